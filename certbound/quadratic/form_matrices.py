"""Quadratic forms over z = (xi, 1) as interval matrices."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from certbound.arrays import Array
from certbound.rigor.intervals import Interval, concatenate, sq, stack


def as_forms(forms: Sequence[Interval], size: int) -> Interval:
    """A batch of forms, shape (k, size, size), also of none."""
    return stack(list(forms)) if forms else Interval.point(np.zeros((0, size, size)))


def linear_form(row: Interval) -> Interval:
    """The form of z |-> row . z."""
    last = np.zeros(row.shape[0])
    last[-1] = 0.5
    half = row.reshape(-1, 1) * Interval.point(last).reshape(1, -1)
    return half + half.T


def scaled_row(normal: Array, bound: Interval, center: Array, width: Array) -> Interval:
    """The row over z of normal . x - bound."""
    entries = Interval.point(normal) * Interval.point(width)
    offset = (Interval.point(normal) * Interval.point(center)).sum() - bound
    return concatenate([entries, offset.reshape(1)])


def ball_form(middle: Array, radius: float, places: Sequence[int], center: Array, width: Array) -> Interval:
    """The form of radius^2 - |x - middle|^2 over the given states, divided by radius^2."""
    n = len(center)
    limit = sq(Interval.point(radius))
    low, high = np.zeros((n + 1, n + 1)), np.zeros((n + 1, n + 1))
    last = limit
    for place, about in zip(places, middle):
        side = Interval.point(width[place])
        shift = Interval.point(center[place]) - Interval.point(about)
        corner, cross = -sq(side) / limit, -(side * shift) / limit
        low[place, place], high[place, place] = corner.lo, corner.hi
        low[place, n] = low[n, place] = cross.lo
        high[place, n] = high[n, place] = cross.hi
        last = last - sq(shift)
    last = last / limit
    low[n, n], high[n, n] = last.lo, last.hi
    return Interval(low, high)


def side_forms(low: Array, high: Array) -> Array:
    """Forms (xi_i - low_i)(high_i - xi_i), shape (n, n + 1, n + 1), in floating point."""
    n = len(low)
    forms = np.zeros((n, n + 1, n + 1))
    for i in range(n):
        forms[i, i, i] = -1.0
        forms[i, i, n] = forms[i, n, i] = (low[i] + high[i]) / 2
        forms[i, n, n] = -low[i] * high[i]
    return forms


def enclosed_side_forms(low: Array, high: Array) -> Interval:
    """`side_forms` enclosed."""
    a, b = Interval.point(low), Interval.point(high)
    cross, last = (a + b) * Interval.point(0.5), -(a * b)
    forms = side_forms(low, high)
    ends = []
    for middle, end in ((cross.lo, last.lo), (cross.hi, last.hi)):
        side = forms.copy()
        for i in range(len(low)):
            side[i, i, -1] = side[i, -1, i] = middle[i]
            side[i, -1, -1] = end[i]
        ends.append(side)
    return Interval(*ends)
