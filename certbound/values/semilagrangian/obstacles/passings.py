"""How probable it is that a path meets an obstacle within a step and ends outside of it.

The obstacle is [p0, p1] x [q0, q1]. Let Z be the distance of q from one of its ends along q, Z <= 0 on the side of the
obstacle, and let p not be in [p0, p1] before the time t. A path that meets the obstacle has Z <= 0 at some time in
[t, h]. So has every path with Z_h <= 0; and where p cannot leave [p0, p1] again, who has met the obstacle and ends with
-depth <= Z_h <= 0 ends in it. Hence

    P(meets it, ends outside) <= P(Z <= 0 at some time in [t, h]) - P(Z_h <= 0) + P(Z_h < -depth).

Each holds on the event of `remainders`; what is taken off may be too much by its share, for which `leaving._RARE` has
room.

*The first*: Z is at least the solution Y of dY = (push - pull Y) dt + s dW, Y_0 the least Z of the starts, since Z' is
at least that on the tube. Y_t is normal. From y > 0 on, Y meets 0 with a probability of at most c(y) (`meeting`), which
falls: its mean is at most the sum of c's falls at y_1 < y_2 < ... times P(Y_t < y_i), with c = 1 up to 0. Only h - t is
left to do so: c is that of the next larger one of h, h/sqrt(2), h/2, ...

The drift at the end is that for the start's p, and changes at a rate within ``turn``: where that gives a larger mean of
Y, it is taken (`least_mean`).

*The time t* (`_arrival`): |F| bounds it. Where F <= 0 all along and F_q is a constant a, dF >= c dt + a s dW, so that
p_u >= p_0 + F_0 u + c u^2/2 - |a| s |int W|, and int W up to u is normal with variance u^3/3. As p only falls, p_t > p1
tells that p was above p1 before: true but for a share Phi(-w) of the paths, if t is the first root of
away - (r - F_0) t + c t^2/2 with r = |a| s w sqrt(u/3) for a u >= t. The share is added; P(Z_h <= 0) is taken off where
t <= h only. All w are valid, and the least bound is taken.

*The others*: Z_h is the end of the flow plus a normal law plus the remainder (``remainders``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Mask
from certbound.lazy import compiled
from certbound.problem.model import Tape, jacobian
from certbound.rigor.intervals import Interval
from certbound.values.discrete import evaluate
from certbound.values.semilagrangian.confines import Ends

_UP = 1 + 1e-9
_FALLS = np.concatenate([0.95 ** np.arange(1, 64), 0.035 * 0.7 ** np.arange(1, 40), 2e-8 * 0.3 ** np.arange(1, 50)])
_PIECES = 800
_WIDE = (2.5, 3.0, 3.8, 6.0, math.inf)
_GRADES = 12


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Passing:
    """What is known on the tubes of boxes of starts, shape (N,) each.

    Attributes
    ----------
    sign, end, depth : float
        Z = sign (q - end), between -depth and 0 in the obstacle.
    push, pull : ndarray
        Z' >= push - pull Z.
    rest : ndarray
        Z' is the drift at the end less pull Z, but for so much.
    turn : Interval
        How fast the drift of q at the end changes, along Z.
    top : ndarray
        Z <= top.
    speeds : (ndarray, ndarray)
        How fast p falls and rises at most.
    turns : (ndarray, ndarray)
        c of the module where p only falls, and where it only rises; nan where that does not serve.
    slow, slowed : (ndarray, ndarray)
        For lower bounds: how fast p falls and rises at least, and what is at least c there.
    slope : ndarray
        |F_q|.
    stays, known : ndarray of bool
        Whether p stays between the obstacle's ends once it is there; whether all this was shown.
    """

    sign: float
    end: float
    depth: float
    push: Array
    pull: Array
    rest: Array
    turn: Interval
    top: Array
    speeds: tuple[Array, Array]
    turns: tuple[Array, Array]
    slow: tuple[Array, Array]
    slowed: tuple[Array, Array]
    slope: Array
    stays: Mask
    known: Mask


def passing(
    ends: tuple[Ends, Ends], tape: Tape, tube: tuple[Interval, Interval], start: Interval, even: Mask, side: int
) -> Passing:
    """How paths pass the lower or upper end along q of an obstacle.

    Parameters
    ----------
    ends : (Ends, Ends)
        Of the obstacle in p and q; q's at ``side`` is finite.
    tape : Tape
        (F, g) over (t, p, q).
    tube : (Interval, Interval), shape (N,)
        Where paths stay, in (p, q).
    start : Interval, shape (N,)
        p at the start.
    even : ndarray of bool, shape (N,)
        Where F_q is known to be constant.
    side : int
    """
    (p0, p1), (q0, q1) = ends
    p, q = tube
    sign, end = (1.0, q1) if side else (-1.0, q0)
    zero = Interval.point(np.zeros(len(p)))
    f, bad, _ = evaluate(tape, [zero, p, q])
    around = Interval(np.minimum(q.lo, end), np.maximum(q.hi, end))
    slopes, worse, jumps = evaluate(jacobian(tape, (1, 2)), [zero, p, around])
    drift = slopes[:, 0] * f[:, 0] + slopes[:, 1] * f[:, 1]
    falls, rises = f.hi[:, 0] <= 0, f.lo[:, 0] >= 0
    p = Interval(np.where(rises, start.lo, p.lo), np.where(falls, start.hi, p.hi))
    at, worst, _ = evaluate(tape, [zero, p, Interval.point(np.full(len(p), end))])
    known = ~bad & ~worse & ~worst & ~jumps & np.isfinite(np.hstack([f.mag, at.mag, slopes.mag])).all(axis=1)
    reach = np.maximum(np.abs(q.lo - end), np.abs(q.hi - end))
    rest = slopes[:, 3].rad * reach * _UP
    push, turn = (at[:, 1] * sign).lo - rest, slopes[:, 2] * f[:, 0] * sign
    return Passing(
        sign=sign, end=end, depth=q1 - q0, push=np.where(known, push - 1e-12 * (1 + np.abs(push)), 0.0),
        pull=np.where(known, -slopes[:, 3].mid, 0.0), rest=np.where(known, rest, 0.0),
        turn=Interval(np.where(known, turn.lo, 0.0), np.where(known, turn.hi, 0.0)),
        top=np.where(known, (q.hi - end if side else end - q.lo) * _UP, 1.0),
        speeds=(np.maximum(-f.lo[:, 0], 0.0) * _UP, np.maximum(f.hi[:, 0], 0.0) * _UP),
        turns=(
            np.where(even & known & falls, drift.lo, np.nan), np.where(even & known & rises, -drift.hi, np.nan)
        ),
        slow=(np.maximum(-f.hi[:, 0], 0.0), np.maximum(f.lo[:, 0], 0.0)),
        slowed=(
            np.where(even & known & falls, drift.hi, np.nan), np.where(even & known & rises, -drift.lo, np.nan)
        ),
        slope=slopes[:, 1].mag, stays=((p.lo >= p0) | rises) & ((p.hi <= p1) | falls) & known, known=known,
    )  # fmt: skip


def passed(
    found: Passing, k: int, low: Array, drift: Array, away: tuple[Array, Array], rates: Interval, ends: Interval,
    variance: Interval, s: float, step: float,
) -> Array:  # fmt: skip
    """Upper bounds of the probability that a path meets the obstacle within the step and ends outside of it.

    Parameters
    ----------
    found : Passing
    k : int
        The box of starts.
    low : ndarray, shape (N,)
        The least Z of the starts.
    drift : ndarray, shape (N,)
        Least drift of Z at the end of the obstacle, for p of the starts.
    away : two ndarrays, shape (N,)
        Least distances of p from the obstacle where it is above its upper (below its lower) end, else at most 0.
    rates : Interval, shape (N,)
        Of F at the starts.
    ends : Interval, shape (N,)
        Z of the noise-free flow's ends, with the remainder.
    variance : Interval
        Of Z at the step's end.
    s, step : float
    """
    push, pull = float(found.push[k]), float(found.pull[k])
    best: Array = np.ones(len(low))
    tables: dict[int, tuple[Array, Array]] = {}
    within = beyond = np.zeros(len(low))
    if found.stays[k]:
        within, beyond = -ends.hi, -(found.depth + ends.lo)
        within = at_most(within / np.sqrt(np.where(within < 0, variance.lo, variance.hi))) * (1 - 4e-9)
        beyond = at_most(beyond / np.sqrt(np.where(beyond > 0, variance.lo, variance.hi)))
    for wide in _WIDE if np.isfinite([turn[k] for turn in found.turns]).any() else _WIDE[-1:]:
        late = _arrival(found, k, away, rates, s, step, wide)
        t = np.minimum(late, step)
        mean = np.maximum(low * np.exp(-pull * t) + push * whole(pull, t), least_mean(found, k, low, drift, t))
        mean -= 1e-12 * (np.abs(low) + abs(push) * step)
        root = np.maximum(s * np.sqrt(whole(2 * pull, t)), 1e-300)
        met, left = np.zeros(len(low)), step / np.maximum(step - t, 1e-300)
        grade = np.minimum(np.floor(2 * np.log2(left)), _GRADES).astype(int)
        for j in np.unique(grade[late <= step]).tolist():
            if j not in tables:
                tables[j] = meeting(push, pull, float(found.top[k]), s, step * 2 ** (-j / 2) * _UP)
            here = np.flatnonzero(grade == j)
            met[here] = _mean_of(*tables[j], mean[here], root[here]) * _UP
        met = np.where(late > step, 0.0, np.maximum(met - within, 0.0) + beyond)
        best = np.minimum(best, met + float(at_most(np.array(-wide))))
    return best


@compiled
def _mean_of(y: Array, chance: Array, mean: Array, root: Array) -> Array:
    """The mean of the step function that falls from 1 to ``chance`` at ``y`` (and never below the last of them)."""
    found = np.empty(len(mean))
    for n in range(len(mean)):
        total, before = 0.0, 1.0
        for i in range(len(y)):
            z = (y[i] - mean[n]) / root[n]
            if z > 9.0:
                total += before
                before = 0.0
                break
            if z > -38.0:
                total += (before - chance[i]) * 0.5 * math.erfc(-z / math.sqrt(2.0))
            before = chance[i]
        found[n] = (total + before) * (1 + 1e-9) + 1e-300
    return found


def least_mean(found: Passing, k: int, low: Array, drift: Array, t: Array) -> Array:
    """Lower bounds of E Y_t for dY = (drift - rest + turn u - pull Y) du + s dW from ``low`` on."""
    pull, rate = float(found.pull[k]), float(found.turn.lo[k])
    shares = np.exp(-pull * t), np.ones(np.shape(t))  # int u e^{-pull (t - u)} lies between both times t^2/2
    change = np.minimum(rate * shares[0], rate * shares[1]) * t**2 / 2
    mean = low * shares[0] + (drift - float(found.rest[k])) * whole(pull, t) + change
    return np.asarray(mean - 1e-12 * (np.abs(low) + np.abs(drift) * t + np.abs(change)))


def meeting(push: float, pull: float, top: float, s: float, step: float) -> tuple[Array, Array]:
    """Heights 0 < y_1 < ... < y_n, and bounds of the probability that Y meets 0 within a step from each of them.

    For dY = (push - pull Y) dt + s dW as long as Y < ``top``, so that the last is 0. The least of two: by the scale
    function, whose integral is bounded piece by piece (its exponent is a parabola), and with the least drift throughout
    by the reflection principle.
    """
    top = max(top, s * math.sqrt(step))
    y = top * np.linspace(0, 1, _PIECES + 1) ** 2
    power = -(2 * push * y - pull * y**2) / s**2
    size, width = np.exp(power - power.max()), np.diff(y)
    bow = abs(pull) * width**2 / (4 * s**2)
    with np.errstate(all="ignore"):
        above = width * (size[1:] + size[:-1]) / 2 * np.exp(bow)
        below = width * np.sqrt(size[1:] * size[:-1]) * np.exp(-bow)
        rest = np.append(np.cumsum(above[::-1])[::-1], 0.0)
        scale = rest / (rest + np.append(0.0, np.cumsum(below)))
    scale = np.where(np.isfinite(scale), scale, 1.0)
    least, root = min(push, push - pull * top), s * math.sqrt(step)
    tilt = -2 * least * y / s**2
    tilt = np.where(tilt < 600, np.exp(np.minimum(tilt, 600.0)) * at_most((least * step - y) / root), 1.0)
    found = np.minimum(np.minimum(scale, at_most(-(y + least * step) / root) + tilt), 1.0) * _UP
    found = np.minimum.accumulate(np.append(found[:-1], 0.0))
    chosen = np.unique(np.minimum(np.searchsorted(-found, -_FALLS), _PIECES))
    chosen = np.append(chosen[(chosen > 0) & (chosen < _PIECES)], _PIECES)
    return y[chosen], found[chosen]


def _arrival(
    found: Passing, k: int, away: tuple[Array, Array], rates: Interval, s: float, step: float, wide: float
) -> Array:
    """Times before which p is not between the obstacle's ends, but for a share Phi(-``wide``); in no step above it."""
    late = np.zeros(len(rates))
    for part, speed, turn, start in zip(away, found.speeds, found.turns, (-rates.lo, rates.hi)):
        with np.errstate(all="ignore"):
            first = np.where(part > 0, part / float(speed[k]), 0.0)
            if math.isfinite(turn[k]) and math.isfinite(wide):
                latest = np.minimum(_root(part, start, float(turn[k])), step)
                more = float(found.slope[k]) * s * wide * np.sqrt(latest / 3) * _UP
                first = np.where(part > 0, np.maximum(first, _root(part, start + more, float(turn[k]))), 0.0)
        late = np.maximum(late, first)
    return late


def _root(away: Array, speed: Array, turn: float) -> Array:
    """The first t > 0 with away = speed t - turn t^2/2, rounded down; inf without one. For away > 0, speed >= 0."""
    rest = speed**2 * (1 + 1e-12) - 2 * turn * away
    speed = np.maximum(speed, 0.0) * _UP
    return np.where(rest < 0, np.inf, 2 * away / np.maximum(speed + np.sqrt(np.maximum(rest, 0.0)) * _UP, 1e-300))


def at_most(z: Array) -> Array:
    """Upper bounds of P(N(0, 1) <= z)."""
    flat = (np.asarray(z, dtype=float) / -math.sqrt(2)).ravel().tolist()
    return np.array([math.erfc(value) for value in flat]).reshape(np.shape(z)) * (0.5 * _UP) + 1e-300


def whole(rate: float, t: Array) -> Array:
    """The integral of e^{-rate u} over [0, t]."""
    return t if rate == 0 else np.asarray(-np.expm1(-rate * t) / rate)
