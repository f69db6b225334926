"""What a certificate states in continuous time: V, patch by patch, as Taylor models of it and its slopes; and levels.

V takes stated values and derivatives (up to the second in every state) at the nodes of a grid, and stated rates, at the
ends of slabs of time: degree 5 in every state and 3 in time on every patch. The data are shared by neighbours, so that
V is twice continuously differentiable in the states and once in time, whatever they are.

On a patch, tau and xi in [-1, 1], V is the sum of data times the products of the basis polynomials below, whose
coefficients are exact. A derivative of V has the basis' derivatives instead, and powers of the half-sides: it is made
from the data, not from V's rounded coefficients. All roundings together are below ``_ROUNDING`` times the sum of the
absolute terms (a patch has at most 144 data, and each a dozen operations).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from flint import arb

from certbound.checker.report import Budget, Unproved, unlimited
from certbound.checker.values.batches import Array, Batch, Index, Terms, variable
from certbound.errors import CertificateError

_ROUNDING = 400 * 2.0**-53
_UP = 1 + 2.0**-40
_CHUNK = 4096
"""Patches that are looked at together."""

Block = tuple[int, int, tuple[slice, ...]]
"""First slab, the slab behind the last one, and cells along the states."""

# Columns: v, r v', r^2 v'' at -1, then at 1; rows: powers of xi. In time v and r v' at both ends.
IN_SPACE = np.array([
    [8, 5, 1, 8, -5, 1],
    [-15, -7, -1, 15, -7, 1],
    [0, -6, -2, 0, 6, -2],
    [10, 10, 2, -10, 10, -2],
    [0, 1, 1, 0, -1, 1],
    [-3, -3, -1, 3, -3, 1],
]) / 16.0  # fmt: skip
IN_TIME = np.array([[2, 1, 2, -1], [-3, -1, 3, -1], [0, -1, 0, 1], [1, 1, -1, 1]]) / 4.0


@dataclass(frozen=True, eq=False)
class Surface:
    """The data of V.

    Attributes
    ----------
    times : ndarray, shape (K + 1,)
    axes : tuple of ndarray, shapes (N_i + 1,)
    values : ndarray, shape (K + 1, N_1 + 1, 3[, N_2 + 1, 3])
        V and its derivatives by order in every state, at the ends of the slabs.
    rates : ndarray, of the same shape
        Their derivatives by time.
    """

    times: Array
    axes: tuple[Array, ...]
    values: Array
    rates: Array
    budget: Budget = field(default_factory=unlimited)

    @property
    def cells(self) -> tuple[int, ...]:
        """Cells along the states."""
        return tuple(len(axis) - 1 for axis in self.axes)

    def blocks(self) -> Iterator[Block]:
        """Parts of all patches, none of which has many of them; as long as the last state has few cells, in order."""
        slabs, per, n = len(self.times) - 1, math.prod(self.cells), len(self.cells)
        if per <= _CHUNK:
            stride, whole = max(1, _CHUNK // per), tuple(slice(0, count) for count in self.cells)
            for first in range(0, slabs, stride):
                yield first, min(first + stride, slabs), whole
            return
        widths, left = [1] * n, _CHUNK
        for axis in reversed(range(n)):
            widths[axis] = min(left, self.cells[axis])
            left = max(1, left // widths[axis])
        rows = [[slice(k, min(k + width, count)) for k in range(0, count, width)]
                for width, count in zip(widths, self.cells)]  # fmt: skip
        for first in range(slabs):
            for cells in itertools.product(*rows):
                yield first, first + 1, cells

    def patches(self, first: int, last: int, cells: Sequence[slice]) -> Patches:
        """All patches of some slabs and cells, time slowest."""
        count = (last - first) * math.prod(part.stop - part.start for part in cells)
        self.budget.fits(8 * 3 * 4 * 6 ** len(cells) * count)
        self.budget.floats(3 * 4 * 6 ** len(cells) * count, 20)
        inner = tuple(part for own in cells for part in (slice(own.start, own.stop + 1), slice(None)))
        early, late = (slice(first, last), *inner), (slice(first + 1, last + 1), *inner)
        data = np.stack([self.values[early], self.rates[early], self.values[late], self.rates[late]], axis=1)
        for axis in range(len(self.axes)):
            place = 2 + 2 * axis
            cut = [np.take(data, range(k, data.shape[place] - 1 + k), axis=place) for k in (0, 1)]
            data = np.concatenate(cut, axis=place + 1)
        n = len(self.axes)
        order = [1, *(3 + 2 * i for i in range(n)), 0, *(2 + 2 * i for i in range(n))]
        flat = data.transpose(order).reshape(4, *([6] * n), -1)
        sides = [(self.times[first:last], self.times[first + 1 : last + 1])]
        sides += [(axis[part], axis[part.start + 1 : part.stop + 1]) for axis, part in zip(self.axes, cells)]
        low = np.meshgrid(*(side[0] for side in sides), indexing="ij")
        high = np.meshgrid(*(side[1] for side in sides), indexing="ij")
        return Patches(np.stack([a.ravel() for a in low]), np.stack([a.ravel() for a in high]), flat)

    def chosen(self, index: int, places: Sequence[Index]) -> Patches:
        """Some cells at the end of a slab, by their numbers along every state, as if V stayed the same in time."""
        n, count, values = len(places), len(places[0]), self.values[index]
        self.budget.fits(8 * 3 * 4 * 6**n * count)
        self.budget.floats(2 * 4 * 6**n * count, 20)
        data = np.zeros((4, *([6] * n), count))
        for corner in itertools.product((0, 1), repeat=n):
            nodes = tuple(part for place, k in zip(places, corner) for part in (place + k, slice(None)))
            data[(slice(0, 4, 2), *(slice(3 * k, 3 * k + 3) for k in corner))] = np.moveaxis(values[nodes], 0, -1)
        low = [np.zeros(count), *(axis[place] for axis, place in zip(self.axes, places))]
        high = [np.ones(count), *(axis[place + 1] for axis, place in zip(self.axes, places))]
        return Patches(np.stack(low), np.stack(high), data)

    def across(self, axis: int, node: int) -> Surface:
        """V where a state is at one of its nodes, as a function of time and of the other states."""
        cut = (slice(None),) * (1 + 2 * axis) + (node, 0)
        values, rates = self.values[cut], self.rates[cut]
        others = tuple(row for k, row in enumerate(self.axes) if k != axis)
        return Surface(self.times, others, values, rates, self.budget)

    def frozen(self, index: int) -> Surface:
        """V at the end of a slab as a function that stays the same in time."""
        same = self.values[[index, index]]
        self.budget.fits(8 * 2 * same.size)
        return Surface(np.array([0.0, 1.0]), self.axes, same, np.zeros_like(same), self.budget)


@dataclass(frozen=True, eq=False)
class Patches:
    """P patches: ``low`` and ``high`` of shape (1 + n, P), time first, and the data, shape (4, 6[, 6], P).

    Models of V are of one of ``parts`` equal parts of every patch along every axis, by its numbers.
    """

    low: Array
    high: Array
    data: Array
    parts: int = 1
    numbers: tuple[int, ...] = ()

    def take(self, places: Index | slice) -> Patches:
        """Some of the patches."""
        return Patches(self.low[:, places], self.high[:, places], self.data[..., places], self.parts, self.numbers)

    def cut(self, parts: int) -> Iterator[Patches]:
        """All equal parts, ``parts`` (a power of 2) along every axis."""
        for numbers in itertools.product(range(parts), repeat=len(self.low)):
            yield replace(self, parts=parts, numbers=numbers)

    def variable(self, which: Terms, axis: int) -> Batch:
        """Time or a state."""
        found = variable(which, axis, self.low[axis], self.high[axis])
        if self.parts == 1:
            return found
        middle, half = found.value, found.coefficients[1 + axis]
        offset = half * ((2 * self.numbers[axis] + 1) / self.parts - 1)
        found.coefficients[0] = middle + offset
        found.coefficients[1 + axis] = half / self.parts
        return Batch(which, found.coefficients, found.error + (np.abs(middle) + np.abs(half)) * 2.0**-51)

    def derivative(self, which: Terms, orders: tuple[int, ...]) -> Batch:
        """d^orders V, time first, as Taylor models; terms beyond the degree lie in the error."""
        boxes = self.low.shape[1]
        which.budget.fits(8 * (3 * self.data.size + 2 * which.numbers(boxes)))
        which.budget.floats(16 * self.data.size + 2 * which.numbers(boxes), 60 + self.data.size // max(1, boxes))
        half = (self.high - self.low) / 2
        total, size = self._scaled(half)
        for axis, order in enumerate(orders):
            basis = _derived(IN_TIME if axis == 0 else IN_SPACE, order)
            if self.parts > 1:
                basis = _restricted(basis, self.parts, self.numbers[axis])
            total, size = _along(basis, total, axis), _along(np.abs(basis), size, axis)
        factor = np.ones(half.shape[1])
        for axis, order in enumerate(orders):
            for _ in range(order):
                factor = factor / half[axis]
        total, error = total * factor, size.reshape(-1, size.shape[-1]).sum(axis=0) * np.abs(factor) * _ROUNDING
        coefficients = np.zeros((len(which.exponents), total.shape[-1]))
        place = {a: k for k, a in enumerate(which.exponents)}
        rest = which.variables - len(orders)
        for powers in itertools.product(*(range(count) for count in total.shape[:-1])):
            row, k = total[powers], place.get(powers + (0,) * rest)
            if k is None:
                error = error + np.abs(row)
            else:
                coefficients[k] = row
        if not any(orders):
            coefficients[0] += self._reference()
            error = error + np.abs(coefficients[0]) * 2.0**-52
        return Batch(which, coefficients, error * _UP + 1e-300)

    def _reference(self) -> Array:
        """V at one corner: the basis of the values sums to 1, so that derivatives do not need it."""
        return np.asarray(self.data[(0,) * (self.data.ndim - 1)])

    def _scaled(self, half: Array) -> tuple[Array, Array]:
        """Data in units of the patch, less the reference, and their absolute values."""
        data = self.data.copy()
        corner = (slice(0, 4, 2), *([slice(0, 6, 3)] * (data.ndim - 2)))
        data[corner] -= self._reference()
        data[1::2] *= half[0]
        for axis in range(1, data.ndim - 1):
            for k in (1, 2, 4, 5):
                data[(slice(None),) * axis + (k,)] *= half[axis] if k % 3 == 1 else half[axis] * half[axis]
        return data, np.abs(data)


@dataclass(frozen=True, eq=False)
class Levels:
    """m between ``edges`` (rising, the last one 0) and q at them, for a bound from above or from below."""

    edges: list[float]
    m: list[float]
    q: list[float]
    upper: bool = True

    def __post_init__(self) -> None:
        edges, m, q, sign = self.edges, self.m, self.q, -1 if self.upper else 1
        if not (len(edges) == len(q) == len(m) + 1 and edges[-1] == 0 and all(a < b for a, b in pairwise(edges))):
            raise CertificateError("`proof.edges` must rise to 0, with one m less and as many q.")
        if not all(rate >= 0 for rate in m) or q[0] != 0 or not all(value >= 0 for value in q):
            raise CertificateError("`proof.m` must not be negative, and `proof.q` must rise from 0.")
        if self.upper and not all(value < 1 for value in q):
            raise CertificateError("`proof.q` must stay below 1.")
        for (a, b), (left, right), rate in zip(pairwise(edges), pairwise(q), m):
            slope = (arb(right) - left) / (arb(b) - a)
            # convex in q, or (from below) concave
            due = [(1 + sign * arb(end)) * (rate - arb(end)) for end in (left, right)]
            top = (arb(rate) - 1) / 2
            if not self.upper and not (top <= min(left, right) or top >= max(left, right)):
                due.append((1 + arb(rate)) ** 2 / 4)
            if not all(slope >= least for least in due):
                raise Unproved("q was not shown to grow as fast as its inequality asks")

    def least(self, low: Array, high: Array) -> Array:
        """The least m of the levels in [low, min(high, 0)]."""
        found = np.full(low.shape, np.inf)
        for (a, b), rate in zip(pairwise(self.edges), self.m):
            found = np.where((low <= b) & (high >= a), np.minimum(found, rate), found)
        return np.where((low > self.edges[0]) & np.isfinite(found), found, 0.0)

    def above(self, level: arb) -> arb:
        """At least the integral of q from a level to 0."""
        total = arb(0)
        for (a, b), (left, right) in zip(pairwise(self.edges), pairwise(self.q)):
            start = arb.max(arb.min(level, arb(b)), arb(a))
            share = (arb(b) - start) / (arb(b) - a)
            total += (arb(right) - (arb(right) - left) * share / 2) * (arb(b) - start)
        return total


def _derived(basis: Array, order: int) -> Array:
    """Coefficients of the basis' derivative."""
    for _ in range(order):
        basis = np.arange(1, len(basis))[:, None] * basis[1:]
    return basis


def _restricted(basis: Array, parts: int, number: int) -> Array:
    """The same by powers of xi' in [-1, 1], xi = c + xi' / parts: exact, as all of it are multiples of a power of 2."""
    middle, count = (2 * number + 1) / parts - 1, len(basis)
    rows = [[math.comb(r, s) * middle ** (r - s) / parts**s if s <= r else 0.0 for r in range(count)]
            for s in range(count)]  # fmt: skip
    return np.array(rows) @ basis


def _along(matrix: Array, array: Array, axis: int) -> Array:
    return np.moveaxis(np.tensordot(matrix, array, axes=([1], [axis])), 0, axis)
