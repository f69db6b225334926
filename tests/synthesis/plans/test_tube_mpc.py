"""The textbook's tube predictive control: a double integrator in bounded noise, with a feedback around the plan."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.checker import check_data, parse

A, B = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.5], [1.0]])


def integrator(initial: Any = (-7.0, -2.0), **signals: Any) -> cb.Problem:
    """|u| <= 1, v <= 2, Q = I and R = .01: the example of Mayne, Seron and Rakovic (2005) from another start."""
    system = cb.linear_system(A, B, inputs=cb.Box([-1], [1]), states=["p", "v"], **signals)
    start = initial if isinstance(initial, cb.Box) else list(initial)
    safe = [cb.Inside(cb.Box([-50.0, -50.0], [50.0, 2.0]))]
    return cb.Problem(system, initial=start, safe=safe, horizon=9, delta=1e-3, cost=(np.eye(2), [[0.01]]))


def reach(gain: Any, steps: int, halfwidth: float) -> np.ndarray:
    """What |K e_k| is at most for e+ = (A + B K) e + w: sums of |K (A + B K)^i| h."""
    rows = [np.abs(gain @ np.linalg.matrix_power(A + B @ gain, i)).sum() * halfwidth for i in range(steps)]
    return np.concatenate([[0.0], np.cumsum(rows)])


@pytest.mark.parametrize("signals", [
    {"noise": cb.Bounded(halfwidth=0.15)}, {"noise": cb.Uniform(halfwidth=0.15)},
    {"E": np.eye(2), "disturbance": cb.Box([-0.15] * 2, [0.15] * 2), "time": "discrete"},
], ids=["bounded noise", "uniform noise", "a disturbance"])  # fmt: skip
def test_it_has_a_plan_whose_inputs_leave_the_reach_of_the_error(signals: Any) -> None:
    found = cb.synthesize_plan(integrator(**signals), feedback="riccati")
    assert found.feasible
    assert found.status == "SAFE"
    assert found.log10_delta < -1e11
    taken = reach(found.feedback, 9, 0.15)[:-1]
    room = 1 - np.abs(found.inputs[:, 0])
    assert np.all(room >= taken - 1e-6)
    assert np.min(room - taken) < 1e-3  # and no more than that
    assert "no noise that there can be" in found.reason
    assert check_data(parse(found.verdict.certificate_text(found.problem))).valid


def test_runs_at_the_corners_of_the_noise_keep_all_limits() -> None:
    found = cb.synthesize_plan(integrator(noise=cb.Bounded(halfwidth=0.15)), feedback="riccati")
    rng, most = np.random.default_rng(0), 0.0
    for _ in range(2000):
        x = np.array([-7.0, -2.0])
        for w in found.plan[:, 0]:
            u = w + float(found.feedback[0] @ x)
            most = max(most, abs(u))
            x = A @ x + B[:, 0] * u + rng.choice([-0.15, 0.15], size=2)
            assert x[1] <= 2
    assert 0.9 < most <= 1


@pytest.mark.parametrize("noise", [cb.Bounded(halfwidth=0.6), cb.SubGaussian(proxy_std=0.15)], ids=["bounded", "any"])
def test_where_the_noise_takes_too_much_the_inputs_are_named_and_no_start_is_blamed(noise: Any) -> None:
    found = cb.synthesize_plan(integrator(noise=noise), method="linear", feedback="riccati")
    assert not found.feasible
    assert found.status == "UNKNOWN"
    assert found.infeasibility.constraint == "inputs within their bounds"
    assert 0 < found.scale < 1
    assert found.softened > 0
    assert found.max_input <= 1


def test_an_initial_set_that_takes_all_of_the_first_input_is_told_so() -> None:
    wide = integrator(cb.Box([-8.0, -2.4], [-6.0, -1.6]), noise=cb.Bounded(halfwidth=0.1))
    with pytest.raises(ValueError, match=r"`feedback` must leave the first input room: .* moves u by 1\.19"):
        cb.synthesize_plan(wide, feedback="riccati")
