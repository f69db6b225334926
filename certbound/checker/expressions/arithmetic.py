"""The operations of a tape on balls: enclosures, and a refusal wherever a jump is not decided.

A ball whose branch is undecided raises `Undecided`; a point outside an operation's domain gives what is not a number,
which no operation takes for one. Increasing functions are evaluated at both ends, and a square is never negative, so
that wide balls lose little.
"""

from __future__ import annotations

from collections.abc import Callable

from flint import arb

_WIDE = 1e-9
_FARTHEST = arb(2) ** 1100
"""Beyond all floats: a wave is evaluated nearer only, as it takes all bits of its argument."""


class Undecided(Exception):
    """A jump, a kink or a branch cut lies inside the ball."""


def is_wide(x: arb) -> bool:
    """Whether the ball is wide enough for its ends to be worth evaluating."""
    return bool(x.rad() > _WIDE * (1 + abs(x.mid())))


def increasing(function: Callable[[arb], arb]) -> Callable[[arb], arb]:
    """An increasing function, evaluated at both ends of wide balls."""
    return lambda x: function(x.lower()).union(function(x.upper())) if is_wide(x) else function(x)


def between(function: Callable[[arb], arb], size: Callable[[], arb]) -> Callable[[arb], arb]:
    """An increasing function with values in [-size, size], also on unbounded balls (but not of what is undefined)."""
    inner = increasing(function)
    return lambda x: inner(x) if x.is_finite() else x if x.is_nan() else arb(0, 1) * size()


def square(x: arb) -> arb:
    """Square."""
    if x.contains(0) and not x.is_zero():
        return arb(0).union(x.abs_upper() ** 2)
    return x * x


def wave(function: Callable[[arb], arb]) -> Callable[[arb], arb]:
    """A function with values in [-1, 1], also on unbounded balls (but not of what is undefined)."""
    return lambda x: function(x) if abs(x) < _FARTHEST else x if x.is_nan() else arb(0, 1)


def sin_cos(x: arb) -> tuple[arb, arb]:
    """Sine and cosine."""
    return x.sin_cos() if abs(x) < _FARTHEST else (sin(x), cos(x))


def tan(x: arb) -> arb:
    """Tangent, of no number where the argument is beyond all floats."""
    return x.tan() if abs(x) < _FARTHEST else arb.nan()


sqrt, exp, log = increasing(arb.sqrt), increasing(arb.exp), increasing(arb.log)
sin, cos = wave(arb.sin), wave(arb.cos)
asin, sinh = increasing(arb.asin), increasing(arb.sinh)
atan, tanh = between(arb.atan, lambda: arb.pi() / 2), between(arb.tanh, lambda: arb(1))


def cosh(x: arb) -> arb:
    """Hyperbolic cosine."""
    if not is_wide(x):
        return x.cosh()
    top = x.abs_upper().cosh()
    return (arb(1) if x.contains(0) else x.abs_lower().cosh()).union(top)


def acos(x: arb) -> arb:
    """Arc cosine."""
    return x.lower().acos().union(x.upper().acos()) if is_wide(x) else x.acos()


def kink(x: arb) -> arb:
    """The slope of |x|, which must not change inside the ball."""
    if x > 0:
        return arb(1)
    if x < 0:
        return arb(-1)
    raise Undecided


def generalised_kink(x: arb) -> arb:
    """The slope of |x|, all of [-1, 1] where x may be 0."""
    if x.is_nan():
        return x
    return arb(1) if x > 0 else arb(-1) if x < 0 else arb(0, 1)


def sign(x: arb) -> arb:
    """-1, 0 or 1."""
    return arb(0) if x.is_zero() else kink(x)


def floor(x: arb) -> arb:
    """Largest whole number below."""
    if not x.is_finite():
        raise Undecided
    low, high = x.lower().floor(), x.upper().floor()
    if low.is_exact() and low == high:
        return low
    raise Undecided


def holds(x: arb) -> bool:
    """Whether a condition holds (is not 0)."""
    if x.is_zero():
        return False
    if x.is_nan() or x.contains(0):
        raise Undecided
    return True


def less(x: arb, y: arb) -> arb:
    """x < y, as 0 or 1."""
    if x < y:
        return arb(1)
    if x >= y:
        return arb(0)
    raise Undecided


def at_most(x: arb, y: arb) -> arb:
    """x <= y, as 0 or 1."""
    if x <= y:
        return arb(1)
    if x > y:
        return arb(0)
    raise Undecided


def equal(x: arb, y: arb) -> arb:
    """x == y, as 0 or 1."""
    if x.is_exact() and y.is_exact() and x == y:
        return arb(1)
    if x < y or x > y:
        return arb(0)
    raise Undecided


def atan2(y: arb, x: arb) -> arb:
    """Angle of the point (x, y)."""
    if x > 0:
        return atan(y / x)
    if y > 0:
        return arb.pi() / 2 - atan(x / y)
    if y < 0:
        return -arb.pi() / 2 - atan(x / y)
    raise Undecided  # the cut, or the origin


def hypot(x: arb, y: arb) -> arb:
    """sqrt(x^2 + y^2)."""
    squares = square(x) + square(y)
    low = squares.lower()
    return (low if low > 0 else arb(0)).sqrt().union(squares.upper().sqrt())


def power(x: arb, exponent: float) -> arb:
    """x ** exponent for a constant exponent: any base where it is a whole number, else a positive one."""
    if x.is_nan():
        return x
    whole = exponent == int(exponent) and abs(exponent) <= 10_000
    if not whole:
        return _power_of_positive(x, exponent) if x > 0 else arb.nan()
    n = int(exponent)
    if n < 0:
        return 1 / power(x, -exponent)
    if not is_wide(x):
        return _whole_power(x, n)
    if n % 2:
        return _whole_power(x.lower(), n).union(_whole_power(x.upper(), n))
    least = arb(0) if x.contains(0) else _whole_power(x.abs_lower(), n)
    return least.union(_whole_power(x.abs_upper(), n))


def _whole_power(x: arb, n: int) -> arb:
    """x^n by squaring (the library's own power is undefined on some balls around 0)."""
    result = arb(1)
    while n:
        if n & 1:
            result = result * x
        n >>= 1
        if n:
            x = x * x
    return result


def _power_of_positive(x: arb, exponent: float) -> arb:
    p = arb(exponent)
    return (x.lower() ** p).union(x.upper() ** p) if is_wide(x) else x**p
