"""Cells that choose themselves: the initial set is halved where the proof needs it, until every cell meets the target.

The probability of leaving from any start is at most the largest one over the cells that cover the starts, so that no
cell waits for another, and one that meets the target is done. A guess of the remainder, which costs little, says
whether a cell is worth a proof; where it is not, the cell is halved along the side that the deviations owe most to.
Where even its middle alone, as a start, is out of reach, no halving helps.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.parallel import Staff, result_of, staff
from certbound.problem.problem import Problem
from certbound.reach.linear.hopes import meeting, promising, refined, run_of
from certbound.reach.linear.linearisation import Linearisation
from certbound.reach.linear.proved import LinearAnswer, SplitAnswer
from certbound.reach.linear.run import LinearRun, Outcome
from certbound.reach.linear.shares import GUESSED, Share
from certbound.reach.nominal import Cells, initial_cells
from certbound.rigor.intervals import Interval
from certbound.watch import executor_lent, jobs_allowed, poll

_DEPTH = 4  # halvings of every side
_BEYOND = 2  # halvings more than make as many equal cells as may be looked at, after which a cell is hopeless
_LOOK = 3  # halvings between two looks at the middle of a cell
_MOST_PIECES = 16_000  # pieces of time times cells that are looked at
_SPARE = 4_000  # cells times steps times squared states that may be spent on less than the target
_FEW = 8  # cells for less than the target where the whole meets it
_MORE = 2  # times the cells that the target took, at most
CLEARLY = 1.25
"""How many times as large the logarithm must become where the whole meets the target and is halved for less."""
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
    def middle(self) -> _Leaf:
        """Its middle alone."""
        centre = self.cells.centres[0]
        return _Leaf(centre, centre)

    def halves(self, side: int) -> tuple[_Leaf, _Leaf]:
        """Both halves along a side."""
        cut = 0.5 * self.low[side] + 0.5 * self.high[side]
        below, above = self.high.copy(), self.low.copy()
        below[side] = above[side] = cut
        return _Leaf(self.low, below, (*self.path, (side, False))), _Leaf(above, self.high, (*self.path, (side, True)))


@dataclass(frozen=True, eq=False, slots=True)
class _Hint:
    """What a cell takes over from the one that was halved: the share that promised most, and what a proof needed."""

    hoped: Share | None = None
    learnt: tuple[Array, Array] | None = None


@dataclass(eq=False)
class _Seen:
    """What became of a cell; ``run`` stays in the process that looked at it."""

    run: LinearRun | None
    fit: Array | None
    hint: _Hint
    promising: bool
    found: tuple[Outcome, Outcome] | None = None  # the least outcome, and the one that is shown
    known: dict[str, Any] = field(default_factory=dict)  # what the answer is asked for in any case
    side: int = 0  # to halve, and how urgently
    urgency: float = 0.0
    hopeless: bool = False  # even its middle alone

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"run": None}

    @property
    def level(self) -> float:
        """Logarithm of what is proved."""
        return 0.0 if self.found is None else self.found[0].log_probability

    def answer(self, problem: Problem, leaf: _Leaf, pieces: int | None) -> LinearAnswer:
        """The proof, with its run."""
        assert self.found is not None
        run = self.run
        if run is None:
            plain = Linearisation(problem, cells=leaf.cells, pieces=pieces)
            run = LinearRun(plain if self.fit is None else plain.corrected(self.fit))
        return LinearAnswer(run=run, outcome=self.found[0], shown=self.found[1]).knowing(self.known)


_Proof = tuple[_Leaf, _Seen]


def _look(problem: Problem, pieces: int | None, target: Share, leaf: _Leaf, hint: _Hint, proving: bool) -> _Seen:
    """Whether a cell promises to meet the target, and the proof that it does if that is asked for."""
    run = run_of(problem, cells=leaf.cells, pieces=pieces)
    run.hoped, run.learnt = hint.hoped, hint.learnt
    met = meeting(run, target) if proving else None
    promise = met is not None if proving else promising(run, target)
    found = None if met is None else (refined(run, *met, target), met[0])
    seen = _Seen(
        run=run, fit=run.engine.correction, hint=_Hint(run.hoped, run.learnt), promising=promise, found=found,
    )  # fmt: skip
    if found is not None:
        seen.known = LinearAnswer(run=run, outcome=found[0], shown=found[1]).shown_values()
    if leaf.path:
        seen.side, seen.urgency = _side(run), _urgency(run)
    if leaf.path and not promise and len(leaf.path) % _LOOK == 0:
        seen.hopeless = not _look(problem, pieces, target, leaf.middle, _Hint(), False).promising
    return seen


class Bisection:
    """The proof cell by cell that every start meets the target, begun while the whole is still looked at.

    ``whole`` is the run over the initial set as one cell. Where others can work meanwhile they look at its middle, and
    from `begin` on, just before its first proof, at its halves; after the last proof `proved` does the rest. A cell
    takes over what those that it is a part of found out, so that the answer is the same whoever comes first.
    """

    def __init__(self, whole: LinearRun, target: Share) -> None:
        self.problem, self.whole, self.target = whole.engine.problem, whole, target
        self.pieces = whole.engine.pieces if whole.engine.continuous else None
        boxes = initial_cells(self.problem).boxes
        self.root = _Leaf(np.array(boxes.lo[0]), np.array(boxes.hi[0]))
        self.middle = self.root.middle
        self.wide = int(np.count_nonzero(self.root.low < self.root.high))
        equal = math.log2(max(_MOST_PIECES / whole.engine.pieces, 1.0))
        self.deepest = min(_DEPTH * self.wide, math.ceil(equal) + _BEYOND)
        self.open: dict[_Leaf, tuple[float, _Hint]] = {self.middle: (np.inf, _Hint())} if self.wide else {}
        self.done: list[_Proof] = []
        self.count = 1
        self.workers: Staff
        self.flying: dict[_Leaf, bool]

    @classmethod
    @contextlib.contextmanager
    def of(cls, whole: LinearRun, target: Share, *, met: bool = False) -> Iterator[Bisection]:
        """With as many processes as are allowed; what time ended goes on where it was. ``met``: for `finer` only."""
        found: Bisection = whole.halving or cls(whole, target)
        whole.halving = found
        asked = partial(_look, found.problem, found.pieces, target)
        with staff(asked, jobs_allowed(), executor_lent()) as found.workers:
            found.flying = {}
            if found.workers.apart and found.middle in found.open and not met:
                found._ask(found.middle)
            yield found

    def begin(self, *, look: bool = True) -> None:
        """Let others, if there are any, look at the halves."""
        if self.wide and self.count == 1:
            halves = self.root.halves(_side(self.whole))
            self.open |= dict.fromkeys(halves, (0.0, _Hint(self.whole.hoped)))
            self.count += len(halves)
            for leaf in halves if look and self.workers.apart else ():
                self._ask(leaf, hands=self.workers.width - 1)

    def proved(self) -> SplitAnswer | None:
        """All cells; None where the target is out of reach, or takes too many of them."""
        self.begin(look=False)
        if not self.wide:
            return None
        while self.open:
            poll(f"cells of the initial set: {len(self.done)} done, {len(self.open)} to do")
            while len(self.flying) < min(self.workers.width, len(self.open)):
                waiting = (leaf for leaf in self.open if leaf not in self.flying)
                self._ask(most := max(waiting, key=self._first), proving=most is not self.middle)
            for leaf, seen, looked in self._finished():
                if looked and leaf is not self.middle and (seen.promising or self._lost):
                    continue
                del self.open[leaf]
                if seen.found is not None:
                    self.done.append((leaf, seen))
                elif leaf is not self.middle:
                    if seen.hopeless or len(leaf.path) >= self.deepest:
                        return None
                    self.open |= dict.fromkeys(leaf.halves(seen.side), (seen.urgency, seen.hint))
                    self.count += 2
                elif not seen.promising:
                    return None
            if self.count * self.whole.engine.pieces > _MOST_PIECES:
                return None
        done = self._further(self.done, min(self._spare - self.count, _MORE * self.count))
        return self._answer(done)

    def finer(self, found: LinearAnswer) -> SplitAnswer | None:
        """The proof that meets the target for the whole, with the worst cells halved; None where that gives no less."""
        seen = _Seen(
            run=self.whole, fit=self.whole.engine.correction, hint=_Hint(self.whole.hoped, self.whole.learnt),
            promising=True, found=(found.outcome, found.shown), side=_side(self.whole),
        )  # fmt: skip
        spare = min(self._spare - 1, _FEW) if self.wide else 0
        done = self._further([(self.root, seen)], spare, CLEARLY)
        return self._answer(done) if len(done) > 1 else None

    @property
    def _spare(self) -> int:
        """Cells that may be looked at for less than the target: none where events are dear."""
        engine = self.whole.engine
        return 0 if engine.continuous else _SPARE // (engine.pieces * engine.n**2)

    def _answer(self, done: list[_Proof]) -> SplitAnswer:
        done = sorted(done, key=lambda item: item[0].path)
        return SplitAnswer.of([
            (leaf.path, leaf.low, leaf.high, seen.answer(self.problem, leaf, self.pieces)) for leaf, seen in done
        ])

    def _further(self, done: list[_Proof], spare: int, gain: float = 1.0) -> list[_Proof]:
        """The cells with the worst ones halved, while ``spare`` cells may be looked at and logarithms ``gain``."""
        while spare >= 2:
            leaf, seen = worst = max(done, key=lambda item: item[1].level)
            if seen.level <= _ENOUGH * self.target.log:
                break
            poll(f"cells of the initial set: {len(done)} done, halving the worst")
            for half in leaf.halves(seen.side):
                self._ask(half, proving=True)
            halves: list[_Proof] = []
            while self.flying:
                poll()
                halves += [(half, seen) for half, seen, _ in self._finished()]
            if max(half.level for _, half in halves) >= gain * seen.level:
                break
            done = [item for item in done if item is not worst] + halves
            spare -= 2
        return done

    def _first(self, leaf: _Leaf) -> tuple[float, int]:
        """What needs most halvings comes first, of that what has most: it fails first."""
        return self.open[leaf][0], len(leaf.path)

    @property
    def _lost(self) -> bool:
        """Whether the whole's remainder could not be enclosed: its halves begin with the share that asks for least."""
        return bool(np.isfinite(self.whole.lost))

    def _ask(self, leaf: _Leaf, proving: bool = False, hands: int | None = None) -> None:
        hint = self.open[leaf][1] if leaf in self.open else _Hint()
        if proving and leaf in self.open:
            hoped = self.target.part(GUESSED[-1][0]) if self._lost and len(leaf.path) == 1 else hint.hoped
            hint = _Hint(hoped, self.whole.learnt if hint.learnt is None else hint.learnt)
        self.flying[leaf] = proving
        self.workers.begin(leaf, leaf, hint, proving, hands=hands)

    def _finished(self) -> Iterator[tuple[_Leaf, _Seen, bool]]:
        """Cells, what became of them, and whether they were looked at only."""
        for leaf, answer in self.workers.finished():
            yield leaf, result_of(answer), not self.flying.pop(leaf)


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
