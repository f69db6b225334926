"""Infinite horizons that every path fails in the end."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

import certbound as cb
from certbound.safety.engines import values_engine
from certbound.values.continuous import leaves_surely

_BOX = cb.Inside(cb.Box([-1.0, -1.0], [1.0, 1.0]))
_STRIP = cb.Inside(cb.Box([-1.0], [1.0], coordinates=[0]))


def _endless(drift, gain, safe=(_BOX,), *, states=2, **more) -> cb.Problem:
    pushed = {"disturbance": more.pop("disturbance")} if "disturbance" in more else {}
    system = cb.ContinuousSystem(drift, states=states, diffusion=gain, **pushed)
    return cb.Problem(system, initial=np.zeros(states), safe=list(safe), horizon=math.inf, **more)


def test_the_mean_time_is_bounded_by_the_formula_and_holds_of_brownian_motion() -> None:
    found = leaves_surely(_endless(lambda x: 0 * x, 1.0, [cb.Inside(cb.Box([-1.0], [1.0]))], states=1))
    assert found is not None
    assert found.mean == pytest.approx(2 * 2 * (math.e - 1) / 0.5, rel=1e-6)
    assert found.mean >= 1.0


def test_the_drift_counts_from_the_side_that_helps() -> None:
    problem = _endless(lambda x, d: [x[1], d[0] - 3 + x[1]], [[0.0], [0.5]], disturbance=cb.Box([-0.5], [0.25]))
    found = leaves_surely(problem)
    assert found is not None
    assert (found.state, found.mirrored, found.drift) == (1, True, 0.0)


@pytest.mark.parametrize(
    "problem",
    [
        _endless(lambda x: -x, lambda x: [[x[0], 0.0], [0.0, 0.0]]),
        _endless(lambda t, x: [-t * x[0], 0 * x[1]], [[0.5], [0.0]]),
        _endless(lambda x: [x[1], -x[1]], [[0.0], [0.5]], [_STRIP]),
        _endless(lambda x: -x, 0.5 * np.eye(2), [cb.Inside(cb.HalfSpace([1.0, 0.0], 1.0))]),
        _endless(lambda x: -x, 0.5 * np.eye(2), reach=cb.Box([-0.8] * 2, [-0.6] * 2)),
        _endless(lambda x: -x, 0.5 * np.eye(2), [], domain=_BOX.region, leaving="ends"),
        _endless(lambda x: [0 * x[0], 1 + x[1] ** 2], [[0.1], [0.0]], [_STRIP]),
        _endless(lambda x: [0 * x[0], 1 + np.floor(x[1]) ** 2], [[0.1], [0.0]], [_STRIP]),
    ],
    ids=["noise that vanishes", "a clock", "no noise", "one side", "a target", "ends", "runs off", "jumps off"],
)
def test_where_paths_may_stay_nothing_is_said(problem: cb.Problem) -> None:
    assert leaves_surely(problem) is None


def test_a_state_without_limits_may_grow_as_fast_as_a_lipschitz_model_makes_it() -> None:
    found = leaves_surely(_endless(lambda x: [0 * x[0], 1 + 3 * x[1]], lambda x: [[0.1], [0.2 * x[1]]], [_STRIP]))
    assert found is not None
    assert found.state == 0


def test_a_step_of_normal_noise_leads_out_with_a_probability_that_has_a_bound() -> None:
    noise = cb.Gaussian(covariance=[[0.04, 0.01, 0.0], [0.01, 0.09, 0.0], [0.0, 0.0, 0.0]])
    system = cb.DiscreteSystem(lambda x: [0.5 * x[0], x[2], 0.9 * x[1]], states=3, noise=noise)
    safe = [cb.Inside(cb.Box([-1.0] * 3, [1.0, 0.2, 1.0]))]
    problem = cb.Problem(system, initial=[0.0] * 3, safe=safe, horizon=math.inf)
    found = leaves_surely(problem)
    assert found is not None
    assert (found.state, found.mirrored) == (1, False)
    assert found.mean == pytest.approx(1 / stats.norm.sf((0.2 + 1) / 0.3), rel=1e-6)
    bounded = cb.DiscreteSystem(lambda x: 0.5 * x, states=3, noise=cb.Uniform(halfwidth=0.1))
    assert leaves_surely(problem.replace(system=bounded)) is None


@pytest.mark.parametrize("dimension", [2, 5])
def test_the_engine_says_that_failing_is_certain(dimension: int) -> None:
    found = values_engine(cb.load("ou", dimension=dimension).replace(horizon=math.inf))
    assert (found.log10_delta, found.log10_lower) == (0.0, 0.0)
    assert "every path leaves in the end" in found.reason
