"""Upper bounds of P(some limit is exceeded) for an affine law: limits one by one, and all of them joined.

A direction a has limits a X <= b from above, or from both sides. Each side costs what being above at its start costs,
and its crossings (`smooth`, `rough`); pieces of time are halved where enclosures cost most. Sides and directions add
up; where all limits are stated from both sides over the same time, sets {|a Z_t| <= z_t for all t of a part} are
symmetric and convex, and by Royen's inequality the probability that all hold is at least the product over parts of time
and directions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from flint import arb, arb_mat

from certbound.arrays import Array, Integers
from certbound.gaussian.affine.law import AffineLaw, root_up
from certbound.gaussian.affine.rough import Decays, lags_of, rough_parts
from certbound.gaussian.affine.smooth import smooth_parts
from certbound.gaussian.affine.trace import Trace
from certbound.gaussian.scalar import log_tail
from certbound.watch import poll

_NEAR = 0.01  # of the whole, what enclosures may add
_ROUNDS, _MOST = 60, 6000  # halvings one after the other, and pieces
_LOOSE = 0.12  # in the exponent of a density, what the variance may move over a piece of a rough row
_SMALL = 1e-3  # of the whole, shared by all pieces, below which a piece is left as it is
_UNSURE = 1e-300
_LIKELY = -4.5  # logarithm of a probability from which on a product says more than a sum
_HALVINGS, _PART, _HOPELESS = 12, 0.02, 12.0  # of pieces that cost more than that; what all may cost
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

    def _evaluate(self) -> tuple[list[tuple[float, Array, Integers]], Array]:
        """What every limit costs, and which pieces are worth being halved (a weight each)."""
        trace = self.trace
        found, gaps = [], np.zeros(len(trace))
        logs = []
        for limit in self.limits:
            lines, _ = trace.rooms(limit.bound, limit.sign)
            chosen = self._chosen(limit)
            if self.smooth:
                first, pieces, about = smooth_parts(trace, lines, chosen)
            else:
                if self.decays is None:
                    self.decays = Decays(trace, lags_of(trace, self.law.horizon))
                first, pieces = rough_parts(trace, self.decays, lines, chosen)
                about = np.where(self._loose(lines)[chosen], -np.inf, pieces)
            found.append((float(first[0]), pieces, chosen))
            logs.append((pieces, about, chosen))
        top = max((float(np.max(np.where(np.isfinite(p), p, -np.inf), initial=-np.inf)) for p, _, _ in logs))
        top = max(top, max((part[0] for part in found)))
        top = top if np.isfinite(top) else 0.0
        for pieces, about, chosen in logs:
            gap = np.exp(np.minimum(pieces - top, 700.0)) - np.exp(np.minimum(about - top, 700.0))
            gaps[chosen] += np.where(np.isfinite(pieces) | (pieces == -np.inf), np.maximum(gap, 0.0), np.inf)
        return found, gaps

    def _loose(self, lines: Array) -> Array:
        """Pieces over which the level of a rough row moves too much."""
        low, high = self.trace.spread_of()
        level = np.min(lines, axis=1) ** 2 / np.maximum(high, 1e-300)
        moved = (1 - low / np.maximum(high, 1e-300)) * np.maximum(level, 1.0) / 2
        moved += np.abs(lines[:, 1] - lines[:, 0]) * np.abs(lines).max(axis=1) / np.maximum(high, 1e-300)
        return np.asarray(moved > _LOOSE)

    def _refine(self) -> None:
        for _ in range(_ROUNDS):
            poll("pieces of time")
            self.parts, gaps = self._evaluate()
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
            if not np.any(worst):
                return
            self.trace.split(np.flatnonzero(worst))

    def log_of(self, number: int) -> float:
        """Logarithm of a bound of P(a limit is exceeded)."""
        first, pieces, _ = self.parts[number]
        return min(float(np.logaddexp.reduce(np.append(pieces, first))) + 1e-11, 0.0)

    def log_kept(self) -> float | None:
        """Logarithm of a lower bound of P(|a Z| stays within both rooms); None where it is not bounded from both sides.

        The product over parts of time, each with what being beyond the rooms at its start costs.
        """
        sides = {limit.sign: limit for limit in self.limits}
        if len(self.limits) != 2 or len(sides) != 2 or any(limit.during is not None for limit in self.limits):
            return None
        best = -np.inf
        for _ in range(_HALVINGS):
            costs = self._two_sided()
            worst = np.flatnonzero(costs[0] > _PART)
            best = max(best, self._product(*costs))
            if not len(worst) or len(self.trace) > _MOST or np.sum(costs[0]) > _HOPELESS:
                break
            self.trace.split(worst)
        return best if best > -np.inf else None

    def _two_sided(self) -> tuple[Array, Array]:
        """What leaving |a Z| <= z costs on each piece, and at its start, z the smaller room of both sides."""
        trace, every = self.trace, np.arange(len(self.trace))
        lines = np.minimum(*(trace.rooms(limit.bound, limit.sign)[0] for limit in self.limits))
        if self.smooth:
            first, pieces, _ = smooth_parts(trace, lines, every)
        else:
            assert self.decays is not None
            first, pieces = rough_parts(trace, self.decays, lines, every)
        heads = np.exp(log_tail(np.where(lines[:, 0] >= 0, lines[:, 0] / root_up(trace.spread_of()[1]), -np.inf)))
        heads[0] = np.exp(min(float(first[0]), 0.0))
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


def bound_exits(law: AffineLaw, rows: Sequence[Sequence[float]], limits: Sequence[Limit]) -> Exits:
    """Bound P(some limit is exceeded), for every start and disturbance of the law."""
    logs = [0.0] * len(limits)
    parted, rest = 0.0, -np.inf
    for direction, row in enumerate(rows):
        own = [place for place, limit in enumerate(limits) if limit.direction == direction]
        found = Exit(law, row, [limits[place] for place in own])
        for number, place in enumerate(own):
            logs[place] = found.log_of(number)
        whole = float(np.logaddexp.reduce([logs[place] for place in own]))
        kept = found.log_kept() if whole > _LIKELY else None
        if kept is None:
            rest = float(np.logaddexp(rest, whole))
        else:
            parted += kept
    total = float(np.logaddexp.reduce(logs))
    product = np.log(-np.expm1(parted)) if parted < 0 else -np.inf
    joined = float(np.logaddexp(rest, product)) + 1e-12
    return Exits(log_probability=min(total, joined, 0.0), logs=tuple(logs))
