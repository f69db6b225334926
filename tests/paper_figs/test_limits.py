"""The yardstick agrees with closed forms, with itself, and with what is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import chi, norm

from experiments.limits import _implicit, _spectral, continuous_radius, discrete_radius, exact_radius


def test_one_step_is_the_chi_quantile() -> None:
    assert discrete_radius(0.9, 1, 1, 0.01) == pytest.approx(norm.isf(0.005), rel=1e-6)
    assert discrete_radius(0.9, 3, 1, 0.01) == pytest.approx(chi(3).isf(0.01), rel=1e-6)


def test_brownian_motion_follows_the_reflection_series() -> None:
    radius = continuous_radius(0.0, 1, 1.0, 0.01)
    series = 4 * sum((-1) ** k * norm.sf((2 * k + 1) * radius) for k in range(5))
    assert series == pytest.approx(0.01, rel=2e-4)


def test_the_known_radius_of_the_ornstein_uhlenbeck_process() -> None:
    assert continuous_radius(-0.5, 1, 5.0, 1e-3, math.sqrt(0.1)) == pytest.approx(1.2858, abs=1e-4)


@pytest.mark.parametrize("n", [1, 3, 6])
def test_both_routes_in_continuous_time_agree(n: int) -> None:
    radius = continuous_radius(-0.5, n, 2.0, 1e-2)
    assert _implicit(-0.5, n, 2.0, radius, 1.0) == pytest.approx(_spectral(-0.5, n, 2.0, radius, 1.0), rel=1e-2)


def test_a_fine_chain_tends_to_the_diffusion_from_below() -> None:
    gain, sigma = math.exp(-0.5 * 0.01), math.sqrt(-math.expm1(-0.01))
    chain = discrete_radius(gain, 1, 200, 1e-2, sigma)
    diffusion = continuous_radius(-0.5, 1, 2.0, 1e-2)
    assert 0.93 * diffusion < chain < diffusion


def test_the_radius_grows_with_horizon_and_dimension_and_falls_with_delta() -> None:
    base = {"rate": -1.0, "n": 1, "horizon": 2.0, "delta": 1e-3}
    radius = exact_radius(**base)  # type: ignore[arg-type]
    assert exact_radius(**{**base, "horizon": 4.0}) > radius  # type: ignore[arg-type]
    assert exact_radius(**{**base, "n": 2}) > radius  # type: ignore[arg-type]
    assert exact_radius(**{**base, "delta": 1e-2}) < radius  # type: ignore[arg-type]


@pytest.mark.parametrize("n", [2, 30])
def test_simulated_norms_leave_as_often_as_asked(n: int) -> None:
    rate, horizon, steps, paths, delta = -0.5, 2.0, 400, 4000, 0.1
    radius = continuous_radius(rate, n, horizon, delta)
    growth, spread = math.exp(rate * horizon / steps), math.sqrt(-math.expm1(2 * rate * horizon / steps))
    rng = np.random.default_rng(n)
    state, top = np.zeros((paths, n)), np.zeros(paths)
    for _ in range(steps):
        state = growth * state + spread * rng.standard_normal((paths, n))
        top = np.maximum(top, np.linalg.norm(state, axis=1))
    assert 0.06 < np.mean(top > radius) < 0.12
