"""Crossings of a row with noise of its own (a G != 0) in windows of pieces, and what is sure of any row on a piece.

The inequalities are "One window" and "From any start" of docs/theory.md, section 9 ("Affine models exactly"), which
certificates state. The level is a line over a piece, and the rate at which correlations decay follows from c, d and v
there, so that rows whose mean moves and rows whose variance falls are compared as closely as those that rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from flint import arb_mat

from certbound.arrays import Array, Integers
from certbound.gaussian.affine.law import floats, root_up, transposed_square
from certbound.gaussian.affine.trace import Trace
from certbound.gaussian.scalar import lift, log_between, log_line_crossing, log_tail
from certbound.rigor.rounding import quiet

CLOCKS = (0.3, 0.8, 1.5, 2.5, 3.5, 5.0, 7.0, np.inf)
"""Clocks of windows, times the squares of their levels, which are tried; infinite: a piece is one window."""
LONGEST = 3.9
"""Clock of a window: longer ones cost about what a start anew does, and the checker looks at none from 4 on."""
MOST_WINDOWS = 1e9
"""Windows of a piece that a certificate may state."""
SHARES = (0.5, 0.8, 0.95, 0.99)
"""Parts of a level that what moves most may take of it, as the checker tries them."""

_SHORTEST = 1e-18  # clock of a window
_SAFE = 1 + 1e-12  # by which results of a few operations are raised


@dataclass(frozen=True, eq=False, kw_only=True)
class Chain:
    """Costs of pieces that follow each other, natural logarithms, (K,).

    Each is the cost of exceeding the limit on the piece for who begins at most at ``enters`` standard deviations
    (infinite: from anywhere); who did not is at most at ``leaves`` at its end (infinite: nothing is known).
    """

    costs: Array
    enters: Array
    leaves: Array

    def lesser(self, other: Chain) -> Chain:
        """Piece by piece the one that costs less."""
        own = self.costs <= other.costs
        pairs = ((self.costs, other.costs), (self.enters, other.enters), (self.leaves, other.leaves))
        costs, enters, leaves = (np.where(own, first, second) for first, second in pairs)
        return Chain(costs=costs, enters=enters, leaves=leaves)

    @quiet
    def settled(self) -> tuple[float, Array]:
        """Logarithms of what being beyond the first level at the start costs, and of each piece with what lies between
        the level of the piece before, at its end, and its own."""
        jumps = np.full(len(self.costs), -np.inf)
        falls = self.enters[1:] < self.leaves[:-1]
        jumps[1:] = np.where(falls, log_between(self.enters[1:], self.leaves[:-1]), -np.inf)
        return float(log_tail(self.enters[:1])[0]), np.asarray(lift(np.logaddexp(self.costs, jumps), 16))

    @property
    def log_sum(self) -> float:
        """Logarithm of all that is paid for."""
        first, pieces = self.settled()
        return float(np.logaddexp.reduce(np.append(pieces, first)))


def own_noise(trace: Trace) -> float:
    """Upper bound of a G G^T a^T."""
    row = arb_mat([trace.row])
    return float(floats((row * transposed_square(trace.law.noise) * row.transpose()).entries())[1][0])


@quiet
def window_parts(trace: Trace, lines: Array, chosen: Integers) -> Chain:
    """Crossing ``lines`` (K, 2) on the ``chosen`` pieces, each in the best of a few numbers of windows."""
    first, last = lines[chosen, 0], lines[chosen, 1]
    after = trace.s[0][chosen + 1]
    return _in_windows(_Sides.of(trace, chosen), trace.steps[chosen], (first, last), (trace.s[1][chosen], after))


@quiet
def windows_about(trace: Trace, lines: Array, chosen: Integers) -> Array:
    """About the costs of `window_parts` without enclosures; they bound nothing."""
    first, last = (lines[chosen] + trace.chord_error[chosen, None]).T
    sides = _Sides.of(trace, chosen).flat()
    return _in_windows(sides, trace.steps[chosen], (first, last), (sides.s_low, sides.s_low)).costs


def _in_windows(sides: _Sides, h: Array, line: tuple[Array, Array], ends: tuple[Array, Array]) -> Chain:
    """From the levels at both ends of each piece, an upper bound of s^2 at the first and a lower one at the last."""
    first, last = line
    many, alone, after = _over(np.minimum(first, last), sides.s_high), _over(first, ends[0]), _under(last, ends[1])
    falls = np.maximum(np.log(first / last), 0.0) * _SAFE + 1e-15
    rate = sides.own / (2 * sides.s_low)
    usable = (first > 0) & (last > 0) & (sides.s_low > 0)
    best, windows = np.full(len(h), np.inf), np.ones(len(h))
    for clock in CLOCKS:
        count = np.clip(np.ceil(h * rate * np.maximum(many, 0.5) ** 2 / clock), 1, MOST_WINDOWS)
        length = h / count * (1 + 1e-15)
        decay, spread = sides.rates(length)
        fallen = np.where(count > 1, 0.0, (spread * length + falls) * _SAFE)
        spent = np.maximum(np.maximum(decay * length, fallen), _SHORTEST) * _SAFE
        start = np.where(count > 1, many, alone)
        stop = np.where(count > 1, many, alone * np.exp(-fallen) / _SAFE)
        tried = usable & (spent < LONGEST) & (start > 0) & np.isfinite(start)
        cost = np.full(len(h), np.inf)
        cost[tried] = log_line_crossing(start[tried], stop[tried], spent[tried]) + np.log(count[tried]) + 1e-14
        better = cost < best
        best, windows = np.where(better, cost, best), np.where(better, count, windows)
    single = windows == 1
    return Chain(costs=best, enters=np.where(single, alone, many), leaves=np.where(single, after, many))


@quiet
def crude_parts(trace: Trace, lines: Array, chosen: Integers) -> Chain:
    """P(the row exceeds the lesser end of its line on a piece), from anywhere: "From any start"."""
    level = np.min(lines[chosen], axis=1)
    start, own = trace.s[1][chosen], own_noise(trace)
    h, e = trace.steps[chosen], trace.speed_of()[1][chosen]
    rests = start == 0
    best = np.zeros(len(h))
    for share in SHARES:
        before = np.where(rests, 0.0, share)
        noise = np.where(rests, share, 0.9 * (1 - share)) if own > 0 else np.zeros(len(h))
        rest = (1 - before - noise) * (1 - 1e-9)  # what is lost to rounding
        terms = [np.log(2.0) - (rest * level) ** 2 / (2 * h**2 * e * _SAFE)]
        terms.append(np.where(rests, -np.inf, log_tail(before * level / root_up(start) / _SAFE)))
        if own > 0:
            terms.append(np.log(2.0) + log_tail(noise * level / np.sqrt(own * h) / _SAFE))
        best = np.minimum(best, np.logaddexp.reduce(terms, axis=0) + 1e-12)
    known = (level > 0) & ~np.isnan(best)
    nothing = np.full(len(h), np.inf)
    leaves = np.where(known, _under(level, trace.s[0][chosen + 1]), np.inf)
    return Chain(costs=np.where(known, best, np.inf), enters=nothing, leaves=leaves)


def _over(level: Array, high: Array) -> Array:
    """Lower bounds of level/s from upper bounds of s^2, of levels above 0."""
    return np.asarray(level / np.sqrt(high) * (1 - 1e-14))


def _under(level: Array, low: Array) -> Array:
    """Upper bounds of level/s from lower bounds of s^2; infinite where that may be 0."""
    return np.asarray(np.where(low > 0, level / np.sqrt(low) * (1 + 1e-14), np.inf))


@dataclass(frozen=True, eq=False, kw_only=True)
class _Sides:
    """Bounds over pieces, from which the rates of windows follow."""

    s_low: Array
    s_high: Array
    c_low: Array
    c_high: Array
    d_low: Array
    v_high: Array
    own: float

    @staticmethod
    def of(trace: Trace, chosen: Integers) -> _Sides:
        pairs = [[x[chosen] for x in pair] for pair in (trace.spread_of(), trace.cross_of())]
        return _Sides(
            s_low=pairs[0][0], s_high=pairs[0][1], c_low=pairs[1][0], c_high=pairs[1][1],
            d_low=trace.second_of()[0][chosen], v_high=trace.third_of()[chosen], own=own_noise(trace),
        )  # fmt: skip

    def flat(self) -> _Sides:
        """The middles in the places of the bounds."""
        s, c = 0.5 * (self.s_low + self.s_high), 0.5 * (self.c_low + self.c_high)
        return _Sides(s_low=s, s_high=s, c_low=c, c_high=c, d_low=self.d_low, v_high=self.v_high, own=self.own)

    def rates(self, length: Array) -> tuple[Array, Array]:
        """k + D and D >= 0 over windows of that length: corr >= exp(-(k + D) x) and s_t <= s_s exp(D (t - s)).

        k - p >= L max(k^2 - q, 0)/2 + r L^2/6 is asked of the root that is found, with room for rounding.
        """
        p = -self.c_low / np.where(self.c_low < 0, self.s_low, self.s_high)
        q = self.d_low / np.where(self.d_low > 0, self.s_high, self.s_low)
        third = root_up(self.v_high / self.s_low) * _SAFE
        p = p + 1e-15 * np.abs(p) + third * length**2 / 6 * _SAFE
        q = q - 1e-15 * np.abs(q)
        part = 2 * length * (p - length * q / 2)
        root = np.where(part < 1, part / length / (1 + np.sqrt(np.maximum(1 - part, 0.0))), np.inf)
        k = np.maximum(np.maximum(root, p), 0.0) * (1 + 1e-9)
        needed = p + length * np.maximum(k * k - q, 0.0) / 2
        slack = 1e-14 * (np.abs(p) + length * (k * k + np.abs(q)))
        k = np.where(k >= needed + slack, k, np.inf)
        grown = self.c_high + 0.5 * self.own
        spread = grown / np.where(grown > 0, self.s_low, self.s_high)
        spread = spread + 1e-14 * np.abs(spread) + 1e-15 * self.own / self.s_low
        return (k + spread) * np.where(k + spread > 0, _SAFE, 1.0), np.maximum(spread, 0.0)
