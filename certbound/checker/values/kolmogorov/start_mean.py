"""The mean of v(0, X_0) over a normal start X_0, of mean m and covariance S.

The file states matrices L (``gains``) and B (``rows``), and z = B (X_0 - m), X_0 = m + L z + e. With M = B S B^T and
delta the largest row sum of |M - I|, the density of z is that of a standard normal vector times a number between

    (1 + delta)^(-d/2) exp(-delta d R^2 / (2 (1 - delta)))   and   (1 - delta)^(-d/2) exp(delta d R^2 / (2 (1 + delta)))

where no |z_k| exceeds R, which it does with a probability of at most erfc(R / sqrt(2 (1 + delta))) each; and |e_k| is
at most slack_k = R sqrt(((I - L B) S (I - L B)^T)_kk) but for erfc(R / sqrt 2) each. On a cell of a grid in z with
sides w, v(0, m + L z + e) is off the multilinear interpolation of its values at the corners by at most

    w^2 / 8 sum_k sup |sum_ij L_ik L_jk v_ij| + sum_k slack_k sup |v_k|,

and the means of its hat functions under the standard normal law are known: of s, the share of a cell [a, b] that z has
passed, it is (phi(a) - phi(b) - a P) / (b - a) with P = Phi(b) - Phi(a).

From above 1 is said wherever m + L z + e was not shown to lie inside of the grid, and at most 1 elsewhere; from below 1
where all of that breaks a constraint of the first moment, and else 0.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
from flint import arb

from certbound.checker.balls import identity, matrix
from certbound.checker.reading import Record
from certbound.checker.report import FUNCTION, Budget, Unproved
from certbound.checker.statement import Model
from certbound.checker.values.batches import Array, Index, Mask, above, below
from certbound.checker.values.kolmogorov.cell_operator import TOGETHER
from certbound.checker.values.kolmogorov.patch_residual import SUMS, UNIT, derivative
from certbound.checker.values.kolmogorov.patches import DEGREE, ROUNDED, Patches
from certbound.checker.values.kolmogorov.stage import Stage
from certbound.checker.values.kolmogorov.stage_limits import marked
from certbound.errors import CertificateError

MOST_CELLS, MOST_PARTS = 1_000_000, 20_000
_FAR = 9.0
"""R: 2e-19 lies beyond."""
_MOST_OFF = 1e-3
_UP = 1 + 2.0**-30
"""For sums and products of a few numbers of like sign, and for sums of a million."""


class StartMean:
    """A normal start in directions in which it varies independently.

    Parameters
    ----------
    model : Model
    record : Record
        The proof, which has ``gains``, ``rows`` and ``parts``.
    budget : Budget
    """

    def __init__(self, model: Model, record: Record, budget: Budget) -> None:
        n, given = model.dimension, model.initial.covariance
        assert given is not None
        self.n, self.budget = n, budget
        rows = record.array("rows", None, n)
        d = self.d = len(rows)
        if not 1 <= d <= n:
            raise CertificateError(f"`proof.rows` must have 1 to {n} entries, got {d}.")
        gains = record.array("gains", n, d)
        count = record.whole("parts", 1, MOST_PARTS)
        if count**d > MOST_CELLS:
            raise CertificateError(f"`proof.parts` must make at most {MOST_CELLS} cells, {d} directions together.")
        self.gains, self.mean, self.count = np.array(gains), np.array(model.initial.centre), count
        budget.products(n, n, 6 * n)
        change, back = matrix(rows), matrix(gains)
        off = change * given * change.transpose() - identity(d)
        sums = [sum((abs(off[i, j]) for j in range(d)), arb(0)).upper() for i in range(d)]
        delta = max(sums, key=float)
        if not delta < _MOST_OFF:
            raise Unproved("the stated directions were not shown to be independent under the start's law")
        left = identity(n) - back * change
        rest = left * given * left.transpose()
        far, square = arb(_FAR), d * arb(_FAR) ** 2
        slack = [far * _root(rest[k, k]) for k in range(n)]
        rounding = 2.0**-46 * (np.abs(self.gains).sum(axis=1) * _FAR + np.abs(self.mean))
        self.slack = np.array([above(x) for x in slack]) + rounding
        tails = d * (far / (2 * (1 + delta)).sqrt()).erfc() + n * (far / arb(2).sqrt()).erfc()
        self.missed = above(tails)
        self.over = above((1 - delta) ** (-arb(d) / 2) * (delta * square / (2 * (1 + delta))).exp())
        self.under = below((1 + delta) ** (-arb(d) / 2) * (-delta * square / (2 * (1 - delta))).exp())
        self.edges = np.linspace(-_FAR, _FAR, count + 1)
        self.least, self.most = self._hats()

    def _hats(self) -> tuple[Array, Array]:
        """Bounds of what each part of a direction gives to its two ends, shapes (2, parts)."""
        self.budget.balls(3 * (self.count + 1), FUNCTION)
        self.budget.fits(400 * self.count)
        places = [arb(float(z)) for z in self.edges]
        passed = [(-z / arb(2).sqrt()).erfc() / 2 for z in places]
        density = [(-z * z / 2).exp() / (2 * arb.pi()).sqrt() for z in places]
        least, most = np.zeros((2, self.count)), np.zeros((2, self.count))
        for k in range(self.count):
            mass, width = passed[k + 1] - passed[k], places[k + 1] - places[k]
            share = (density[k] - density[k + 1] - places[k] * mass) / width
            for row, ball in enumerate((mass - share, share)):
                least[row, k], most[row, k] = max(below(ball), 0.0), max(above(ball), 0.0)
        return least, most

    # ---- the mean ---------------------------------------------------------------------------------------------

    def bound(self, stage: Stage) -> float:
        """At least the mean of v from above, and of the smaller of v and 0 from below."""
        points = self.count**self.d
        self.budget.take(8 * points * (12 + 4 * self.n))
        self.budget.floats(points * (100 + 40 * self.n), 400)
        low, high = self._hulls()
        inside = np.ones(low.shape[1:], dtype=bool)
        for axis, first, last in zip(stage.splines.axes, low, high):
            inside &= (first > axis[0]) & (last < axis[-1])
        sign = 1.0 if stage.above else -1.0
        value, off = self._at_corners(stage, inside)
        value, extra = sign * value, self._extra(stage, low, high, inside) + off
        mass = self.over * _product([self.most.sum(axis=0)] * self.d) * _UP
        total = np.zeros(mass.shape)
        for corner in itertools.product((0, 1), repeat=self.d):
            own = value[tuple(slice(c, c + self.count) for c in corner)]
            most = _product([self.most[c] for c in corner]) * self.over
            least = _product([self.least[c] for c in corner]) * self.under
            total += np.maximum(own, 0.0) * (most * _UP if stage.above else least / _UP)
            total += 0.0 if stage.above else np.minimum(own, 0.0) * most * _UP
        if stage.above:
            cells = np.where(inside, np.minimum(total * _UP + mass * extra, mass), mass)
            return float(np.where(np.isnan(cells), mass, cells).sum()) * _UP + self.missed
        lost = np.where(self._lost(stage, low, high), _product([self.least.sum(axis=0)] * self.d) * self.under / _UP, 0)
        cells = np.where(inside, np.maximum(total - np.abs(total) * (_UP - 1) - mass * extra, 0.0), lost)
        mean = float(np.where(np.isnan(cells), 0.0, cells).sum()) / _UP - 2.0**-40 * self.over - self.missed
        return -max(mean, 0.0)

    def _hulls(self) -> tuple[Array, Array]:
        """Ends of m + L z + e on every cell of the grid in z, shapes (n, parts, ...)."""
        ends = np.stack([self.edges[:-1], self.edges[1:]])
        shape = (self.n, *[self.count] * self.d)
        low, high = (np.zeros(shape) + self.mean.reshape(-1, *[1] * self.d) for _ in range(2))
        for k in range(self.d):
            across = [1] * self.d
            across[k] = self.count
            parts = self.gains[:, k, None] * ends[:, None]
            low += parts.min(axis=0).reshape(self.n, *across)
            high += parts.max(axis=0).reshape(self.n, *across)
        slack = (self.slack * _UP).reshape(-1, *[1] * self.d)
        return low - slack, high + slack

    def _lost(self, stage: Stage, low: Array, high: Array) -> Mask:
        """Cells on which every point breaks a constraint of the first moment."""
        limits = stage.limits.at_begin()

        def box(block: Sequence[tuple[int, int]]) -> list[tuple[arb, arb]]:
            part = (slice(None), *(slice(*ends) for ends in block))
            axes = tuple(range(1, self.d + 1))
            return [(arb(float(a)), arb(float(b))) for a, b in zip(low[part].min(axis=axes), high[part].max(axis=axes))]

        return marked(low.shape[1:], box, limits.excludes, limits.holds, self.budget)

    def _at_corners(self, stage: Stage, inside: Mask) -> tuple[Array, float]:
        """v(0, .) at the corners of the cells inside of the grid, 0 at others, and by how much it is off at most."""
        asked = np.zeros([self.count + 1] * self.d, dtype=bool)
        for corner in itertools.product((0, 1), repeat=self.d):
            asked[tuple(slice(c, c + self.count) for c in corner)] |= inside
        numbers = np.nonzero(asked)
        points = self.mean[:, None] + self.gains @ np.array([self.edges[row] for row in numbers])
        axes = stage.splines.axes
        cells = [np.clip(np.searchsorted(axis, row, side="right") - 1, 0, len(axis) - 2)
                 for axis, row in zip(axes, points)]  # fmt: skip
        weights = [_basis(axis, cell, row) for axis, cell, row in zip(axes, cells, points)]
        flat, values, off = np.ravel_multi_index(cells, stage.splines.cells), np.zeros(len(points[0])), 0.0
        order = np.argsort(flat, kind="stable")
        chosen, first = np.unique(flat[order], return_index=True)
        first = np.append(first, len(order))
        for start in range(0, len(chosen), TOGETHER):
            stop = min(start + TOGETHER, len(chosen))
            patches = _at_first(stage, np.unravel_index(chosen[start:stop], stage.splines.cells))
            off = max(off, float((8 * ROUNDED * patches.size + 2 * UNIT * np.abs(patches.constants[0])).max()))
            for begin in range(first[start], first[stop], TOGETHER):
                some = order[begin : min(begin + TOGETHER, first[stop])]
                place = np.searchsorted(chosen[start:stop], flat[some])
                self.budget.fits(16 * len(some) * (DEGREE + 1) ** self.n)
                self.budget.floats(4 * len(some) * (DEGREE + 1) ** self.n, 20)
                table = patches.local[0][..., place]
                for row in weights:
                    table = (table * row[:, some].reshape(DEGREE + 1, *[1] * (table.ndim - 2), -1)).sum(axis=0)
                values[some] = table + patches.constants[0][place]
        found = np.zeros(asked.shape)
        found[numbers] = values
        return found, off if math.isfinite(off) else math.inf

    def _extra(self, stage: Stage, low: Array, high: Array, inside: Mask) -> Array:
        """What v may be off its interpolation on each cell inside of the grid."""
        n, splines = self.n, stage.splines
        width = float(np.diff(self.edges).max())
        bend = np.abs(self.gains) @ np.abs(self.gains).T * width**2 / 8 * _UP
        terms = [(tuple(int(k == i) for k in range(n)), self.slack[i]) for i in range(n)]
        terms += [(tuple((k == i) + (k == j) for k in range(n)), bend[i, j]) for i in range(n) for j in range(n)]
        table = np.zeros(math.prod(splines.cells))
        for first in range(0, table.size, TOGETHER):
            number = np.arange(first, min(first + TOGETHER, table.size))
            patches = _at_first(stage, np.unravel_index(number, splines.cells))
            powers = patches.powers()
            self.budget.floats(len(terms) * 3 * powers[:1].size, 20 * len(terms))
            for orders, factor in terms:
                scale = math.prod(1 / half**order for half, order in zip(patches.half, orders))
                size = np.abs(derivative(powers[:1], orders)).sum(axis=tuple(range(n + 1)))
                off = ROUNDED * math.prod(SUMS[order] for order in orders) * patches.size
                table[number] += factor * scale * (size + off) * _UP
        table = table.reshape(splines.cells)
        places, most = [], np.where(np.isnan(table), np.inf, table)
        for k, (axis, a, b) in enumerate(zip(splines.axes, low, high)):
            begin = np.clip(np.searchsorted(axis, a, side="right") - 1, 0, len(axis) - 2)
            end = np.clip(np.searchsorted(axis, b, side="left") - 1, 0, len(axis) - 2)
            places.append(begin)
            reach = int(np.where(inside, end - begin, 0).max()) + 1
            self.budget.floats(most.size * reach.bit_length() * 2, 4 * reach.bit_length())
            most = _most_ahead(most, k, reach)
        return np.asarray(most[tuple(places)])


def _at_first(stage: Stage, places: Sequence[Index]) -> Patches:
    """v(0, .) on cells."""
    return stage.splines.at(0).patches(0 * places[0], places, 0)


def _basis(axis: Array, cell: Index, points: Array) -> Array:
    """Bernstein's polynomials of degree 5 at points of cells, shape (6, points)."""
    width = axis[cell + 1] - axis[cell]
    share, rest = ((points - axis[cell]) / width).clip(0, 1), ((axis[cell + 1] - points) / width).clip(0, 1)
    return np.stack([math.comb(DEGREE, k) * share**k * rest ** (DEGREE - k) for k in range(DEGREE + 1)])


def _most_ahead(table: Array, axis: int, count: int) -> Array:
    """The largest of an entry and the next ones along an axis, ``count`` or as many as there are."""
    table, span = np.moveaxis(table, axis, 0).copy(), 1
    while span < count:
        step = min(span, count - span)
        table[:-step] = np.maximum(table[:-step], table[step:])
        span += step
    return np.moveaxis(table, 0, axis)


def _product(rows: Sequence[Array]) -> Array:
    """A tensor of products."""
    found = np.ones(())
    for row in rows:
        found = found[..., None] * row
    return found


def _root(x: arb) -> arb:
    """The root of a variance that rounding may have made negative."""
    return arb.max(x, arb(0)).upper().sqrt()


