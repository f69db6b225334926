"""Certified rates of models with many states: how far above what sampling found, and what they cost.

A power grid of 78 states, a formation of 100, a heat equation of 200 and 60 forced oscillators; the quick run takes the
same models with fewer members (the grid is what it is). Seconds are processor time, in one process.
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


def row(problem: Problem) -> tuple[int, float, float, float]:
    """(states, certified rate, what it lies above the sampled one, seconds)."""
    start = time.process_time()
    constants = cb.bound_constants(problem)
    seconds = time.process_time() - start
    if constants.gap is None:
        raise ValueError(f"`{problem.name}` must have certified constants.")
    return problem.system.dimension, constants.worst_slope, constants.gap, seconds


def compute(full: bool) -> tuple[Arrays, Claims]:
    """One row per model, and the largest memory that the process took, in MB."""
    names, rows = [], []
    for name, build in builders(full).items():
        names.append(name)
        rows.append(row(build()))
        states, rate, gap, seconds = rows[-1]
        print(f"{name:10s} {states:4d} states: rate {rate:.6g} 1/s, gap {gap:.1e}, {seconds:.1f} s")
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    table = np.array(rows)
    arrays: Arrays = {"states": table[:, 0], "rate": table[:, 1], "gap": table[:, 2], "seconds": table[:, 3]}
    claims: Claims = {"models": names, "rates": table[:, 1].tolist(), "gaps": table[:, 2].tolist(), "megabytes": memory}
    return arrays, claims


if __name__ == "__main__":
    main("large_models", compute)
