"""Probabilities that the Gaussian response exceeds levels along rows, at any time (the scalar events of Thm K7).

Discrete time: P(exists t: xi_t > z_t) <= sum_t P(xi_{t-1} <= z_{t-1}, xi_t > z_t), and for noise that is only
sub-Gaussian sum_t exp(-z_t^2/(2 s_t^2)).

Continuous time, in windows [t_a, t_e]: M_s = Phi(t_e, s) Z_s is a Gaussian martingale, so that
P(a . M_{t_a} <= z, sup a . M > z) = 2 P(a . M_{t_a} <= z, a . M_{t_e} > z). A row r at time s reads r . Z_s = b . M_s
with b = r Phi(s, t_e), and where |M_i| <= z_i for all i, r . Z_s <= a . M_s + sum_i |b - a|_i z_i. That some
coordinate of M exceeds its level is paid once, for all rows together. At a sampling time, where the state jumps, a row
reads what is there after it; a window may begin with one, and none lies inside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

from flint import arb, arb_mat

from certbound.checker.balls import below_and_above, diagonal, identity, magnitude, quadratic, tail, upper
from certbound.checker.linear.response import Piece
from certbound.checker.report import FUNCTION, Budget, Unproved

_NEGLIGIBLE = 1e-3
MOST_ENTRIES = 1_000_000
"""Numbers beyond which what bounded noise does at most is not looked at: some 100 MB."""
_JOINT = 1_000_000
"""Units of work of a joint probability; 200 to 400 us measured."""

Level = arb | None


@dataclass(frozen=True, eq=False)
class _Pair:
    """P(X <= below, Y > above) for centred normals; ``below`` None: no condition."""

    below: Level
    above: arb
    below_variance: arb
    above_variance: arb
    covariance: arb
    weight: int = 1

    def tail(self) -> arb:
        """P(Y > above), the simple bound."""
        variance = self.above_variance.upper()
        if variance.is_zero():
            return arb(0) if self.above >= 0 else arb(1)
        return self.weight * upper(tail(self.above / variance.sqrt()))

    def joint(self) -> arb:
        """P(X <= below, Y > above)."""
        if self.below is None or not self.below_variance > 0 or not self.above_variance > 0:
            return self.tail()
        first, second = self.below_variance.sqrt(), self.above_variance.sqrt()
        return self.weight * below_and_above(
            self.below / first, self.above / second, self.covariance / (first * second)
        )


def union_of_pairs(pairs: Sequence[_Pair], budget: Budget) -> arb:
    """Upper bound of the sum: the joint probability where it matters, the plain tail elsewhere."""
    budget.balls(len(pairs), 2 * FUNCTION)
    tails = [pair.tail() for pair in pairs]
    total = sum(tails, arb(0))
    if total.is_zero():
        return arb(0)
    result = arb(0)
    for pair, value in zip(pairs, tails):
        if value * len(pairs) < _NEGLIGIBLE * total:
            result += value
            continue
        budget.balls(1, _JOINT)
        result += arb.min(value, pair.joint())
    return upper(result)


def chain(
    rows: Sequence[Sequence[arb]], levels: Sequence[Level], transitions: Sequence[arb_mat],
    covariances: Sequence[arb_mat], budget: Budget,
) -> arb:
    """Discrete time, Gaussian noise: P(exists k: rows[k] . Z_k > levels[k]); None: nothing is asked at that step."""
    pairs: list[_Pair] = []
    previous: tuple[arb_mat, Level, arb] | None = None
    for k, (row, level) in enumerate(zip(rows, levels)):
        budget.products(len(row), 3 * len(row) + 30)
        flat = arb_mat(1, len(row), list(row))
        variance = _variance(flat, covariances[k])
        if level is not None:
            if not level >= 0:
                return arb(1)
            below, own, cross = None, arb(0), arb(0)
            if previous is not None and previous[1] is not None:
                below, own = previous[1], previous[2]
                cross = quadratic(flat * transitions[k - 1], covariances[k - 1], previous[0])
            pairs.append(_Pair(below, level, own, variance, cross))
        previous = flat, level, variance
    return union_of_pairs(pairs, budget)


def sub_gaussian(
    rows: Sequence[Sequence[arb]], levels: Sequence[Level], proxies: Sequence[arb_mat], budget: Budget,
    drives: Sequence[arb_mat] | None = None,
) -> arb:
    """Discrete time, sub-Gaussian noise: sum of exp(-z^2/(2 r V r^T)).

    ``drives`` (`bounded_drives`) leaves out the steps at which z is no less than the largest r . Z there is.
    """
    total = arb(0)
    for k, (row, level) in enumerate(zip(rows, levels)):
        budget.products(len(row) + 8, len(row) + 30)
        if level is None:
            continue
        flat = arb_mat(1, len(row), list(row))
        variance = _variance(flat, proxies[k]).upper()
        if not level >= 0:
            return arb(1)
        if variance.is_zero() or (drives is not None and level >= _reach(flat, drives[k], budget)):
            continue
        total += (-level * level / (2 * variance)).exp()
    return upper(total)


def bounded_drives(
    transitions: Sequence[arb_mat], matrix: arb_mat, halfwidth: Sequence[arb], budget: Budget
) -> list[arb_mat] | None:
    """At every step the matrices F ... F G diag(h) of all noise before it, side by side; None where they are too many.

    Z_0 = 0 and |w_j| <= h_j, so that |r . Z_k| is at most the sum of the absolute values of r times the k-th one.
    """
    n, m, steps = matrix.nrows(), matrix.ncols(), len(transitions)
    entries = (steps + 1) * steps * n * m // 2
    if entries > MOST_ENTRIES:
        return None
    budget.hold(entries)
    budget.products(n, m, m)
    fresh = matrix * diagonal(list(halfwidth))
    found = [arb_mat(n, 0)]
    for transition in transitions:
        budget.products(n, n + 10, found[-1].ncols() + m)
        before = transition * found[-1] if found[-1].ncols() else found[-1]
        found.append(arb_mat([[*old, *new] for old, new in zip(_rows(before), fresh.tolist())]))
    return found


def _rows(a: arb_mat) -> list[list[arb]]:
    return a.tolist() if a.ncols() else [[] for _ in range(a.nrows())]


def _reach(flat: arb_mat, drive: arb_mat, budget: Budget) -> arb:
    """The largest value of a row where all noise does its worst."""
    if not drive.ncols():
        return arb(0)
    budget.products(flat.ncols() + 10, drive.ncols())
    return upper(sum((abs(x) for x in (flat * drive).entries()), arb(0)))


class Windows:
    """Windows of consecutive pieces in continuous time.

    ``covariances`` are those at the nodes, ``starts`` the first piece of every window; they rise from 0.
    """

    def __init__(
        self, pieces: Sequence[Piece], covariances: Sequence[arb_mat], starts: Sequence[int], budget: Budget
    ) -> None:
        self.pieces, self.covariances, self.budget = pieces, covariances, budget
        self.starts = list(starts)
        self.ends = [*self.starts[1:], len(pieces)]
        self.n = pieces[0].transition.nrows()
        budget.hold(3 * len(pieces) * self.n**2)
        self.levels: Sequence[Sequence[arb]] = [[]] * len(self.starts)
        self.forward: list[arb_mat] = []
        self.back: list[arb_mat] = []
        self.before: list[arb_mat] = []
        self.bend: list[arb_mat] = []
        one = identity(self.n)
        bends: list[tuple[arb_mat, arb_mat, arb_mat]] = []
        for start, end in zip(self.starts, self.ends):
            later = one
            for k in range(end - 1, start - 1, -1):
                budget.products(self.n, self.n, 8 * self.n + 40)
                try:
                    after = later.inv()
                    earlier = later * pieces[k].transition
                    if pieces[k].jump:  # it has no inverse: nothing may stand before it in its window
                        bends.append((after, after, one * 0))
                        later = earlier
                        continue
                    bends.append((after, earlier.inv(), _bend(pieces[k], after)))
                except ZeroDivisionError as error:
                    raise Unproved("a window is too long for this system") from error
                later = earlier
            self.forward.append(later)
            self.back += [item[0] for item in bends[::-1]]
            self.before += [item[1] for item in bends[::-1]]
            self.bend += [item[2] for item in bends[::-1]]
            bends.clear()

    def coordinates(self, levels: Sequence[Sequence[arb]]) -> arb:
        """P(some |M_i| exceeds levels[w][i] in some window), and these levels are kept for `exceedance`."""
        self.levels = levels
        total = arb(0)
        for i in range(self.n):
            row = [arb(1 if j == i else 0) for j in range(self.n)]
            total += 2 * self._chain([row] * len(self.starts), [level[i] for level in levels])
        return upper(total)

    def exceedance(self, rows: Sequence[Sequence[arb]], levels: Sequence[Level]) -> arb:
        """P(rows[k] . Z_t > levels[k] for some t in some piece k, and no coordinate beyond its level)."""
        directions, costs = self.spans(rows, [level is not None for level in levels])
        tops: list[Level] = []
        for start, end in zip(self.starts, self.ends):
            least: Level = None
            for k in range(start, end):
                level = levels[k]
                if level is not None:
                    value = (level - costs[k]).lower()
                    least = value if least is None else arb.min(least, value)
            tops.append(least)
        self.budget.balls(4 * len(levels))
        nothing = [arb(0)] * self.n
        return self._chain([nothing if direction is None else direction for direction in directions], tops)

    def spans(
        self, rows: Sequence[Sequence[arb]], asked: Sequence[bool]
    ) -> tuple[list[list[arb] | None], dict[int, arb]]:
        """A direction for every window (None: nothing is asked in it), and what the rows on its pieces lose to it."""
        directions: list[list[arb] | None] = []
        costs: dict[int, arb] = {}
        for window, (start, end) in enumerate(zip(self.starts, self.ends)):
            count = sum(asked[start:end])
            self.budget.balls((1 + count) * 24 * self.n)
            ends = {k: self._ends(rows[k], k) for k in range(start, end) if asked[k]}
            if not ends:
                directions.append(None)
                continue
            seen = [value for pair in ends.values() for value in pair]
            direction = [
                ((reduce(arb.max, [v[i] for v in seen]) - reduce(arb.max, [-v[i] for v in seen])) / 2).mid()
                for i in range(self.n)
            ]
            for k, pair in ends.items():
                costs[k] = self._cost(rows[k], k, direction, pair, window)
            directions.append(direction)
        return directions, costs

    def _ends(self, row: Sequence[arb], k: int) -> tuple[list[arb], list[arb]]:
        self.budget.products(3, self.n, self.n + 20)
        flat = arb_mat(1, self.n, list(row))
        return (flat * self.before[k]).entries(), (flat * self.back[k]).entries()

    def _cost(
        self, row: Sequence[arb], k: int, direction: list[arb], ends: tuple[list[arb], list[arb]], window: int
    ) -> arb:
        """Bound of (b - a) . M over the piece: b lies on a chord up to a bulge."""
        bulge = (arb_mat(1, self.n, [x.abs_upper() for x in row]) * self.bend[k]).entries()
        total = arb(0)
        for i, level in enumerate(self.levels[window]):
            off = arb.max(abs(ends[0][i] - direction[i]), abs(ends[1][i] - direction[i]))
            total += (off + bulge[i]) * level
        return total

    def _chain(self, directions: Sequence[Sequence[arb]], levels: Sequence[Level]) -> arb:
        """P(some window's a . M exceeds its level)."""
        pairs = []
        previous: tuple[arb_mat, Level, arb] | None = None
        for window, (direction, level) in enumerate(zip(directions, levels)):
            self.budget.products(4, self.n, self.n + 30)
            flat = arb_mat(1, self.n, list(direction))
            first, last = flat * self.forward[window], self.covariances[self.ends[window]]
            begin = self.covariances[self.starts[window]]
            end_variance = _variance(flat, last)
            if level is not None:
                if not level >= 0:
                    return arb(1)
                variance = _variance(first, begin)
                below, own, cross = None, arb(0), arb(0)
                if previous is not None and previous[1] is not None:
                    below, own = previous[1], previous[2]
                    cross = quadratic(first, begin, previous[0])
                pairs.append(_Pair(below, level, own, variance, cross))
                pairs.append(_Pair(level, level, variance, end_variance, variance, 2))
            previous = flat, level, end_variance
        return union_of_pairs(pairs, self.budget)


def _variance(row: arb_mat, covariance: arb_mat) -> arb:
    """row covariance row^T, which is not negative: where it is, or is no number, there is no such noise."""
    value = quadratic(row, covariance, row)
    if not value.upper() >= 0:
        raise Unproved("a variance is negative or not a number")
    return value


def _bend(piece: Piece, after: arb_mat) -> arb_mat:
    """h^2/8 sup |Phi''| |Phi(t_{k+1}, t_e)|: how far a row seen from the window's end bulges from its chord."""
    return piece.curvature * magnitude(after) * (piece.length * piece.length / 8)
