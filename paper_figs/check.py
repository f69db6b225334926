"""Compares every number that the paper prints with what the experiments found.

``python -m paper_figs.check quick`` prints one line a claim and ends with "N passed, N failed".
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
DATA = HERE.parent / "experiments" / "out"

STATUSES = (
    "reproduced",
    "reproduced under a stated reading",
    "refuted",
    "depends on reconstruction",
    "certbound",
)


@dataclass(frozen=True, kw_only=True)
class Row:
    """One expectation beside what was found."""

    name: str
    place: str
    expected: Any
    found: Any
    status: str
    passed: bool
    note: str


def compare(expectation: Mapping[str, Any], found: Any) -> bool:
    """True where a found number meets its expectation.

    ``value`` with ``tolerance`` (absolute), ``at_least``, ``at_most``; ``value`` alone asks for equality.
    """
    if found is None:
        return False
    if "value" in expectation:
        value = expectation["value"]
        if isinstance(value, list):
            pairs = zip(value, found) if isinstance(found, list) else ()
            return len(value) == len(found) and all(compare({**expectation, "value": a}, b) for a, b in pairs)
        if "tolerance" in expectation:
            return bool(abs(found - value) <= expectation["tolerance"])
        return bool(found == value)
    return bool(expectation.get("at_least", found) <= found <= expectation.get("at_most", found))


def check(expected: Sequence[Mapping[str, Any]], claims: Mapping[str, Mapping[str, Any]], mode: str) -> list[Row]:
    """One row for each expectation that applies to the mode; a claim that is missing has failed."""
    rows = []
    for entry in expected:
        if entry["status"] not in STATUSES:
            raise ValueError(f"`status` must be one of {', '.join(STATUSES)}, got {entry['status']!r}.")
        if entry.get("mode", mode) != mode:
            continue
        stem, _, name = entry["claim"].partition(".")
        found = claims.get(stem, {}).get(name)
        rows.append(
            Row(
                name=entry["claim"],
                place=entry["place"],
                expected=entry.get("printed", _goal(entry)),
                found=found,
                status=entry["status"],
                passed=compare(entry, found),
                note=entry.get("note", ""),
            )
        )
    return rows


def table(rows: Sequence[Row]) -> str:
    """The rows as text, and the count."""
    lines = []
    for row in rows:
        mark = "pass" if row.passed else "FAIL"
        lines.append(
            f"{mark}  {row.name:<34} {row.place:<34} wanted {show(row.expected):<38} "
            f"found {show(row.found):<26} {row.status}"
        )
    return "\n".join([*lines, summary(rows)])


def summary(rows: Sequence[Row]) -> str:
    """How many passed and failed."""
    passed = sum(row.passed for row in rows)
    return f"{passed} passed, {len(rows) - passed} failed"


def _goal(entry: Mapping[str, Any]) -> Any:
    if "value" in entry:
        return entry["value"]
    return ", ".join(f"{word} {entry[key]}" for key, word in (("at_least", ">="), ("at_most", "<=")) if key in entry)


def show(value: Any) -> str:
    """A value in a few signs."""
    if isinstance(value, float):
        return f"{value:.5g}"
    if isinstance(value, list):
        return " ".join(show(item) for item in value)
    return str(value)


def load_claims(mode: str) -> dict[str, dict[str, Any]]:
    """Stem -> claims, of every experiment that has run in this mode."""
    return {
        path.stem: json.loads(path.read_text(encoding="utf-8"))["claims"]
        for path in sorted((DATA / mode).glob("*.json"))
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; 1 where anything failed."""
    parser = argparse.ArgumentParser(prog="python -m paper_figs.check")
    parser.add_argument("mode", nargs="?", choices=["quick", "full"], default="quick")
    parser.add_argument("--expected", type=Path, default=HERE / "expected.json")
    options = parser.parse_args(arguments)
    expected = json.loads(options.expected.read_text(encoding="utf-8"))["claims"]
    rows = check(expected, load_claims(options.mode), options.mode)
    print(table(rows))
    return 0 if rows and all(row.passed for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
