"""A random start where an engine serves sets: an ellipsoid that holds nearly all of it."""

from __future__ import annotations

import numpy as np
import pytest

import certbound as cb
from certbound.errors import CertificateError, EngineError
from certbound.safety.certificate import certificate_data
from certbound.safety.engines.random_starts import truncated


def spinning(covariance: np.ndarray, delta: float = 1e-2) -> cb.Problem:
    system = cb.ContinuousSystem(lambda x: [-x[0] - x[1], x[0] - x[1]], states=2, diffusion=0.3 * np.eye(2))
    start = cb.GaussianStart([0.1, 0.0], covariance)
    return cb.Problem(system, initial=start, safe=[cb.Inside(cb.Box([-1.5] * 2, [1.5] * 2))], horizon=1, delta=delta)


@pytest.mark.parametrize(
    ("covariance", "rank"), [([[0.04, 0.01], [0.01, 0.02]], 2), ([[1e-12, 0], [0, 0.04]], 2), ([[0.04, 0.04]] * 2, 1)]
)
def test_what_lies_outside_is_as_rare_as_stated(covariance, rank: int) -> None:
    problem = spinning(np.array(covariance), 0.2)
    inner, outside = truncated(problem)
    points = problem.initial.sample(np.random.default_rng(0), 400_000)
    missed = 1 - np.mean(inner.initial.contains(points))
    assert missed <= outside + 4 * np.sqrt(outside / len(points))
    assert missed >= 0.9 * outside or rank < 2
    assert outside + inner.delta <= problem.delta


def test_near_a_limit_less_of_the_start_is_held_and_more_of_delta_is_spent_on_the_rest() -> None:
    inner, outside = truncated(spinning(0.65**2 * np.eye(2), 0.2))
    assert inner.delta == pytest.approx(0.06)
    assert outside == pytest.approx(0.14, rel=2e-3)
    assert outside < 0.14
    with pytest.raises(EngineError, match="of the random start breaks a constraint at time 0; give"):
        truncated(spinning(0.8**2 * np.eye(2), 0.2))
    verdict = cb.verify_safety(spinning(0.8**2 * np.eye(2), 0.2), method="quadratic")
    assert "failed" not in verdict.reason


def test_a_start_that_is_not_random_after_all_is_a_point() -> None:
    inner, outside = truncated(spinning(np.zeros((2, 2))))
    assert outside == 0
    assert inner.initial.is_point


def test_an_engine_for_sets_bounds_what_simulation_finds_and_no_certificate_says_more() -> None:
    problem = spinning(0.04 * np.eye(2), 0.05)
    verdict = cb.verify_safety(problem, method="quadratic")
    assert verdict.status == "SAFE"
    assert "from an ellipsoid" in verdict.reason
    assert verdict.log10_lower is None
    assert 10**verdict.log10_delta > cb.simulate_exits(problem, paths=20_000, halve=False).lower
    with pytest.raises(CertificateError, match="says of a random one"):
        certificate_data(problem, verdict)


def test_where_disturbances_leave_no_room_a_random_start_is_told_so() -> None:
    """It was told of a defect: a random start has no hull that could be split."""
    system = cb.DiscreteSystem(
        lambda x, d: [0.5 * abs(x[0]) + d[0]], states=1, disturbance=cb.Box([-0.15], [0.15]),
        noise=cb.Gaussian(std=0.2),
    )  # fmt: skip
    passed = cb.Outside(cb.Box([0.25], [0.75]), during=(2, 2))  # which the noise-free tube touches
    problem = cb.Problem(system, initial=cb.GaussianStart([-0.1], [[0.01]]), safe=[passed], horizon=2)
    reason = cb.verify_safety(problem, method="constants").reason
    assert "already leaves no room" in reason
    assert "; try a smaller disturbance" in reason


def test_what_cannot_be_smaller_is_not_asked_to_be() -> None:
    """A neuron at rest: one start, no disturbance; a tube that bursts was told 'short by 4.43e+13'."""
    system = cb.ContinuousSystem(
        lambda v, w: [v - v**3 / 3 - w + 0.2, 0.08 * (v + 0.7 - 0.8 * w)], states=["v", "w"], diffusion=[[0.04], [0]]
    )
    problem = cb.Problem(
        system, initial=[-1.0694, -0.4617], safe=[cb.Inside(cb.HalfSpace([1.0, 0.0], 0.0))], horizon=20.0, delta=0.05
    )
    verdict = cb.verify_safety(problem, method="constants")
    assert verdict.margin is None  # -1e9 says nothing
    assert "much too rough here, which says nothing of the problem" in verdict.reason
    assert "noise at most" not in verdict.reason
    verdict = cb.verify_safety(problem.replace(horizon=50.0), method="constants")
    assert verdict.margin is None
    burst = verdict.reason
    assert "is proved so widely only that it leaves no room for 'v <= 0' at t = 50; try a shorter horizon." in burst
