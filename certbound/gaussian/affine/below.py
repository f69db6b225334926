"""Lower bounds of P(some limit is exceeded) for an affine law, from one start and the middle of the disturbances.

The events A_k = {sign * (a X_t) > b} at a grid of times, for some rows and both signs, are joined by de Caen's
inequality P(A_1 or A_2 or ...) >= sum_k P(A_k)^2 / sum_l P(A_k and A_l). Over a short horizon all covariances follow
from the rows r_l = a F(l d) alone, cov(a Z_i, a' Z_{i+m}) = sum_{l<i} r_l Q(d) r'_{l+m}, and a V_0 r'_m for a random
start. Over a long one the law of a late part hardly changes: with V(s) between V(t_s) and V(t_s) + D a covariance moves
by sqrt(r D r . a D a) at most, so that pairs are looked at lag by lag, and those beyond the last lag x have a
correlation of at most the root of (s^2 - a Q(x) a)/s^2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from flint import arb, arb_mat

from certbound.arrays import Array
from certbound.gaussian.affine.doubling import Doubling
from certbound.gaussian.affine.law import GAIN, LOSS, AffineLaw, floats, root_up
from certbound.gaussian.affine.trace import dot, rows_of
from certbound.gaussian.scalar import log_below_above, log_tail, log_tail_below
from certbound.rigor.rounding import quiet
from certbound.watch import poll

_STEPS = (32, 128)  # of a short horizon
_MANY, _LARGE = 3, 60  # rows and states beyond which the coarser ones serve
_LONG = 60.0  # mean periods from which on a horizon is long
_PERIODS = (0.08, 0.15, 0.3)  # parts of a mean period between events of a long horizon
_LATE = 12  # halvings of the horizon, after one of which the law hardly changes
_CHANGED = 1e-3  # of a variance, for which that holds
_LAGS = 512
_OPPOSITE = 0.999  # of a correlation: nearer to -1 bounds of pairs lose their accuracy

Asked = tuple[int, int, float]
"""Number of a row, sign, bound."""


@quiet
def bound_exits_below(law: AffineLaw, rows: Sequence[Sequence[float]], asked: Sequence[Asked]) -> float:
    """Lower bound of P(sign * (row X_t) > bound at some t <= horizon for some of what is asked).

    ``law.mean`` is the start; starts about it and disturbances other than their middle are not looked at.
    """
    used = sorted({row for row, _, _ in asked})
    own = [[arb(x) for x in rows[k]] for k in used]
    events = [(used.index(row), sign, bound) for row, sign, bound in asked]
    periods = [_period(law, row) for row in own]
    best = 0.0
    shortest = min(periods)
    if law.horizon <= _LONG * shortest or not law.still:
        for steps in _STEPS[: 1 if len(own) > _MANY or law.dimension > _LARGE else None]:
            poll("events at single times")
            best = max(best, _short(law, own, events, steps))
    late = _late(law, own)
    if late is not None:
        for part in _PERIODS:
            poll("events at single times")
            best = max(best, _long(law, own, events, part * shortest, late))
    return best


def _period(law: AffineLaw, row: list[arb]) -> float:
    """About the mean time between upcrossings of the middle, or what noise of its own takes to matter.

    At the end of the horizon, and no longer than that: a stationary start's variance grows by nothing.
    """
    final = law.doubling.gramian(GAIN, 0)
    if LOSS in law.doubling.sources:
        final = final - law.doubling.gramian(LOSS, 0)
    if law.covariance is not None:
        final = final + law.covariance
    fast = rows_of(arb_mat([row]) * law.slope)[0]
    s2 = float(dot(rows_of(arb_mat([row]) * final)[0], row).mid())
    e2 = float(dot(rows_of(arb_mat([fast]) * final)[0], fast).mid())
    own = float(sum((x * x for x in (arb_mat([row]) * law.noise).entries()), arb(0)).mid())
    if s2 <= 0:
        return law.horizon
    smooth = 2 * np.pi * np.sqrt(s2 / e2) if e2 > 0 else law.horizon
    return float(min(smooth, 2 * s2 / own if own > 0 else smooth, law.horizon))


def _pair(first: Array, second: Array, high: Array) -> Array:
    """Upper bounds of P(X > first, Y > second) for correlations of at most ``high``."""
    return np.exp(log_below_above(-first, second, np.clip(-high, -1.0, _OPPOSITE)))


def _short(law: AffineLaw, rows: list[list[arb]], events: list[Asked], steps: int) -> float:
    """By all pairs of times k T/steps, k = 1, ..., steps (a power of two)."""
    doubling = law.doubling
    level = int(np.ceil(np.log2(steps)))
    moved = []  # (steps + 1, n) rows of every direction
    for row in rows:
        own = [row]
        while len(own) < steps + 1:
            ahead = doubling.transition(level - int(np.log2(len(own))))
            own += rows_of(arb_mat(own) * ahead)
        moved.append(own[: steps + 1])
    gramian, count = doubling.gramian(GAIN, level), len(rows)
    if LOSS in doubling.sources:
        gramian = gramian - doubling.gramian(LOSS, level)
    low, high = np.zeros((2, count, count, steps, steps))
    for i in range(count):
        image = arb_mat(moved[i]) * gramian
        for j in range(count):
            back = arb_mat(moved[j]).transpose()
            products = rows_of(image * back)
            entries = []
            places = []
            for m in range(steps):
                total = arb(0)
                for k in range(1, steps - m + 1):
                    total = total + products[k - 1][k - 1 + m]
                    entries.append(total)
                    places.append((k - 1, k - 1 + m))
            if law.covariance is not None:  # V = V_0 + V+ - V-: what V_0 adds depends on the lag alone
                spread = rows_of(arb_mat([moved[i][0]]) * law.covariance)[0]
                constant = [dot(spread, moved[j][m]) for m in range(steps)]
                entries = [entry + constant[b - a] for entry, (a, b) in zip(entries, places)]
            a, b = (np.array(part) for part in zip(*places))
            low[i, j, a, b], high[i, j, a, b] = floats(entries)
    # cov(row i early, row j late) at (early, late)
    variance = np.array([[low[i, i].diagonal(), high[i, i].diagonal()] for i in range(count)])
    deviation = np.sqrt(np.maximum(variance, 0.0))
    means = [[dot(row, law.mean.entries()) for row in moved[i][1:]] for i in range(count)]
    levels, most, singles, signs, owner = [], [], [], [], []
    for i, sign, bound in events:
        room = floats([arb(bound) - sign * mean for mean in means[i]])
        with np.errstate(divide="ignore", invalid="ignore"):
            small = np.minimum(room[0] / deviation[i, 1], room[0] / deviation[i, 0]) * 1.0
            large = np.maximum(room[1] / deviation[i, 0], room[1] / deviation[i, 1])
        known = deviation[i, 0] > 0
        small = np.where(known, small - 1e-14 * np.abs(small), np.inf)
        large = np.where(known, large + 1e-14 * np.abs(large), np.inf)
        levels.append(small)
        most.append(large)
        singles.append(np.exp(log_tail_below(large)))
        signs.append(sign)
        owner.append(i)
    p = np.array(singles)
    sums = np.exp(log_tail(np.array(levels)))
    early, late = np.triu_indices(steps)
    for e in range(len(events)):
        for f in range(len(events)):
            i, j, sign = owner[e], owner[f], signs[e] * signs[f]
            a, b = (early, late)
            inner = a < b if e >= f else a <= b  # at one time each pair of events once
            a, b = a[inner], b[inner]
            if e == f:
                a, b = early[early < late], late[early < late]
            cov = np.where(sign > 0, high[i, j, a, b], -low[i, j, a, b])
            scale = np.where(cov > 0, deviation[i, 0, a] * deviation[j, 0, b], deviation[i, 1, a] * deviation[j, 1, b])
            with np.errstate(divide="ignore", invalid="ignore"):
                rho = np.where(scale > 0, cov / scale, 0.0)
            both = _pair(levels[e][a], levels[f][b], np.clip(rho + 1e-14, -1.0, 1.0))
            np.add.at(sums[e], a, both)
            np.add.at(sums[f], b, both)
    with np.errstate(divide="ignore", invalid="ignore"):
        value = float(np.sum(np.where(p > 0, p * p / sums, 0.0))) * (1 - 1e-11)
    return min(max(value, float(p.max(initial=0.0)) * (1 - 1e-12)), 1.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Late:
    """From T/2^level on V(s) is between ``start`` and that plus ``change``; ``rest`` is left of the horizon."""

    start: arb_mat
    change: arb_mat
    rest: float


def _late(law: AffineLaw, rows: list[list[arb]]) -> _Late | None:
    """The earliest of the halves of halves of the horizon from which on the rows' variances hardly change."""
    if not law.still:
        return None
    doubling, best = law.doubling, None
    whole = doubling.gramian(GAIN, 0)
    if LOSS in doubling.sources:
        whole = whole + doubling.gramian(LOSS, 0)
    for level in range(1, _LATE + 1):
        forward = doubling.transition(level)
        change = forward * whole * forward.transpose()
        start = doubling.gramian(GAIN, level)
        if LOSS in doubling.sources:
            start = start - doubling.gramian(LOSS, level)
        if law.covariance is not None:
            start = start + law.covariance
        ratio = 0.0
        for row in rows:
            s2 = float(dot(rows_of(arb_mat([row]) * start)[0], row).mid())
            more = float(dot(rows_of(arb_mat([row]) * change)[0], row).mid())
            ratio = max(ratio, more / s2 if s2 > 0 else np.inf)
        if not ratio <= _CHANGED:
            break
        best = _Late(start=start, change=change, rest=law.horizon * (1 - 2.0**-level))
    return best


def _long(law: AffineLaw, rows: list[list[arb]], events: list[Asked], step: float, late: _Late) -> float:
    """By lags of multiples of ``step`` within the late part."""
    count = int(late.rest / step * (1 - 1e-12))
    if count < 2:
        return 0.0
    lags, number = min(_LAGS, count - 1), len(rows)
    forward = Doubling(law.slope, {GAIN: law.parts[0]}, step)
    moved = []
    for row in rows:
        own, power = [row], forward.transition(0)
        while len(own) < lags + 1:
            own += rows_of(arb_mat(own) * power)
            power = power * power
        moved.append(own[: lags + 1])
    back = arb_mat(rows).transpose()
    high, low = np.zeros((2, number, number, lags + 1))
    start, moves = late.start * back, late.change
    both = [np.array(floats((arb_mat(own) * start).entries())).reshape(2, lags + 1, number) for own in moved]
    norms = []
    for own in moved:
        matrix = arb_mat(own)
        norms.append(root_up(floats([dot(r, image) for r, image in zip(own, rows_of(matrix * moves))])[1]))
    for j in range(number):  # row j later by the lag, row i before
        for i in range(number):
            slack = norms[j] * norms[i][0] * (1 + 1e-12)
            low[i, j], high[i, j] = both[j][0][:, i] - slack, both[j][1][:, i] + slack
    least = np.array([both[i][0][0, i] for i in range(number)])
    if law.covariance is not None:
        least = least - np.array([norms[i][0] ** 2 for i in range(number)])
    most = np.array([both[i][1][0, i] + norms[i][0] ** 2 for i in range(number)]) * (1 + 1e-12)
    if not np.all(least > 0):
        return 0.0
    inner, outer = np.sqrt(least) * (1 - 1e-15), np.sqrt(most) * (1 + 1e-15)
    # beyond the last lag
    beyond = Doubling(law.slope, {GAIN: arb_mat(law.noise * law.noise.transpose())}, step * lags)
    kept = [dot(rows_of(arb_mat([row]) * beyond.gramian(GAIN, 0))[0], row) for row in rows]
    tails = root_up(most - floats(kept)[0]) / inner
    value = 0.0
    for e, (i, sign, bound) in enumerate(events):
        small, large = bound / outer[i] * (1 - 1e-14), bound / inner[i] * (1 + 1e-14)
        p = float(np.exp(log_tail_below(large)))
        total = float(np.exp(log_tail(small)))
        for f, (j, other, limit) in enumerate(events):
            level = limit / outer[j] * (1 - 1e-14)
            for first, second in ((i, j), (j, i)):
                cov = np.where(sign * other > 0, high[first, second], -low[first, second])
                scale = np.where(cov > 0, inner[first] * inner[second], outer[first] * outer[second])
                rho = np.clip(cov / scale + 1e-14, -1.0, 1.0)
                pairs = _pair(np.full(lags + 1, small), np.full(lags + 1, level), rho)
                total += float(np.sum(pairs[1:]))
                if f != e and (first, second) == (i, j):
                    total += float(pairs[0])
            if count - 1 > lags:
                far = min(max(tails[i], tails[j]) + 1e-14, 1.0)
                total += 2 * (count - 1 - lags) * float(_pair(np.array([small]), np.array([level]), np.array([far]))[0])
        value += count * p * p / (total * (1 + 1e-11)) if p > 0 else 0.0
    return min(value * (1 - 1e-11), 1.0)
