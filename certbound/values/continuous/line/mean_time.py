"""The mean time of leaving an interval, from above and below, by one function of the state (Dynkin's formula).

Let L m = f m' + a m''/2 with a = g^2 >= 0, m twice continuously differentiable on [low, high]. Where m >= 0 at the ends
and L m <= -(1 - e) < 0 for every disturbance, E tau <= m/(1 - e): m has no minimum inside, as L m >= 0 there. Where
m <= 0 at the ends and L m >= -(1 + e), E tau >= m/(1 + e).

m is a polynomial that nearly solves L m = -1 (collocation), its coefficients are numbers from there on, and L m is
enclosed over small cells: m' and m'' at their middles in balls, elsewhere by a bound of the next derivative
(|T_k^(j)| is largest at 1).
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from flint import arb, arb_poly, fmpq, fmpq_poly
from numpy.polynomial import chebyshev

from certbound.arrays import Array
from certbound.problem.model import Tape, compile_numpy, sources
from certbound.problem.problem import Problem
from certbound.problem.systems import ContinuousSystem
from certbound.rigor.balls import lower, precision, upper
from certbound.rigor.intervals import Interval
from certbound.values.continuous.coefficients import enclose, squared_diffusion

_DEGREES = (16, 28, 44)
_CELLS = (2**12, 2**15)
_GOOD = 2e-3
_MOST = 0.5


def bound_mean_time(problem: Problem) -> tuple[float, float | None] | None:
    """Bounds of the mean time of leaving from every start, under every disturbance; None where nothing is proved.

    One state in continuous time, a model without t, and an interval that stays; the upper bound is None where only the
    lower one is proved. An EnclosureError where the model is undefined somewhere in the interval.
    """
    ends = _interval(problem)
    if ends is None or not isinstance(problem.system, ContinuousSystem):
        return None
    square = squared_diffusion(problem.system.diffusion, problem.system.states)
    if any(0 in slots for tape in (problem.closed_loop, square) for slots in sources(tape)):
        return None
    best: tuple[float, Array] | None = None
    tried = [found for degree in _DEGREES if (found := _proposal(problem, square, *ends, degree)) is not None]
    for count in _CELLS:
        cells = _Cells(problem, square, *ends, count)
        for coefficients in tried:
            error = cells.error(coefficients)
            if best is None or error < best[0]:
                best = error, coefficients
            if error < _GOOD:
                return _bounds(problem, *ends, *best)
    if best is None or not best[0] < _MOST:
        return None
    return _bounds(problem, *ends, *best)


def _interval(problem: Problem) -> tuple[float, float] | None:
    """The ends of the safe interval, where it is one that is exactly known."""
    low, high = -np.inf, np.inf
    for constraint in problem.constraints:
        if constraint.outside or constraint.region.moving:
            return None
        normals, bounds = constraint.region.halfspaces()
        centre = float(np.ravel(constraint.region.center_at())[0]) if constraint.region.center is not None else 0.0
        if centre != 0.0 or not np.all(np.abs(normals) == 1.0):
            return None
        for normal, bound in zip(normals.ravel().tolist(), bounds.tolist()):
            low, high = (low, min(high, bound)) if normal > 0 else (max(low, -bound), high)
    return (low, high) if np.isfinite([low, high]).all() and low < high else None


def _proposal(problem: Problem, square: Tape, low: float, high: float, degree: int) -> Array | None:
    """Chebyshev coefficients over [low, high] of a near solution of L m = -1 that vanishes at the ends."""
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
        rows = np.vstack([inner, chebyshev.chebvander(np.array([-1.0, 1.0]), degree)])
        if not np.isfinite(rows).all():
            return None
        found = np.linalg.lstsq(rows, np.concatenate([-np.ones(len(x)), [0.0, 0.0]]), rcond=None)[0]
    return found if np.isfinite(found).all() else None


class _Cells:
    """Enclosures of f and a over equal cells of the interval, once for all polynomials; y in [-1, 1] is the place."""

    def __init__(self, problem: Problem, square: Tape, low: float, high: float, count: int) -> None:
        box = problem.system.disturbance
        self.count = count
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

    def error(self, coefficients: Array) -> float:
        """An upper bound of |L m + 1| over the whole interval."""
        first = _polynomial(coefficients).derivative()
        slope = self._over(first, _largest(coefficients, 2)) / self.half
        bend = self._over(first.derivative(), _largest(coefficients, 3)) / (self.half * self.half)
        residual = self.f * slope + self.a * bend * Interval.point(0.5) + Interval.point(1.0)
        return float(np.max(residual.mag))

    def _over(self, function: fmpq_poly, steepest: float) -> Interval:
        """Ranges over the cells, from the values at their middles and the largest slope."""
        with precision():
            values = [arb_poly(function)(arb(middle)) for middle in self.middles.tolist()]
            found = Interval(np.array([lower(value) for value in values]), np.array([upper(value) for value in values]))
        width = Interval.point(steepest) * Interval.point(1.0 / self.count)
        return found + width * Interval(-1.0, 1.0)


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


def _bounds(problem: Problem, low: float, high: float, error: float, coefficients: Array) -> tuple[float, float | None]:
    """m over the starts, lifted to what it has to be at the ends, by what L m may miss -1."""
    m = _polynomial(coefficients)
    around, whole = problem.initial.hull(), Fraction(high) - Fraction(low)
    first, last = (2 * (Fraction(float(end)) - Fraction(low)) / whole - 1 for end in (around.lo[0], around.hi[0]))
    if first < -1 or last > 1:
        return 0.0, None
    half = float(np.nextafter(float(last - first) / 2, np.inf))
    with precision():
        ends = [arb_poly(m)(arb(end)) for end in (-1, 1)]
        middle = arb_poly(m)(_ball((first + last) / 2))
        room = arb(half) * arb(_largest(coefficients, 1))
        least = (middle - room - ends[0].max(ends[1])) / (1 + arb(error))
        most = (middle + room - ends[0].min(ends[1])) / (1 - arb(error))
        return max(lower(least), 0.0), upper(most)


def _ball(value: Fraction) -> arb:
    return arb(fmpq(value.numerator, value.denominator))
