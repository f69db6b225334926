"""Special functions in ball arithmetic: every result is a rigorous enclosure (python-flint, log domain).

Symbols: F_a(z) = 1F1(a; b; z), excess E_a(z) = (F_a(z) - 1)/a with the limit sum_k z^k/(k (b)_k) at a = 0
(item 7.13 of docs/theory.md), and 0F1(; b; x). All the Taylor coefficients of E_a and 0F1 are positive for a >= 0,
b > 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager

from flint import arb, ctx

PRECISION = 96
"""Working precision in bits: enough that rounding to a float costs the last place only."""

_SERIES_LIMIT = 200_000
_SUMMED = 4_000  # beyond this index of the largest term only a block around it is summed
_BLOCK = 256
_FARTHEST = 1e14


def precision(bits: int = PRECISION) -> AbstractContextManager[object]:
    """Context manager that sets the working precision of ball arithmetic."""
    manager: AbstractContextManager[object] = ctx.workprec(bits)
    return manager


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


def _series(a: arb | None, b: arb, z: arb) -> arb:
    """Sum over k >= 1 of (a + 1)_(k-1) z^k / ((b)_k k!), or of z^k / ((b)_k k!) without a."""
    term = z / b
    total = term
    bits = int(ctx.prec) + 8
    peak = math.sqrt(upper(z)) if a is None else upper(z)
    if peak > _SERIES_LIMIT:
        return arb.nan()
    for k in range(1, _SERIES_LIMIT):
        ratio = z / ((b + k) * (k + 1))
        if a is not None:
            ratio = ratio * (a + k)
        term = term * ratio
        total += term
        if k > peak and k % 16 == 0:
            # later ratios only shrink: (a + j)/(b + j) is monotone with limit 1, z/(j + 1) falls
            bound = ratio if a is None else z / (k + 1) * arb.max((a + k) / (b + k), arb(1))
            if bound < arb(0.5) and term < total * arb(2) ** (-bits):
                tail = term * bound / (1 - bound)
                return total + tail.union(arb(0))
    return arb.nan()


def kummer_excess(a: arb, b: arb, z: arb) -> arb:
    """Ball of E_a(z) = (1F1(a; b; z) - 1)/a for a >= 0 (limit at a = 0), b > 0, z >= 0.

    Indeterminate where neither the library nor the series reaches.

    Examples
    --------
    >>> from flint import arb
    >>> bool(abs(kummer_excess(arb(0.5), arb(0.5), arb(1)) - 2 * (arb(1).exp() - 1)) < 1e-13)
    True
    """
    if z.is_zero():
        return arb(0)
    if not a.is_zero():
        value = _sharpened(lambda: (z.hypgeom_1f1(a, b) - 1) / a, a * z / b)
        if value is not None:
            return value
    return _series(a, b, z)


def bessel_excess(b: arb, x: arb) -> arb:
    """Ball of 0F1(; b; x) - 1 for b > 0, x >= 0 (indeterminate beyond reach)."""
    if x.is_zero():
        return arb(0)
    value = _sharpened(lambda: x.hypgeom_0f1(b) - 1, x / b)
    return _series(None, b, x) if value is None else value


def _sharpened(evaluate: Callable[[], arb], size: arb) -> arb | None:
    """The library's value at enough precision; None where the subtraction of 1 or the size defeats it."""
    if not size > 0:
        return None
    lost = max(0, -math.floor(lower(size.log()) / math.log(2)))
    if lost > 400:
        return None
    bits = int(ctx.prec)
    for extra in (8, 72):
        with precision(bits + lost + extra):
            value = evaluate()
        if value.is_finite() and value > 0 and value.rel_accuracy_bits() >= min(bits, 56):
            return value
    return None


def excess_floor(a: arb, b: arb, z: arb, *, bessel: bool = False) -> arb:
    """Ball that lies below E_a(z), or below (0F1(; b; a z) - 1)/a, at any size: sharp where they are within reach.

    Beyond it a block of the largest terms stands for the sum (all of them are positive, and their logarithms are
    gamma functions), and past z = 1e14 the value there (it rises).

    Examples
    --------
    >>> from flint import arb
    >>> bool(excess_floor(arb(0.5), arb(0.5), arb(1e9)).log() > 1e9 - 40)
    True
    """
    z = arb.min(z, arb(_FARTHEST) ** 2 / arb.max(a, arb(1)) if bessel else arb(_FARTHEST))
    x = a * z if bessel else z
    if x.is_zero():
        return arb(0)
    value = _library_excess(a, b, z, bessel)
    if value is not None:
        return value
    peak = _peak(float(a), float(b), float(x), bessel=bessel)
    if peak <= _SUMMED:
        return _series(None, b, x) / a if bessel else _series(a, b, z)
    first = arb(math.floor(peak) - _BLOCK // 2)
    with precision(int(ctx.prec) + 64):  # logarithms of up to 1e17 keep their absolute accuracy
        log_term = first * x.log() - (b + first).lgamma() + b.lgamma() - (first + 1).lgamma()
        log_term += -a.log() if bessel else (a + first).lgamma() - (a + 1).lgamma()
        term = log_term.exp()
    total = term
    for _ in range(_BLOCK):
        first = first + 1
        term = term * x / ((b + first - 1) * first)
        if not bessel:
            term = term * (a + first - 1)
        total += term
    return total


def _library_excess(a: arb, b: arb, z: arb, bessel: bool) -> arb | None:
    """Ball of E_a(z) or of its Bessel companion by the library's functions; None beyond their reach."""
    if a.is_zero() and not bessel:
        return None
    x = a * z
    return _sharpened(lambda: ((x.hypgeom_0f1(b) if bessel else z.hypgeom_1f1(a, b)) - 1) / a, x / b)


def excess_tangent(a: arb, b: arb, z: arb, *, bessel: bool = False) -> tuple[arb, arb | None]:
    """(E_a(z), d log E_a/d log z) as balls; beyond the library's reach (:func:`excess_floor`, None).

    Examples
    --------
    >>> from flint import arb
    >>> value, slope = excess_tangent(arb(0.5), arb(0.5), arb(2))  # E = 2 (e^z - 1)
    >>> bool(abs(slope - 2 * arb(2).exp() / (arb(2).exp() - 1)) < 1e-12)
    True
    """
    value = _library_excess(a, b, z, bessel)
    if value is None:
        return excess_floor(a, b, z, bessel=bessel), None
    above = (a * z).hypgeom_0f1(b + 1) if bessel else z.hypgeom_1f1(a + 1, b + 1)
    slope = z / b * above / value
    return value, slope if slope.is_finite() and slope.rel_accuracy_bits() >= 30 else None


def _peak(a: float, b: float, x: float, *, bessel: bool) -> float:
    """About the index of the largest term."""
    if bessel:
        return math.sqrt((b - 1) ** 2 / 4 + x) - (b + 1) / 2
    half = (x - b - 1) / 2
    return half + math.sqrt(max(half * half + a * x - b, 0.0))


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
