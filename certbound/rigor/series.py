"""Taylor series with interval coefficients: what elementary functions make of them.

A series [x_0, x_1, ..., x_m] stands for x(s) = x_0 + x_1 s + x_2 s^2 + ...; coefficients left out are 0. The
recurrences are those of automatic differentiation: y = F(x) satisfies a linear relation between y' and x'. Every
function takes its arguments and the highest order wanted, and encloses the coefficients for all values within theirs;
the names are those of the functions in ``elementary``.

Where a kink (abs, min, max) is undecided the first coefficient is that of the generalised derivative and all later ones
are unbounded; where a jump is undecided everything is unbounded.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from certbound.rigor import elementary as iv
from certbound.rigor.arithmetic import Interval

Series = list[Interval]

ZERO = Interval.point(0.0)


def _sum(terms: Sequence[Interval]) -> Interval:
    total = terms[0] if terms else ZERO
    for term in terms[1:]:
        total = total + term
    return total


def _at(x: Series, k: int) -> Interval:
    return x[k] if k < len(x) else ZERO


def add(x: Series, y: Series, order: int) -> Series:
    common = min(len(x), len(y))
    return [*(a + b for a, b in zip(x, y)), *x[common:], *y[common:]]


def subtract(x: Series, y: Series, order: int) -> Series:
    common = min(len(x), len(y))
    return [*(a - b for a, b in zip(x, y)), *x[common:], *(-b for b in y[common:])]


def product(x: Series, y: Series, order: int | None = None, known: Sequence[Interval] = ()) -> Series:
    """Cauchy product, cut after ``order`` when given; its first coefficients may be ``known``."""
    length = len(x) + len(y) - 1
    if order is not None:
        length = min(length, order + 1)
    return [
        *known,
        *(
            _sum([x[j] * y[k - j] for j in range(max(0, k - len(y) + 1), min(k, len(x) - 1) + 1)])
            for k in range(len(known), length)
        ),
    ]


def divide(x: Series, y: Series, order: int) -> Series:
    if len(y) == 1:
        return [coefficient / y[0] for coefficient in x]
    result: Series = []
    for k in range(order + 1):
        terms = [y[j] * result[k - j] for j in range(1, min(k, len(y) - 1) + 1)]
        result.append((_at(x, k) - _sum(terms)) / y[0])
    return result


def sq(x: Series, order: int) -> Series:
    result = product(x, x, order)
    result[0] = iv.sq(x[0])
    return result


def _root(x: Series, first: Interval, order: int) -> Series:
    """The root of x whose value is ``first``."""
    result = [first]
    for k in range(1, order + 1):
        terms = [result[j] * result[k - j] for j in range(1, k)]
        result.append((_at(x, k) - _sum(terms)) / (first * 2.0))
    return result


def sqrt(x: Series, order: int) -> Series:
    return _root(x, iv.sqrt(x[0]), order)


def _slopes(x: Series, order: int) -> list[tuple[int, Interval]]:
    """Pairs (j, j x_j) of the coefficients of x' that are present."""
    return [(j, x[j] * float(j)) for j in range(1, min(len(x), order + 1))]


def derivative(x: Series, order: int) -> Series:
    return [value for _, value in _slopes(x, order)] or [ZERO]


def _next(slopes: list[tuple[int, Interval]], outer: Series, k: int, sign: float = 1.0) -> Interval:
    """Coefficient k of y with y' = sign outer x'."""
    return _sum([slope * outer[k - j] for j, slope in slopes if j <= k]) / (sign * k)


def integral(first: Interval, numerator: Series, weight: Series, order: int) -> Series:
    """y with y_0 = first and weight y' = numerator."""
    result = [first]
    for k in range(1, order + 1):
        terms = [result[j] * weight[k - j] * float(j) for j in range(max(1, k - len(weight) + 1), k)]
        result.append((_at(numerator, k - 1) - _sum(terms)) / (weight[0] * float(k)))
    return result


def _spoiled(undefined: Any, series: Series) -> Series:
    """Unbounded in every coefficient where the function itself is undefined, whatever its derivative says."""
    if not np.any(undefined):
        return series
    return [_where(undefined, _unbounded(np.broadcast_shapes(np.shape(undefined), x.shape)), x) for x in series]


def exp(x: Series, order: int) -> Series:
    result, slopes = [iv.exp(x[0])], _slopes(x, order)
    for k in range(1, order + 1):
        result.append(_next(slopes, result, k))
    return result


def log(x: Series, order: int) -> Series:
    return _spoiled(x[0].lo <= 0, integral(iv.log(x[0]), derivative(x, order), x, order))


def _pair(x: Series, known: tuple[Series, Series], sign: float, order: int) -> tuple[Series, Series]:
    """sin and cos (sign -1), or sinh and cosh (sign 1), which differentiate into each other."""
    one, two, slopes = [*known[0]], [*known[1]], _slopes(x, order)
    for k in range(len(one), order + 1):
        odd, even = _next(slopes, two, k), _next(slopes, one, k, sign)
        one.append(odd)
        two.append(even)
    return one, two


def circular(x: Series, order: int, known: tuple[Series, Series] | None = None) -> tuple[Series, Series]:
    """Sine and cosine; their first coefficients may be ``known``."""
    return _pair(x, known or ([iv.sin(x[0])], [iv.cos(x[0])]), -1.0, order)


def hyperbolic(x: Series, order: int) -> tuple[Series, Series]:
    """Hyperbolic sine and cosine."""
    return _pair(x, ([iv.sinh(x[0])], [iv.cosh(x[0])]), 1.0, order)


def _riccati(x: Series, first: Interval, sign: float, order: int) -> Series:
    """y' = (1 + sign y^2) x': tan (1) and tanh (-1)."""
    result, weights, slopes = [first], [iv.sq(first) * sign + 1.0], _slopes(x, order)
    for k in range(1, order + 1):
        result.append(_next(slopes, weights, k))
        weights.append(_sum([result[j] * result[k - j] for j in range(k + 1)]) * sign)
    return result


def tan(x: Series, order: int) -> Series:
    return _riccati(x, iv.tan(x[0]), 1.0, order)


def tanh(x: Series, order: int) -> Series:
    return _riccati(x, iv.tanh(x[0]), -1.0, order)


def atan(x: Series, order: int) -> Series:
    first, *rest = sq(x, order)
    return integral(iv.atan(x[0]), derivative(x, order), [first + 1.0, *rest], order)


def _opposite(x: Series, order: int) -> Series:
    """sqrt(1 - x^2)."""
    first, *rest = [-coefficient for coefficient in sq(x, order)]
    return sqrt([first + 1.0, *rest], order)


def asin(x: Series, order: int) -> Series:
    return integral(iv.asin(x[0]), derivative(x, order), _opposite(x, order), order)


def acos(x: Series, order: int) -> Series:
    return integral(iv.acos(x[0]), [-value for value in derivative(x, order)], _opposite(x, order), order)


def hypot(x: Series, y: Series, order: int) -> Series:
    return _root(add(sq(x, order), sq(y, order), order), iv.hypot(x[0], y[0]), order)


def atan2(y: Series, x: Series, order: int) -> Series:
    first, second = product(x, derivative(y, order), order), product(y, derivative(x, order), order)
    squares = add(sq(x, order), sq(y, order), order)
    result = integral(iv.atan2(y[0], x[0]), subtract(first, second, order), squares, order)
    return _spoiled(iv.across_cut(y[0], x[0]), result)


def power(x: Series, exponent: float, order: int, times: Callable[[Series, Series, int], Series] = product) -> Series:
    """x ** exponent for a constant exponent; ``times`` multiplies."""
    if len(x) == 1:
        return [iv.pow_(x[0], exponent)]
    if exponent == int(exponent) and abs(exponent) <= 64:
        result = _integer_power(x, abs(int(exponent)), order, times)
        if exponent < 0:
            result = divide([Interval.point(1.0)], result, order)
        result[0] = iv.pow_(x[0], exponent)
        return result
    result = [iv.pow_(x[0], exponent)]
    for k in range(1, order + 1):
        terms = [
            x[j] * result[k - j] * (Interval.point(exponent) * float(j) - float(k - j))
            for j in range(1, min(k, len(x) - 1) + 1)
        ]
        result.append(_sum(terms) / (x[0] * float(k)))
    return _spoiled(iv.power_undefined(x[0], exponent), result)


def _integer_power(
    x: Series, exponent: int, order: int, times: Callable[[Series, Series, int], Series]
) -> Series:
    result: Series = [Interval.point(1.0)]
    factor = x
    while exponent:
        if exponent & 1:
            result = times(result, factor, order) if len(result) > 1 or exponent > 1 or factor is not x else factor
        exponent >>= 1
        if exponent:
            factor = times(factor, factor, order)
    return list(result)


# ---- kinks and jumps -------------------------------------------------------------------------------------------


def _where(mask: Any, first: Interval, second: Interval) -> Interval:
    return Interval(np.where(mask, first.lo, second.lo), np.where(mask, first.hi, second.hi))


def _unbounded(shape: tuple[int, ...]) -> Interval:
    return Interval(np.full(shape, -np.inf), np.full(shape, np.inf))


def _selected(first: Any, second: Any, value: Interval, x: Series, y: Series) -> Series:
    """x where ``first`` holds, y where ``second`` holds, the generalised derivative elsewhere."""
    result = [value]
    for k in range(1, max(len(x), len(y))):
        a, b = _at(x, k), _at(y, k)
        shape = np.broadcast_shapes(value.shape, a.shape, b.shape)
        undecided = a.hull(b) if k == 1 else _unbounded(shape)
        result.append(_where(first, a, _where(second, b, undecided)))
    return result


def abs_(x: Series, order: int) -> Series:
    return _selected(x[0].lo >= 0, x[0].hi <= 0, iv.abs_(x[0]), x, [-value for value in x])


def maximum(x: Series, y: Series, order: int) -> Series:
    return _selected(x[0].lo >= y[0].hi, y[0].lo >= x[0].hi, iv.maximum(x[0], y[0]), x, y)


def minimum(x: Series, y: Series, order: int) -> Series:
    return _selected(x[0].hi <= y[0].lo, y[0].hi <= x[0].lo, iv.minimum(x[0], y[0]), x, y)


def kink(x: Series, order: int) -> Series:
    value = iv.kink(x[0])
    decided = value.lo == value.hi
    if np.all(decided):
        return [value]
    return [value, *[_where(decided, ZERO, _unbounded(value.shape))] * order]


def jump(function: Callable[..., Interval]) -> Callable[..., Series]:
    """A piecewise constant function of one or more series."""

    def series(*arguments: Any) -> Series:
        *given, order = arguments
        value = function(*(x[0] for x in given))
        decided = value.lo == value.hi
        if np.all(decided):
            return [value]
        wide = _unbounded(value.shape)
        return [_where(decided, value, wide), *[_where(decided, ZERO, wide)] * order]

    return series


def if_else_zero(condition: Series, x: Series, order: int) -> Series:
    flag = condition[0]
    result = []
    for k in range(order + 1 if np.any(flag.lo != flag.hi) else len(x)):
        value = _at(x, k)
        wide = _unbounded(np.broadcast_shapes(flag.shape, value.shape))
        decided = _where(flag.lo >= 1, value, _where(flag.hi <= 0, ZERO, wide))
        result.append(_where(flag.lo == flag.hi, decided, wide))
    return result
