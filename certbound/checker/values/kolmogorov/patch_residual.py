"""v_t + L v on patches (Thm K10): what bounds it from above in every slab of a stage.

On a patch v_t + L v is a polynomial in time whose Bernstein coefficients are v_t's and the means of the products of L's
with b_j. Of f and a Taylor models about the patch's middle are made; their polynomials times those of v's derivatives
are polynomials of degree 5 + d in every xi (of degree d in disturbances), which lie below the largest of their
Bernstein coefficients. What the models miss is paid by the size of the derivatives. Where that does not show what the
file states as ``eta``, the patch is cut; eta is what is found at last.

From above that covers all disturbances. From below one of the stated disturbances is enough for every patch.

Roundings. An entry of the derivative of orders alpha of b_j, by powers of xi, is off by at most `patches.ROUNDED`
times the size times prod_i (2 / h_i)^alpha_i binomial (5, k_i) k_i!/(k_i - alpha_i)!, whose sums over k are ``SUMS``.
The sum of all products, and the matrices to Bernstein's form, whose entries are at most 1, add a rounding for each
term of a sum. With c the Bernstein coefficients in time, of degree q, of a power of xi in a model, those of its product
with b are sum_i binomial (q, k - i) binomial (3, i) / binomial (q + 3, k) c_(k-i) b_i: means.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from certbound.checker.report import Budget, Unproved
from certbound.checker.values.batches import Array, Index, Mask, bernstein
from certbound.checker.values.kolmogorov.cell_operator import Acting, Generator, Grid, Operator, Orders
from certbound.checker.values.kolmogorov.patches import DEGREE, ROUNDED, Patches, Splines, along

SUMS = (32.0, 80.0, 160.0)
"""Sums over k of binomial (5, k) k!/(k - order)!."""
UNIT = 2.0**-52
UP = 1 + 2.0**-40
_DEEPEST = 3
"""How often a patch is halved along every axis."""
_CHUNK, _NUMBERS = 512, 2_000_000
"""Patches that are looked at together, and numbers of their arrays: they stay in the cache."""
_CUBIC = 4
"""Coefficients of v in time."""


class Residual:
    """v_t + L v of one stage.

    Parameters
    ----------
    splines : Splines
    operator : Operator
    stated : ndarray, shape (K,)
        ``eta`` of the file.
    over : ndarray of bool, shape (N_1, ...)
        Cells on which nothing is asked.
    end : float
        Nothing is asked where v is at least this.
    actings : sequence of disturbances, or [None]
        One of these serves each patch; None: all of their set are to be served.
    """

    def __init__(
        self, splines: Splines, operator: Operator, stated: Array, over: Mask, end: float,
        actings: Sequence[Acting | None] = (None,),
    ) -> None:  # fmt: skip
        self.splines, self.operator, self.stated, self.over, self.end = splines, operator, stated, over, end
        self.actings, self.n = actings, len(splines.axes)
        self.budget: Budget = splines.budget
        self.grid = Grid(axes=splines.axes, times=splines.times)

    @property
    def work(self) -> int:
        """Numbers that all patches take at least."""
        cells = int(np.count_nonzero(~self.over))
        return cells * self.splines.slabs * self._each() + self.operator.work(
            cells, self.splines.slabs, self.actings[0]
        )

    def _each(self) -> int:
        """Numbers that one patch takes at least."""
        return int(_CUBIC * (DEGREE + 1) ** self.n * (6 + 7 * self.n))

    def payments(self) -> Array:
        """eta of every slab: what its patches need, which the file says about."""
        splines, n = self.splines, self.n
        eta, cells = np.zeros(splines.slabs), np.flatnonzero(~self.over.ravel())
        count = splines.slabs * len(cells)
        self.budget.fits(8 * 4 * (n + 2) * count)
        slab = np.tile(np.arange(splines.slabs), len(cells))
        places = [np.repeat(part, splines.slabs) for part in np.unravel_index(cells, splines.cells)]
        for level in range(_DEEPEST + 1):
            need = self._needs(slab, places, level)
            settled = (need <= self.stated[slab]) | (level == _DEEPEST)
            np.maximum.at(eta, slab[settled], need[settled])
            slab, *places = (part[~settled] for part in (slab, *places))
            if not len(slab):
                break
            many = 2**n
            self.budget.fits(8 * 4 * (n + 2) * many * len(slab))
            self.budget.expect(many * len(slab) * self._each())
            slab = np.repeat(slab, many)
            for axis, part in enumerate(itertools.zip_longest(*itertools.product((0, 1), repeat=n))):
                places[axis] = np.repeat(2 * places[axis], many) + np.tile(part, len(slab) // many)
        if not np.isfinite(eta).all():
            raise Unproved("the dynamics was not shown to be defined where v is asked for")
        return eta

    def _needs(self, slab: Index, places: Sequence[Index], level: int) -> Array:
        """What every patch needs as eta; 0 where v is beyond its end."""
        need = np.full(len(slab), np.inf)
        for acting in self.actings:
            due = np.flatnonzero(~(need <= self.stated[slab]))
            if len(due):
                found = self._needs_under(acting, slab[due], [place[due] for place in places], level)
                need[due] = np.minimum(need[due], found)
        return need

    def _needs_under(self, acting: Acting | None, slab: Index, places: Sequence[Index], level: int) -> Array:
        need, shape = np.zeros(len(slab)), tuple(count * 2**level for count in self.splines.cells)
        timed, slabs, together = self.operator.timed, self.splines.slabs, self.operator.together(acting)
        for first in range(0, len(slab), together):
            rows = slice(first, first + together)
            own, here = slab[rows], [place[rows] for place in places]
            self.budget.floats(200 * len(own), 40)
            numbers = np.ravel_multi_index(here, shape) * slabs + (own if timed else 0)
            chosen, which = np.unique(numbers, return_inverse=True)
            cells = np.unravel_index(chosen // slabs, shape)
            models = self.operator.models(self.grid, chosen % slabs, cells, level, acting)
            tops = _tops(models, self.operator.variables(acting))
            chunk = max(min(_CHUNK, _NUMBERS // math.prod(self._shape(tops))), 1)
            for start in range(0, len(own), chunk):
                part = slice(start, start + chunk)
                patches = self.splines.patches(own[part], [place[part] for place in here], level)
                due = np.flatnonzero(~(patches.lowest() >= self.end))
                if len(due):
                    need[first + start + due] = self._need(patches.take(due), models, which[part][due], tops)
        return need

    def _shape(self, tops: Orders) -> tuple[int, ...]:
        """Of the residual: time, states, disturbances."""
        n, timed = self.n, self.operator.timed
        states = [DEGREE + 1 + top for top in tops[:n]]
        return (_CUBIC + (tops[n] if timed else 0), *states, *(1 + top for top in tops[n + timed :]))

    def _need(self, patches: Patches, models: Generator, which: Index, tops: Orders) -> Array:
        """At least v_t + L v on every patch, for all values of the other variables."""
        n, count, shape = self.n, len(which), self._shape(tops)
        numbers, more = math.prod(shape), shape[0] - _CUBIC
        monomials = (1 + more) * sum(int(np.any(model.coefficients, axis=1).sum()) for *_, model in models)
        self.budget.fits(8 * count * (3 * numbers + 8 * _CUBIC * (DEGREE + 1) ** n))
        self.budget.floats(
            count * (_CUBIC * (DEGREE + 1) ** n * (3 * monomials + 8 * len(models) + 12)
                     + numbers * sum(shape[1:]) // 2),
            (10 if more else 6) * monomials + 20 * len(models) + 40,
        )  # fmt: skip
        powers = patches.powers()
        total = np.zeros((*shape, count))
        inner: tuple[slice | int, ...] = (slice(None), *[slice(0, DEGREE + 1)] * n, *[0] * (len(shape) - 1 - n))
        rates = _risen(np.diff(powers, axis=0) * (3 / patches.step))
        raised = _products(more).sum(axis=0)
        total[inner] = np.tensordot(raised, rates, axes=(1, 0)) if more else rates
        total.reshape(shape[0], -1, count)[:, 0] += raised @ patches.speeds
        rounded, missed = 12 / patches.step * SUMS[0] ** n, patches.off.copy()
        sums = 8 * sum(shape) + 400 + 8 * monomials
        for orders, weight, model in models:
            slope = derivative(powers, orders)
            scale = np.full(count, weight)
            for half, order in zip(patches.half, orders):
                scale = scale / half**order
            slope = slope * scale
            own = model.coefficients[:, which]
            self._add(total, slope, model.terms.exponents, own, more)
            size = scale * math.prod(SUMS[order] for order in orders) * patches.size
            largest = np.abs(slope).sum(axis=tuple(range(1, n + 1))).max(axis=0) + ROUNDED * size
            missed = missed + model.error[which] * largest
            rounded = rounded + np.abs(own).sum(axis=0) * scale * math.prod(SUMS[order] for order in orders)
        for axis, length in enumerate(shape[1:], 1):
            if length > 1:
                total = along(bernstein(length - 1), total, axis)
        high = total.reshape(-1, count).max(axis=0)
        found = high + (missed + rounded * patches.size * (2 * ROUNDED + sums * UNIT)
                        + sums * UNIT * np.abs(patches.speeds).max(axis=0)) * UP  # fmt: skip
        found = found + np.abs(found) * UNIT
        return np.where(np.isfinite(found), np.maximum(found, 0.0), np.inf)

    def _add(self, total: Array, slope: Array, exponents: Sequence[Orders], own: Array, more: int) -> None:
        """Add a model times a derivative of v to the residual, by powers of states and of disturbances."""
        n, timed = self.n, self.operator.timed
        groups: dict[Orders, list[tuple[int, Array]]] = {}
        for powers, row in zip(exponents, own):
            if row.any():
                groups.setdefault((*powers[:n], *powers[n + timed :]), []).append((powers[n] if timed else 0, row))
        weights = _products(more)
        for powers, rows in groups.items():
            place: tuple[slice | int, ...] = (
                *(slice(e, e + size) for e, size in zip(powers, slope.shape[1:-1])), *powers[n:],
            )  # fmt: skip
            if not more:
                total[(slice(None), *place)] += rows[0][1] * slope
                continue
            change = bernstein(more)
            for k in range(more + 1):
                factor = sum(change[k, power] * row for power, row in rows)
                share = weights[k, k : k + _CUBIC].diagonal().reshape(-1, *[1] * (n + 1))
                total[(slice(k, k + _CUBIC), *place)] += share * (factor * slope)


def _tops(models: Generator, variables: int) -> Orders:
    """The largest power of every variable in the models."""
    tops = [0] * variables
    for *_, model in models:
        for powers, there in zip(model.terms.exponents, np.any(model.coefficients, axis=1).tolist()):
            if there:
                tops = [max(pair) for pair in zip(tops, powers)]
    return tuple(tops)


def _products(more: int) -> Array:
    """Weights w[l, k, i], k = l + i, of products of Bernstein coefficients: of degree ``more`` in time with a cubic's.

    Their sum over l raises the degree of a cubic.
    """
    found = np.zeros((more + 1, _CUBIC + more, _CUBIC))
    for k, i in itertools.product(range(more + 1), range(_CUBIC)):
        found[k, k + i, i] = math.comb(more, k) * math.comb(_CUBIC - 1, i) / math.comb(_CUBIC - 1 + more, k + i)
    return found


def _risen(slopes: Array) -> Array:
    """A quadratic in Bernstein's form as a cubic."""
    first, middle, last = slopes
    return np.stack([first, (first + 2 * middle) / 3, (2 * middle + last) / 3, last])


def derivative(powers: Array, orders: Orders) -> Array:
    """Coefficients of a derivative by xi."""
    for axis, order in enumerate(orders, 1):
        for _ in range(order):
            count = powers.shape[axis]
            shape = [-1 if k == axis else 1 for k in range(powers.ndim)]
            powers = np.take(powers, range(1, count), axis=axis) * np.arange(1, count).reshape(shape)
    return powers
