"""Crossings of a row with noise of its own (a G != 0): Slepian's comparison in blocks within the pieces of its trace.

For s < t = s + x let g_s(x) = a F(x) V(s) a, so that corr = g_s(x)/(s_s s_t), and w_s = dg_s/dx = a A F(x) V(s) a. If
-w_s(x) <= k g_s(x) for all x up to a block's length and all s in a piece, then -log corr(s, t) <= k (t - s) +
log(s_t/s_s): in the clock that grows by k dt and by half of what V+ adds to log s^2 the row crosses no oftener than a
stationary Ornstein-Uhlenbeck process. The rows a F(x) on a grid of x serve all pieces; between its nodes g, w and the
norms of rows in what V changes by are within x^2/8 of their chords, times bounds of their second derivatives by Cauchy
and Schwarz, |b F(y) V(s) a| <= sd(b Z_{s+y}) s_s.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from flint import arb_mat

from certbound.arrays import Array, Integers, Mask
from certbound.gaussian.affine.law import GAIN, floats, root_up
from certbound.gaussian.affine.row_windows import Chain, own_noise
from certbound.gaussian.affine.trace import Trace, dot, rows_of
from certbound.gaussian.scalar import (
    Clock,
    clock_crossing,
    log_between,
    log_line_crossing,
    log_polygon_crossing,
    log_tail,
    log_tail_below,
)
from certbound.rigor.rounding import quiet

_PARTS = 8  # cells of lags between two doublings
_SHORT, _FIRST = 0.005, 0.01  # of the initial decay, what the first cell may leave open; its length, of that decay's
_SHARES = (0.0, 0.4, 0.7, 0.85, 0.93, 0.97)  # of a variance that may stand still over a block
_CLOCKS = np.array([0.02 * 1.25**k for k in range(25)])  # of blocks, up to 4.2
_LEVELS = np.concatenate([np.arange(-4.0, 0.0, 0.25), np.arange(0.0, 12.01, 0.06)])  # in deviations, of the table
_SHORTER, _JOINED = 0.8, (0.8, 1.7, 3.5)  # clocks of pieces that are joined to one block, and of the block
_WEIGHT = 2.0  # clock of a window times the square of the level, as in `clock_crossing`
_MOST = 64  # windows of a block


@dataclass(frozen=True, eq=False, kw_only=True)
class Lags:
    """Rows a F(x) at lags, from 0 on: (J + 1,), what bounds curvature over the cell after each, in balls and floats."""

    times: Array
    rows: arb_mat
    moved: arb_mat
    bends: Array  # (J,): sd of the second derivative of a A F(x) Z over a cell


def lags_of(trace: Trace, longest: float) -> Lags:
    """Lags up to about ``longest``, fine enough at the first for the row's own noise."""
    law, doubling = trace.law, trace.law.doubling
    top = doubling.gramian(GAIN, 0) if law.covariance is None else doubling.gramian(GAIN, 0) + law.covariance
    size = float(np.max(trace.s[1])) ** 0.5
    row, own = arb_mat([trace.row]), own_noise(trace)
    level = 0
    third = row * law.slope * law.slope * law.slope
    sharp = float(root_up(floats([dot(third.entries(), (third * top).entries())])[1])[0])
    step = law.horizon
    slow = 2 * size**2 / own  # the time in which its own noise alone would decorrelate the row
    while step > longest or ((step**2 / 8 * sharp * size > _SHORT * own or step > _FIRST * slow) and level < 150):
        step, level = step / 2, level + 1
    times, rows = [0.0, step], [trace.row, rows_of(row * doubling.transition(level))[0]]
    while times[-1] < longest * (1 - 1e-9):
        inner = doubling.transition(level + 3)
        start = times[-1]
        for part in range(_PARTS):
            rows.append(rows_of(arb_mat([rows[-1]]) * inner)[0])
            times.append(start + start * (part + 1) / _PARTS)
        level -= 1
    matrix = arb_mat(rows)
    moved = matrix * law.slope
    image = moved * law.slope * law.slope
    squares = [dot(r, i) for r, i in zip(rows_of(image), rows_of(image * top))]
    return Lags(times=np.array(times), rows=matrix, moved=moved, bends=root_up(floats(squares)[1][:-1]))


def _largest_rate(lost: Array, moved: Array, least: Array, most: Array) -> Array:
    """The largest (lost + moved r)/(least + r^2) for r in [0, most], what V changes by along the row being r^2 at most.

    With s^2 = s_k^2 + r^2 - 2 (what V- adds) at the time of it, -w_s/s_s^2 is at most that.
    """
    at = moved * least / (lost + np.sqrt(lost**2 + moved**2 * np.maximum(least, 0.0)))
    at = np.where(np.isfinite(at), np.minimum(at, most), 0.0)
    found = (lost + moved * at) / (least + at**2)
    inside = at < most  # at a maximum the function is flat: a rounding of its place costs nothing
    found = np.where(inside, found * (1 + 1e-12), (lost + moved * most) / (least + most**2) * (1 + 1e-12))
    return np.where((least > 0) & np.isfinite(found), found, np.where(least > 0, lost / least, np.inf))


def _plain(matrix: arb_mat) -> tuple[Array, Array]:
    """Middle and radius in floats."""
    low, high = floats(matrix.entries())
    shape = matrix.nrows(), matrix.ncols()
    middle = 0.5 * (low + high)
    return middle.reshape(shape), ((high - low) * 0.5 + 4e-16 * np.abs(middle) + 1e-300).reshape(shape)


@dataclass(eq=False)
class Decays:
    """Bounds k of the decay of g over the lags, piece by piece."""

    trace: Trace
    lags: Lags

    def __post_init__(self) -> None:
        self._known: dict[tuple[int, int], Array] = {}
        self._moved = _plain(self.lags.moved)
        self.own = own_noise(self.trace)

    def of(self, places: Integers) -> Array:
        """(P, 2, J + 1): a lower bound of g/s^2 at every lag, and how far below its chord it may be until the next one.

        In the first cell it is above the chord from 1 on; minus infinity where nothing is known.
        """
        trace = self.trace
        keys = [(int(trace.levels[k]), trace.indices[k]) for k in places.tolist()]
        new = [(key, k) for key, k in zip(keys, places.tolist()) if key not in self._known]
        if new:
            self._matrices = trace.matrices()
            for (key, _), values in zip(new, self.over([(k, k + 1) for _, k in new])):
                self._known[key] = values
        return np.array([self._known[key] for key in keys])

    @quiet
    def over(self, spans: list[tuple[int, int]]) -> Array:
        """The same over runs of pieces, from a first one to the one before a last."""
        trace, lags = self.trace, self.lags
        law = trace.law
        own = arb_mat([trace.row]).transpose()
        start = None if law.covariance is None else law.covariance * own
        vectors = []
        for k, _ in spans:
            gain, loss = self._matrices[k]
            vector = gain * own - loss * own
            vectors.append(vector if start is None else vector + start)
        joined = arb_mat([[v[i, 0] for v in vectors] for i in range(law.dimension)])
        count = lags.rows.nrows()
        w = np.array(floats((lags.moved * joined).entries())).reshape(2, count, -1)
        norms = np.array([self._norms(*span) for span in spans])  # (P, J + 1)
        spread = trace.spread_of()
        low = np.array([[np.min(spread[0][first:last])] for first, last in spans])
        high = np.array([[np.max(spread[1][first:last])] for first, last in spans])
        changed = root_up(np.array([[self._change(*span)] for span in spans]))  # sd of what V changes by along the row
        gap = np.diff(lags.times)
        fall = -w[0].T  # (P, J + 1), of g
        bend = root_up(high) * lags.bends * gap**2 / 8 * (1 + 1e-12)
        moved = np.maximum(norms[:, :-1], norms[:, 1:]) + lags.bends * gap**2 / 8
        extra = bend + changed * moved
        first, last = fall[:, :-1], fall[:, 1:]
        lost = np.where(np.arange(len(gap)) == 0, np.maximum(first, last), 0.5 * (first + last)) + bend
        columns = trace.columns
        least = np.array([[trace.s[0][k] - 2 * np.sum(columns["loss s"][k:last])] for k, last in spans]) * (1 - 1e-14)
        rate = _largest_rate(np.maximum(lost, 0.0), moved, least, changed)
        bound = 1 - np.cumsum(rate * gap, axis=1) * (1 + 1e-12)
        below = gap * (np.abs(last - first) / 8 + extra) / low * (1 + 1e-12) + 1e-13
        bound = np.pad(bound, ((0, 0), (1, 0)), constant_values=1.0)
        result = np.stack([bound, np.pad(below, ((0, 0), (0, 1)))], axis=1)
        return np.where(np.isnan(result) | (low[:, None] <= 0), -np.inf, result)

    def _change(self, first: int, last: int) -> float:
        """Bound of a (D+ + D-) a over a run of pieces."""
        columns = self.trace.columns
        return float(np.sum(columns["gain s"][first:last] + columns["loss s"][first:last])) * (1 + 1e-12)

    def _norms(self, first: int, last: int) -> Array:
        """Norms of the moved rows in D+ + D- over a run of pieces, in floats with their rounding."""
        before, after = self._matrices[first], self._matrices[last]
        middle, radius = _plain(after[0] - before[0] + after[1] - before[1])
        slack = 4e-16 * len(middle)
        rows, error = self._moved
        whole = np.abs(rows) + error
        value = np.einsum("ji,ik,jk->j", rows, middle, rows)
        value += np.einsum("ji,ik,jk->j", whole, radius + slack * np.abs(middle), whole)
        value += 2 * np.einsum("ji,ik,jk->j", error, np.abs(middle), whole)
        return root_up(value * (1 + 1e-12))


@quiet
def rough_parts(trace: Trace, decays: Decays, lines: Array, chosen: Integers, *, closely: bool) -> Chain:
    """What crossing ``lines`` (K, 2) costs on the ``chosen`` pieces, which follow each other.

    The level counts as constant over a piece, the least z over the largest s. A piece is cut into equal blocks, no
    longer than the lags over which its decay is known. Only ``closely`` some of the variance may stand still over a
    block.
    """
    low, high = (x[chosen] for x in trace.spread_of())
    level = np.min(lines[chosen], axis=1) / root_up(high) * (1 - 1e-14)
    grown = 0.5 * trace.columns["gain s"][chosen] / low * (1 + 1e-12)  # what V+ adds to the clock
    known = decays.of(chosen)
    costs = np.full(len(chosen), np.inf)
    for share in _SHARES if closely else _SHARES[:1]:
        costs = np.fmin(costs, _with_share(share, known, decays.lags.times, trace.steps[chosen], level, grown))
    costs = np.where((level >= 0) & (low > 0), costs, np.inf)
    return Chain(costs=costs, enters=level, leaves=level)


@quiet
def joined_parts(
    trace: Trace, decays: Decays, lines: Array, chosen: Integers, pieces: Array, leaves: Array
) -> Array:  # fmt: skip
    """The costs of pieces where short ones that follow each other are one block: all of it at the first.

    Every piece is a window of the block's polygon then, and begins nothing anew. ``leaves``: levels at the ends of
    pieces, as in `Chain`, none of which is below the level of a polygon there.
    """
    low, high = (x[chosen] for x in trace.spread_of())
    level = np.min(lines[chosen], axis=1) / root_up(high) * (1 - 1e-14)
    grown = 0.5 * trace.columns["gain s"][chosen] / low * (1 + 1e-12)
    h, times = trace.steps[chosen], decays.lags.times
    about = decays.own / (2 * low) * h  # clocks of the pieces
    fits = (about <= _SHORTER) & np.isfinite(pieces) & (level >= 0)
    best = pieces
    for most in _JOINED:
        runs = _runs(about, fits, most)
        if runs:
            known = decays.over([(int(chosen[first]), int(chosen[last - 1]) + 1) for first, last in runs])
            speeds = _speeds(0.0, known[:, 0], known[:, 1], times[1:])
            found = _by_runs(runs, speeds, times[1:], h, level, grown, pieces, leaves)
            if np.logaddexp.reduce(found) < np.logaddexp.reduce(best):
                best = found
    return best


def _runs(about: Array, fits: Mask, most: float) -> list[tuple[int, int]]:
    """Pieces that follow each other, from the last ones on, with clocks of about ``most`` together."""
    runs, end, total = [], len(about), 0.0
    for k in range(len(about) - 1, -2, -1):
        if k >= 0 and fits[k] and total + about[k] <= most:
            total += float(about[k])
            continue
        if end - (k + 1) > 1:
            runs.append((k + 1, end))
        opens = k >= 0 and fits[k] and about[k] <= most
        end, total = (k + 1, float(about[k])) if opens else (k, 0.0)
    return runs[::-1]


def _by_runs(
    runs: list[tuple[int, int]], speeds: Array, ends: Array, h: Array, level: Array, grown: Array, pieces: Array,
    leaves: Array,
) -> Array:
    """The costs with each run as one block, where that is less."""
    result = pieces.copy()
    for (first, last), speed in zip(runs, speeds):
        reach = int(np.searchsorted(ends, np.sum(h[first:last]) * (1 + 1e-12)))
        if reach >= len(speed) or not np.isfinite(speed[reach]):
            continue
        clocks = (speed[reach] * h[first:last] + grown[first:last]) * (1 + 1e-12)
        own = level[first:last]
        clock = Clock(increments=clocks, starts=np.zeros(1, dtype=np.intp))
        whole = 10.0 ** (clock_crossing(clock, own) * (1 - 1e-15) + 1e-14)
        rest = whole - float(np.exp(log_tail_below(own[:1]))[0]) * (1 - 1e-12)  # but for being above at the start
        cost = float(np.log(max(rest, 0.0) + 1e-300)) + 1e-12
        if first and own[0] < leaves[first - 1]:  # the step from the piece before
            cost = float(np.logaddexp(cost, log_between(own[:1], leaves[first - 1 : first])[0]))
        if cost < np.logaddexp.reduce(pieces[first:last]):
            result[first:last] = -np.inf
            result[first] = cost
    return result


def _with_share(share: float, known: Array, times: Array, h: Array, level: Array, grown: Array) -> Array:
    """Costs of pieces by comparison with sqrt(a) N + sqrt(1 - a) U, a the share and U an Ornstein-Uhlenbeck process.

    Where g/s^2 >= a + (1 - a) e^{-k x} for all lags x in a block, and log s grows by G at most, corr(s, t) >= a' + (1 -
    a') e^{-k x - G(s, t)/(1 - a)} with a' = a e^{-G}: both sides are linear in e^{-k x}, and for e^{-k x} = 1 it says
    that -log((e^{-G(s, t)} - a')/(1 - a')) <= G(s, t)/(1 - a). A convex function is below a chord where it is at both
    ends.
    """
    bound, below = known[:, 0], known[:, 1]
    ends = times[1:]
    speed = _speeds(share, bound, below, ends)
    length = np.minimum(ends, h[:, None])
    more = (grown / (1 - share))[:, None]
    whole = speed * length
    # the longest clock of the table that the lags allow; or the whole piece as one block
    place = np.searchsorted(_CLOCKS, whole.clip(0.0, 1e9), side="right") - 1
    fits = place >= 0
    single = np.searchsorted(_CLOCKS, (speed * h[:, None] + more).clip(0.0, 1e9), side="left")
    alone = (ends >= h[:, None]) & (single < len(_CLOCKS))
    room = _CLOCKS[np.maximum(place, 0)] - more  # of a block's clock, beside what V+ brings
    blocks = np.where(fits & (room > 0), np.ceil(speed * h[:, None] / np.maximum(room, 1e-300) * (1 + 1e-12)), np.inf)
    blocks = np.where(alone, 1.0, blocks)
    clock = np.minimum(np.where(alone, single, np.maximum(place, 0)), len(_CLOCKS) - 1).astype(np.intp)
    constant = share * np.exp(-2 * grown)
    reach = np.maximum(level, 0.5)[:, None]
    score = blocks * (_CLOCKS[clock] * reach + np.sqrt(_CLOCKS[clock]))  # about what they cost
    best = np.argmin(np.where(np.isfinite(blocks), score, np.inf), axis=1)
    index = np.arange(len(h))
    count, chosen = blocks[index, best], clock[index, best]
    result = np.full(len(h), np.inf)
    use = np.isfinite(count) & (level >= 0)
    if share == 0:
        result[use] = _plain_costs(level[use], _CLOCKS[chosen[use]]) + np.log(count[use])
        return result
    constant = share * np.exp(-2 * grown)
    for number in np.unique(chosen[use]).tolist():
        own = use & (chosen == number)
        result[own] = _mixed_costs(constant[own], level[own], number) + np.log(count[own])
    return result


def _speeds(share: float, bound: Array, below: Array, ends: Array) -> Array:
    """The least k with g/s^2 >= a + (1 - a) e^{-k x} for all lags x up to the end of each cell, (P, J)."""
    after = (bound[:, 1:] - np.where(np.arange(len(ends)) == 0, 0.0, below[:, :-1]) - share) / (1 - share)
    before = (bound[:, 1:-1] - below[:, 1:-1] - share) / (1 - share)
    speed = np.where(after > 0, -np.log(np.minimum(after, 1.0)) / ends, np.inf)
    speed[:, 1:] = np.maximum(speed[:, 1:], np.where(before > 0, -np.log(np.minimum(before, 1.0)) / ends[:-1], np.inf))
    return np.asarray(np.maximum.accumulate(np.where(np.isnan(speed), np.inf, speed), axis=1) * (1 + 1e-12) + 1e-300)


def _mixed_costs(constant: Array, level: Array, clock: int) -> Array:
    """Logs of P(sqrt(a) N + sqrt(1 - a) U is below the level at a block's start, and above it within the block)."""
    table, above = _table(clock)
    slope = np.sqrt(constant)[:, None] * (1 + 1e-14)
    rest = np.sqrt(1 - constant)[:, None]
    # N at which the level left to U is that of the table: cells of N from high to low
    nodes = (level[:, None] - rest * _LEVELS) / slope
    slack = 1e-12 * (1 + np.abs(nodes))
    mass = log_between(nodes[:, 1:] - slack[:, 1:], nodes[:, :-1] + slack[:, :-1])
    inner = np.logaddexp.reduce(mass + table, axis=1)
    under = log_tail(nodes[:, 0] - slack[:, 0]) + float(log_tail(-_LEVELS[0]))
    return np.asarray(np.logaddexp(np.logaddexp(inner, under), above) + 1e-11)


@lru_cache(maxsize=64)
def _table(clock: int) -> tuple[Array, float]:
    """Logs of P(U <= upper end, U above the lower end within the clock), cell by cell of `_LEVELS`; and beyond them.

    Below 0 the start alone counts: there a level that stands still is no longer above its chords.
    """
    low, high = _LEVELS[:-1], _LEVELS[1:]
    start, up = log_tail(-high), low >= 0
    crossing = _plain_costs(low[up], np.full(int(up.sum()), _CLOCKS[clock]))
    start[up] = np.minimum(start[up], np.logaddexp(crossing, log_between(low[up], high[up])))
    last = _LEVELS[-1:]
    return start, float(np.logaddexp(_plain_costs(last, _CLOCKS[clock : clock + 1]), log_tail(last))[0])


def _plain_costs(levels: Array, clock: Array) -> Array:
    """Logs of P(below the level at a block's start, above it within the block) for an Ornstein-Uhlenbeck process."""
    if not len(levels):
        return np.zeros(0)
    counts = np.clip(np.ceil(clock * np.maximum(levels, 0.5) ** 2 / _WEIGHT), 1, _MOST).astype(int)
    own, parts = np.repeat(levels, counts), np.repeat(clock / counts * (1 + 1e-15), counts)
    heads = np.cumsum(counts) - counts
    fresh = np.zeros(len(own), dtype=bool)
    fresh[heads] = True
    logs = log_polygon_crossing(parts, own, own, fresh=fresh)[1:]
    logs[heads] = log_line_crossing(own[heads], own[heads], parts[heads])  # without the step from another block's level
    top = np.maximum.reduceat(logs, heads)
    safe = np.where(np.isfinite(top), top, 0.0)
    sums = np.add.reduceat(np.exp(logs - np.repeat(safe, counts)), heads)
    return np.asarray(np.where(np.isfinite(top), safe + np.log(sums) + 1e-12, top))
