"""Quintic splines on graded axes: linear maps along one axis, and how tensors of any dimension are mapped by them.

An axis has nodes z_0 < ... < z_N. Its splines are C^4, of degree 5, with a simple knot at every inner node and clamped
ends: N + 5 coefficients. The *lattice* of an axis is the points at which its cells are sampled, nodes among them.
Whatever proposes a spline, the spline is its coefficients: the proofs read these alone.

Proved of an axis, in exact arithmetic: on cell c the k-th derivative lies between the least and the largest of its
control values c, ..., c + 5 - k (the convex hull of B-splines); its first and last coefficient are its values at the
ends. Every entry of a matrix here is computed from sums of products of like sign, or differences of these, with an
error of at most `ROUNDOFF` of the sum of magnitudes in its row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import comb, factorial, prod
from typing import Any

import numpy as np

from certbound.arrays import Array, Index
from certbound.lazy import compiled
from certbound.values.polynomials import lebesgue, nodes_of, norm, to_bernstein

DEGREE = 5
_NEAREST = DEGREE + 1
ROUNDOFF = 200 * 2.0**-53
"""Relative error of a derivative at a lattice point against the sum of the magnitudes of its terms: fewer than 200
roundings lie on the way from a coefficient to a value (six of de Boor's recursion an axis, products and sums)."""


_MANY = 64 * 2.0**-53
"""Relative error of a control value against the sum of the magnitudes of its terms: three roundings a difference."""


_OFF = 10 * 21.1 * 2.0**-53
"""Error of a Bernstein coefficient against the largest control value, for each rounding of a point by a share of its
cell: the slope is at most 10, the norm of `to_bernstein(6)` is 21."""


@compiled
def _banded(out, values, start, weights):  # type: ignore[no-untyped-def]
    """out[p, j, q] = sum_k weights[j, k] values[p, start[j] + k, q]."""
    if values.shape[2] == 1:
        for p in range(values.shape[0]):
            for j in range(start.size):
                total = 0.0
                for k in range(weights.shape[1]):
                    total += weights[j, k] * values[p, start[j] + k, 0]
                out[p, j, 0] = total
        return
    for p in range(values.shape[0]):
        for j in range(start.size):
            row = out[p, j]
            first = values[p, start[j]]
            w = weights[j, 0]
            for q in range(row.size):
                row[q] = w * first[q]
            for k in range(1, weights.shape[1]):
                w = weights[j, k]
                if w != 0.0:
                    other = values[p, start[j] + k]
                    for q in range(row.size):
                        row[q] += w * other[q]


@compiled
def _largest(out, values, count, stride):  # type: ignore[no-untyped-def]
    """out[p, j, q] = max of values[p, stride j + k, q] over k < count."""
    if values.shape[2] == 1:
        for p in range(out.shape[0]):
            line, given = out[p, :, 0], values[p, :, 0]
            for j in range(line.size):
                line[j] = given[stride * j]
            for k in range(1, count):
                for j in range(line.size):
                    line[j] = max(line[j], given[stride * j + k])
        return
    for p in range(out.shape[0]):
        for j in range(out.shape[1]):
            row = out[p, j]
            first = values[p, stride * j]
            for q in range(row.size):
                row[q] = first[q]
            for k in range(1, count):
                other = values[p, stride * j + k]
                for q in range(row.size):
                    if other[q] > row[q]:
                        row[q] = other[q]


@compiled
def _sizes(  # type: ignore[no-untyped-def]
    out, coefficients, factors1, factors2, factors3, orders, degree, zero, off1, off2, off3
):
    """Of three axes: the largest magnitude of a derivative's control values on every cell, one spline at a time.

    To it is added what it may be off: three factors, times the magnitude ``zero`` of the spline itself where known.
    """
    held = np.empty(coefficients.shape[1:])
    n1, n2, n3 = held.shape
    for number in range(coefficients.shape[0]):
        held[:] = coefficients[number]
        for o in range(orders[0]):
            for i in range(n1 - 1 - o):
                f, row, other = factors1[o, i], held[i], held[i + 1]
                for j in range(n2):
                    for k in range(n3):
                        row[j, k] = f * (other[j, k] - row[j, k])
        for i in range(n1 - orders[0]):
            plane = held[i]
            for o in range(orders[1]):
                for j in range(n2 - 1 - o):
                    f, line, behind = factors2[o, j], plane[j], plane[j + 1]
                    for k in range(n3):
                        line[k] = f * (behind[k] - line[k])
            for j in range(n2 - orders[1]):
                line = plane[j]
                for o in range(orders[2]):
                    for k in range(n3 - 1 - o):
                        line[k] = factors3[o, k] * (line[k + 1] - line[k])
                for k in range(n3 - orders[2]):
                    line[k] = abs(line[k])
                width, count = 1, degree[2] + 1 - orders[2]
                while width < count:
                    shift = min(width, count - width)
                    for k in range(n3 - orders[2] - shift):
                        line[k] = max(line[k], line[k + shift])
                    width += shift
            width, count = 1, degree[1] + 1 - orders[1]
            while width < count:
                shift = min(width, count - width)
                for j in range(n2 - orders[1] - shift):
                    line, behind = plane[j], plane[j + shift]
                    for k in range(n3):
                        line[k] = max(line[k], behind[k])
                width += shift
        width, count = 1, degree[0] + 1 - orders[0]
        while width < count:
            shift = min(width, count - width)
            for i in range(n1 - orders[0] - shift):
                row, other = held[i], held[i + shift]
                for j in range(n2):
                    for k in range(n3):
                        row[j, k] = max(row[j, k], other[j, k])
            width += shift
        for i in range(out.shape[1]):
            for j in range(out.shape[2]):
                line, found = out[number, i, j], held[i, j]
                if zero.shape[0] == 0:
                    for k in range(line.size):
                        line[k] = found[k]
                else:
                    off, own = off1[i] * off2[j], zero[number, i, j]
                    for k in range(line.size):
                        line[k] = found[k] + off * off3[k] * own[k]


@compiled
def _combined(out, values, rows, stride):  # type: ignore[no-untyped-def]
    """out[p, c, q] = the largest of 0 and sum_k rows[r, k] values[p, stride c + k, q] over r."""
    if values.shape[2] == 1:
        for p in range(out.shape[0]):
            for c in range(out.shape[1]):
                best = 0.0
                for r in range(rows.shape[0]):
                    sum_ = 0.0
                    for k in range(rows.shape[1]):
                        sum_ += rows[r, k] * values[p, stride * c + k, 0]
                    best = max(best, sum_)
                out[p, c, 0] = best
        return
    total = np.empty(out.shape[2])
    for p in range(out.shape[0]):
        for c in range(out.shape[1]):
            row = out[p, c]
            for q in range(row.size):
                row[q] = 0.0
            for r in range(rows.shape[0]):
                w = rows[r, 0]
                first = values[p, stride * c]
                for q in range(row.size):
                    total[q] = w * first[q]
                for k in range(1, rows.shape[1]):
                    w = rows[r, k]
                    other = values[p, stride * c + k]
                    for q in range(row.size):
                        total[q] += w * other[q]
                for q in range(row.size):
                    if total[q] > row[q]:
                        row[q] = total[q]


def _split(shape: tuple[int, ...], axis: int) -> tuple[int, int, int]:
    return prod(shape[:axis]), shape[axis], prod(shape[axis + 1 :])


def thin(array: Array, axis: int) -> Array:
    """A tensor as (before, along, behind)."""
    before, along, behind = _split(array.shape, axis)
    return np.ascontiguousarray(array).reshape(before, along, behind)


def back(out: Array, shape: tuple[int, ...], axis: int) -> Array:
    """A result of that form as a tensor."""
    return out.reshape((*shape[:axis], out.shape[1], *shape[axis + 1 :]))


@dataclass(frozen=True, eq=False, slots=True)
class Banded:
    """A matrix whose row j has its entries from column ``start[j]`` on: shapes (rows,) and (rows, width)."""

    start: Index
    weights: Array

    def along(self, values: Array, axis: int) -> Array:
        """Map a tensor along one axis."""
        given = thin(values, axis)
        out = np.empty((given.shape[0], len(self.start), given.shape[2]))
        _banded(out, given, self.start, self.weights)
        return back(out, values.shape, axis)

    def absolute(self) -> Array:
        """Sum of the magnitudes of each row, shape (rows,)."""
        return np.asarray(np.abs(self.weights).sum(axis=1))


def sliding_max(values: Array, axis: int, count: int, stride: int = 1) -> Array:
    """The largest of ``count`` neighbours along an axis, every ``stride``-th."""
    given = thin(values, axis)
    out = np.empty((given.shape[0], (given.shape[1] - count) // stride + 1, given.shape[2]))
    _largest(out, given, count, stride)
    return back(out, values.shape, axis)


def cell_combinations(values: Array, axis: int, rows: Array) -> Array:
    """Of lattice values along an axis: on every cell the largest of 0 and of what each of the rows makes of them."""
    given = thin(values, axis)
    stride = rows.shape[1] - 1
    out = np.empty((given.shape[0], given.shape[1] // stride, given.shape[2]))
    _combined(out, given, np.ascontiguousarray(rows), stride)
    return back(out, values.shape, axis)


@dataclass(frozen=True, eq=False, slots=True)
class Sampling:
    """How a cell is sampled along an axis: ``parts`` + 1 points, and the polynomial of degree ``parts`` through them.

    The points are those of `nodes_of`, near Chebyshev's extremal ones. In units of the cell's width:

    Attributes
    ----------
    parts : int
        Degree of the interpolant, 2 to 5.
    """

    parts: int

    @property
    def nodes(self) -> Array:
        """Shares of the cell, 0 and 1 among them."""
        return np.array(nodes_of(self.parts + 1))

    @property
    def lebesgue(self) -> float:
        """Bound of the interpolant where the samples are at most 1 in size."""
        return lebesgue(self.parts + 1)

    @property
    def tail(self) -> float:
        """Error of the interpolant for a derivative of order ``parts + 1`` of size 1."""
        return _node_product(self.parts + 1) / factorial(self.parts + 1)

    @property
    def chord(self) -> float:
        """Distance of a function with second derivative -1 from its chords between the points: gap^2 / 8."""
        return float(np.diff(self.nodes).max()) ** 2 / 8

    def derivative(self, order: int) -> Array:
        """From samples to the Bernstein coefficients of the interpolant's derivative."""
        return _derivative(self.parts, order)


@lru_cache(maxsize=16)
def _node_product(count: int) -> float:
    """An upper bound of max |(s - s_1) ... (s - s_count)| over [0, 1]."""
    points = np.linspace(0, 1, 2**17 + 1)
    sizes = np.abs(points[:, None] - np.array(nodes_of(count))).prod(axis=1)
    return float(sizes.max()) + count / 2**18  # |derivative| <= count: half a spacing to the nearest point


@lru_cache(maxsize=32)
def _derivative(parts: int, order: int) -> Array:
    rows = to_bernstein(parts + 1)
    for k in range(order):
        rows = (parts - k) * np.diff(rows, axis=0)
    return np.ascontiguousarray(rows)


@dataclass(frozen=True, eq=False)
class Axis:
    """Splines over the nodes of one axis.

    Parameters
    ----------
    nodes : ndarray, shape (N + 1,)
        Rising; at least 7.
    sampling : Sampling
        How its cells are sampled.
    """

    nodes: Array
    sampling: Sampling

    @property
    def cells(self) -> int:
        """N."""
        return len(self.nodes) - 1

    @cached_property
    def knots(self) -> Array:
        """The clamped knots, shape (N + 11,)."""
        return np.concatenate([[self.nodes[0]] * DEGREE, self.nodes, [self.nodes[-1]] * DEGREE])

    @cached_property
    def lattice(self) -> Array:
        """The points at which cells are sampled, shape (parts N + 1,)."""
        inner = self.nodes[:-1, None] + np.diff(self.nodes)[:, None] * self.sampling.nodes[:-1]
        return np.append(inner.ravel(), self.nodes[-1])

    @cached_property
    def bends(self) -> Banded:
        """From lattice values to the Bernstein coefficients of minus each interpolant's second derivative by shares."""
        rows = -self.sampling.derivative(2)
        start = np.repeat(np.arange(self.cells) * self.sampling.parts, len(rows))
        return Banded(start.astype(np.intp), np.tile(rows, (self.cells, 1)))

    @cached_property
    def moved(self) -> Array:
        """Per cell, its distance from 0 in cells: by so many roundings, as shares of the cell, its points are off."""
        return np.maximum(np.abs(self.nodes[1:]), np.abs(self.nodes[:-1])) / self.widths

    @cached_property
    def widths(self) -> Array:
        """Widths of the cells, rounded up, shape (N,)."""
        return np.diff(self.nodes) * (1 + 1e-15)

    def at_points(self, points: Array, order: int) -> Banded:
        """The ``order``-th derivative at points, from the coefficients."""
        from scipy.interpolate import BSpline

        count = self.cells + DEGREE
        place = np.clip(np.searchsorted(self.nodes, points, side="right") - 1, 0, self.cells - 1)
        values = BSpline(self.knots, np.eye(count), DEGREE)
        full = (values.derivative(order) if order else values)(points)
        columns = place[:, None] + np.arange(DEGREE + 1)
        return Banded(place.astype(np.intp), np.ascontiguousarray(np.take_along_axis(full, columns, axis=1)))

    @cached_property
    def on_lattice(self) -> tuple[Banded, Banded, Banded]:
        """Values, first and second derivatives on the lattice."""
        first, second, third = (self.at_points(self.lattice, order) for order in range(3))
        return first, second, third

    @cached_property
    def bernstein(self) -> Banded:
        """The Bernstein coefficients of degree 5 on each cell, six rows a cell."""
        from scipy.interpolate import BSpline

        count = DEGREE + 1
        inner = np.array(nodes_of(count))
        points = self.nodes[:-1, None] + np.diff(self.nodes)[:, None] * inner
        values = BSpline(self.knots, np.eye(self.cells + DEGREE), DEGREE)
        place = np.repeat(np.arange(self.cells), count)
        full = np.take_along_axis(values(points.ravel()), place[:, None] + np.arange(count), axis=1)
        weights = np.einsum("jk,ckm->cjm", to_bernstein(count), full.reshape(self.cells, count, count))
        return Banded(place.astype(np.intp), np.ascontiguousarray(weights.reshape(-1, count)))

    @cached_property
    def differentiate(self) -> Array:
        """For orders 1 to 5: from differences of the derivative before to control values of this one, by factors.

        Shape (5, N + 4); the later rows are shorter, and filled with zeros.
        """
        result = np.zeros((DEGREE, self.cells + DEGREE - 1))
        for order in range(1, DEGREE + 1):
            knots, degree = self.knots[order : len(self.knots) - order], DEGREE - order
            gaps = knots[degree + 1 :] - knots[: -degree - 1]
            result[order - 1, : self.cells + degree] = (degree + 1) / gaps[: self.cells + degree]
        return result

    @cached_property
    def condition(self) -> tuple[Array, Array, Array]:
        """Per cell, the largest row sum of magnitudes on its lattice points, of each of `on_lattice`; shapes (N,).

        Where a lattice point is rounded, the sum grows by the share of a cell that this moves it.
        """
        sums = [one.absolute() for one in self.on_lattice]
        parts = self.sampling.parts
        first, second, third = ((1 + self.moved) * sliding_max(row, 0, parts + 1, parts) for row in sums)
        return first, second, third

    @cached_property
    def rounding(self) -> tuple[Array, ...]:
        """Per cell and order, how much larger than the coefficients the terms of a derivative's control values are."""
        result = [np.ones(self.cells)]
        for order, step in enumerate(self.differentiate, start=1):
            largest = sliding_max(2.0 * step[: self.cells + DEGREE - order], 0, DEGREE + 1 - order)
            result.append(result[-1] * largest)
        return tuple(result)

    def from_nodes(self, nodes: Array | None = None) -> Array:
        """The matrix from values at ``nodes`` (default: its own) to coefficients, each from `_NEAREST` nodes about it.

        A coefficient is that of the polynomial through these, by its blossom at the inner knots of the B-spline. What
        one node holds reaches no further: an interpolating spline rings, by .43 a node, from wherever it is not smooth.
        ``nodes`` may reach beyond the axis; its part within must be the axis' own. Shape (N + 5, len(nodes)).
        """
        nodes = self.nodes if nodes is None else nodes
        result = np.zeros((self.cells + DEGREE, len(nodes)))
        for i, row in enumerate(result):
            inner = self.knots[i + 1 : i + DEGREE + 1]
            middle = float(np.mean(inner))
            begin = int(np.clip(np.searchsorted(nodes, middle) - _NEAREST // 2, 0, len(nodes) - _NEAREST))
            near = nodes[begin : begin + _NEAREST]
            unit = float(near[-1] - near[0])
            powers = np.vander((near - middle) / unit, _NEAREST, increasing=True)
            symmetric = np.poly(-(inner - middle) / unit)  # of x^5 + e_1 x^4 + ...
            blossoms = np.array([symmetric[m] / comb(DEGREE, m) for m in range(DEGREE + 1)])
            row[begin : begin + _NEAREST] = np.linalg.solve(powers.T, blossoms)
        return result


def apply_dense(matrices: list[Array], values: Array) -> Array:
    """Map a tensor by one dense matrix an axis."""
    for axis, matrix in enumerate(matrices):
        values = np.moveaxis(np.tensordot(matrix, values, axes=(1, axis)), 0, axis)
    return np.ascontiguousarray(values)


class Derivatives:
    """Bounds of the partial derivatives of tensor splines in up to three variables, each computed once.

    Parameters
    ----------
    axes : sequence of Axis
    coefficients : ndarray, shape (B, N_1 + 5, ..., N_n + 5)
        Of B splines.
    """

    def __init__(self, axes: tuple[Axis, ...], coefficients: Array) -> None:
        self.axes, self.coefficients = axes, coefficients
        self.sizes: dict[tuple[int, ...], Array] = {}

    def size(self, orders: tuple[int, ...]) -> Array:
        """A bound of the magnitude of the derivative of these orders on every cell, shape (B, N_1, ..., N_n)."""
        if orders not in self.sizes:
            shape, ahead = self.coefficients.shape, 3 - len(self.axes)
            given = np.ascontiguousarray(self.coefficients).reshape(shape[0], *[1] * ahead, *shape[1:])
            out = np.empty((shape[0], *[1] * ahead, *cells_of(self.axes)))
            first, second, third = [_NONE] * ahead + [axis.differentiate for axis in self.axes]
            degrees = np.array([0] * ahead + [DEGREE] * len(self.axes))
            p, q, r = [np.ones(1)] * ahead + [axis.rounding[order] for axis, order in zip(self.axes, orders)]
            zero = self.size((0,) * len(orders)).reshape(out.shape) if any(orders) else out[:0]
            times = np.array([0] * ahead + list(orders))
            _sizes(out, given, first, second, third, times, degrees, zero, _MANY * p, q, r)
            self.sizes[orders] = out.reshape(shape[0], *out.shape[ahead + 1 :])
        return self.sizes[orders]

    def along(self, axis: int, order: int) -> Array:
        """Control values of a derivative along one axis."""
        value = self.coefficients
        for row in self.axes[axis].differentiate[:order]:
            value = np.diff(value, axis=axis + 1)
            value *= row[: value.shape[axis + 1]].reshape([-1 if k == axis else 1 for k in range(len(self.axes))])
        return value


_NONE = np.zeros((0, 0))


def most_on_cells(axes: tuple[Axis, ...], coefficients: Array) -> Array:
    """An upper bound of tensor splines on every cell by Bernstein coefficients; shape (B, N_1, ..., N_n)."""
    value = coefficients
    for k, axis in enumerate(axes):
        value = axis.bernstein.along(value, k + 1)
    for k in range(len(axes)):
        value = sliding_max(value, k + 1, DEGREE + 1, DEGREE + 1)
    size = np.abs(coefficients)
    for k in range(len(axes)):
        size = sliding_max(size, k + 1, DEGREE + 1)
    share = np.full(cells_of(axes), 1e-11)
    for k, axis in enumerate(axes):
        share += _OFF * axis.moved.reshape([-1 if j == k else 1 for j in range(len(axes))])
    return np.asarray(value + share * size)


@lru_cache(maxsize=64)
def subdivided(first: float, last: float) -> Array:
    """From Bernstein coefficients of degree 5 on a cell to those between two shares of it."""
    rows = np.eye(DEGREE + 1)
    for split, keep_first in ((last, True), (first / last, False)):  # de Casteljau's algorithm
        line, front, rear = rows, [rows[0]], [rows[-1]]
        for _ in range(DEGREE):
            line = (1 - split) * line[:-1] + split * line[1:]
            front.append(line[0])
            rear.append(line[-1])
        rows = np.array(front if keep_first else rear[::-1])
    return rows


def controls_on_some(
    axes: tuple[Axis, ...], coefficients: Array, cells: Sequence[Index], part: Sequence[tuple[float, float]]
) -> tuple[Array, Array]:
    """Bernstein coefficients of tensor splines on a part of some cells, and by how much they are off.

    Parameters
    ----------
    axes : tuple of Axis
    coefficients : ndarray, shape (B, N_1 + 5, ...)
    cells : sequence of ndarray, shape (R,)
        Their places along every axis.
    part : sequence of (float, float)
        Where it begins and ends along every axis, as shares of the cell.

    Returns
    -------
    controls : ndarray, shape (B, R, 6^n)
    off : ndarray, shape (B, R)
    """
    n, count = len(axes), DEGREE + 1
    places: list[Any] = [slice(None)]
    for k, place in enumerate(cells):
        window = place[:, None] + np.arange(count)
        places.append(window.reshape(-1, *[count if j == k else 1 for j in range(n)]))
    patches = coefficients[tuple(places)]
    share = np.full(len(cells[0]), 1e-11)
    for axis, place in zip(axes, cells):
        share += _OFF * axis.moved[place]
    off = share * np.abs(patches).max(axis=tuple(range(2, n + 2)))
    for k, (axis, place, one) in enumerate(zip(axes, cells, part)):
        rows = subdivided(*one) @ axis.bernstein.weights.reshape(-1, count, count)[place]
        line = np.moveaxis(patches, k + 2, -1)
        patches = np.moveaxis(np.einsum("rij,br...j->br...i", rows, line), -1, k + 2)
    return patches.reshape(*patches.shape[:2], -1), off


def most_of_difference(
    axes: tuple[Axis, ...], others: tuple[Axis, ...], first: Array, second: Array, own: tuple[slice, ...],
    places: tuple[slice, ...],
) -> Array:  # fmt: skip
    """An upper bound of the second spline less the first on cells that both have, ``own`` cells of the first's axes."""
    parts, sizes = [], []
    for grid, coefficients, cells in ((axes, first, own), (others, second, places)):
        value, size = coefficients, np.abs(coefficients)
        for k, axis in enumerate(grid):
            value = axis.bernstein.along(value, k)
            size = sliding_max(size, k, DEGREE + 1)
        rows = tuple(slice((DEGREE + 1) * cell.start, (DEGREE + 1) * cell.stop) for cell in cells)
        parts.append(value[rows])
        share = np.full(cells_of(grid), 1e-11)
        for k, axis in enumerate(grid):
            share += _OFF * axis.moved.reshape([-1 if j == k else 1 for j in range(len(grid))])
        sizes.append((share * size)[cells])
    difference = np.ascontiguousarray(parts[1] - parts[0])
    for k in range(len(axes)):
        difference = sliding_max(difference, k, DEGREE + 1, DEGREE + 1)
    return np.asarray(difference + sizes[0] + sizes[1])


def over_cells(axes: tuple[Axis, ...], lattice: Array, skip: int | None = None) -> Array:
    """The largest of the lattice values on every cell; the tensor's last axes are those of the grid.

    Along the axis ``skip`` there is one value a cell already.
    """
    ahead = lattice.ndim - len(axes)
    for k, axis in enumerate(axes):
        if k != skip:
            lattice = sliding_max(lattice, ahead + k, axis.sampling.parts + 1, axis.sampling.parts)
    return lattice


def most_of_interpolants(axes: tuple[Axis, ...], lattice: Array, windows: tuple[tuple[int, int], ...] = ()) -> Array:
    """A bound of the polynomials through the lattice values on every cell, from above, by chords, axis by axis.

    With J the piecewise linear interpolation along an axis, p <= J p + gap^2 / 8 sup (-d^2 p)^+ along it: J p and the
    coefficients of -d^2 p are bounded over the axes behind it in the same way. That -d^2 p be negative on the lines of
    the lattice would not do, even times a Lebesgue constant: between them its positive part may be anything. The
    tensor's last axes are those of the grid; ``windows`` says how many values a cell has along the first of them, and
    how far apart cells begin.
    """
    k, ahead = len(windows), lattice.ndim - len(axes)
    if k == len(axes):
        for place, (count, stride) in enumerate(windows):
            lattice = sliding_max(lattice, ahead + place, count, stride)
        return lattice
    sampling = axes[k].sampling
    high = most_of_interpolants(axes, lattice, (*windows, (sampling.parts + 1, sampling.parts)))
    if k == len(axes) - 1:
        bends, window = cell_combinations(lattice, ahead + k, -sampling.derivative(2)), (1, 1)
    else:
        bends, window = axes[k].bends.along(lattice, ahead + k), (sampling.parts - 1, sampling.parts - 1)
    extra = most_of_interpolants(axes, bends, (*windows, window))
    return np.asarray(high + sampling.chord * np.maximum(extra, 0.0))


def amplified(axes: tuple[Axis, ...]) -> float:
    """By how much more than the lattice values, all off by 1, `most_of_interpolants` may be off."""
    return float(np.prod([1 + axis.sampling.chord * norm(axis.sampling.derivative(2)) for axis in axes]))


def cells_of(axes: tuple[Axis, ...]) -> tuple[int, ...]:
    """Cells along each axis."""
    return tuple(axis.cells for axis in axes)


def outer(factors: list[Array]) -> Array:
    """Tensor product of vectors."""
    result = factors[0]
    for factor in factors[1:]:
        result = result[..., None] * factor
    return result


def unit(axis: int, dimension: int, times: int = 1) -> tuple[int, ...]:
    """``times`` in one place."""
    return tuple(times if k == axis else 0 for k in range(dimension))


def plus(*orders: tuple[int, ...]) -> tuple[int, ...]:
    """Entrywise sum."""
    return tuple(map(sum, zip(*orders)))
