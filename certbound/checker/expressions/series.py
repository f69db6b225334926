"""Taylor series in time over balls: the defect of a nominal curve, enclosed over a whole piece.

A series is a list of coefficients; operations follow from the differential equations that the functions obey. Expanded
at the middle of a piece and, for the last coefficient, over all of it, a function lies in its Taylor polynomial plus
that coefficient times the last power (Lagrange's remainder). At a kink there are series up to the first power only,
whose coefficient encloses the slopes on both sides (a Lipschitz function is the integral of its derivative).
"""

from __future__ import annotations

from collections.abc import Callable

from flint import arb

from certbound.checker.expressions import arithmetic as balls

Series = list[arb]


def constant(value: arb, order: int) -> Series:
    return [value] + [arb(0)] * order


def add(x: Series, y: Series) -> Series:
    return [a + b for a, b in zip(x, y)]


def sub(x: Series, y: Series) -> Series:
    return [a - b for a, b in zip(x, y)]


def scale(x: Series, factor: arb) -> Series:
    return [a * factor for a in x]


def mul(x: Series, y: Series) -> Series:
    return [sum((x[i] * y[k - i] for i in range(k + 1)), arb(0)) for k in range(len(x))]


def sq(x: Series) -> Series:
    return [balls.square(x[0]), *mul(x, x)[1:]]


def div(x: Series, y: Series) -> Series:
    result: Series = []
    for k in range(len(x)):
        rest = x[k] - sum((result[i] * y[k - i] for i in range(k)), arb(0))
        result.append(rest / y[0])
    return result


def _slope(x: Series) -> Series:
    """Coefficients of x', one fewer."""
    return [(k + 1) * x[k + 1] for k in range(len(x) - 1)]


def integrated(first: arb, slope: Callable[[Series], Series], x: Series) -> Series:
    """y with y_0 = first and y' = slope(y so far) x'."""
    result, rate = [first], _slope(x)
    for k in range(1, len(x)):
        outer = slope(result)
        result.append(sum((outer[i] * rate[k - 1 - i] for i in range(k)), arb(0)) / k)
    return result


def known(outer: Series) -> Callable[[Series], Series]:
    return lambda _: outer


def exp(x: Series) -> Series:
    return integrated(balls.exp(x[0]), lambda y: y, x)


def log(x: Series) -> Series:
    return integrated(balls.log(x[0]), known(div(constant(arb(1), len(x) - 1), x)), x)


def sqrt(x: Series) -> Series:
    result = [balls.sqrt(x[0])]
    for k in range(1, len(x)):
        rest = x[k] - sum((result[i] * result[k - i] for i in range(1, k)), arb(0))
        result.append(rest / (2 * result[0]))
    return result


def _pair(x: Series, first: arb, second: arb, sign: int) -> tuple[Series, Series]:
    """sin and cos (sign -1), or sinh and cosh (sign 1)."""
    s, c, rate = [first], [second], _slope(x)
    for k in range(1, len(x)):
        odd = sum((c[i] * rate[k - 1 - i] for i in range(k)), arb(0)) / k
        even = sum((s[i] * rate[k - 1 - i] for i in range(k)), arb(0)) * sign / k
        s.append(odd)
        c.append(even)
    return s, c


def circular(x: Series) -> tuple[Series, Series]:
    """sin and cos."""
    return _pair(x, balls.sin(x[0]), balls.cos(x[0]), -1)


def hyperbolic(x: Series) -> tuple[Series, Series]:
    """sinh and cosh."""
    return _pair(x, balls.sinh(x[0]), balls.cosh(x[0]), 1)


def tanh(x: Series) -> Series:
    return integrated(balls.tanh(x[0]), lambda y: sub(constant(arb(1), len(y) - 1), sq(y)), x)


def tan(x: Series) -> Series:
    return integrated(balls.tan(x[0]), lambda y: add(constant(arb(1), len(y) - 1), sq(y)), x)


def atan(x: Series) -> Series:
    one = constant(arb(1), len(x) - 1)
    return integrated(balls.atan(x[0]), known(div(one, add(one, sq(x)))), x)


def _arc(x: Series) -> Series:
    """1/sqrt(1 - x^2)."""
    one = constant(arb(1), len(x) - 1)
    return div(one, sqrt(sub(one, sq(x))))


def asin(x: Series) -> Series:
    return integrated(balls.asin(x[0]), known(_arc(x)), x)


def acos(x: Series) -> Series:
    return integrated(balls.acos(x[0]), known(scale(_arc(x), arb(-1))), x)


def abs_(x: Series) -> Series:
    return larger(x, scale(x, arb(-1)))


def power(x: Series, exponent: float) -> Series:
    order = len(x) - 1
    if exponent == 0.0:
        return constant(x[0] if x[0].is_nan() else arb(1), order)
    if exponent == int(exponent) and 1 <= exponent <= 64:
        result = x
        for _ in range(int(exponent) - 1):
            result = mul(result, x)
        return [balls.power(x[0], exponent), *result[1:]]
    result, p = [balls.power(x[0], exponent)], arb(exponent)
    for k in range(1, order + 1):
        total = sum(((p * i - (k - i)) * x[i] * result[k - i] for i in range(1, k + 1)), arb(0))
        result.append(total / (k * x[0]))
    return result


def atan2(y: Series, x: Series) -> Series:
    first = balls.atan2(y[0], x[0])
    squares = add(sq(x), sq(y))
    rate = sub(mul(x[:-1], _slope(y)), mul(y[:-1], _slope(x)))
    quotient = div(rate, squares[:-1]) if len(x) > 1 else []
    return [first, *(value / (k + 1) for k, value in enumerate(quotient))]


def hypot(x: Series, y: Series) -> Series:
    return sqrt(add(sq(x), sq(y)))


def larger(x: Series, y: Series) -> Series:
    try:
        return x if balls.kink(x[0] - y[0]) == 1 else y
    except balls.Undecided:
        if len(x) > 2:
            raise
        return [arb.max(x[0], y[0]), *(a.union(b) for a, b in zip(x[1:], y[1:]))]


def smaller(x: Series, y: Series) -> Series:
    minus = arb(-1)
    return scale(larger(scale(x, minus), scale(y, minus)), minus)


def if_else_zero(condition: Series, x: Series) -> Series:
    return x if balls.holds(condition[0]) else constant(arb(0), len(x) - 1)


def step(function: Callable[..., arb]) -> Callable[..., Series]:
    """A piecewise constant function of one or more series."""
    return lambda *args: constant(function(*(x[0] for x in args)), len(args[0]) - 1)
