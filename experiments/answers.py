"""Whether every bundled problem and benchmark is answered as before, bit for bit.

``python -m experiments.answers before.json`` stores the answers; the same command with another name and
``--against before.json``, after a change, prints what differs and ends with 1 if anything does. An answer is what
``certbound verify --json`` prints, with hashes of the tube and of the certificate.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from pathlib import Path
from typing import Any

import certbound as cb
from certbound.errors import CertificateError
from experiments.certificates import subjects

__all__ = ["answer", "differences", "main"]


def answer(problem: cb.Problem) -> dict[str, Any]:
    """The verdict on a problem as JSON would state it, and the certificate's hash (or why there is none)."""
    verdict = cb.verify_safety(problem)
    data = verdict.to_dict()
    data["tube"] = _hash(data["tube"])
    try:
        data["certificate"] = _hash(verdict.certificate)
    except CertificateError as error:
        data["certificate"] = str(error)
    plain: dict[str, Any] = json.loads(json.dumps(data))
    return plain


def _hash(data: Any) -> str:
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


def differences(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """One line for each key of each problem that is not the same."""
    lines = []
    for name in sorted({*before, *after}):
        old, new = before.get(name, {}), after.get(name, {})
        lines += [
            f"{name}: {key}: {old.get(key)!r} -> {new.get(key)!r}"
            for key in sorted({*old, *new})
            if old.get(key) != new.get(key)
        ]
    return lines


def main() -> int:
    """Store the answers, and compare them if asked."""
    parser = argparse.ArgumentParser(prog="python -m experiments.answers")
    parser.add_argument("out", type=Path, help="where the answers are stored")
    parser.add_argument("--against", type=Path, help="answers of an earlier run")
    options = parser.parse_args()
    answers = {}
    for name, problem in subjects().items():
        answers[name] = answer(problem)
        print(f"{name:28s} {answers[name]['status']:14s} {answers[name]['log10_delta']!r}", flush=True)
    options.out.write_text(json.dumps(answers, indent=1) + "\n", encoding="utf-8")
    if options.against is None:
        return 0
    lines = differences(json.loads(options.against.read_text(encoding="utf-8")), answers)
    print("\n".join(lines) or f"the same: {len(answers)} answers")
    return int(bool(lines))


if __name__ == "__main__":
    sys.exit(main())
