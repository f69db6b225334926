"""Special functions in ball arithmetic: every result is a rigorous enclosure (python-flint, log domain).

Symbols: F_a(z) = 1F1(a; b; z), excess E_a(z) = (F_a(z) - 1)/a with the limit sum_k z^k/(k (b)_k) at a = 0
(item 7.13 of docs/theory.md), 0F1(; b; x), and the normal tail Q(x) = P(N(0, 1) > x). All the Taylor coefficients
of F_a, E_a and 0F1 are positive for a >= 0, b > 0, so that a partial sum is a lower bound.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from flint import arb, ctx

__all__ = [
    "PRECISION",
    "ball",
    "bessel_excess",
    "kummer_excess",
    "log_bessel0f1",
    "log_expm1",
    "log_kummer",
    "log_q_bounds",
    "log_q_upper",
    "lower",
    "precision",
    "solve_upward",
    "upper",
]

PRECISION = 96
"""Working precision in bits: enough that rounding to a float costs the last place only."""

_SERIES_LIMIT = 2_000_000


def precision(bits: int = PRECISION) -> object:
    """Context manager that sets the working precision of ball arithmetic."""
    return ctx.workprec(bits)


def ball(value: float | int) -> arb:
    """Exact ball of a float or an integer."""
    return arb(value)


def upper(value: arb) -> float:
    """Float that is at least every point of the ball (inf for an indeterminate ball)."""
    if value.is_nan():
        return math.inf
    top = value.upper()
    result = float(top)
    while arb(result) < top:
        result = math.nextafter(result, math.inf)
    return result


def lower(value: arb) -> float:
    """Float that is at most every point of the ball (-inf for an indeterminate ball)."""
    return -upper(-value)


def _series(a: arb, b: arb, z: arb, shift: int) -> arb:
    """Sum over k >= 1 of (a + shift)_(k-1) z^k / ((b)_k k!) (shift 1), with 0F1's terms for shift = -1."""
    term = z / b
    total = term
    bits = int(ctx.prec) + 8
    peak = math.sqrt(upper(z)) if shift < 0 else upper(z)
    for k in range(1, _SERIES_LIMIT):
        ratio = z / ((b + k) * (k + 1))
        if shift >= 0:
            ratio = ratio * (a + k)
        term = term * ratio
        total += term
        if k > peak and k % 16 == 0:
            # later ratios only shrink: (a + j)/(b + j) is monotone with limit 1, z/(j + 1) falls
            bound = ratio if shift < 0 else z / (k + 1) * arb.max((a + k) / (b + k), arb(1))
            if bound < arb(0.5) and term < total * arb(2) ** (-bits):
                tail = term * bound / (1 - bound)
                return total + tail.union(arb(0))
    raise ArithmeticError(f"the series needs more than {_SERIES_LIMIT} terms at z = {z.str(5)}.")


def kummer_excess(a: arb, b: arb, z: arb) -> arb:
    """Ball of E_a(z) = (1F1(a; b; z) - 1)/a for a >= 0 (limit at a = 0), b > 0, z >= 0.

    Examples
    --------
    >>> from flint import arb
    >>> bool(abs(kummer_excess(arb(0.5), arb(0.5), arb(1)) - 2 * (arb(1).exp() - 1)) < 1e-15)
    True
    """
    if z.is_zero():
        return arb(0)
    size = a * z / b
    lost = 0 if a.is_zero() else max(0, -int(math.floor(lower(size.log()) / math.log(2)))) if size > 0 else 10**6
    if not a.is_zero() and lost < 400:
        with precision(int(ctx.prec) + lost + 8):
            value = (z.hypgeom_1f1(a, b) - 1) / a
        if _accurate(value):
            return value
    return _series(a, b, z, 1)


def bessel_excess(b: arb, x: arb) -> arb:
    """Ball of 0F1(; b; x) - 1 for b > 0, x >= 0."""
    if x.is_zero():
        return arb(0)
    size = x / b
    lost = max(0, -int(math.floor(lower(size.log()) / math.log(2)))) if size > 0 else 10**6
    if lost < 400:
        with precision(int(ctx.prec) + lost + 8):
            value = x.hypgeom_0f1(b) - 1
        if _accurate(value):
            return value
    return _series(arb(0), b, x, -1)


def _accurate(value: arb) -> bool:
    return bool(value.is_finite()) and value > 0 and value.rel_accuracy_bits() >= int(ctx.prec) // 2


def log_expm1(x: arb) -> arb:
    """Ball of log(exp(x) - 1), x > 0."""
    return x + (-(-x).expm1()).log()


def log_kummer(a: float, b: float, z: float) -> tuple[float, float]:
    """Rigorous bounds (lo, hi) of log 1F1(a; b; z), a >= 0, b > 0, z >= 0.

    Examples
    --------
    >>> lo, hi = log_kummer(0.5, 0.5, 3.0)
    >>> lo <= 3.0 <= hi and hi - lo < 1e-14
    True
    """
    _check(a=a, b=b, z=z)
    with precision():
        value = (1 + arb(a) * kummer_excess(arb(a), arb(b), arb(z))).log()
        return lower(value), upper(value)


def log_bessel0f1(b: float, z: float) -> tuple[float, float]:
    """Rigorous bounds (lo, hi) of log 0F1(; b; z), b > 0, z >= 0.

    Examples
    --------
    >>> lo, hi = log_bessel0f1(0.5, 1.0)  # cosh(2 sqrt z)
    >>> lo <= math.log(math.cosh(2.0)) + 1e-15 and hi - lo < 1e-14
    True
    """
    _check(b=b, z=z)
    with precision():
        value = (1 + bessel_excess(arb(b), arb(z))).log()
        return lower(value), upper(value)


def _check(**values: float) -> None:
    for name, value in values.items():
        if not (math.isfinite(value) and value >= 0 and (name != "b" or value > 0)):
            rule = "be positive and finite" if name == "b" else "be finite and not negative"
            raise ValueError(f"`{name}` must {rule}, got {value}.")


def solve_upward(function: Callable[[arb], arb], target: arb, guess: float) -> float:
    """Float z with function(z) >= target proved, close above ``guess``; inf when none is found.

    ``function`` must be increasing; ``guess`` should solve function(z) = target to float accuracy.
    """
    if math.isnan(guess):
        guess = 1.0
    step = 2e-13
    z = guess * (1 + 1e-14) + 5e-324
    while math.isfinite(z):
        if function(arb(z)) >= target:
            return z
        z = max(z * (1 + step), math.nextafter(z, math.inf))
        step *= 8
    return math.inf


def log_q_bounds(x: float) -> tuple[float, float]:
    """Rigorous bounds (lo, hi) of log Q(x), Q the upper tail of the standard normal law.

    Examples
    --------
    >>> lo, hi = log_q_bounds(0.0)
    >>> lo <= math.log(0.5) <= hi
    True
    """
    if math.isnan(x):
        raise ValueError("`x` must not be nan.")
    if math.isinf(x):
        return (-math.inf, -math.inf) if x > 0 else (0.0, 0.0)
    with precision():
        value = ((arb(x) / arb(2).sqrt()).erfc() / 2).log()
        if not value.is_finite():  # Mills: x phi/(1 + x^2) < Q < phi/x
            density = -arb(x) ** 2 / 2 - (2 * arb.pi()).log() / 2
            return lower(density + (arb(x) / (1 + arb(x) ** 2)).log()), upper(density - arb(x).log())
        return lower(value), upper(value)


def log_q_upper(x: float) -> float:
    """Upper bound of log Q(x).

    Examples
    --------
    >>> abs(log_q_upper(1.959963984540054) - math.log(0.025)) < 1e-12
    True
    """
    return log_q_bounds(x)[1]
