"""Drift and squared diffusion as polynomials with a proved remainder, cell by cell.

A function F(t, x, d), read from its tape, becomes p(t, x) + E with |E| <= remainder for every (t, x) of a cell and
every d of a branch. p interpolates F at the nodes of `polynomials.nodes_of`; along an axis with q + 1 nodes

    |F - I F| <= sup |d^(q+1) F| h^(q+1) max |prod (s - s_j)| / (q + 1)!,

and the axes add up, each weighted by the Lebesgue constants of those before it. The derivatives are exact tapes, read
in outward-rounded arithmetic over the whole cell. Where the tape has a kink or an undecided jump on a cell, p is a
constant and the remainder the radius of the enclosed range.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import factorial

import numpy as np

from certbound.arrays import Array
from certbound.errors import EnclosureError
from certbound.problem.model import Node, Tape, edged, jacobian
from certbound.rigor.intervals import Interval
from certbound.values.enclosing import enclose
from certbound.values.polynomials import interpolation, lebesgue, node_product, nodes_of, norm

_HIGHEST = 6  # polynomials up to this degree are represented exactly
_SMOOTH = 4  # degree of the interpolant of any other smooth function


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Cells:
    """A batch of boxes: ends of each axis, shape (B,); the first axis is time, then come the states."""

    low: tuple[Array, ...]
    high: tuple[Array, ...]

    @property
    def widths(self) -> tuple[Array, ...]:
        """Float lengths of the sides, correctly rounded."""
        return tuple(high - low for low, high in zip(self.low, self.high))

    def whole(self) -> list[Interval]:
        """The boxes themselves."""
        return [Interval(low, high) for low, high in zip(self.low, self.high)]

    def points(self, counts: Sequence[int], *, within: bool = False) -> list[Interval]:
        """The nodes of each axis as narrow intervals, shaped for an outer product behind the batch.

        ``within`` cuts off what rounding adds beyond the cells, where a root may have no value.
        """
        result = []
        for axis, count in enumerate(counts):
            shape = [1] * len(counts)
            shape[axis] = count
            low, high = Interval.point(self.low[axis]), Interval.point(self.high[axis])
            share = np.array(nodes_of(count)).reshape(shape)
            extended = (len(self.low[axis]), *([1] * len(counts)))
            low, high = low.reshape(extended), high.reshape(extended)
            place = low + (high - low) * Interval.point(share)
            result.append(Interval(np.maximum(place.lo, low.lo), np.minimum(place.hi, high.hi)) if within else place)
        return result


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Interpolant:
    """F = p + E: values of p at sample points, its size, and the bound of E.

    Attributes
    ----------
    samples : ndarray, shape (outputs, B, *samples of each axis)
        p there, off by at most 40 units of ``size`` roundoffs.
    size : ndarray, shape (outputs, B)
        Bound of |p| at the samples and of every intermediate result.
    remainder : ndarray, shape (outputs, B)
        Bound of |E| over the cell and the branch.
    """

    samples: Array
    size: Array
    remainder: Array


class Reader:
    """One function of (t, x), with its derivatives, that is interpolated on any batch of cells.

    Parameters
    ----------
    tape : Tape
        Over ``("t", *states, *disturbances)``.
    axes : int
        1 + number of states.
    """

    def __init__(self, tape: Tape, axes: int) -> None:
        self.tape, self.axes = tape, axes
        self.edged = edged(tape)
        self.degrees: list[int] = []
        self.derivatives: list[Tape | None] = []
        for axis in range(axes):
            degree, derivative = _degree(tape, axis)
            self.degrees.append(degree)
            self.derivatives.append(derivative)

    @property
    def autonomous(self) -> bool:
        """True when the function does not depend on t."""
        return all(node.op != "input" or node.args[0] != 0 for node in self.tape.nodes)

    def interpolate(self, cells: Cells, branch: Sequence[Interval], points: Sequence[tuple[float, ...]]) -> Interpolant:
        """p at sample points (shares of each axis), and the remainder.

        Proves: |F(t, x, d) - p(t, x)| <= remainder on each cell, d in the branch; see the module.
        """
        counts = [degree + 1 for degree in self.degrees]
        rooted = any(node.op == "sqrt" for node in self.tape.nodes)
        values, _ = enclose(self.tape, [*cells.points(counts, within=rooted), *branch])
        shape = (len(cells.low[0]), *counts)
        full = [value.broadcast_to(shape) for value in values]
        mid = np.array([value.mid for value in full])
        rad = np.array([value.rad.reshape(shape[0], -1).max(axis=1) for value in full])
        remainder = rad * np.prod([lebesgue(count) for count in counts]) + self._tail(cells, branch)
        mid, remainder = self._at_edges(cells, branch, mid, remainder)
        size = np.abs(mid).reshape(*mid.shape[:2], -1).max(axis=2)
        for axis, (count, where) in enumerate(zip(counts, points)):
            matrix = interpolation(count, tuple(where))
            mid = np.moveaxis(np.tensordot(mid, matrix, axes=([axis + 2], [1])), -1, axis + 2)
            size = size * norm(matrix)
        return Interpolant(samples=mid, size=size * (1 + 1e-12), remainder=remainder * (1 + 1e-12))

    def _tail(self, cells: Cells, branch: Sequence[Interval]) -> Array:
        """The interpolation errors of all axes; 0 along an axis in which the function is a polynomial."""
        total = np.zeros((len(self.tape.outputs), len(cells.low[0])))
        weight = 1.0
        for derivative, degree, width in zip(self.derivatives, self.degrees, cells.widths):
            count = degree + 1
            if derivative is not None:
                sizes = _magnitudes(derivative, [*cells.whole(), *branch], len(width))
                factor = node_product(count) / factorial(count) * (width * (1 + 1e-15)) ** count
                total += weight * sizes * factor * (1 + 1e-12)
            weight *= lebesgue(count)
        return total

    def _at_edges(
        self, cells: Cells, branch: Sequence[Interval], mid: Array, remainder: Array
    ) -> tuple[Array, Array]:
        """Constants with the radius of the range where a kink or a jump lies on the cell, or no bound was found."""
        rough = ~np.isfinite(remainder).all(axis=0)
        if not self.edged and not rough.any():
            return mid, remainder
        ranges, edge = enclose(self.tape, [*cells.whole(), *branch])
        place = np.flatnonzero(rough | np.broadcast_to(edge, rough.shape))
        for output, value in enumerate(ranges):
            full = value.broadcast_to(rough.shape)[place]
            if not np.isfinite(full.lo).all() or not np.isfinite(full.hi).all():
                raise EnclosureError(
                    "the model has no finite range on a part of the safe set; add constraints (or a `domain`) "
                    "that keep away from there."
                )
            mid[output, place] = full.mid.reshape(-1, *([1] * self.axes))
            remainder[output, place] = full.rad
        return mid, remainder


def _magnitudes(derivative: Tape, inputs: Sequence[Interval], count: int) -> Array:
    try:
        values, _ = enclose(derivative, inputs)
    except EnclosureError:  # of the derivative alone: a root at 0, say
        return np.full((len(derivative.outputs), count), np.inf)
    return np.array([np.broadcast_to(value.mag, (count,)) for value in values])


def _degree(tape: Tape, axis: int) -> tuple[int, Tape | None]:
    """Degree of the interpolant along an axis, and the derivative that bounds its error (None: it is exact)."""
    current, tail = tape, None
    for degree in range(_HIGHEST + 1):
        current = _column(current, axis)
        if all(current.nodes[output] == Node("const", (), 0.0) for output in current.outputs):
            return degree, None
        tail = current if degree == _SMOOTH else tail
    return _SMOOTH, tail


def _column(tape: Tape, axis: int) -> Tape:
    derivative = jacobian(tape, [axis])
    return Tape(
        inputs=derivative.inputs, nodes=derivative.nodes, outputs=derivative.outputs, shape=(len(derivative.outputs),)
    )
