"""Cells that choose themselves: the initial set is halved where the proof needs it, until every cell meets the target.

The probability of leaving from any start is at most the largest one over the cells that cover the starts, so that no
cell waits for another, and one that meets the target is done. A guess of the remainder, which costs little, says
whether a cell is worth a proof; where it is not, the cell is halved along the side that the deviations owe most to.
Where even its middle alone, as a start, is out of reach, no halving helps.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.parallel import side_by_side
from certbound.problem.problem import Problem
from certbound.reach.linear.hopes import meeting, promising, refined, run_of
from certbound.reach.linear.proved import LinearAnswer, SplitAnswer
from certbound.reach.linear.run import LinearRun
from certbound.reach.linear.shares import Share
from certbound.reach.nominal import Cells, initial_cells
from certbound.rigor.intervals import Interval
from certbound.watch import executor_lent, jobs_allowed, poll

_DEPTH = 4  # halvings of every side
_BATCH = 4  # cells that are proved side by side, should there be processes for it
_LOOK = 3  # halvings between two looks at the middle of a cell
_MOST_PIECES = 16_000  # pieces of time times cells that are looked at
_SPARE = 4_000  # cells times steps times squared states that may be spent on less than the target
_MORE = 2  # times the cells that the target took, at most
_ENOUGH = 10.2  # times its logarithm, beyond which less is worth nothing


@dataclass(frozen=True, eq=False, slots=True)
class _Leaf:
    """A box of starts (n,), and the halvings that made it: (side, whether it is the upper half)."""

    low: Array
    high: Array
    path: tuple[tuple[int, bool], ...] = ()

    @property
    def cells(self) -> Cells:
        """The box as the one cell of a linearisation."""
        centre = np.clip(0.5 * self.low + 0.5 * self.high, self.low, self.high)
        return Cells(centres=centre[None], boxes=Interval(self.low[None], self.high[None]))

    @property
    def middle(self) -> Cells:
        """Its middle alone."""
        centre = self.cells.centres
        return Cells(centres=centre, boxes=Interval.point(centre))

    def halves(self, side: int) -> tuple[_Leaf, _Leaf]:
        """Both halves along a side."""
        cut = 0.5 * self.low[side] + 0.5 * self.high[side]
        below, above = self.high.copy(), self.low.copy()
        below[side] = above[side] = cut
        return _Leaf(self.low, below, (*self.path, (side, False))), _Leaf(above, self.high, (*self.path, (side, True)))


_Proof = tuple[_Leaf, LinearAnswer]


def bisected(problem: Problem, whole: LinearRun, target: Share) -> SplitAnswer | None:
    """The proof cell by cell that every start meets the target; None where it is out of reach, or takes too many cells.

    ``whole`` is the run over the initial set as one cell, which did not meet it.
    """
    pieces = whole.engine.pieces if whole.engine.continuous else None
    boxes = initial_cells(problem).boxes
    root = _Leaf(np.array(boxes.lo[0]), np.array(boxes.hi[0]))
    wide = int(np.count_nonzero(root.low < root.high))
    if not wide or not _middle_promises(problem, root, pieces, target):
        return None
    heap: list[tuple[float, int, _Leaf, LinearRun]] = [(0.0, 0, root, whole)]
    done: list[_Proof] = []
    count = 1
    while heap:
        poll(f"cells of the initial set: {len(done)} done, {len(heap)} to do")
        worst = [heapq.heappop(heap) for _ in range(min(_BATCH, len(heap)))]
        for _, _, _, run in worst:
            run.learnt = done[-1][1].run.learnt if done else whole.learnt
            run.hoped = done[-1][1].shown.nonlinear if done else run.hoped
        found = _side_by_side([run for _, _, _, run in worst if run is not whole], target)
        for _, _, leaf, run in worst:
            proved = found.get(run)
            if proved is not None:
                done.append((leaf, proved))
                continue
            if len(leaf.path) >= _DEPTH * wide or (count + 2) * whole.engine.pieces > _MOST_PIECES:
                return None
            if leaf.path and len(leaf.path) % _LOOK == 0 and not _middle_promises(problem, leaf, pieces, target):
                return None
            for half in leaf.halves(_side(run)):
                count += 1
                other = run_of(problem, cells=half.cells, pieces=pieces)
                other.hoped = run.hoped
                heapq.heappush(heap, (-_urgency(other), count, half, other))
    if not whole.engine.continuous:  # elsewhere events are dear
        work = whole.engine.pieces * whole.engine.n**2
        done = _further(problem, done, pieces, target, min(_SPARE // work - count, _MORE * count))
    done.sort(key=lambda item: item[0].path)
    return SplitAnswer.of([(leaf.path, leaf.low, leaf.high, answer) for leaf, answer in done])


def _further(
    problem: Problem, done: list[_Proof], pieces: int | None, target: Share, spare: int
) -> list[_Proof]:
    """The cells with the worst ones halved, while ``spare`` cells may be looked at and that gives less than before."""
    while spare >= 2:
        leaf, answer = worst = max(done, key=lambda item: item[1].outcome.log_probability)
        level = answer.outcome.log_probability
        if level <= _ENOUGH * target.log:
            break
        poll(f"cells of the initial set: {len(done)} done, halving the worst")
        halves = [(half, run_of(problem, cells=half.cells, pieces=pieces)) for half in leaf.halves(_side(answer.run))]
        proofs = _side_by_side([run for _, run in halves], target)
        found = [(half, proofs[run]) for half, run in halves]
        better = [(half, part) for half, part in found if part is not None and part.outcome.log_probability < level]
        if len(better) < 2:
            break
        done = [item for item in done if item is not worst] + better
        spare -= 2
    return done


def _side_by_side(runs: list[LinearRun], target: Share) -> dict[LinearRun, LinearAnswer | None]:
    """What is proved of cells; each begins with what the proof of another one has learnt."""

    answers: dict[LinearRun, LinearAnswer | None] = {}
    tasks = [partial(_work, run, target) for run in runs]
    for run, (found, learnt, hoped) in zip(runs, side_by_side(tasks, jobs_allowed(), executor_lent())):
        run.learnt, run.hoped = learnt, hoped
        answers[run] = None if found is None else LinearAnswer(run=run, outcome=found[0], shown=found[1])
    return answers


def _work(run: LinearRun, target: Share) -> Any:
    """What is proved of a cell, without the run: outcome and what is shown, if it meets the target; what was learnt."""
    met = meeting(run, target)
    found = None if met is None else (refined(run, *met, target), met[0])
    return found, run.learnt, run.hoped


def _middle_promises(problem: Problem, leaf: _Leaf, pieces: int | None, target: Share) -> bool:
    return promising(run_of(problem, cells=leaf.middle, pieces=pieces), target)


def _shares(run: LinearRun) -> Array:
    """How much of the deviation along the inner rows each side of the cell makes: (pieces, rows, states)."""
    engine = run.engine
    moved = np.empty((engine.pieces, engine.n, engine.n))
    current = np.diag(engine.radii[0])
    for k in range(engine.pieces):
        moved[k] = current
        current = engine.response.transition[0, k] @ current
    return np.asarray(np.abs(np.nan_to_num(run.rows[0] @ moved)))


def _side(run: LinearRun) -> int:
    """The side to halve: that which the deviation along the inner rows owes most to, on average."""
    found = _shares(run)
    total = found.sum(axis=-1, keepdims=True)
    weights = np.where(total > 0, found / np.maximum(total, 1e-300), 0.0).sum(axis=(0, 1))
    wide = run.engine.radii[0] > 0
    return int(np.argmax(np.where(wide, weights + 1e-9, -1.0)))


def _urgency(run: LinearRun) -> float:
    """The widest deviation along the inner rows: what needs most halvings comes first, and fails first."""
    return float(_shares(run).sum(axis=-1).max(initial=0.0))
