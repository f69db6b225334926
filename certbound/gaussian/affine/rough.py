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

import numpy as np
from flint import arb_mat

from certbound.arrays import Array, Integers
from certbound.gaussian.affine.law import floats, root_up
from certbound.gaussian.affine.trace import Trace, dot, rows_of
from certbound.gaussian.scalar import lift, log_between, log_line_crossing, log_polygon_crossing, log_tail
from certbound.rigor.rounding import quiet

_PARTS = 8  # cells of lags between two doublings
_SHORT = 0.02  # of the initial decay, what the first cell may leave open
_GREW = 0.9  # a decorrelation so fast that longer blocks are not looked at
_WEIGHT = 2.0  # clock of a window times the square of the level, as in `clock_crossing`
_MOST = 64  # windows of a block


@dataclass(frozen=True, eq=False, kw_only=True)
class Lags:
    """Rows a F(x) at lags, from 0 on: (J + 1,), what bounds curvature over the cell after each, in balls and floats."""

    times: Array
    rows: arb_mat
    moved: arb_mat
    bends: tuple[Array, Array]  # (J,): sd of the second derivatives of a F(x) Z and a A F(x) Z over a cell


def lags_of(trace: Trace, longest: float) -> Lags:
    """Lags up to about ``longest``, fine enough at the first for the row's own noise."""
    law, doubling = trace.law, trace.law.doubling
    top = trace.matrices[-1][0] if law.covariance is None else trace.matrices[-1][0] + law.covariance
    size = float(np.max(trace.s[1])) ** 0.5
    row = arb_mat([trace.row])
    own = float(floats((row * (law.noise * law.noise.transpose()) * row.transpose()).entries())[1][0])
    level = 0
    third = row * law.slope * law.slope * law.slope
    sharp = float(root_up(floats([dot(third.entries(), (third * top).entries())])[1])[0])
    step = law.horizon
    while step > longest or (step**2 / 8 * sharp * size > _SHORT * own and level < 150):
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
    bends, image = [], moved
    for _ in range(2):
        image = image * law.slope
        squares = [dot(r, i) for r, i in zip(rows_of(image), rows_of(image * top))]
        bends.append(root_up(floats(squares)[1][:-1]))
    return Lags(times=np.array(times), rows=matrix, moved=moved, bends=(bends[0], bends[1]))


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
        self._rows, self._moved = _plain(self.lags.rows), _plain(self.lags.moved)

    def of(self, places: Integers) -> Array:
        """(P, J): the largest of -w/g over each cell of the lags; infinite where nothing is known."""
        trace = self.trace
        keys = [(int(trace.levels[k]), trace.indices[k]) for k in places.tolist()]
        new = [(key, k) for key, k in zip(keys, places.tolist()) if key not in self._known]
        if new:
            for (key, _), values in zip(new, self._found([k for _, k in new])):
                self._known[key] = values
        return np.array([self._known[key] for key in keys])

    @quiet
    def _found(self, places: list[int]) -> Array:
        trace, lags = self.trace, self.lags
        law = trace.law
        own = arb_mat([trace.row]).transpose()
        start = None if law.covariance is None else law.covariance * own
        vectors = []
        for k in places:
            gain, loss = trace.matrices[k]
            vector = gain * own - loss * own
            vectors.append(vector if start is None else vector + start)
        joined = arb_mat([[v[i, 0] for v in vectors] for i in range(law.dimension)])
        count = lags.rows.nrows()
        g = np.array(floats((lags.rows * joined).entries())).reshape(2, count, -1)
        w = np.array(floats((lags.moved * joined).entries())).reshape(2, count, -1)
        norms = np.array([self._norms(k) for k in places])  # (P, 2, J + 1)
        spread = trace.spread_of()
        changed = root_up(np.array([self._change(k) for k in places]))  # sd of what V changes by along the row
        size = root_up(spread[1][places])
        gap = np.diff(lags.times) ** 2 / 8 * (1 + 1e-12)
        first, second = (bend * gap for bend in lags.bends)
        g_low = np.minimum(g[0][:-1], g[0][1:]).T - np.outer(size, first)
        g_low -= changed[:, None] * (np.maximum(norms[:, 0, :-1], norms[:, 0, 1:]) + first)
        w_high = np.maximum(-w[0][:-1], -w[0][1:]).T + np.outer(size, second)
        w_high += changed[:, None] * (np.maximum(norms[:, 1, :-1], norms[:, 1, 1:]) + second)
        value = np.where(g_low > 0, np.maximum(w_high, 0.0) / g_low * (1 + 1e-12), np.inf)
        return np.where(np.isnan(value), np.inf, value)

    def _change(self, k: int) -> float:
        """Bound of a (D+ + D-) a over a piece."""
        return float(self.trace.columns["gain s"][k] + self.trace.columns["loss s"][k]) * (1 + 1e-15)

    def _norms(self, k: int) -> tuple[Array, Array]:
        """Norms of the rows and the moved rows in D+ + D- over a piece, in floats with their rounding."""
        before, after = self.trace.matrices[k], self.trace.matrices[k + 1]
        middle, radius = _plain(after[0] - before[0] + after[1] - before[1])
        slack = 4e-16 * len(middle)
        result = []
        for rows, error in (self._rows, self._moved):
            whole = np.abs(rows) + error
            value = np.einsum("ji,ik,jk->j", rows, middle, rows)
            value += np.einsum("ji,ik,jk->j", whole, radius + slack * np.abs(middle), whole)
            value += 2 * np.einsum("ji,ik,jk->j", error, np.abs(middle), whole)
            result.append(root_up(value * (1 + 1e-12)))
        return result[0], result[1]


@quiet
def rough_parts(trace: Trace, decays: Decays, lines: Array, chosen: Integers) -> tuple[Array, Array]:
    """What crossing ``lines`` (K, 2) costs: at the start, and piece by piece; natural logarithms.

    Of the ``chosen`` pieces, which follow each other. The level counts as constant over a piece, the least z over the
    largest s. A piece is cut into equal blocks, no longer than the lags over which its decay is known.
    """
    h = trace.steps[chosen]
    speeds = np.maximum.accumulate(decays.of(chosen), axis=1)  # over all lags up to the end of a cell
    ends = decays.lags.times[1:]
    low, high = (x[chosen] for x in trace.spread_of())
    level = np.min(lines[chosen], axis=1)
    level = level / root_up(high) * (1 - 1e-14)
    clock = speeds * np.minimum(ends, h[:, None])
    weight = np.sqrt(1 + 2 / np.maximum(clock, 1e-300) / np.maximum(level, 0.5)[:, None] ** 2)  # short blocks cost more
    score = np.where(clock <= _GREW, speeds * weight, np.inf)
    best = np.argmin(score, axis=1)
    index = np.arange(len(chosen))
    blocks = np.ceil(h / ends[best])
    blocks = np.where(blocks * ends[best] >= h * (1 + 1e-12), blocks, np.where(ends[best] >= h, 1, blocks + 1))
    grown = 0.5 * trace.columns["gain s"][chosen] / low  # of the clock: what V+ adds to log s, put into every block
    spans = (speeds[index, best] * h / blocks + grown) * (1 + 1e-12)
    known = np.isfinite(spans) & np.isfinite(score[index, best]) & (level >= 0) & (low > 0)
    costs = np.full(len(chosen), np.inf)
    costs[known] = _cost(spans[known], level[known]) + np.log(blocks[known])
    first = np.asarray(log_tail(level[:1]) if known[0] else np.array([-np.inf]))
    jumps = np.full(len(chosen), -np.inf)
    falls = level[1:] < level[:-1]
    jumps[1:] = np.where(falls, log_between(level[1:], level[:-1]), -np.inf)
    if not known[0]:
        costs[0] = _beginning(trace, int(chosen[0]), lines)
        jumps[1:2] = log_tail(level[1:2])  # nothing is said of the end of the first piece
    return first, np.asarray(lift(np.logaddexp(costs, jumps), 16))


def _cost(spans: Array, levels: Array) -> Array:
    """Logs of P(below the level at a block's start, above it within the block), one block each."""
    if not len(spans):
        return np.zeros(0)
    counts = np.clip(np.ceil(spans * np.maximum(levels, 0.5) ** 2 / _WEIGHT), 1, _MOST).astype(int)
    own, parts = np.repeat(levels, counts), np.maximum(np.repeat(spans / counts * (1 + 1e-15), counts), 1e-12)
    heads = np.cumsum(counts) - counts
    fresh = np.zeros(len(own), dtype=bool)
    fresh[heads] = True
    logs = log_polygon_crossing(parts, own, own, fresh=fresh)[1:]
    logs[heads] = log_line_crossing(own[heads], own[heads], parts[heads])  # without the step from another block's level
    top = np.maximum.reduceat(logs, heads)
    safe = np.where(np.isfinite(top), top, 0.0)
    sums = np.add.reduceat(np.exp(logs - np.repeat(safe, counts)), heads)
    return np.asarray(np.where(np.isfinite(top), safe + np.log(sums), top))


def _beginning(trace: Trace, k: int, lines: Array) -> float:
    """P(a Z exceeds the line within a first piece that starts from V = 0), crudely.

    sup a Z <= sup a G W + int |a A Z|; the first by reflection, the second by E exp(l Y) <= 2 exp(l^2 h^2 e/2).
    """
    if k != 0 or trace.law.covariance is not None:
        return np.inf
    h, z = float(trace.steps[0]), float(np.min(lines[0]))
    if z <= 0:
        return np.inf
    row = arb_mat([trace.row])
    own = root_up(floats((row * (trace.law.noise * trace.law.noise.transpose()) * row.transpose()).entries())[1])[0]
    speed = float(trace.speed_of()[1][0])
    best = np.inf
    for share in (0.5, 0.8, 0.95, 0.99):
        first = np.log(2.0) + float(log_tail(share * z / (own * np.sqrt(h)) * (1 - 1e-12)))
        second = np.log(2.0) - (0.999999 * (1 - share) * z) ** 2 / (2 * h * h * speed + 1e-300)
        best = min(best, float(np.logaddexp(first, second)) + 1e-12)
    return best
