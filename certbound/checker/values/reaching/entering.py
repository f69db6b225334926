"""Targets in continuous time: a path is over once it has met the target; later it cannot fail.

*One state*: V is about log of the probability of arriving. On an interval of the grid that lies in the safe set, and
one of whose sides lies in the target, the proof from below (`crossing`) bounds the probability of leaving by that side
within the target's window, from every start: these paths have arrived. On an interval that keeps off the target, and
whose starts are some of the initial set, the proof from above (`passage`) bounds that of leaving by a side that does
not break a constraint: no other path arrives, as paths are continuous. With P the probability of arriving, 1 - P is
that of failing.

*Two states*: V is about log of the probability of failing. Above, cells of the grid that lie in the target are over;
their union is a part of the target, so that to miss it is no less probable. V >= 0 on the other cells at the end of the
window and on the sides of the grid, the residual inequality holds on them, and exp(V) >= w where they meet those that
are over. Below, all cells are over that are not shown to keep off the target: their union holds it. V <= 0 on the
others, and exp(V) <= W where they meet those that are over.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
from flint import arb

from certbound.checker.report import Budget, Unproved
from certbound.checker.statement import Model, SafeSet, starts_of
from certbound.checker.values.batches import Array, Mask, above, below
from certbound.checker.values.crossing import Crossing
from certbound.checker.values.passage import Passage
from certbound.checker.values.step_back import target_of

Side = tuple[int, int]


def bound_failing_above(model: Model, value: object, budget: Budget) -> arb:
    """Upper bound of the probability of failing where there is a target."""
    if model.dimension > 1:
        return _FailingAbove(model, value, budget).upper()
    return arb.min((1 - _ArrivingBelow(model, value, budget).lower()).upper(), arb(1))


def bound_failing_below(model: Model, value: object, budget: Budget) -> arb:
    """Lower bound of the probability of failing from some start where there is a target."""
    if model.dimension > 1:
        return _FailingBelow(model, value, budget).lower()
    return arb.max((1 - _ArrivingAbove(model, value, budget).upper()).lower(), arb(0))


def _window(model: Model) -> float:
    """The end of the target's window."""
    target = model.target
    assert target is not None
    first, last = target.during or (0.0, model.horizon)
    if first != 0 or model.stays:
        raise Unproved("value functions in continuous time are proved for targets that count from the beginning")
    if model.initial.covariance is not None:
        raise Unproved("value functions are proved for targets from a set of starts only")
    return last


def _target(model: Model) -> SafeSet:
    """What decides where the target is."""
    return SafeSet(replace(model, constraints=(target_of(model),)), bounded=False)


def _box(proof: Passage, side: Side | None = None) -> tuple[list[arb], list[arb]]:
    """Centre and radius of the grid, or of one of its sides."""
    ends = [(arb(float(axis[0])), arb(float(axis[-1]))) for axis in proof.surface.axes]
    if side is not None:
        ends[side[0]] = (ends[side[0]][side[1]],) * 2
    return [(a + b) / 2 for a, b in ends], [(b - a) / 2 for a, b in ends]


class _ArrivingBelow(Crossing):
    """The probability of arriving from below, from the worst start."""

    def _named(self) -> list[str]:
        return []

    def _last(self) -> float:
        return _window(self.model)

    def _level(self) -> float:
        """At most V(0, .) on the initial set."""
        self._check_box()
        if self.model.disturbance:
            raise Unproved("a target of one state is not proved to be met under disturbances")
        initial = self.model.initial
        low, _ = self._over([below(x) for x in initial.low], [above(x) for x in initial.high])
        return float(np.nextafter(low.min() + self.lift, -np.inf))

    def _harmless_sides(self) -> list[Side]:
        """Those that do not lie in the target, or touch an obstacle: who meets both at once has failed."""
        sides, target, limits = [(0, 0), (0, 1)], _target(self.model), self.limits()
        boxes = {side: _box(self, side) for side in sides}
        return [s for s, box in boxes.items() if not (target.holds(*box) and limits.holds(*box, strictly=True))]


class _ArrivingAbove(Passage):
    """The probability of arriving from above, from the best of the stated starts."""

    def _named(self) -> list[str]:
        return ["side", "starts"]

    def _last(self) -> float:
        return _window(self.model)

    def _check_box(self) -> None:
        if not _target(self.model).excludes(*_box(self)):
            raise Unproved("the grid was not shown to keep off the target")

    def _spared(self) -> list[Side]:
        """The sides that break a constraint: by these no path arrives."""
        return self.excluded(SafeSet(self.model, bounded=False))

    def _at_start(self) -> float:
        sides, found = [(arb(float(axis[0])), arb(float(axis[-1]))) for axis in self.surface.axes], np.inf
        for point in starts_of(self.model, self.record):
            if not all(a < x < b for (a, b), x in zip(sides, point)):
                raise Unproved("a start was not shown to lie in the grid")
            _, high = self._over([below(x) for x in point], [above(x) for x in point])
            found = min(found, float(high.max()))
        return float(np.nextafter(found + self.lift, np.inf))


class _Cells:
    """Which cells are over, and V where the others meet them."""

    def __init__(self, proof: Passage, *, upper: bool) -> None:
        target, axes = _target(proof.model), proof.surface.axes
        self.proof, self.over = proof, np.zeros(proof.surface.cells, dtype=bool)
        for place in itertools.product(*(range(count) for count in self.over.shape)):
            proof.budget.box()
            ends = [(arb(float(axis[k])), arb(float(axis[k + 1]))) for axis, k in zip(axes, place)]
            box = [(a + b) / 2 for a, b in ends], [(b - a) / 2 for a, b in ends]
            self.over[place] = target.holds(*box) if upper else not target.excludes(*box)
        if not self.over.any() or self.over.all():
            raise Unproved("the target was not shown to be a part of the grid")

    def around(self) -> tuple[float, float]:
        """Ends of V, before it is lifted, where a path may enter the cells that are over."""
        least, most = np.inf, -np.inf
        for axis in range(self.over.ndim):
            rows = np.moveaxis(self.over, axis, 0)
            for node in range(1, len(rows)):
                entered = rows[node - 1] != rows[node]
                if entered.any():
                    low, high = (part.reshape(-1, entered.size)[:, entered.ravel()]
                                 for part in self.proof.across(axis, node))  # fmt: skip
                    least, most = min(least, float(low.min())), max(most, float(high.max()))
        return least, most

    def beside(self, axis: int, end: int) -> Mask:
        """The cells of a side of the grid that are not over."""
        return np.asarray(~np.take(self.over, -end, axis=axis)).ravel()


class _FailingAbove(Passage):
    """The probability of failing from above: V is at least 0 where a path fails, and w where it meets the target."""

    def __init__(self, model: Model, value: object, budget: Budget) -> None:
        super().__init__(model, value, budget)
        self.ended = _Cells(self, upper=True)
        self.due = ~self.ended.over

    def _last(self) -> float:
        return _window(self.model)

    def _missing(self) -> float:
        least = float(_known(self.last_ends()[0][~self.ended.over]).min())
        for axis, end in itertools.product(range(self.model.dimension), (0, 1)):
            beside = self.ended.beside(axis, end)
            if beside.any():
                least = min(least, float(self.across(axis, -end)[0].reshape(-1, beside.size)[:, beside].min()))
        return -min(least, 0.0)

    def _at_end(self) -> float:
        return float(np.nextafter(self.ended.around()[0] + self.lift, -np.inf))


class _FailingBelow(Crossing):
    """The probability of failing from below: V is at most 0 everywhere, and W where a path meets the target."""

    def __init__(self, model: Model, value: object, budget: Budget) -> None:
        super().__init__(model, value, budget)
        self.ended = _Cells(self, upper=False)
        self.due = ~self.ended.over

    def _last(self) -> float:
        return _window(self.model)

    def _level(self) -> float:
        for point in starts_of(self.model, self.record):
            for place in np.argwhere(self.ended.over):
                ends = [(axis[k], axis[k + 1]) for axis, k in zip(self.surface.axes, place)]
                if not any(x < float(low) or x > float(high) for x, (low, high) in zip(point, ends)):
                    raise Unproved("a start was not shown to keep off the target")
        return super()._level()

    def _at_end(self) -> float:
        return float(np.nextafter(self.ended.around()[1] + self.lift, np.inf))


def _known(low: Array) -> Array:
    """Lower ends, -inf where one is no number."""
    return np.where(np.isnan(low), -np.inf, low)
