"""Pieces of time for a certificate of the exact law, chosen in floating point: the checker proves what follows.

`upper` halves pieces for inequalities of its own; a certificate's are simpler (docs/certificate.md, "proof by the exact
law") and ask for more pieces. Here every limit's bound is evaluated in floats as the checker will do it in balls, and
pieces are halved where their enclosures cost most. No number of this module bounds anything.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from flint import arb_mat

from certbound.arrays import Array, Integers
from certbound.gaussian.affine.doubling import Doubling
from certbound.gaussian.affine.law import GAIN, LOSS, MEAN, WIDE, AffineLaw, transposed_square
from certbound.gaussian.affine.row_windows import CLOCKS, LONGEST, MOST_WINDOWS, SHARES
from certbound.gaussian.affine.trace import Inaccurate
from certbound.gaussian.affine.upper import Limit
from certbound.gaussian.scalar import log_line_crossing, log_tail
from certbound.rigor.rounding import quiet
from certbound.watch import poll

_DEEPEST, _MOST, _ROUNDS = 60, 30_000, 80  # halvings of the horizon, pieces of a grid, and rounds of halving
_STALLED = 5  # rounds one after the other that gained nothing: no more
_RAISED = 2.0**-32  # of the size of what a random start's variance changes by: what both of its parts are raised by
_LEAST = 1e-300
_ACCURATE = 1e-9  # of a matrix's largest entry, by which its balls may be wide


@dataclass(frozen=True, eq=False, kw_only=True)
class Stated:
    """What a certificate states of an affine law, and about what the checker will prove of it.

    Parameters
    ----------
    grids : tuple of tuple of int
        Halvings of the horizon of every piece, one grid for each direction of limits.
    windows : tuple
        For every limit the numbers of windows of the pieces of its direction's grid; None for a row without noise.
    loss : array, shape (n, k), or None
        L with M- = L L^T, of a random start.
    logs : tuple of float
        Natural logarithms of what each limit costs.
    """

    grids: tuple[tuple[int, ...], ...]
    windows: tuple[tuple[int, ...] | None, ...]
    loss: Array | None
    logs: tuple[float, ...]


def stated_exits(law: AffineLaw, rows: Sequence[Sequence[float]], limits: Sequence[Limit], near: float) -> Stated:
    """Pieces for every limit, until their enclosures add at most the part ``near`` to what it costs.

    `Inaccurate` where the working precision of balls is too low for the law.
    """
    loss = None if law.covariance is None else _loss_of(law)
    known = _Floats(law, loss)
    windows: list[tuple[int, ...] | None] = [None] * len(limits)
    grids, logs = [], [0.0] * len(limits)
    for direction, row in enumerate(rows):
        own = [place for place, limit in enumerate(limits) if limit.direction == direction]
        found = _Direction(known, np.asarray(row, dtype=float), [limits[place] for place in own])
        found.refine(near)
        grids.append(tuple(found.levels.tolist()))
        for place, bound in zip(own, found.bounds):
            logs[place] = bound.log
            windows[place] = None if bound.windows is None else tuple(bound.windows.astype(int).tolist())
    return Stated(grids=tuple(grids), windows=tuple(windows), loss=loss, logs=tuple(logs))


def _middle(matrix: arb_mat) -> Array:
    """The middles of balls, none of which may be wide against the largest."""
    entries = matrix.entries()
    found, radius = (np.array([float(part) for part in parts]) for parts in zip(*((x.mid(), x.rad()) for x in entries)))
    if not (np.all(np.isfinite(found)) and np.max(radius) <= _ACCURATE * np.max(np.abs(found)) + _LEAST):
        raise Inaccurate
    return found.reshape(matrix.nrows(), matrix.ncols())


def _loss_of(law: AffineLaw) -> Array:
    """L such that M + L L^T is positive definite, by a margin, where M is what a random start's variance changes by."""
    assert law.covariance is not None
    moved = law.slope * law.covariance
    source = _middle(moved + moved.transpose() + transposed_square(law.noise))
    spread = np.sqrt(np.maximum(np.diag(_middle(law.covariance)), 0.0))
    size = np.abs(source).max(axis=1) + spread * (np.abs(_middle(law.slope)) @ spread)
    scale = np.sqrt(np.maximum(size, _LEAST))
    values, vectors = np.linalg.eigh(source / scale / scale[:, None])
    raised = np.maximum(-values, 0.0) + _RAISED * max(np.abs(values).max(initial=0.0), 1.0)
    return np.asarray(scale[:, None] * vectors * np.sqrt(raised))


@dataclass(eq=False)
class _Floats:
    """Transition matrices and Gramians in floats, level by level."""

    law: AffineLaw
    loss: Array | None

    def __post_init__(self) -> None:
        law = self.law
        sources = law.pushing
        gain = transposed_square(law.noise)
        if law.covariance is not None and self.loss is not None:
            moved = law.slope * law.covariance
            lost = transposed_square(arb_mat(self.loss.tolist()))
            gain, sources[LOSS] = moved + moved.transpose() + gain + lost, lost
        sources[GAIN] = gain
        self._doubling = Doubling(law.slope, sources, law.horizon)
        self.names = tuple(sources)
        self.slope, self.noise = _middle(law.slope), _middle(law.noise)
        self.start = np.zeros_like(self.slope) if law.covariance is None else _middle(law.covariance)
        self.mean = _middle(law.mean)[:, 0]
        self.starts = None if law.starts is None else _middle(law.starts)
        self._transitions: dict[int, Array] = {}
        self._gramians: dict[tuple[str, int], Array] = {}

    def transition(self, level: int) -> Array:
        if level not in self._transitions:
            self._transitions[level] = _middle(self._doubling.transition(level))
        return self._transitions[level]

    def gramian(self, name: str, level: int) -> Array:
        if (name, level) not in self._gramians:
            self._gramians[name, level] = _middle(self._doubling.gramian(name, level))
        return self._gramians[name, level]


def _moments(r: Array, q: Array, p: Array, o: Array, form: Array) -> Array:
    """s^2, c, e, d, Var(a A^2 Z) and v, as the checker calls them, (6, K)."""
    pairs = (r, r), (r, q), (q, q), (r, p), (p, p), (o, o)
    return np.array([_form(first, form, second) for first, second in pairs])


def _form(first: Array, matrix: Array, second: Array) -> Array:
    return np.asarray(np.einsum("ki,ij,kj->k", first, matrix, second))


@dataclass(eq=False, kw_only=True)
class _Bound:
    """What a limit costs on its pieces, about that without enclosures, and the windows of its pieces."""

    chosen: Integers
    costs: Array
    gaps: Array
    rest: float  # at the start and where pieces meet
    windows: Array | None

    @property
    def log(self) -> float:
        """Natural logarithm of the sum."""
        return float(np.log(min(float(np.sum(self.costs)) + self.rest, 1.0) + _LEAST))


@dataclass(eq=False)
class _Direction:
    """One row over a grid of pieces, and what its limits cost."""

    known: _Floats
    row: Array
    limits: Sequence[Limit]
    levels: Integers = field(init=False)

    def __post_init__(self) -> None:
        self.levels = np.zeros(1, dtype=np.int64)
        self.own = float(np.sum((self.row @ self.known.noise) ** 2))
        self.bounds: list[_Bound] = []

    def refine(self, near: float) -> None:
        """Halve pieces until what their enclosures add is next to nothing, and keep what costs least.

        Windows of a row with noise of its own ask for pieces that are not too short.
        """
        best, found, stalled = np.inf, (self.levels, self.bounds), 0
        for _ in range(_ROUNDS):
            poll("pieces of time for the certificate")
            self._follow()
            self.bounds = [self._bound(limit) for limit in self.limits]
            total = sum(float(np.sum(bound.costs)) + bound.rest for bound in self.bounds)
            stalled = 0 if total < best * (1 - near / 10) else stalled + 1
            if total <= best:
                best, found = total, (self.levels, self.bounds)
            gaps = np.zeros(len(self.levels))
            for bound in self.bounds:
                whole = max(float(np.sum(bound.costs)) + bound.rest, _LEAST)
                gaps[bound.chosen] += np.minimum(bound.gaps / whole, 1.0)
            open_ = (gaps > near / (2 * len(gaps))) & (gaps > 0.02 * gaps.max()) & (self.levels < _DEEPEST)
            if np.sum(gaps) <= near or not np.any(open_) or len(gaps) > _MOST or (stalled > _STALLED and best < 1):
                break
            self.levels = np.repeat(self.levels + open_, np.where(open_, 2, 1))
        self.levels, self.bounds = found

    @quiet
    def _follow(self) -> None:
        """The row's law at the ends of the pieces and over them."""
        known, levels = self.known, self.levels
        finest = int(levels.max())
        sizes = np.int64(1) << (finest - levels)
        places = np.concatenate([[0], np.cumsum(sizes)])
        self.times = places / 2.0**finest * known.law.horizon
        self.h = known.law.horizon * 0.5 ** levels.astype(float)
        self.rows = self._rows(places[:-1], finest)
        count = len(levels)
        change = np.zeros((2, 6, count))
        self.error, push = np.zeros(count), np.zeros(count)
        starts = 1 if known.starts is None else known.starts.shape[1]
        for level in np.unique(levels).tolist():
            own = levels == level
            r = self.rows[:-1][own]
            q = r @ known.slope
            p = q @ known.slope
            for name in known.names:
                gramian = known.gramian(name, level)
                if name in (GAIN, LOSS):
                    change[int(name == LOSS)][:, own] = _moments(r, q, p, p @ known.slope, gramian)
                elif name in (MEAN, WIDE):
                    root = np.sqrt(np.maximum(_form(p, gramian, p), 0.0))
                    factor = np.sqrt(starts) if name == WIDE else 1.0
                    self.error[own] += root * factor * np.sqrt(self.h[own] ** 3 / 48)
                else:
                    push[own] += np.sqrt(self.h[own] * np.maximum(_form(r, gramian, r), 0.0))
        self._enclose(change)
        self.mean = self.rows @ known.mean
        self.wide = np.zeros(count + 1) if known.starts is None else np.abs(self.rows @ known.starts).sum(axis=1)
        self.pushed = np.cumsum(push)

    def _rows(self, places: Integers, finest: int) -> Array:
        """r at the starts of pieces, and at the horizon: each from the one without its last binary digit."""
        rows = np.zeros((len(places) + 1, len(self.row)))
        rows[0] = self.row
        steps = places & -places
        for bit in range(finest - 1, -1, -1):
            own = np.flatnonzero(steps == 1 << bit)
            if len(own):
                before = np.searchsorted(places, places[own] - (1 << bit))
                rows[own] = rows[before] @ self.known.transition(finest - bit)
        rows[-1] = self.row @ self.known.transition(0)
        return rows

    def _enclose(self, change: Array) -> None:
        """Enclosures of the moments over the pieces."""
        slope, r = self.known.slope, self.row[None]
        q = r @ slope
        p = q @ slope
        first = _moments(r, q, p, p @ slope, self.known.start)
        ends = np.cumsum(np.concatenate([first, change[0] - change[1]], axis=1), axis=1)
        gain, loss = (np.maximum(part, [[0.0], [-np.inf], [0.0], [-np.inf], [0.0], [0.0]]) for part in change)
        before, after = ends[:, :-1], ends[:, 1:]
        low, high = np.maximum(before - loss, after - gain), np.minimum(before + gain, after + loss)
        middle = 0.5 * (before + after)
        self.s = np.maximum(ends[0], 0.0)
        self.s_low, self.s_high = np.maximum(low[0], 0.0), np.maximum(high[0], _LEAST)
        self.e, self.e_high = np.maximum(middle[2], _LEAST), np.maximum(high[2], _LEAST)
        self.v, self.v_high = np.maximum(middle[5], 0.0), np.maximum(high[5], 0.0)
        bend, twice = (
            0.5 * (np.sqrt(gain[0] * gain[place]) + np.sqrt(loss[0] * loss[place])) for place in (2, 4)
        )
        self.c, self.d = middle[1], middle[3]
        self.c_low, self.c_high, self.d_low = self.c - bend, self.c + bend, self.d - twice

    @quiet
    def _bound(self, limit: Limit) -> _Bound:
        """What a limit costs, as the checker will add it up."""
        chosen = np.arange(len(self.levels))
        if limit.during is not None:
            first, last = limit.during
            chosen = np.flatnonzero((self.times[1:] >= first) & (self.times[:-1] <= last))
        high = limit.sign * self.mean + self.wide
        ends = limit.bound - np.stack([high[:-1], high[1:]]) - self.error - self.pushed
        level = ends[:, chosen]
        about = np.repeat(level.mean(axis=0)[None], 2, axis=0)
        rising = (level[1] - level[0]) / self.h[chosen]
        crude = self._crude(level, chosen)
        if self.own == 0:
            costs, enters, leaves, windows = *self._rice(level, rising, chosen, self._sides(chosen)), None
            middle = self._rice(about, rising, chosen, self._middles(chosen))[0]
        else:
            costs, enters, leaves, windows = self._windows(level, chosen, self._sides(chosen))
            middle = self._windows(about, chosen, self._middles(chosen))[0]
        costs = np.where(np.isfinite(costs) & (self.s_low[chosen] > 0), costs, np.inf)
        plain = crude <= costs
        costs = np.where(level.min(axis=0) > 0, np.where(plain, crude, costs), np.inf)
        enters = np.where(plain, np.inf, enters)
        leaves = np.where(plain, level.min(axis=0) / np.sqrt(self.s[1:][chosen]), leaves)
        jumps = np.exp(log_tail(enters[1:])) - np.exp(log_tail(leaves[:-1]))
        rest = float(np.sum(np.maximum(jumps, 0.0))) + float(np.exp(log_tail(enters[:1]))[0])
        lost = np.minimum(np.where(plain, 0.0, np.nan_to_num(middle, nan=0.0, posinf=0.0)), costs)
        costs = np.minimum(costs, 1e6)
        full = None if windows is None else np.ones(len(self.levels))
        if full is not None and windows is not None:
            full[chosen] = windows
        return _Bound(chosen=chosen, costs=costs, gaps=costs - lost, rest=rest, windows=full)

    def _sides(self, chosen: Integers) -> tuple[Array, ...]:
        sides = self.s_low, self.s_high, self.c_low, self.c_high, self.e_high, self.d_low, self.v_high
        return tuple(x[chosen] for x in sides)

    def _middles(self, chosen: Integers) -> tuple[Array, ...]:
        s = np.maximum(0.5 * (self.s[:-1] + self.s[1:]), _LEAST)[chosen]
        c = self.c[chosen]
        return s, s, c, c, self.e[chosen], self.d[chosen], self.v[chosen]

    def _rice(
        self, level: Array, rising: Array, chosen: Integers, sides: tuple[Array, ...]
    ) -> tuple[Array, Array, Array]:  # fmt: skip
        """Costs, and levels over s at both ends."""
        s_low, s_high, c_low, c_high, e_high, _, _ = sides
        low, high = level.min(axis=0), level.max(axis=0)
        square = low**2
        at = np.clip(square, s_low, s_high)
        most = np.exp(-square / (2 * at)) / np.sqrt(2 * np.pi * at)
        mean = c_high * np.where(c_high > 0, high / s_low, low / s_high) - rising
        least = np.maximum(np.maximum(c_low, -c_high), 0.0)
        spread = np.sqrt(np.maximum(e_high - least**2 / s_high, _LEAST))
        ratio = mean / spread
        part = spread * np.exp(-0.5 * ratio**2) / np.sqrt(2 * np.pi) + mean * np.exp(log_tail(-ratio))
        starts, ends = self.s[:-1][chosen], self.s[1:][chosen]
        costs = self.h[chosen] * most * np.maximum(part, 0.0)
        return costs, level[0] / np.sqrt(starts), level[1] / np.sqrt(ends)

    def _windows(
        self, level: Array, chosen: Integers, sides: tuple[Array, ...]
    ) -> tuple[Array, Array, Array, Array]:  # fmt: skip
        """Costs, levels over s at both ends, and the best of a few numbers of windows."""
        s_low, s_high, *_ = sides
        h, many = self.h[chosen], level.min(axis=0) / np.sqrt(s_high)
        alone, after = level[0] / np.sqrt(self.s[:-1][chosen]), level[1] / np.sqrt(self.s[1:][chosen])
        falls = np.maximum(np.log(level[0] / level[1]), 0.0)
        rate = self.own / (2 * np.maximum(s_low, _LEAST))
        best, windows = np.full(len(h), np.inf), np.ones(len(h))
        for clock in CLOCKS:
            count = np.clip(np.ceil(h / (clock / np.maximum(many, 0.5) ** 2 / rate)), 1, MOST_WINDOWS)
            length = h / count
            decay, spread = self._rates(length, sides)
            fallen = np.where(count > 1, 0.0, spread * length + falls)
            spent = np.maximum(np.maximum(decay * length, fallen), 1e-18)
            first = np.where(count > 1, many, alone)
            last = np.where(count > 1, many, alone * np.exp(-fallen))
            usable = (spent < LONGEST) & (first > 0) & np.isfinite(first)
            logs = log_line_crossing(*(np.where(usable, x, 1.0) for x in (first, last, spent)))
            cost = np.where(usable, count * np.exp(logs), np.inf)
            better = cost < best
            best, windows = np.where(better, cost, best), np.where(better, count, windows)
        single = windows == 1
        return best, np.where(single, alone, many), np.where(single, after, many), windows

    def _rates(self, length: Array, sides: tuple[Array, ...]) -> tuple[Array, Array]:
        """Rates of decay and of s, as the checker finds them."""
        s_low, s_high, c_low, c_high, _, d_low, v_high = sides
        p = -c_low / np.where(c_low < 0, s_low, s_high)
        q = d_low / np.where(d_low > 0, s_high, s_low)
        p = p + np.sqrt(v_high / s_low) * length**2 / 6
        part = 2 * length * (p - length * q / 2)
        root = np.where(part < 1, part / length / (1 + np.sqrt(np.maximum(1 - part, 0.0))), np.inf)
        k = np.maximum(np.maximum(root, p), 0.0) * (1 + 1e-12)
        k = np.where(k * (1 + 1e-9) >= p + length * np.maximum(k * k - q, 0.0) / 2, k, np.inf)
        grown = c_high + 0.5 * self.own
        spread = grown / np.where(grown > 0, s_low, s_high)
        return k + spread, np.maximum(spread, 0.0)

    def _crude(self, level: Array, chosen: Integers) -> Array:
        s, h, e, least = self.s[:-1][chosen], self.h[chosen], self.e_high[chosen], level.min(axis=0)
        rests = s == 0
        best = np.ones(len(h))
        for share in SHARES:
            if self.own == 0:
                before, noise = np.where(rests, 0.0, share), np.zeros(len(h))
                rest = np.where(rests, 1.0, 1 - share)
            else:
                before, noise = np.where(rests, 0.0, share), np.where(rests, share, 0.9 * (1 - share))
                rest = np.where(rests, 1 - share, 0.1 * (1 - share))
            total = np.where(rests, 0.0, np.exp(log_tail(before * least / np.sqrt(np.maximum(s, _LEAST)))))
            if self.own > 0:
                total = total + 2 * np.exp(log_tail(noise * least / np.sqrt(self.own * h)))
            total = total + 2 * np.exp(-((rest * least) ** 2) / (2 * h**2 * e))
            best = np.minimum(best, total)
        return np.where(least > 0, best, 1.0)
