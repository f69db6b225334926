"""What the dynamics look like to first order: which entries of its Jacobians are constant, which states matter.

Where an entry of D_x f depends on nothing, the linearisation uses the model's own (exact) value: the remainder does
not depend on that state through that entry, whatever the floats of the certificate say. That is false where f jumps
(the derivative of a step is 0) or is not defined: what decides that must be seen apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from flint import arb, arb_mat

from certbound.checker.expressions import Graph, Program, Undecided, is_partial
from certbound.checker.report import STEP, Budget, Unproved
from certbound.checker.statement.problem import Model
from certbound.problem.model import JUMPS


@dataclass(frozen=True, eq=False, kw_only=True)
class Entries:
    """A Jacobian of f, of a ``shape``: nodes[i, j] of the graph, absent where the entry is exactly 0.

    ``varying`` lists those that depend on an input, row by row, ``fixed`` holds the values of the others.
    """

    shape: tuple[int, int]
    nodes: dict[tuple[int, int], int]
    varying: list[tuple[int, int]]
    fixed: dict[tuple[int, int], arb]

    def active(self, output: int) -> list[int]:
        """Inputs on which the remainder of an output may depend."""
        return [j for i, j in self.varying if i == output]

    def matrix(self, values: Sequence[float], *, constants: bool = True) -> arb_mat:
        """The matrix whose varying entries are given; the constant ones are the model's own, or 0."""
        rows, columns = self.shape
        entries = [arb(0)] * (rows * columns)
        for (i, j), value in [*(self.fixed.items() if constants else ()), *zip(self.varying, map(arb, values))]:
            entries[i * columns + j] = value
        return arb_mat(rows, columns, entries)


@dataclass(frozen=True, eq=False, kw_only=True)
class Structure:
    """The Jacobians of f (``outputs`` of ``graph``) by the states and by the disturbances."""

    graph: Graph
    outputs: list[int]
    states: Entries
    disturbances: Entries

    def hidden(self, model: Model, output: int) -> list[int]:
        """Inputs that decide a jump of an output, or whether it is defined, and are none of its remainder's."""
        self.graph.budget.check()
        count, n = len(model.dynamics.inputs), model.dimension
        first = count - len(model.disturbance)
        asked = sum(1 << slot for slot in [*range(1, n + 1), *range(first, count)])
        asked &= ~sum(1 << 1 + j for j in self.states.active(output))
        asked &= ~sum(1 << first + j for j in self.disturbances.active(output))
        deciding = 0
        order = self.graph.reachable([self.outputs[output]])
        self.graph.budget.spend(2 * STEP * len(order))
        for index in order:
            deciding |= _deciding(self.graph, index)
        return [slot for slot in range(count) if deciding & asked & 1 << slot]


def structure_of(model: Model, budget: Budget) -> Structure:
    """Differentiate the model once."""
    graph = Graph(budget)
    n, q = model.dimension, len(model.disturbance)
    slots = [graph.input(slot) for slot in range(len(model.dynamics.inputs))]
    nodes = graph.include(model.dynamics, slots)
    outputs = [nodes[output] for output in model.dynamics.outputs]
    first = len(slots) - q
    states = _entries(graph, outputs, range(1, n + 1), budget)
    return Structure(
        graph=graph, outputs=outputs, states=states,
        disturbances=_entries(graph, outputs, range(first, first + q), budget),
    )  # fmt: skip


def _deciding(graph: Graph, index: int) -> int:
    """The inputs that decide on which side of a jump an operation is, or whether it is defined."""
    op, args, value, _ = graph.node(index)
    if op == "if_else_zero":
        return graph.masks[args[0]]
    if op == "div":
        return graph.masks[args[1]]
    if op == "pow" and value >= 0 and value == int(value):
        return 0
    return graph.masks[index] if op in JUMPS or is_partial(op) else 0


def _entries(graph: Graph, outputs: list[int], slots: range, budget: Budget) -> Entries:
    found = {}
    for i, output in enumerate(outputs):
        for j, slot in enumerate(slots):
            if graph.masks[output] >> slot & 1:
                budget.check()
                node = graph.derivative(output, slot)
                if not graph.is_const(node, 0.0):
                    found[i, j] = node
    varying = sorted(entry for entry, node in found.items() if graph.masks[node])
    return Entries(shape=(len(outputs), len(slots)), nodes=found, varying=varying, fixed=_values(graph, found))


def _values(graph: Graph, nodes: dict[tuple[int, int], int]) -> dict[tuple[int, int], arb]:
    """Values of the entries that depend on nothing."""
    constant = {entry: node for entry, node in nodes.items() if not graph.masks[node]}
    program = Program(graph, list(constant.values()), variables=0)
    program.prepare([])
    try:
        return dict(zip(constant, program.run([])))
    except Undecided as error:
        raise Unproved("a derivative of the dynamics that depends on nothing is not defined") from error
