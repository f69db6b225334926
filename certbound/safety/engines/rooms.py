"""From rooms to numbers: the probability of given rooms, the tube at a given probability.

Thm K2 turns the rooms r_k into a bound of P(exists t: ||S_t||_P > r_t); a tube of the paper, which has no such
converse, is tried at several delta. Everything that ends in a probability is evaluated in ball arithmetic by the
tubes room; what is searched here only proposes.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from flint import arb

from certbound.arrays import Array
from certbound.reach.nominal import Curve
from certbound.rigor.balls import precision, upper
from certbound.tubes.constants import Constants
from certbound.tubes.kummer import exit_level, moderate_parameters
from certbound.tubes.question import Question, Start
from certbound.tubes.tube import Tube
from certbound.tubes.tuning import least_exit_level

Profile = tuple[Array, Array]

SMALLEST_LOG10 = -290.0
BISECTIONS = 9
BELOW = 1e-9
"""A tube that fits at a little less than the target leaves no doubt about the last digit of a logarithm."""


def room_level(constants: Constants, *, horizon: float, profile: Profile, start: Start, fits: bool = False) -> float:
    """log10 of Thm K2's bound for rooms given as (times, values); at most 0.

    ``fits`` says that a tube at the target fits into the rooms: a search that then comes back with nothing has lost
    its way, and a few moderate parameters are tried instead.
    """
    if not np.all(profile[1] > 0):
        return 0.0
    if not np.any(np.isfinite(profile[1])):
        return -1e12  # nothing is asked
    question = Question.of(constants, horizon, clearance=profile, start=start)
    level = least_exit_level(question)
    if level < 0.0 or not fits:
        return level
    cut = question.cut
    for a, v0 in moderate_parameters(cut):
        level = min(level, exit_level(cut, question.clearance, a=a, v0=v0, start=start))
    return max(level, -1e12)


def smallest_level(
    tube_at: Callable[[float], Tube],
    fits: Callable[[Tube], bool],
    target: float,
    fitting: Tube | None,
    *,
    closely: bool = True,
) -> float:
    """log10 of about the smallest delta at which a named tube fits; 0 if it fits at none.

    ``tube_at`` takes a delta to its tube; ``fits`` says, rigorously, whether a tube fits into the rooms; ``target`` is
    the delta that was asked for, ``fitting`` the tube at it, if it fits. Not ``closely``: only the target and 1/2 are
    tried.
    """

    def proved(log10: float) -> float | None:
        tube = tube_at(10.0**log10)
        return tube.log10_delta if fits(tube) else None

    asked = math.log10(target)
    if fitting is not None:
        low, high = SMALLEST_LOG10, asked
        below = proved(asked - BELOW)
        best = fitting.log10_delta if below is None else below
        smallest = proved(low) if closely else best
        if smallest is not None:
            return smallest
    else:
        low, high = asked, -1e-3 if closely else math.log10(0.5)
        found = proved(high)
        if found is None:
            return 0.0
        best = found
    if not closely:
        return best
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        found = proved(middle)
        if found is None:
            low = middle
        else:
            high, best = middle, found
        if high - low < 0.005 * abs(high):
            break
    return best


def deviation_pieces(curve: Curve, radius: Array) -> tuple[Array, Array]:
    """Times (K + 1,) and the radius between them; in discrete time the larger one of both steps."""
    if curve.continuous:
        return np.append(curve.starts, curve.ends[-1]), radius
    return np.asarray(curve.starts), np.maximum(radius[:-1], radius[1:])


def joined(profile: Profile, tolerance: float) -> Profile:
    """The profile with neighbours of nearly equal values (within a factor 1 + tolerance) joined at the smaller one."""
    times, values = profile
    kept, least = [times[0]], [values[0]]
    largest = values[0]
    for start, value in zip(times[1:-1], values[1:]):
        low, high = min(least[-1], value), max(largest, value)
        if high <= low * (1 + tolerance):
            least[-1], largest = low, high
        else:
            kept.append(start)
            least.append(value)
            largest = value
    return np.append(kept, times[-1]), np.array(least)


def log10_sum(levels: list[float]) -> float:
    """Upper bound of log10 of a sum of numbers given by their log10, at most 0."""
    with precision():
        ten = arb(10).log()
        total = sum(((arb(level) * ten).exp() for level in levels), arb(0))
        return min(0.0, upper(total.log() / ten))
