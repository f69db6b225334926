"""A traced function computes what the function computes; what cannot be traced is refused with the cure."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import certbound as cb
from certbound.problem.model.evaluation import compile_numpy
from certbound.problem.model.tracing import trace

STATES = {"t": ["t"], "x": ["a", "b", "c"], "u": ["u"]}

FUNCTIONS = {
    "arithmetic": lambda t, x, u: [x[0] + 2 * x[1] - t * x[2], (1 - x[0]) / (3 + x[1] ** 2), -x[2] + 3 ** x[0]],
    "powers": lambda x: [x[0] ** 3, abs(x[1]) ** 0.5, np.power(x[2], -2), x[0] ** 0, (2 + np.cos(x[1])) ** x[0]],
    "trigonometry": lambda x: np.sin(x) + np.cos(x[::-1]) * np.tan(0.1 * x),
    "inverse trigonometry": lambda x: [np.arcsin(x[0] / 9), np.arccos(x[1] / 9), np.arctan(x[2])],
    "hyperbolic": lambda x: [np.sinh(x[0]), np.cosh(x[1]) * np.tanh(x[2])],
    "inverse hyperbolic": lambda x: [np.arcsinh(x[0]), np.arccosh(9 + x[1]), np.arctanh(x[2] / 9)],
    "exponentials": lambda x: [np.exp(x[0]), np.exp2(x[1]), np.expm1(x[2]), np.logaddexp(x[0], x[1])],
    "logarithms": lambda x: [np.log(9 + x[0]), np.log2(9 + x[1]), np.log10(9 + x[2]), np.log1p(x[0] ** 2)],
    "roots": lambda x: [np.sqrt(x[0] ** 2 + 1), np.hypot(x[0], x[1]), np.linalg.norm(x), np.linalg.norm(x[:2])],
    "angles": lambda x: [np.arctan2(x[0], x[1]), np.deg2rad(x[0]), np.degrees(x[1])],
    "kinks": lambda x: [abs(x[0]), np.maximum(x[0], x[1]), np.minimum(x[1], 0.5), np.fabs(x[2]), x.max(), np.min(x)],
    "clip": lambda x: np.concatenate([np.clip(x, -0.5, 0.5), np.clip(x[:1], None, 0.2), x[1:2].clip(0.0)]),
    "where": lambda x: np.where(x > 0, x, 2 * x) + np.where(x[0] <= x[1], 1.0, np.sin(x[2])),
    "masks": lambda x: [np.where((x[0] > 0) & ~(x[1] > 0), 1.0, 2.0), np.where((x[0] < 0) | (x[1] != x[1]), 3.0, 4.0)],
    "select": lambda x: [np.select([x[0] > 1, x[0] > 0], [x[1], x[2]], 7.0)],
    "steps": lambda x: [np.sign(x[0]), np.floor(x[1]), np.ceil(x[1]), np.heaviside(x[2], 0.5), x[0] % 2, x[1] // 2],
    "matrices": lambda x: (
        np.array([[0, 1.5, 0], [2, 0, 1], [0, 0, 3]]) @ x + np.dot(np.eye(3), x) - x @ np.ones((3, 3))
    ),
    "reductions": lambda x: [x.sum(), np.sum(x**2), np.prod(x), np.mean(x), x @ x],
    "shapes": lambda x: np.concatenate([np.diff(x), np.cross(x, [1.0, 2.0, 3.0]), np.stack([x[0], x[1]])]),
    "outer product": lambda x: np.outer(x, [1.0, 2.0]),
    "in place": lambda x: _in_place(x.copy()),
    "a mix of kinds": lambda x: [x[0], 1, np.float64(2.5), np.array(3.0), np.array([x[1]])[0]],
    "constants only": lambda x: [1.0, np.pi],
    "einsum": lambda x: np.einsum("i,ij->j", x, np.arange(6.0).reshape(3, 2)),
    "comparisons of an array of entries": lambda x: (
        np.where(np.array([x[0], x[1]]) > 0, 1.0, 2.0) + np.maximum(0, np.asarray([x[2], x[0]]))
    ),
    "an array of entries and numbers": lambda x: np.sin(np.array([x[0], 1.0])) * np.array([[x[1]], [x[2]]])[:, 0],
    "plain array of entries": lambda x: np.sin(np.array([x[0], x[1]])) * 2 + np.array([x[2], 1.0]),
}


def _in_place(x):
    x += 1.0
    x[0] *= 3.0
    return x


def direct(function, t, x, u):
    arguments = {"t": t, "x": x, "u": u}
    names = function.__code__.co_varnames[: function.__code__.co_argcount]
    value = function(*(arguments[name] for name in names))
    return np.asarray([np.asarray(entry, dtype=float) for entry in value]) if isinstance(value, list) else value


@pytest.mark.parametrize("name", FUNCTIONS)
@settings(derandomize=True, deadline=None, max_examples=30)
@given(values=st.lists(st.floats(-3, 3, allow_subnormal=False), min_size=5, max_size=5))
def test_a_tape_computes_what_numpy_computes(name, values):
    function = FUNCTIONS[name]
    values = [0.1 if abs(value) < 1e-3 else value for value in values]
    expected = direct(function, values[0], np.array(values[1:4]), np.array(values[4:]))
    tape = trace(function, STATES)
    result = compile_numpy(tape)(*values)
    assert result.shape == tape.shape == np.shape(expected)
    np.testing.assert_allclose(result, expected, rtol=1e-12, atol=1e-12)


def test_a_jump_is_traced_with_its_values_on_both_sides():
    step = trace(lambda x: [np.where(x[0] < 1, -1.0, np.sign(x[0]) * 5)], {"x": ["x"]})
    np.testing.assert_array_equal(compile_numpy(step)([0.0, 0.999, 1.0, 2.0]).ravel(), [-1, -1, 5, 5])
    angle = trace(lambda x: [np.arctan2(x[0], x[1])], {"x": ["y", "x"]})
    np.testing.assert_allclose(compile_numpy(angle)([1e-9, -1e-9], -1.0).ravel(), [math.pi, -math.pi], atol=1e-8)


def test_twelve_states_are_traced_with_a_loop_and_a_matrix():
    rng = np.random.default_rng(0)
    weights = rng.normal(size=(12, 12))

    def dynamics(t, x):
        return [np.tanh(weights[i] @ x) - x[i] + t * x[(i + 1) % 12] for i in range(12)]

    tape = trace(dynamics, {"t": ["t"], "x": [f"x{k}" for k in range(12)]})
    x = rng.normal(size=(100, 12))
    expected = np.tanh(x @ weights.T) - x + 0.3 * np.roll(x, -1, axis=1)
    np.testing.assert_allclose(compile_numpy(tape)(0.3, *x.T), expected, rtol=1e-13, atol=1e-13)


def test_arguments_are_taken_by_name_in_any_order_and_defaults_stay():
    tape = trace(lambda u, x, gain=3.0: [gain * x[0] + u[0]], {"t": ["t"], "x": ["x"], "u": ["u"]})
    assert compile_numpy(tape)(0.0, 2.0, 1.0) == 7.0
    assert tape.inputs == ("t", "x", "u")


def test_a_scalar_result_has_one_entry():
    assert trace(lambda x: x[0] * x[0], {"x": ["x"]}).shape == (1,)


def test_equal_entries_are_stored_once():
    tape = trace(lambda x: [np.sin(x[0]) + 1, np.sin(x[0]) * 2], {"x": ["x"]})
    assert sum(node.op == "sin" for node in tape.nodes) == 1


def untraceable_branch(x):
    if x[0] > 0:
        return x
    return -x


def untraceable_array(x):
    y = np.zeros(2)
    y[0] = x[0]
    return y


@pytest.mark.parametrize(
    ("function", "cure"),
    [
        (lambda x: math.sin(x[0]), r"use np\.sin"),
        (lambda x: float(x[0]), r"use np\.sin"),
        (lambda x: round(x[0]), r"use np\.sin"),
        (lambda x: range(x[0]), r"use np\.sin"),
        (untraceable_array, r"collect entries with np\.array"),
        (untraceable_branch, r"use np\.where"),
        (lambda x: max(x[0], 0.0), r"np\.maximum"),
        (lambda x: x[0] and x[1], r"use np\.where"),
        (lambda x: [1.0 if x else 2.0], r"use np\.where"),
        (lambda x: np.linalg.inv(np.outer(x, x)), r"write it out"),
        (lambda x: np.interp(x[0], [0, 1], [0, 1]), r"write it out"),
        (lambda x: np.cbrt(x), r"np\.cbrt .* cannot be traced"),
        (lambda x: x[0] + 1j, r"must be real"),
        (lambda x: x[0] + "a", r"meets 'a'"),
        (lambda x: np.sin(x, where=[True, False]), r"cannot be traced"),
        (lambda x: x[0].foo, r"no attribute 'foo'"),
    ],
)
def test_what_cannot_be_traced_is_refused_with_the_cure(function, cure):
    with pytest.raises(TypeError, match=f"cannot be traced.*{cure}"):
        trace(function, {"x": ["a", "b"]})


@pytest.mark.parametrize(
    ("function", "same"),
    [
        (lambda x, v: [v, -x], lambda x: [x[1], -x[0]]),
        (lambda t, v, u: [v * t, u], lambda t, x, u: [x[1] * t, u[0]]),
        (lambda v, x, k=2.0: [x, k * v], lambda x: [x[0], 2.0 * x[1]]),
        (lambda x, v=3.0: v * x, lambda x: 3.0 * x),
    ],
)
def test_entries_may_be_taken_by_their_own_names(function, same):
    arguments = {"t": ["t"], "x": ["x", "v"], "u": ["u"]}
    places = np.random.default_rng(1).normal(size=(4, 4))
    found, expected = (compile_numpy(trace(one, arguments)) for one in (function, same))
    assert np.array_equal(found(*places), expected(*places))


def test_a_system_whose_states_are_named_takes_them_by_name():
    pendulum = cb.ContinuousSystem(lambda th, w: [w, -np.sin(th)], states=["th", "w"], diffusion=lambda w: [[0.0], [w]])
    assert np.array_equal(compile_numpy(pendulum.dynamics)(0.0, 0.3, 0.5), [0.5, -np.sin(0.3)])
    assert np.array_equal(compile_numpy(pendulum.diffusion)(0.0, 0.3, 0.5), [[0.0], [0.5]])


def test_a_refusal_names_the_line():
    with pytest.raises(TypeError, match=r"`untraceable_branch` .*\(line \d+ of test_tracing.py: if x\[0\] > 0:\)"):
        trace(untraceable_branch, {"x": ["a", "b"]})


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda x, u: x, "a system with u needs `inputs=`"),
        (lambda x, q: x, r"by name, from t, x or the names of their entries \(a, b\); got `q`"),
        (lambda *x: x, r"got `\*x`"),
        (lambda **x: x, r"got `\*\*x`"),
        (max, "must be a Python function|must take its arguments by name"),
        (3.0, "must be a function of t, x"),
    ],
)
def test_arguments_are_checked(function, message):
    with pytest.raises(TypeError, match=message):
        trace(function, {"t": ["t"], "x": ["a", "b"]})


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda x: None, "must return its value, got None"),
        (lambda x: [x[0], [x[1], x[0]]], "ragged"),
        (lambda x: [[x[0], 1], [x[1]]], "ragged"),
        (lambda x: np.zeros((2, 2, 2)), "ragged or deeper"),
        (lambda x: [np.nan, x[0]], "finite numbers, got nan at position 0"),
        (lambda x: [x[0], np.inf], "finite numbers, got inf at position 1"),
        (lambda x: "text", "finite numbers, got 'text'"),
    ],
)
def test_the_result_is_checked(function, message):
    with pytest.raises(ValueError, match=message):
        trace(function, {"x": ["a", "b"]})


def test_names_must_be_distinct():
    with pytest.raises(ValueError, match=r"must be distinct, got \['a'\]"):
        trace(lambda x: x, {"x": ["a"], "u": ["a"]})


def test_a_function_must_not_keep_its_arguments():
    kept = []

    def greedy(x):
        kept.append(x[0])
        return kept[0] + x[1]

    trace(greedy, {"x": ["a", "b"]})
    with pytest.raises(TypeError, match="must not keep its arguments"):
        trace(greedy, {"x": ["a", "b"]})


def test_a_value_of_another_call_is_no_result():
    kept = []
    trace(lambda x: kept.append(x[0]) or x, {"x": ["a"]})
    with pytest.raises(TypeError, match="must depend on its arguments only"):
        trace(lambda x: [kept[0]], {"x": ["a"]})


def test_a_traced_value_shows_its_expression():
    shown = []
    trace(lambda x: shown.append(repr(np.sin(x[0]) + 1)) or x, {"x": ["angle"]})
    assert shown == ["<traced (sin(angle) + 1)>"]


def test_numpy_makes_its_own_arrays_again_once_a_model_was_called():
    makers = np.array, np.asarray, np.asanyarray

    def broken(x):
        assert np.array is not makers[0]
        assert trace(lambda y: np.array([y[0], 1.0]), {"y": ["y"]}).shape == (2,)  # a call within a call
        assert type(np.array([1.0, 2.0])) is np.ndarray
        raise KeyError("user")

    with pytest.raises(KeyError):
        trace(broken, {"x": ["x"]})
    assert (np.array, np.asarray, np.asanyarray) == makers
