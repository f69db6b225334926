"""Upper bounds of P(some limit is exceeded) for an affine law: limits one by one, and all of them joined.

A direction a has limits a X <= b from above, or from both sides. Each side costs what being above at its start costs,
and its crossings (`smooth`, `rough`); pieces of time are halved where enclosures cost most. Sides and directions add
up; where all limits are stated from both sides over the same time, sets {|a Z_t| <= z_t for all t of a part} are
symmetric and convex, and by Royen's inequality the probability that all hold is at least the product over parts of time
and directions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
from flint import arb, arb_mat

from certbound.arrays import Array, Integers
from certbound.gaussian.affine.lagged import Costs, Spans, Watched, choose_marks, lagged_cost
from certbound.gaussian.affine.law import AffineLaw, root_up
from certbound.gaussian.affine.rough import Decays, joined_parts, lags_of, rough_parts
from certbound.gaussian.affine.row_windows import Chain, crude_parts, window_parts, windows_about
from certbound.gaussian.affine.smooth import smooth_parts
from certbound.gaussian.affine.trace import Trace
from certbound.gaussian.scalar import log_tail
from certbound.watch import poll

_NEAR = 0.01  # of the whole, what enclosures may add
_ROUNDS, _MOST = 60, 6000  # halvings one after the other, and pieces
_FEW, _VAIN = 8, 6  # pieces that are costly to look at, and halvings after which none of them became known: no more
_LOOSE = 0.12  # in the exponent of a density, what the variance may move over a piece of a rough row
_UNSURE = 1e-300
_CERTAIN = 2.5  # logarithm of a number of crossings from which on nothing is said
_MOST_STATES, _MOST_SIDES, _WATCHED = 80, 8, 12  # for first crossings: states, limits, and limits that marks watch
_SHARE = -4.6  # logarithm of a limit's part of the whole, below which all its crossings count
_LIKELY = -4.5  # logarithm of a probability from which on a product says more than a sum
_HALVINGS, _PART, _HOPELESS = 12, 0.02, 5.0  # of pieces that cost more than that; what all may cost
_PARTED = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 64, 128)


@dataclass(frozen=True, kw_only=True)
class Limit:
    """sign * (a X) <= bound, with the direction's number; ``during`` None: at all times."""

    direction: int
    sign: int
    bound: float
    during: tuple[float, float] | None = None


@dataclass(eq=False)
class Exit:
    """The law of one direction, and what exceeding some limits along it costs."""

    law: AffineLaw
    row: Sequence[float]
    limits: Sequence[Limit]

    def __post_init__(self) -> None:
        row = [arb(value) for value in self.row]
        self.smooth = all(x.is_zero() for x in (arb_mat([row]) * self.law.noise).entries())
        self.trace = Trace(self.law, row, full=not self.smooth)
        self.decays: Decays | None = None
        self.peaks: dict[int, Array] = {}  # of smooth rows: the pieces' costs at their highest rates
        self.chains: dict[int, Chain] = {}  # of rough rows
        self.parts: list[tuple[float, Array, Integers]] = []  # of every limit: at its start, piece by piece, which
        self._refine()

    def _chosen(self, limit: Limit) -> Integers:
        """Pieces that meet the limit's window."""
        if limit.during is None:
            return np.arange(len(self.trace))
        first, last = limit.during
        times = self.trace.times
        slip = 1e-12 * self.law.horizon
        return np.flatnonzero((times[1:] >= first - slip) & (times[:-1] <= last + slip))

    def _evaluate(self, *, closely: bool = False) -> tuple[list[tuple[float, Array, Integers]], Array]:
        """What every limit costs, and which pieces are worth being halved (a weight each)."""
        trace = self.trace
        found: list[tuple[float, Array, Integers]] = []
        gaps = np.zeros(len(trace))
        logs = []
        for limit in self.limits:
            lines, _ = trace.rooms(limit.bound, limit.sign)
            chosen = self._chosen(limit)
            if self.smooth:
                begun, pieces, about, self.peaks[len(found)] = smooth_parts(trace, lines, chosen)
                first = float(begun[0])
            else:
                first, pieces, about = self._rough(lines, chosen, len(found), closely=closely)
            found.append((first, pieces, chosen))
            logs.append((pieces, about, chosen))
        top = max(float(np.max(np.where(np.isfinite(p), p, -np.inf), initial=-np.inf)) for p, _, _ in logs)
        top = max(top, max(part[0] for part in found))
        top = top if np.isfinite(top) else 0.0
        for pieces, about, chosen in logs:
            gap = np.exp(np.minimum(pieces - top, 700.0)) - np.exp(np.minimum(about - top, 700.0))
            gaps[chosen] += np.where(np.isfinite(pieces) | (pieces == -np.inf), np.maximum(gap, 0.0), np.inf)
        return found, gaps

    def _rough(
        self, lines: Array, chosen: Integers, number: int, *, closely: bool
    ) -> tuple[float, Array, Array]:  # fmt: skip
        """What a limit of a rough row costs at its start, piece by piece, and about that without enclosures."""
        chain = self.chains[number] = self._chain(lines, chosen, closely=closely)
        first, pieces = chain.settled()
        about = np.minimum(pieces, windows_about(self.trace, lines, chosen))
        about[self._loose(lines)[chosen] | np.isinf(chain.enters)] = -np.inf  # or from any start: shorter ones say more
        if closely and self.decays is not None:
            pieces = joined_parts(self.trace, self.decays, lines, chosen, pieces, chain.leaves)
        return first, pieces, about

    def _chain(self, lines: Array, chosen: Integers, *, closely: bool) -> Chain:
        """The best comparison of a rough row on each piece, or one of them on all where that is less.

        Only ``closely`` the one is looked at that asks for covariance matrices.
        """
        trace = self.trace
        crude, windows = crude_parts(trace, lines, chosen), window_parts(trace, lines, chosen)
        chains = [windows.lesser(crude)]
        if closely:
            if self.decays is None:
                self.decays = Decays(trace, lags_of(trace, self.law.horizon))
            blocks = rough_parts(trace, self.decays, lines, chosen, closely=True)
            chains += [blocks.lesser(crude), chains[0].lesser(blocks)]
        return min(chains, key=lambda chain: chain.log_sum)

    def _loose(self, lines: Array) -> Array:
        """Pieces over which the level of a rough row moves too much."""
        low, high = self.trace.spread_of()
        level = np.min(lines, axis=1) ** 2 / np.maximum(high, 1e-300)
        moved = (1 - low / np.maximum(high, 1e-300)) * np.maximum(level, 1.0) / 2
        moved += np.abs(lines[:, 1] - lines[:, 0]) * np.abs(lines).max(axis=1) / np.maximum(high, 1e-300)
        return np.asarray(moved > _LOOSE)

    def _refine(self) -> None:
        """Halve pieces where enclosures cost most."""
        least, kept = np.inf, self.trace
        for cost in self._rounds():
            if not self.smooth and cost < least:
                least, kept = cost, copy(self.trace)
        if not self.smooth:
            self._settle(kept)

    def _settle(self, kept: Trace) -> None:
        """Look closely at a rough row on the last pieces, and on those on which windows cost least.

        A piece is one window at least, and more windows than are needed cost more; blocks of windows that begin
        nothing anew ask for short pieces.
        """
        found = []
        for trace in (kept, self.trace)[: 1 if len(kept) == len(self.trace) else 2]:
            self.trace, self.decays, self.chains = trace, None, {}
            self.parts, _ = self._evaluate(closely=True)
            found.append((self._largest(), trace, self.decays, self.chains, self.parts))
        _, self.trace, self.decays, self.chains, self.parts = min(found, key=lambda one: one[0])

    def _largest(self) -> float:
        """Logarithm of the most that a limit costs."""
        return max(float(np.logaddexp.reduce(np.append(pieces, first))) for first, pieces, _ in self.parts)

    def _rounds(self) -> Iterator[float]:
        """Logarithms of what all limits cost after each round of halvings."""
        unknown, rounds = 0, 0  # pieces of which nothing is known, and since when there are no fewer
        for left in range(_ROUNDS - 1, -1, -1):
            poll("pieces of time")
            self.parts, gaps = self._evaluate()
            yield self._largest()
            rounds = rounds + 1 if _FEW < unknown <= np.sum(np.isinf(gaps)) else 0
            unknown = int(np.sum(np.isinf(gaps)))
            if rounds == _VAIN:
                return
            logs = np.concatenate([np.append(pieces, first) for first, pieces, _ in self.parts])
            top = float(np.max(np.where(np.isfinite(logs), logs, -np.inf), initial=-np.inf))
            if top == -np.inf and not np.any(gaps):
                return
            whole = np.sum(np.exp(np.where(logs == np.inf, -np.inf, logs) - (top if np.isfinite(top) else 0.0)))
            if not np.any(np.isinf(gaps)) and np.sum(gaps) <= _NEAR * whole:
                return
            if len(self.trace) > _MOST:
                return
            worst = np.isinf(gaps)
            least = max(_NEAR * whole / (2 * len(self.trace)), _UNSURE)
            finite = np.where(worst, 0.0, gaps)
            worst |= (finite > least) & (finite > 0.05 * np.max(finite, initial=0.0))
            if not (left and np.any(worst)):
                return  # what is split after the last look would have no costs
            self.trace.split(np.flatnonzero(worst))

    def log_of(self, number: int) -> float:
        """Logarithm of a bound of P(a limit is exceeded)."""
        first, pieces, _ = self.parts[number]
        return min(float(np.logaddexp.reduce(np.append(pieces, first))) + 1e-11, 0.0)

    def costs_of(self, number: int) -> Costs:
        """What crossings of a limit cost, piece by piece, each counted at its highest rate."""
        pieces = self.parts[number][1]
        return Costs(times=self.trace.times, logs=self.peaks[number], lag=0.0, whole=pieces)

    def within(self, number: int, first: float, last: float) -> float:
        """Upper bound of P(a limit of a rough row is exceeded on the pieces that [first, last] touches)."""
        times, chain = self.trace.times, self.chains[number]
        begun = int(np.clip(np.searchsorted(times, first, side="right") - 1, 0, len(self.trace) - 1))
        done = int(np.clip(np.searchsorted(times, last, side="left"), begun + 1, len(self.trace)))
        costs = np.append(chain.settled()[1][begun:done], log_tail(chain.enters[begun]))
        return float(np.exp(np.minimum(np.logaddexp.reduce(costs), 5.0))) * (1 + 1e-11)

    def log_kept(self) -> float | None:
        """Logarithm of a lower bound of P(|a Z| stays within both rooms); None where it is not bounded from both sides.

        The product over parts of time, each with what being beyond the rooms at its start costs.
        """
        sides = {limit.sign: limit for limit in self.limits}
        if len(self.limits) != 2 or len(sides) != 2 or any(limit.during is not None for limit in self.limits):
            return None
        best, split = -np.inf, False
        for _ in range(_HALVINGS):
            costs = self._two_sided()
            worst = np.flatnonzero(costs[0] > _PART)
            best = max(best, self._product(*costs))
            if not len(worst) or len(self.trace) > _MOST or np.sum(costs[0]) > _HOPELESS:
                break
            self.trace.split(worst)
            split = True
        if not self.smooth:
            best = max(best, self._product(*self._two_sided(closely=True)))
        if split:
            self.parts, _ = self._evaluate(closely=True)
        if self.law.resting and self.limits[0].bound == self.limits[1].bound:
            both = 2 * float(np.exp(self.log_of(0))) * (1 + 1e-12)
            best = max(best, float(np.log1p(-both)) - 1e-12) if both < 1 else best
        return best if best > -np.inf else None

    def _two_sided(self, *, closely: bool = False) -> tuple[Array, Array]:
        """What leaving |a Z| <= z costs on each piece, and at its start, z the smaller room of both sides."""
        trace, every = self.trace, np.arange(len(self.trace))
        lines = np.minimum(*(trace.rooms(limit.bound, limit.sign)[0] for limit in self.limits))
        if self.smooth:
            first, pieces, _, _ = smooth_parts(trace, lines, every)
            enters = np.where(lines[:, 0] >= 0, lines[:, 0] / root_up(trace.spread_of()[1]), -np.inf)
            heads = np.exp(log_tail(enters))
            heads[0] = np.exp(min(float(first[0]), 0.0))
        else:
            chain = self._chain(lines, every, closely=closely)
            pieces, heads = chain.settled()[1], np.exp(log_tail(chain.enters))
        return 2 * np.exp(np.minimum(pieces, 5.0)) * (1 + 1e-11), 2 * heads * (1 + 1e-11)

    def _product(self, costs: Array, heads: Array) -> float:
        """The best logarithm over parts of time that cost about the same."""
        best = -np.inf
        total = np.cumsum(costs)
        for parts in _PARTED:
            places = np.unique(np.searchsorted(total, total[-1] * np.arange(parts) / parts, side="left"))
            places = np.unique(np.concatenate([[0], places]))
            failing = (np.add.reduceat(costs, places) + heads[places]) * (1 + 1e-12)
            if np.all(failing < 1):
                best = max(best, float(np.sum(np.log1p(-failing))) * (1 + 1e-13))
        return best


@dataclass(frozen=True, eq=False, kw_only=True)
class Exits:
    """What is proved of all limits: logarithms of bounds, of P(some is exceeded) and limit by limit."""

    log_probability: float
    logs: tuple[float, ...]


def bound_exits(
    law: AffineLaw, rows: Sequence[Sequence[float]], limits: Sequence[Limit],
    first: Callable[[float, tuple[float, ...]], bool] = lambda total, logs: True,
) -> Exits:
    """Bound P(some limit is exceeded), for every start and disturbance of the law.

    ``first`` is told the sum over limits and its parts, all logarithms, and says whether to look for less.
    """
    exits, logs = _one_by_one(law, rows, limits)
    total = float(np.logaddexp.reduce(logs))
    if not first(min(total, 0.0), tuple(logs)) or total > _CERTAIN:
        return Exits(log_probability=min(total, 0.0), logs=tuple(logs))
    total = min(total, _by_directions(exits, logs), _by_first_crossings(law, rows, limits, exits, logs))
    return Exits(log_probability=min(total, 0.0), logs=tuple(logs))


def _one_by_one(
    law: AffineLaw, rows: Sequence[Sequence[float]], limits: Sequence[Limit]
) -> tuple[list[tuple[Exit, list[int]]], list[float]]:
    """The directions with the numbers of their limits, and what each limit costs."""
    logs = [0.0] * len(limits)
    exits = []
    for direction, row in enumerate(rows):
        own = [place for place, limit in enumerate(limits) if limit.direction == direction]
        found = Exit(law, row, [limits[place] for place in own])
        exits.append((found, own))
        for number, place in enumerate(own):
            logs[place] = found.log_of(number)
    return exits, logs


def _by_directions(exits: list[tuple[Exit, list[int]]], logs: list[float]) -> float:
    """By the product over directions with two sides, beside the sum over all others."""
    parted, rest = 0.0, -np.inf
    for found, own in exits:
        whole = float(np.logaddexp.reduce([logs[place] for place in own]))
        kept = found.log_kept() if whole > _LIKELY else None
        if kept is None:
            rest = float(np.logaddexp(rest, whole))
        else:
            parted += kept
    product = np.log(-np.expm1(parted)) if parted < 0 else -np.inf
    return float(np.logaddexp(rest, product)) + 1e-12


def _by_first_crossings(
    law: AffineLaw, rows: Sequence[Sequence[float]], limits: Sequence[Limit], exits: list[tuple[Exit, list[int]]],
    logs: list[float],
) -> float:
    """By crossings that were within all limits a while before, where the mean stands still."""
    plain = all(limit.during is None and limit.bound > 0 for limit in limits)
    if not (plain and law.resting and law.dimension <= _MOST_STATES):
        return 0.0
    top = float(np.logaddexp.reduce(logs))
    spans = Spans(law)
    watched = [Watched(row=tuple(rows[one.direction]), sign=one.sign, level=one.bound) for one in limits]
    order = sorted(range(len(limits)), key=lambda place: -logs[place])
    watched = [watched[place] for place in order[:_WATCHED]]
    sides: list[Side] = []
    known: dict[tuple[int, float], Side] = {}
    for found, own in exits:
        for number, place in enumerate(own):
            limit = limits[place]
            key = limit.direction, limit.bound
            if key not in known:
                after = None
                if found.smooth and logs[place] > top + _SHARE and len(known) < _MOST_SIDES:
                    seen, early = _seen(watched, limit.sign), found.costs_of(number).share
                    marks = choose_marks(law, rows[limit.direction], limit.bound, seen, spans, early)
                    if marks:
                        after = lagged_cost(law, rows[limit.direction], limit.bound, marks, spans)
                known[key] = Side(exit=found, number=number, level=limit.bound, after=after)
            sides.append(known[key])
    if all(side.after is None for side in sides):
        return 0.0
    best = float(np.log(min(sum(side.cost(0.0, law.horizon) for side in sides), 1.0) + 1e-300))
    symmetric = len(sides) == 2 * len(exits) and all(
        limits[own[0]].sign != limits[own[1]].sign and limits[own[0]].bound == limits[own[1]].bound
        for _, own in exits if len(own) == 2
    )  # fmt: skip
    if symmetric and best > _LIKELY:
        for parts in _PARTED:
            ends = np.linspace(0.0, law.horizon, parts + 1)
            failing = [sum(side.cost(*pair) for side in sides) for pair in zip(ends[:-1].tolist(), ends[1:].tolist())]
            if max(failing) < 1:
                kept = float(np.sum(np.log1p(-np.array(failing)))) * (1 + 1e-12)
                best = min(best, float(np.log(-np.expm1(kept))) + 1e-12)
    return best + 1e-11


def _seen(watched: list[Watched], sign: int) -> list[Watched]:
    """The limits as they are for -X, where it is the lower side that is crossed: the law is symmetric."""
    return [Watched(row=one.row, sign=sign * one.sign, level=one.level) for one in watched]


@dataclass(frozen=True, eq=False, kw_only=True)
class Side:
    """One limit: what all crossings cost, and (``after``) what first crossings do from their longest lag on."""

    exit: Exit
    number: int
    level: float
    after: Costs | None

    def cost(self, first: float, last: float) -> float:
        """Upper bound of P(this limit is the first to be exceeded within [first, last]), which starts within all."""
        trace, (start, _, _) = self.exit.trace, self.exit.parts[self.number]
        piece = int(np.clip(np.searchsorted(trace.times, first, side="right") - 1, 0, len(trace) - 1))
        head = np.exp(start)
        if first > 0:
            high = trace.spread_of()[1][max(piece - 1, 0) : piece + 2].max()
            head = float(np.exp(log_tail(self.level / root_up(high) * (1 - 1e-12))))
        if self.after is None and first == 0 and last == self.exit.law.horizon:
            return float(np.exp(self.exit.log_of(self.number)))
        if not self.exit.smooth:
            return self.exit.within(self.number, first, last)
        plain = self.exit.costs_of(self.number)
        middle = last
        after = 0.0
        if self.after is not None:
            begun = first + self.after.lag
            if begun < last:
                middle, after = begun, self.after.between(begun, last)
        return float(head + plain.between(first, middle) + after) * (1 + 1e-12)
