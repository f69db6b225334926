"""Programs over Taylor models, made from a graph: parameters are evaluated once, boxes many times."""

from __future__ import annotations

from collections.abc import Sequence

from flint import arb

from certbound.checker.expressions import networks
from certbound.checker.expressions.arithmetic import Undecided, holds
from certbound.checker.expressions.graph import Graph
from certbound.checker.expressions.operations import OPERATIONS
from certbound.checker.expressions.program import work_of
from certbound.checker.expressions.quadratic import Quadratic
from certbound.checker.expressions.taylor import Model, constant
from certbound.checker.report import BALL, STEP, Budget
from certbound.problem.model import Part

_ZERO = arb(0)
_MANY = 100
"""Terms whose time and memory are worth counting."""

_Step = tuple[str, tuple[int, ...], float | Part]


class Expansion:
    """A node of a graph as a program over Taylor models: parameters are evaluated once, boxes many times.

    ``guard`` is a node that must be defined too; inputs below ``variables`` vary over the box, the others are
    parameters.
    """

    def __init__(self, graph: Graph, node: int, guard: int, *, variables: int) -> None:
        self.variables, self._budget = variables, graph.budget
        order = graph.reachable([node, guard])
        self._budget.spend(5 * STEP * len(order))
        self._budget.hold(sum(4 + graph.bits[index] // 512 for index in order))
        self._bits = [graph.bits[index] for index in order]
        place = {index: number for number, index in enumerate(order)}
        below = (1 << variables) - 1
        self._nodes: list[_Step] = []
        for index in order:
            op, args, value, part = graph.node(index)
            places = args if op == "input" else tuple(place[arg] for arg in args)
            self._nodes.append((op, places, part or value))
        self._early = [number for number, index in enumerate(order) if not graph.masks[index] & below]
        self._first = [number for number, index in enumerate(order) if graph.masks[index] & below == 1]
        self._later = [number for number, index in enumerate(order) if graph.masks[index] & below > 1]
        early = set(self._early)
        self.work = sum(  # of its parameters and of one box, at least
            STEP + (1 if number in early else 2) * work_of(op, 0) for number, (op, *_) in enumerate(self._nodes)
            if op not in ("input", "const")
        )
        self._output, self._guard = place[node], place[guard]
        self._template: list[Model | None] = []
        self._last: tuple[arb, dict[int, arb]] | None = None

    def prepare(self, parameters: Sequence[arb]) -> None:
        """Set the parameters (inputs ``variables``, ``variables + 1``, ...)."""
        values: list[Model | None] = [None] * len(self._nodes)
        for number in self._early:
            op, args, value = self._nodes[number]
            self._budget.balls(1, STEP + work_of(op, self._bits[number]))
            try:
                if op == "input":
                    values[number] = constant(parameters[args[0] - self.variables])
                else:
                    values[number] = _value(op, args, value, values, self._budget)
            except Undecided:
                values[number] = None
        self._template, self._last = values, None

    def run(self, inputs: Sequence[tuple[arb, dict[int, arb]]], size: int) -> Quadratic:
        """The expression over a box of ``size`` coordinates; every variable is a centre and its linear coefficients.

        Undecided where a jump is undecided or something is undefined somewhere in the box.
        """
        with self._budget.passing():
            return self._run(inputs, size)

    def _run(self, inputs: Sequence[tuple[arb, dict[int, arb]]], size: int) -> Quadratic:
        self._budget.check()
        if self._last != inputs[0]:  # most boxes share the time
            self._last = None  # should a jump in time stop here, what is half done serves nobody
            self._execute(self._first, self._template, inputs)
            self._last = inputs[0]
        values = self._template.copy()
        self._execute(self._later, values, inputs)
        found, guard = values[self._output], values[self._guard]
        if found is None or guard is None or not guard.range().is_finite():
            raise Undecided
        if not found.range().is_finite():
            raise Undecided
        self._budget.balls(size * size // 4 + len(found.squares))
        gradient, hessian = [_ZERO] * size, [[_ZERO] * size for _ in range(size)]
        for a, c in found.linear.items():
            gradient[a] = c
        for (a, b), c in found.squares.items():
            hessian[a][b] = hessian[b][a] = 2 * c if a == b else c
        smear = [arb(found.blame.get(a, 0.0)) for a in range(size)]
        return Quadratic(
            value=found.value, gradient=gradient, hessian=hessian, radius=[arb(1)] * size, error=found.error.upper(),
            smear=smear, budget=self._budget,
        )

    def _execute(
        self, numbers: Sequence[int], values: list[Model | None], inputs: Sequence[tuple[arb, dict[int, arb]]]
    ) -> None:
        for number in numbers:
            op, args, value = self._nodes[number]
            if op == "input":
                centre, linear = inputs[args[0]]
                values[number] = Model(centre, linear, {}, _ZERO, {})
            else:
                self._count(op, args, values)
                found = values[number] = _value(op, args, value, values, self._budget)
                if found is not None and len(found.squares) > _MANY:
                    self._budget.hold(3 * len(found.squares))

    def _count(self, op: str, args: tuple[int, ...], values: list[Model | None]) -> None:
        """Count the work of an operation by the terms of what it takes."""
        linear = squares = 0
        for arg in args:
            model = values[arg]
            if model is not None:
                linear, squares = max(linear, len(model.linear)), max(squares, len(model.squares))
        self._budget.balls(1, STEP + 2 * work_of(op, 0) + BALL * (linear * (linear + 8) + 4 * squares))


def _value(
    op: str, args: tuple[int, ...], value: float | Part, values: list[Model | None], budget: Budget
) -> Model | None:
    """A node's model; None is what is not defined. A jump, a kink or a branch cut in the box is `Undecided`."""
    if isinstance(value, Part):
        inner = [model for model in (values[arg] for arg in args) if model is not None]
        return networks.model(value, inner, budget) if len(inner) == len(args) else None
    if op == "const":
        return constant(arb(value))
    given = [model for model in (values[arg] for arg in args) if model is not None]
    if op == "if_else_zero":
        condition = values[args[0]]
        if condition is None:
            return None
        return values[args[1]] if holds(condition.range()) else constant(_ZERO)
    if len(given) < len(args):
        return None
    row, exponent = OPERATIONS[op], [value] if op == "pow" else []
    if all(model.fixed for model in given):
        known = row.ball(*(model.value for model in given), *exponent)
        return constant(known) if known.is_finite() else None
    if row.model is None:
        return constant(row.ball(*(model.range() for model in given)))
    return row.model(*given, *exponent)
