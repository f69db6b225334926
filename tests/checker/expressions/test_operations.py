"""Every column of the checker's table says the same function, and the one that the prover's table says."""

from __future__ import annotations

import random

import pytest
from flint import arb

from certbound.checker.expressions.arithmetic import Undecided
from certbound.checker.expressions.expansion import Expansion
from certbound.checker.expressions.graph import Graph
from certbound.checker.expressions.operations import OPERATIONS, is_partial
from certbound.checker.expressions.program import Program, expand
from certbound.checker.report import Budget
from certbound.problem.model import Node, Tape, compile_numpy, jacobian
from certbound.problem.model.operations import OPERATIONS as PROVER
from certbound.problem.model.tape import ARITY, JUMPS
from certbound.reach.nominal.series import expand as expand_intervals
from certbound.rigor.intervals import Interval

EXPONENT = 2.5
CENTRES = [(0.3, 0.7), (0.8, 0.4), (0.45, -0.55)]

every_operation = pytest.mark.parametrize("op", sorted(OPERATIONS))


def value_of(op: str) -> float:
    return EXPONENT if op == "pow" else 0.0


def tape_of(op: str) -> Tape:
    nodes = (Node("input", (0,)), Node("input", (1,)), Node(op, tuple(range(ARITY[op])), value_of(op)))
    return Tape(inputs=("a", "b"), nodes=nodes, outputs=(2,), shape=(1,))


def graph_of(op: str) -> tuple[Graph, int]:
    graph = Graph()
    inputs = [graph.input(0), graph.input(1)]
    return graph, graph.apply(op, *inputs[: ARITY[op]], value=value_of(op))


def run(graph: Graph, node: int, box: list[arb]) -> arb:
    program = Program(graph, [node], variables=2)
    program.prepare([])
    return program.run(box)[0]


def overlap(ball: arb, interval: Interval) -> bool:
    return bool(ball.overlaps(arb(float(interval.lo)).union(arb(float(interval.hi)))))


def test_both_tables_have_every_operation_and_agree_on_what_may_be_undefined() -> None:
    assert OPERATIONS.keys() == PROVER.keys() == ARITY.keys() - {"const", "input"}
    assert {op for op in ARITY if is_partial(op)} == {op for op, row in PROVER.items() if row.undefined}
    assert {op for op, row in OPERATIONS.items() if row.model is None} == JUMPS | {"kink"}
    assert {op for op, row in OPERATIONS.items() if row.slope is None} == JUMPS - {"if_else_zero"} | {"kink"}


@every_operation
def test_values_and_derivatives_are_those_of_the_prover(op: str) -> None:
    graph, node = graph_of(op)
    value, slope = compile_numpy(tape_of(op)), compile_numpy(jacobian(tape_of(op)))
    for point in CENTRES:
        box = [arb(p) for p in point]
        assert abs(float(run(graph, node, box)) - value(*point)[0]) < 1e-14
        for k in range(2):
            assert abs(float(run(graph, graph.derivative(node, k), box)) - slope(*point)[0, k]) < 1e-13


@every_operation
@pytest.mark.parametrize("radius", [1e-12, 0.05, 0.25])
def test_balls_hold_the_values_at_their_points(op: str, radius: float) -> None:
    rng = random.Random(5)
    for centre in CENTRES:
        args, exponent = [arb(c, radius) for c in centre[: ARITY[op]]], [EXPONENT] if op == "pow" else []
        try:
            found = OPERATIONS[op].ball(*args, *exponent)
        except Undecided:
            assert PROVER[op].jump or PROVER[op].kink
            continue
        for _ in range(20):
            point = [arb(c) + arb(rng.choice((-1.0, 1.0, rng.uniform(-1, 1)))) * arb(radius) for c in centre]
            assert found.contains(OPERATIONS[op].ball(*point[: ARITY[op]], *exponent).mid())


@every_operation
def test_series_overlap_those_of_the_prover_and_neither_is_wide(op: str) -> None:
    for centre in CENTRES if op != "if_else_zero" else [(0.0, 0.7), (1.0, 0.4)]:  # a condition is 0 or 1
        lines = [(a, b) for a, b in zip(centre, (0.7, -0.4) if op != "if_else_zero" else (0.0, -0.4))]
        balls = expand(tape_of(op), [[arb(a), arb(b)] for a, b in lines], 6, Budget(60))[0]
        thin = [[Interval.point(a), Interval.point(b)] for a, b in lines]
        for ball, interval in zip(balls, expand_intervals(tape_of(op), thin, 6)[0]):
            assert overlap(ball, interval)
            assert interval.width < 1e-9 * (1 + abs(interval.mid))
            assert ball.rad() < 1e-9 * (1 + abs(ball.mid()))


@every_operation
@pytest.mark.parametrize("radius", [0.25, 0.01])
def test_models_hold_the_values_over_their_boxes(op: str, radius: float) -> None:
    rng = random.Random(1)
    graph, node = graph_of(op)
    program = Expansion(graph, node, node, variables=2)
    program.prepare([])
    for centre in CENTRES:
        try:
            found = program.run([(arb(c), {k: arb(radius)}) for k, c in enumerate(centre)], 2)
        except Undecided:
            assert radius == 0.25
            continue
        assert radius == 0.25 or found.error <= 100 * radius**3
        for _ in range(30):
            x = [rng.choice((-1.0, 1.0, rng.uniform(-1, 1))) for _ in centre]
            total = found.value + sum((g * p for g, p in zip(found.gradient, x)), arb(0))
            total += sum((found.hessian[a][b] * p * q / 2 for a, p in enumerate(x) for b, q in enumerate(x)), arb(0))
            exact = run(graph, node, [arb(c) + arb(radius) * p for c, p in zip(centre, x)])
            assert abs(exact - total) <= found.error + arb(2) ** -100
