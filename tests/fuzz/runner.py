"""One seed: draw the problem, run every command on it, and return the record."""

from __future__ import annotations

import time
import warnings
from typing import Any

from tests.fuzz.commands import Run, signature_of, units_of
from tests.fuzz.generator import draw

__all__ = ["COMMAND_LINE", "run_seed"]

COMMAND_LINE = 20
"""Every 20th problem also goes through the command line."""


def run_seed(seed: int, *, command_line: bool | None = None, units: int = 1) -> dict[str, Any]:
    """The record of a problem: what it has, what every command answered, how long it took, and what went wrong."""
    started = time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            draft, problem = draw(seed)
    except Exception as error:  # noqa: BLE001  (a legal problem that is refused is a finding)
        finding = {"command": "problem", "kind": "error", "signature": signature_of(error), "message": str(error)}
        return {
            "seed": seed,
            "family": "?",
            "features": [],
            "answers": {},
            "seconds": {},
            "facts": {},
            "findings": [finding],
        }
    run = Run(draft, problem)
    run.verify()
    if run.seconds["verify"] < 2.0:
        others = units_of(draft, run.rng(0))
        for k in range(min(units, len(others))):
            run.units(*others[(seed + k) % len(others)])
    run.certificate()
    run.tune(run.derive())
    run.reach()
    run.simulate()
    run.file()
    if command_line if command_line is not None else seed % COMMAND_LINE == 0:
        run.command_line()
    run.seconds["all"] = time.process_time() - started
    return run.to_dict()
