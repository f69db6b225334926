"""How probable it is that Z <= 0 at some time in [t, h] and Z_h > z at the end of the step: from above and from below.

Let Z lie between Y and Y', the solutions of dY = (drift + rate u - pull Y) du + s dW with the least and the largest
start, drift and rate. M_u = s int e^{pull v} dW is a Brownian motion in the time tau(u) = s^2 int e^{2 pull v} dv, and
e^{pull u} Y_u = M_u + A(u), A(u) = Y_0 + drift int e^{pull v} dv + rate int v e^{pull v} dv; the last integral is u^2/2
up to a factor between 1 and e^{pull h}, which is given to rate. Let A + M belong to Y, A' + M to Y'.

*A line* a + m tau that lies above A' on [t, h] serves for lower bounds, one below A for upper bounds: the chord, moved
by (tau_h - tau_t)^2/8 times what d^2A/dtau^2 is at least (at most). Let V = M + a + m tau. From below, V <= 0 somewhere
in [t, h] and M_h > e^{pull h} z - A(h) will do; from above both are needed, the last one with A'(h). V is a Brownian
motion with the drift m. Given V_t = v > 0, by the reflection principle, for x >= 0

    P(V <= 0 somewhere in [t, h], V_h > x) = e^{-2 m v} P(N(m r - v, r) > x),   r = tau_h - tau_t,

and e^{-2 m v} times the density of V_t at v is e^{-2 m a} times that at -v of the motion from -a. So it is
B(a) + e^{-2 m a} B(-a) without the condition, B(a) = P(V_t <= 0, V_h > x | V_0 = a), an integral of phi(xi) times
Phi((xi - c)/kappa): on pieces Phi lies between its chord and a tangent, and mass and first moment of phi are known.

*Who is there* at t (`Arrival`) depends on xi = M_t/sqrt(tau_t). From below, a share of who is not is left out of every
piece; the reflected xi is -xi - 2 m sqrt(tau_t). From above, who was there before t and has V_t > 0 is added, since
V_t <= 0 has been counted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Mask
from certbound.lazy import compiled, within
from certbound.rigor.intervals import Interval

_PIECES, _FEW, _RARELY = 8, 3, 1e-5  # pieces, and how many where hardly any path is
_FAR = 6.0
_SURE = 1e-10  # relative, for every erfc and product


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Motion:
    """dZ = (drift + rate u - pull Z) du + s dW for u in a step, with bounds of start, drift and rate, shape (N,)."""

    start: Interval
    drift: Interval
    rate: Interval
    pull: float
    s: float
    step: float


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Arrival:
    """Times t, shape (N,), and who is not there by then (from above: who is there before), given the noise up to them.

    With M_t = xi sqrt(tau) that is P(N(0, 1) <= (``gap`` + ``lean`` xi)/``loose``), from above with the other sign.
    """

    t: Array
    gap: Array
    lean: Array
    loose: Array

    def where(self, kept: Mask, other: Arrival) -> Arrival:
        """This one where it is kept, else another."""
        names = ("t", "gap", "lean", "loose")
        return Arrival(**{name: np.where(kept, getattr(self, name), getattr(other, name)) for name in names})


def dipped(motion: Motion, arrival: Arrival, above: Array, *, upper: bool) -> Array:
    """Bounds of P(Z <= 0 somewhere in [t, step], Z_step > z), from below with who is there at t, from above or earlier.

    Parameters
    ----------
    above : ndarray, shape (K,)
        The z: not negative; or -inf, for upper bounds.

    Returns
    -------
    ndarray, shape (K, N)
    """
    k, h, last = motion.pull, motion.step, motion.s**2 * grown(2 * motion.pull, np.array(motion.step))
    t = np.minimum(arrival.t, h * (1 - 1e-6))
    tau = motion.s**2 * grown(2 * k, t)
    own, others = (("lo", "hi") if upper else ("hi", "lo"))
    start, end, other = _sum(motion, own, t), _sum(motion, own, np.array(h)), _sum(motion, others, np.array(h))
    size = motion.start.mag + (motion.drift.mag + motion.rate.mag * h) * h * math.exp(4 * abs(k) * h)
    slack = (1e-12 + 8e-15 / (1 - t / h)) * size  # a line through two times that are close is off by more
    sign = -1.0 if upper else 1.0
    move = sign * (_bent(motion, own, -sign) * (last - tau) ** 2 / 8 * (1 + 1e-9) + slack)
    slope = (end - start) / (last - tau)
    height = math.exp(k * h) * above[:, None]
    beyond = height * (1 + sign * 1e-12) + (end + move - other + sign * slack)
    absent = np.stack([arrival.gap, arrival.lean, np.maximum(arrival.loose, 1e-300)])
    found = _hits(start + move - slope * tau, slope, tau, float(last), beyond, slack, absent, upper)
    if upper:  # who is there by the end only: all of those, whatever Z does
        late = np.flatnonzero(arrival.t >= h)
        loose = np.sqrt(arrival.lean[late] ** 2 + arrival.loose[late] ** 2)
        with np.errstate(over="ignore"):  # so many deviations that no path is there
            gaps = (arrival.gap[late] / np.maximum(loose, 1e-300) / math.sqrt(2)).tolist()
        found[:, late] = np.array([0.5 * math.erfc(gap) for gap in gaps]) * (1 + 1e-8) + 1e-300
        found[:, (arrival.t > t) & (arrival.t < h)] = 1.0  # too near to the end for these formulas
        return np.asarray(found)
    return np.where(arrival.t > h * (1 - 1e-6), 0.0, found)


def grown(rate: float, t: Array) -> Array:
    """The integral of e^{rate u} over [0, t]."""
    return t if rate == 0 else np.asarray(np.expm1(rate * t) / rate)


def _rate(motion: Motion, side: str) -> Array:
    pick = np.maximum if side == "hi" else np.minimum
    rate: Array = getattr(motion.rate, side)
    return np.asarray(pick(rate, rate * math.exp(motion.pull * motion.step)))


def _sum(motion: Motion, side: str, t: Array) -> Array:
    """A(t) of one side."""
    start, drift = getattr(motion.start, side), getattr(motion.drift, side)
    return np.asarray(start + drift * grown(motion.pull, t) + _rate(motion, side) * t**2 / 2)


def _bent(motion: Motion, side: str, sign: float) -> Array:
    """What ``sign`` d^2A/dtau^2 is at most, or 0: (rate (1 - 2 pull u) - pull drift e^{pull u}) e^{-4 pull u}/s^4."""
    k, h, rate = motion.pull, motion.step, sign * _rate(motion, side)
    first = np.maximum(rate, rate * (1 - 2 * k * h))
    second = -k * sign * getattr(motion.drift, side)
    second = np.maximum(second, second * math.exp(k * h))
    return np.asarray(np.maximum(first + second, 0.0) * max(1.0, math.exp(-4 * k * h)) / motion.s**4)


@within
def _below(z: float) -> float:
    return 0.5 * math.erfc(-z / math.sqrt(2.0))


@within
def _joint(
    a: float, m: float, tau: float, last: float, x: float, absent: tuple[float, float, float], upper: bool
) -> float:
    """B(a) from above, or from below and without a share Phi((gap + lean xi)/loose) of who is at xi deviations."""
    if tau <= 0.0:
        return _below((a + m * last - x) / math.sqrt(last)) if a <= 0.0 else 0.0
    root, wide = math.sqrt(tau), math.sqrt((last - tau) / tau)
    end, middle = -(a + m * tau) / root, (x - a - m * last) / root
    low = max(middle - _FAR * wide, min(end, 0.0) - _FAR / (1 + max(-end, 0.0) / 3))
    top = max(min(end, middle + _FAR * wide, _FAR), low)
    if low >= end:
        return _below(end) * _below((end - middle) / wide) if upper else 0.0
    gap, lean, loose = absent
    pieces = _PIECES if _below(end) > _RARELY else _FEW
    total = _below(low) * _below((low - middle) / wide) if upper else 0.0
    late = 0.0 if upper else _below((gap + lean * low) / loose)
    for half in range(3):  # where the chance rises faster, where slower, and where it is nearly 1
        bend = max(min(middle, top), low)
        start = (low, bend, top)[half]
        width = ((bend, top, end)[half] - start) / (pieces if half < 2 else 1)
        for i in range(pieces if half < 2 else 1) if width > 0.0 else range(0):
            one, two = start + i * width, start + (i + 1) * width
            before, mass = _below(one), _below(two)
            error = _SURE * (before + mass)
            mass -= before
            share = (_density(one) - _density(two) - one * mass) / width  # the first moment
            more = 1e-15 * (1 + abs(one)) * (_density(one) + _density(two) + before) / width
            if (half == 0) == upper:
                left, right = _below((one - middle) / wide), _below((two - middle) / wide)
            else:
                place = ((one + two) / 2 - middle) / wide
                left, right = _below(place), _density(place) * width / wide / 2
                left, right = left - right, left + right
            if half == 2:
                left = right = 1.0 if upper else _below((top - middle) / wide)
            if upper:
                share = min(max(share + more, 0.0), mass + error)
                total += left * (mass + error) + (right - left) * share
            else:
                before, late = late, _below((gap + lean * two) / loose)
                share = max(share - more, 0.0)
                part = left * (mass - error if left > 0.0 else mass + error) + (right - left) * share
                step = max(mass - error, 0.0) * _below((one - middle) / wide - 1e-12)
                total += max(part * (1 - _SURE), step) * max(1 - max(late, before) * (1 + 1e-8), 0.0)
    return float(total)


@within
def _density(z: float) -> float:
    return math.exp(-z * z / 2) / math.sqrt(2 * math.pi)


@within
def _early(low: float, gap: float, lean: float, loose: float) -> float:
    """P(xi > low, xi lean + N(0, loose^2) <= -gap), from above."""
    top = max(low, 0.0) + _FAR
    before, chance = _below(-low), _below(-(gap + lean * low) / loose)
    total = _below(-top) * (_below(-(gap + lean * top) / loose) if lean >= 0.0 else 1.0) * (1 + 1e-8)
    pieces = 12 * _FEW
    for i in range(1, pieces + 1):
        place = low + (top - low) * (i / pieces) ** 2
        now, mass = _below(-(gap + lean * place) / loose), _below(-place)
        total += max(before * (1 + _SURE) - mass * (1 - _SURE), 0.0) * max(chance, now) * (1 + 1e-8)
        before, chance = mass, now
    return float(total)


@compiled
def _hits(
    first: Array, slope: Array, times: Array, last: float, beyond: Array, slack: Array, absent: Array, upper: bool
) -> Array:
    """P(V <= 0 somewhere, V_h > x), shape (K, N); for x < 0 (upper bounds) with P(x < V_h <= 0)."""
    found = np.empty(beyond.shape)
    share = (1 + 1e-9) if upper else (1 - 1e-9)
    for n in range(len(first)):
        a, m, tau = first[n], slope[n], times[n]
        power = -2 * m * a + (2 if upper else -2) * abs(m) * slack[n]
        gap, lean, loose, root = absent[0, n], absent[1, n], absent[2, n], max(math.sqrt(tau), 1e-300)
        turned = gap - 2 * lean * m * math.sqrt(tau), -lean, loose
        more = _early(-(a + m * tau) / root, gap, lean, loose) if upper and tau > 0.0 and gap < 1e300 else 0.0
        if not upper and a > 0.0 and _below(-(a + m * tau) / root) < _RARELY and power < -12.0:
            found[:, n] = 0.0  # too little to count
            continue
        for k in range(len(beyond)):
            x = max(beyond[k, n], 0.0)
            total = more + _joint(a, m, tau, last, x, (gap, lean, loose), upper)
            if (tau > 0.0 or a > 0.0) and power > -700.0:
                other = _joint(-a, m, tau, last, x, turned, upper) + (1e-300 if upper else 0.0)
                total += math.exp(min(power, 600.0)) * other if power < 600.0 or not upper else 1.0
            if beyond[k, n] < 0.0:
                middle, wide = a + m * last, math.sqrt(last)
                total += _below(-middle / wide) * (1 + _SURE)
                if beyond[k, n] > -1e300:
                    total -= _below((beyond[k, n] - middle) / wide) * (1 - _SURE)
            found[k, n] = min(max(total, 0.0) * share, 1.0)
            if upper:
                found[k, n] += 1e-300
    return found
