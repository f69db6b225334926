"""The generated source computes what the tape says, and depends on a model's structure alone."""

import math

import numpy as np
import pytest

from certbound.problem.model.evaluation import compile_numpy
from certbound.problem.model.tape import Node, Tape
from certbound.problem.model.tracing import trace
from certbound.simulation.tape_text import Parameters, function_source, linear_form, live_nodes


def run(tape, *values):
    """Evaluate the generated source as plain Python."""
    parameters = Parameters()
    names = [f"x_{i}" for i in range(len(tape.inputs))]
    space = {"math": math, "np": np, "tanh": math.tanh, "atan2": math.atan2}
    space["sincos"] = lambda x: (math.sin(x), math.cos(x))
    exec("\n".join(function_source("f", tape, names, parameters)), space)  # noqa: S102
    return space["f"](parameters.values, *values)


def unary(op, value=0.0):
    return Tape(inputs=("a",), nodes=(Node("input", (0,)), Node(op, (0,), value)), outputs=(1,), shape=(1,))


def binary(op):
    nodes = (Node("input", (0,)), Node("input", (1,)), Node(op, (0, 1)))
    return Tape(inputs=("a", "b"), nodes=nodes, outputs=(2,), shape=(1,))


@pytest.mark.parametrize("exponent", [-3.0, -1.0, 0.5, 1.0, 2.0, 3.0, 4.0, 7.0, 12.0, 13.0, 1.7, -0.5])
def test_powers_agree_with_numpy(exponent):
    tape = unary("pow", exponent)
    np.testing.assert_allclose(run(tape, 1.3), compile_numpy(tape)(1.3), rtol=1e-14)


@pytest.mark.parametrize("op", ["min", "max"])
@pytest.mark.parametrize(("a", "b"), [(math.nan, 1.0), (1.0, math.nan)])
def test_minimum_and_maximum_do_not_swallow_nan(op, a, b):
    assert math.isnan(run(binary(op), a, b)[0])


def test_a_traced_function_with_shared_parts_agrees_with_numpy():
    def f(t, x):
        r = np.hypot(x[0], x[1])
        return [np.where(x[0] > 0, r, -r) + t, np.tanh(r) ** 3 - np.arctan2(x[1], x[0])]

    tape = trace(f, {"t": ["t"], "x": ["a", "b"]})
    for values in [(0.1, 1.0, 2.0), (0.2, -1.0, 0.5)]:
        np.testing.assert_allclose(run(tape, *values), compile_numpy(tape)(*values), rtol=1e-13)


def test_numbers_of_the_tape_do_not_show_in_the_source():
    sources = []
    for rate in (0.123, 0.456):
        tape = trace(lambda x, rate=rate: [-rate * x[0] + 7.25], {"x": ["a"]})
        sources.append(function_source("f", tape, ["x_0"], Parameters()))
    assert sources[0] == sources[1]
    assert "0.123" not in "".join(sources[0])


def test_a_sine_and_a_cosine_of_one_argument_are_computed_together():
    tape = trace(lambda x: [np.cos(x[0]) * x[0] + np.sin(x[0]), np.sin(x[1])], {"x": ["a", "b"]})
    source = "\n".join(function_source("f", tape, ["x_0", "x_1"], Parameters()))
    assert source.count("sincos(x_0)") == 1
    assert source.count("math.sin(x_1)") == 1
    np.testing.assert_allclose(run(tape, 0.3, 0.7), compile_numpy(tape)(0.3, 0.7), rtol=1e-14)


def test_dead_nodes_are_left_out():
    nodes = (Node("input", (0,)), Node("sin", (0,)), Node("cos", (0,)))
    tape = Tape(inputs=("a",), nodes=nodes, outputs=(2,), shape=(1,))
    assert live_nodes(tape) == [0, 2]
    assert "sin" not in "".join(function_source("f", tape, ["x_0"], Parameters()))


def test_linear_forms_leave_out_zeros_and_ones():
    parameters = Parameters()
    assert linear_form([0.0, 1.0, 3.0], ["a", "b", "c"], parameters) == "b + p[0] * c"
    assert linear_form([0.0, 0.0], ["a", "b"], parameters) == "0.0"
    assert parameters.values == [3.0]
