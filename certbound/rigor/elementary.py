"""Elementary functions of intervals.

NumPy's functions are not correctly rounded: their results are widened by `LIBRARY_ULPS` units and then cut to
the function's range (sin and tanh to [-1, 1], exp to [0, inf)). An operation that is undefined somewhere on
its argument gives [-inf, inf]. Of an undecided jump a result encloses all values that the operation may take.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from certbound.arrays import Array, Mask
from certbound.rigor.arithmetic import Interval, power
from certbound.rigor.rounding import LIBRARY_ULPS, STEP, TINY, lower, quiet, upper

Function = Callable[[Any], Any]

MARGIN = LIBRARY_ULPS * STEP
PI_UP = float(np.nextafter(np.pi, 4.0))  # np.pi lies below pi
HALF_PI_UP = float(np.nextafter(np.pi / 2, 4.0))
SMALLEST = 5e-324
REDUCTION = 2.0**-60
FAR = 2.0**20  # beyond it the position within a period is not resolved: sin and cos become [-1, 1]


def _widen(lo: Array, hi: Array) -> Interval:
    return Interval._raw(lower(lo, step=MARGIN, tiny=TINY), upper(hi, step=MARGIN, tiny=TINY))


def _clip(x: Interval, least: float, largest: float) -> Interval:
    return Interval._raw(np.maximum(x.lo, least), np.minimum(x.hi, largest))


def _everything_where(mask: Mask, x: Interval) -> Interval:
    if not mask.any():
        return x
    return Interval._raw(np.where(mask, -np.inf, x.lo), np.where(mask, np.inf, x.hi))


def _rising(function: Function, x: Interval) -> Interval:
    """A rising function, evaluated at the ends (once for points)."""
    lo = function(x.lo)
    return _widen(lo, lo if x.hi is x.lo else function(x.hi))


def _signed(y: Interval, x: Interval) -> Interval:
    """Restore y >= 0 where x >= 0 and y <= 0 where x <= 0, for odd rising functions."""
    return Interval._raw(
        np.where(x.lo >= 0, np.maximum(y.lo, 0.0), y.lo), np.where(x.hi <= 0, np.minimum(y.hi, 0.0), y.hi)
    )


@quiet
def sq(x: Interval) -> Interval:
    """Square."""
    small, large = x.mig, x.mag
    hi = upper(large * large, tiny=TINY)
    if not np.all(large):
        hi = np.where(large == 0, 0.0, hi)
    return Interval._raw(np.maximum(lower(small * small, tiny=TINY), 0.0), hi)


@quiet
def sqrt(x: Interval) -> Interval:
    """Square root; undefined where x reaches below 0."""
    root = Interval._raw(lower(np.sqrt(np.maximum(x.lo, 0.0))), upper(np.sqrt(np.maximum(x.hi, 0.0))))
    return _everything_where(x.lo < 0, root)


@quiet
def exp(x: Interval) -> Interval:
    """Exponential."""
    return _clip(_rising(np.exp, x), 0.0, np.inf)


@quiet
def log(x: Interval) -> Interval:
    """Natural logarithm; undefined where x reaches 0."""
    inside = Interval._raw(np.maximum(x.lo, SMALLEST), np.maximum(x.hi, SMALLEST))
    return _everything_where(x.lo <= 0, _rising(np.log, inside))


@quiet
def sinh(x: Interval) -> Interval:
    """Hyperbolic sine."""
    return _signed(_rising(np.sinh, x), x)


@quiet
def cosh(x: Interval) -> Interval:
    """Hyperbolic cosine."""
    return _clip(_widen(np.cosh(x.mig), np.cosh(x.mag)), 1.0, np.inf)


@quiet
def tanh(x: Interval) -> Interval:
    """Hyperbolic tangent; [-1, 1] on the whole line."""
    return _clip(_signed(_rising(np.tanh, x), x), -1.0, 1.0)


@quiet
def atan(x: Interval) -> Interval:
    """Arc tangent."""
    return _clip(_signed(_rising(np.arctan, x), x), -HALF_PI_UP, HALF_PI_UP)


@quiet
def asin(x: Interval) -> Interval:
    """Arc sine; undefined where x leaves [-1, 1]."""
    inside = Interval._raw(np.clip(x.lo, -1.0, 1.0), np.clip(x.hi, -1.0, 1.0))
    angle = _clip(_signed(_rising(np.arcsin, inside), x), -HALF_PI_UP, HALF_PI_UP)
    return _everything_where(beyond_one(x), angle)


@quiet
def acos(x: Interval) -> Interval:
    """Arc cosine; undefined where x leaves [-1, 1]."""
    lo, hi = np.arccos(np.clip(x.hi, -1.0, 1.0)), np.arccos(np.clip(x.lo, -1.0, 1.0))
    return _everything_where(beyond_one(x), _clip(_widen(lo, hi), 0.0, PI_UP))


def _holds_multiple(x: Interval, period: float, shift: float) -> Mask:
    """May x contain (k + shift) * period for an integer k? Never a wrong no, for |x| <= FAR.

    The rounded quotient x / period - shift is off by at most 2^-50 (|quotient| + 1); period is pi or 2 pi,
    rounded.
    """
    first, last = x.lo / period - shift, x.hi / period - shift
    first = first - 2.0**-50 * (np.abs(first) + 1.0)
    last = last + 2.0**-50 * (np.abs(last) + 1.0)
    return np.asarray(np.ceil(first) <= np.floor(last))


def _wave(function: Function, x: Interval, shift: float) -> Interval:
    """sin or cos, whose maxima lie at (k + shift) 2 pi and whose minima half a period away.

    Beside the relative margin, 2^-60 min(|x|, 1) is granted for the reduction of the argument near the zeros.
    """
    lo = function(x.lo)
    hi = lo if x.hi is x.lo else function(x.hi)
    lo, hi = np.minimum(lo, hi), np.maximum(lo, hi)
    slack = np.minimum(x.mag, 1.0) * REDUCTION
    lo, hi = lower(lo, step=MARGIN, tiny=TINY) - slack, upper(hi, step=MARGIN, tiny=TINY) + slack
    far = (x.mag > FAR) | (x.hi - x.lo >= 6.5)
    hi = np.where(far | _holds_multiple(x, 2 * np.pi, shift), 1.0, np.minimum(hi, 1.0))
    lo = np.where(far | _holds_multiple(x, 2 * np.pi, shift + 0.5), -1.0, np.maximum(lo, -1.0))
    return Interval._raw(lo, hi)


@quiet
def sin(x: Interval) -> Interval:
    """Sine; [-1, 1] beyond 2^20."""
    y = _wave(np.sin, x, 0.25)
    small = x.mag <= 3.0
    return Interval._raw(
        np.where(small & (x.lo >= 0), np.maximum(y.lo, 0.0), y.lo),
        np.where(small & (x.hi <= 0), np.minimum(y.hi, 0.0), y.hi),
    )


@quiet
def cos(x: Interval) -> Interval:
    """Cosine; [-1, 1] beyond 2^20."""
    return _wave(np.cos, x, 0.0)


@quiet
def tan(x: Interval) -> Interval:
    """Tangent; undefined where x may hold a pole, and beyond 2^20."""
    return _everything_where(tan_undefined(x), _rising(np.tan, x))


@quiet
def atan2(y: Interval, x: Interval) -> Interval:
    """Angle of the points (x, y) in (-pi, pi]; undefined on boxes that touch the cut {y = 0, x <= 0}.

    Off the cut the smallest and the largest angle of a box are attained at corners.
    """
    x_lo, y_lo, x_hi, y_hi = np.broadcast_arrays(x.lo, y.lo, x.hi, y.hi)
    first_x = np.where(y_lo >= 0, x_hi, x_lo)
    first_y = np.where(first_x > 0, y_lo, y_hi)
    last_x = np.where(y_hi <= 0, x_hi, x_lo)
    last_y = np.where(last_x > 0, y_hi, y_lo)
    angle = _widen(np.arctan2(first_y, first_x), np.arctan2(last_y, last_x))
    return _everything_where(across_cut(y, x), _clip(angle, -PI_UP, PI_UP))


@quiet
def hypot(x: Interval, y: Interval) -> Interval:
    """sqrt(x^2 + y^2)."""
    least = np.maximum(x.mig, y.mig)
    large = np.hypot(x.mag, y.mag)
    hi = np.where(large == 0, 0.0, upper(large, step=MARGIN, tiny=TINY))
    return Interval._raw(np.maximum(lower(np.hypot(x.mig, y.mig), step=MARGIN, tiny=TINY), least), hi)


def abs_(x: Interval) -> Interval:
    """Absolute value."""
    return Interval._raw(x.mig, x.mag)


def minimum(x: Interval, y: Interval) -> Interval:
    """Smaller of two."""
    return Interval._raw(np.minimum(x.lo, y.lo), np.minimum(x.hi, y.hi))


def maximum(x: Interval, y: Interval) -> Interval:
    """Larger of two."""
    return Interval._raw(np.maximum(x.lo, y.lo), np.maximum(x.hi, y.hi))


@quiet
def pow_(x: Interval, exponent: float) -> Interval:
    """x ** exponent for a constant exponent; for a non-integer one undefined where x reaches below 0."""
    if float(exponent).is_integer():
        return power(x, int(exponent))
    mask = power_undefined(x, exponent)
    lo, hi = np.maximum(x.lo, 0.0), np.maximum(x.hi, 0.0)
    if exponent < 0:
        lo, hi = hi, lo
    result = _clip(_widen(np.power(lo, exponent), np.power(hi, exponent)), 0.0, np.inf)
    if exponent > 0:
        result = Interval._raw(result.lo, np.where(hi == 0, 0.0, result.hi))
    return _everything_where(mask, result)


def _truth(yes: Mask, no: Mask) -> Interval:
    """[1, 1] where decided true, [0, 0] where decided false, [0, 1] elsewhere."""
    return Interval._raw(np.where(yes, 1.0, 0.0), np.where(no, 0.0, 1.0))


def less(x: Interval, y: Interval) -> Interval:
    """x < y, as 0 or 1."""
    return _truth(x.hi < y.lo, x.lo >= y.hi)


def less_equal(x: Interval, y: Interval) -> Interval:
    """x <= y, as 0 or 1."""
    return _truth(x.hi <= y.lo, x.lo > y.hi)


def equal(x: Interval, y: Interval) -> Interval:
    """x == y, as 0 or 1."""
    return _truth((x.lo == y.hi) & (x.hi == y.lo), (x.hi < y.lo) | (x.lo > y.hi))


def _false(x: Interval) -> Mask:
    return np.asarray((x.lo == 0) & (x.hi == 0))


def _true(x: Interval) -> Mask:
    return np.asarray((x.lo > 0) | (x.hi < 0))


def not_(x: Interval) -> Interval:
    """Whether x is 0, as 0 or 1."""
    return _truth(_false(x), _true(x))


def and_(x: Interval, y: Interval) -> Interval:
    """Whether neither is 0, as 0 or 1."""
    return _truth(_true(x) & _true(y), _false(x) | _false(y))


def or_(x: Interval, y: Interval) -> Interval:
    """Whether one is not 0, as 0 or 1."""
    return _truth(_true(x) | _true(y), _false(x) & _false(y))


def if_else_zero(condition: Interval, value: Interval) -> Interval:
    """The value where the condition is not 0, else 0."""
    yes, no = _true(condition), _false(condition)
    lo = np.where(no, 0.0, np.where(yes, value.lo, np.minimum(value.lo, 0.0)))
    hi = np.where(no, 0.0, np.where(yes, value.hi, np.maximum(value.hi, 0.0)))
    return Interval._raw(lo, hi)


def sign(x: Interval) -> Interval:
    """-1, 0 or 1."""
    return Interval._raw(np.sign(x.lo), np.sign(x.hi))


def floor(x: Interval) -> Interval:
    """Largest whole number below."""
    return Interval._raw(np.floor(x.lo), np.floor(x.hi))


def kink(x: Interval) -> Interval:
    """Generalised derivative of the absolute value."""
    return Interval._raw(np.where(x.lo > 0, 1.0, -1.0), np.where(x.hi < 0, -1.0, 1.0))


def beyond_one(x: Interval) -> Mask:
    """Where asin and acos are undefined."""
    return np.asarray((x.lo < -1) | (x.hi > 1))


@quiet
def tan_undefined(x: Interval) -> Mask:
    """Where the tangent is undefined, or not resolved."""
    return np.asarray((x.mag > FAR) | _holds_multiple(x, np.pi, 0.5))


def across_cut(y: Interval, x: Interval) -> Mask:
    """Where atan2 meets its cut."""
    return np.asarray((y.lo <= 0) & (y.hi >= 0) & (x.lo <= 0))


def power_undefined(x: Interval, exponent: float) -> Mask:
    """Where a power is undefined."""
    if float(exponent).is_integer():
        return (x.lo <= 0) & (x.hi >= 0) if exponent < 0 else np.zeros(x.shape, dtype=bool)
    return x.lo < 0 if exponent > 0 else x.lo <= 0
