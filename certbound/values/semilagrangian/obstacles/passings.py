"""How probable it is that a path meets an obstacle within a step and ends outside of it.

The obstacle is [p0, p1] x [q0, q1]. Let Z be the distance of q from one of its ends along q, Z <= 0 on the side of the
obstacle, and let p not be in [p0, p1] before the time t. A path that meets the obstacle has Z <= 0 at some time in
[t, h]. So has every path with Z_h <= 0; and where p cannot leave [p0, p1] again, who has met the obstacle and ends with
-depth <= Z_h <= 0 ends in it. Hence

    P(meets it, ends outside) <= P(Z <= 0 at some time in [t, h]) - P(Z_h <= 0) + P(Z_h < -depth).

and P(meets it, ends outside, not with 0 < Z_h <= z) <= P(Z <= 0 at some time in [t, h], Z_h > z) + P(Z_h < -depth).
Each holds on the event of `remainders`; what is taken off may be too much by its share, for which `leaving._RARE` has
room. Narrower tubes give sharper bounds, and their rareness is added.

*Z* (`motion_of`): on the tube Z' is the drift at the end less pull Z, but for rest. The drift at the end is that for
the start's p, and changes at a rate within ``turn``; where F has one sign and dF = c dt + a s dW, also on average at
the mean of F up to then, within F_0 + c u/2 +- |a| s sup |W|, times what p changes it by. See ``reflections``.

*The time t* (`arrival_of`): |F| bounds it. Where F <= 0 all along and F_q is a constant a, dF >= c dt + a s dW, so that
p_u >= p_0 + F_0 u + c u^2/2 + a s int W, and int W up to u is normal with variance u^3/3. As p only falls, p_t > p1
tells that p was above p1 before; and given the noise M_t of Z, with xi deviations, int W is normal with the mean
xi int (t - v) e^{pull v} dv / sqrt(int e^{2 pull v} dv) (with a sign): who is early counts, given xi. All t are valid,
and the least bound of a few is taken; P(Z_h <= 0) is taken off where t < h only.

*The others*: Z_h is the end of the flow plus a normal law plus the remainder (``remainders``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Mask
from certbound.problem.model import Tape, jacobian
from certbound.rigor.intervals import Interval
from certbound.values.discrete import evaluate
from certbound.values.semilagrangian.confines import Ends
from certbound.values.semilagrangian.obstacles.reflections import Arrival, Motion, dipped, grown

_UP = 1 + 1e-9
_WIDE = (1.0, 1.7, 2.6, math.inf)
_FIRST = 2  # from which of them on wide tubes are asked, with which nothing is paid
_LITTLE = 1e-3  # of which it does not matter where it ends


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Passing:
    """What is known on the tubes of boxes of starts, shape (N,) each.

    Attributes
    ----------
    sign, end, depth : float
        Z = sign (q - end), between -depth and 0 in the obstacle.
    omega : float
        sup |W| is at most that times the root of the step on the tubes.
    pull, rest : ndarray
        Z' is the drift at the end less pull Z, but for so much.
    turn, along, bend : Interval
        How fast the drift of q at the end changes, along Z, and how it does with p; the drift of F, where F_q is
        constant and F has one sign.
    speeds : (ndarray, ndarray)
        How fast p falls and rises at most.
    turns : (ndarray, ndarray)
        c of the module where p only falls, and where it only rises; nan where that does not serve.
    slow, slowed : (ndarray, ndarray)
        For lower bounds: how fast p falls and rises at least, and what is at least c there.
    slope, tilt : ndarray
        |F_q|, and F_q where it is constant.
    stays, known : ndarray of bool
        Whether p stays between the obstacle's ends once it is there; whether all this was shown.
    """

    sign: float
    end: float
    depth: float
    omega: float
    pull: Array
    rest: Array
    turn: Interval
    along: Interval
    bend: Interval
    speeds: tuple[Array, Array]
    turns: tuple[Array, Array]
    slow: tuple[Array, Array]
    slowed: tuple[Array, Array]
    slope: Array
    tilt: Array
    stays: Mask
    known: Mask


def passing(
    ends: tuple[Ends, Ends], tape: Tape, tube: tuple[Interval, Interval], start: Interval, even: Mask, side: int,
    omega: float,
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
    omega : float
        Of the tube.
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
    single = even & known & (falls | rises)
    along = slopes[:, 2] * sign
    turn = along * f[:, 0]
    return Passing(
        sign=sign, end=end, depth=q1 - q0, omega=omega,
        pull=np.where(known, -slopes[:, 3].mid, 0.0), rest=np.where(known, rest, 0.0),
        turn=Interval(np.where(known, turn.lo, 0.0), np.where(known, turn.hi, 0.0)),
        along=Interval(np.where(known, along.lo, 0.0), np.where(known, along.hi, 0.0)),
        bend=Interval(np.where(single, drift.lo, -np.inf), np.where(single, drift.hi, np.inf)),
        speeds=(np.maximum(-f.lo[:, 0], 0.0) * _UP, np.maximum(f.hi[:, 0], 0.0) * _UP),
        turns=(
            np.where(even & known & falls, drift.lo, np.nan), np.where(even & known & rises, -drift.hi, np.nan)
        ),
        slow=(np.maximum(-f.hi[:, 0], 0.0), np.maximum(f.lo[:, 0], 0.0)),
        slowed=(
            np.where(even & known & falls, drift.hi, np.nan), np.where(even & known & rises, -drift.lo, np.nan)
        ),
        slope=slopes[:, 1].mag, tilt=slopes[:, 1].mid, known=known,
        stays=((p.lo >= p0) | rises) & ((p.hi <= p1) | falls) & known,
    )  # fmt: skip


def passed(
    found: Passing, k: int, heights: Interval, drift: Interval, away: tuple[Array, Array], rates: Interval,
    ends: Interval, variance: Interval, above: Array, s: float, step: float,
) -> Array:  # fmt: skip
    """Upper bounds of the probability that a path meets the obstacle within the step and ends outside of it.

    The first of all, then not with 0 < Z <= ``above``; shape (1 + K, N).

    Parameters
    ----------
    found : Passing
    k : int
        The box of starts.
    heights, drift : Interval, shape (N,)
        Z of the starts, and its drift at the end of the obstacle for their p.
    away : two ndarrays, shape (N,)
        Least distances of p from the obstacle where it is above its upper (below its lower) end, else at most 0.
    rates : Interval, shape (N,)
        Of F at the starts.
    ends : Interval, shape (N,)
        Z of the noise-free flow's ends, with the remainder.
    variance : Interval
        Of Z at the step's end.
    above : ndarray, shape (K,)
    s, step : float
    """
    motion = motion_of(found, k, heights, drift, rates, s, step)
    within = beyond = np.zeros(len(rates))
    if found.stays[k]:
        within, beyond = -ends.hi, -(found.depth + ends.lo)
        within = at_most(within / np.sqrt(np.where(within < 0, variance.lo, variance.hi))) * (1 - 4e-9)
        beyond = at_most(beyond / np.sqrt(np.where(beyond > 0, variance.lo, variance.hi)))
    best, chosen = np.full(len(rates), np.inf), None
    options = _WIDE[_FIRST:] if found.omega > 6 else _WIDE[:-1]
    for wide in options if np.isfinite([turn[k] for turn in found.turns]).any() else _WIDE[-1:]:
        arrival = arrival_of(found, k, away, rates, s, step, wide, upper=True)
        met, late = dipped(motion, arrival, np.array([-math.inf]), upper=True)[0], arrival.t >= step
        met = np.where(late, met, np.maximum(met - within, 0.0) + beyond)
        chosen = arrival if chosen is None else chosen.where(best <= met, arrival)
        best = np.minimum(best, met)
    higher = np.broadcast_to(best, (len(above), len(best)))
    if found.stays[k] and chosen is not None and best.max() > _LITTLE:
        higher = np.minimum(best, dipped(motion, chosen, above, upper=True) + beyond)
    return np.minimum(np.vstack([best, higher]) + 4 * float(at_most(np.array(-found.omega))), 1.0)


def motion_of(
    found: Passing, k: int, heights: Interval, drift: Interval, rates: Interval, s: float, step: float
) -> Motion:
    """Z on the tubes of a box of starts; of its parts ``heights``, ``drift`` at the obstacle's end, ``rates`` (F)."""
    rest, low, high = float(found.rest[k]), found.turn.lo[k], found.turn.hi[k]
    if math.isfinite(found.bend.lo[k]):  # the mean of F up to u, up to a noise of at most F_q s sup |W|
        noise = float(found.slope[k]) * s * found.omega * math.sqrt(step) * _UP
        mean = rates + found.bend[k] * Interval(0.0, step / 2) + Interval(-noise, noise)
        own = mean * found.along[k]
        low, high = np.fmax(low, own.lo), np.fmin(high, own.hi)
    return Motion(
        start=heights, drift=Interval(drift.lo - rest, drift.hi + rest), pull=float(found.pull[k]), s=s, step=step,
        rate=Interval(np.minimum(low, high), high) + np.zeros(len(rates)),
    )  # fmt: skip


def arrival_of(
    found: Passing, k: int, parts: tuple[Array, Array], rates: Interval, s: float, step: float, wide: float, *,
    upper: bool,
) -> Arrival:  # fmt: skip
    """When p has come to be between the obstacle's ends: up to ``wide`` deviations earlier (``upper``) or later.

    Parameters
    ----------
    parts : two ndarrays, shape (N,)
        Least (or largest) distances of p above the obstacle's upper (below its lower) end.
    wide : float
        Infinite where bounds of |F| are to serve alone.
    """
    sure = math.inf if upper else -math.inf
    t, lean, loose = np.zeros((3, len(rates)))
    gap = np.full(len(rates), sure)
    speeds, turns = (found.speeds, found.turns) if upper else (found.slow, found.slowed)
    starts = (-rates.lo, rates.hi) if upper else (-rates.hi, rates.lo)  # towards the obstacle
    late = -1.0 if upper else 1.0
    for part, speed, turn, start, turned in zip(parts, speeds, turns, starts, (1.0, -1.0)):
        out = part > 0
        with np.errstate(all="ignore"):
            first = part / float(speed[k]) * (1 + late * 1e-9)
            own = np.full(len(rates), sure)
            if math.isfinite(turn[k]) and math.isfinite(wide):
                time, noise = np.full(len(rates), step), float(found.slope[k]) * s * wide
                for _ in range(4):
                    time = np.minimum(first_root(
                        np.maximum(part + late * noise * np.sqrt(time**3 / 3), 0.0), start, float(turn[k])
                    ), step)  # fmt: skip
                own = part - start * time + float(turn[k]) * time**2 / 2
                own += late * 1e-12 * (np.abs(part) + np.abs(start) * time + abs(float(turn[k])) * time**2)
                better = out & ((time > first) if upper else (time < first))
                first, own = np.where(better, time, first), np.where(better, own, sure)
                lead, spread = _together(float(found.pull[k]), time)
                lean = np.where(better, turned * float(found.tilt[k]) * found.sign * s * lead, lean)
                loose = np.where(better, float(found.slope[k]) * s * spread, loose)
        t, gap = np.where(out, first, t), np.where(out, own, gap)
    return Arrival(t=t, gap=gap, lean=lean, loose=loose)


def _together(pull: float, t: Array) -> tuple[Array, Array]:
    """int_0^t W given int e^{pull u} dW = xi deviations: its mean over xi, and its deviation."""
    x, small = pull * t, np.abs(pull * t) < 1e-2
    share = np.where(small, 0.5 + x / 6 + x**2 / 24 + x**3 / 120 + x**4 / 720, 0.0)
    share = np.where(small, share, (np.expm1(x) - x) / np.where(small, 1.0, x) ** 2)
    lead = t**2 * share / np.sqrt(np.maximum(grown(2 * pull, t), 1e-300))
    return lead, np.sqrt(np.maximum(t**3 / 3 - lead**2, 0.0) + 1e-10 * t**3)


def first_root(away: Array, speed: Array, turn: float) -> Array:
    """The first t > 0 with away = speed t - turn t^2/2, rounded down; inf without one. For away > 0, speed >= 0."""
    rest = speed**2 * (1 + 1e-12) - 2 * turn * away
    speed = np.maximum(speed, 0.0) * _UP
    with np.errstate(over="ignore"):  # what is large and does not move is never there
        first = 2 * away / np.maximum(speed + np.sqrt(np.maximum(rest, 0.0)) * _UP, 1e-300)
    return np.where(rest < 0, np.inf, first)


def at_most(z: Array) -> Array:
    """Upper bounds of P(N(0, 1) <= z)."""
    flat = (np.asarray(z, dtype=float) / -math.sqrt(2)).ravel().tolist()
    return np.array([math.erfc(value) for value in flat]).reshape(np.shape(z)) * (0.5 * _UP) + 1e-300
