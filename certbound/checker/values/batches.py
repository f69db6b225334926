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
import itertools
import math
import operator
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
from flint import arb

from certbound.checker.expressions import Undecided

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Index = npt.NDArray[np.intp]
Series = list[arb]

_UNIT = 2.0**-52
_UP = 1 + 2.0**-40
_TINY = 1e-300


@dataclass(frozen=True, eq=False)
class Terms:
    """The monomials of a total degree in some variables, and of each the products (j, k) with others that are kept."""

    variables: int
    degree: int
    exponents: tuple[tuple[int, ...], ...]
    kept: tuple[tuple[tuple[int, int], ...], ...]
    totals: tuple[int, ...]


@lru_cache(maxsize=16)
def terms(variables: int, degree: int) -> Terms:
    """The monomials up to a total degree; the constant is the first, then come the variables themselves.

    Examples
    --------
    >>> terms(2, 2).exponents
    ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    """
    every = [a for a in itertools.product(range(degree + 1), repeat=variables) if sum(a) <= degree]
    exponents = tuple(sorted(every, key=lambda a: (sum(a), [-x for x in a])))
    place = {a: k for k, a in enumerate(exponents)}
    totals = tuple(sum(a) for a in exponents)
    kept = []
    for a, total in zip(exponents, totals):
        others = exponents[: bisect.bisect_right(totals, degree - total)]
        kept.append(tuple((j, place[tuple(map(operator.add, a, b))]) for j, b in enumerate(others)))
    return Terms(variables, degree, exponents, tuple(kept), totals)


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
        which, count = self.terms, self.terms.degree + 1
        table = np.zeros((count,) * which.variables + self.error.shape)
        for exponents, row in zip(which.exponents, self.coefficients):
            table[exponents] = row
        matrix = _to_bernstein(count - 1)
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
        return Batch(self.terms, self.coefficients[:, places], self.error[places])


@lru_cache(maxsize=32)
def _to_bernstein(degree: int) -> Array:
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
    return Batch(
        parts[0].terms, np.concatenate([part.coefficients for part in parts], axis=1),
        np.concatenate([part.error for part in parts]),
    )  # fmt: skip


def fixed(which: Terms, value: Array, error: Array | float = 0.0) -> Batch:
    """Constants, each known up to an error."""
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
    return Batch(like.terms, np.zeros_like(like.coefficients), np.full(like.error.shape, np.inf))


def chosen(where: Mask, x: Batch, y: Batch) -> Batch:
    """x where the mask holds, else y."""
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
    return Batch(x.terms, -x.coefficients, x.error)


def add(x: Batch, y: Batch) -> Batch:
    """x + y."""
    coefficients = x.coefficients + y.coefficients
    error = x.error + y.error + np.abs(coefficients).sum(axis=0) * _UNIT
    return known(Batch(x.terms, coefficients, error * _UP))


def sub(x: Batch, y: Batch) -> Batch:
    """x - y."""
    return add(x, neg(y))


def scaled(x: Batch, factor: Array | float, off: Array | float = 0.0) -> Batch:
    """x times real numbers that differ from the floats ``factor`` by at most ``off``."""
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
    pairs, back = np.unique(np.stack([x.value, reach], axis=1), axis=0, return_inverse=True)
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
