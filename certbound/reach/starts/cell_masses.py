"""The probability of failing from a random start, from both sides: the normal mass of the starts that fail.

P(fail) <= 1 - sum of the masses of cells all of whose paths keep every constraint + what the rest misses, and
P(fail) >= sum of the masses of cells all of whose paths break one - what it misses. Cells that do neither are halved
along the direction that hides it, those of the largest mass first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Integers, Mask
from certbound.reach.starts.crossed_limits import Limit
from certbound.reach.starts.drawn_directions import FAR, StartDirections
from certbound.watch import poll

_PARTS = 0.9  # of the undecided mass, whose cells are halved in a round
_MOST = 1500  # cells halved in a round
_TOGETHER = 64  # cells that are judged together
_ROUND = 1e-12
_OPEN, _KEPT, _BROKEN = 0, 1, 2


@dataclass(frozen=True, eq=False, kw_only=True)
class StartBounds:
    """P(fail) within [``lower``, ``upper``]; ``shares`` are masses of cells that break each constraint."""

    lower: float
    upper: float
    cells: int
    shares: tuple[float, ...]


class StartCells:
    """Boxes of the directions of a start, and what is known of each."""

    def __init__(self, start: StartDirections, kept: list[Limit], broken: list[Limit]) -> None:
        self.start, self.kept, self.broken = start, kept, broken
        self.low = np.full((1, start.count), -FAR)
        self.high = np.full((1, start.count), FAR)
        self.least, self.most = start.mass(self.low, self.high)
        self.status, self.by, self.axis = self._judged(self.low, self.high)

    def bounds(self) -> StartBounds:
        """What the cells prove together."""
        failing = self.status == _BROKEN
        lower = float(np.sum(self.least[failing])) * (1 - _ROUND) - self.start.missed
        upper = float(np.sum(self.most[self.status != _KEPT])) * (1 + _ROUND) + self.start.missed + self.start.beyond
        shares = tuple(float(self.least[failing & (self.by == k)].sum()) for k in range(len(self.broken)))
        return StartBounds(lower=max(lower, 0.0), upper=min(upper, 1.0), cells=len(self.low), shares=shares)

    def refine(self, most: int, enough: Callable[[StartBounds], bool]) -> StartBounds:
        """Halve cells until the bounds are enough, or there are ``most``."""
        while True:
            found = self.bounds()
            open_ = np.flatnonzero((self.status == _OPEN) & (self.most > 0))
            if not len(open_) or len(self.low) >= most or enough(found):
                return found
            poll(f"cells of the random start ({len(self.low)})")
            order = open_[np.argsort(-self.most[open_], kind="stable")]
            total = np.cumsum(self.most[order])
            self._halve(order[: min(int(np.searchsorted(total, _PARTS * total[-1])) + 1, _MOST)])

    def _halve(self, chosen: Integers) -> None:
        chosen = np.sort(chosen)
        rows, axis = np.arange(len(chosen)), self.axis[chosen]
        low, high = np.repeat(self.low[chosen], 2, axis=0), np.repeat(self.high[chosen], 2, axis=0)
        cut = halved(self.low[chosen, axis], self.high[chosen, axis])
        high[2 * rows, axis] = cut
        low[2 * rows + 1, axis] = cut
        least, most = self.start.mass(low, high)
        status, by, axes = self._judged(low, high)
        names = ("low", "high", "least", "most", "status", "by", "axis")
        for name, new in zip(names, (low, high, least, most, status, by, axes)):
            old = np.delete(getattr(self, name), chosen, axis=0)
            setattr(self, name, np.concatenate([old, new]))

    def _judged(self, low: Array, high: Array) -> tuple[Integers, Integers, Integers]:
        """Whether cells keep or break the constraints, by which one they break, and along which axis to halve them."""
        middle = (low + high) / 2
        half = np.maximum(high - middle, middle - low) * (1 + 1e-15)
        status, by, axis = (np.zeros(len(low), dtype=np.int64) for _ in range(3))
        order = np.lexsort(middle.T[::-1])
        for begin in range(0, len(low), _TOGETHER):  # neighbours, which keep the constraints on much the same pieces
            own = order[begin : begin + _TOGETHER]
            kept, hidden = self._kept(middle[own], half[own])
            rest = own[~kept]
            broken, number = self._broken(middle[rest], half[rest])
            status[own[kept]], status[rest[broken]], by[rest] = _KEPT, _BROKEN, number
            hidden = np.where(hidden.max(axis=1, keepdims=True) > 0, hidden, half[own])
            axis[own] = np.argmax(hidden, axis=1)
        return status, by, axis

    def _kept(self, middle: Array, half: Array) -> tuple[Mask, Array]:
        """Which cells keep every constraint, and how much each direction hides that, (B,) and (B, d)."""
        kept, hidden = np.ones(len(middle), dtype=bool), np.zeros(middle.shape)
        for limit in self.kept:
            pieces = limit.near(middle, half)
            for part in limit.chunks(pieces, len(middle)) if len(pieces.value) else ():
                room = limit.room(pieces, middle[part], half[part])
                place = np.argmin(room, axis=1)
                short = room[np.arange(len(room)), place] < 0
                found = limit.effects(pieces.chosen(place), middle[part], half[part])
                hidden[part] += np.where(short[:, None], found, 0.0)
                kept[part] &= ~short
        return kept, hidden

    def _broken(self, middle: Array, half: Array) -> tuple[Mask, Integers]:
        """Which cells break a constraint, and the number of one that they break."""
        broken, by = np.zeros(len(middle), dtype=bool), np.zeros(len(middle), dtype=np.int64)
        for number, limit in enumerate(self.broken):
            points = limit.beside(middle, half) if len(middle) else limit.points
            for part in limit.chunks(points, len(middle)) if len(points.value) else ():
                beyond = limit.breaks(points, middle[part], half[part]).max(axis=1) > 0
                by[part] = np.where(beyond & ~broken[part], number, by[part])
                broken[part] |= beyond
        return broken, by


def halved(low: Array, high: Array) -> Array:
    """Where an interval is halved: in its middle, or one deviation from the end that is nearer to 0."""
    middle = (low + high) / 2
    below = np.where(high <= 0, np.maximum(middle, high - 1.0), middle)
    return np.where(low >= 0, np.minimum(middle, low + 1.0), below)
