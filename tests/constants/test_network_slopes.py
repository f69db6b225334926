"""Constants of loops with a network from its activations' slopes: sound, and known where intervals know nothing."""

from __future__ import annotations

import numpy as np
import pytest

import certbound as cb
from certbound.constants.model_data import model_of
from certbound.constants.network_slopes import bound_by_slopes
from certbound.errors import CertificateError
from certbound.problem.networks import NetworkFunction
from certbound.problem.systems import System
from certbound.safety.certificate import certificate_data


def policy(states: int, width: int, activation: str = "tanh", last: str = "linear", seed: int = 0) -> NetworkFunction:
    rng = np.random.default_rng(seed)
    first = {"weights": rng.normal(size=(width, states)), "bias": rng.normal(size=width) / 3, "activation": activation}
    second = {"weights": rng.normal(size=(1, width)) / np.sqrt(width), "bias": [0.1], "activation": last}
    return cb.network([first, second | ({"low": -0.5, "high": 0.5} if last == "clip" else {})])


def loop(law: NetworkFunction, *, continuous: bool, bent: bool = False) -> System:
    a, b = np.array([[-1.0, 0.5], [-0.5, -1.5]]), np.array([0.3, 0.4])

    def flow(x: np.ndarray) -> np.ndarray:
        pushed = [0.2 * np.sin(x[0]), 0.0] if bent else [0.0, 0.0]
        return a @ x + b * law(x)[0] + np.array(pushed)

    if continuous:
        return cb.ContinuousSystem(flow, states=2, diffusion=0.1 * np.eye(2))
    return cb.DiscreteSystem(lambda x: x + 0.2 * flow(x), states=2, noise=cb.Gaussian(std=0.1))


@pytest.mark.parametrize("continuous", [True, False])
@pytest.mark.parametrize(("activation", "last"), [("tanh", "linear"), ("relu", "linear"), ("tanh", "clip")])
def test_no_two_points_move_apart_faster(continuous: bool, activation: str, last: str) -> None:
    system = loop(policy(2, 6, activation, last), continuous=continuous, bent=True)
    metric = np.array([[2.0, 0.4], [0.4, 1.0]])
    for domain, size in ((None, 20.0), (cb.Box([-0.3, -0.3], [0.3, 0.3]), 0.3)):
        bound = bound_by_slopes(model_of(system, domain, 1.0), metric)
        assert np.isfinite(bound)
        rng = np.random.default_rng(1)
        x, step = rng.uniform(-size, size, (2000, 2)), rng.normal(size=(2000, 2)) * 1e-4
        y = np.clip(x + step, -size, size)
        apart, moved = y - x, _value(system, y) - _value(system, x)
        square = np.einsum("mi,ij,mj->m", apart, metric, apart)
        if continuous:
            seen = np.einsum("mi,ij,mj->m", apart, metric, moved) / square
        else:
            seen = np.sqrt(np.einsum("mi,ij,mj->m", moved, metric, moved) / square)
        assert seen.max() <= bound + 1e-6
        assert bound <= seen.max() + (1.0 if continuous else 0.3)


def _value(system: System, x: np.ndarray) -> np.ndarray:
    from certbound.problem.model import compile_numpy

    return np.asarray(compile_numpy(system.dynamics)(0.0, *x.T)).reshape(len(x), -1)


def test_a_linear_loop_of_one_layer_has_its_own_measure() -> None:
    law = cb.network([{"weights": [[1.0], [-1.0]], "activation": "tanh"}, {"weights": [[1.0, -1.0]]}])
    system = cb.ContinuousSystem(lambda x: -3 * x + law(x), states=1, diffusion=0.1)
    assert bound_by_slopes(model_of(system, None, 1.0), None) == pytest.approx(-1.0, abs=1e-4)  # slopes 0 to 2


def test_derive_answers_on_all_states_where_intervals_do_not() -> None:
    system = loop(policy(2, 6), continuous=True)
    found = cb.bound_constants(system, metric="euclidean", budget=500)
    assert found.certified
    assert found.rate == pytest.approx(bound_by_slopes(model_of(system, None, None), None))


def test_no_certificate_states_it() -> None:
    problem = cb.Problem(
        loop(policy(2, 6), continuous=True), initial=[0.1, 0], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=2
    )
    verdict = cb.verify_safety(problem, method="constants")
    assert verdict.status == "SAFE"
    with pytest.raises(CertificateError, match="bounds by the slopes of a network's activations are not stated"):
        certificate_data(problem, verdict)


def test_what_it_does_not_serve_has_no_bound() -> None:
    one, other = policy(2, 6), policy(2, 6, seed=1)
    plain = cb.ContinuousSystem(lambda x: -x + np.tanh(x), states=2, diffusion=0.1 * np.eye(2))
    two = cb.ContinuousSystem(lambda x: -x + one(x)[0] + other(x)[0], states=2, diffusion=0.1 * np.eye(2))
    bent = cb.ContinuousSystem(lambda x: -x + one(x**2)[0], states=2, diffusion=0.1 * np.eye(2))
    wide = cb.ContinuousSystem(lambda x: -x + policy(2, 70)(x)[0], states=2, diffusion=0.1 * np.eye(2))
    squared = cb.ContinuousSystem(lambda x: -x + one(x)[0] ** 2, states=2, diffusion=0.1 * np.eye(2))
    for system in (plain, two, bent, wide, squared):
        assert bound_by_slopes(model_of(system, None, 1.0), None) == np.inf
