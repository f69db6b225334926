"""Policies in the loop: proved, simulated, certified, and refused when a bit of a weight is another."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.checker import check_data
from certbound.safety.certificate import problem_data
from tests.checker.conftest import coarsely
from tests.networks import random_layers


@pytest.fixture(autouse=True)
def short() -> Iterator[None]:
    with coarsely():
        yield


def problem_of(rows: Any, time: str = "discrete") -> cb.Problem:
    policy = cb.network(rows, name="policy")
    start, safe = cb.Box([0.05, -0.05], [0.1, 0.05]), [cb.Inside(cb.Box([-0.5, -0.6], [0.5, 0.6]))]
    if time == "continuous":
        plant: Any = cb.ContinuousSystem(
            lambda x: [x[1], -x[0] - x[1] + 0.2 * policy(x)[0]], states=["x", "v"], diffusion=0.02 * np.eye(2)
        )
        return cb.Problem(plant, initial=start, safe=safe, horizon=0.2)
    plant = cb.DiscreteSystem(
        lambda x: [x[0] + 0.1 * x[1], 0.8 * x[1] - 0.3 * x[0] + 0.1 * policy(x)[0]], states=["x", "v"],
        noise=cb.Gaussian(std=0.01),
    )
    return cb.Problem(plant, initial=start, safe=safe, horizon=4)


@lru_cache
def proved(activation: str, time: str = "discrete") -> tuple[cb.Problem, cb.Verdict]:
    problem = problem_of(random_layers(activation, sizes=(2, 6, 6, 1), scale=1.0), time)
    return problem, cb.verify_safety(problem, method="linear")


cases = pytest.mark.parametrize(
    ("activation", "time"), [("tanh", "discrete"), ("relu", "discrete"), ("tanh", "continuous"), ("relu", "continuous")]
)


@cases
def test_a_policy_is_proved_and_its_certificate_checked(activation: str, time: str) -> None:
    problem, verdict = proved(activation, time)
    assert verdict.status == "SAFE"
    data = json.loads(json.dumps(verdict.certificate))
    assert check_data(data, problem_data(problem)).valid
    assert len(data["problem"]["dynamics"]["networks"]) == 1


def test_simulation_leaves_no_more_often_than_the_bound() -> None:
    problem, verdict = proved("relu")
    found = cb.simulate_exits(problem, paths=2000, rng=np.random.default_rng(0), halve=False)
    assert found.lower <= 10**verdict.log10_delta


def test_a_bit_of_a_weight_makes_another_problem() -> None:
    _problem, verdict = proved("tanh")
    rows = random_layers("tanh", sizes=(2, 6, 6, 1), scale=1.0)
    rows[1]["weights"][2, 3] = np.nextafter(rows[1]["weights"][2, 3], np.inf)
    data = json.loads(json.dumps(verdict.certificate))
    report = check_data(data, problem_data(problem_of(rows)))
    assert not report.valid
    assert "another function" in report.reason


def test_a_certificate_for_smaller_weights_is_refuted() -> None:
    """The proof's numbers with weights ten times as large: the remainder does not stay in its boxes."""
    _, verdict = proved("tanh")
    data = json.loads(json.dumps(verdict.certificate))
    layer = data["problem"]["dynamics"]["networks"][0][0]
    layer["weights"] = [[(10 * float.fromhex(x)).hex() for x in row] for row in layer["weights"]]
    assert not check_data(data).valid


@pytest.mark.parametrize("change", [
    lambda net: net[0].update(activation="gelu"), lambda net: net[0].update(bias=[]), lambda net: net.clear(),
    lambda net: net[1]["weights"].pop(), lambda net: net[0].update(more=1),
])  # fmt: skip
def test_a_malformed_network_is_refused(change: Any) -> None:
    data = json.loads(json.dumps(proved("tanh")[1].certificate))
    change(data["problem"]["dynamics"]["networks"][0])
    with pytest.raises(cb.CertificateError, match="networks"):
        check_data(data)
