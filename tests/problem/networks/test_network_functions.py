"""Networks are read from layers and files, called in models, and written with them."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.constants.enclosures import enclose
from certbound.problem.adapters.casadi import to_casadi
from certbound.problem.model import compile_numpy, jacobian, trace
from certbound.problem.networks import write_network
from certbound.rigor.intervals import Interval
from certbound.simulation.tape_text import Parameters, function_source
from tests.networks import CONSTANTS, random_layers, random_network
from tests.simulation.test_tape_text import run

PROBLEM = """
time = "discrete"
horizon = 10
states = ["x", "v"]
[networks]
policy = "policy.npz"
[dynamics]
x = "x + 0.1*v"
v = "0.9*v + 0.1*policy(x, 2*v)[1]"
[noise]
law = "gaussian"
std = 0.01
[initial]
point = [0, 0]
[[stay]]
box = { x = [-1, 1] }
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_network(random_network("tanh"), tmp_path / "policy.npz")
    (tmp_path / "problem.toml").write_text(PROBLEM)
    return tmp_path


def test_a_traced_network_is_one_node_an_output_with_its_derivatives() -> None:
    policy = random_network("tanh", sizes=(2, 64, 64, 2))
    tape = trace(lambda x: [x[0] * policy(x)[0], policy(x[0], x[1])[1]], {"x": ["a", "b"]})
    assert len(tape.nodes) == 5
    point = [0.3, -0.2]
    np.testing.assert_allclose(compile_numpy(tape)(*point), policy(point) * [0.3, 1], rtol=1e-15)
    slopes, step = jacobian(tape), 1e-6
    differences = [(compile_numpy(tape)(*(point + e)) - compile_numpy(tape)(*(point - e))) / (2 * step)
                   for e in step * np.eye(2)]  # fmt: skip
    np.testing.assert_allclose(compile_numpy(slopes)(*point).T, differences, rtol=1e-6, atol=1e-8)
    box = [Interval(np.array([0.2]), np.array([0.4])), Interval(np.array([-0.3]), np.array([-0.1]))]
    assert enclose(slopes, box).contains(compile_numpy(slopes)(*point)).all()
    second = jacobian(slopes)
    assert enclose(second, box).contains(compile_numpy(second)(*point)).all()


def test_second_derivatives_of_a_network_with_kinks_are_refused_where_these_lie() -> None:
    policy = cb.network([{"weights": [[1.0]], "activation": "relu"}])
    second = jacobian(jacobian(trace(lambda x: [policy(x)[0] ** 2], {"x": ["a"]})))
    wide, right = [Interval(np.array([-1.0]), np.array([1.0]))], [Interval(np.array([1.0]), np.array([2.0]))]
    assert np.isinf(enclose(second, wide, undefined="infinite").hi).all()
    assert enclose(second, right).contains([[[2.0]]]).all()


@pytest.mark.parametrize("activation", ["tanh", "sigmoid", "softplus", "elu", "sin", "relu", "leaky_relu", "clip"])
def test_kernels_and_casadi_compute_the_network(activation: str) -> None:
    policy = random_network(activation)
    tape = trace(lambda a, b: [policy(a[0], b[0])[1]], {"a": ["a"], "b": ["b"]})
    for point in ((0.3, -0.4), (-2.0, 1.5)):
        np.testing.assert_allclose(run(tape, *point), policy(*point)[1], rtol=1e-13)
        np.testing.assert_allclose(float(to_casadi(tape, point)), policy(*point)[1], rtol=1e-13)


def test_a_derivative_of_a_network_has_no_kernel() -> None:
    policy = random_network("tanh")
    tape = jacobian(trace(lambda x: [policy(x)[0]], {"x": ["a", "b"]}))
    with pytest.raises(ValueError, match="has no kernel"):
        function_source("drift", tape, ["a", "b"], Parameters())


def test_a_problem_file_calls_its_networks_and_is_written_with_them(folder: Path) -> None:
    problem = cb.load(folder / "problem.toml")
    policy = cb.network(folder / "policy.npz")
    step = compile_numpy(problem.closed_loop)
    np.testing.assert_allclose(step(0, 0.1, 0.2), [0.12, 0.9 * 0.2 + 0.1 * policy(0.1, 0.4)[1]], rtol=1e-15)
    other = folder / "other"
    other.mkdir()
    cb.save(problem, other / "again.toml")
    again = cb.load(other / "again.toml")
    np.testing.assert_array_equal(compile_numpy(again.closed_loop)(0, 0.1, 0.2), step(0, 0.1, 0.2))


def test_a_python_model_is_written_with_its_network(tmp_path: Path) -> None:
    policy = random_network("relu")
    system = cb.DiscreteSystem(lambda x: [x[1], policy(x)[0]], states=["a", "b"], noise=cb.Gaussian(std=0.1))
    problem = cb.Problem(system, initial=[0, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=3)
    cb.save(problem, tmp_path / "model.toml")
    assert (tmp_path / "model.policy.npz").exists()
    loaded = compile_numpy(cb.load(tmp_path / "model.toml").closed_loop)
    np.testing.assert_array_equal(loaded(0, 0.3, -0.2), compile_numpy(problem.closed_loop)(0, 0.3, -0.2))


@pytest.mark.parametrize(("text", "words"), [
    ("policy(x)[1]", "takes 2 arguments, got 1"), ("policy(x, v)", r"policy\(\.\.\.\)\[k\]"),
    ("policy(x, v)[2]", "k from 0 to 1"), ("polcy(x, v)[0]", "policy"), ("x[0]", "indexing does not exist"),
    ("policy(x, v)[x]", "k from 0 to 1"), ("policy(x, v)[0][0]", "indexing does not exist"),
])  # fmt: skip
def test_wrong_calls_say_what_is_right(folder: Path, text: str, words: str) -> None:
    (folder / "problem.toml").write_text(PROBLEM.replace("policy(x, 2*v)[1]", text))
    with pytest.raises(ValueError, match=words):
        cb.load(folder / "problem.toml")


@pytest.mark.parametrize("file", ["/etc/policy.npz", "../policy.npz"])
def test_networks_lie_in_the_folder_of_the_problem(folder: Path, file: str) -> None:
    (folder / "problem.toml").write_text(PROBLEM.replace("policy.npz", file))
    with pytest.raises(ValueError, match=r"`networks\.policy` must be a file in the problem file's folder"):
        cb.load(folder / "problem.toml")


@pytest.mark.parametrize("activation", ["leaky_relu", "clip", "tanh"])
def test_json_and_npz_hold_the_same_network(tmp_path: Path, activation: str) -> None:
    rows = random_layers(activation)
    plain = [{key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in row.items()}
             for row in rows]  # fmt: skip
    (tmp_path / "a.json").write_text(json.dumps({"layers": plain}))
    (tmp_path / "b.json").write_text(json.dumps(plain))
    write_network(cb.network(rows), tmp_path / "a.npz")
    point = [0.2, 0.7]
    for name in ("a.json", "b.json", "a.npz"):
        np.testing.assert_array_equal(cb.network(tmp_path / name)(point), cb.network(rows)(point))


@pytest.mark.parametrize(("rows", "words"), [
    ([], "1 to 32 layers"), ([{"bias": [1]}], "with `weights`"), ([{"weights": [[1]], "activation": "gelu"}], "one of"),
    ([{"weights": [[1, 2]]}, {"weights": [[1, 2]]}], "take what the one before gives"),
    ([{"weights": [[np.inf]]}], "finite"), ([{"weights": [[1]], "wieghts": 2}], "weights"),
    ([{"weights": [[1]], "activation": "clip", "low": 1}], "must give 'high'"), ([{"weights": [1]}], "matrix"),
    ([{"weights": [["a"]]}], "numbers"), ("tanh", "must end in"),
    ([{"weights": [[1]], "bias": [1, 2]}], "as many rows"),
    ([{"weights": [[1]], "activation": "clip", "low": 1, "high": 0}], "at most the upper"), ({}, "list of layers"),
])  # fmt: skip
def test_what_is_no_network_is_refused_in_words(rows: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        cb.network(rows)


def test_files_that_are_none_are_refused(tmp_path: Path) -> None:
    for name in ("a.npz", "a.json"):
        (tmp_path / name).write_bytes(b"\x80 no network")
        with pytest.raises(ValueError, match="must be a"):
            cb.network(tmp_path / name)
    np.savez(tmp_path / "b.npz", activations=np.array([object()], dtype=object))
    with pytest.raises(ValueError, match="plain arrays"):
        cb.network(tmp_path / "b.npz")
    np.savez(tmp_path / "c.npz", activations=["tanh"], weights_0=np.eye(2), more=np.eye(2))
    with pytest.raises(ValueError, match="more besides"):
        cb.network(tmp_path / "c.npz")
    with pytest.raises(ValueError, match="must be a readable file"):
        cb.network(tmp_path / "missing.npz")
    with pytest.raises(ValueError, match=r"must end in \.npz"):
        write_network(random_network("tanh"), tmp_path / "a.onnx")


def test_a_pickled_model_is_the_same_function() -> None:
    policy = random_network("relu")
    tape = trace(lambda x: list(policy(x)), {"x": ["a", "b"]})
    copy = pickle.loads(pickle.dumps(tape))
    assert copy.nodes[2].part.network is copy.nodes[3].part.network
    np.testing.assert_array_equal(compile_numpy(copy)(0.1, 0.2), compile_numpy(tape)(0.1, 0.2))


def test_a_network_is_a_plan_of_all_states_as_it_is() -> None:
    policy = cb.network(random_layers("tanh"))
    system = cb.ContinuousSystem(
        lambda x, u: [x[1] + u[0], u[1]], states=["a", "b"], inputs=cb.Box([-9, -9], [9, 9]), diffusion=0.1 * np.eye(2)
    )
    safe = [cb.Inside(cb.Box([-1, -1], [1, 1]))]
    for hold in (None, 0.5):
        same = [
            cb.Problem(system, initial=[0, 0], safe=safe, horizon=1, plan=plan, hold=hold)
            for plan in (policy, lambda x: policy(x))
        ]
        tapes = [problem.plan if hold else problem.closed_loop for problem in same]
        assert tapes[0].nodes == tapes[1].nodes


def test_a_network_is_called_on_vectors_and_batches() -> None:
    policy = random_network("tanh", sizes=(3, 4, 2))
    points = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_allclose(policy(points), np.stack([policy(*point) for point in points]), rtol=1e-14)
    assert repr(policy) == "<network policy: 3 -> 4 -> 2 (tanh, linear)>"
    with pytest.raises(ValueError, match="takes 3 numbers, got 2"):
        policy(points[:, :2])
    assert set(CONSTANTS) == {"leaky_relu", "clip"}
