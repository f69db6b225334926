"""Safe sets in the plane that are more than a box: polynomials of degree 2 whose signs say what is safe.

A constraint is a set {g_1 <= 0, ..., g_m <= 0}, to stay inside of or outside of; a face is affine, a ball or an
ellipsoid quadratic. The safe region O is open: g_j < 0 for all j inside, g_j > 0 for some j outside. Then

- closure(O) lies in {g_j <= 0 for all j} of every inside and in {g_j >= 0 for some j} of every outside;
- a boundary point of O is in closure(O), and some g_j of some constraint is 0 there.

Everything that a proof asks of a box is answered here in outward-rounded arithmetic.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from certbound.arrays import Array, Mask
from certbound.problem.sets import Inside, Quadratic, Region
from certbound.rigor.intervals import Interval, sq, stack
from certbound.values.sets import inverse_of

Box = tuple[Interval, Interval]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Wall:
    """g(x) = y' Q y + l y + k of y = x - center, every coefficient enclosed; Q is symmetric.

    Attributes
    ----------
    center : ndarray, shape (2,)
    square : tuple of Interval
        Q_11, Q_12, Q_22.
    slope : ndarray, shape (2,)
    constant : Interval
    """

    center: Array
    square: tuple[Interval, Interval, Interval]
    slope: Array
    constant: Interval

    def over(self, box: Box) -> Interval:
        """Ranges over boxes, any shape; exact but for rounding where Q is diagonal or 0."""
        x, y = (side - Interval.point(place) for side, place in zip(box, self.center))
        xx, xy, yy = self.square
        total = x * Interval.point(self.slope[0]) + y * Interval.point(self.slope[1]) + self.constant
        if self.curved:
            total = total + xx * sq(x) + yy * sq(y)
            if xy.lo != 0 or xy.hi != 0:
                total = total + 2.0 * (xy * x * y)
        return total

    @property
    def curved(self) -> bool:
        """Whether it is of degree 2."""
        return any(float(entry.lo) != 0 or float(entry.hi) != 0 for entry in self.square)

    def bernstein(self, ends: tuple[tuple[Interval, Interval], ...]) -> Interval:
        """Coefficients of degree (2, 2) over boxes given by enclosed (low, high) ends, shape (B, 3, 3): polar forms."""
        rows, squares = [], []
        for (left, right), place in zip(ends, self.center):
            low, high = left - Interval.point(place), right - Interval.point(place)
            rows.append(stack([low, 0.5 * (low + high), high], axis=-1))
            squares.append(stack([sq(low), low * high, sq(high)], axis=-1))
        x, xx, y, yy = rows[0][:, :, None], squares[0][:, :, None], rows[1][:, None, :], squares[1][:, None, :]
        table = x * Interval.point(self.slope[0]) + y * Interval.point(self.slope[1]) + self.constant
        return table + self.square[0] * xx + self.square[2] * yy + 2.0 * (self.square[1] * (x * y))

    def distance(self, x: Array, y: Array) -> Array:
        """How far points are from g = 0 along its slope there, with g's sign; plain floats, and smooth at the wall."""
        u, v = x - self.center[0], y - self.center[1]
        xx, xy, yy = (float(entry.mid) for entry in self.square)
        value = xx * u * u + 2 * xy * u * v + yy * v * v + self.slope[0] * u + self.slope[1] * v
        value = value + float(self.constant.mid)
        along, across = 2 * (xx * u + xy * v) + self.slope[0], 2 * (xy * u + yy * v) + self.slope[1]
        steep = np.hypot(along, across)
        flat = steep < 1e-100  # at the centre, where the slope has no direction
        bent = (xx * along**2 + 2 * xy * along * across + yy * across**2) / np.where(flat, 1.0, steep) ** 2
        bent = np.where(flat, max(xx, yy), bent)
        root = np.sqrt(np.maximum(steep**2 - 4 * bent * value, 0.0))
        return np.asarray(2 * value / np.maximum(steep + root, 1e-300))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Walls:
    """The constraints: the walls of each, and whether its set is to be kept out of."""

    groups: tuple[tuple[tuple[Wall, ...], bool], ...]

    @classmethod
    def of(cls, constraints: Sequence[Inside]) -> Walls:
        """The walls of constraints that hold at all times and do not move."""
        return cls(groups=tuple((walls_of(one.region), one.outside) for one in constraints))

    def locate(self, box: Box) -> tuple[Mask, Mask]:
        """Boxes that surely lie in O, and boxes that surely do not meet closure(O); the rest is undecided."""
        within, away = np.ones(box[0].shape, dtype=bool), np.zeros(box[0].shape, dtype=bool)
        for walls, outside in self.groups:
            ranges = [wall.over(box) for wall in walls]
            if outside:
                within &= np.any([g.lo > 0 for g in ranges], axis=0)
                away |= np.all([g.hi < 0 for g in ranges], axis=0)
            else:
                within &= np.all([g.hi < 0 for g in ranges], axis=0)
                away |= np.any([g.lo > 0 for g in ranges], axis=0)
        return within, away

    def touched(self, box: Box) -> list[tuple[Wall, Mask]]:
        """For every wall, the boxes that may hold boundary points of O on it."""
        away = self.locate(box)[1]
        found = []
        for walls, _ in self.groups:
            for wall in walls:
                g = wall.over(box)
                found.append((wall, (g.lo <= 0) & (g.hi >= 0) & ~away))
        return found

    def depths(self, x: Array, y: Array) -> Array:
        """About how far points are from each wall, positive on its safe side, shape (walls, ...); plain floats."""
        return np.array([
            wall.distance(x, y) * (1.0 if outside else -1.0) for walls, outside in self.groups for wall in walls
        ])  # fmt: skip

    def depth(self, x: Array, y: Array) -> Array:
        """About how far points are from the boundary, positive where it is safe; plain floats."""
        best = np.full(np.shape(x), np.inf)
        for walls, outside in self.groups:
            gaps = [wall.distance(x, y) for wall in walls]
            best = np.minimum(best, np.max(gaps, axis=0) if outside else -np.max(gaps, axis=0))
        return np.asarray(best)


class Deep(Protocol):
    """What says how far points are from walls, positive on the safe side."""

    def depth(self, x: Array, y: Array) -> Array: ...


def walls_of(region: Region) -> tuple[Wall, ...]:
    """The walls of one set in the plane that does not move."""
    places, center = region.places(2), np.zeros(2)
    center[places] = region.center_at()
    if isinstance(region.form, Quadratic):
        inverse = inverse_of(region.form.shape)
        full = [[Interval.point(0.0) for _ in range(2)] for _ in range(2)]
        for i, row in enumerate(places):
            for j, column in enumerate(places):
                full[row][column] = inverse[i, j]
        constant = -(Interval.point(region.form.radius) * region.form.radius)
        square = (full[0][0], full[0][1], full[1][1])
        return (Wall(center=center, square=square, slope=np.zeros(2), constant=constant),)
    none = (Interval.point(0.0),) * 3
    rows = region.lifted(region.form.normals, 2)
    return tuple(
        Wall(center=center, square=none, slope=row, constant=Interval.point(-float(bound)))
        for row, bound in zip(rows, region.form.bounds)
    )
