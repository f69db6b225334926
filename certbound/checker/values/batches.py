"""Taylor models over many boxes at once: the vectorised arithmetic of the proof by value functions.

A batch holds, for each of N boxes, a polynomial in xi in [-1, 1]^v and a number e: the function in question lies
within e of the polynomial, everywhere on the box. Coefficients are floats, taken as the real numbers that they are;
whatever rounding, truncation and remainders amount to is added to e. So every operation below does two things: it
computes coefficients in floats, and it adds to e at least what these miss, with ``_UP`` for the rounding of e itself
(at most 2^12 operations of relative error 2^-53 each) and ``_TINY`` for what underflows. Where e is not finite nothing
is known of a box, not even that the function is defined there.

This arithmetic is the checker's second one, beside balls: N boxes cost a few NumPy operations, where balls cost N
times as many calls. Functions of one variable (``composed``) are expanded by balls.
"""

from __future__ import annotations

import bisect
import math
import operator
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
from flint import arb

from certbound.checker.expressions import Undecided
from certbound.checker.report import FUNCTION, Budget, unlimited

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Index = npt.NDArray[np.intp]
Series = list[arb]

_UNIT = 2.0**-52
_UP = 1 + 2.0**-40
_TINY = 1e-300
_PAIR_BYTES, _PAIR_WORK = 150, 1_500
"""Memory and units of work of a product of monomials that is kept."""
_MOST_KEPT = 100_000
"""Products of monomials of a table that serves later checks too."""
_TABLE = 2_000_000
"""Numbers of a table of Bernstein coefficients that is made at once."""


@dataclass(frozen=True, eq=False)
class Terms:
    """The monomials of a total degree in some variables, and of each the products (j, k) with others that are kept."""

    variables: int
    degree: int
    exponents: tuple[tuple[int, ...], ...]
    kept: tuple[tuple[tuple[int, int], ...], ...]
    totals: tuple[int, ...]
    budget: Budget

    def numbers(self, boxes: int) -> int:
        """Coefficients of a batch of so many boxes."""
        return len(self.exponents) * boxes


def terms(variables: int, degree: int, budget: Budget | None = None) -> Terms:
    """The monomials up to a total degree; the constant is the first, then come the variables themselves.

    What is done with batches of them counts in the ``budget``.

    Examples
    --------
    >>> terms(2, 2).exponents
    ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    """
    limits = unlimited() if budget is None else budget

    def make() -> Terms:
        pairs = math.comb(2 * variables + degree, degree)
        limits.spend(pairs * _PAIR_WORK)
        limits.take(pairs * _PAIR_BYTES)
        table = (_kept_table if pairs <= _MOST_KEPT else _table)(variables, degree)
        return Terms(variables, degree, *table, limits)

    return limits.once(Terms, (variables, degree), make)


_Table = tuple[tuple[tuple[int, ...], ...], tuple[tuple[tuple[int, int], ...], ...], tuple[int, ...]]


def _monomials(variables: int, total: int) -> Iterator[tuple[int, ...]]:
    """The exponents of one total degree, high powers of the first variables first."""
    if variables == 1:
        yield (total,)
        return
    for power in range(total, -1, -1):
        for rest in _monomials(variables - 1, total - power):
            yield power, *rest


def _table(variables: int, degree: int) -> _Table:
    exponents = tuple(a for total in range(degree + 1) for a in _monomials(variables, total))
    place = {a: k for k, a in enumerate(exponents)}
    totals = tuple(sum(a) for a in exponents)
    kept = []
    for a, total in zip(exponents, totals):
        others = exponents[: bisect.bisect_right(totals, degree - total)]
        kept.append(tuple((j, place[tuple(map(operator.add, a, b))]) for j, b in enumerate(others)))
    return exponents, tuple(kept), totals


_kept_table = lru_cache(maxsize=16)(_table)


@dataclass(frozen=True, eq=False)
class Batch:
    """Taylor models of one function on N boxes: ``coefficients`` of shape (terms, N), ``error`` of shape (N,)."""

    terms: Terms
    coefficients: Array
    error: Array

    @property
    def value(self) -> Array:
        """The constant terms."""
        return np.asarray(self.coefficients[0])

    def sizes(self) -> Array:
        """Sums of the absolute coefficients of every total degree, shape (degree + 1, N)."""
        return self._parts()[1]

    def _parts(self) -> tuple[list[bool], Array]:
        """Which coefficients are not 0 everywhere, and the `sizes`."""
        which, boxes = self.terms, len(self.error)
        which.budget.floats(2 * which.numbers(boxes), len(which.exponents) + 2)
        present = np.any(self.coefficients, axis=1).tolist()
        found = np.zeros((self.terms.degree + 1, len(self.error)))
        for k, total in enumerate(self.terms.totals):
            if present[k]:
                found[total] += np.abs(self.coefficients[k])
        return present, found

    def times(self) -> Callable[[Batch], Batch]:
        """x -> x times this: `mul` by one factor again and again, which is looked at once."""
        which = self.terms
        yours, two = self._parts()
        right, rows = two.sum(axis=0), list(self.coefficients)

        def product(x: Batch) -> Batch:
            mine, one = (yours, two) if x is self else x._parts()
            boxes = len(x.error)
            pairs = min(sum(mine) * sum(yours), sum(len(which.kept[i]) for i, there in enumerate(mine) if there))
            numbers = (2 * pairs + which.degree**2) * boxes + 3 * which.numbers(boxes)
            which.budget.floats(numbers, pairs + which.degree + 15)
            coefficients = np.zeros_like(x.coefficients)
            into = list(coefficients)
            for i, own in enumerate(x.coefficients):
                if mine[i]:
                    for j, k in which.kept[i]:
                        if yours[j]:
                            into[k] += own * rows[j]
            lost = np.zeros_like(x.error)
            for a in range(1, which.degree + 1):
                for b in range(which.degree + 1 - a, which.degree + 1):
                    lost += one[a] * two[b]
            left = one.sum(axis=0)
            rounding = (len(which.exponents) + 2) * _UNIT * left * right
            error = lost + rounding + x.error * (right + self.error) + self.error * left + _TINY
            return known(Batch(which, coefficients, error * _UP))

        return product

    def reach(self) -> Array:
        """At least the distance of every value from the constant term."""
        return np.asarray((self.sizes()[1:].sum(axis=0) + self.error) * _UP)

    def ends(self) -> tuple[Array, Array]:
        """Bounds of all values."""
        reach = self.reach()
        slack = (np.abs(self.value) + reach) * 2 * _UNIT
        return self.value - reach - slack, self.value + reach + slack

    def sharp_ends(self) -> tuple[Array, Array]:
        """Bounds of all values from the Bernstein coefficients, between which a polynomial lies."""
        which, boxes = self.terms, len(self.error)
        most = max(1, _TABLE // (which.degree + 1) ** which.variables)
        if boxes <= most:
            return self._sharp_ends()
        parts = [self.take(slice(k, k + most))._sharp_ends() for k in range(0, boxes, most)]
        low, high = (np.concatenate(ends) for ends in zip(*parts))
        return low, high

    def _sharp_ends(self) -> tuple[Array, Array]:
        which, count = self.terms, self.terms.degree + 1
        size = count**which.variables * len(self.error)
        which.budget.fits(24 * size)
        which.budget.floats(size * which.variables * (count // 2 + 2), len(which.exponents) + 10 * which.variables)
        table = np.zeros((count,) * which.variables + self.error.shape)
        for exponents, row in zip(which.exponents, self.coefficients):
            table[exponents] = row
        matrix = bernstein(count - 1)
        for axis in range(which.variables):
            table = np.moveaxis(np.tensordot(matrix, table, axes=([1], [axis])), 0, axis)
        rows = table.reshape(-1, len(self.error))
        least, most = rows.min(axis=0), rows.max(axis=0)  # what is no number stays none
        size = np.abs(self.coefficients).sum(axis=0)  # the matrices' entries are at most 1
        slack = (self.error + which.variables * (count + 4) * _UNIT * size + _TINY) * _UP
        low, high = self.ends()
        return np.maximum(low, least - slack), np.minimum(high, most + slack)

    def take(self, places: Any) -> Batch:
        """Some of the boxes."""
        self.terms.budget.floats(self.coefficients.size)
        return Batch(self.terms, self.coefficients[:, places], self.error[places])


@lru_cache(maxsize=32)
def bernstein(degree: int) -> Array:
    """From powers of xi = 2 s - 1 in [-1, 1] to Bernstein coefficients, entries rounded once."""
    rows = []
    for j in range(degree + 1):
        row = []
        for k in range(degree + 1):
            found = (math.comb(k, i) * 2**i * (-1) ** (k - i) * Fraction(math.comb(j, i), math.comb(degree, i))
                     for i in range(min(j, k) + 1))  # fmt: skip
            row.append(float(sum(found, Fraction(0))))
        rows.append(row)
    return np.array(rows)


def joined(parts: list[Batch]) -> Batch:
    """The boxes of several batches."""
    size = sum(part.coefficients.size for part in parts)
    parts[0].terms.budget.fits(8 * size)
    parts[0].terms.budget.floats(size, len(parts))
    return Batch(
        parts[0].terms, np.concatenate([part.coefficients for part in parts], axis=1),
        np.concatenate([part.error for part in parts]),
    )  # fmt: skip


def fixed(which: Terms, value: Array, error: Array | float = 0.0) -> Batch:
    """Constants, each known up to an error."""
    which.budget.fits(8 * which.numbers(len(value)))
    which.budget.floats(which.numbers(len(value)), 3)
    coefficients = np.zeros((len(which.exponents), len(value)))
    coefficients[0] = value
    return Batch(which, coefficients, np.broadcast_to(np.asarray(error, dtype=float), value.shape))


def variable(which: Terms, number: int, low: Array, high: Array) -> Batch:
    """x = (low + high)/2 + xi (high - low)/2 for one of the variables xi: all of [low, high]."""
    found = fixed(which, low / 2 + high / 2)
    found.coefficients[1 + number] = high / 2 - low / 2
    exact = (low == high) & (found.value == low)
    return Batch(which, found.coefficients, np.where(exact, 0.0, (np.abs(low) + np.abs(high)) * 2 * _UNIT + _TINY))


def unknown(like: Batch) -> Batch:
    """Nothing."""
    like.terms.budget.floats(like.coefficients.size)
    return Batch(like.terms, np.zeros_like(like.coefficients), np.full(like.error.shape, np.inf))


def chosen(where: Mask, x: Batch, y: Batch) -> Batch:
    """x where the mask holds, else y."""
    x.terms.budget.floats(2 * x.coefficients.size)
    return Batch(
        x.terms, np.where(where, x.coefficients, y.coefficients), np.where(where, x.error, y.error)
    )


def known(x: Batch) -> Batch:
    """The batch, with everything unknown where a coefficient or the error is no finite number."""
    good = np.isfinite(x.error) & np.isfinite(x.coefficients).all(axis=0)
    if good.all():
        return x
    return Batch(x.terms, np.where(good, x.coefficients, 0.0), np.where(good, x.error, np.inf))


def neg(x: Batch) -> Batch:
    """-x."""
    x.terms.budget.floats(x.coefficients.size)
    return Batch(x.terms, -x.coefficients, x.error)


def add(x: Batch, y: Batch) -> Batch:
    """x + y."""
    x.terms.budget.floats(4 * x.coefficients.size, 8)
    coefficients = x.coefficients + y.coefficients
    error = x.error + y.error + np.abs(coefficients).sum(axis=0) * _UNIT
    return known(Batch(x.terms, coefficients, error * _UP))


def sub(x: Batch, y: Batch) -> Batch:
    """x - y."""
    return add(x, neg(y))


def scaled(x: Batch, factor: Array | float, off: Array | float = 0.0) -> Batch:
    """x times real numbers that differ from the floats ``factor`` by at most ``off``."""
    x.terms.budget.floats(5 * x.coefficients.size, 10)
    size = np.abs(x.coefficients).sum(axis=0)
    coefficients = x.coefficients * factor
    error = x.error * (np.abs(factor) + off) + size * off + np.abs(coefficients).sum(axis=0) * _UNIT + _TINY
    return known(Batch(x.terms, coefficients, error * _UP))


def mul(x: Batch, y: Batch) -> Batch:
    """x y, without the terms beyond the degree, which lie in the error."""
    return y.times()(x)


def composed(x: Batch, function: Callable[[Series], Series]) -> Batch:
    """phi(x) for a smooth phi, by Taylor's formula about the constant term, with Lagrange's remainder.

    ``function`` maps the Taylor coefficients of an argument to those of phi of it, in balls.
    """
    order = x.terms.degree
    reach = np.where(np.isfinite(x.error), x.reach(), np.inf)
    x.terms.budget.floats(60 * len(reach), 200)
    pairs, back = np.unique(np.stack([x.value, reach], axis=1), axis=0, return_inverse=True)
    x.terms.budget.balls(len(pairs) * (order + 2) ** 2 * 8)
    x.terms.budget.balls(len(pairs) * (order + 8), FUNCTION)
    x.terms.budget.fits(len(pairs) * (order + 2) * 100)
    table = np.array([_expanded(function, float(v), float(r), order) for v, r in pairs]).reshape(-1, order + 2)
    found = table[back.reshape(-1)].T
    rest = Batch(x.terms, np.concatenate([np.zeros((1, len(reach))), x.coefficients[1:]]), x.error)
    total, times = fixed(x.terms, found[order]), rest.times()
    for k in reversed(range(order)):
        total = add(times(total), fixed(x.terms, found[k]))
    return known(Batch(x.terms, total.coefficients, (total.error + found[order + 1]) * _UP))


def _expanded(function: Callable[[Series], Series], value: float, reach: float, order: int) -> list[float]:
    """Taylor coefficients at a point, and what the polynomial through them misses within the reach."""
    nothing = [0.0] * (order + 1) + [np.inf]
    if not np.isfinite(reach):
        return nothing
    here, around = arb(value), arb(value, reach)
    try:
        near = function([here, arb(1), *[arb(0)] * (order - 1)])
        wide = function([around, arb(1), *[arb(0)] * order])[order + 1]
    except Undecided:
        return nothing
    size = arb(reach)
    off = abs(wide) * size ** (order + 1)
    for k, ball in enumerate(near):
        off += abs(ball - arb(float(ball.mid()))) * size**k
    if not (off.is_finite() and all(ball.is_finite() for ball in near)):
        return nothing
    return [*(float(ball.mid()) for ball in near), above(off)]


def above(ball: arb) -> float:
    """A float that is at least every number in a ball; inf where there is none."""
    top = float(ball.upper()) if ball.is_finite() else np.inf
    return float(np.nextafter(top, np.inf))


def below(ball: arb) -> float:
    """A float that is at most every number in a ball."""
    return -above(-ball)
