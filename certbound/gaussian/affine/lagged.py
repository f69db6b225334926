"""First crossings of a smooth row: upcrossings that were not beyond the limits a while before.

A path that first fails at a time t crosses upwards there, and was within the limits at t - x_1, t - x_2, ... With eta =
d xi/dt the expected number of such crossings is int phi(z/s)/s E[eta^+; all y_i <= z_i | xi_t = z] dt with the y_i the
marks: values of this row or others at lags, 0 among them (Rice's formula for marked crossings). Under xi_t = z the
speed is normal with the mean c z/s^2 and the variance v^2; over cells of it the y_i are normal variables, and P(some
y_i > z_i) is bounded from below by pairs. This counts few of the crossings of a clump. All of these are rows of the
state Z at the earliest time plus noise that follows, so that their covariances are enclosed as those of one row
(`trace`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from flint import arb, arb_mat

from certbound.arrays import Array, Integers
from certbound.gaussian.affine.doubling import Doubling
from certbound.gaussian.affine.law import GAIN, LOSS, AffineLaw, floats, root_up, transposed_square
from certbound.gaussian.affine.trace import Row, dot, rows_of, square_of
from certbound.gaussian.scalar import (
    LOG_ROOT_2PI,
    log_below_above,
    log_between,
    log_crossings,
    log_tail,
    log_tail_below,
)
from certbound.rigor import intervals as iv
from certbound.rigor.intervals import Interval
from certbound.rigor.rounding import quiet
from certbound.watch import poll

_CELLS = np.concatenate([np.linspace(0.0, 5.0, 41), [5.5, 6.0, 7.0, 9.0]])  # of the speed, in standard deviations
_MOST, _ROUNDS, _NEAR = 1500, 30, 0.02
_PARTS, _LAGS, _EARLY = 4, 40, 0.5  # lags looked at: parts of a mean period, how many, and share of the horizon
_MARKS, _GAIN = 4, 0.01  # marks, and what one must take from the crossings


@dataclass(eq=False)
class Joint:
    """Rows X F(t) of several rows X, and the Gram matrix K + X V(t) X^T, over pieces of time."""

    law: AffineLaw
    start: list[Row]
    constant: list[list[arb]]
    levels: Integers = field(init=False)
    indices: list[int] = field(init=False)

    def __post_init__(self) -> None:
        law, count = self.law, len(self.start)
        self.levels, self.indices = np.zeros(1, dtype=np.intp), [0]
        grams = [[arb(0)] * count for _ in range(count)]
        if law.covariance is not None:
            images = rows_of(arb_mat(self.start) * law.covariance)
            grams = [[dot(image, row) for row in self.start] for image in images]
        self.rows = [self.start]
        grown, changes = self._pieces([self.start], 0)
        first = [[k + g for k, g in zip(*pair)] for pair in zip(self.constant, grams)]
        self.grams = [first, [[x + y for x, y in zip(*pair)] for pair in zip(first, changes[0])]]
        self.grown = np.array(grown)

    def _pieces(self, nodes: list[list[Row]], level: int) -> tuple[list[list[float]], list[list[list[arb]]]]:
        """Roots of what V+ and V- add to the diagonal over pieces, (N, 2, p), and what changes of the Gram matrices."""
        doubling, count = self.law.doubling, len(self.start)
        flat = [row for node in nodes for row in node]
        matrix = arb_mat(flat)
        changes = [[[arb(0)] * count for _ in range(count)] for _ in nodes]
        grown = []
        for name, sign in ((GAIN, 1), (LOSS, -1)):
            if name not in doubling.sources:
                grown.append(np.zeros((len(nodes), count)))
                continue
            images = rows_of(matrix * doubling.gramian(name, level))
            squares = []
            for k, node in enumerate(nodes):
                own = images[k * count : (k + 1) * count]
                for i in range(count):
                    square = square_of(node[i], own[i])
                    squares.append(square)
                    for j in range(i + 1):
                        value = square if i == j else dot(own[i], node[j])
                        changes[k][i][j] = changes[k][i][j] + sign * value
                        if i != j:
                            changes[k][j][i] = changes[k][i][j]
            grown.append(root_up(floats(squares)[1]).reshape(len(nodes), count))
        return np.stack(grown, axis=1).tolist(), changes

    def split(self, places: Integers) -> None:
        """Halve the pieces at these places."""
        added = {}
        doubling, count = self.law.doubling, len(self.start)
        for level in np.unique(self.levels[places]).tolist():
            poll("the law of first crossings")
            own = [k for k in np.unique(places).tolist() if self.levels[k] == level]
            flat = rows_of(arb_mat([row for k in own for row in self.rows[k]]) * doubling.transition(level + 1))
            middle = [flat[i * count : (i + 1) * count] for i in range(len(own))]
            grown, changes = self._pieces([self.rows[k] for k in own] + middle, level + 1)
            for i, k in enumerate(own):
                gram = [[x + y for x, y in zip(*pair)] for pair in zip(self.grams[k], changes[i])]
                added[k] = [grown[i], grown[len(own) + i]], middle[i], gram
        levels, indices, rows, grams, grown_ = [], [], [], [], []
        before = self.grown.tolist()
        for k, level in enumerate(self.levels.tolist()):
            rows.append(self.rows[k])
            grams.append(self.grams[k])
            if k not in added:
                levels.append(level)
                indices.append(self.indices[k])
                grown_.append(before[k])
                continue
            halves, row, gram = added[k]
            levels += [level + 1] * 2
            indices += [2 * self.indices[k], 2 * self.indices[k] + 1]
            rows.append(row)
            grams.append(gram)
            grown_ += halves
        self.levels, self.indices, self.rows = np.array(levels, dtype=np.intp), indices, rows
        self.grams, self.grown = [*grams, self.grams[-1]], np.array(grown_)

    def enclosures(self, places: Integers) -> dict[tuple[int, int], Interval]:
        """The entries of the Gram matrix over each of some pieces."""
        result, count = {}, len(self.start)
        ends = [self.grams[k + end] for k in places.tolist() for end in (0, 1)]
        grown = self.grown[places]
        for i in range(count):
            for j in range(i + 1):
                low, high = floats([gram[i][j] for gram in ends])
                half = 0.5 * (grown[:, :, i] * grown[:, :, j]).sum(axis=1) * (1 + 1e-14)
                low, high = 0.5 * (low[::2] + low[1::2]), 0.5 * (high[::2] + high[1::2])
                slack = half + 4e-16 * (np.abs(low) + np.abs(high)) + 1e-300
                low = np.maximum(low - slack, 0.0) if i == j else low - slack
                result[i, j] = result[j, i] = Interval(low, high + slack)
        return result


@dataclass(frozen=True, kw_only=True)
class Mark:
    """sign * row X at a time ``lag`` earlier, which was at most ``level`` as nothing had failed by then."""

    row: tuple[float, ...]
    lag: float
    sign: int
    level: float


def joint_of(law: AffineLaw, row: Sequence[float], marks: Sequence[Mark], spans: Spans) -> Joint:
    """xi_t, eta_t and the marks' rows as rows of Z at t - (the longest lag), for t from that on."""
    long = max(mark.lag for mark in marks)
    rest = float(np.nextafter(law.horizon - long, np.inf)) if long > 0 else law.horizon
    own = [arb(x) for x in row]
    fast = rows_of(arb_mat([own]) * law.slope)[0]
    rows = [own, fast, *([arb(x) for x in mark.row] for mark in marks)]
    after = [long, long, *(long - mark.lag for mark in marks)]
    constant = [[arb(0)] * len(rows) for _ in rows]
    for i, r in enumerate(rows):
        for j in range(i + 1):
            both = min(after[i], after[j])
            first, second = spans.moved(r, after[i] - both), spans.moved(rows[j], after[j] - both)
            constant[i][j] = constant[j][i] = spans.noise(first, second, both)
    starts = [spans.moved(r, span) for r, span in zip(rows, after)]
    return Joint(replace(law, horizon=rest), starts, constant)


class Spans:
    """Transition matrices and Gramians of the noise over some lengths of time, each computed once."""

    def __init__(self, law: AffineLaw) -> None:
        self._law, self._gram = law, transposed_square(law.noise)
        self._known: dict[float, Doubling] = {}

    def _of(self, span: float) -> Doubling:
        if span not in self._known:
            self._known[span] = Doubling(self._law.slope, {GAIN: self._gram}, span)
        return self._known[span]

    def transition(self, span: float) -> arb_mat:
        """F(span)."""
        return self._of(span).transition(0)

    def moved(self, row: Row, span: float) -> Row:
        """r F(span)."""
        return row if span == 0 else rows_of(arb_mat([row]) * self._of(span).transition(0))[0]

    def noise(self, first: Row, second: Row, span: float) -> arb:
        """r Q(span) r'^T."""
        if span == 0:
            return arb(0)
        return dot(rows_of(arb_mat([first]) * self._of(span).gramian(GAIN, 0))[0], second)


@quiet
def lagged_parts(joint: Joint, level: float, marks: Sequence[Mark], places: Integers) -> tuple[Array, Array]:
    """What such crossings of a level that stands still cost on some pieces, and about that without enclosures (logs).

    At most what all crossings cost.
    """
    steps = np.array([float(joint.law.doubling.step(int(k))) for k in joint.levels[places]])
    found = joint.enclosures(places)
    about = {key: Interval.point(value.mid) for key, value in found.items()}
    s2, c, e = ((found[key].lo, found[key].hi) for key in ((0, 0), (0, 1), (1, 1)))
    plain = log_crossings(steps, np.full(len(steps), level), s2, c, e)[1]
    return np.fmin(_logs(found, level, marks) + np.log(steps), plain), _logs(about, level, marks) + np.log(steps)


def _logs(found: dict[tuple[int, int], Interval], z: float, marks: Sequence[Mark]) -> Array:
    """Logs of the rates, one a piece; infinite where an enclosure is too wide to say anything."""
    s2, count = found[0, 0], len(marks)
    slope = [found[0, i + 1] / s2 for i in range(count + 1)]  # of eta and the marks' rows on xi
    given = {}  # their covariances under xi
    for i in range(count + 1):
        for j in range(i + 1):
            given[i, j] = found[i + 1, j + 1] - slope[i] * found[0, j + 1]
    v = _root(given[0, 0])
    mean = slope[0] * z / v  # of the speed, in its deviations
    low, high = _CELLS[:-1, None], _CELLS[1:, None]
    cell = Interval(low, high)
    turns, owns, levels = [], [], []  # of the marks: slopes on the speed, deviations under both, standard levels
    for i, mark in enumerate(marks, 1):
        turn = given[i, 0] / v
        own = _root(given[i, i] - iv.sq(turn))
        gap = (mark.level - (slope[i] * z + turn * (cell - mean)) * float(mark.sign)).hi
        level = np.where(gap > 0, gap / own.lo, gap / own.hi) * (1 + np.where(gap > 0, 1e-14, -1e-14))
        levels.append(np.where(np.isnan(level), np.inf, level))
        turns.append(turn)
        owns.append(own)
    beyond = _any_beyond(levels, lambda i, j: _correlation(given, turns, owns, marks, i, j))
    # int u phi(u - k) over a cell is -[phi(u - k)] + k [Phi(u - k)]; k moved by d changes phi by exp(|u - k| d) at most
    middle, away = mean.mid[None], mean.rad[None] * (1 + 1e-12)
    parts = (np.exp(-0.5 * (low - middle) ** 2) - np.exp(-0.5 * (high - middle) ** 2)) * np.exp(-LOG_ROOT_2PI)
    parts = parts + middle * np.exp(log_between(low - middle, high - middle))
    farthest = np.maximum(np.abs(low - middle), np.abs(high - middle)) + away
    mass = np.log(np.maximum(parts, 0.0) + 1e-13 * (high**2 - low**2)) + farthest * away + 1e-13
    far = np.maximum(_CELLS[-1] - mean.hi, 0.0)
    tail = np.logaddexp(-0.5 * far**2 - LOG_ROOT_2PI, np.log(np.maximum(mean.hi, 1e-300)) + log_tail(far))
    inner = np.logaddexp.reduce(np.concatenate([mass + np.log1p(-beyond), tail[None]]), axis=0)
    density = -0.5 * z * z / s2.hi * (1 - 1e-15) - 0.5 * np.log(s2.lo) - LOG_ROOT_2PI
    value = inner + np.log(v.hi) + density
    return np.where(np.isnan(value) | (s2.lo <= 0), np.inf, value + 1e-12 * (1 + np.abs(value)))


def _root(square: Interval) -> Interval:
    return iv.sqrt(Interval(np.maximum(square.lo, 0.0), np.maximum(square.hi, 0.0)))


def _correlation(
    given: dict[tuple[int, int], Interval], turns: list[Interval], owns: list[Interval], marks: Sequence[Mark], i: int,
    j: int,
) -> Array:
    """Upper bound of the correlation of two marks' values, each with its sign, under xi and its speed: (pieces,)."""
    value = (given[max(i, j) + 1, min(i, j) + 1] - turns[i] * turns[j]) / (owns[i] * owns[j])
    high = (value * float(marks[i].sign * marks[j].sign)).hi
    return np.where(np.isfinite(high), np.clip(high, -1.0, 1.0), 1.0)


@quiet
def _any_beyond(levels: list[Array], correlation: Callable[[int, int], Array]) -> Array:
    """Lower bound of P(some of several standard normal variables is above its level), (cells, pieces).

    By de Caen's inequality, sum of p_i^2 / sum_j p_ij, or the largest p_i; from lower bounds of the p_i and upper
    bounds of the p_ij, which rise with the correlation and fall with the levels.
    """
    singles = [np.exp(log_tail_below(level)) for level in levels]
    totals = [np.exp(log_tail(level)) for level in levels]
    best = np.max(singles, axis=0)
    for i in range(len(levels)):
        for j in range(i):
            rho = np.maximum(-correlation(i, j), -1.0)[None] * np.ones_like(levels[i])
            both = np.exp(log_below_above(-levels[i], levels[j], rho))
            totals[i], totals[j] = totals[i] + both, totals[j] + both
    joined = sum(np.where(p > 0, p * p / total, 0.0) for p, total in zip(singles, totals))
    return np.asarray(np.clip(np.maximum(best, joined * (1 - 1e-12)), 0.0, 1.0))


def lagged_cost(law: AffineLaw, row: Sequence[float], level: float, marks: Sequence[Mark], spans: Spans) -> Costs:
    """What first crossings of a level cost from the longest lag on, piece by piece."""
    joint = joint_of(law, row, marks, spans)
    known: dict[tuple[int, int], tuple[float, float]] = {}
    for left in range(_ROUNDS - 1, -1, -1):
        keys = list(zip(joint.levels.tolist(), joint.indices))
        new = [k for k, key in enumerate(keys) if key not in known]
        found = lagged_parts(joint, level, marks, np.array(new, dtype=np.intp))
        for k, value, guess in zip(new, *(part.tolist() for part in found)):
            known[keys[k]] = value, guess
        pieces, about = np.array([known[key] for key in keys]).T
        top = float(np.max(np.where(np.isfinite(pieces), pieces, -np.inf), initial=-np.inf))
        top = top if np.isfinite(top) else 0.0
        gaps = np.exp(np.minimum(pieces - top, 700)) - np.exp(np.minimum(about - top, 700))
        gaps = np.where(np.isfinite(pieces) | (pieces == -np.inf), np.maximum(gaps, 0), np.inf)
        whole = np.sum(np.exp(np.where(np.isfinite(pieces), pieces, -np.inf) - top))
        if (np.all(np.isfinite(gaps)) and np.sum(gaps) <= _NEAR * whole) or len(pieces) > _MOST:
            break
        worst = np.isinf(gaps)
        finite = np.where(worst, 0.0, gaps)
        worst |= (finite > _NEAR * whole / (2 * len(gaps))) & (finite > 0.05 * np.max(finite, initial=0.0))
        if not (left and np.any(worst)):
            break  # what is split after the last look would have no costs
        joint.split(np.flatnonzero(worst))
    long = max(mark.lag for mark in marks)
    times = [float(joint.law.doubling.step(int(k)) * index) for k, index in zip(joint.levels, joint.indices)]
    return Costs(times=long + np.array([*times, joint.law.horizon]), logs=pieces + 1e-11, lag=long)


@dataclass(frozen=True, eq=False, kw_only=True)
class Costs:
    """Logs of what pieces of time cost, each at a constant rate at most; crossings count from ``lag`` on.

    Where ``logs`` are infinite ``whole`` says what all of a piece or any part of it costs.
    """

    times: Array
    logs: Array
    lag: float
    whole: Array | None = None

    def share(self, last: float) -> float:
        """What part of the whole the time until ``last`` costs."""
        return self.between(self.times[0], last) / (self.between(self.times[0], self.times[-1]) + 1e-300)

    def between(self, first: float, last: float) -> float:
        """What an interval of time costs, which no piece may be missing from."""
        inside = np.minimum(self.times[1:], last) - np.maximum(self.times[:-1], first)
        part = np.clip(inside / np.diff(self.times) * (1 + 1e-12) + 1e-15, 0.0, 1.0)
        part = np.where(inside + 1e-12 * self.times[-1] <= 0, 0.0, part)
        logs = self.logs
        if self.whole is not None:
            part = np.where((part > 0) & np.isinf(logs), 1.0, part)
            logs = np.fmin(logs, self.whole)
        with np.errstate(over="ignore", invalid="ignore"):
            return float(np.sum(np.where(part > 0, np.exp(np.minimum(logs, 50.0)) * part, 0.0)) * (1 + 1e-11))


@dataclass(frozen=True, kw_only=True)
class Watched:
    """A limit whose keeping may be a mark: sign * row X <= level at all times."""

    row: tuple[float, ...]
    sign: int
    level: float


def choose_marks(
    law: AffineLaw, row: Sequence[float], level: float, watched: Sequence[Watched], spans: Spans,
    early: Callable[[float], float],
) -> list[Mark]:
    """Marks that take most from the crossings of row X over a level, by floats and the law at the end.

    ``early``: the share of the crossings within so long a time from the start, in which none are taken.
    """
    doubling = law.doubling
    final = doubling.gramian(GAIN, 0)
    if LOSS in doubling.sources:
        final = final - doubling.gramian(LOSS, 0)
    if law.covariance is not None:
        final = final + law.covariance
    cov, slope = _plain(final), _plain(law.slope)
    own = np.asarray(row, dtype=float)
    fast = own @ slope
    s2, e2 = float(own @ cov @ own), float(fast @ cov @ fast)
    if not (s2 > 0 and e2 > 0):
        return []
    unit = 2 * np.pi * np.sqrt(s2 / e2) / _PARTS
    count = int(min(_LAGS, _EARLY * law.horizon / unit))
    rows = np.array([watch.row for watch in watched]) * np.array([watch.sign for watch in watched])[:, None]
    levels = np.array([watch.level for watch in watched])
    lags = np.arange(count + 1)
    step = _plain(spans.transition(float(unit))) if count else np.eye(law.dimension)
    moved, others = [own], [rows]  # rows of X now, as of a lag ago
    for _ in range(count):
        moved.append(moved[-1] @ step)
        others.append(others[-1] @ step)
    ahead = np.array([m @ cov @ rows.T for m in others])  # (lags, limits, limits): the first is so much later
    to_x = np.array([m @ cov @ rows.T for m in moved])
    to_e = np.array([m @ slope @ cov @ rows.T for m in moved]) / np.sqrt(e2)
    spread = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", rows, cov, rows), 1e-300))
    rest = spread**2 - to_x**2 / s2 - to_e**2
    usable = rest > 1e-9 * spread**2
    usable[0] &= ~np.all(np.isclose(rows, own), axis=1)
    deviation = np.sqrt(np.maximum(rest, 1e-300))
    u = 0.5 * (_CELLS[1:42] + _CELLS[:41])[::2]
    weight = u * np.exp(-(u**2) / 2)
    weight = weight / weight.sum()
    gaps = ((levels - to_x / s2 * level)[..., None] - to_e[..., None] * u) / deviation[..., None]
    worth = np.where(usable, np.exp(log_tail(gaps)) @ weight, 0.0)
    chosen: list[tuple[int, int]] = []
    before = np.array([early(lag * unit) for lag in lags.tolist()])[:, None]
    while len(chosen) < _MARKS:
        lost = max((float(before[lag, 0]) for lag, _ in chosen), default=0.0)
        score = worth - np.maximum(before - lost, 0.0)
        lag, number = (int(x) for x in np.unravel_index(int(np.argmax(score)), score.shape))
        if score[lag, number] < _GAIN:
            break
        chosen.append((lag, number))
        gap = np.abs(lag - lags)
        later = np.where((lags <= lag)[:, None], ahead[gap, :, number], ahead[gap, number, :])
        rho = (later - to_x * to_x[lag, number] / s2 - to_e * to_e[lag, number]) / (deviation * deviation[lag, number])
        rho = np.clip(np.nan_to_num(rho), -1.0, 1.0)[..., None] * np.ones(len(u))
        both = np.exp(log_below_above(-gaps, np.broadcast_to(gaps[lag, number], gaps.shape), -rho)) @ weight
        worth = np.maximum(worth - both, 0.0)
        worth[lag, number] = 0.0
    pairs = [(float(lag * unit), watched[number]) for lag, number in chosen]
    return [Mark(row=one.row, lag=lag, sign=one.sign, level=one.level) for lag, one in pairs]


def _plain(matrix: arb_mat) -> Array:
    """The middles of balls."""
    return np.array([float(x.mid()) for x in matrix.entries()]).reshape(matrix.nrows(), matrix.ncols())
