"""Upper bounds of an expression over a part of a box, by branch and bound on balls.

On a box around c with radii r the expression lies below value + |grad| . r + sum of |H_ab| r_a r_b / 2 (the square
terms one-sided), with value and gradient at c and the Hessian over the whole box. Where a kink lies inside the box the
generalised slopes over the box bound it to first order, and where those do not exist its range does.

Boxes are cut at exact points, and both halves keep the cut: what is proved on all parts is proved on the box.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from flint import arb

from certbound.checker.expressions.arithmetic import Undecided
from certbound.checker.expressions.graph import Graph
from certbound.checker.expressions.program import Program
from certbound.checker.report import Budget
from certbound.problem.model import JUMPS

_MOST_BOXES = 200_000
_DEEPEST = 40
_EVEN = 6
_RISKY = JUMPS | {"kink", "atan2", "jumping"}

Side = tuple[arb, arb]


@dataclass(frozen=True, eq=False)
class _Found:
    """Value at the centre, upper bound over the box, and what each coordinate contributes to their distance."""

    value: arb
    high: arb
    smear: list[arb]


class Ceiling:
    """An expression (``node``) over the inputs 0 .. ``count`` - 1 of a graph.

    The nodes ``defined`` must be defined too wherever it is bounded.
    """

    def __init__(self, graph: Graph, node: int, defined: Sequence[int], *, count: int, budget: Budget) -> None:
        self.budget = budget
        guards = {node, *defined}
        mask = 0
        for index in guards:
            mask |= graph.masks[index]
        self.slots = [slot for slot in range(count) if mask >> slot & 1]
        gradient = [graph.derivative(node, slot) for slot in self.slots]
        second = {}
        for a in range(len(gradient)):
            for b in range(a, len(gradient)):
                budget.check()
                budget.hold(2)
                second[a, b] = graph.derivative(gradient[a], self.slots[b])
        self._pairs = [pair for pair, index in second.items() if not graph.is_const(index, 0.0)]
        hessian = [second[pair] for pair in self._pairs]
        risky = {index for index in graph.reachable([*gradient, *hessian]) if graph.node(index).op in _RISKY}
        self._thin = Program(graph, [node, *gradient], guards, variables=count)
        self._wide = Program(graph, hessian, risky | guards, variables=count)
        self._slopes = Program(graph, gradient, guards, variables=count, generalised=True)
        self._range = Program(graph, [node], guards, variables=count)
        self._kinked = any(graph.node(index).op in ("kink", "bent") for index in graph.reachable(gradient))
        for program in (self._thin, self._wide, self._slopes, self._range):
            program.prepare([])

    @property
    def work(self) -> int:
        """Units of work of one look at a box, at least."""
        return self._thin.work

    def prove(
        self, box: Sequence[Side], bound: arb, skip: Callable[[Sequence[arb], Sequence[arb]], bool] = lambda *_: False,
        member: Callable[[Sequence[arb], Sequence[arb]], bool] = lambda *_: True,
    ) -> bool:
        """Whether the expression is at most ``bound`` on the part of a box that ``skip`` does not rule out.

        ``box`` has exact ends, one pair an input. ``skip`` says whether a box, given by centres and radii, surely has
        no point of interest; ``member`` whether all its points are: one that exceeds the bound settles that nothing is
        proved.
        """
        first = list(box)
        widths, point = [high - low for low, high in first], [arb(0)] * len(first)
        stack = [(first, 0)]
        for _ in range(_MOST_BOXES):
            if not stack:
                return True
            self.budget.box()
            self.budget.balls(12 * len(first) + 6 * len(self._pairs))
            current, depth = stack.pop()
            centre = [middle_of(side) for side in current]
            radius = [arb.max(high - c, c - low).upper() for (low, high), c in zip(current, centre)]
            if skip(centre, radius):
                continue
            found = self._bound(current, centre, radius)
            if found is not None and found.high <= bound:
                continue
            if found is not None and found.value > bound and member(centre, point):
                return False
            turn = _EVEN if member(centre, radius) else 2  # what lies across an edge must become small on all sides
            place = self._place(radius, widths, None if found is None or depth % turn == turn - 1 else found.smear)
            if place < 0 or depth > _DEEPEST * len(self.slots):
                return False
            low, high = current[place]
            cut = centre[place]
            if not low < cut < high:
                return False
            halves = (low, cut), (cut, high)
            stack += [([*current[:place], half, *current[place + 1 :]], depth + 1) for half in halves]
        return not stack

    def holds(self, centre: Sequence[arb], radius: Sequence[arb], bound: arb) -> bool:
        """Whether one look shows that the expression is at most ``bound`` on the box of these centres and radii."""
        box = [(c - r, c + r) for c, r in zip(centre, radius)]
        found = self._bound(box, list(centre), list(radius))
        return found is not None and bool(found.high <= bound)

    def _place(self, radius: list[arb], widths: list[arb], smear: list[arb] | None) -> int:
        """The side to cut: what contributes most, or the widest one relative to the whole box; -1 for a point."""
        best, size = -1, arb(0)
        for number, slot in enumerate(self.slots):
            if radius[slot] > 0:
                own = radius[slot] / widths[slot] if smear is None else smear[number]
                if best < 0 or own > size:
                    best, size = slot, own
        return best

    def _bound(self, box: list[Side], centre: list[arb], radius: list[arb]) -> _Found | None:
        """Bounds on a box; None where nothing is decided."""
        whole = [low.union(high) if low < high else low for low, high in box]
        reach = [radius[slot] for slot in self.slots]
        try:
            value, *gradient = self._thin.run(centre)
            second = self._wide.run(whole)
        except Undecided:
            return self._coarse(whole, centre, reach)
        smear = [abs(g) * r for g, r in zip(gradient, reach)]
        high = value + sum(smear, arb(0))
        for (a, b), entry in zip(self._pairs, second):
            if a == b:
                part = arb.max(entry.upper(), arb(0)) * reach[a] * reach[a] / 2
            else:
                part = abs(entry) * reach[a] * reach[b]
                smear[b] += part
            high += part
            smear[a] += part
        return _Found(value, high.upper(), [x.upper() for x in smear])

    def _coarse(self, whole: list[arb], centre: list[arb], reach: list[arb]) -> _Found | None:
        """To first order with generalised slopes, or the range."""
        if self._kinked:
            try:
                (value,) = self._range.run(centre)
                slopes = self._slopes.run(whole)
            except Undecided:
                pass
            else:
                smear = [(abs(g) * r).upper() for g, r in zip(slopes, reach)]
                return _Found(value, (value + sum(smear, arb(0))).upper(), smear)
        try:
            (found,) = self._range.run(whole)
        except Undecided:
            return None
        return _Found(found.lower(), found.upper(), reach)


def middle_of(side: Side) -> arb:
    """An exact point in the middle of a side."""
    low, high = side
    return ((low + high) / 2).mid() if low < high else low
