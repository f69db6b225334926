"""Bounds of leaving through one wall, or some, in one window of time: how finely they were found, and their sum."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.quadratic.inequality import Proved
from certbound.quadratic.setting import Wall
from certbound.rigor.balls import precision, upper

PIECES, SPLIT, APART, PAIRS = -1, -2, -3, -4
"""Refinements besides slabs of the held coordinates: more pieces of time, two windows in place of one, every wall by
itself, opposite sides by themselves."""
_FIRST_PIECES = 4
_GROWTH = 1.5  # of the pieces before a window, backward: what is long ago is smooth
_SMALLEST = -300.0
_LARGEST = 5e6  # inequalities, times the square of the entries of each


@dataclass(eq=False, kw_only=True, slots=True)
class Attempt:
    """The best bound of leaving through a wall, or some, in a window of time, and how finely it was found.

    Attributes
    ----------
    wall : Wall
    others : tuple of Wall
        Further walls that the same V serves.
    during : tuple of float
        The window, in which there are
    pieces : int
        of time; before it are others, the longer the earlier.
    slabs : tuple of int
        Of each held coordinate.
    proved : Proved or None
    corners : ndarray or None
        See `corner_levels`.
    seconds : float
        That the last solution took; 0 before the first.
    gains : dict
        Of the logarithm, by each refinement tried.
    """

    wall: Wall
    others: tuple[Wall, ...] = ()
    during: tuple[float, float]
    pieces: int = _FIRST_PIECES
    slabs: tuple[int, ...] = ()
    proved: Proved | None = None
    corners: Array | None = None
    seconds: float = 0.0
    gains: dict[int, float] = field(default_factory=dict)

    @property
    def level(self) -> float:
        """Bound of log P for the worst start."""
        return 0.0 if self.proved is None else min(self.proved.level, 0.0)

    @property
    def found(self) -> float:
        """The level, above 0 too, where it bounds nothing but says how far that is."""
        return math.inf if self.proved is None else self.proved.level

    @property
    def key(self) -> tuple[object, ...]:
        """What is tried: walls, window, pieces and slabs."""
        return tuple(map(id, (self.wall, *self.others))), self.during, self.pieces, self.slabs

    @property
    def times(self) -> tuple[Array, int]:
        """The ends of the pieces of time, and how many of these lie before the window."""
        start, end = self.during
        inner = np.linspace(start, end, self.pieces + 1)
        inner[0], inner[-1] = start, end
        before, length, place = [], (end - start) / self.pieces, start
        while place > 0:
            length *= _GROWTH
            place = place - length if place > 1.5 * length else 0.0
            before.append(place)
        return np.concatenate([np.array(before[::-1], dtype=float), inner]), len(before)

    @property
    def paired(self) -> int:
        """How many fewer programs opposite sides take together than by themselves, all being more than one pair."""
        walls = (self.wall, *self.others)
        pairs = paired(walls)
        return len(apart(walls)) - len(pairs) if len(pairs) > 1 else 0

    def finer(self, option: int) -> list[Attempt]:
        """Not yet tried: walls by themselves, two windows, twice the pieces, or more slabs (two are seldom enough)."""
        if option in (APART, PAIRS):
            groups = (apart if option == APART else paired)((self.wall, *self.others))
            return [self._changed(walls=group) for group in groups]
        if option == SPLIT:
            start, end = self.during
            middle = (start + end) / 2
            pieces = max(self.pieces // 2, 2)
            return [self._changed(during=one, pieces=pieces) for one in ((start, middle), (middle, end))]
        if option == PIECES:
            return [self._changed(pieces=2 * self.pieces)]
        factor = 4 if math.prod(self.slabs) == 1 and len(self.slabs) < 3 else 2
        return [self._changed(slabs=tuple(factor * n if k == option else n for k, n in enumerate(self.slabs)))]

    def _changed(
        self, during: tuple[float, float] | None = None, pieces: int | None = None,
        slabs: tuple[int, ...] | None = None, walls: tuple[Wall, ...] = (),
    ) -> Attempt:
        wall, *others = walls or (self.wall, *self.others)
        return Attempt(
            wall=wall, others=tuple(others), during=during or self.during, pieces=pieces or self.pieces,
            slabs=self.slabs if slabs is None else slabs, gains=dict(self.gains),
        )  # fmt: skip

    @property
    def blocks(self) -> int:
        """Matrix inequalities of its program."""
        return int(3 * (len(self.times[0]) - 1) * math.prod(self.slabs) * 2 ** len(self.slabs))


def refuse_large(attempts: Sequence[Attempt], states: int) -> None:
    """InfeasibleError where the program of an attempt would take minutes, in a single step of the solver."""
    for attempt in attempts:
        if attempt.blocks * ((states + 1) * (states + 2) / 2) ** 2 > _LARGEST:
            raise InfeasibleError(
                f"a bound takes a program of {attempt.blocks} matrix inequalities in {states} states, since the slopes "
                f"of the dynamics depend on {len(attempt.slabs)} of them; that is more than what is solved in a minute."
            )


class Option(NamedTuple):
    """A refinement of the attempt at a place: what of its logarithm it may gain, and the seconds that it may take."""

    place: int
    kind: int
    gain: float
    seconds: float

    def worth(self, parts: Array) -> float:
        """What it may take off the sum each second; ``parts`` are logarithms."""
        part = math.exp(parts[self.place] - parts.max())
        return -part * math.expm1(-self.gain) / self.seconds if self.place >= 0 else -1.0


NOTHING = Option(-1, 0, 0.0, math.inf)


def groups(walls: Sequence[Wall], *, together: bool) -> list[tuple[Wall, ...]]:
    """The walls, but sides of the working box as one at first: few are worth programs of their own."""
    sides = tuple(wall for wall in walls if wall.side is not None)
    alone = [(wall,) for wall in walls if wall.side is None]
    return alone + ([sides] if together and sides else apart(sides))


def apart(walls: Sequence[Wall]) -> list[tuple[Wall, ...]]:
    """Walls by themselves, but sides along which the model is affine as one at first, as they can be far."""
    far = tuple(wall for wall in walls if wall.far)
    alone = [(wall,) for wall in walls if not wall.far]
    return alone + ([far] if alone and far else [(wall,) for wall in far])


def paired(walls: Sequence[Wall]) -> list[tuple[Wall, ...]]:
    """`apart`, but opposite sides of the working box together."""
    found: dict[object, tuple[Wall, ...]] = {}
    for group in apart(walls):
        side = group[0].side
        key = group if side is None or len(group) > 1 else side[0]
        found[key] = found.get(key, ()) + group
    return list(found.values())


def total(attempts: Sequence[Attempt]) -> tuple[float, Array]:
    """log of the bound of P for the worst start, and what each attempt contributes to it (logarithms).

    The sum over the attempts at the worst corner, or of each one's own worst start.
    """
    worst = np.array([attempt.level for attempt in attempts])
    if not len(attempts):
        return -math.inf, worst
    best = log_sum(worst)
    if all(attempt.corners is not None for attempt in attempts):
        # as they are: cut off at their own suprema they would no longer be the corners of convex functions
        table = np.array([attempt.corners for attempt in attempts])
        rough = table.max(axis=0) + np.log(np.exp(table - table.max(axis=0)).sum(axis=0))
        level = max(log_sum(column) for column in table.T)
        if level < best:
            return level, table[:, int(np.argmax(rough))]
    return best, worst


def log_sum(levels: Sequence[float] | Array) -> float:
    """Upper bound of log sum exp, at most 0."""
    from flint import arb

    with precision():
        found = sum((arb(float(level)).exp() for level in levels), arb(0))
        return min(0.0, upper(found.log()))


def log10_up(level: float) -> float:
    """log10 of exp(level), rounded up, between -300 and 0."""
    value = max(level / math.log(10), _SMALLEST)
    return min(value + 1e-14 * abs(value) + 1e-15, 0.0)
