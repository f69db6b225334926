"""A graph shares nodes and rewrites only what is exact over the reals."""

from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from certbound.problem.model.evaluation import compile_numpy
from certbound.problem.model.graph import Graph, substitute
from certbound.problem.model.tape import Tape
from certbound.problem.model.tracing import trace

numbers = st.floats(-1e6, 1e6, allow_nan=False, allow_infinity=False)


def exact(tape: Tape, node: int) -> Fraction | None:
    """Value of a node of a tape of constants in exact arithmetic."""
    values: list[Fraction] = []
    for entry in tape.nodes:
        a = [values[arg] for arg in entry.args]
        match entry.op:
            case "const":
                values.append(Fraction(entry.value))
            case "add":
                values.append(a[0] + a[1])
            case "sub":
                values.append(a[0] - a[1])
            case "mul":
                values.append(a[0] * a[1])
            case "div":
                values.append(a[0] / a[1])
            case "neg":
                values.append(-a[0])
            case "sq":
                values.append(a[0] ** 2)
            case _:
                raise AssertionError(entry.op)
    return values[node]


@settings(derandomize=True, deadline=None, max_examples=200)
@given(x=numbers, y=numbers, z=numbers, ops=st.lists(st.sampled_from(["add", "sub", "mul"]), min_size=2, max_size=2))
def test_folding_constants_never_rounds(x, y, z, ops):
    graph = Graph(())
    inner = graph.apply(ops[0], graph.const(x), graph.const(y))
    outer = graph.apply(ops[1], inner, graph.const(z))
    exactly = {"add": lambda a, b: a + b, "sub": lambda a, b: a - b, "mul": lambda a, b: a * b}
    expected = exactly[ops[1]](exactly[ops[0]](Fraction(x), Fraction(y)), Fraction(z))
    assert exact(graph.tape([outer], (1,)), -1) == expected


def test_a_product_that_would_round_stays_a_product():
    graph = Graph(())
    assert graph.number(graph.apply("mul", graph.const(0.1), graph.const(0.3))) is None
    assert graph.number(graph.apply("mul", graph.const(0.5), graph.const(3.0))) == 1.5


def test_equal_operations_are_one_node():
    graph = Graph(["x", "y"])
    x, y = graph.input(0), graph.input(1)
    assert graph.apply("add", x, y) == graph.apply("add", y, x)
    assert graph.apply("sub", x, y) != graph.apply("sub", y, x)


@pytest.mark.parametrize(
    ("build", "op"),
    [
        (lambda g, x: g.apply("mul", x, x), "sq"),
        (lambda g, x: g.pow(x, 2.0), "sq"),
        (lambda g, x: g.pow(x, 0.5), "sqrt"),
        (lambda g, x: g.pow(x, -3.0), "div"),
        (lambda g, x: g.pow(x, 3.0), "pow"),
        (lambda g, x: g.apply("sq", g.apply("neg", x)), "sq"),
        (lambda g, x: g.apply("mul", x, g.const(-1.0)), "neg"),
        (lambda g, x: g.apply("neg", g.apply("neg", x)), "input"),
        (lambda g, x: g.apply("sub", x, g.const(0.0)), "input"),
        (lambda g, x: g.apply("max", x, x), "input"),
        (lambda g, x: g.apply("mul", x, g.const(0.0)), "const"),
        (lambda g, x: g.apply("sub", x, x), "const"),
        (lambda g, x: g.pow(x, 0.0), "const"),
        (lambda g, x: g.apply("if_else_zero", g.const(0.0), x), "const"),
        (lambda g, x: g.apply("if_else_zero", g.const(1.0), x), "input"),
    ],
)
def test_simple_forms_are_recognised(build, op):
    graph = Graph(["x"])
    assert graph.nodes[build(graph, graph.input(0))].op == op


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_constant_must_be_finite(value):
    with pytest.raises(ValueError, match="every constant must be finite"):
        Graph(()).const(value)


def test_an_exponent_must_be_finite():
    graph = Graph(["x"])
    with pytest.raises(ValueError, match="an exponent must be finite"):
        graph.pow(graph.input(0), float("inf"))


def test_an_unknown_operation_is_refused():
    graph = Graph(["x"])
    with pytest.raises(ValueError, match="must be a tape operation of 1 arguments, got 'erf'"):
        graph.apply("erf", graph.input(0))


def test_nodes_that_no_output_needs_are_dropped():
    graph = Graph(["x"])
    x = graph.input(0)
    graph.apply("sin", x)
    assert [node.op for node in graph.tape([graph.apply("cos", x)], (1,)).nodes] == ["input", "cos"]


def test_substitution_puts_functions_and_numbers_in_place_of_inputs():
    outer = trace(lambda x, u: [x[0] + u[0] * u[1]], {"x": ["a"], "u": ["p", "q"]})
    law = trace(lambda t, x: [x[0] ** 2, t], {"t": ["t"], "x": ["a"]})
    closed = substitute(outer, ["t", "a"], {"p": (law, 0), "q": (law, 1)})
    assert compile_numpy(closed)(5.0, 3.0) == 3.0 + 9.0 * 5.0
    assert compile_numpy(substitute(outer, ["a", "p"], {"q": 2.0}))(3.0, 7.0) == 17.0


def test_substitution_needs_every_input():
    tape = trace(lambda x: [x[0] + x[1]], {"x": ["a", "b"]})
    with pytest.raises(ValueError, match="must contain 'b', which is not replaced"):
        substitute(tape, ["a"], {})
