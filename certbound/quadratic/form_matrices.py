"""Quadratic forms over z = (xi, 1) as interval matrices."""

from __future__ import annotations

import itertools
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


def splitting(n: int, held: Sequence[int]) -> Array:
    """A basis of (D_a), symmetric, with sum_a s_a z' D_a z = 0 where s = z[held]: shape (b, len(held), n + 1, n + 1).

    Each member moves one monomial between two places, by halves and ones: exact in floating point.
    """
    places: dict[tuple[int, ...], list[tuple[int, int, int]]] = {}
    for a, axis in enumerate(held):
        for i, j in itertools.combinations_with_replacement(range(n + 1), 2):
            places.setdefault(tuple(sorted((axis, i, j))), []).append((a, i, j))
    basis = []
    for first, *others in places.values():
        for other in others:
            member = np.zeros((len(held), n + 1, n + 1))
            for (a, i, j), sign in ((other, 1.0), (first, -1.0)):
                member[a, i, j] += sign if i == j else sign / 2
                member[a, j, i] += 0.0 if i == j else sign / 2
            basis.append(member)
    return np.array(basis) if basis else np.zeros((0, len(held), n + 1, n + 1))


def symmetric_basis(size: int) -> Array:
    """A basis of the symmetric matrices, shape (size, size, size (size + 1) / 2)."""
    pairs = [(i, j) for i in range(size) for j in range(i, size)]
    basis = np.zeros((size, size, len(pairs)))
    for k, (i, j) in enumerate(pairs):
        basis[i, j, k] = basis[j, i, k] = 1.0
    return basis
