"""Knots in time, from the end backward: close together in the layer at the end, and after jumps of the clock."""

from __future__ import annotations

from functools import partial

import numpy as np

from certbound.arrays import Array
from certbound.values.kolmogorov.axes import Size
from certbound.values.kolmogorov.factors import HALF

_FIRST = 12  # steps within the layer at the end
_GROWTH = {2: 0.15, 3: 0.3}  # of steps with the time passed: a front leaves it sharp, and blurs slowly; by the number
# of states
_AFTER, _QUICKER = 0.25, 0.5  # first step after a jump of the clock, as a share of that layer, and how steps grow
_RUNG = {2: 1.2, 3: 1.05}
"""Ratio of the lengths that steps have. In two states an equation that does not change is factored once for each, which
takes as long as a dozen steps: with 1.07 a third of the time of ten seconds was spent on that."""


def growing_steps(layer: float, longest: Size, states: int) -> Size:
    """Lengths of steps that grow from the layer at the end on, to ``longest``."""
    return partial(_least, longest, 0.0, partial(_growing, layer / _FIRST, _GROWTH[states]))


def _growing(first: float, growth: float, passed: Array) -> Array:
    return first + growth * np.maximum(passed, 0.0)


def time_steps(horizon: float, longest: Size, states: int) -> Array:
    """Lengths of the steps from the end backward, each about ``longest`` at the time passed before it."""
    return _graded(horizon, longest, _RUNG[states])


def _graded(length: float, longest: Size, ratio: float) -> Array:
    first = float(longest(np.array(0.0)))
    result: list[float] = []
    passed = 0.0
    while passed < length * (1 - 1e-9):
        rung = np.floor(np.log(float(longest(np.array(passed))) / first) / np.log(ratio) + 1e-9)
        result.append(float(first * ratio**rung))
        passed += result[-1]
    return np.array(result) * (length / passed)


def knots_of(begin: float, horizon: float, longest: Size, layer: float, breaks: Array, states: int) -> Array:
    """Times of the knots, from the horizon back: as `time_steps`, with two about every break.

    Before a break, backward in time, a solution that does not fit the new coefficients at faces has a layer in time.
    """
    half = HALF * horizon
    ends = horizon - np.append(breaks[::-1], begin)  # passed, backward
    passed = [0.0]
    for k, end in enumerate(ends):
        last = end - half if k < len(breaks) else end
        so_far = passed[-1]
        least = partial(_growing, layer * _AFTER, _QUICKER) if k else partial(np.full_like, fill_value=np.inf)
        steps = _graded(last - so_far, partial(_least, longest, so_far, least), _RUNG[states])
        passed += list(so_far + np.cumsum(steps))
        passed[-1] = last
        if k < len(breaks):
            passed.append(end + half)
    times = horizon - np.array(passed)
    times[-1] = begin
    return np.asarray(times)


def _least(longest: Size, begin: float, other: Size, passed: Array) -> Array:
    return np.minimum(longest(begin + passed), other(passed))


__all__ = ["growing_steps", "knots_of", "time_steps"]
