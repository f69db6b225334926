"""Taylor coefficients of a traced function along a curve, in interval arithmetic.

A series [x_0, x_1, ..., x_m] stands for x(s) = x_0 + x_1 s + x_2 s^2 + ...; coefficients left out are 0.
Evaluated at one point of time the coefficients are thin; evaluated with coefficients that hold at every
time of a piece they enclose x^(j)(s)/j! over the piece, which is what Lagrange's remainder asks for
(`taylor_bounds`).

The recurrences are those of automatic differentiation: y = F(x) satisfies a linear relation between y' and
x'. Where a kink (abs, min, max) is undecided the first coefficient is that of the generalised derivative
and all later ones are unbounded; where a jump is undecided everything is unbounded.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np

from certbound.problem.model import Tape
from certbound.rigor import intervals as iv
from certbound.rigor.intervals import Interval

__all__ = ["Series", "expand", "polynomial_range", "series_arithmetic", "series_product", "taylor_bounds"]

Series = list[Interval]

ZERO = Interval.point(0.0)


def expand(tape: Tape, inputs: Sequence[Series], order: int) -> list[Series]:
    """Series of every output of ``tape``, padded to ``order + 1`` coefficients.

    Parameters
    ----------
    tape : Tape
    inputs : sequence of Series
        One series per input slot.
    order : int
        Highest coefficient.

    Examples
    --------
    >>> from certbound.problem.model import Node
    >>> square = Tape(inputs=("t",), nodes=(Node("input", (0,)), Node("sq", (0,))), outputs=(1,), shape=(1,))
    >>> one = Interval.point(1.0)
    >>> [float(c.mid) for c in expand(square, [[one, one]], 3)[0]]
    [1.0, 2.0, 1.0, 0.0]
    """
    outputs = tape.evaluate(series_arithmetic(order), inputs)
    return [list(series) + [ZERO] * (order + 1 - len(series)) for series in outputs]


def polynomial_range(series: Series, span: Interval) -> Interval:
    """Enclosure of x_0 + x_1 s + ... for s in ``span``, best where ``span`` is centred at 0.

    Even powers of ``span`` are nonnegative; the coefficients may be intervals (a Taylor form with remainder).
    """
    total = series[0]
    for power, coefficient in enumerate(series[1:], start=1):
        total = total + coefficient * span**power
    return total


def taylor_bounds(centre: Series, piece: Series, span: Interval) -> list[Interval]:
    """Enclosures of a function over a piece, one for every order of Lagrange's remainder.

    Proves: x(s) lies in sum_{j < r} centre_j s^j + piece_r s^r for s in ``span``, for every r; a caller may
    intersect them.

    Parameters
    ----------
    centre : Series
        Coefficients at s = 0.
    piece : Series
        Coefficients valid at every s of the convex hull of 0 and ``span``.
    """
    powers = [span**power for power in range(1, len(piece))]
    bounds = [piece[0]]
    partial = centre[0]
    for r in range(1, len(piece)):
        bounds.append(partial + piece[r] * powers[r - 1])
        if r < len(centre):
            partial = partial + centre[r] * powers[r - 1]
    return bounds


def series_product(x: Series, y: Series, order: int | None = None) -> Series:
    """Cauchy product, cut after ``order`` when given."""
    length = len(x) + len(y) - 1
    if order is not None:
        length = min(length, order + 1)
    return [
        _sum([x[j] * y[k - j] for j in range(max(0, k - len(y) + 1), min(k, len(x) - 1) + 1)])
        for k in range(length)
    ]


def _sum(terms: Sequence[Interval]) -> Interval:
    total = terms[0] if terms else ZERO
    for term in terms[1:]:
        total = total + term
    return total


def _linear(signs: tuple[float, float]) -> Callable[[Series, Series], Series]:
    def combine(x: Series, y: Series) -> Series:
        result = []
        for k in range(max(len(x), len(y))):
            if k >= len(y):
                result.append(x[k])
            elif k >= len(x):
                result.append(y[k] if signs[1] > 0 else -y[k])
            else:
                result.append(x[k] + y[k] if signs[1] > 0 else x[k] - y[k])
        return result

    return combine


def _scaled(x: Series, order: int) -> list[tuple[int, Interval]]:
    """Pairs (j, j x_j) of the coefficients of x' that are present."""
    return [(j, x[j] * float(j)) for j in range(1, min(len(x), order + 1))]


def _where(mask: Any, first: Interval, second: Interval) -> Interval:
    return Interval(np.where(mask, first.lo, second.lo), np.where(mask, first.hi, second.hi))


def _unbounded(shape: tuple[int, ...]) -> Interval:
    return Interval(np.full(shape, -np.inf), np.full(shape, np.inf))


def _spoiled(undefined: Any, series: Series) -> Series:
    """Unbounded in every coefficient where the function itself is undefined, whatever its derivative says."""
    if not np.any(undefined):
        return series
    return [
        _where(undefined, _unbounded(np.broadcast_shapes(np.shape(undefined), x.shape)), x) for x in series
    ]


@cache
def series_arithmetic(order: int) -> dict[str, Callable[..., Any]]:
    """Arithmetic for ``Tape.evaluate`` whose values are series cut after ``order``."""
    base = iv.ARITHMETIC

    def product(x: Series, y: Series) -> Series:
        return series_product(x, y, order)

    def divide(x: Series, y: Series) -> Series:
        if len(y) == 1:
            return [coefficient / y[0] for coefficient in x]
        result: Series = []
        for k in range(order + 1):
            terms = [y[j] * result[k - j] for j in range(1, min(k, len(y) - 1) + 1)]
            head = x[k] if k < len(x) else ZERO
            result.append((head - _sum(terms)) / y[0])
        return result

    def root(x: Series, first: Interval) -> Series:
        result = [first]
        for k in range(1, order + 1):
            terms = [result[j] * result[k - j] for j in range(1, k)]
            head = x[k] if k < len(x) else ZERO
            result.append((head - _sum(terms)) / (first * 2.0))
        return result

    def quotient_integral(first: Interval, numerator: Series, weight: Series) -> Series:
        """y with y_0 = first and weight y' = numerator."""
        result = [first]
        for k in range(1, order + 1):
            terms = [result[j] * weight[k - j] * float(j) for j in range(max(1, k - len(weight) + 1), k)]
            head = numerator[k - 1] if k - 1 < len(numerator) else ZERO
            result.append((head - _sum(terms)) / (weight[0] * float(k)))
        return result

    def derivative(x: Series) -> Series:
        return [value for _, value in _scaled(x, order)] or [ZERO]

    def exp(x: Series) -> Series:
        result = [base["exp"](x[0])]
        slopes = _scaled(x, order)
        for k in range(1, order + 1):
            result.append(_sum([slope * result[k - j] for j, slope in slopes if j <= k]) / float(k))
        return result

    def pair(names: tuple[str, str], sign: float, which: int) -> Callable[[Series], Series]:
        """sin and cos (sign -1), or sinh and cosh (sign 1), which differentiate into each other."""

        def function(x: Series) -> Series:
            first, second = [base[names[0]](x[0])], [base[names[1]](x[0])]
            slopes = _scaled(x, order)
            for k in range(1, order + 1):
                odd = _sum([slope * second[k - j] for j, slope in slopes if j <= k]) / float(k)
                even = _sum([slope * first[k - j] for j, slope in slopes if j <= k]) / (sign * k)
                first.append(odd)
                second.append(even)
            return (first, second)[which]

        return function

    def riccati(name: str, sign: float) -> Callable[[Series], Series]:
        """y' = (1 + sign y^2) x': tan (1) and tanh (-1)."""

        def function(x: Series) -> Series:
            result = [base[name](x[0])]
            weights = [base["sq"](result[0]) * sign + 1.0]
            slopes = _scaled(x, order)
            for k in range(1, order + 1):
                result.append(_sum([slope * weights[k - j] for j, slope in slopes if j <= k]) / float(k))
                weights.append(_sum([result[j] * result[k - j] for j in range(k + 1)]) * sign)
            return result

        return function

    def arc(name: str) -> Callable[[Series], Series]:
        def function(x: Series) -> Series:
            squared = square(x)
            if name == "atan":
                weight = [squared[0] + 1.0, *squared[1:]]
            else:
                weight = [-coefficient for coefficient in squared]
                weight[0] = weight[0] + 1.0
                weight = root(weight, base["sqrt"](weight[0]))
            slope = derivative(x)
            numerator = [-value for value in slope] if name == "acos" else slope
            return quotient_integral(base[name](x[0]), numerator, weight)

        return function

    def square(x: Series) -> Series:
        result = series_product(x, x, order)
        result[0] = base["sq"](x[0])
        return result

    def sum_of_squares(x: Series, y: Series) -> Series:
        return _linear((1.0, 1.0))(square(x), square(y))

    def hypot(x: Series, y: Series) -> Series:
        return root(sum_of_squares(x, y), base["hypot"](x[0], y[0]))

    def atan2(y: Series, x: Series) -> Series:
        numerator = _linear((1.0, -1.0))(product(x, derivative(y)), product(y, derivative(x)))
        result = quotient_integral(base["atan2"](y[0], x[0]), numerator, sum_of_squares(x, y))
        return _spoiled(iv.UNDEFINED["atan2"](y[0], x[0]), result)

    def log(x: Series) -> Series:
        result = quotient_integral(base["log"](x[0]), derivative(x), x)
        return _spoiled(iv.UNDEFINED["log"](x[0]), result)

    def power(x: Series, exponent: float) -> Series:
        if len(x) == 1:
            return [base["pow"](x[0], exponent)]
        if exponent == int(exponent) and abs(exponent) <= 64:
            result = _integer_power(x, abs(int(exponent)), product)
            if exponent < 0:
                result = divide([Interval.point(1.0)], result)
            result[0] = base["pow"](x[0], exponent)
            return result
        result = [base["pow"](x[0], exponent)]
        for k in range(1, order + 1):
            terms = [
                x[j] * result[k - j] * (Interval.point(exponent) * float(j) - float(k - j))
                for j in range(1, min(k, len(x) - 1) + 1)
            ]
            result.append(_sum(terms) / (x[0] * float(k)))
        return _spoiled(iv.UNDEFINED["pow"](x[0], exponent), result)

    def select(first: Any, second: Any, value: Interval, x: Series, y: Series) -> Series:
        """x where ``first`` holds, y where ``second`` holds, the generalised derivative elsewhere."""
        result = [value]
        for k in range(1, max(len(x), len(y))):
            a, b = (s[k] if k < len(s) else ZERO for s in (x, y))
            shape = np.broadcast_shapes(value.shape, a.shape, b.shape)
            undecided = a.hull(b) if k == 1 else _unbounded(shape)
            result.append(_where(first, a, _where(second, b, undecided)))
        return result

    def absolute(x: Series) -> Series:
        return select(x[0].lo >= 0, x[0].hi <= 0, base["abs"](x[0]), x, [-value for value in x])

    def maximum(x: Series, y: Series) -> Series:
        return select(x[0].lo >= y[0].hi, y[0].lo >= x[0].hi, base["max"](x[0], y[0]), x, y)

    def minimum(x: Series, y: Series) -> Series:
        return select(x[0].hi <= y[0].lo, y[0].hi <= x[0].lo, base["min"](x[0], y[0]), x, y)

    def jump(name: str) -> Callable[..., Series]:
        def function(*arguments: Series) -> Series:
            value = base[name](*(x[0] for x in arguments))
            decided = value.lo == value.hi
            if np.all(decided):
                return [value]
            wide = _unbounded(value.shape)
            return [_where(decided, value, wide), *[_where(decided, ZERO, wide)] * order]

        return function

    def kink(x: Series) -> Series:
        value = base["kink"](x[0])
        decided = value.lo == value.hi
        if np.all(decided):
            return [value]
        return [value, *[_where(decided, ZERO, _unbounded(value.shape))] * order]

    def if_else_zero(condition: Series, x: Series) -> Series:
        flag = condition[0]
        result = []
        for k in range(order + 1 if np.any(flag.lo != flag.hi) else len(x)):
            value = x[k] if k < len(x) else ZERO
            wide = _unbounded(np.broadcast_shapes(flag.shape, value.shape))
            decided = _where(flag.lo >= 1, value, _where(flag.hi <= 0, ZERO, wide))
            result.append(_where(flag.lo == flag.hi, decided, wide))
        return result

    def constant_shortcut(name: str, function: Callable[..., Series]) -> Callable[..., Series]:
        def shortcut(*arguments: Series) -> Series:
            if all(len(x) == 1 for x in arguments):
                return [base[name](*(x[0] for x in arguments))]
            return function(*arguments)

        return shortcut

    smooth: dict[str, Callable[..., Series]] = {
        "add": _linear((1.0, 1.0)),
        "sub": _linear((1.0, -1.0)),
        "mul": product,
        "div": divide,
        "neg": lambda x: [-value for value in x],
        "sq": square,
        "sqrt": lambda x: root(x, base["sqrt"](x[0])),
        "exp": exp,
        "log": log,
        "sin": pair(("sin", "cos"), -1.0, 0),
        "cos": pair(("sin", "cos"), -1.0, 1),
        "sinh": pair(("sinh", "cosh"), 1.0, 0),
        "cosh": pair(("sinh", "cosh"), 1.0, 1),
        "tan": riccati("tan", 1.0),
        "tanh": riccati("tanh", -1.0),
        "asin": arc("asin"),
        "acos": arc("acos"),
        "atan": arc("atan"),
        "atan2": atan2,
        "hypot": hypot,
        "abs": absolute,
        "min": minimum,
        "max": maximum,
    }
    table: dict[str, Callable[..., Any]] = {
        name: constant_shortcut(name, function) for name, function in smooth.items()
    }
    for name in ("sign", "floor", "not", "lt", "le", "eq", "ne", "and", "or"):
        table[name] = jump(name)
    table["if_else_zero"] = if_else_zero
    table["kink"] = kink
    table["pow"] = power
    table["const"] = lambda value: [Interval.point(value)]
    return table


def _integer_power(x: Series, exponent: int, product: Callable[[Series, Series], Series]) -> Series:
    result: Series = [Interval.point(1.0)]
    factor = x
    while exponent:
        if exponent & 1:
            result = product(result, factor) if len(result) > 1 or exponent > 1 or factor is not x else factor
        exponent >>= 1
        if exponent:
            factor = product(factor, factor)
    return list(result)
