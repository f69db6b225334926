"""Knots in time, from the end backward: close together in the layer at the end, and after jumps of the clock."""

from __future__ import annotations

import numpy as np

from certbound.arrays import Array
from certbound.values.kolmogorov.factors import HALF

_FIRST = 12  # steps within the layer at the end
_GROWTH = {2: 1.15, 3: 1.3}  # of these steps: a front leaves it sharp, and blurs slowly; by the number of states
_AFTER, _QUICKER = 0.25, 1.5  # first step after a jump of the clock, as a share of that layer, and how steps grow


def time_steps(horizon: float, count: int, layer: float, states: int) -> Array:
    """Lengths of the steps from the end backward: small in the end layer, growing to horizon / count."""
    return _graded(horizon, horizon / count, layer / _FIRST, _GROWTH[states])


def _graded(length: float, largest: float, first: float, growth: float) -> Array:
    step = first
    result: list[float] = []
    while step < largest and sum(result) + step < length:
        result.append(step)
        step *= growth
    rest = length - sum(result)
    more = max(int(np.ceil(rest / largest)), 1)
    return np.array(result + [rest / more] * more)


def knots_of(begin: float, horizon: float, count: int, layer: float, breaks: Array, states: int) -> Array:
    """Times of the knots, from the horizon back: as `time_steps`, with two about every break.

    Before a break, backward in time, a solution that does not fit the new coefficients at faces has a layer in time.
    """
    half, largest = HALF * horizon, (horizon - begin) / count
    ends = horizon - np.append(breaks[::-1], begin)  # passed, backward
    passed = [0.0]
    for k, end in enumerate(ends):
        last = end - half if k < len(breaks) else end
        first, faster = (layer / _FIRST, _GROWTH[states]) if k == 0 else (layer * _AFTER, _QUICKER)
        so_far = passed[-1]
        passed += list(so_far + np.cumsum(_graded(last - so_far, largest, first, faster)))
        passed[-1] = last
        if k < len(breaks):
            passed.append(end + half)
    times = horizon - np.array(passed)
    times[-1] = begin
    return np.asarray(times)


__all__ = ["knots_of", "time_steps"]
