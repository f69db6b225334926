"""What a certificate by the backward equation states: v, quintic splines in space, cubic in time, and v on patches.

An axis has nodes z_0 < ... < z_N, six-fold at both ends; its splines have N + 5 coefficients and are C^4. At every
time t_k the file states the coefficients U_k of v and D_k of v_t, as whole numbers times a unit. On the slab
[t_k, t_{k+1}], of length h, v has the Bernstein coefficients in time

    b_0 = U_k,  b_1 = U_k + h D_k / 3,  b_2 = U_{k+1} - h D_{k+1} / 3,  b_3 = U_{k+1},

so that v is continuously differentiable in time at its ends too. A *patch* is a slab and one interval of every axis,
cut into 2^level equal parts. There every b_j is taken less its corner coefficient, whole numbers that subtract exactly:
what is rounded then is how v varies on a patch, at most ``size`` there, and not v. Blossoming leads from the
coefficients to those of Bernstein's form by averages with weights that are computed to a relative 2^-48, so that the
latter are off by at most ``ROUNDED`` of the size, and those of powers of xi in [-1, 1] by at most that times
binomial (5, k) an axis: the powers' coefficients of Bernstein's polynomials have binomial (5, k) as the sum of their
magnitudes.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache

import numpy as np

from certbound.checker.reading import Record, numbers, unpacked
from certbound.checker.report import Budget
from certbound.checker.values.batches import Array, Index
from certbound.errors import CertificateError

DEGREE = 5
ROUNDED = 2.0**-45
"""Relative error of a coefficient on a patch, in Bernstein's form against the size and as a power against binomials."""
MOST_NUMBERS = 4_000_000
_MOST = 2.0**50
"""Whole numbers up to which sums and differences of two are exact."""
_FAR = 2.0**200
"""Bounds of nodes, of the widths of cells and of units, within which nothing overflows or vanishes."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Splines:
    """v by its coefficients.

    Attributes
    ----------
    axes : tuple of ndarray, shapes (N_i + 1,)
    times : ndarray, shape (K + 1,)
    values, rates : ndarray, shape (K + 1, N_1 + 5, ...)
    """

    axes: tuple[Array, ...]
    times: Array
    values: Array
    rates: Array
    budget: Budget

    @property
    def cells(self) -> tuple[int, ...]:
        """Cells along the axes."""
        return tuple(len(axis) - 1 for axis in self.axes)

    @property
    def slabs(self) -> int:
        """K."""
        return len(self.times) - 1

    def face(self, axis: int, side: int) -> Splines:
        """v on the lower (0) or the upper (1) end of an axis, where its coefficients are the outermost ones."""
        values, rates = (np.take(part, -side, axis=axis + 1) for part in (self.values, self.rates))
        others = tuple(row for k, row in enumerate(self.axes) if k != axis)
        return Splines(axes=others, times=self.times, values=values, rates=rates, budget=self.budget)

    def at(self, index: int) -> Splines:
        """v at one of its times, as if it were so at all."""
        places = [index, index]
        return Splines(
            axes=self.axes, times=np.array([0.0, 1.0]), values=self.values[places],
            rates=np.zeros_like(self.rates[:2]), budget=self.budget,
        )  # fmt: skip

    def matrices(self, axis: int, level: int) -> Array:
        """From coefficients to Bernstein's form on each part of each cell, shape (6, 6, 2^level N): averages."""
        def make() -> Array:
            nodes, parts = self.axes[axis], 2**level
            self.budget.take(8 * 36 * parts * len(nodes))
            self.budget.fits(8 * 200 * parts * len(nodes))
            self.budget.floats(1500 * parts * len(nodes), 2000)
            whole = _blossomed(nodes)
            found = np.stack([np.einsum("jk,kmc->jmc", _part(level, part), whole) for part in range(parts)], axis=-1)
            return np.ascontiguousarray(found.reshape(DEGREE + 1, DEGREE + 1, -1))

        return self.budget.once(self.axes[axis], ("matrices", level), make)

    def patches(self, slab: Index, places: Sequence[Index], level: int) -> Patches:
        """P patches: the slab of each, and its interval of every axis, counted in parts of cells."""
        n, count = len(self.axes), len(slab)
        numbers = 4 * (DEGREE + 1) ** n * count
        self.budget.fits(8 * 5 * numbers)
        self.budget.floats(numbers * (6 + 7 * n), 60)
        window: list[Index] = []
        for axis, place in enumerate(places):
            steps = np.arange(DEGREE + 1).reshape([-1 if k == axis else 1 for k in range(n)] + [1])
            window.append((place >> level) + steps)
        early, late = ((slab + k, *window) for k in (0, 1))
        corner = (0,) * n
        given = [self.values[early], self.rates[early], self.rates[late], self.values[late]]
        first, start, end, last = (part[corner] for part in given)
        u, d, e, w = (part - part[corner] for part in given)
        step = self.times[slab + 1] - self.times[slab]
        d, e = d * (step / 3), e * (step / 3)
        size = np.maximum(_most(u) + _most(d), _most(w) + _most(e)) * (1 + 2.0**-40)
        local = np.stack([u, u + d, w - e, w])
        letters = "xyz"[:n]
        for axis, place in enumerate(places):
            out = letters.replace(letters[axis], "j")
            matrix = self.matrices(axis, level)[:, :, place]
            local = np.einsum(f"j{letters[axis]}p,b{letters}p->b{out}p", matrix, local)
        constants = np.stack([first, first + start * (step / 3), last - end * (step / 3), last])
        mean = 3 * (last - first) / step - start - end
        speeds = np.stack([start, (start + 2 * mean) / 3, (end + 2 * mean) / 3, end])
        off = 2.0**-48 * (3 * np.abs(last - first) / step + np.abs(start) + np.abs(end))
        half = [np.diff(axis)[place >> level] / 2 ** (level + 1) for axis, place in zip(self.axes, places)]
        return Patches(self, local, constants, speeds, off, size, step, tuple(half))


@dataclass(frozen=True, eq=False)
class Patches:
    """v on P patches.

    Attributes
    ----------
    local : ndarray, shape (4, 6, ..., 6, P)
        Bernstein coefficients, in time and space, of v less a number for each of those in time, off by at most
        ``ROUNDED`` times the size.
    constants, speeds : ndarray, shape (4, P)
        These numbers, and the coefficients of v_t that they alone make, off by at most ``off``.
    size : ndarray, shape (P,)
    step : ndarray, shape (P,)
    half : tuple of ndarray, shapes (P,)
        Half of every side, to a relative 2^-51.
    """

    whole: Splines
    local: Array
    constants: Array
    speeds: Array
    off: Array
    size: Array
    step: Array
    half: tuple[Array, ...]

    def lowest(self, axis: int | None = None, side: int = 0) -> Array:
        """At most v, everywhere on each patch, or on its side along an axis."""
        n = len(self.half)
        local = self.local if axis is None else self.local.take([-side], axis=axis + 1)
        least = local.min(axis=tuple(range(1, n + 1))) + self.constants
        return np.asarray(least.min(axis=0) - self._slack() * (1 + 2.0**-40))

    def most_above(self, other: Patches) -> Array:
        """At least v less another one, both at rest, on patches that are the same."""
        n = len(self.half)
        self.whole.budget.floats(3 * self.local[0].size, 20)
        most = (self.local[0] - other.local[0]).max(axis=tuple(range(n)))
        found = most + (self.constants[0] - other.constants[0])
        return np.asarray(found + (self._slack() + other._slack()) * (1 + 2.0**-40))

    def _slack(self) -> Array:
        """By how much a value is off, which is a sum of a few numbers of at most these sizes."""
        moved = np.abs(self.constants).max(axis=0) + self.step * np.abs(self.speeds).max(axis=0)
        return np.asarray(ROUNDED * self.size + 2.0**-48 * moved)

    def take(self, places: Index) -> Patches:
        """Some of the patches."""
        self.whole.budget.floats(self.local.size, 8)
        return Patches(
            self.whole, np.ascontiguousarray(self.local[..., places]), self.constants[:, places],
            self.speeds[:, places], self.off[places], self.size[places], self.step[places],
            tuple(row[places] for row in self.half),
        )  # fmt: skip

    def powers(self) -> Array:
        """Coefficients of the powers of xi instead, shape (4, 6, ..., 6, P)."""
        found, n = self.local, len(self.half)
        self.whole.budget.fits(16 * found.size)
        self.whole.budget.floats(3 * n * found.size, 2 * n)
        for axis in range(n):
            found = along(to_powers(), found, axis + 1)
        return found


def along(matrix: Array, table: Array, axis: int) -> Array:
    """A matrix along one axis of a contiguous array."""
    shape = table.shape
    flat = table.reshape(math.prod(shape[:axis]), shape[axis], -1)
    return np.asarray(np.matmul(matrix, flat).reshape(*shape[:axis], len(matrix), *shape[axis + 1 :]))


def read_splines(record: Record, dimension: int, budget: Budget) -> Splines:
    """The entries ``axes``, ``times``, ``units``, ``values`` and ``rates`` of a proof.

    CertificateError where an axis or the times do not rise, or the arrays are too long or of another size.
    """
    axes = tuple(np.array(numbers(row, f"{record.at('axes')}[{k}]", None))
                 for k, row in enumerate(record.items("axes", dimension, dimension)))  # fmt: skip
    times = np.array(record.array("times", None))
    for name, row in [("times", times), *(("axes", axis) for axis in axes)]:
        if len(row) < 2 or not (np.diff(row) > 1 / _FAR).all() or not (np.abs(row) < _FAR).all():
            raise CertificateError(f"`{record.at(name)}` must be two or more numbers of usual size that rise.")
    shape = (len(times), *(len(axis) - 1 + DEGREE for axis in axes))
    count = math.prod(shape)
    if count > MOST_NUMBERS:
        raise CertificateError(f"`{record.at('axes')}` and `times` must make at most {MOST_NUMBERS} coefficients.")
    units = record.array("units", 2)
    if not all(1 / _FAR < unit < _FAR and math.frexp(unit)[0] == 0.5 for unit in units):
        raise CertificateError(f"`{record.at('units')}` must be powers of two of usual size.")
    rows = []
    for name, unit in zip(("values", "rates"), units):
        found = np.frombuffer(unpacked(record[name], record.at(name), count, budget, whole=True)).reshape(shape)
        rows.append(_summed(found, record.at(name), budget) * unit)
    return Splines(axes=axes, times=times, values=rows[0], rates=rows[1], budget=budget)


def _summed(found: Array, path: str, budget: Budget) -> Array:
    """From second differences in time of differences along every axis: exact, as no sum on the way is too large."""
    budget.take(8 * found.size)
    for axis in (0, *range(found.ndim)):
        budget.fits(24 * found.size)
        budget.floats(4 * found.size, 3)
        found = np.cumsum(found, axis=axis)
        if not (np.abs(found) <= _MOST).all():
            raise CertificateError(f"`{path}` must be whole numbers below 2^50 throughout.")
    return found


def _most(table: Array) -> Array:
    return np.asarray(np.abs(table).max(axis=tuple(range(table.ndim - 1))))


def _blossomed(nodes: Array) -> Array:
    """Bernstein coefficients of degree 5 on every cell from the six coefficients there, shape (6, 6, N).

    De Boor's recursion with one of the ends of the cell at every stage: at each two weights, positive or 0, that are
    quotients of differences of knots. So every entry has a relative error of at most 30 roundings.
    """
    cells = len(nodes) - 1
    knots = np.concatenate([[nodes[0]] * DEGREE, nodes, [nodes[-1]] * DEGREE])
    first = np.arange(cells)
    found = np.empty((DEGREE + 1, DEGREE + 1, cells))
    for j in range(DEGREE + 1):
        rows = [np.where(np.arange(DEGREE + 1)[:, None] == i, 1.0, np.zeros(cells)) for i in range(DEGREE + 1)]
        for stage in range(1, DEGREE + 1):
            place = nodes[first + 1] if stage <= j else nodes[first]
            for i in range(DEGREE, stage - 1, -1):
                low, high = knots[first + i], knots[first + i + DEGREE + 1 - stage]
                width = high - low
                rows[i] = (high - place) / width * rows[i - 1] + (place - low) / width * rows[i]
        found[j] = rows[DEGREE]
    return found


@lru_cache(maxsize=64)
def _part(level: int, part: int) -> Array:
    """De Casteljau: Bernstein coefficients on one of 2^level equal parts from those on all of [0, 1]; rounded once."""
    low, high = Fraction(part, 2**level), Fraction(part + 1, 2**level)
    rows = []
    for j in range(DEGREE + 1):
        row = [Fraction(0)] * (DEGREE + 1)
        # the blossom at j times the upper end and 5 - j times the lower one: products of two Bernstein bases
        for i, k in itertools.product(range(j + 1), range(DEGREE + 1 - j)):
            row[i + k] += (math.comb(j, i) * high**i * (1 - high) ** (j - i)
                           * math.comb(DEGREE - j, k) * low**k * (1 - low) ** (DEGREE - j - k))  # fmt: skip
        rows.append([float(x) for x in row])
    return np.array(rows)


@lru_cache(maxsize=1)
def to_powers() -> Array:
    """From Bernstein coefficients of degree 5 to those of the powers of xi = 2 s - 1; exact."""
    rows = np.zeros((DEGREE + 1, DEGREE + 1))
    for j in range(DEGREE + 1):
        for i, k in itertools.product(range(j + 1), range(DEGREE + 1 - j)):
            sign = (-1) ** k
            rows[i + k, j] += sign * math.comb(DEGREE, j) * math.comb(j, i) * math.comb(DEGREE - j, k) / 2**DEGREE
    return rows
