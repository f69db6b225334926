"""Formulas read back as the same operations on the same numbers."""

from itertools import count

import numpy as np
import pytest

from certbound.problem.files.formulas import formulas
from certbound.problem.files.parser import parse
from certbound.problem.model.derivative import jacobian
from certbound.problem.model.evaluation import compile_numpy
from certbound.problem.model.graph import Graph
from certbound.problem.model.tracing import trace


def reread(tape):
    definitions, texts = formulas(tape, (f"s{k}" for k in count()))
    graph = Graph(tape.inputs)
    names = {name: graph.input(slot) for slot, name in enumerate(tape.inputs)}
    for name, text in definitions.items():
        names[name] = parse(text, graph, names, name)
    return graph.tape([parse(text, graph, names, "output") for text in texts], tape.shape), definitions, texts


MODELS = {
    "signs": lambda x: [-(x[0] ** 2), (-x[0]) ** 2 * -x[1], -(x[0] - x[1]) / -(x[1] + 3), 2 - (x[0] - (x[1] - 1))],
    "brackets": lambda x: [x[0] / (x[1] + 9) / (x[0] * (x[1] * x[0]) + 9), x[0] - (x[1] + x[0]), (x[0] * 2) ** 3],
    "numbers": lambda x: [x[0] * 0.1 + 1e-30 - 1e22 * x[1], x[0] * -2.5, x[0] + 1 / 3, (x[0] + 5) ** -0.7],
    "calls": lambda x: [np.sin(x[0]) * np.arctan2(x[1], x[0] + 9) + np.hypot(x[0], 1), np.maximum(x[0], -x[1])],
    "shared": lambda x: [np.exp(np.tanh(x[0] * x[1])) + k * np.tanh(x[0] * x[1]) for k in range(3)],
    "deep": lambda x: [deep(x[0]) + x[1]],
    "jumps": lambda x: [np.sign(x[0]) + np.floor(2.5 * x[1]), 2 * ((x[0] < 1) < (x[1] > 0)) - ~(x[0] < 0) * x[1]],
    "choices": lambda x: [
        np.where(x[0] > x[1], x[0] + 1, np.where(x[0] != 0, x[1], 3.0)),
        np.where((x[0] <= 1) & ~(x[1] == 2) | (x[0] * x[1] < 0.5), x[0], -x[0]),
    ],
}


def deep(value):
    for k in range(40):
        value = np.sin(value) + 1.0 / (k + 1)
    return value


@pytest.mark.parametrize("name", MODELS)
def test_values_survive_to_the_last_bit(name):
    tape = trace(MODELS[name], {"x": ["a", "b"]})
    back = reread(tape)[0]
    points = np.random.default_rng(0).uniform(-2, 2, (2, 200))
    np.testing.assert_array_equal(compile_numpy(back)(*points), compile_numpy(tape)(*points))


def test_shared_and_deep_parts_become_definitions():
    definitions, texts = reread(trace(MODELS["shared"], {"x": ["a", "b"]}))[1:]
    assert list(definitions.values()) == ["tanh(a*b)", "exp(s0)"]
    assert texts == ["s1", "s1 + s0", "s1 + 2*s0"]
    assert max(map(len, reread(trace(MODELS["deep"], {"x": ["a", "b"]}))[1].values())) < 400


def test_twelve_states_keep_their_size():
    weights = np.random.default_rng(0).normal(size=(12, 12))
    tape = trace(lambda x: np.tanh(weights @ x), {"x": [f"x{k}" for k in range(12)]})
    assert len(reread(tape)[0].nodes) == len(tape.nodes)


def test_a_kink_of_a_derivative_is_no_formula():
    with pytest.raises(ValueError, match="kink does not exist in problem files"):
        formulas(jacobian(trace(lambda x: np.abs(x), {"x": ["a"]})), iter(["s"]))
