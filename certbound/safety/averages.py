"""Constants that are drawn once: a verdict on every cell of their values, and the average of the bounds.

P(failure) <= P(a constant lies in no cell) + sum over cells of P(it lies there) times the bound that holds for every
value of the cell. The cell that weighs most is halved until delta is met. From below the same holds of values that
have a probability of their own, where nobody chooses: the worst start of one value is not that of another, and a
disturbance does not know which was drawn. Where there is a choice one cell alone counts.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from flint import arb

from certbound.arrays import Array
from certbound.checks import assign
from certbound.problem.problem import Problem
from certbound.problem.sets import Box
from certbound.safety.answers import is_at_most, is_more_than, settled
from certbound.safety.verdict import Verdict
from certbound.watch import OutOfTime, Watch

_MOST = 40  # cells that are asked
_SHARE, _SECONDS = 0.15, 10.0  # of the time that is left, for one of them, and the most
_FAIR = 0.5  # of delta, in proportion to the weights; the rest in equal parts to so many cells
_PARTS = 20
_NEAR = (-3.0, -1.5, 0.0, 1.5, 3.0)  # in units of the scale
_GAIN, _HALF = 0.9, 0.5  # of the bound of the cell that it was cut from, where that says something
_LARGEST = 0.3  # delta of a cell, where the whole problem's is not larger
_ENOUGH = 0.02  # of delta: cells whose values are rarer in sum are not asked
_UP, _DOWN, _TINY = 1 + 1e-12, 1 - 1e-12, 1e-300


def bounds_of(problem: Problem) -> Box:
    """The box of the disturbances, which a problem with drawn constants has."""
    box = problem.system.disturbance
    assert box is not None
    return box


@dataclass(frozen=True, eq=False, kw_only=True)
class Cell:
    """Values of the drawn constants between ``low`` and ``high``, shape (q,), and the verdict that holds for all.

    Without a verdict nothing is known: such values count as failing. ``asked`` is False of a verdict that was found for
    more values than these.
    """

    problem: Problem
    low: Array
    high: Array
    verdict: Verdict | None = None
    asked: bool = False
    gained: bool = True  # whether its bound is better than that of the cell it was cut from

    @cached_property
    def weights(self) -> tuple[float, float]:
        """Bounds of the probability that all constants lie here."""
        least = most = 1.0
        for law, low, high in zip(self.problem.random.values(), self.low.tolist(), self.high.tolist()):
            own = law.probability(low, high)
            least, most = least * own[0] * _DOWN, most * own[1] * _UP
        return least, min(most, 1.0)

    @property
    def weight(self) -> arb:
        """The probability that all constants lie here, as a ball."""
        found = arb(1)
        for law, low, high in zip(self.problem.random.values(), self.low.tolist(), self.high.tolist()):
            found *= law.weight(low, high)
        return found

    @property
    def plain(self) -> Problem:
        """The problem with these values as unknown constants; as plain constants where each is one number."""
        system, names = self.problem.system, list(self.problem.random)
        box = bounds_of(self.problem)
        low, high = np.array(box.low), np.array(box.high)
        places = [system.disturbance_names.index(name) for name in names]
        low[places], high[places] = self.low, self.high
        moving = [name for name, a, b in zip(names, self.low, self.high) if a < b]
        cut = copy.copy(system)
        assign(cut, disturbance=Box(low, high))
        share = _FAIR + (1 - _FAIR) / (_PARTS * max(self.weights[1], _TINY))
        delta = min(self.problem.delta * share, max(self.problem.delta, _LARGEST))
        fixed = (*self.problem.unknown, *moving)
        return self.problem.replace(system=cut, random=None, unknown=fixed, delta=delta)

    @property
    def most(self) -> float:
        """What this cell adds to the probability of failing, at most."""
        known = 1.0 if self.verdict is None else min(max(10.0**self.verdict.log10_delta * _UP, _TINY), 1.0)
        return self.weights[1] * known * _UP

    @property
    def least(self) -> float:
        """What it adds at least: only where it is one value."""
        alone = self.asked and not np.any(self.low < self.high)
        known = self.verdict.log10_lower if alone and self.verdict is not None else None
        return 0.0 if known is None else self.weights[0] * 10.0**known * _DOWN

    def halves(self) -> list[Cell]:
        """The cell cut in the middle of its side that is longest beside the whole box, each half as small as can be."""
        whole = Cell.of(self.problem)
        sides = (self.high - self.low) / np.where(whole.high > whole.low, whole.high - whole.low, 1.0)
        axis = int(np.argmax(sides))
        return self.cut(axis, [float(self.low[axis] + (self.high[axis] - self.low[axis]) / 2)])

    def cut(self, axis: int, places: Sequence[float]) -> list[Cell]:
        """The cell in parts along an axis; where nothing can be drawn there is none."""
        law, found = list(self.problem.random.values())[axis], []
        ends = [float(self.low[axis]), *places, float(self.high[axis])]
        for first, last in pairwise(ends):
            low, high = self.low.copy(), self.high.copy()
            low[axis], high[axis] = law.hull(first, last)
            if law.probability(first, last)[1] > 0:
                found.append(replace(self, low=low, high=high, asked=False))
        return found

    @classmethod
    def of(cls, problem: Problem) -> Cell:
        """All values of the disturbances' box."""
        names, box = problem.system.disturbance_names, bounds_of(problem)
        places = [names.index(name) for name in problem.random]
        ends = [law.hull(float(box.low[k]), float(box.high[k])) for k, law in zip(places, problem.random.values())]
        low, high = np.array(ends).T
        return cls(problem=problem, low=low, high=high)


def average_verdict(problem: Problem, watch: Watch, decided: Callable[[Problem], Verdict]) -> Verdict:
    """The verdict on a problem with drawn constants: the average over cells of their values, as ``members``.

    Laws without ends are cut near their middle first; otherwise the whole box comes first, as a bound for every value
    of it is one for the average. Each cell has a share of the time that is left.
    """
    cells = _first(problem)
    try:
        with watch.running():
            for place, cell in enumerate(cells):
                cells[place] = _asked(cell, watch, decided)
            for _ in range(_MOST):
                if _settled(problem, cells):
                    break
                cells = _refined(cells, watch, decided)
    except OutOfTime:
        pass
    return _verdict(problem, cells)


def _first(problem: Problem) -> list[Cell]:
    """The whole box, cut where laws without ends begin to be rare."""
    cells = [Cell.of(problem)]
    for axis, law in enumerate(problem.random.values()):
        if law.law.bound is None:
            scale = float(law.law.factor[0, 0])
            places = [law.mean + far * scale for far in _NEAR]
            cells = [
                part for cell in cells
                for part in cell.cut(axis, [place for place in places if cell.low[axis] < place < cell.high[axis]])
            ]  # fmt: skip
    return sorted(cells, key=lambda cell: -cell.weights[1])


def _asked(cell: Cell, watch: Watch, decided: Callable[[Problem], Verdict]) -> Cell:
    if cell.weights[1] < _ENOUGH * cell.problem.delta / _MOST:
        return cell
    watch.log10_delta, watch.log10_lower = 0.0, None  # what is told is about this cell
    with watch.share(_SHARE, _SECONDS):
        found = decided(cell.plain)
    before = 0.0 if cell.verdict is None else cell.verdict.log10_delta
    gained = before > math.log10(_HALF) or found.log10_delta < before + math.log10(_GAIN)
    if found.log10_delta > before:
        found = replace(found, log10_delta=before)
    return replace(cell, verdict=found, asked=True, gained=gained)


def _refined(cells: Sequence[Cell], watch: Watch, decided: Callable[[Problem], Verdict]) -> list[Cell]:
    """The cells with the one that weighs most in halves, which are asked where they can matter."""
    worst = max(filter(_open, cells), key=lambda cell: cell.most)
    rest = [cell for cell in cells if cell is not worst]
    halves = [_asked(half, watch, decided) for half in worst.halves()]
    gained = any(half.gained for half in halves)  # the worst value of all may lie in one of them
    return [*rest, *(replace(half, gained=gained) for half in halves)]


def _ends(problem: Problem, cells: Sequence[Cell]) -> tuple[float, float]:
    """Bounds of the probability of failing from below and above."""
    most = math.fsum([_outside(problem), *(cell.most for cell in cells)]) * _UP
    chosen = not (problem.fixed_start or problem.initial.random) or bounds_of(problem).dimension > len(problem.random)
    least = (max if chosen else math.fsum)([cell.least for cell in cells])
    return least * _DOWN, min(most, 1.0)


def _outside(problem: Problem) -> float:
    """What is drawn outside of the disturbances' box, which no cell holds."""
    names, box = problem.system.disturbance_names, bounds_of(problem)
    ends = [(law, names.index(name)) for name, law in problem.random.items()]
    return math.fsum(law.outside(float(box.low[k]), float(box.high[k])) for law, k in ends) * _UP


def _settled(problem: Problem, cells: Sequence[Cell]) -> bool:
    """Whether the bounds decide, or no cell can be cut any more."""
    least, most = _ends(problem, cells)
    decided = most <= problem.delta * _DOWN or least > problem.delta * _UP
    return decided or not any(map(_open, cells))


def _open(cell: Cell) -> bool:
    """Whether halves of a cell may be better than the whole."""
    return cell.gained and bool(np.any(cell.low < cell.high))


def _verdict(problem: Problem, cells: Sequence[Cell]) -> Verdict:
    """The average, with what is known of the cell that weighs most."""
    least, most = _ends(problem, cells)
    level = math.log10(most) if most < 1 else 0.0
    if len(cells) == 1 and cells[0].verdict is not None and _outside(problem) == 0:
        level = cells[0].verdict.log10_delta
    level = settled(level, problem.delta)
    lower = math.log10(least) if least > 0 else None
    safe = is_at_most(level, problem.delta)
    unsafe = lower is not None and is_more_than(lower, problem.delta)
    known = [cell for cell in cells if cell.verdict is not None]
    if not known:
        raise OutOfTime
    worst = max(known, key=lambda cell: cell.most)
    assert worst.verdict is not None
    names = ", ".join(problem.random)
    reason = (
        f"averaged over {len(cells)} cells of what is drawn ({names}); most of it, {worst.most:.3g}, comes from "
        f"{_place(worst)}: {worst.verdict.reason}"
    )
    return replace(
        worst.verdict, problem=problem, status="SAFE" if safe else "UNSAFE" if unsafe else "UNKNOWN",
        log10_delta=level, log10_lower=lower, reason=reason, margin=None, time=None, constraint=None, tube=None,
        reach=None, constants=None, deviation=None, members=(), cells=tuple(cells),
    )  # fmt: skip


def _place(cell: Cell) -> str:
    ends = zip(cell.problem.random, cell.low.tolist(), cell.high.tolist())
    return ", ".join(f"{name} = {a:.4g}" if a == b else f"{name} in [{a:.4g}, {b:.4g}]" for name, a, b in ends)
