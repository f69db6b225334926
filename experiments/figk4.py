"""Fig. K4: seconds against the number of states, for the chain at rest with more and more masses.

Constants (metric and proof), the linear-response verdict, and a simulation of equal strength: the paths that a
Clopper-Pearson limit needs to support the same delta when none of them leaves. These are timings: the one
experiment whose numbers differ from run to run.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np

import certbound as cb
from certbound.errors import CertboundError
from experiments.harness import Arrays, Claims, main

QUICK, FULL = (3, 4, 6), (3, 5, 10, 20, 40)
CONFIDENCE = 0.99
LEVELS = (1e-3, 1e-6)


def compute(full: bool) -> tuple[Arrays, Claims]:
    """Seconds of each task, shape (sizes,); nan where a task was left out."""
    masses = FULL if full else QUICK
    cb.verify_safety(cb.load("chain_rest"), method="linear")  # imports are not what is timed
    rows: dict[str, list[float]] = {"constants": [], "linear": [], "sampling": []}
    status = []
    for count in masses:
        problem = cb.load("chain_rest", masses=float(count))
        # beyond 20 masses the semidefinite program takes minutes
        rows["constants"].append(seconds(lambda p=problem: cb.bound_constants(p)) if count <= 20 else math.nan)
        started = time.perf_counter()
        status.append(cb.verify_safety(problem, method="linear").status)
        rows["linear"].append(time.perf_counter() - started)
        counts = cb.simulate_exits(problem, paths=20_000, rng=np.random.default_rng(14))
        rows["sampling"].append(counts.seconds / counts.paths)
    arrays: Arrays = {name: np.array(values) for name, values in rows.items()}
    arrays["states"] = 2 * np.array(masses)
    arrays["levels"] = np.array(LEVELS)
    arrays["paths_needed"] = np.array([paths_needed(level) for level in LEVELS])
    claims: Claims = {
        "states": [2 * count for count in masses],
        "all_safe": all(one == "SAFE" for one in status),
        "paths_needed_1e6": int(paths_needed(1e-6)),
        "slowest_linear": float(np.max(arrays["linear"])),
    }
    return arrays, claims


def paths_needed(level: float) -> float:
    """Paths without a single exit after which the upper limit is at most ``level``."""
    return math.ceil(math.log((1 - CONFIDENCE) / 2) / math.log1p(-level))


def seconds(task: Callable[[], Any]) -> float:
    """Wall time of one run; nan where no answer exists."""
    started = time.perf_counter()
    try:
        task()
    except CertboundError:
        return math.nan
    return time.perf_counter() - started


if __name__ == "__main__":
    main("figk4", compute)
