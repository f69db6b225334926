"""Fig. K3: the largest noise level at which the unicycle is certified, over the horizon, delta = 1e-3.

Linear response (one cell for the whole initial box), the contraction tube with local rates, and the level at which
simulated paths begin to hit an obstacle more often than delta.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

import certbound as cb
from certbound.errors import CertboundError
from certbound.problem.problem import Problem
from experiments.harness import Arrays, Claims, main

QUICK, FULL = (0.5, 0.75, 1.0), (0.5, 1.0, 2.0, 3.5, 5.0)
LOCAL = 1.0  # the longest horizon at which local rates are tried at more than the lowest level


def compute(full: bool) -> tuple[Arrays, Claims]:
    """Largest levels on a geometric grid, found by bisection."""
    horizons = FULL if full else QUICK
    grid = np.geomspace(0.01, 0.64, 25) if full else np.geomspace(0.04, 0.64, 5)
    paths = 200_000 if full else 20_000
    linear, local, simulated = [], [], []
    for horizon in horizons:
        linear.append(largest(grid, lambda sigma, T=horizon: certified(sigma, T, "linear", cells=1)))
        if full or horizon < LOCAL:
            tried = grid[: (len(grid) if horizon <= LOCAL else 1) if full else 3]
            local.append(largest(tried, lambda sigma, T=horizon: certified(sigma, T, "constants")))
        else:
            local.append(math.nan)
        simulated.append(largest(grid, lambda sigma, T=horizon: survives(sigma, T, paths)))
    arrays: Arrays = {
        "horizons": np.array(horizons),
        "linear": np.array(linear),
        "local": np.array(local),
        "simulated": np.array(simulated),
    }
    shown = FULL[2] if full else QUICK[-1]
    index = horizons.index(shown)
    claims: Claims = {
        "step": float(grid[1] / grid[0]),
        "paths": paths,
        "shown": shown,
        "linear_shown": linear[index],
        "simulated_shown": simulated[index],
        "local_half": local[0],
        "linear_last": linear[-1],
        "last": horizons[-1],
        "consistent": bool(np.all(np.array(linear) <= np.array(simulated))),
    }
    return arrays, claims


def course(sigma: float, horizon: float) -> Problem:
    """The unicycle at another noise level and horizon."""
    return cb.load("unicycle", sigma=sigma).replace(horizon=horizon)


def certified(sigma: float, horizon: float, method: str, cells: int | None = None) -> bool:
    """Whether one engine proves it safe."""
    try:
        return cb.verify_safety(course(sigma, horizon), method=method, cells=cells).status == "SAFE"
    except CertboundError:
        return False


def survives(sigma: float, horizon: float, paths: int) -> bool:
    """Whether simulated paths hit an obstacle no more often than delta."""
    problem = course(sigma, horizon)
    seed = round(1e6 * sigma) + round(1e3 * horizon)
    return cb.simulate_exits(problem, paths=paths, rng=np.random.default_rng(seed)).probability <= problem.delta


def largest(grid: np.ndarray, holds: Callable[[float], bool]) -> float:
    """Largest value of the grid at which a monotone property holds; 0 where it holds nowhere."""
    low, high = -1, len(grid)
    while high - low > 1:
        middle = math.ceil((low + high) / 2)
        if middle == high:
            break
        low, high = (middle, high) if holds(float(grid[middle])) else (low, middle)
    return float(grid[low]) if low >= 0 else 0.0


if __name__ == "__main__":
    main("figk3", compute)
