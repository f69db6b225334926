"""Drift and squared diffusion on the cells of a grid: interpolants with a proved remainder.

On every cell F = p + E, p the tensor interpolant of F through the cell's lattice points, of degree m along each axis
(`splines.Sampling`). With a cell's widths h_i, the Lebesgue constant C of the points and the constant c of their tail,

    |E| <= sum_i C^i c h_i^(m+1) sup |d_i^(m+1) F|,     and where F has a kink or a jump on the cell
    |E| <= (1 + C^n) rad F(cell).

Where d_i^k F vanishes identically, so does d_i^k p: the interpolants of the other axes are taken of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from certbound.arrays import Array, Mask
from certbound.errors import EnclosureError
from certbound.problem.model import Node, Tape, jacobian
from certbound.rigor.intervals import Interval
from certbound.values.enclosing import enclose
from certbound.values.kolmogorov.splines import Axis, cell_combinations, cells_of, over_cells

_UP = 1 + 1e-12


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
        return [
            self._field(axes, points[k], ranges[k], edge, [t[k] for t in tails], degrees[k]) if present else None
            for k, present in enumerate(self.present)
        ]

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


def _about(axis: Axis) -> tuple[Array, Array]:
    """Ends of intervals around the lattice points, which are rounded, within the axis."""
    off = 4 * np.spacing(np.abs(axis.nodes).max())
    low, high = axis.nodes[0], axis.nodes[-1]
    return np.maximum(axis.lattice - off, low), np.minimum(axis.lattice + off, high)


def _along(values: Array, axis: int, dimension: int) -> Array:
    return values.reshape([-1 if k == axis else 1 for k in range(dimension)])
