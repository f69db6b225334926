"""The checker's own differentiation and its arithmetic, against difference quotients and sampled points."""

from __future__ import annotations

import pytest
from flint import arb

from certbound.checker.expressions.arithmetic import Undecided, generalised_kink, power
from certbound.checker.expressions.graph import Graph
from certbound.checker.expressions.operations import OPERATIONS
from certbound.checker.expressions.program import Program, expand
from certbound.checker.report import Budget
from certbound.problem.model.tape import ARITY, JUMPS, Node, Tape

SMOOTH_ONE = sorted(op for op in OPERATIONS.keys() - JUMPS - {"kink", "pow"} if ARITY[op] == 1)
SMOOTH_TWO = sorted(op for op in OPERATIONS.keys() - JUMPS if ARITY[op] == 2)

def program(graph: Graph, node: int, variables: int = 2) -> Program:
    made = Program(graph, [node], variables=variables)
    made.prepare([])
    return made


@pytest.mark.parametrize("op", SMOOTH_ONE + SMOOTH_TWO)
def test_first_and_second_derivatives_agree_with_difference_quotients(op: str) -> None:
    graph = Graph()
    x, y = graph.input(0), graph.input(1)
    # inner functions make the chain rule count
    inner = graph.apply("mul", graph.const(0.7), graph.apply("add", x, graph.apply("mul", graph.const(0.2), y)))
    node = graph.apply(op, inner, y) if op in SMOOTH_TWO else graph.apply(op, inner)
    first = graph.derivative(node, 0)
    second = graph.derivative(first, 1)
    point, h = [0.6, 0.43], arb(2) ** -40

    def at(index: int, shift: list[arb]) -> arb:
        return program(graph, index).run([arb(p) + s for p, s in zip(point, shift)])[0]

    for slope, function, direction in ((first, node, 0), (second, first, 1)):
        up, down = ([arb(0)] * 2 for _ in range(2))
        up[direction], down[direction] = h, -h
        quotient = (at(function, up) - at(function, down)) / (2 * h)
        assert abs(quotient - at(slope, [arb(0)] * 2)) < 1e-3 * h + 1e-2 * h


@pytest.mark.parametrize("exponent", [-2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 0.5, 2.5])
def test_powers_and_their_derivatives(exponent: float) -> None:
    graph = Graph()
    node = graph.apply("pow", graph.input(0), value=exponent)
    value, slope = (program(graph, i, 1).run([arb(1.3)])[0] for i in (node, graph.derivative(node, 0)))
    assert value.contains(arb(1.3) ** arb(exponent)) or abs(value - arb(1.3) ** arb(exponent)) < 1e-12
    assert abs(slope - exponent * arb(1.3) ** arb(exponent - 1)) < 1e-12


def test_powers_of_balls_around_zero_are_defined() -> None:
    for radius in (1e-30, 0.5):
        for n in (1.0, 2.0, 3.0, 7.0):
            found = power(arb(0, radius), n)
            assert found.is_finite()
            assert found.contains(arb(radius) ** int(n) * 0.999)
    assert power(arb(-1, 0.5), 0.5).is_nan()


def test_the_slope_of_a_kink_is_undecided_at_its_point_alone_too() -> None:
    with pytest.raises(Undecided):
        OPERATIONS["kink"].ball(arb(0))


@pytest.mark.parametrize("op", ["sign", "floor", "kink", "not"])
def test_an_undecided_jump_of_one_argument_is_noticed(op: str) -> None:
    with pytest.raises(Undecided):
        OPERATIONS[op].ball(arb(0, 0.5) if op != "floor" else arb(1, 0.1))


@pytest.mark.parametrize("op", ["lt", "le", "eq", "ne", "and", "or", "if_else_zero", "atan2"])
def test_an_undecided_jump_of_two_arguments_is_noticed(op: str) -> None:
    second = arb(-1) if op == "atan2" else arb(0, 0.5)
    with pytest.raises(Undecided):
        OPERATIONS[op].ball(arb(0, 0.5), second)


def test_decided_jumps_have_their_values() -> None:
    assert OPERATIONS["lt"].ball(arb(1), arb(2)) == 1
    assert OPERATIONS["lt"].ball(arb(2), arb(2)) == 0
    assert OPERATIONS["le"].ball(arb(2), arb(2)) == 1
    assert OPERATIONS["if_else_zero"].ball(arb(0), arb(5)) == 0
    assert OPERATIONS["floor"].ball(arb(1.5, 0.25)) == 1
    assert OPERATIONS["sign"].ball(arb(-3, 1)) == -1
    assert generalised_kink(arb(0, 1)).contains(arb(-1))


def test_bounded_functions_of_everything_are_bounded() -> None:
    everything = arb.neg_inf().union(arb.pos_inf())
    for op in ("sin", "cos", "tanh"):
        assert OPERATIONS[op].ball(everything).abs_upper() < 1.0001
    assert (1 - OPERATIONS["sq"].ball(OPERATIONS["tanh"].ball(everything))).lower() > -1e-6


def test_simplified_derivatives_do_not_depend_on_what_cancels() -> None:
    graph = Graph()
    x, y = graph.input(0), graph.input(1)
    node = graph.apply("add", graph.apply("mul", graph.const(3.0), x), graph.apply("sin", y))
    assert graph.is_const(graph.derivative(node, 0), 3.0)
    assert graph.masks[graph.derivative(node, 1)] == 0b10
    assert graph.is_const(graph.derivative(graph.derivative(node, 0), 0), 0.0)


@pytest.mark.parametrize("op", SMOOTH_ONE + SMOOTH_TWO + ["pow"])
def test_taylor_series_enclose_the_function_along_a_line(op: str) -> None:
    if op == "pow":
        nodes = [Node("input", (0,)), Node("pow", (0,), 2.5)]
    elif op in SMOOTH_TWO:
        nodes = [Node("input", (0,)), Node("input", (1,)), Node(op, (0, 1))]
    else:
        nodes = [Node("input", (0,)), Node(op, (0,))]
    tape = Tape(inputs=("x", "y"), nodes=tuple(nodes), outputs=(len(nodes) - 1,), shape=(1,))
    order, size = 6, 0.02
    lines = [(0.4, 0.9), (0.55, -0.3)]
    thin = expand(tape, [[arb(a), arb(b)] for a, b in lines], order, Budget(60))[0]
    span = arb(0, size)
    wide = expand(tape, [[arb(a) + b * span, arb(b)] for a, b in lines], order, Budget(60))[0]
    for s in (-size, -0.003, 0.0, size):
        total = wide[order] * arb(s) ** order if s else arb(0)
        total += sum((thin[j] * arb(s) ** j for j in range(1, order) if s), arb(0)) + thin[0]
        args = [arb(a + b * s) for a, b in lines]
        exact = power(args[0], 2.5) if op == "pow" else OPERATIONS[op].ball(*args[: len(nodes) - 1])
        assert abs(float(total - exact)) < 1e-9 or total.overlaps(exact)
        assert total.lower() - 1e-15 <= exact <= total.upper() + 1e-15


def test_a_power_of_0_makes_no_number_of_what_is_undefined() -> None:
    nodes = (Node("input", (0,)), Node("log", (0,)), Node("pow", (1,), 0.0))
    tape = Tape(inputs=("t",), nodes=nodes, outputs=(2,), shape=(1,))
    assert expand(tape, [[arb(1), arb(1)]], 1, Budget(60))[0] == [1, 0]
    with pytest.raises(Undecided):
        expand(tape, [[arb(-1), arb(1)]], 1, Budget(60))
