"""Where a line without a limit on some side is cut, in floats: far beyond where paths get to.

The cut is no hypothesis: above, leaving through it counts as failing; below, as not failing.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.model import compile_numpy
from certbound.problem.problem import Problem
from certbound.values.continuous.hypotheses import Model
from certbound.values.continuous.line.initial_law import Start
from certbound.values.continuous.line.phases import last_instant, limits_of, value_at

_PATHS, _STEPS = 400, 200
_DEVIATIONS = 7.0
_FARTHEST = 1e9  # times the largest of the starts and limits, and times 1
_LARGEST = 1e60  # units in which V's second derivatives would fall below the smallest float are refused


def cuts_of(
    problem: Problem, model: Model, start: Start, held: tuple[float | None, float | None] = (None, None)
) -> tuple[float, float]:
    """A place below and one above everything; `inf` is never returned. No path crosses the ``held`` ones.

    Raises
    ------
    InfeasibleError
        Paths get beyond any bound, so that no cut helps.
    """
    places = []
    always: set[int] = set()  # the sides that are never without a limit
    for limit, window in limits_of(problem, inner=False):
        always |= {limit.side} if window[0] <= 0 and window[1] >= last_instant(problem) else set()
        times = [0.0, last_instant(problem)] if limit.center is None else np.linspace(0, last_instant(problem), 9)
        for t in times:
            moved = 0.0 if limit.center is None else float(value_at(limit.center, float(t)).mid)
            places.append(limit.offset + moved)
    scale = max(1.0, *(abs(place) for place in (start.low, start.high, *places)))
    if not scale < _LARGEST:
        raise InfeasibleError(f"value functions need states below {_LARGEST:g}: write the state in another unit.")
    always |= {side for side, place in enumerate(held) if place is not None}
    places += [place for place in held if place is not None]
    if len(always) == 2:
        return min(places), max(places)  # nothing is cut
    low, high = _spread(problem, model, start, _FARTHEST * scale, held)
    low, high = min([low, *places]), max([high, *places])
    square = compile_numpy(model.square.tape)
    room = 0.02 * (high - low)
    at = _beyond(square, np.zeros(2), np.array([low, high]), np.array([-room, room]))
    return float(at[0]), float(at[1])


def _spread(
    problem: Problem, model: Model, start: Start, farthest: float, held: tuple[float | None, float | None]
) -> tuple[float, float]:
    """Extremes of a few paths with the worst disturbances each way, extended by so many deviations."""
    drift, square = compile_numpy(model.drift.tape), compile_numpy(model.square.tape)
    corners = [[float(value.mid) for value in branch] for branch in model.branches]
    rng = np.random.default_rng(0)
    horizon = last_instant(problem)
    step = horizon / _STEPS
    sigma = math.sqrt(start.variance)
    ends = []
    for sign, begin in ((-1.0, start.low), (1.0, start.high)):
        x: Array = begin + sigma * rng.standard_normal(_PATHS)
        far = begin + sign * _DEVIATIONS * sigma
        middle, deviation, clock = np.empty(_STEPS), np.empty(_STEPS), np.linspace(0, horizon - step, _STEPS)
        for k in range(_STEPS):
            with np.errstate(all="ignore"):
                f = np.array([np.broadcast_to(drift(clock[k], x, *c)[..., 0], x.shape) for c in corners])
                g = np.sqrt(np.broadcast_to(square(clock[k], x)[..., 0, 0], x.shape))
                x = x + step * sign * (sign * f).max(axis=0) + np.sqrt(step) * g * rng.standard_normal(_PATHS)
            x = np.clip(x, -math.inf if held[0] is None else held[0], math.inf if held[1] is None else held[1])
            if not np.all(np.abs(x) < farthest):
                raise InfeasibleError(_BEYOND)
            middle[k], deviation[k] = np.median(x), np.std(x)
            far = sign * max(sign * far, float((sign * x).max()))
        beyond = _beyond(square, clock, middle, sign * _DEVIATIONS * deviation)
        ends.append(sign * max(sign * far, float((sign * beyond).max())))
    if not max(-ends[0], ends[1]) < farthest:
        raise InfeasibleError(_BEYOND)
    return ends[0], ends[1]


def _beyond(square: Callable[..., Array], clock: Array, middle: Array, way: Array) -> Array:
    """The places at a distance from the middle that is measured by the noise: multiplicative noise never reaches 0."""
    parts, x = 64, middle
    with np.errstate(all="ignore"):
        start = np.maximum(square(clock, middle)[..., 0, 0], 1e-300)
        for _ in range(parts):
            x = x + way / parts * np.sqrt(np.maximum(square(clock, x)[..., 0, 0], 0.0) / start)
        return np.where(np.isfinite(x), x, middle + way)


_BEYOND = (
    "value functions need a bounded safe set, or paths that stay in reach; here paths leave every bound: add a "
    "`domain`, or a constraint that bounds the state."
)
