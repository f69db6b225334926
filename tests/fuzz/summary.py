"""What a campaign found, in words: counts, the closest calls, the slowest answers, and every signature with a seed."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from typing import Any

__all__ = ["summarize"]

SOFT = frozenset({"close call", "none", "engine failed", "weaker"})
"""Kinds that are counted apart: a verdict within 2 % of its limit in other units, SAFE without a certificate, an engine
that failed where it should have said why it does not apply, and a certificate of SAFE that claims more than delta (it
states windows where the verdict has crossing rates and clocks; ``verify --certificate`` says so in a line)."""


def summarize(records: Iterable[Mapping[str, Any]]) -> str:
    """The report on records."""
    rows = list(records)
    lines = [f"{len(rows)} problems", "", "answers"]
    by_command: dict[str, Counter[str]] = defaultdict(Counter)
    for row in rows:
        for command, answer in row["answers"].items():
            by_command[command][answer.partition(":")[0]] += 1
    for command, answers in by_command.items():
        lines.append(f"  {command:16}" + ", ".join(f"{answer} {count}" for answer, count in answers.most_common()))
    lines += ["", "problems by feature, and how many of them are SAFE", *_coverage(rows)]
    lines += ["", *_closest(rows), "", *_slowest(rows), "", *_findings(rows)]
    return "\n".join(lines)


def _coverage(rows: list[Mapping[str, Any]]) -> list[str]:
    counts: Counter[str] = Counter()
    safe: Counter[str] = Counter()
    for row in rows:
        for feature in [*row["features"], f"family: {row['family']}"]:
            counts[feature] += 1
            safe[feature] += row["answers"].get("verify") == "SAFE"
    return [f"  {counts[name]:5} {safe[name]:5}  {name}" for name in sorted(counts)]


def _closest(rows: list[Mapping[str, Any]]) -> list[str]:
    known = sorted(
        (row["facts"]["ratio to estimate"], row["seed"]) for row in rows if "ratio to estimate" in row["facts"]
    )
    limits = sorted((row["facts"]["ratio"], row["seed"]) for row in rows if "ratio" in row["facts"])
    lines = [f"certified over simulated ({len(known)} with exits), closest"]
    lines += [f"  {ratio:.4g} to the estimate (seed {seed})" for ratio, seed in known[:5]]
    return lines + [f"  {ratio:.4g} to the lower limit (seed {seed})" for ratio, seed in limits[:5]]


def _slowest(rows: list[Mapping[str, Any]]) -> list[str]:
    total: dict[str, list[tuple[float, int]]] = defaultdict(list)
    for row in rows:
        for command, seconds in row["seconds"].items():
            total[command].append((seconds, row["seed"]))
    lines = ["seconds of processor time: sum, mean, slowest with its seed"]
    for command, found in total.items():
        spent, (worst, seed) = sum(s for s, _ in found), max(found)
        lines.append(f"  {command:12} {spent:9.1f} {spent / len(found):7.2f} {worst:7.1f} ({seed})")
    return lines


def _findings(rows: list[Mapping[str, Any]]) -> list[str]:
    seeds: dict[tuple[str, str, str], list[int]] = defaultdict(list)
    for row in rows:
        for finding in row["findings"]:
            key = (finding["command"], finding["kind"], finding["signature"])
            if row["seed"] not in seeds[key]:
                seeds[key].append(row["seed"])
    bad = {row["seed"] for row in rows if any(f["kind"] not in SOFT for f in row["findings"])}
    lines = [f"{len(bad)} of {len(rows)} problems with a finding ({len(seeds)} signatures)"]
    for (command, kind, signature), found in sorted(seeds.items(), key=lambda item: -len(item[1])):
        shown = " ".join(str(seed) for seed in sorted(found)[:4])
        lines.append(f"  {len(found):4}  {command} {kind}: {signature}  (seeds {shown})")
    return lines
