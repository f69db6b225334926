"""Activations of networks on balls, written anew: values, slopes, bends, series, and what Taylor models need."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from flint import arb

from certbound.checker.expressions import arithmetic as balls
from certbound.checker.expressions import series as ts
from certbound.checker.expressions import taylor as tm

_ONE, _ZERO = arb(1), arb(0)

Constants = tuple[float, ...]


@dataclass(frozen=True, eq=False, slots=True)
class Activation:
    """One activation; every function takes its constants last.

    ``value``, ``slope`` and ``bend`` enclose phi, phi' and phi'' (generalised at kinks) over balls; ``series`` are its
    Taylor coefficients; ``expansion`` gives phi, phi' and phi''/2 at a ball and phi''', with its sign, over another,
    where it is smooth; ``knots`` are the kinks of a piecewise linear one.
    """

    value: Callable[..., arb]
    slope: Callable[..., arb]
    bend: Callable[..., arb]
    series: Callable[..., ts.Series]
    expansion: Callable[[arb, arb], tuple[arb, arb, arb, arb]] | None = None
    knots: Callable[..., tuple[float, ...]] | None = None


def _tanh_slope(x: arb) -> arb:
    return 1 - balls.square(balls.tanh(x))


def _cubic_hull(t: arb) -> arb:
    """2 t^3 - 2 t over a ball: its slope 6 t^2 - 2 may vanish inside."""
    if not balls.is_wide(t):
        return 2 * t * (t * t - 1)
    low, high = t.lower(), t.upper()
    found: arb = (2 * low * (low * low - 1)).union(2 * high * (high * high - 1))
    turn = 1 / arb(3).sqrt()
    for place in (turn, -turn):
        if t.overlaps(place):
            found = found.union(2 * place * (place * place - 1))
    return found


def _sigmoid(x: arb) -> arb:
    return (1 + balls.tanh(x / 2)) / 2


def _sigmoid_expansion(v: arb, r: arb) -> tuple[arb, arb, arb, arb]:
    value, slope, half, third = tm.tanh(v / 2, r / 2)
    return (1 + value) / 2, slope / 4, half / 8, third / 16


def _sigmoid_series(x: ts.Series) -> ts.Series:
    first, *rest = ts.tanh([c / 2 for c in x])
    return [(1 + first) / 2, *(c / 2 for c in rest)]


def _softplus_at(x: arb) -> arb:
    return (1 + x.exp()).log() if x < 0 else x + (1 + (-x).exp()).log()


_softplus = balls.increasing(_softplus_at)


def _softplus_expansion(v: arb, r: arb) -> tuple[arb, arb, arb, arb]:
    value, slope, _, _ = _sigmoid_expansion(v, r)
    return _softplus_at(v), value, slope / 2, _cubic_hull(balls.tanh(r / 2)) / 8


def _softplus_series(x: ts.Series) -> ts.Series:
    return ts.integrated(_softplus(x[0]), ts.known(_sigmoid_series(x)), x)


def _elu_at(x: arb) -> arb:
    return x if x >= 0 else x.exp() - 1 if x < 0 else x.union(x.exp() - 1)


_elu = balls.increasing(_elu_at)


def _elu_slope(x: arb) -> arb:
    return _ONE if x >= 0 else balls.exp(x) if x < 0 else balls.exp(x.lower()).union(_ONE)


def _elu_bend(x: arb) -> arb:
    return _ZERO if x > 0 else balls.exp(x) if x < 0 else _ZERO.union(_ONE)


def _elu_expansion(v: arb, r: arb) -> tuple[arb, arb, arb, arb]:
    if r > 0:
        return v, _ONE, _ZERO, _ZERO
    if r < 0:
        e = v.exp()
        return e - 1, e, e / 2, balls.exp(r)
    return _elu_at(v), _elu_slope(v), _elu_bend(v) / 2, arb.nan()


def _elu_series(x: ts.Series) -> ts.Series:
    if x[0] > 0:
        return x
    if x[0] < 0:
        first, *rest = ts.exp(x)
        return [first - 1, *rest]
    if len(x) > 2:
        raise balls.Undecided
    return [_elu(x[0]), *(c * _elu_slope(x[0]) for c in x[1:])]


def _leaky(x: arb, left: float = 0.0) -> arb:
    return arb.max(x, _ZERO) + left * arb.min(x, _ZERO)


def _leaky_slope(x: arb, left: float = 0.0) -> arb:
    return _ONE if x > 0 else arb(left) if x < 0 else _ONE.union(arb(left))


def _leaky_series(x: ts.Series, left: float = 0.0) -> ts.Series:
    zero = ts.constant(_ZERO, len(x) - 1)
    return ts.add(ts.larger(x, zero), ts.scale(ts.smaller(x, zero), arb(left)))


def _clip(x: arb, low: float, high: float) -> arb:
    return arb.min(arb.max(x, arb(low)), arb(high))


def _clip_slope(x: arb, low: float, high: float) -> arb:
    if x > low and x < high:
        return _ONE
    return _ZERO if x < low or x > high else _ZERO.union(_ONE)


def _clip_series(x: ts.Series, low: float, high: float) -> ts.Series:
    order = len(x) - 1
    return ts.smaller(ts.larger(x, ts.constant(arb(low), order)), ts.constant(arb(high), order))


def _flat(*_: object) -> arb:
    return _ZERO


def _at_zero(*_: float) -> tuple[float, ...]:
    return (0.0,)


def _at_both(low: float, high: float) -> tuple[float, ...]:
    return low, high


ACTIVATIONS: dict[str, Activation] = {
    "linear": Activation(lambda x: x, lambda x: _ONE, _flat, lambda x: x, lambda v, r: (v, _ONE, _ZERO, _ZERO)),
    "tanh": Activation(balls.tanh, _tanh_slope, lambda x: _cubic_hull(balls.tanh(x)), ts.tanh, tm.tanh),
    "sigmoid": Activation(
        _sigmoid, lambda x: _tanh_slope(x / 2) / 4, lambda x: _cubic_hull(balls.tanh(x / 2)) / 8, _sigmoid_series,
        _sigmoid_expansion,
    ),
    "softplus": Activation(
        _softplus, _sigmoid, lambda x: _tanh_slope(x / 2) / 4, _softplus_series, _softplus_expansion
    ),
    "elu": Activation(_elu, _elu_slope, _elu_bend, _elu_series, _elu_expansion),
    "sin": Activation(balls.sin, balls.cos, lambda x: -balls.sin(x), lambda x: ts.circular(x)[0], tm.sin),
    "relu": Activation(_leaky, _leaky_slope, _flat, _leaky_series, knots=_at_zero),
    "leaky_relu": Activation(_leaky, _leaky_slope, _flat, _leaky_series, knots=_at_zero),
    "clip": Activation(_clip, _clip_slope, _flat, _clip_series, knots=_at_both),
}  # fmt: skip
"""Activation name to its row."""


def kinked(row: Activation, x: arb, constants: Constants) -> bool:
    """Whether a kink may lie in a ball."""
    return row.knots is not None and any(x.contains(place) for place in row.knots(*constants))


def line(row: Activation, x: arb, constants: Constants) -> tuple[arb, arb]:
    """(s, t) with phi(z) in s z + t for every z of a ball: a chord of a piecewise linear activation.

    phi(z) - s z is piecewise linear too: it lies between its values at the ends and at the knots inside.
    """
    assert row.knots is not None
    low, high = x.lower(), x.upper()
    if not kinked(row, x, constants):
        slope = row.slope(x, *constants)
        return slope, row.value(low, *constants) - slope * low
    places = [low, high, *(arb(place) for place in row.knots(*constants) if x.contains(place))]
    slope = arb(((row.value(high, *constants) - row.value(low, *constants)) / (high - low)).mid()) if low < high else (
        arb(row.slope(x, *constants).mid()))
    if not slope.is_finite():
        slope = _ZERO
    found = row.value(low, *constants) - slope * low
    for place in places[1:]:
        found = found.union(row.value(place, *constants) - slope * place)
    return slope, found
