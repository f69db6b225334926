"""``python -m tests.fuzz --count 2000 --seed 0 --jobs 2 --out results.jsonl``.

``--show SEED`` runs one problem and prints its record; with ``--dump FILE`` it is written as a problem file instead.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

from tests.fuzz.campaign import finished_seeds, run_campaign
from tests.fuzz.summary import SOFT, summarize


def main() -> int:
    """Run seeds that the file of results does not have yet, and print the summary; 1 if anything was found."""
    options = _options()
    if options.show is not None:
        return _show(options.show, options.dump)
    wanted = range(options.seed, options.seed + options.count)
    done = finished_seeds(options.out)
    missing = [seed for seed in wanted if seed not in done]
    started = time.perf_counter()
    with options.out.open("a", encoding="utf-8") as stream:

        def finished(record: dict[str, Any]) -> None:
            stream.write(json.dumps(record) + "\n")
            stream.flush()
            done[record["seed"]] = record
            for finding in record["findings"]:
                sys.stdout.write(
                    f"{finding['command']} {finding['kind']}: {finding['signature']}"
                    f"  [python -m tests.fuzz --show {record['seed']}]\n"
                )
                sys.stdout.flush()

        run_campaign(missing, jobs=options.jobs, limit=options.limit, finished=finished)
    rows = [done[seed] for seed in wanted if seed in done]
    sys.stdout.write(summarize(rows) + f"\n\n{time.perf_counter() - started:.0f} s for {len(missing)} problems\n")
    return int(any(finding["kind"] not in SOFT for row in rows for finding in row["findings"]))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description="Random problems through every command.")
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0, help="the first seed")
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time")
    parser.add_argument("--limit", type=float, default=120.0, help="processor seconds of a problem")
    parser.add_argument("--out", type=Path, default=Path("fuzz.jsonl"), help="results; seeds in it are not run again")
    parser.add_argument("--show", type=int, help="run one seed here and print its record")
    parser.add_argument("--dump", type=Path, help="with --show: write the problem as a TOML file, and do not run it")
    return parser.parse_args()


def _show(seed: int, dump: Path | None) -> int:
    from tests.fuzz.generator import draw
    from tests.fuzz.runner import run_seed

    if dump is not None:
        import certbound as cb

        cb.save(draw(seed)[1], dump)
        sys.stdout.write(dump.read_text(encoding="utf-8"))
        return 0
    record = run_seed(seed, command_line=True)
    findings = record.pop("findings")
    sys.stdout.write(json.dumps(record, indent=1) + "\n")
    for finding in findings:
        sys.stdout.write(f"\n{finding['command']} {finding['kind']}: {finding['signature']}\n{finding['message']}\n")
    return int(any(finding["kind"] not in SOFT for finding in findings))


if __name__ == "__main__":
    sys.exit(main())
