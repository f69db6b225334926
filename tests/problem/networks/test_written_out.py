"""A network that a model writes out in NumPy is what `cb.network` makes of its layers: bounds, runs, certificates."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.checker import check_data, parse
from certbound.problem.model import jacobian
from certbound.problem.model.networks_found import written_layers
from certbound.safety.certificate import problem_data

RNG = np.random.default_rng(0)
WIDTH = 16
W1, W2, W3 = RNG.normal(size=(WIDTH, 2)), RNG.normal(size=(WIDTH, WIDTH)) / 4, RNG.normal(size=(1, WIDTH)) / 4
B1, B2, B3 = RNG.normal(size=WIDTH) / 4, RNG.normal(size=WIDTH) / 4, RNG.normal(size=1) / 4
FUNCTIONS: dict[str, Callable[[Any], Any]] = {
    "tanh": np.tanh, "relu": lambda v: np.maximum(0, v), "sigmoid": lambda v: 1 / (1 + np.exp(-v)),
}  # fmt: skip


def written(activation: str) -> Callable[[Any], Any]:
    f = FUNCTIONS[activation]
    return lambda z: W3 @ f(W2 @ f(W1 @ z + B1) + B2) + B3


def called(activation: str) -> Callable[[Any], Any]:
    hidden = [{"weights": w, "bias": b, "activation": activation} for w, b in ((W1, B1), (W2, B2))]
    return cb.network([*hidden, {"weights": W3, "bias": B3}])


def loop(policy: Callable[[Any], Any], time: str) -> cb.Problem:
    """A damped oscillator pushed by the network, within a box."""
    def rates(x: Any) -> Any:
        return np.array([x[1], -3 * x[0] - x[1] + 0.5 * np.clip(policy(x)[0], -3, 3)])

    safe = [cb.Inside(cb.Box([-0.5, -0.9], [0.5, 0.9]))]
    start = cb.Box([0.05, -0.01], [0.06, 0.01])
    if time == "continuous":
        system: Any = cb.ContinuousSystem(rates, states=["x", "v"], diffusion=np.diag([0.003, 0.03]))
        return cb.Problem(system, initial=start, safe=safe, horizon=1.0, delta=1e-3)
    system = cb.DiscreteSystem(
        lambda x: x + 0.1 * rates(x), states=["x", "v"], noise=cb.Gaussian(std=[0.001, 0.01])
    )
    return cb.Problem(system, initial=start, safe=safe, horizon=10, delta=1e-3)


@pytest.mark.parametrize("time", ["discrete", "continuous"])
@pytest.mark.parametrize("activation", FUNCTIONS)
def test_the_tape_is_that_of_the_called_network(activation: str, time: str) -> None:
    own, other = loop(written(activation), time), loop(called(activation), time)
    assert [(node.op, node.args) for node in own.closed_loop.nodes] == [
        (node.op, node.args) for node in other.closed_loop.nodes
    ]
    first, second = (
        next(node.part.network for node in problem.closed_loop.nodes if node.part) for problem in (own, other)
    )
    assert [(x.weights, x.bias, x.activation) for x in first.layers] == [
        (x.weights, x.bias, x.activation) for x in second.layers
    ]


@pytest.mark.parametrize(("activation", "time"), [("tanh", "discrete"), ("relu", "discrete"), ("tanh", "continuous")])
def test_bounds_runs_and_certificates_agree(activation: str, time: str) -> None:
    own, other = loop(written(activation), time), loop(called(activation), time)
    verdicts = [cb.verify_safety(problem, method="linear") for problem in (own, other)]
    assert verdicts[0].log10_delta == pytest.approx(verdicts[1].log10_delta, rel=1e-9)
    assert verdicts[0].status == "SAFE"
    paths = [cb.sample_paths(problem, paths=20, rng=np.random.default_rng(3)) for problem in (own, other)]
    np.testing.assert_allclose(paths[0], paths[1], rtol=1e-12, atol=1e-14)
    text = verdicts[0].certificate_text(own)
    assert '"network"' in text
    assert problem_data(own) == problem_data(other)  # so that it speaks of both
    assert check_data(parse(text), problem_data(own)).valid


def test_bounds_agree_with_those_of_the_single_operations(monkeypatch: pytest.MonkeyPatch) -> None:
    own = loop(written("tanh"), "discrete")
    monkeypatch.setattr(written_layers, "LEAST_WEIGHTS", 10**9)
    scalar = loop(written("tanh"), "discrete")
    assert len(scalar.closed_loop.nodes) > 600
    bounds = [cb.verify_safety(problem, method="linear").log10_delta for problem in (own, scalar)]
    assert bounds[0] == pytest.approx(bounds[1], rel=1e-3)
    paths = [cb.sample_paths(problem, paths=20, rng=np.random.default_rng(3)) for problem in (own, scalar)]
    np.testing.assert_allclose(paths[0], paths[1], rtol=1e-12, atol=1e-14)


def test_work_does_not_grow_with_the_weights() -> None:
    """One operation an output and one a derivative, however wide the layers are."""
    rng, counts = np.random.default_rng(1), []
    for width in (16, 64):
        w1, w2, w3 = rng.normal(size=(width, 2)), rng.normal(size=(width, width)), rng.normal(size=(1, width))
        problem = loop(lambda z, w1=w1, w2=w2, w3=w3: w3 @ np.tanh(w2 @ np.tanh(w1 @ z)), "discrete")
        counts.append((len(problem.closed_loop.nodes), len(jacobian(problem.closed_loop).nodes)))
    assert counts[0] == counts[1]
    assert max(counts[0]) < 60
