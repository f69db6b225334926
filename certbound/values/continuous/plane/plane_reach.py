"""Where simulated paths get to, in floats: where a box may end that nothing bounds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from certbound.arrays import Array
from certbound.problem.problem import Problem

_PATHS, _STEPS = 400, 200

Floats = Callable[[float, Array, Array], Array]


def reach_of(problem: Problem, drift: Floats, square: Floats, share: float) -> list[Array]:
    """Ends of a box that hardly a path leaves, from simulated ones."""
    rng = np.random.default_rng(0)
    hull = problem.initial.hull()
    x = rng.uniform(hull.lo, hull.hi, (_PATHS, 2)).T
    least, most = x.min(axis=1), x.max(axis=1)
    step = float(problem.horizon) / _STEPS
    for k in range(_STEPS):
        t = k * step
        a = np.moveaxis(square(t, *x) * np.ones((2, 2, _PATHS)), -1, 0)
        values, vectors = np.linalg.eigh(a)
        root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
        noise = np.einsum("nij,nj->in", root, rng.standard_normal((_PATHS, 2)))
        moved = x + step * drift(t, *x)[0] + np.sqrt(step) * noise
        x = np.where(np.isfinite(moved), moved, x)
        least, most = np.minimum(least, x.min(axis=1)), np.maximum(most, x.max(axis=1))
    beyond = share * (most - least)
    return [least - beyond, most + beyond]
