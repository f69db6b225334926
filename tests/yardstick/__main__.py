"""``python -m tests.yardstick [NAME ...] [--limit 20] [--method M] [--out FILE] [--against FILE]``.

Prints a line a problem and, beside a stored run, what differs; ends with 1 if a bound is weaker, or a decision or a
certificate is lost.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

from tests.yardstick.comparison import differences, line, worse
from tests.yardstick.measure import Run, measured
from tests.yardstick.problems import Entry, entries


def main() -> int:
    """Run problems, print and write what is found, and compare it."""
    options = _options()
    stored = _stored(options.against) if options.against else {}
    runs = _stored(options.out) if options.out and options.out.exists() else {}
    begin, losses = time.perf_counter(), list[str]()
    for entry in _chosen(options.names):
        run = runs[entry.name] = measured(entry.name, min(options.limit, entry.limit), options.method)
        found = differences(run, stored[entry.name]) if entry.name in stored else []
        losses += [entry.name] if worse(found) else []
        sys.stdout.write("\n    ".join([line(entry.name, entry.kind, run), *found]) + "\n")
        sys.stdout.flush()
        if options.out:
            _write(options.out, runs)
    sys.stdout.write(f"{time.perf_counter() - begin:.0f} s\n")
    if stored:
        missing = [one.name for one in _chosen(options.names) if one.name not in stored]
        sys.stdout.write(f"nothing stored of: {', '.join(missing)}\n" if missing else "")
        sys.stdout.write(f"weaker or lost: {', '.join(losses) or 'nothing'}\n")
    return int(bool(losses))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m tests.yardstick", description="Problems, and what is proved of them."
    )
    parser.add_argument("names", nargs="*", help="names, or parts of names or classes (default: all)")
    parser.add_argument(
        "--limit", type=float, default=20.0, help="seconds of processor time that a question may take at most"
    )
    parser.add_argument("--method", default="auto", help="auto, or an engine's name")
    parser.add_argument("--out", type=Path, help="write the run; what the file has of other problems stays")
    parser.add_argument("--against", type=Path, help="compare with a stored run")
    return parser.parse_args()


def _chosen(names: list[str]) -> list[Entry]:
    known = entries()
    chosen = [one for one in known.values() if not names or any(part in f"{one.name} {one.kind}" for part in names)]
    missing = [part for part in names if not any(part in f"{one.name} {one.kind}" for one in known.values())]
    if missing:
        raise SystemExit(f"no problem of the yardstick is called {missing[0]!r}; it has {', '.join(known)}.")
    return chosen


def _stored(file: Path) -> dict[str, Run]:
    return {name: Run(**data) for name, data in json.loads(file.read_text(encoding="utf-8")).items()}


def _write(file: Path, runs: dict[str, Run]) -> None:
    known = [name for name in entries() if name in runs]
    rows = [f"{json.dumps(name)}: {json.dumps(runs[name].as_data())}" for name in known]
    file.write_text("{\n" + ",\n".join(rows) + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
