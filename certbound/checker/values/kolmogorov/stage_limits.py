"""What the problem asks of a path in a stage of time and at its end; windows are the problem's, never the file's.

A constraint holds in its window, a closed interval of time. A path has failed at the first time at which it breaks one
that holds, unless it has met the target by then; at the end of the target's window it fails unless it has.

- ``room``: from above the constraints whose windows meet the inside of the stage, from below those that hold in all of
  it.
- ``gate``: those that hold at its end; from above without those of the room.
- ``over``: cells in which a path is over without having failed. From above cells that lie in the target, where no
  constraint of the stage or of its end is touched; from below all that were not shown to keep off the target.

So from above too little is over and too much fails, from below the other way round, wherever the stages are cut.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from flint import arb

from certbound.checker.report import Budget, Unproved
from certbound.checker.statement import Constraint, Model, SafeSet
from certbound.checker.values.batches import Array, Mask
from certbound.checker.values.kolmogorov.cell_operator import about

Span = tuple[float, float]
Box = tuple[list[arb], list[arb]]


def end_of(model: Model) -> float:
    """When it is decided whether a path fails: at the horizon, or where the target's window ends."""
    during = None if model.target is None else model.target.during
    return model.horizon if during is None else min(during[1], model.horizon)


class StageLimits:
    """What is asked in one stage.

    Parameters
    ----------
    model : Model
    span : (float, float)
        Its times.
    axes : sequence of ndarray
        Nodes of its grid.
    budget : Budget
    above : bool
    """

    def __init__(self, model: Model, span: Span, axes: Sequence[Array], budget: Budget, *, above: bool) -> None:
        self.model, self.span, self.axes, self.budget, self.above = model, span, axes, budget, above
        kept = self._held(self._overlaps if above else self._covers)
        due = self._held(lambda window: window[0] <= span[1] <= window[1])
        self.kept, self.room = kept, self._set(kept)
        self.gate = self._set([c for c in due if not (above and any(c is one for one in kept))])
        self.opens = 0.0 if model.target is None or model.target.during is None else model.target.during[0]

    def _held(self, chosen: Callable[[Span], bool]) -> list[Constraint]:
        return [c for c in self.model.constraints if chosen(c.during or (0.0, self.model.horizon))]

    def _overlaps(self, window: Span) -> bool:
        return window[0] < self.span[1] and window[1] > self.span[0]

    def _covers(self, window: Span) -> bool:
        return window[0] <= self.span[0] and window[1] >= self.span[1]

    def _set(self, kept: Sequence[Constraint]) -> SafeSet:
        return SafeSet(replace(self.model, constraints=tuple(replace(c, during=None) for c in kept)), bounded=False)

    def at_begin(self) -> SafeSet:
        """The constraints that hold at its first moment, from above with those of all of the stage."""
        first = self._held(lambda window: window[0] <= self.span[0] <= window[1])
        more = [c for c in self.kept if not any(c is one for one in first)] if self.above else []
        return self._set([*first, *more])

    @property
    def begins_alike(self) -> bool:
        """Whether all constraints of its first moment are of the stage."""
        first = self._held(lambda window: window[0] <= self.span[0] <= window[1])
        return all(any(c is one for one in self.kept) for c in first)

    @cached_property
    def target(self) -> SafeSet | None:
        """The target, where there is one."""
        return None if self.model.target is None else self._set([self.model.target])

    @cached_property
    def over(self) -> Mask:
        """The cells in which a path is over."""
        counts = self.opens <= self.span[0] if self.above else self.opens < self.span[1]
        if self.target is None or not counts:
            return np.zeros([len(axis) - 1 for axis in self.axes], dtype=bool)
        if not self.above:
            return ~self.missed
        later = self._set(self._held(lambda window: window[0] <= self.span[1] and window[1] > self.span[0]))
        return self._on_cells(
            lambda *box: self._is_met(*box) and later.holds(*box, strictly=True), self._is_missed
        )

    @cached_property
    def missed(self) -> Mask:
        """Cells that keep off the target."""
        return self._on_cells(self._is_missed, self._is_met)

    @cached_property
    def met(self) -> Mask:
        """Cells that lie in the target."""
        return self._on_cells(self._is_met, self._is_missed)

    @cached_property
    def within(self) -> Mask:
        """Cells on which no constraint of the gate is broken or touched."""
        return self._on_cells(lambda *box: self.gate.holds(*box, strictly=True), self.gate.excludes)

    @cached_property
    def off(self) -> Mask:
        """Cells all of which break a constraint of the gate."""
        return self._on_cells(self.gate.excludes, lambda *box: self.gate.holds(*box, strictly=True))

    def _is_met(self, centre: Sequence[arb], radius: Sequence[arb]) -> bool:
        assert self.target is not None
        return self.target.holds(centre, radius)

    def _is_missed(self, centre: Sequence[arb], radius: Sequence[arb]) -> bool:
        assert self.target is not None
        return self.target.excludes(centre, radius)

    def _on_cells(self, holds: Callable[..., bool], fails: Callable[..., bool]) -> Mask:
        """Cells on which something holds."""

        def box(block: Sequence[tuple[int, int]]) -> list[tuple[arb, arb]]:
            return [(arb(float(axis[a])), arb(float(axis[b]))) for axis, (a, b) in zip(self.axes, block)]

        return marked([len(axis) - 1 for axis in self.axes], box, holds, fails, self.budget)


def marked(
    shape: Sequence[int], box: Callable[[Sequence[tuple[int, int]]], Sequence[tuple[arb, arb]]],
    holds: Callable[..., bool], fails: Callable[..., bool], budget: Budget,
) -> Mask:  # fmt: skip
    """Cells of a grid on which something holds: of a block of cells at once, where it does or fails on all of it.

    ``box`` gives the ends of what lies in a block.
    """
    budget.fits(math.prod(shape))
    found = np.zeros(shape, dtype=bool)
    blocks = [[(0, size) for size in shape]]
    while blocks:
        block = blocks.pop()
        budget.box()
        sides = about(box(block))
        if holds(*sides):
            found[tuple(slice(a, b) for a, b in block)] = True
            continue
        widest = max(range(len(block)), key=lambda k: block[k][1] - block[k][0])
        low, high = block[widest]
        if high - low > 1 and not fails(*sides):
            middle = (low + high) // 2
            blocks += [[*block[:widest], part, *block[widest + 1 :]] for part in ((low, middle), (middle, high))]
    return found


def common(axes: Sequence[Array], others: Sequence[Array]) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """The cells that two grids share, in each of them.

    Unproved where a node that lies in both grids is a node of one of them alone.
    """
    rows: list[list[slice]] = [[], []]
    for axis, other in zip(axes, others):
        low, high = max(axis[0], other[0]), min(axis[-1], other[-1])
        parts = [np.flatnonzero((line >= low) & (line <= high)) for line in (axis, other)]
        one, two = (line[part] for line, part in zip((axis, other), parts))
        if not np.array_equal(one, two):
            raise Unproved("the grids of two stages were not shown to have the nodes in common that lie in both")
        for part, row in zip(parts, rows):
            row.append(slice(int(part[0]), int(part[-1])) if len(part) else slice(0, 0))
    return tuple(rows[0]), tuple(rows[1])


def faces(n: int) -> list[tuple[int, int]]:
    """Axis and side of every face of a box."""
    return list(itertools.product(range(n), (0, 1)))
