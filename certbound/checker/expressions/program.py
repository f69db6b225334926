"""Straight-line programs over balls, made from a graph: parameters are evaluated once, variables many times.

And tapes run once on Taylor series in time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from flint import arb

from certbound.checker.expressions import networks
from certbound.checker.expressions.arithmetic import Undecided, generalised_kink
from certbound.checker.expressions.graph import Graph, longer
from certbound.checker.expressions.operations import OPERATIONS
from certbound.checker.expressions.series import Series, constant
from certbound.checker.report import BALL, FUNCTION, STEP, Budget
from certbound.problem.model import JUMPS, Node, Tape

Step = tuple[int, Callable[..., arb], int, int]

_PLAIN = frozenset(
    ["neg", "add", "sub", "mul", "sq", "div", "abs", "min", "max", "kink", "sign", "floor", "if_else_zero", *JUMPS]
)
_LONG, _WORD = 4096, 512
"""Bits of an exponent that cost as much as the rest of a ball: in work, and in memory."""


def work_of(op: str, bits: int) -> int:
    """Units of an operation of balls whose exponents are so long; parts of networks count their own."""
    return (BALL if op in _PLAIN else 2 * FUNCTION if op == "pow" else FUNCTION) * (1 + bits // _LONG)


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
        self._budget.spend(5 * STEP * len(order))
        self._budget.hold(sum(4 + graph.bits[index] // _WORD for index in order))
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
        self._work = [
            sum(work_of(graph.node(order[step[0]]).op, graph.bits[order[step[0]]]) for step in steps)
            for steps in (self._early, self._late)
        ]
        self._outputs = [place[index] for index in outputs]
        self._watched = [place[index] for index in watched]
        self._size = len(order)
        self._template: list[arb] = []

    def _step(self, number: int, node: Node, args: list[int]) -> Step:
        op, _, value, part = node
        if part is not None:
            budget = self._budget
            return number, lambda values: networks.ball(part, [values[arg] for arg in args], budget), -1, -1
        ball = self._special.get(op, OPERATIONS[op].ball)
        if op == "pow":
            return number, lambda x: ball(x, value), args[0], -1
        return number, ball, args[0], args[1] if len(args) == 2 else -1

    @property
    def work(self) -> int:
        """Units of work of a run, at 128 bits."""
        return self._work[1] + STEP + self._size

    def prepare(self, parameters: Sequence[arb]) -> None:
        """Set the parameters (inputs ``variables``, ``variables + 1``, ...)."""
        self._budget.balls(1, self._work[0] + STEP + self._size)
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
        self._budget.balls(1, self.work)
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
    with budget.passing():
        return _expanded(tape, inputs, order, budget)


def _expanded(tape: Tape, inputs: Sequence[Series], order: int, budget: Budget) -> list[Series]:
    values: list[Series] = []
    bits: list[int] = []
    count = order + 1
    for node in tape.nodes:
        bits.append(longer(node.op, 0 if node.op == "input" else max((bits[arg] for arg in node.args), default=0)))
        times = int(min(abs(node.value), 64)) if node.op == "pow" else 2
        budget.balls(1, STEP + 2 * work_of(node.op, bits[-1]) + times * count * count * BALL * (1 + bits[-1] // _LONG))
        budget.hold(count * (1 + bits[-1] // _WORD))
        if node.op == "input":
            given = list(inputs[node.args[0]])[: order + 1]
            values.append(given + [arb(0)] * (order + 1 - len(given)))
        elif node.op == "const":
            values.append(constant(arb(node.value), order))
        elif node.part is not None:
            values.append(networks.series(node.part, [values[arg] for arg in node.args], budget))
        else:
            exponent = [node.value] if node.op == "pow" else []
            values.append(OPERATIONS[node.op].series(*(values[arg] for arg in node.args), *exponent))
    result = [values[output] for output in tape.outputs]
    if not all(c.is_finite() for series in result for c in series):
        raise Undecided
    return result
