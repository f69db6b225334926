"""The mean of v(0, X_0) over a normal start, from above and from below.

X_0 = m + L z + e: z = B (X_0 - m) for floats L and B has a covariance near I, E, and the rest e is so small that
|e_k| <= slack_k but for a probability that is counted. On a cell of a grid in z with sides w, v(m + L z) is off the
multilinear interpolation of its values at corners by at most

    sum_k w^2 / 8 sum_ij |L_ik L_jk| sup |v_ij|     (+ sum_k slack_k sup |v_k|),

and the means of hat functions under the normal law are known. Cells that are not within the box of v count as failing
from above; from below those beyond a limit do, and others as safe.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from flint import arb

from certbound.arrays import Array, Index, Mask
from certbound.errors import InfeasibleError
from certbound.problem.sets import GaussianStart
from certbound.rigor.balls import lower, precision, upper
from certbound.rigor.intervals import Interval
from certbound.values.kolmogorov.splines import DEGREE, Axis, Derivatives, plus, unit

if TYPE_CHECKING:
    from certbound.values.kolmogorov.carry import Side

_FAR = 9.0  # deviations up to which the grid reaches: 2e-19 lies beyond
CELLS = {1: 2000, 2: 300, 3: 70}  # along each direction, by their number
_SINGULAR = 1e-9  # of the correlations' eigenvalues: what is less belongs to the rest
_TOGETHER = 20000  # points
_UP = 1 + 1e-10


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Directions:
    """X_0 within ``mean`` + ``gains`` z + {|e| <= ``slack``}, but for ``missed``; z = ``rows`` (X_0 - ``mean``).

    Shapes (n,), (n, d), (n,), (d, n). The density of z is that of a standard normal vector times a factor between
    ``under`` and ``over``, where |z_k| <= 9.
    """

    mean: Array
    gains: Array
    rows: Array
    slack: Array
    missed: float
    under: float
    over: float


def directions_of(start: GaussianStart) -> Directions:
    """The directions in which a start varies.

    Raises
    ------
    InfeasibleError
        Floats cannot tell the covariance's numbers apart.
    """
    covariance = np.asarray(start.covariance, dtype=float)
    scale = np.sqrt(np.diag(covariance))
    size = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / size[:, None] / size)
    kept = values > _SINGULAR * max(float(values[-1]), 0.0)
    gains = size[:, None] * vectors[:, kept] * np.sqrt(values[kept])
    rows = (vectors[:, kept] / np.sqrt(values[kept])).T / size
    if np.count_nonzero(covariance) == np.count_nonzero(scale):  # independent: directions along the coordinates
        own = np.flatnonzero(scale)
        gains, rows = np.diag(scale)[:, own], np.diag(1 / size)[own]
    given, d = Interval.point(covariance), gains.shape[1]
    off = Interval.point(rows) @ given @ Interval.point(rows.T) - np.eye(d)
    distortion = float(off.mag.sum(axis=1).max()) * _UP if d else 0.0
    if not distortion < 1e-3:
        raise InfeasibleError("the covariance of the random start is too badly conditioned; rescale the states.")
    left = np.eye(len(scale)) - Interval.point(gains) @ Interval.point(rows)
    rest = left @ given @ Interval(left.lo.T, left.hi.T)
    variance = np.maximum(np.diag(np.asarray(rest.hi)), 0.0)
    rounding = 1e-14 * (np.abs(gains).sum(axis=1) * _FAR + np.abs(start.mean))
    far = _tail(_FAR / np.sqrt(1 + distortion) * (1 - 1e-12))
    square = d * _FAR**2
    return Directions(
        mean=np.asarray(start.mean, dtype=float), gains=gains, rows=rows,
        slack=_FAR * np.sqrt(variance) * _UP + rounding,
        missed=2 * far * (d + int(np.count_nonzero(variance))) * _UP,
        under=(1 + distortion) ** (-d / 2) * np.exp(-distortion * square / (2 * (1 - distortion))) / _UP,
        over=(1 - distortion) ** (-d / 2) * np.exp(distortion * square / (2 * (1 + distortion))) * _UP,
    )  # fmt: skip


def _tail(size: float) -> float:
    with precision():
        return upper((arb(size) / arb(2).sqrt()).erfc() / 2)


@lru_cache(maxsize=4)
def _weights(count: int) -> tuple[Array, Array, Array]:
    """Edges in units of deviations, and bounds of what each cell of a standard normal variable gives to its two ends.

    Shapes (count + 1,) and (2, count) each: E[1 - s; cell] and E[s; cell], s the share of the cell, from below and from
    above.
    """
    edges = np.linspace(-_FAR, _FAR, count + 1)
    least, most = np.zeros((2, count)), np.zeros((2, count))
    with precision():
        root = arb(2).sqrt()
        places = [arb(float(z)) for z in edges]
        below = [(-z / root).erfc() / 2 for z in places]
        density = [(-z * z / 2).exp() / (2 * arb.pi()).sqrt() for z in places]
        for k in range(count):
            mass, width = below[k + 1] - below[k], places[k + 1] - places[k]
            share = (density[k] - density[k + 1] - places[k] * mass) / width
            for row, value in enumerate((mass - share, share)):
                least[row, k], most[row, k] = max(lower(value), 0.0), max(upper(value), 0.0)
    return edges, least, most


class StartMean:
    """The mean of a side's v(0, .) over a normal start.

    Parameters
    ----------
    start : GaussianStart
    """

    def __init__(self, start: GaussianStart) -> None:
        self.directions = directions_of(start)
        count = self.directions.gains.shape[1]
        self.dimensions = count
        self.edges, self.least, self.most = _weights(CELLS.get(count, 2))
        lines = np.meshgrid(*[self.edges] * count, indexing="ij")
        z = np.array([line.ravel() for line in lines]).reshape(count, -1)
        self.shape = (len(self.edges),) * count
        self.points = self.directions.mean[:, None] + self.directions.gains @ z
        self.rows: tuple[Side, list[tuple[Index, Array]], Mask] | None = None

    @property
    def places(self) -> Array:
        """A few points that stand for the law, shape (points, n): their mean is right for polynomials of degree 3."""
        off = np.sqrt(self.dimensions) * self.directions.gains.T
        return np.asarray(self.directions.mean + np.concatenate([off, -off]))

    def bound(self, side: Side) -> tuple[float, float]:
        """The mean about, and the certified bound: of v from above, and of -v from below as a negative number."""
        if self.rows is None or self.rows[0] is not side:
            self.rows = (side, *self._prepared(side))
        _, rows, inside = self.rows
        coefficients = side.values[-1] if side.above else -side.values[-1]
        value = np.zeros(inside.shape)
        value[inside] = _at(rows, coefficients)
        whole = self._cells(inside)
        extra = self._extra(side, coefficients)
        under, over, n = self.directions.under, self.directions.over, self.dimensions
        mass = over * self._product(self.most.sum(axis=0)) * _UP
        total, about = np.zeros(mass.shape), np.zeros(mass.shape)
        for corner in product((0, 1), repeat=n):
            place = tuple(slice(c, c + len(self.edges) - 1) for c in corner)
            own = value.reshape(self.shape)[place]
            most, least = (self._product(*(rows_[c] for c in corner)) for rows_ in (self.most, self.least))
            about += own * most
            if side.above:
                total += np.maximum(own, 0) * most * over
            else:
                total += np.where(own > 0, own * least * under, own * most * over)
        if side.above:
            cells = np.where(whole, np.minimum(total * _UP + mass * extra, mass), mass)
            bound = float(cells.sum()) * _UP + self.directions.missed
            return float(np.where(whole, np.minimum(about, mass), mass).sum()), min(bound, 1.0)
        lost = self._lost(side)
        least = under * self._product(self.least.sum(axis=0)) / _UP
        cells = np.where(whole, np.maximum(total - 1e-10 * mass - mass * extra, 0.0), np.where(lost, least, 0.0))
        bound = float(cells.sum()) / _UP - self.directions.missed
        return -float(np.where(whole, about, np.where(lost, mass, 0.0)).sum()), -max(bound, 0.0)

    def _prepared(self, side: Side) -> tuple[list[tuple[Index, Array]], Mask]:
        """Basis functions at the corners within the box, and which these are."""
        slack = self.directions.slack[:, None]
        low, high = (np.array([axis.nodes[end] for axis in side.axes])[:, None] for end in (0, -1))
        inside = np.all((self.points - slack >= low) & (self.points + slack <= high), axis=0)
        return [_basis(axis, row[inside]) for axis, row in zip(side.axes, self.points)], inside

    def _lost(self, side: Side) -> Mask:
        """Cells beyond one of the limits."""
        result = np.zeros((len(self.edges) - 1,) * self.dimensions, dtype=bool)
        for k, axis in enumerate(side.axes):
            for end, limited in enumerate(side.setting.limited[:, k]):
                if limited:
                    out = (2 * end - 1) * (self.points[k] - axis.nodes[-end]) > self.directions.slack[k]
                    result |= self._cells(out)
        return result

    def _cells(self, marked: Mask) -> Mask:
        """Cells all of whose corners are marked."""
        marked = marked.reshape(self.shape)
        parts = [
            marked[tuple(slice(c, c + len(self.edges) - 1) for c in corner)]
            for corner in product((0, 1), repeat=self.dimensions)
        ]
        return np.asarray(np.logical_and.reduce(parts))

    def _product(self, *rows: Array) -> Array:
        """A tensor of products, of one row for each direction or the same for all."""
        rows = rows * self.dimensions if len(rows) == 1 else rows
        result = np.ones(())
        for row in rows:
            result = result[..., None] * row
        return result

    def _extra(self, side: Side, coefficients: Array) -> Array:
        """What v may be above its interpolation on each cell of the grid in z, for cells within the box."""
        from scipy.ndimage import maximum_filter

        n, derivatives = len(side.axes), Derivatives(side.axes, coefficients[None])
        gains, width = np.abs(self.directions.gains), float(np.diff(self.edges).max())
        bend = gains @ gains.T * width**2 / 8
        table = np.zeros(tuple(axis.cells for axis in side.axes))
        for i in range(n):
            table += self.directions.slack[i] * derivatives.size(unit(i, n))[0]
            for j in range(n):
                if bend[i, j]:
                    table += bend[i, j] * derivatives.size(plus(unit(i, n), unit(j, n)))[0]
        half = gains.sum(axis=1) * width / 2 + self.directions.slack
        around = [2 * int(np.ceil(h / axis.widths.min() * _UP)) + 1 for h, axis in zip(half, side.axes)]
        table = maximum_filter(table, around) + 1e-13 * np.abs(coefficients).max()
        middle = [(self.edges[1:] + self.edges[:-1]) / 2] * self.dimensions
        z = np.array([line.ravel() for line in np.meshgrid(*middle, indexing="ij")]).reshape(self.dimensions, -1)
        x = self.directions.mean[:, None] + self.directions.gains @ z
        place = tuple(
            np.clip(np.searchsorted(axis.nodes, row, side="right") - 1, 0, axis.cells - 1)
            for axis, row in zip(side.axes, x)
        )
        return np.asarray(table[place].reshape((len(self.edges) - 1,) * self.dimensions)) * _UP


def _basis(axis: Axis, points: Array) -> tuple[Index, Array]:
    """The first of the six basis functions at each point, and their values."""
    line, place = np.unique(points, return_inverse=True)
    parts = [axis.at_points(line[k : k + _TOGETHER], 0) for k in range(0, max(len(line), 1), _TOGETHER) if len(line)]
    if not parts:
        return np.zeros(0, dtype=np.intp), np.zeros((0, DEGREE + 1))
    start, weights = np.concatenate([p.start for p in parts]), np.concatenate([p.weights for p in parts])
    return start[place], weights[place]


def _at(rows: list[tuple[Index, Array]], coefficients: Array) -> Array:
    """A tensor spline at points."""
    count, n = len(rows[0][0]), len(rows)
    result = np.zeros(count)
    for begin in range(0, count, _TOGETHER):
        own = [(start[begin : begin + _TOGETHER], weights[begin : begin + _TOGETHER]) for start, weights in rows]
        for shift in product(range(DEGREE + 1), repeat=n):
            weight = np.prod([weights[:, k] for k, (_, weights) in zip(shift, own)], axis=0)
            place = tuple(start + k for k, (start, _) in zip(shift, own))
            result[begin : begin + _TOGETHER] += weight * coefficients[place]
    return result
