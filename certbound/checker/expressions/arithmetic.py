"""The operations of a tape on balls: enclosures, and a refusal wherever a jump is not decided.

A ball whose branch is undecided raises `Undecided`; a point outside an operation's domain gives what is not a number,
which no operation takes for one. Increasing functions are evaluated at both ends, and a square is never negative, so
that wide balls lose little.
"""

from __future__ import annotations

from collections.abc import Callable

from flint import arb

__all__ = ["BALLS", "Undecided", "generalised_kink", "is_wide", "kink", "power"]

_WIDE = 1e-9


class Undecided(Exception):
    """A jump, a kink or a branch cut lies inside the ball."""


def is_wide(x: arb) -> bool:
    """Whether the ball is wide enough for its ends to be worth evaluating."""
    return bool(x.rad() > _WIDE * (1 + abs(x.mid())))


def _increasing(function: Callable[[arb], arb]) -> Callable[[arb], arb]:
    def evaluate(x: arb) -> arb:
        return function(x.lower()).union(function(x.upper())) if is_wide(x) else function(x)

    return evaluate


def _between(function: Callable[[arb], arb], size: Callable[[], arb]) -> Callable[[arb], arb]:
    """An increasing function with values in [-size, size], also on unbounded balls (but not of what is undefined)."""

    def evaluate(x: arb) -> arb:
        if not x.is_finite():
            return x if x.is_nan() else arb(0, 1) * size()
        return function(x.lower()).union(function(x.upper())) if is_wide(x) else function(x)

    return evaluate


def _square(x: arb) -> arb:
    if x.contains(0) and not x.is_zero():
        return arb(0).union(x.abs_upper() ** 2)
    return x * x


def _wave(function: Callable[[arb], arb]) -> Callable[[arb], arb]:
    def evaluate(x: arb) -> arb:
        return function(x) if x.is_finite() else x if x.is_nan() else arb(0, 1)

    return evaluate


def _cosh(x: arb) -> arb:
    if not is_wide(x):
        return x.cosh()
    top = x.abs_upper().cosh()
    return (arb(1) if x.contains(0) else x.abs_lower().cosh()).union(top)


def _acos(x: arb) -> arb:
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


def _sign(x: arb) -> arb:
    return arb(0) if x.is_zero() else kink(x)


def _floor(x: arb) -> arb:
    if not x.is_finite():
        raise Undecided
    low, high = x.lower().floor(), x.upper().floor()
    if low.is_exact() and low == high:
        return low
    raise Undecided


def _truth(x: arb) -> bool:
    if x.is_zero():
        return False
    if x.is_nan() or x.contains(0):
        raise Undecided
    return True


def _less(x: arb, y: arb) -> arb:
    if x < y:
        return arb(1)
    if x >= y:
        return arb(0)
    raise Undecided


def _at_most(x: arb, y: arb) -> arb:
    if x <= y:
        return arb(1)
    if x > y:
        return arb(0)
    raise Undecided


def _equal(x: arb, y: arb) -> arb:
    if x.is_exact() and y.is_exact() and x == y:
        return arb(1)
    if x < y or x > y:
        return arb(0)
    raise Undecided


def _atan2(y: arb, x: arb) -> arb:
    if x > 0:
        return BALLS["atan"](y / x)
    if y > 0:
        return arb.pi() / 2 - BALLS["atan"](x / y)
    if y < 0:
        return -arb.pi() / 2 - BALLS["atan"](x / y)
    raise Undecided  # the cut, or the origin


def _hypot(x: arb, y: arb) -> arb:
    squares = _square(x) + _square(y)
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


BALLS: dict[str, Callable[..., arb]] = {
    "neg": lambda x: -x,
    "sq": _square,
    "sqrt": _increasing(lambda x: x.sqrt()),
    "exp": _increasing(lambda x: x.exp()),
    "log": _increasing(lambda x: x.log()),
    "sin": _wave(lambda x: x.sin()),
    "cos": _wave(lambda x: x.cos()),
    "tan": lambda x: x.tan(),
    "asin": _increasing(lambda x: x.asin()),
    "acos": _acos,
    "atan": _between(lambda x: x.atan(), lambda: arb.pi() / 2),
    "sinh": _increasing(lambda x: x.sinh()),
    "cosh": _cosh,
    "tanh": _between(lambda x: x.tanh(), lambda: arb(1)),
    "abs": abs,
    "kink": kink,
    "sign": _sign,
    "floor": _floor,
    "not": lambda x: arb(0 if _truth(x) else 1),
    "add": lambda x, y: x + y,
    "sub": lambda x, y: x - y,
    "mul": lambda x, y: x * y,
    "div": lambda x, y: x / y,
    "atan2": _atan2,
    "hypot": _hypot,
    "min": arb.min,
    "max": arb.max,
    "lt": _less,
    "le": _at_most,
    "eq": _equal,
    "ne": lambda x, y: 1 - _equal(x, y),
    "and": lambda x, y: arb(1 if _truth(x) and _truth(y) else 0),
    "or": lambda x, y: arb(1 if _truth(x) or _truth(y) else 0),
    "if_else_zero": lambda c, y: y if _truth(c) else arb(0),
}
"""Operation name to its extension to balls (const and pow apart)."""
