"""Models with many states: certified rates and verdicts, beside what sampling and simulation find, and what they cost.

A power grid of 78 states, a formation of 100, a heat equation of 200 and 60 forced oscillators; the quick run takes the
same models with fewer members (the grid is what it is) and fewer paths. Seconds are processor time, in one process.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable

import numpy as np

import certbound as cb
from certbound.problem.library.grid import grid
from certbound.problem.library.large_models import formation, heat, kuramoto
from certbound.problem.problem import Problem
from experiments.harness import Arrays, Claims, main

PATHS = 100_000
STEPS = 500
LIMIT = 60.0  # seconds for a verdict, as the command line has it
COLUMNS = ("states", "rate", "gap", "seconds", "log10_delta", "verifying", "exit", "upper", "simulating")

Builders = dict[str, Callable[[], Problem]]


def builders(full: bool) -> Builders:
    """Name to model."""
    if full:
        return {"grid": grid, "formation": formation, "heat": heat, "kuramoto": kuramoto}
    return {
        "grid": grid,
        "formation": lambda: formation(agents=20),
        "heat": lambda: heat(nodes=40),
        "kuramoto": lambda: kuramoto(oscillators=20),
    }


def row(problem: Problem, paths: int) -> tuple[float, ...]:
    """Under ``COLUMNS``, a row of the table."""
    start = time.process_time()
    constants = cb.bound_constants(problem)
    bounded = time.process_time()
    if constants.gap is None:
        raise ValueError(f"`{problem.name}` must have certified constants.")
    verdict = cb.verify_safety(problem, time_limit=LIMIT)
    verified = time.process_time()
    counted = cb.simulate_exits(problem, paths=paths, rng=1, steps=STEPS)
    simulated = time.process_time()
    sides = problem.system.dimension, constants.worst_slope, constants.gap, bounded - start
    return *sides, verdict.log10_delta, verified - bounded, counted.exits, counted.upper, simulated - verified


def compute(full: bool) -> tuple[Arrays, Claims]:
    """One row per model, and the largest memory that the process took, in MB."""
    names, rows, paths = [], [], PATHS if full else PATHS // 50
    for name, build in builders(full).items():
        names.append(name)
        rows.append(row(build(), paths))
        states, rate, gap, seconds, proved, verifying, exits, upper, simulating = rows[-1]
        print(
            f"{name:10s} {states:4.0f} states: rate {rate:.6g} 1/s, gap {gap:.1e}, {seconds:.1f} s; "
            f"P <= 10^{proved:.1f}, {verifying:.1f} s; {exits:.0f} of {paths} paths left (99 %: P <= {upper:.1e}), "
            f"{simulating:.1f} s",
            flush=True,
        )
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    table = np.array(rows)
    claims: Claims = {"models": names, "megabytes": memory}
    claims |= {f"{name}s": table[:, COLUMNS.index(name)].tolist() for name in ("rate", "gap", "log10_delta", "exit")}
    return dict(zip(COLUMNS, table.T)), claims


if __name__ == "__main__":
    main("large_models", compute)
