"""Straight-line programs over balls, made from a graph: parameters are evaluated once, variables many times.

And tapes run once on Taylor series in time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from flint import arb

from certbound.checker.expressions import networks
from certbound.checker.expressions.arithmetic import Undecided, generalised_kink
from certbound.checker.expressions.graph import Graph
from certbound.checker.expressions.operations import OPERATIONS
from certbound.checker.expressions.series import Series, constant
from certbound.checker.report import Budget
from certbound.problem.model import Node, Tape

Step = tuple[int, Callable[..., arb], int, int]


class Program:
    """Some nodes of a graph (``outputs``) as a program.

    ``guards`` are evaluated too, and must be decided and finite (``unbounded``: only defined), but are not returned.
    Inputs below ``variables`` change from run to run, the others are parameters. ``generalised``: the slope of |x| is
    all of [-1, 1] where x may be 0, instead of undecided.
    """

    def __init__(
        self, graph: Graph, outputs: Sequence[int], guards: Iterable[int] = (), *, variables: int,
        generalised: bool = False, unbounded: bool = False,
    ) -> None:
        self._unbounded, self._budget = unbounded, graph.budget
        self.variables = variables
        self._special: dict[str, Callable[..., arb]] = {"kink": generalised_kink} if generalised else {}
        watched = sorted(set(guards))
        order = graph.reachable([*outputs, *watched])
        self._budget.check()
        self._budget.hold(4 * len(order))
        place = {index: number for number, index in enumerate(order)}
        below = (1 << variables) - 1
        self._inputs: list[tuple[int, int]] = []
        self._early: list[Step] = []
        self._late: list[Step] = []
        self._constants: list[tuple[int, arb]] = []
        for number, index in enumerate(order):
            node = graph.node(index)
            if node.op == "input":
                self._inputs.append((number, node.args[0]))
            elif node.op == "const":
                self._constants.append((number, arb(node.value)))
            else:
                steps = self._late if graph.masks[index] & below else self._early
                steps.append(self._step(number, node, [place[arg] for arg in node.args]))
        self._outputs = [place[index] for index in outputs]
        self._watched = [place[index] for index in watched]
        self._size = len(order)
        self._template: list[arb] = []

    def _step(self, number: int, node: Node, args: list[int]) -> Step:
        op, _, value, part = node
        if part is not None:
            return number, lambda values: networks.ball(part, [values[arg] for arg in args]), -1, -1
        ball = self._special.get(op, OPERATIONS[op].ball)
        if op == "pow":
            return number, lambda x: ball(x, value), args[0], -1
        return number, ball, args[0], args[1] if len(args) == 2 else -1

    def prepare(self, parameters: Sequence[arb]) -> None:
        """Set the parameters (inputs ``variables``, ``variables + 1``, ...)."""
        self._budget.check()
        values: list[arb] = [arb(0)] * self._size
        for number, known in self._constants:
            values[number] = known
        for number, slot in self._inputs:
            if slot >= self.variables:
                values[number] = parameters[slot - self.variables]
        for step in self._early:
            try:
                _execute([step], values)
            except Undecided:
                values[step[0]] = arb.nan()
        self._template = values

    def run(self, variables: Sequence[arb]) -> list[arb]:
        """Enclosures of the outputs.

        Undecided where a jump is undecided or something is undefined somewhere in the balls.
        """
        self._budget.check()
        values = self._template.copy()
        for number, slot in self._inputs:
            if slot < self.variables:
                values[number] = variables[slot]
        _execute(self._late, values)
        for number in self._watched:
            value = values[number]
            if value.is_nan() if self._unbounded else not value.is_finite():
                raise Undecided
        result = [values[number] for number in self._outputs]
        for value in result:
            if not value.is_finite():
                raise Undecided
        return result


def _execute(steps: list[Step], values: list[arb]) -> None:
    for number, function, first, second in steps:
        if first < 0:  # as many arguments as a network takes
            values[number] = function(values)
        else:
            values[number] = function(values[first]) if second < 0 else function(values[first], values[second])


def expand(tape: Tape, inputs: Sequence[Series], order: int, budget: Budget) -> list[Series]:
    """Coefficients 0 .. ``order`` of a tape's outputs along series of its inputs; Undecided where something jumps."""
    values: list[Series] = []
    for node in tape.nodes:
        budget.check()
        if node.op == "input":
            given = list(inputs[node.args[0]])[: order + 1]
            values.append(given + [arb(0)] * (order + 1 - len(given)))
        elif node.op == "const":
            values.append(constant(arb(node.value), order))
        elif node.part is not None:
            values.append(networks.series(node.part, [values[arg] for arg in node.args]))
        else:
            exponent = [node.value] if node.op == "pow" else []
            values.append(OPERATIONS[node.op].series(*(values[arg] for arg in node.args), *exponent))
    result = [values[output] for output in tape.outputs]
    if not all(c.is_finite() for series in result for c in series):
        raise Undecided
    return result
