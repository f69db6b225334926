"""Constraints that come and go in continuous time: V is stated for stages of time that follow each other.

In a stage V is what `passage` and `crossing` ask, of the constraints that hold then: from above of all whose windows
overlap it, from below of those whose windows cover it. At its end a path is at the gate: the set of all constraints
whose windows hold that instant. V may jump there.

From above, V >= min(V_next, 0) on parts of the grid that lie in the gate and in the next grid, and V >= 0 on all
others; at the last end nothing is asked of parts in the gate. So exp(theta(V)), stopped at 1, never jumps upward. The
least exp(V) where a path is over that did not fail counts over all stages: on sides beyond the domain, too.

From below, V <= V_next on parts in the next grid that were not shown to be off the gate; where these lie outside of the
next grid, and at the last end, exp(V) <= W. A path on any other part has failed, and V <= 0.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from flint import arb

from certbound.checker.reading import Record, entries
from certbound.checker.report import Budget, Unproved
from certbound.checker.statement import Constraint, Model, SafeSet
from certbound.checker.values import batches as tm
from certbound.checker.values.batches import Array
from certbound.checker.values.crossing import Crossing
from certbound.checker.values.passage import Passage
from certbound.errors import CertificateError

MOST_STAGES = 50
_OWN = ("axes", "times", "values", "rates", "lam", "eps")
_HALVINGS = 40  # of a part of a line across which a gate ends
_FEW = 64
_CHUNK = 4096
"""Parts of a gate that are looked at together."""
_PART_BYTES = 1_500
"""Memory of a part of a gate and its box of balls."""

Box = tuple[list[arb], list[arb]]
Span = tuple[float, float]


def check_stages(model: Model, value: Mapping[str, object], budget: Budget, *, upper: bool) -> arb:
    """Upper or lower bound of the probability that a constraint is broken while it holds."""
    shared = {name: part for name, part in value.items() if name != "stages"}
    if any(name in shared for name in _OWN):
        raise CertificateError("`proof` must state what belongs to a stage in its stages.")
    items = entries(value["stages"], "proof.stages", 1, MOST_STAGES)
    own = [Record(item, f"proof.stages[{k}]", _OWN) for k, item in enumerate(items)]
    windows = [_window(model, constraint.during) for constraint in model.constraints]
    if any(end <= 0 for _, end in windows):
        raise Unproved("value functions do not treat constraints at time 0 alone")
    spans = [_span(one) for one in own]
    if spans[0][0] != 0 or spans[-1][1] != max((end for _, end in windows), default=model.horizon):
        raise Unproved("the stages do not cover the windows")
    if any(first[1] != second[0] for first, second in itertools.pairwise(spans)):
        raise Unproved("the stages do not follow each other")
    given = [({**shared, **one.value}, budget, span) for one, span in zip(own, spans)]
    if upper:
        above = [_StageAbove(model, *row) for row in given]
        for stage, after in zip(reversed(above), [None, *reversed(above[1:])]):
            stage.join(after)
        return above[0].followed(above)
    below = [_StageBelow(model, *row) for row in given]
    for one, then in zip(reversed(below), [None, *reversed(below[1:])]):
        one.join(then)
    return below[0].crossed(below)


def _span(record: Record) -> Span:
    times = record.array("times", None)
    if len(times) < 2:
        raise CertificateError(f"`{record.at('times')}` must be two or more numbers that rise.")
    return times[0], times[-1]


def _window(model: Model, during: Span | None) -> Span:
    first, last = during or (0.0, model.horizon)
    return first, min(last, model.horizon)


class _Joint:
    """The end of a stage: parts of its grid, V on them, and what is known of them."""

    def __init__(self, stage: Passage, gate: SafeSet, after: Passage | None) -> None:
        axes = stage.surface.axes
        edges = [axis if after is None else _merged(axis, after.surface.axes[i]) for i, axis in enumerate(axes)]
        if len(edges) == 1:
            edges = [_cut(edges[0], gate)]
        many = math.prod(len(row) - 1 for row in edges)
        stage.budget.take(many * _PART_BYTES)
        rows = [np.meshgrid(*ends, indexing="ij") for ends in ([e[:-1] for e in edges], [e[1:] for e in edges])]
        self.low, self.high = (np.stack([part.ravel() for part in row]) for row in rows)
        boxes = [_box(low, high) for low, high in zip(self.low.T, self.high.T)]
        for _ in boxes:
            stage.budget.box()
        self.within = np.array([gate.holds(*box) for box in boxes])
        self.off = np.array([gate.excludes(*box) for box in boxes])
        self.least, self.most = np.empty(len(boxes)), np.empty(len(boxes))
        self.goes_on = np.zeros(len(boxes), dtype=bool)
        self.gap = np.full((2, len(boxes)), np.nan)
        if after is not None:
            ends = [(axis[0], axis[-1]) for axis in after.surface.axes]
            self.goes_on = np.all([(low >= a) & (high <= b) for (a, b), low, high in zip(ends, self.low, self.high)], 0)
        for first in range(0, len(boxes), _CHUNK):
            self._look(stage, after, np.arange(first, min(first + _CHUNK, len(boxes))))

    def _look(self, stage: Passage, after: Passage | None, parts: tm.Index) -> None:
        """V on some of the parts, and what is between it and V of the next stage."""
        here = self._over(stage, -1, parts)
        least, most = here.sharp_ends()
        self.least[parts] = np.where(np.isnan(least), -np.inf, least)
        self.most[parts] = np.where(np.isnan(most), np.inf, most)
        on = np.flatnonzero(self.goes_on[parts])
        if after is not None and len(on):
            found = tm.sub(self._over(after, 0, parts[on]), here.take(on)).sharp_ends()
            gap = np.array(found) + after.lift
            gap += np.array([[-1.0], [1.0]]) * 2.0**-50 * (np.abs(gap) + abs(after.lift))
            self.gap[:, parts[on]] = gap

    def _over(self, stage: Passage, index: int, parts: tm.Index) -> tm.Batch:
        """V of a stage on some parts, at one of its ends."""
        low, high = self.low[:, parts], self.high[:, parts]
        places = [np.searchsorted(axis, row, side="right") - 1 for axis, row in zip(stage.surface.axes, low)]
        return stage.part_of(stage.surface.chosen(index, places), list(low), list(high))


class _StageAbove(Passage):
    """A stage from above."""

    def __init__(self, model: Model, value: object, budget: Budget, span: Span) -> None:
        self.span = span
        kept = [c for c in model.constraints if _overlaps(_window(model, c.during), span)]
        self.gate = _at(model, span[1])
        super().__init__(_still(model, kept), value, budget)

    def _first(self) -> float:
        return self.span[0]

    def _last(self) -> float:
        return self.span[1]

    def join(self, after: Passage | None) -> None:
        """Lift V over what it lacks on the sides and at the gate, the next stage being lifted already."""
        self._check_box()
        joint = _Joint(self, self.gate, after)
        need = -joint.least
        if after is None:
            need = np.where(joint.within, -np.inf, need)
        else:
            passing = joint.within & joint.goes_on & np.isfinite(joint.gap[1])
            need = np.where(passing, np.minimum(joint.gap[1], need), need)
        self.lift = float(np.nextafter(max(self._missing(), float(need.max())), np.inf))


class _StageBelow(Crossing):
    """A stage from below."""

    def __init__(self, model: Model, value: object, budget: Budget, span: Span) -> None:
        self.span = span
        kept = [c for c in model.constraints if _covers(_window(model, c.during), span)]
        self.gate = _at(model, span[1])
        self.last = -np.inf
        super().__init__(_still(model, kept), value, budget)

    def _first(self) -> float:
        return self.span[0]

    def _last(self) -> float:
        return self.span[1]

    def join(self, after: Passage | None) -> None:
        """Lower V under what it exceeds, at the gate too, the next stage being lowered already."""
        joint = _Joint(self, self.gate, after)
        passing = joint.goes_on & ~joint.off
        gap = np.where(np.isnan(joint.gap[0]), -np.inf, joint.gap[0])
        self.lowered(max(self._highest(), float(np.where(passing, -gap, -np.inf).max())))
        ends = np.where(joint.off | passing, -np.inf, joint.most)
        self.last = float(np.nextafter(ends.max() + self.lift, np.inf))

    def _at_end(self) -> float:
        return self.last


def _overlaps(window: Span, span: Span) -> bool:
    return window[0] < span[1] and window[1] > span[0]


def _covers(window: Span, span: Span) -> bool:
    return window[0] <= span[0] and window[1] >= span[1]


def _at(model: Model, time: float) -> SafeSet:
    """What holds at an instant."""
    kept = [c for c in model.constraints if _window(model, c.during)[0] <= time <= _window(model, c.during)[1]]
    return SafeSet(_still(model, kept), bounded=False)


def _still(model: Model, kept: Sequence[Constraint]) -> Model:
    """The model with these constraints only, without their windows."""
    return replace(model, constraints=tuple(replace(c, during=None) for c in kept))


def _merged(axis: Array, other: Array) -> Array:
    return np.union1d(axis, other[(other > axis[0]) & (other < axis[-1])])


def _cut(edges: Array, gate: SafeSet) -> Array:
    """The edges, with more of them where a gate ends between two."""
    found, due = list(edges), list(itertools.pairwise(edges.tolist()))
    for _ in range(_HALVINGS):
        boxes = [(pair, _box(*np.array(pair)[:, None])) for pair in due]
        due = [pair for pair, box in boxes if not gate.holds(*box) and not gate.excludes(*box)]
        halves = [(a, (a + b) / 2, b) for a, b in due if a < (a + b) / 2 < b]
        if len(halves) > _FEW:
            break
        found += [middle for _, middle, _ in halves]
        due = [pair for a, middle, b in halves for pair in ((a, middle), (middle, b))]
    return np.unique(found)


def _box(low: Array, high: Array) -> Box:
    """Centre and radius."""
    ends = [(arb(float(a)), arb(float(b))) for a, b in zip(low, high)]
    return [(a + b) / 2 for a, b in ends], [(b - a) / 2 for a, b in ends]
