"""Drift and squared diffusion on the cells of a grid: interpolants with a proved remainder.

On every cell F = p + E, p the tensor interpolant of F through the cell's lattice points, of degree m along each axis
(`splines.Sampling`). With a cell's widths h_i, the Lebesgue constant C of the points and the constant c of their tail,

    |E| <= sum_i C^i c h_i^(m+1) sup |d_i^(m+1) F|.

Where F has a kink or a jump on the cell, that is cut into boxes B, on each of which

    |E| <= max(sup F(B) - inf p(B), sup p(B) - inf F(B)):

p follows a kink to a few hundredths of what its slopes differ by over the cell, and the range of F on all of the cell
is ten times that.

Where d_i^k F vanishes identically, so does d_i^k p: the interpolants of the other axes are taken of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import comb

import numpy as np

from certbound.arrays import Array, Index, Mask
from certbound.errors import EnclosureError
from certbound.problem.model import Node, Tape, jacobian
from certbound.rigor.intervals import Interval
from certbound.values.enclosing import enclose
from certbound.values.kolmogorov.splines import Axis, Sampling, cell_combinations, cells_of, over_cells

_UP = 1 + 1e-12
_FINEST = 32
"""Parts along each axis into which a cell with a kink is cut, at most: their width is what is added to its error."""

_MANY, _TOGETHER = 2**24, 2**21
"""Bernstein coefficients of all of them at most, two seconds' work, and of those that are looked at together, 16 MB."""

_ROUNDED = 1e-13  # of sums of up to 6 products, three in a row for each axis, and of powers of shares and of their rest


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Field:
    """One function F(x) on a grid.

    Attributes
    ----------
    lattice : ndarray, shape (2 N_1 + 1, ...)
        p at the lattice points.
    error : ndarray, shape (N_1, ...)
        Bound of |E| on every cell.
    slopes : tuple of tuple of ndarray
        ``slopes[i][k]`` bounds |d_i^k p|, k = 0, ..., m, as long as it is not 0 everywhere.
    """

    lattice: Array
    error: Array
    slopes: tuple[tuple[Array, ...], ...]

    @property
    def magnitude(self) -> Array:
        """Bound of |F| on every cell."""
        return self.slopes[0][0] + self.error


@lru_cache(maxsize=64)
def derivative_of(tape: Tape, axis: int, order: int) -> Tape:
    """The tape of d_i^order F over ``("t", *states, ...)``, ``axis`` counted among the states."""
    for _ in range(order):
        flat = jacobian(tape, [axis + 1])
        tape = Tape(inputs=flat.inputs, nodes=flat.nodes, outputs=flat.outputs, shape=(len(flat.outputs),))
    return tape


def _present(tape: Tape) -> tuple[bool, ...]:
    """Which outputs of a tape do not vanish identically."""
    return tuple(tape.nodes[output] != Node("const", (), 0.0) for output in tape.outputs)


class Fields:
    """The outputs of a tape on grids; functions that vanish identically are left out.

    Parameters
    ----------
    tape : Tape
        Over ``("t", *states, *disturbances)``, flat outputs.
    dimension : int
        Number of states n.
    """

    def __init__(self, tape: Tape, dimension: int) -> None:
        self.tape, self.dimension = tape, dimension
        self.present = _present(tape)
        self.autonomous = all(node.op != "input" or node.args[0] != 0 for node in tape.nodes)

    def on(self, axes: tuple[Axis, ...], time: Interval, branch: Sequence[Interval] = ()) -> list[Field | None]:
        """Each output on the cells of a grid, for all times of an interval and all disturbances of a branch.

        Raises
        ------
        EnclosureError
            The function is undefined or unbounded somewhere on the grid.
        """
        rims = [_about(axis) for axis in axes]
        points, _ = self._enclosed(self.tape, [low for low, _ in rims], [high for _, high in rims], time, branch)
        ends = [axis.nodes for axis in axes]
        ranges, edge = self._enclosed(self.tape, [e[:-1] for e in ends], [e[1:] for e in ends], time, branch)
        tails = [
            self._magnitudes(derivative_of(self.tape, k, axis.sampling.parts + 1), ends, time, branch)
            for k, axis in enumerate(axes)
        ]
        most = [axis.sampling.parts for axis in axes]
        degrees = [most if edge.any() else self._degrees(axes, k) for k in range(len(ranges))]
        fields = [
            self._field(axes, points[k], ranges[k], edge, [t[k] for t in tails], degrees[k]) if present else None
            for k, present in enumerate(self.present)
        ]
        if edge.any() and not (time.shape or any(one.shape for one in branch)):
            self._follow_kinks(axes, fields, np.nonzero(edge), time, branch)
        return fields

    def _follow_kinks(
        self, axes: tuple[Axis, ...], fields: Sequence[Field | None], cells: tuple[Index, ...], time: Interval,
        branch: Sequence[Interval],
    ) -> None:  # fmt: skip
        """Lower the errors on cells with kinks, as far as those of their boxes allow."""
        count, each = len(cells[0]), int(np.prod([axis.sampling.parts + 1 for axis in axes]))
        parts = min(int((_MANY / (count * each)) ** (1 / len(axes))), _FINEST)
        together = max(1, _TOGETHER // (each * max(parts, 1) ** len(axes)))
        rows = [_on_parts(axis.sampling, max(parts, 1)) for axis in axes]
        for begin in range(0, count if parts > 1 else 0, together):
            own = tuple(place[begin : begin + together] for place in cells)
            values, _ = enclose(self.tape, [time, *_cut(axes, own, parts), *branch])
            for field, value in zip(fields, values):
                if field is not None:
                    low, high = _ranges(_samples(axes, field.lattice, own), rows)
                    off = np.maximum(value.hi - low, high - value.lo)
                    most = off.reshape(len(own[0]), -1).max(axis=1) * _UP
                    field.error[own] = np.minimum(field.error[own], most)

    def _degrees(self, axes: tuple[Axis, ...], output: int) -> list[int]:
        """The highest order along each axis, up to that of its interpolants, whose derivative does not vanish."""
        return [
            max(k for k in range(axis.sampling.parts + 1) if k == 0 or _present(derivative_of(self.tape, i, k))[output])
            for i, axis in enumerate(axes)
        ]

    def _enclosed(
        self, tape: Tape, low: list[Array], high: list[Array], time: Interval, branch: Sequence[Interval]
    ) -> tuple[list[Interval], Mask]:
        lows, highs = (np.meshgrid(*ends, indexing="ij", sparse=True) for ends in (low, high))
        values, edge = enclose(tape, [time, *(Interval(a, b) for a, b in zip(lows, highs)), *branch])
        shape = tuple(map(len, low))
        return [value.broadcast_to(shape) for value in values], np.broadcast_to(edge, shape)

    def _magnitudes(self, tape: Tape, ends: list[Array], time: Interval, branch: Sequence[Interval]) -> list[Array]:
        try:
            values, _ = self._enclosed(tape, [e[:-1] for e in ends], [e[1:] for e in ends], time, branch)
        except EnclosureError:
            shape = tuple(len(e) - 1 for e in ends)
            return [np.full(shape, np.inf)] * len(tape.outputs)
        return [np.asarray(value.mag) for value in values]

    def _field(
        self, axes: tuple[Axis, ...], points: Interval, ranges: Interval, edge: Mask, tails: list[Array],
        degrees: Sequence[int],
    ) -> Field:  # fmt: skip
        lattice, radius = np.array(points.mid), over_cells(axes, np.array(points.rad))
        weights, smooth = 1.0, np.zeros(cells_of(axes))
        widths = [_along(axis.widths, k, len(axes)) for k, axis in enumerate(axes)]
        for axis, width, tail in zip(axes, widths, tails):
            smooth = smooth + weights * axis.sampling.tail * width ** (axis.sampling.parts + 1) * tail
            weights *= axis.sampling.lebesgue
        rough = (1 + weights) * np.asarray(ranges.rad)
        error = np.where(edge | ~np.isfinite(smooth), rough, np.minimum(smooth, rough)) + weights * radius
        if not (np.isfinite(lattice).all() and np.isfinite(error).all()):
            raise EnclosureError(
                "the model has no finite range on a part of the safe set; add constraints (or a `domain`) that keep "
                "away from there."
            )
        slopes = []
        for k, (axis, width) in enumerate(zip(axes, widths)):
            spread = weights / axis.sampling.lebesgue
            rows = []
            for order in range(degrees[k] + 1):
                matrix = axis.sampling.derivative(order)
                along = cell_combinations(lattice, k, np.concatenate([matrix, -matrix]))
                rounding = np.abs(matrix).sum() * (1e-14 * over_cells(axes, np.abs(lattice)) + radius)
                rows.append((spread * over_cells(axes, along, skip=k) + rounding) / width**order * _UP)
            slopes.append(tuple(rows))
        return Field(lattice=lattice, error=error * _UP, slopes=tuple(slopes))


def _cut(axes: tuple[Axis, ...], cells: tuple[Index, ...], parts: int) -> list[Interval]:
    """Boxes of some cells, a little wider than they are: along each axis, shape (R, 1, ..., parts, ..., 1)."""
    n, boxes = len(axes), list[Interval]()
    for k, (axis, cell) in enumerate(zip(axes, cells)):
        begin, end = axis.nodes[cell, None], axis.nodes[cell + 1, None]
        ends = begin + (end - begin) * np.arange(parts + 1) / parts
        off = 4 * np.spacing(np.maximum(np.abs(begin), np.abs(end)))
        shape = [len(cell), *(parts if j == k else 1 for j in range(n))]
        low, high = np.maximum(ends[:, :-1] - off, begin), np.minimum(ends[:, 1:] + off, end)
        boxes.append(Interval(low.reshape(shape), high.reshape(shape)))
    return boxes


@lru_cache(maxsize=32)
def _on_parts(sampling: Sampling, parts: int) -> tuple[Array, float]:
    """From samples of a cell to the Bernstein coefficients on each of its parts, shape (parts, m + 1, m + 1).

    The number bounds by how much they may amplify what rounding leaves, of the weights themselves too.
    """
    m, own = sampling.parts, sampling.derivative(0)
    s = (np.arange(parts)[:, None, None] + sampling.nodes[:, None]) / parts
    powers = np.arange(m + 1)
    bernstein = np.array([comb(m, j) for j in powers]) * s**powers * (1 - s) ** (m - powers)
    return own @ bernstein @ own, float((np.abs(own) @ bernstein @ np.abs(own)).sum(axis=2).max())


def _samples(axes: tuple[Axis, ...], lattice: Array, cells: tuple[Index, ...]) -> Array:
    """Values at the lattice points of some cells, shape (R, m_1 + 1, ...)."""
    n, places = len(axes), []
    for k, (axis, cell) in enumerate(zip(axes, cells)):
        m = axis.sampling.parts
        row = m * cell[:, None] + np.arange(m + 1)
        places.append(row.reshape(len(cell), *(m + 1 if j == k else 1 for j in range(n))))
    return np.asarray(lattice[tuple(places)])


def _ranges(samples: Array, rows: Sequence[tuple[Array, float]]) -> tuple[Array, Array]:
    """Bounds of p on the parts of some cells, shapes (R, parts, ...)."""
    result, size = samples, np.abs(samples).reshape(len(samples), -1).max(axis=1)
    for row, amplified in rows:
        result = np.einsum("sab,rb...->r...sa", row, result)
        size = size * amplified
    inner = tuple(range(2, result.ndim, 2))
    off = _along(_ROUNDED * size, 0, len(rows) + 1)
    return result.min(axis=inner) - off, result.max(axis=inner) + off


def _about(axis: Axis) -> tuple[Array, Array]:
    """Ends of intervals around the lattice points, which are rounded, within the axis."""
    off = 4 * np.spacing(np.abs(axis.nodes).max())
    low, high = axis.nodes[0], axis.nodes[-1]
    return np.maximum(axis.lattice - off, low), np.minimum(axis.lattice + off, high)


def _along(values: Array, axis: int, dimension: int) -> Array:
    return values.reshape([-1 if k == axis else 1 for k in range(dimension)])
