"""The box of a problem in three states: its limits and, where nothing limits a state, ends beyond simulated paths."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.problem import Problem
from certbound.values.room import limits_of

_PATHS, _STEPS = 400, 200
_BEYOND = 0.35  # of the paths' extent


def closed_room(
    problem: Problem, drift: Callable[..., Array], square: Callable[..., Array]
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Ends of a box within the limits. Any such box will do: leaving it counts as failing.

    Raises
    ------
    InfeasibleError
        The limits are no box, leave no interior, or hold over a window; or paths run away where there is no limit.
    """
    room = limits_of(problem)
    low, high = np.array(room.inner_low), np.array(room.inner_high)
    if not np.all(low < high):
        raise InfeasibleError("the safe set has no interior.")
    if not np.isfinite([low, high]).all():
        ends = _reach(problem, drift, square, low, high)
        if not np.isfinite(ends).all() or not np.all(ends[0] < ends[1]):
            raise InfeasibleError("value functions need a bounded safe set: add limits, or a `domain`.")
        low, high = np.where(np.isfinite(low), low, ends[0]), np.where(np.isfinite(high), high, ends[1])
    return tuple(float(end) for end in low), tuple(float(end) for end in high)


def _reach(
    problem: Problem, drift: Callable[..., Array], square: Callable[..., Array], low: Array, high: Array
) -> Array:
    """Ends of a box that hardly a path leaves before it breaks a limit, from simulated ones; shape (2, n)."""
    rng = np.random.default_rng(0)
    hull, n = problem.initial.hull(), len(low)
    x = rng.uniform(hull.lo, hull.hi, (_PATHS, n)).T
    least, most = x.min(axis=1), x.max(axis=1)
    step = float(problem.horizon) / _STEPS
    for k in range(_STEPS):
        a = np.moveaxis(square(k * step, *x) * np.ones((n, n, _PATHS)), -1, 0)
        values, vectors = np.linalg.eigh(a)
        root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
        noise = np.einsum("nij,nj->in", root, rng.standard_normal((_PATHS, n)))
        moved = x + step * drift(k * step, *x)[0] + np.sqrt(step) * noise
        inside = np.all((low <= moved.T) & (high >= moved.T), axis=1)
        x = np.where(inside, moved, x)
        least, most = np.minimum(least, x.min(axis=1)), np.maximum(most, x.max(axis=1))
    beyond = _BEYOND * (most - least)
    return np.stack([least - beyond, most + beyond])
