"""Activations of neural networks over intervals: values, slopes, bends, Taylor series and parallel lines around them.

An activation may have constants of its own (``leaky_relu`` its slope left of 0, ``clip`` its ends); every function of a
row takes them last. Slopes and bends are generalised where the activation has a kink (``relu``, ``leaky_relu``,
``clip``) or where its slope has one (``elu``): all that holds on either side.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from certbound.arrays import Array, Mask
from certbound.rigor import elementary as iv
from certbound.rigor import series as ts
from certbound.rigor.arithmetic import Interval

Constants = tuple[float, ...]

_TURN = 0.5773502691896258  # 1/sqrt(3) up to rounding, where 2 t^3 - 2 t has its extremes
_MOST = 0.7698003589195013  # a little above these extremes, 4/(3 sqrt 3)
_ONE = Interval.point(1.0)


OfInterval = Callable[..., Interval]
"""A function of an interval and the activation's constants."""


@dataclass(frozen=True, eq=False, slots=True)
class Activation:
    """One activation phi.

    Parameters
    ----------
    numpy : callable
        Its values in floats.
    value, slope, bend : callable
        Enclose phi, phi' and phi'' over intervals.
    rest : callable
        ``rest(x, slope)``: encloses phi(z) - slope z over x, for floats ``slope``; exact lines touch phi.
    lines : callable
        ``lines(low, high)``: slopes, in floats, of a line close below phi and of one close above between two ends.
    series : callable
        Taylor coefficients: those of its argument and the highest order.
    kinks : callable, optional
        The places of its kinks, from its constants.
    constants : int
        How many constants it has.
    """

    numpy: Callable[..., Any]
    value: OfInterval
    slope: OfInterval
    bend: OfInterval
    rest: Callable[..., Interval]
    lines: Callable[..., tuple[Array, Array]]
    series: Callable[..., ts.Series]
    kinks: Callable[..., tuple[float, ...]] | None = None
    constants: int = 0

    def kinked(self, x: Interval, constants: Constants) -> Mask:
        """Where a kink lies in the interval."""
        found = np.zeros(x.shape, dtype=bool)
        for place in self.kinks(*constants) if self.kinks is not None else ():
            found |= (x.lo <= place) & (x.hi >= place)
        return found


def _ends(x: Interval) -> tuple[Interval, Interval]:
    return Interval(x.lo, x.lo), Interval(x.hi, x.hi)


def _hull_where(result: Interval, mask: Mask, other: Interval) -> Interval:
    return Interval(
        np.where(mask, np.minimum(result.lo, other.lo), result.lo),
        np.where(mask, np.maximum(result.hi, other.hi), result.hi),
    )


def _between_ends(function: OfInterval, x: Interval, *constants: float) -> Interval:
    """The hull of a function's values at both ends: its range where it is monotone."""
    low, high = _ends(x)
    return function(low, *constants).hull(function(high, *constants))


def _at_ends(function: OfInterval, x: Interval, slope: Array, *constants: float) -> Interval:
    """The hull of phi(z) - slope z at both ends."""
    low, high = _ends(x)
    return (function(low, *constants) - low * slope).hull(function(high, *constants) - high * slope)


def chord(numpy: Callable[..., Any], low: Array, high: Array, *constants: float) -> Array:
    """The slope of the chord between two ends, in floats; 0 where there is none."""
    with np.errstate(all="ignore"):
        slope = (numpy(high, *constants) - numpy(low, *constants)) / (high - low)
    return np.where(np.isfinite(slope), slope, 0.0)


# ---- tanh and what is made of it -----------------------------------------------------------------------------------


def _tanh_slope(x: Interval) -> Interval:
    found = 1.0 - iv.sq(iv.tanh(x))
    return Interval(np.maximum(found.lo, 0.0), np.minimum(found.hi, 1.0))


def _tanh_bend(x: Interval) -> Interval:
    """-2 t (1 - t^2) with t = tanh: a cubic, extreme at t = +-1/sqrt(3)."""
    t = iv.tanh(x)

    def cubic(at: Interval) -> Interval:
        return (iv.sq(at) - 1.0) * at * 2.0

    found = _between_ends(cubic, t)
    lo = np.where((t.lo <= _TURN + 1e-12) & (t.hi >= _TURN - 1e-12), -_MOST, found.lo)
    hi = np.where((t.lo <= 1e-12 - _TURN) & (t.hi >= -_TURN - 1e-12), _MOST, found.hi)
    return Interval(np.maximum(lo, -_MOST), np.minimum(hi, _MOST))


def _tanh_rest(x: Interval, slope: Array) -> Interval:
    """tanh(z) - s z turns where tanh' = s, at +-z with tanh z = sqrt(1 - s): the value there is t - s artanh t."""
    found = _at_ends(iv.tanh, x, slope)
    inner = (slope > 0) & (slope < 1)
    s = Interval.point(np.where(inner, slope, 0.5))
    t = iv.sqrt(1.0 - s)
    place = iv.log((t + 1.0) / (1.0 - t)) / 2.0
    top = t - s * place
    found = _hull_where(found, inner & (place.lo <= x.hi) & (place.hi >= x.lo), top)
    return _hull_where(found, inner & (-place.hi <= x.hi) & (-place.lo >= x.lo), -top)


def _tanh_lines(low: Array, high: Array) -> tuple[Array, Array]:
    """The chord on the hollow side and the tangent at the middle on the other; across 0 tangents through the ends."""
    through, flat = chord(np.tanh, low, high), 1 - np.tanh((low + high) / 2) ** 2
    crossing = (low < 0) & (high > 0)
    below, above = np.where(high <= 0, flat, through), np.where(low >= 0, flat, through)
    return (
        np.where(crossing, _tanh_tangent(-high, -low, through), below),
        np.where(crossing, _tanh_tangent(low, high, through), above),
    )


def _tanh_tangent(low: Array, high: Array, otherwise: Array) -> Array:
    """The slope of the tangent at a d > 0 through tanh's point at ``low`` < 0, for d < ``high``: Newton's steps."""
    start = np.clip(low, -40.0, -1e-9)
    end, d = np.tanh(start), np.minimum(-start / 2, 0.5 * np.log1p(-4 * start))
    for _ in range(5):
        t = np.tanh(d)
        slope = 1 - t * t
        d = np.clip(d - (t - end - slope * (d - start)) / (2 * t * slope * (d - start)), 1e-9, 20.0)
    return np.where(d < high, 1 - np.tanh(d) ** 2, otherwise)


def _sigmoid_lines(low: Array, high: Array) -> tuple[Array, Array]:
    below, above = _tanh_lines(low / 2, high / 2)
    return below / 4, above / 4


def _sigmoid(x: Interval) -> Interval:
    found = (iv.tanh(x / 2.0) + 1.0) / 2.0
    return Interval(np.maximum(found.lo, 0.0), np.minimum(found.hi, 1.0))


def _sigmoid_slope(x: Interval) -> Interval:
    return _tanh_slope(x / 2.0) / 4.0


def _sigmoid_series(x: ts.Series, order: int) -> ts.Series:
    first, *rest = ts.tanh([coefficient / 2.0 for coefficient in x], order)
    return [(first + 1.0) / 2.0, *(coefficient / 2.0 for coefficient in rest)]


def _softplus(x: Interval) -> Interval:
    """log(1 + e^z) = max(z, 0) + log(1 + e^-|z|), rising."""

    def at(z: Interval) -> Interval:
        return iv.maximum(z, Interval.point(0.0)) + iv.log(iv.exp(-iv.abs_(z)) + 1.0)

    found = _between_ends(at, x)
    return Interval(np.maximum(found.lo, 0.0), found.hi)


def _softplus_rest(x: Interval, slope: Array) -> Interval:
    """Least where the sigmoid equals s: -s log s - (1 - s) log(1 - s)."""
    found = _at_ends(_softplus, x, slope)
    inner = (slope > 0) & (slope < 1)
    s = Interval.point(np.where(inner, slope, 0.5))
    low = -(s * iv.log(s)) - (1.0 - s) * iv.log(1.0 - s)
    return Interval(np.where(inner, np.minimum(found.lo, low.lo), found.lo), found.hi)


def _softplus_series(x: ts.Series, order: int) -> ts.Series:
    outer = ts.product(_sigmoid_series(x, order), ts.derivative(x, order), order)
    return ts.integral(_softplus(x[0]), outer, [_ONE], order)


def _convex_lines(
    numpy: Callable[..., Any], slope: Callable[[Array], Array]
) -> Callable[[Array, Array], tuple[Array, Array]]:
    """The tangent at the middle below, the chord above."""
    return lambda low, high: (slope((low + high) / 2), chord(numpy, low, high))


def _softplus_at(z: Array) -> Any:
    return np.logaddexp(z, 0.0)


def _elu_at(z: Array) -> Any:
    return np.where(z > 0, z, np.expm1(np.minimum(z, 0.0)))


# ---- piecewise ones ------------------------------------------------------------------------------------------------


def _elu(x: Interval) -> Interval:
    rising = _between_ends(lambda z: iv.exp(iv.minimum(z, Interval.point(0.0))) - 1.0, x)
    return Interval(np.where(x.lo >= 0, x.lo, rising.lo), np.where(x.hi >= 0, np.maximum(x.hi, 0.0), rising.hi))


def _elu_slope(x: Interval) -> Interval:
    found = iv.exp(iv.minimum(x, Interval.point(0.0)))
    return Interval(np.where(x.lo >= 0, 1.0, found.lo), np.where(x.hi >= 0, 1.0, np.minimum(found.hi, 1.0)))


def _elu_bend(x: Interval) -> Interval:
    found = iv.exp(iv.minimum(x, Interval.point(0.0)))
    return Interval(
        np.where(x.hi >= 0, 0.0, found.lo), np.where(x.lo > 0, 0.0, np.where(x.hi >= 0, 1.0, np.minimum(found.hi, 1.0)))
    )


def _elu_rest(x: Interval, slope: Array) -> Interval:
    """Convex, least where e^z = s: s - 1 - s log s."""
    found = _at_ends(_elu, x, slope)
    inner = (slope > 0) & (slope < 1)
    s = Interval.point(np.where(inner, slope, 0.5))
    low = s - 1.0 - s * iv.log(s)
    return Interval(np.where(inner, np.minimum(found.lo, low.lo), found.lo), found.hi)


def _elu_series(x: ts.Series, order: int) -> ts.Series:
    left, right = x[0].hi <= 0, x[0].lo >= 0
    rest = ts.exp([iv.minimum(x[0], Interval.point(0.0)), *x[1:]], order)[1:]
    result, crossing = [_elu(x[0])], ~(left | right)
    for k in range(1, order + 1):
        own = x[k] if k < len(x) else ts.ZERO
        wide = _elu_slope(x[0]) * own if k == 1 else Interval(-np.inf, np.inf)
        shape = np.broadcast_shapes(x[0].shape, own.shape, rest[k - 1].shape)
        parts = [part.broadcast_to(shape) for part in (own, rest[k - 1], wide)]
        result.append(Interval(
            np.where(crossing, parts[2].lo, np.where(right, parts[0].lo, parts[1].lo)),
            np.where(crossing, parts[2].hi, np.where(right, parts[0].hi, parts[1].hi)),
        ))  # fmt: skip
    return result


def _leaky(x: Interval, left: float = 0.0) -> Interval:
    zero = Interval.point(0.0)
    return iv.maximum(x, zero) + iv.minimum(x, zero) * left


def _leaky_slope(x: Interval, left: float = 0.0) -> Interval:
    low, high = min(left, 1.0), max(left, 1.0)
    lo = np.where(x.lo > 0, 1.0, np.where(x.hi < 0, left, low))
    return Interval(lo, np.where(x.lo > 0, 1.0, np.where(x.hi < 0, left, high)))


def _leaky_series(x: ts.Series, order: int, left: float = 0.0) -> ts.Series:
    zero = [ts.ZERO]
    scaled = [coefficient * left for coefficient in ts.minimum(x, zero, order)]
    return ts.add(ts.maximum(x, zero, order), scaled, order)


def _leaky_at(z: Array, left: float = 0.0) -> Any:
    return np.where(z > 0, z, left * z)


def _leaky_lines(low: Array, high: Array, left: float = 0.0) -> tuple[Array, Array]:
    """Across the kink the chord on the hollow side, on the other the line of the longer part."""
    crossing, alone = (low < 0) & (high > 0), np.where(low >= 0, 1.0, left)
    hollow = np.where(crossing, chord(_leaky_at, low, high, left), alone)
    other = np.where(crossing, np.where(high > -low, 1.0, left), alone)
    return (other, hollow) if left <= 1 else (hollow, other)


def _clip_lines(low: Array, high: Array, bottom: float, top: float) -> tuple[Array, Array]:
    """As for one kink; across both, lines through an end and the kink beyond it."""
    through = chord(np.clip, low, high, bottom, top)
    lower, upper = (low < bottom) & (high > bottom), (low < top) & (high > top)
    with np.errstate(all="ignore"):
        below = np.where(lower & upper, (top - bottom) / (high - bottom), through)
        above = np.where(lower & upper, (top - bottom) / (top - low), through)
    inside = (low >= bottom) & (high <= top)
    below = np.where(lower & ~upper, np.where(high - bottom > bottom - low, 1.0, 0.0), np.where(inside, 1.0, below))
    above = np.where(upper & ~lower, np.where(top - low > high - top, 1.0, 0.0), np.where(inside, 1.0, above))
    return below, above


def _clip(x: Interval, low: float, high: float) -> Interval:
    return Interval(np.clip(x.lo, low, high), np.clip(x.hi, low, high))


def _clip_slope(x: Interval, low: float, high: float) -> Interval:
    inside = (x.lo > low) & (x.hi < high)
    outside = (x.hi < low) | (x.lo > high)
    return Interval(np.where(inside, 1.0, 0.0), np.where(outside, 0.0, 1.0))


def _clip_series(x: ts.Series, order: int, low: float, high: float) -> ts.Series:
    return ts.minimum(ts.maximum(x, [Interval.point(low)], order), [Interval.point(high)], order)


def _straight(x: Interval, *_: float) -> Interval:
    return Interval.point(np.zeros(x.shape))


def _knotted(value: OfInterval, knots: Callable[..., tuple[float, ...]]) -> Callable[..., Interval]:
    """phi(z) - s z for piecewise linear phi: extreme at the ends and the knots."""

    def rest(x: Interval, slope: Array, *constants: float) -> Interval:
        found = _at_ends(value, x, slope, *constants)
        for place in knots(*constants):
            knot = Interval.point(np.full(x.shape, place))
            found = _hull_where(found, (x.lo <= place) & (x.hi >= place), value(knot, *constants) - knot * slope)
        return found

    return rest


def _mean_value_rest(value: OfInterval, slope_of: OfInterval) -> Callable[..., Interval]:
    """phi(z) - s z by the mean value theorem about the middle."""

    def rest(x: Interval, slope: Array, *constants: float) -> Interval:
        middle = Interval.point(x.mid)
        size = x.rad
        return value(middle, *constants) - middle * slope + (slope_of(x, *constants) - slope) * Interval(-size, size)

    return rest


def _at_zero(*_: float) -> tuple[float, ...]:
    return (0.0,)


def _at_both(low: float, high: float) -> tuple[float, ...]:
    return low, high


def _chords(numpy: Callable[..., Any]) -> Callable[[Array, Array], tuple[Array, Array]]:
    """The same slope on both sides."""

    def lines(low: Array, high: Array) -> tuple[Array, Array]:
        slope = chord(numpy, low, high)
        return slope, slope

    return lines


ACTIVATIONS: dict[str, Activation] = {
    "linear": Activation(
        lambda z: z, lambda x: x, lambda x: Interval.point(np.ones(x.shape)), _straight,
        lambda x, slope: _at_ends(lambda z: z, x, slope), lambda low, high: (np.ones(low.shape),) * 2,
        lambda x, order: x,
    ),
    "tanh": Activation(np.tanh, iv.tanh, _tanh_slope, _tanh_bend, _tanh_rest, _tanh_lines, ts.tanh),
    "sigmoid": Activation(
        lambda z: 0.5 + 0.5 * np.tanh(0.5 * z), _sigmoid, _sigmoid_slope, lambda x: _tanh_bend(x / 2.0) / 8.0,
        lambda x, slope: (_tanh_rest(x / 2.0, 4.0 * slope) + 1.0) / 2.0, _sigmoid_lines, _sigmoid_series,
    ),
    "softplus": Activation(
        _softplus_at, _softplus, _sigmoid, _sigmoid_slope, _softplus_rest,
        _convex_lines(_softplus_at, lambda z: 0.5 + 0.5 * np.tanh(0.5 * z)), _softplus_series,
    ),
    "elu": Activation(
        _elu_at, _elu, _elu_slope, _elu_bend, _elu_rest,
        _convex_lines(_elu_at, lambda z: np.exp(np.minimum(z, 0.0))), _elu_series,
    ),
    "sin": Activation(
        np.sin, iv.sin, iv.cos, lambda x: -iv.sin(x), _mean_value_rest(iv.sin, iv.cos), _chords(np.sin),
        lambda x, order: ts.circular(x, order)[0],
    ),
    "relu": Activation(
        lambda z: np.maximum(z, 0.0), _leaky, _leaky_slope, _straight, _knotted(_leaky, _at_zero), _leaky_lines,
        _leaky_series, kinks=_at_zero,
    ),
    "leaky_relu": Activation(
        _leaky_at, _leaky, _leaky_slope, _straight, _knotted(_leaky, _at_zero), _leaky_lines, _leaky_series,
        kinks=_at_zero, constants=1,
    ),
    "clip": Activation(
        np.clip, _clip, _clip_slope, _straight, _knotted(_clip, _at_both), _clip_lines, _clip_series, kinks=_at_both,
        constants=2,
    ),
}  # fmt: skip
"""Activation name to its row."""
