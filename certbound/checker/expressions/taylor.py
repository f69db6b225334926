"""Second-order Taylor models: an expression over a box as a quadratic polynomial and a bound of the rest.

On a box x = c + r xi, abs(xi_a) <= 1, a model v + g . xi + xi^T H xi + [-e, e] holds an expression: products keep their
terms up to the second order and bound the others, functions of one variable are expanded about v, with Lagrange's
remainder over the range of their argument. Unlike derivatives evaluated on balls, what cancels between the linear and
quadratic parts of an expression cancels here too.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from flint import arb

from certbound.checker.expressions import arithmetic as balls

_ZERO = arb(0)

K = TypeVar("K")


class Model:
    """One expression; ``linear`` and ``squares`` hold the coefficients that are not 0, ``blame`` splits the error.

    ``blame`` only guides how boxes are cut.
    """

    __slots__ = ("blame", "error", "linear", "size", "squares", "sums", "value")

    def __init__(
        self, value: arb, linear: dict[int, arb], squares: dict[tuple[int, int], arb], error: arb,
        blame: dict[int, float],
    ) -> None:
        self.value, self.linear, self.squares, self.error, self.blame = value, linear, squares, error, blame
        self.sums: tuple[arb, arb] | None = None

    @property
    def fixed(self) -> bool:
        """Whether nothing but the value is there."""
        return not self.linear and not self.squares and self.error.is_zero()

    def norms(self) -> tuple[arb, arb]:
        """Bounds of the linear and of the quadratic part."""
        if self.sums is None:
            self.sums = (
                sum((abs(x) for x in self.linear.values()), _ZERO), sum((abs(x) for x in self.squares.values()), _ZERO)
            )
        return self.sums

    def reach(self) -> arb:
        """Bound of the distance from the value."""
        first, second = self.norms()
        return (first + second + self.error).upper()

    def range(self) -> arb:
        """Ball of all values."""
        return self.value + arb(0, self.reach())

    def scaled(self, factor: arb) -> Model:
        """The model times a number."""
        size = abs(factor)
        weight = float(size.mid())
        return Model(
            self.value * factor, {a: x * factor for a, x in self.linear.items()},
            {pair: x * factor for pair, x in self.squares.items()}, self.error * size,
            {a: x * weight for a, x in self.blame.items()},
        )  # fmt: skip


def constant(value: arb) -> Model:
    return Model(value, {}, {}, _ZERO, {})


def _merged(first: dict[K, Any], second: dict[K, Any]) -> dict[K, Any]:
    """The sums of balls, or of floats, under the same key."""
    result = dict(first)
    for key, x in second.items():
        result[key] = result[key] + x if key in result else x
    return result


def _shared(amount: arb, *parts: dict[int, arb]) -> dict[int, float]:
    """An error split between coordinates by their linear coefficients."""
    size = float(amount.mid())
    if not size > 0:
        return {}
    weights: dict[int, float] = {}
    for linear in parts:
        for a, x in linear.items():
            weights[a] = weights.get(a, 0.0) + abs(float(x.mid()))
    total = sum(weights.values())
    return {a: size * weight / total for a, weight in weights.items()} if total > 0 else {}


def add(x: Model, y: Model) -> Model:
    return Model(
        x.value + y.value, _merged(x.linear, y.linear), _merged(x.squares, y.squares), x.error + y.error,
        _merged(x.blame, y.blame),
    )  # fmt: skip


def neg(x: Model) -> Model:
    return Model(
        -x.value, {a: -c for a, c in x.linear.items()}, {p: -c for p, c in x.squares.items()}, x.error, x.blame
    )


def mul(x: Model, y: Model) -> Model:
    if y.fixed:
        return x.scaled(y.value)
    if x.fixed:
        return y.scaled(x.value)
    u, v = x.value, y.value
    (l1, q1), (l2, q2) = x.norms(), y.norms()
    linear = _merged({a: c * v for a, c in x.linear.items()}, {a: c * u for a, c in y.linear.items()})
    squares = _merged({p: c * v for p, c in x.squares.items()}, {p: c * u for p, c in y.squares.items()})
    for a, c in x.linear.items():
        for b, d in y.linear.items():
            pair = (a, b) if a <= b else (b, a)
            squares[pair] = squares[pair] + c * d if pair in squares else c * d
    rest = l1 * q2 + q1 * l2 + q1 * q2
    error = rest
    if not x.error.is_zero() or not y.error.is_zero():
        error = rest + x.error * (abs(v) + l2 + q2 + y.error) + y.error * (abs(u) + l1 + q1)
    blame = _shared(rest, x.linear, y.linear)
    for model, factor in ((x, v), (y, u)):
        weight = abs(float(factor.mid()))
        blame = _merged(blame, {a: weight * c for a, c in model.blame.items()})
    return Model(u * v, linear, squares, error, blame)


def _composed(x: Model, value: arb, first: arb, half: arb, third: arb) -> Model | None:
    """phi(x) from phi, phi' and phi''/2 at the value, and phi''' over the range."""
    if not (value.is_finite() and first.is_finite() and half.is_finite() and third.is_finite()):
        return None
    linear = {a: c * first for a, c in x.linear.items()}
    squares = {p: c * first for p, c in x.squares.items()}
    items = list(x.linear.items())
    for i, (a, c) in enumerate(items):
        scaled = c * half
        for b, d in items[i:]:
            pair = (a, b) if a <= b else (b, a)
            term = scaled * d if a == b else 2 * scaled * d
            squares[pair] = squares[pair] + term if pair in squares else term
    one, two = x.norms()
    reach = one + two + x.error
    cross = two * (2 * one + two) + x.error * (2 * (one + two) + x.error)
    rest = abs(half) * cross + abs(third) * reach * reach * reach / 6
    size = abs(first)
    weight = float(size.mid())
    blame = _merged({a: weight * c for a, c in x.blame.items()}, _shared(rest, x.linear))
    return Model(value, linear, squares, rest + size * x.error, blame)


# ---- functions of one variable: phi(v), phi'(v), phi''(v)/2 and a bound of phi''' over a ball ---------------


def sqrt(v: arb, r: arb) -> tuple[arb, arb, arb, arb]:
    root = v.sqrt()
    return root, 1 / (2 * root), -1 / (8 * root * v), balls.power(r, -2.5) * 3 / 8


def exp(v: arb, r: arb) -> tuple[arb, arb, arb, arb]:
    e = v.exp()
    return e, e, e / 2, balls.exp(r)


def log(v: arb, r: arb) -> tuple[arb, arb, arb, arb]:
    return v.log(), 1 / v, -1 / (2 * v * v), 2 * balls.power(r, -3.0) if r > 0 else arb.nan()


def sin(v: arb, r: arb) -> tuple[arb, arb, arb, arb]:
    s, c = balls.sin_cos(v)
    return s, c, -s / 2, -balls.cos(r)


def cos(v: arb, r: arb) -> tuple[arb, arb, arb, arb]:
    s, c = balls.sin_cos(v)
    return c, -s, -c / 2, balls.sin(r)


def tan(v: arb, r: arb) -> tuple[arb, arb, arb, arb]:
    t, whole = balls.tan(v), balls.tan(r)
    slope, square = 1 + t * t, balls.power(whole, 2.0)
    return t, slope, t * slope, 2 * (1 + square) * (1 + 3 * square)


def asin(v: arb, r: arb) -> tuple[arb, arb, arb, arb]:
    left, whole = 1 - v * v, 1 - balls.power(r, 2.0)
    slope = 1 / left.sqrt()
    return v.asin(), slope, v * slope / (2 * left), (1 + 2 * balls.power(r, 2.0)) * balls.power(whole, -2.5)


def acos(v: arb, r: arb) -> tuple[arb, arb, arb, arb]:
    _, slope, half, third = asin(v, r)
    return v.acos(), -slope, -half, -third


def atan(v: arb, r: arb) -> tuple[arb, arb, arb, arb]:
    slope, square = 1 / (1 + v * v), balls.power(r, 2.0)
    return v.atan(), slope, -v * slope * slope, (6 * square - 2) * balls.power(1 + square, -3.0)


def sinh(v: arb, r: arb) -> tuple[arb, arb, arb, arb]:
    s, c = v.sinh_cosh()
    return s, c, s / 2, balls.cosh(r)


def cosh(v: arb, r: arb) -> tuple[arb, arb, arb, arb]:
    s, c = v.sinh_cosh()
    return c, s, c / 2, balls.sinh(r)


def tanh(v: arb, r: arb) -> tuple[arb, arb, arb, arb]:
    t, square = v.tanh(), balls.power(balls.tanh(r), 2.0)
    slope = 1 - t * t
    return t, slope, -t * slope, (1 - square) * (6 * square - 2)


def smooth(
    derivatives: Callable[[arb, arb], tuple[arb, arb, arb, arb]]
) -> Callable[[Model], Model | None]:
    """A function of one variable, given by phi(v), phi'(v), phi''(v)/2 and a bound of phi''' over a ball."""
    return lambda x: _composed(x, *derivatives(x.value, x.range()))


def power(x: Model, exponent: float) -> Model | None:
    """x ** exponent; where a factor of a derivative is 0, x may be so too."""
    p = arb(exponent)
    whole = exponent == int(exponent) and abs(exponent) <= 10_000
    if not whole and not x.range() > 0:
        return None

    def at(place: arb, k: int) -> arb:
        if whole:
            return balls.power(place, exponent - k)
        return (place.lower() ** (p - k)).union(place.upper() ** (p - k))

    factors = [p, p * (p - 1) / 2, p * (p - 1) * (p - 2)]
    found = [
        _ZERO if factor.is_zero() else factor * at(place, k + 1)
        for k, (factor, place) in enumerate(zip(factors, (x.value, x.value, x.range())))
    ]
    return _composed(x, at(x.value, 0), *found)


def _with_error(x: Model, amount: arb, *parts: dict[int, arb]) -> Model | None:
    """The model with a further error, blamed on the coordinates of some linear parts."""
    if not amount.is_finite():
        return None
    return Model(x.value, x.linear, x.squares, x.error + amount, _merged(x.blame, _shared(amount, *parts)))


def _moved(x: Model) -> Model:
    """The model less its value."""
    return Model(_ZERO, x.linear, x.squares, x.error, x.blame)


def div(x: Model, y: Model) -> Model | None:
    """x/y = q + n/y with q = v_x/v_y, n = x - q y, and 1/y = 1/v_y - d/v_y^2 + d^2/(v_y^2 y), d = y - v_y."""
    inverse = 1 / y.value
    if not inverse.is_finite():
        return None
    if y.fixed:
        return x.scaled(inverse)
    whole = y.range()
    if not (whole > 0 or whole < 0):
        return None
    quotient = x.value * inverse
    rest = _moved(add(_moved(x), _moved(y).scaled(-quotient)))
    found = add(rest.scaled(inverse), mul(rest, _moved(y)).scaled(-inverse * inverse))
    found.value = quotient
    size = y.reach() * inverse
    return _with_error(found, abs(rest.reach() * size * size) / whole.abs_lower(), y.linear, rest.linear)


def atan2(y: Model, x: Model) -> Model | None:
    """arg(z) = arg(z_0) + Im log(1 + w), w = (z - z_0)/z_0.

    |log(1 + w) - w + w^2/2| <= |w|^3/(3 (1 - |Re w|)^3).
    """
    if not x.range() > 0:
        balls.kink(y.range())
    angle = balls.atan2(y.value, x.value)
    square = x.value * x.value + y.value * y.value
    across, up = x.value / square, y.value / square
    if not (across.is_finite() and up.is_finite()):
        return None
    right, top = _moved(x), _moved(y)
    real = add(right.scaled(across), top.scaled(up))
    imaginary = add(top.scaled(across), right.scaled(-up))
    one, two = real.reach(), imaginary.reach()
    if not one < 1:
        return None
    found = add(imaginary, neg(mul(real, imaginary)))
    found.value = angle
    size = (one * one + two * two).sqrt() / (1 - one)
    return _with_error(found, size * size * size / 3, imaginary.linear, real.linear)


def hypot(x: Model, y: Model) -> Model | None:
    return smooth(sqrt)(add(mul(x, x), mul(y, y)))


def _larger(x: Model, y: Model) -> bool:
    return bool(balls.kink(add(x, neg(y)).range()) > 0)


def maximum(x: Model, y: Model) -> Model:
    return x if _larger(x, y) else y


def minimum(x: Model, y: Model) -> Model:
    return y if _larger(x, y) else x


def abs_(x: Model) -> Model:
    return x if balls.kink(x.range()) > 0 else neg(x)
