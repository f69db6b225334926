"""The rate of leaving an interval, from both sides, by functions of the state alone.

Let L v = f v' + a v''/2 with a = g^2 >= 0. Where v <= 0 at the ends and L v >= -k v for every disturbance, e^{kt} v(X)
is a submartingale until the exit, so that P(not left before T) >= e^{-kT} v(x)/sup v for every T at once. Where p > 0
on all of [low, high] and L p <= -k p, P(not left before T) <= e^{-kT} p(x)/min p. v is the first eigenfunction of L
less a little of m with L m = -1 (so that L v > 0 at the ends, where v vanishes), p that of a slightly longer interval.

Both are polynomials by collocation, their coefficients are numbers from there on, and L v is enclosed over small
cells: v' and v'' at their middles with what is rounded, elsewhere by a bound of the next derivative (|T_k^(j)| is
largest at 1).
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from flint import arb, arb_poly, fmpq, fmpq_poly
from numpy.polynomial import chebyshev

from certbound.arrays import Array
from certbound.problem.model import Tape, compile_numpy
from certbound.problem.problem import Problem
from certbound.rigor import rounding
from certbound.rigor.balls import lower, precision, upper
from certbound.rigor.intervals import Interval
from certbound.values.continuous.line.stationary.mean_time import limits_of, squared_of
from certbound.values.enclosing import enclose

_DEGREE = 28
_CELLS = 2**14
_LESS = (1e-3, 1e-2, 0.1)  # of m, in units of what the rate may grow by
_LONGER = (0.001, 0.003, 0.01, 0.03)  # of the interval, at both ends
_SLACK = 1 + 1e-9


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Eigen:
    """A function over an interval by its Chebyshev coefficients, its rate, and what it was read to be.

    ``start`` bounds it over the starts, ``extreme`` over the interval: v >= start and v <= extreme, or p <= start and
    p >= extreme.
    """

    ends: tuple[float, float]
    coefficients: Array
    rate: float
    start: float
    extreme: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Rate:
    """1 - share[1] e^{-rate[0] T} <= P(leaving before T) <= 1 - share[0] e^{-rate[1] T} for every T.

    From every start, under every disturbance; the first share may exceed 1. ``rate[0]`` is 0 where nothing is proved.
    ``slow`` and ``fast`` are v and p.
    """

    rate: tuple[float, float]
    share: tuple[float, float]
    slow: Eigen
    fast: Eigen | None

    def before(self, time: float) -> tuple[float, float]:
        """Bounds of the probability of leaving before a time, which may be infinite."""
        with precision():
            if np.isinf(time):
                return (1.0 if self.rate[0] > 0 else 0.0), 1.0
            still = [arb(share) * (-arb(rate) * arb(time)).exp() for share, rate in zip(self.share, self.rate[::-1])]
            return max(lower(1 - still[1]), 0.0) if self.rate[0] > 0 else 0.0, min(upper(1 - still[0]), 1.0)


def bound_rate(problem: Problem) -> Rate | None:
    """How fast paths leave, for every horizon at once; None where nothing is proved.

    One state in continuous time, a model without t, and an interval that stays.
    """
    ends, square = limits_of(problem), squared_of(problem)
    if ends is None or square is None or not np.isfinite(ends).all():
        return None
    cells, degree = _Cells(problem, square, *ends, _CELLS), _DEGREE
    slow = [_slow(problem, square, cells, degree, less) for less in _LESS]
    above = min((found for found in slow if found is not None), default=None, key=lambda one: one.rate)
    if above is None:
        return None
    fast = [_fast(problem, square, cells, degree, more) for more in _LONGER]
    below = max((found for found in fast if found is not None), default=None, key=lambda one: one.rate)
    shares = above.start / above.extreme / _SLACK, 1.0 if below is None else below.start / below.extreme * _SLACK
    return Rate(rate=(0.0 if below is None else below.rate, above.rate), share=shares, slow=above, fast=below)


def _slow(problem: Problem, square: Tape, cells: _Cells, degree: int, less: float) -> Eigen | None:
    """A rate that is at least as large as the true one, and v."""
    m = _proposal(problem, square, cells.low, cells.high, degree)
    found = _eigenfunction(problem, square, cells.low, cells.high, degree)
    if m is None or found is None:
        return None
    rate, psi = found
    v = psi - less * rate * m
    with precision():
        ends = [upper(arb_poly(_polynomial(v))(arb(end))) for end in (-1, 1)]
    v[0] = np.nextafter(v[0] - max(*ends, 0.0), -np.inf)
    drift, size = cells.moved(v), cells.values(v)
    inside = size.lo > 0
    needed = float(np.max(np.where(inside, -drift.lo / np.where(inside, size.lo, 1.0), 0.0))) * _SLACK
    if not 0 < needed < 10 * rate or np.any(drift.lo[~inside] + needed * size.lo[~inside] * _SLACK < 0):
        return None
    least, _ = _over_starts(problem, cells.low, cells.high, v)
    if not least > 0:
        return None
    return Eigen(
        ends=(cells.low, cells.high), coefficients=v, rate=needed, start=least, extreme=float(np.max(size.hi))
    )


def _fast(problem: Problem, square: Tape, cells: _Cells, degree: int, more: float) -> Eigen | None:
    """A rate that is at most as large as the true one, and p."""
    wide = more * (cells.high - cells.low)
    found = _eigenfunction(problem, square, cells.low - wide, cells.high + wide, degree)
    if found is None:
        return None
    y = np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    values = chebyshev.chebval(y / (1 + 2 * more), found[1])
    p = np.asarray(np.linalg.solve(chebyshev.chebvander(y, degree), values), dtype=np.float64)
    drift, size = cells.moved(p), cells.values(p)
    if not np.all(size.lo > 0):
        return None
    rate = float(np.min(-drift.hi / np.where(drift.hi < 0, size.hi, size.lo))) / _SLACK
    _, most = _over_starts(problem, cells.low, cells.high, p)
    if not rate > 0:
        return None
    return Eigen(
        ends=(cells.low, cells.high), coefficients=p, rate=rate, start=most, extreme=float(np.min(size.lo))
    )


def _eigenfunction(problem: Problem, square: Tape, low: float, high: float, degree: int) -> tuple[float, Array] | None:
    """The first eigenvalue k of L v = -k v with v = 0 at the ends, and v with the largest value 1, in floats."""
    import scipy.linalg

    rows = _collocation(problem, square, low, high, degree)
    if rows is None:
        return None
    inner, ends, y = rows
    left = np.vstack([inner, ends])
    right = np.vstack([-chebyshev.chebvander(y, degree), np.zeros((2, degree + 1))])
    with np.errstate(all="ignore"):
        values, vectors = scipy.linalg.eig(left, right)
    good = np.isfinite(values) & (np.abs(values.imag) < 1e-6 * np.abs(values.real)) & (values.real > 0)
    if not good.any():
        return None
    place = int(np.argmin(np.where(good, values.real, np.inf)))
    v = np.real(vectors[:, place])
    shape = chebyshev.chebval(np.linspace(-1, 1, 201), v)
    largest = shape[np.argmax(np.abs(shape))]
    return (float(values.real[place]), v / largest) if largest != 0 else None


def _proposal(problem: Problem, square: Tape, low: float, high: float, degree: int) -> Array | None:
    """Chebyshev coefficients over [low, high] of a near solution of L m = -1 that vanishes at the ends."""
    rows = _collocation(problem, square, low, high, degree)
    if rows is None:
        return None
    inner, ends, _ = rows
    found = np.linalg.lstsq(np.vstack([inner, ends]), np.concatenate([-np.ones(len(inner)), [0.0, 0.0]]), rcond=None)[0]
    return found if np.isfinite(found).all() else None


def _collocation(
    problem: Problem, square: Tape, low: float, high: float, degree: int
) -> tuple[Array, Array, Array] | None:
    """L T_k at points inside, T_k at the two ends, and the points in [-1, 1]; disturbances in their middle."""
    middle, half = (low + high) / 2, (high - low) / 2
    y = np.cos(np.pi * np.arange(1, degree) / degree)
    x, box = middle + half * y, problem.system.disturbance
    pushes = [] if box is None else [np.full(x.shape, value) for value in (box.low + box.high) / 2]
    with np.errstate(all="ignore"):
        f = np.broadcast_to(compile_numpy(problem.closed_loop)(np.zeros_like(x), x, *pushes)[..., 0], x.shape)
        a = np.broadcast_to(compile_numpy(square)(np.zeros_like(x), x)[..., 0, 0], x.shape)
        eye = np.eye(degree + 1)
        once, twice = (chebyshev.chebval(y, chebyshev.chebder(eye, order)).T for order in (1, 2))
        inner = f[:, None] * once / half + a[:, None] / 2 * twice / half**2
    return (inner, chebyshev.chebvander(np.array([-1.0, 1.0]), degree), y) if np.isfinite(inner).all() else None


class _Cells:
    """Enclosures of f and a over equal cells of the interval, once for all polynomials; y in [-1, 1] is the place."""

    def __init__(self, problem: Problem, square: Tape, low: float, high: float, count: int) -> None:
        box = problem.system.disturbance
        self.low, self.high, self.count = low, high, count
        y = 2.0 * np.arange(count + 1) / count - 1.0  # exact: the number of cells is a power of 2
        ends = Interval.point(low), Interval.point(high)
        self.half = (ends[1] - ends[0]) * Interval.point(0.5)
        x = ends[0] + (Interval(y[:-1], y[1:]) + Interval.point(1.0)) * self.half
        self.middles = (y[:-1] + y[1:]) / 2
        sides = [] if box is None else zip(box.low, box.high)
        pushes = [Interval(np.full(count, a), np.full(count, b)) for a, b in sides]
        time = Interval.point(np.zeros(count))
        self.f = enclose(problem.closed_loop, [time, x, *pushes])[0][0]
        self.a = enclose(square, [time, x])[0][0]

    def moved(self, coefficients: Array) -> Interval:
        """Ranges of L m over the cells, for every disturbance."""
        first = _derivative([Fraction(value) for value in coefficients.tolist()])
        slope = self._over(first, _largest(coefficients, 3)) / self.half
        bend = self._over(_derivative(first), _largest(coefficients, 4)) / (self.half * self.half)
        return self.f * slope + self.a * bend * Interval.point(0.5)

    def values(self, coefficients: Array) -> Interval:
        """Ranges of m itself."""
        return self._over([Fraction(value) for value in coefficients.tolist()], _largest(coefficients, 2))

    def _over(self, coefficients: list[Fraction], bend: float) -> Interval:
        """Ranges over the cells, from values and slopes at their middles and a bound of the second derivative."""
        value, error = _summed(coefficients, self.middles)
        slope, more = _summed(_derivative(coefficients), self.middles)
        half = 1.0 / self.count  # a power of 2: nothing is rounded where it multiplies
        with np.errstate(all="ignore"):
            room = rounding.upper(
                error + half * (np.abs(slope) + more + half / 2 * bend), step=4 * rounding.STEP, tiny=rounding.TINY
            )
            low, high = rounding.lower(value - room), rounding.upper(value + room)
            known = np.isfinite(value) & np.isfinite(room)
        return Interval(np.where(known, low, -np.inf), np.where(known, high, np.inf))


def _summed(coefficients: list[Fraction], y: Array) -> tuple[Array, Array]:
    """sum c_k T_k at places in [-1, 1] by Clenshaw's recurrence, and a bound of its error.

    b_k = 2 y b_(k+1) - b_(k+2) + c_k is linear: what is computed is the exact sum for coefficients c_k + e_k, where e_k
    is what is rounded in the line of b_k (or what c_k is off as a float), and |T_k(y)| <= 1. Twice the unit that three
    operations are rounded by covers the rounding of the errors' own sum.
    """
    floats = [float(value) for value in coefficients]
    off = sum((abs(value - Fraction(number)) for value, number in zip(coefficients, floats)), Fraction(0))
    now, before, rounded = np.zeros_like(y), np.zeros_like(y), np.zeros_like(y)
    with np.errstate(all="ignore"):
        for k in range(len(floats) - 1, -1, -1):
            product = (2 * y if k else y) * now
            difference = product - before
            before, now = now, difference + floats[k]
            rounded += np.abs(product) + np.abs(difference) + np.abs(now)
        tiny = len(floats) * rounding.TINY + np.nextafter(float(off), np.inf)
        return now, rounding.upper(rounding.STEP * rounded + tiny, tiny=rounding.TINY)


def _derivative(coefficients: list[Fraction]) -> list[Fraction]:
    """The Chebyshev coefficients of the derivative, exactly: c'_(k-1) = c'_(k+1) + 2 k c_k, c'_0 half of it."""
    found = [Fraction(0)] * (len(coefficients) + 1)
    for k in range(len(coefficients) - 1, 0, -1):
        found[k - 1] = found[k + 1] + 2 * k * coefficients[k]
    return [found[0] / 2, *found[1 : max(len(coefficients) - 1, 1)]]


def _polynomial(coefficients: Array) -> fmpq_poly:
    """The polynomial of y with these Chebyshev coefficients, exactly."""
    before, now, y = fmpq_poly([1]), fmpq_poly([0, 1]), fmpq_poly([0, 1])
    total = fmpq_poly([0])
    for value in coefficients.tolist():
        share = Fraction(value)
        total += before * fmpq(share.numerator, share.denominator)
        before, now = now, 2 * y * now - before
    return total


def _largest(coefficients: Array, order: int) -> float:
    """A bound of the derivative of an order over [-1, 1]: of T_k it is prod (k^2 - i^2)/(2 i + 1) over i < order."""
    total = Fraction(0)
    for k, value in enumerate(coefficients.tolist()):
        size = abs(Fraction(value))
        for i in range(order):
            size *= Fraction(max(k * k - i * i, 0), 2 * i + 1)
        total += size
    return float(np.nextafter(float(total), np.inf))


def _over_starts(problem: Problem, low: float, high: float, coefficients: Array) -> tuple[float, float]:
    """Bounds of a polynomial over the starts; nothing where they leave the interval."""
    around, whole = problem.initial.hull(), Fraction(high) - Fraction(low)
    first, last = (2 * (Fraction(float(end)) - Fraction(low)) / whole - 1 for end in (around.lo[0], around.hi[0]))
    if first < -1 or last > 1:
        return -np.inf, np.inf
    half = float(np.nextafter(float(last - first) / 2, np.inf)) if last > first else 0.0
    with precision():
        middle = arb_poly(_polynomial(coefficients))(_ball((first + last) / 2))
        room = arb(half) * arb(_largest(coefficients, 1))
        return lower(middle - room), upper(middle + room)


def _ball(value: Fraction) -> arb:
    return arb(fmpq(value.numerator, value.denominator))
