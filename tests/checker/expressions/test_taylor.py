"""Taylor models hold what they stand for, and quadratic polynomials stay where they are said to stay."""

from __future__ import annotations

import math
import random

import pytest
from flint import arb

from certbound.checker.expressions.arithmetic import Undecided, power
from certbound.checker.expressions.expansion import Expansion
from certbound.checker.expressions.graph import Graph
from certbound.checker.expressions.operations import OPERATIONS
from certbound.checker.expressions.quadratic import Cut, Quadratic


def form(graph: Graph, node: int, centre: list[float], radius: list[float]) -> Quadratic:
    """The model of a node over a box; input 0 is no coordinate of it."""
    program = Expansion(graph, node, node, variables=len(centre) + 1)
    program.prepare([])
    inputs = [(arb(0), {}), *((arb(c), {a: arb(r)}) for a, (c, r) in enumerate(zip(centre, radius)))]
    return program.run(inputs, len(centre))


def value_at(found: Quadratic, x: list[float]) -> arb:
    total = found.value
    for a, p in enumerate(x):
        total += found.gradient[a] * p + sum((found.hessian[a][b] * p * q / 2 for b, q in enumerate(x)), arb(0))
    return total


def assert_holds(graph: Graph, node: int, centre: list[float], radius: list[float], function: object) -> Quadratic:
    """At random points, the ends included, the function lies within the error of the polynomial."""
    found = form(graph, node, centre, radius)
    rng = random.Random(1)
    for _ in range(60):
        x = [rng.choice((-1.0, 1.0, rng.uniform(-1, 1))) for _ in centre]
        point = [arb(c) + arb(r) * p for c, r, p in zip(centre, radius, x)]
        assert abs(function(*point) - value_at(found, x)) <= found.error + arb(2) ** -100  # type: ignore[operator]
    return found


@pytest.mark.parametrize("exponent", [0.0, 1.0, 2.0, 3.0, -1.0, -2.0, 0.1, 2.5, -0.5, 1e-20, 12_345.0])
def test_powers_lie_within_their_models(exponent: float) -> None:
    graph = Graph()
    node = graph.apply("pow", graph.input(1), value=exponent)
    assert_holds(graph, node, [1.2], [1e-3], lambda x: power(x, exponent))


@pytest.mark.parametrize("op", ["add", "sub", "mul", "div", "atan2", "hypot"])
@pytest.mark.parametrize("centre", [(1.0, 1.3), (-0.8, -1.1), (0.9, -1.0)])
def test_functions_of_two_variables_lie_within_their_models(op: str, centre: tuple[float, float]) -> None:
    graph = Graph()
    node = graph.apply(op, graph.input(1), graph.input(2))
    found = assert_holds(graph, node, list(centre), [0.2, 0.1], OPERATIONS[op].ball)
    assert found.error <= 0.03


def test_what_cancels_leaves_no_error() -> None:
    """A rotation moves the angle by itself: only terms of the third order are left."""
    graph = Graph()
    angle, (x, y) = graph.input(1), (graph.const(2.0), graph.const(0.5))
    c, s = graph.apply("cos", angle), graph.apply("sin", angle)
    first = graph.sub(graph.mul(c, x), graph.mul(s, y))
    second = graph.add(graph.mul(s, x), graph.mul(c, y))
    node = graph.sub(graph.apply("atan2", second, first), angle)
    found = assert_holds(graph, node, [0.1], [0.1], lambda a: arb.atan2(arb(0.5), arb(2)) + 0 * a)
    assert abs(found.gradient[0]) < 1e-30
    assert abs(found.hessian[0][0]) < 1e-30
    assert found.error < 5e-3


@pytest.mark.parametrize(
    ("op", "centre"), [("sqrt", 0.05), ("log", 0.05), ("asin", 0.95), ("abs", 0.05), ("sign", 0.0)]
)
def test_what_is_undefined_or_undecided_has_no_model(op: str, centre: float) -> None:
    graph = Graph()
    with pytest.raises(Undecided):
        form(graph, graph.apply(op, graph.input(1)), [centre], [0.1])


def test_a_branch_that_is_not_taken_need_not_be_defined() -> None:
    graph = Graph()
    x = graph.input(1)
    node = graph.apply("if_else_zero", graph.apply("lt", graph.const(0.0), x), graph.apply("sqrt", x))
    found = form(graph, node, [-1.0], [0.5])
    assert found.value.is_zero()
    assert found.error.is_zero()
    with pytest.raises(Undecided):
        form(graph, node, [0.1], [0.5])


def test_the_cut_of_atan2_is_not_crossed() -> None:
    graph = Graph()
    node = graph.apply("atan2", graph.input(1), graph.input(2))
    with pytest.raises(Undecided):
        form(graph, node, [0.1, -1.0], [0.2, 0.1])
    assert_holds(graph, node, [0.3, -1.0], [0.2, 0.1], OPERATIONS["atan2"].ball)


def polynomial(error: float = 0.0, bend: float = 1.0) -> Quadratic:
    """x y + bend (x^2 + y^2)/2 on [-1, 1]^2."""
    rows = [[arb(bend), arb(1)], [arb(1), arb(bend)]]
    zero = arb(0)
    return Quadratic(
        value=zero, gradient=[zero, zero], hessian=rows, radius=[arb(1), arb(1)], error=arb(error), smear=[zero, zero]
    )


def test_a_polynomial_stays_within_its_range_and_within_no_less() -> None:
    assert polynomial().stays(arb(-0.1), arb(2.001), []) is True  # (x + y)^2/2
    assert polynomial().stays(arb(-1), arb(1.9), []) is False
    assert polynomial(error=0.01).stays(arb(-0.1), arb(2.001), []) is not True
    assert polynomial(error=0.01).stays(arb(-1), arb(2.02), []) is True


def test_cuts_count_and_points_beyond_them_do_not() -> None:
    cut = Cut([arb(1), arb(1)], arb(-1), arb(1))  # |x + y| <= 1
    assert polynomial().stays(arb(-0.3), arb(1.0), [cut]) is True
    assert polynomial().stays(arb(-0.1), arb(0.1), [cut]) is False
    assert polynomial(bend=-1.0).stays(arb(-1), arb(0.01), [cut]) is not True  # x y - ... = -(x - y)^2/2 goes to -2
    assert math.isclose(float(value_at(polynomial(), [1.0, 1.0])), 2.0)


def test_a_jump_in_time_leaves_nothing_behind_for_the_next_box() -> None:
    graph = Graph()
    time, state = graph.input(0), graph.input(1)
    growth = graph.apply("exp", time)
    jump = graph.apply("sign", graph.sub(graph.apply("sq", time), graph.const(4.0)))
    node = graph.mul(graph.mul(state, growth), jump)
    program = Expansion(graph, node, node, variables=2)
    program.prepare([])
    early = [(arb(1), {0: arb(0.125)}), (arb(3), {1: arb(0.5)})]
    first = program.run(early, 2)
    with pytest.raises(Undecided):
        program.run([(arb(2), {0: arb(0.125)}), early[1]], 2)
    again = program.run(early, 2)
    assert abs(again.value - first.value) < 1e-20
    assert abs(again.gradient[1] - first.gradient[1]) < 1e-20
