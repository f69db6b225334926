"""Lipschitz constants of networks: proved, close to what the semidefinite program finds, never below a difference."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.constants import bound_network_gain
from certbound.constants.network_gains import NetworkGain
from certbound.errors import CertificateError
from tests.networks import random_network

KINDS = ["tanh", "relu", "leaky_relu", "sigmoid", "sin", "clip", "linear"]


def steepest(policy: Any, inputs: int) -> float:
    """The largest norm of a difference quotient between near points."""
    rng = np.random.default_rng(0)
    points, steps = rng.normal(size=(4000, inputs)), rng.normal(size=(4000, inputs))
    steps *= 1e-5 / np.linalg.norm(steps, axis=1, keepdims=True)
    return float(np.max(np.linalg.norm(policy(points + steps) - policy(points), axis=1)) / 1e-5)


def check(policy: Any, inputs: int) -> NetworkGain:
    found = bound_network_gain(policy)
    norms = [np.linalg.norm(layer.weights, 2) for layer in policy.data.layers]
    assert steepest(policy, inputs) * (1 - 1e-6) <= found.gain <= 1.01 * np.prod(norms)
    assert found.proposed * 0.9999 <= found.gain <= 1.01 * found.proposed
    return found


@pytest.mark.parametrize("kind", KINDS)
def test_a_gain_lies_between_what_is_seen_and_the_product_of_the_norms(kind: str) -> None:
    check(random_network(kind, 3, sizes=(2, 5, 5, 2)), 2)


def test_a_linear_map_has_its_norm() -> None:
    matrix = np.array([[3.0, 1.0], [0.0, -2.0]])
    found = bound_network_gain(cb.network([{"weights": matrix}]))
    assert np.linalg.norm(matrix, 2) <= found.gain <= np.linalg.norm(matrix, 2) * (1 + 1e-4)


def test_a_network_of_opposite_neurons_is_far_below_its_norms() -> None:
    """tanh(x) - tanh(x) = 0 has norms of product 2; one multiplier a neuron sees slopes of one neuron only."""
    two = cb.network([{"weights": [[1.0], [1.0]], "activation": "tanh"}, {"weights": [[1.0, -1.0]]}])
    assert bound_network_gain(two).gain < 1.01


def test_multipliers_that_prove_nothing_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """A solver that lies: half of what is true is never printed."""
    policy = random_network("tanh", 1, sizes=(2, 6, 1))
    honest = bound_network_gain(policy)
    monkeypatch.setattr("certbound.constants.network_gains._proposal", lambda *_: (1e-6, honest.multipliers))
    with pytest.raises(CertificateError, match="were not proved"):
        bound_network_gain(policy)


def test_a_network_that_is_too_large_is_named() -> None:
    with pytest.raises(ValueError, match="at most 200 hidden neurons, got 201"):
        bound_network_gain(random_network("tanh", sizes=(1, 201, 1)))


@pytest.mark.slow
def test_twenty_networks_of_two_layers_of_32() -> None:
    for seed in range(20):
        check(random_network("tanh" if seed % 2 else "relu", seed, sizes=(2, 32, 32, 1)), 2)
