"""Derivatives are exact, keep the function's nodes, and mark kinks and jumps."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from certbound.problem.model.derivative import jacobian
from certbound.problem.model.evaluation import compile_numpy
from certbound.problem.model.graph import Graph
from certbound.problem.model.tape import JUMPS
from certbound.problem.model.tracing import trace

SMOOTH = {
    "add sub mul div": lambda x: [x[0] * x[1] - x[2] / (2 + x[0] ** 2), (x[0] + x[1]) / (3 + x[2])],
    "powers": lambda x: [x[0] ** 3, (5 + x[1]) ** 1.5, (5 + x[2]) ** 0.3, (5 + x[0]) ** -2, (5 + x[1]) ** -0.7],
    "exp log sqrt": lambda x: [np.exp(x[0] * x[1]), np.log(5 + x[1]), np.sqrt(5 + x[2])],
    "sin cos tan": lambda x: [np.sin(x[0]), np.cos(x[1] * x[2]), np.tan(x[2] / 4)],
    "inverses": lambda x: [np.arcsin(x[0] / 4), np.arccos(x[1] / 4), np.arctan(x[2])],
    "hyperbolic": lambda x: [np.sinh(x[0]), np.cosh(x[1]), np.tanh(x[2] - x[0])],
    "two arguments": lambda x: [np.arctan2(x[0], 4 + x[1]), np.hypot(x[1], 4 + x[2]), np.arctan2(4 + x[0], x[1])],
    "kinks": lambda x: [abs(x[0]), np.maximum(x[0], x[1] ** 2), np.minimum(x[1], 2 * x[2]), abs(x[2] * x[0])],
    "branches": lambda x: [np.where(x[0] > x[1], np.sin(x[0]), x[2] ** 2)],
}


def differences(evaluate, point, step=1e-6):
    columns = []
    for unit in np.eye(len(point)):
        columns.append((evaluate(*(point + step * unit)) - evaluate(*(point - step * unit))) / (2 * step))
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("name", SMOOTH)
@settings(derandomize=True, deadline=None, max_examples=25)
@given(point=st.lists(st.floats(-2, 2), min_size=3, max_size=3, unique=True))
def test_a_jacobian_agrees_with_finite_differences(name, point):
    point = np.array(point) + np.array([1e-3, 2e-3, 3e-3])
    near_kink = min(abs(point[0]), abs(point[2]), abs(point[0] - point[1] ** 2), abs(point[1] - 2 * point[2]))
    if near_kink < 1e-4 or abs(point[0] - point[1]) < 1e-4:
        return
    tape = trace(SMOOTH[name], {"x": ["a", "b", "c"]})
    expected = differences(compile_numpy(tape), point)
    np.testing.assert_allclose(compile_numpy(jacobian(tape))(*point), expected, rtol=2e-5, atol=2e-6)


@pytest.mark.parametrize("exponent", [3.0, 4.0, 7.0, 1.5, 2.5, 0.3, -0.7, 100.0])
def test_every_power_is_differentiated(exponent):
    graph = Graph(["a"])
    tape = graph.tape([graph.pow(graph.input(0), exponent)], (1,))
    expected = exponent * 0.8 ** (exponent - 1)
    assert compile_numpy(jacobian(tape))(0.8)[0, 0] == pytest.approx(expected, rel=1e-13)
    if exponent == int(exponent):
        expected = exponent * (-0.8) ** (exponent - 1)
        assert compile_numpy(jacobian(tape))(-0.8)[0, 0] == pytest.approx(expected, rel=1e-13)


def test_second_derivatives_come_from_the_jacobian_of_the_jacobian():
    tape = trace(lambda x: [x[0] ** 3 * np.sin(x[1])], {"x": ["a", "b"]})
    hessian = compile_numpy(jacobian(jacobian(tape)))(2.0, 0.5)
    s, c = np.sin(0.5), np.cos(0.5)
    np.testing.assert_allclose(hessian, [[12 * s, 12 * c], [12 * c, -8 * s]], rtol=1e-14)


def test_columns_choose_inputs_in_their_order():
    tape = trace(lambda t, x: [t * x[0], x[1]], {"t": ["t"], "x": ["a", "b"]})
    part = jacobian(tape, [2, 0])
    assert part.shape == (2, 2)
    np.testing.assert_array_equal(compile_numpy(part)(5.0, 7.0, 9.0), [[0, 7], [1, 0]])
    with pytest.raises(ValueError, match=r"`columns` must lie in 0\.\.2, got \[3\]"):
        jacobian(tape, [3])


def test_a_derivative_is_computed_once():
    tape = trace(lambda x: x**2, {"x": ["a"]})
    assert jacobian(tape) is jacobian(tape, [0])


def test_a_structural_zero_is_a_constant_node():
    tape = jacobian(trace(lambda x: [x[0], np.sin(x[1])], {"x": ["a", "b"]}))
    zero = tape.nodes[tape.outputs[1]]
    assert (zero.op, zero.value) == ("const", 0.0)


def test_the_nodes_begin_with_those_of_the_function():
    for function in SMOOTH.values():
        tape = trace(function, {"x": ["a", "b", "c"]})
        assert jacobian(tape).nodes[: len(tape.nodes)] == tape.nodes


@pytest.mark.parametrize(
    ("function", "jump"),
    [
        (lambda x: [np.sign(x[0])], "sign"),
        (lambda x: [np.where(x[0] > 0, 1.0, -1.0)], "if_else_zero"),
        (lambda x: [np.floor(x[0])], "floor"),
        (lambda x: [np.heaviside(x[0], 0.5)], "if_else_zero"),
        (lambda x: [np.arctan2(x[0], x[1])], "atan2"),
    ],
)
def test_a_jump_of_the_function_stays_visible_in_its_derivative(function, jump):
    derivative = jacobian(trace(function, {"x": ["a", "b"]}))
    assert jump in {node.op for node in derivative.nodes}


def test_a_kink_has_a_generalised_slope_that_is_no_jump():
    derivative = jacobian(trace(lambda x: [abs(x[0]), np.maximum(x[0], x[1])], {"x": ["a", "b"]}))
    ops = {node.op for node in derivative.nodes}
    assert "kink" in ops
    assert not ops & JUMPS
    np.testing.assert_array_equal(compile_numpy(derivative)(-2.0, 3.0), [[-1, 0], [0, 1]])


def test_the_slope_of_a_kink_is_a_jump_to_second_derivatives():
    second = jacobian(jacobian(trace(lambda x: [abs(x[0])], {"x": ["a"]})))
    ops = {node.op for node in second.nodes}
    assert "sign" in ops
    assert "kink" not in ops


def test_no_constant_of_a_derivative_is_rounded():
    """d/dx (0.1 x 0.3) is the product of two floats, which no float equals."""
    derivative = jacobian(trace(lambda x: [0.1 * x[0] * 0.3], {"x": ["a"]}))
    values = [node.value for node in derivative.nodes if node.op == "const"]
    exact = Fraction(0.1) * Fraction(0.3)
    assert Fraction(0.1 * 0.3) != exact
    assert 0.1 * 0.3 not in values
    assert compile_numpy(derivative)(1.0) == pytest.approx(0.03)


def test_a_power_whose_lower_exponent_rounds_is_differentiated_by_division():
    """0.3 - 1 is not -0.7 in floats, so no node may hold a rounded exponent."""
    derivative = jacobian(trace(lambda x: [x[0] ** 0.3], {"x": ["a"]}))
    assert {node.value for node in derivative.nodes if node.op == "pow"} == {0.3}


def test_twenty_masses_are_differentiated_sparsely():
    def chain(x):
        p, v = x[:20], x[20:]
        force = [10 * (p[(i + 1) % 20] - p[i]) - np.tanh(v[i]) for i in range(20)]
        return [*v, *force]

    tape = trace(chain, {"x": [f"x{k}" for k in range(40)]})
    derivative = jacobian(tape)
    assert len(derivative.nodes) < 4 * len(tape.nodes)
    point = np.random.default_rng(1).normal(size=40)
    expected = differences(compile_numpy(tape), point)
    np.testing.assert_allclose(compile_numpy(derivative)(*point), expected, atol=1e-8)
