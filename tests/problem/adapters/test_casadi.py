"""Tapes become CasADi expressions and come back with the same values."""

import numpy as np
import pytest

from certbound.problem.adapters.casadi import casadi_module, from_casadi, to_casadi
from certbound.problem.model.derivative import jacobian
from certbound.problem.model.evaluation import compile_numpy
from certbound.problem.model.tracing import trace

ca = casadi_module()
FUNCTIONS = {
    "arithmetic": lambda t, x, u: [x[0] + 2 * x[1] - t * x[2], (1 - x[0]) / (3 + x[1] ** 2), -x[2] + u[0] * 3 ** x[0]],
    "powers": lambda x: [x[0] ** 3, x[1] ** 0.5, x[2] ** -2, x[0] ** 1.7, 5.0],
    "functions": lambda x: [np.sin(x[0]) + np.cos(x[1]) * np.tan(x[2]), np.sinh(x[0]) - np.cosh(x[1]) * np.tanh(x[2])],
    "inverses": lambda x: [np.arcsin(x[0]), np.arccos(x[1]), np.arctan(x[2]), np.arctan2(x[0], x[1])],
    "exponentials": lambda x: [np.exp(x[0]), np.log(x[1]), np.sqrt(x[2]), np.hypot(x[0], x[1])],
    "kinks and jumps": lambda x: [abs(x[0] - 0.5), np.maximum(x[0], x[1]), np.minimum(x[1], 0.5), np.floor(9 * x[2])],
    "branches": lambda x: [
        np.where((x[0] > 0.5) & ~(x[1] <= x[2]), 1.0, np.sign(x[0] - x[1])),
        (x[0] == x[1]) | (x[1] != x[2]),
    ],
    "matrix": lambda x: np.outer(x, [1.0, 2.0]),
}
STATES = {"t": ["t"], "x": ["a", "b", "c"], "u": ["u"]}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_tape_survives_the_round_trip(name):
    tape = trace(FUNCTIONS[name], STATES)
    symbols = ca.SX.sym("z", 5)
    expression = to_casadi(tape, [symbols])
    assert expression.shape == (tape.shape if len(tape.shape) == 2 else (tape.shape[0], 1))
    back = from_casadi(expression, [symbols], tape.inputs, tape.shape)
    points = np.random.default_rng(0).uniform(0.2, 0.9, (5, 40))
    np.testing.assert_allclose(compile_numpy(back)(*points), compile_numpy(tape)(*points), rtol=1e-12)


def test_both_derivatives_agree():
    tape = trace(lambda x: [np.tanh(x[0]) * x[1], x[0] ** 3 / (1 + x[1] ** 2)], {"x": ["a", "b"]})
    symbols = ca.SX.sym("x", 2)
    theirs = from_casadi(ca.jacobian(to_casadi(tape, [symbols]), symbols), [symbols], tape.inputs, (2, 2))
    points = np.random.default_rng(0).normal(size=(2, 30))
    np.testing.assert_allclose(compile_numpy(theirs)(*points), compile_numpy(jacobian(tape))(*points), rtol=1e-12)


def test_scalars_vectors_and_mx_are_accepted():
    tape = trace(lambda x: [x[0] + 2 * x[1]], {"x": ["a", "b"]})
    for kind in (ca.SX, ca.MX):
        a, b = kind.sym("a"), kind.sym("b")
        function = ca.Function("f", [a, b], [to_casadi(tape, [a, b])])
        assert float(function(1.0, 2.0)) == 5.0


def test_a_matrix_keeps_its_rows():
    x = ca.SX.sym("x", 2)
    tape = from_casadi(ca.vertcat(ca.horzcat(x[0], x[1], 1), ca.horzcat(2, 3, x[0] * x[1])), [x], ["a", "b"], (2, 3))
    np.testing.assert_array_equal(compile_numpy(tape)(5.0, 7.0), [[5, 7, 1], [2, 3, 35]])


def test_the_number_of_names_is_checked():
    x = ca.SX.sym("x", 2)
    with pytest.raises(ValueError, match="must name the 2 scalar inputs, got 1"):
        from_casadi(x, [x], ["a"], (2,))


def test_an_operation_that_a_tape_cannot_hold_is_named():
    x = ca.SX.sym("x")
    with pytest.raises(ValueError, match="uses OP_ERF, which a tape cannot hold"):
        from_casadi(ca.erf(x), [x], ["x"], (1,))


def test_functions_of_the_library_are_rewritten():
    x = ca.SX.sym("x")
    expression = ca.vertcat(ca.log1p(x), ca.expm1(x), ca.ceil(x), ca.asinh(x), 2 * x, 1 / x, x ** ca.SX(1.5), 3**x)
    result = compile_numpy(from_casadi(expression, [x], ["x"], (8,)))(1.25)
    np.testing.assert_allclose(
        result, [np.log1p(1.25), np.expm1(1.25), 2, np.arcsinh(1.25), 2.5, 0.8, 1.25**1.5, 3**1.25]
    )
