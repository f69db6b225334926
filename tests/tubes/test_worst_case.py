"""The worst case over g g^T <= sigma^2 I, tr <= nu sigma^2: a second solver of its equation, and what it changes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from certbound.tubes.constants import Constants
from certbound.tubes.exact.first_passage import bound_worst_exit
from certbound.tubes.tuning import bound_exit_probability, tune_tube
from tests.tubes.yardstick import estimate_radius


def dynamic_programming(rate, n, nu, radius, horizon, cells=120):
    """P(exit) by the explicit upwind scheme in s, the best of rho in {0, nu - n + 1, 1} at every cell.

    The scheme is monotone, so that it tends to the value function.
    """
    h = radius / cells
    s = np.arange(cells + 1) * h
    step = 0.3 * h * h
    count = math.ceil(horizon / step)
    step = horizon / count
    u = np.zeros(cells + 1)
    u[-1] = 1.0
    controls = sorted({0.0, min(max(nu - n + 1, 0.0), 1.0), min(1.0, nu)})
    for _ in range(count):
        bend = (u[2:] - 2 * u[1:-1] + u[:-2]) / h**2
        up, down = (u[2:] - u[1:-1]) / h, (u[1:-1] - u[:-2]) / h
        best = np.full(cells - 1, -np.inf)
        for rho in controls:
            drift = rate * s[1:-1] + 0.5 * min(nu - rho, n - 1) / s[1:-1]
            best = np.maximum(best, 0.5 * rho * bend + np.where(drift > 0, drift * up, drift * down))
        # at the centre u_ss = u_s/s: the generator is at most (nu/2) u_ss there
        centre = 0.5 * min(nu, n) * 2 * (u[1] - u[0]) / h**2
        u[1:-1] += step * best
        u[0] += step * max(0.0, centre)
        u = np.minimum(u, 1.0)
    return float(u[0])


@pytest.mark.parametrize(
    ("rate", "n", "nu", "radius"), [(-0.5, 3, 3.0, 3.0), pytest.param(0.0, 2, 1.3, 2.8, marks=pytest.mark.slow)]
)
def test_the_bound_agrees_with_dynamic_programming(rate, n, nu, radius):
    constants = Constants(rate=rate, sigma=1.0, dimension=n, effective_dimension=nu)
    coarse, fine = (dynamic_programming(rate, n, nu, radius, 1.0, cells) for cells in (60, 120))
    truth = 2 * fine - coarse  # the scheme is of first order
    got = bound_worst_exit(constants, horizon=1.0, radius=radius, target=truth)
    assert 0.97 * truth < got < 1.1 * truth


@pytest.mark.parametrize("rate", [0.0, pytest.param(1.0, marks=pytest.mark.slow)])
def test_in_one_dimension_without_contraction_it_is_the_scaled_tube_of_full_noise(rate):
    # beyond R e^{-c (T - t)} no noise leaves for sure; inside the value is convex, so that full noise is best
    constants = Constants(rate=rate, sigma=1.0, dimension=1)
    variance = 1.0 if rate == 0 else math.expm1(2 * rate) / (2 * rate)
    k = 2 * np.arange(200) + 1
    series = 4 / np.pi * (-1.0) ** np.arange(200) / k * np.exp(-((k * np.pi / 4.0) ** 2) * variance / 8)
    truth = 1 - float(series.sum())
    got = bound_worst_exit(constants, horizon=1.0, radius=4.0, target=truth)
    assert truth < got < 1.14 * truth  # the slope in the radius is R^2: under one percent of it


@pytest.mark.slow
def test_smaller_noise_in_some_states_doubles_the_probability_under_expansion():
    # the constant radius of level .01 for noise exactly sigma at c = 1, T = 2 is left with probability .0196
    constants = Constants(rate=1.0, sigma=1.0, dimension=1, isotropic=True)
    radius = estimate_radius(constants, horizon=2.0, delta=0.01, cells=4000)
    worst = bound_worst_exit(constants, horizon=2.0, radius=radius, target=0.02)
    assert 0.0192 < worst < 0.0205


@pytest.mark.slow
def test_it_is_far_below_the_kummer_level_under_expansion():
    constants = Constants(rate=1.0, sigma=1.0, dimension=1)
    tube = tune_tube(constants, horizon=2.0, delta=0.0087, objective="max")
    worst = bound_worst_exit(constants, horizon=2.0, radius=tube.maximum, target=2e-3)
    assert 10 ** bound_exit_probability(constants, horizon=2.0, clearance=tube.maximum) > 2 * worst


@pytest.mark.slow
def test_more_freedom_is_never_safer():
    base = Constants(rate=-0.5, sigma=1.0, dimension=3, effective_dimension=1.4)
    levels = [
        bound_worst_exit(constants, horizon=1.0, radius=3.0, target=1e-3)
        for constants in (base, replace(base, effective_dimension=2.2), replace(base, effective_dimension=3.0))
    ]
    assert levels[0] < levels[1] < levels[2]


def test_a_radius_that_expansion_reaches_for_sure_has_level_one():
    constants = Constants(rate=1.0, sigma=1.0, dimension=3)
    assert bound_worst_exit(constants, horizon=3.0, radius=1.0) == 1.0


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "n"), [(0.0, 1), (0.0, 3), (0.0, 6), (-0.5, 1), (-0.5, 3)])
def test_the_worst_case_tube_is_within_one_percent_of_its_own_limit(rate, n):
    constants = Constants(rate=rate, sigma=1.0, dimension=n)
    tube = tune_tube(constants, horizon=1.0, delta=1e-2, method="worst_case")
    low, high = 0.9 * tube.maximum, tube.maximum
    for _ in range(8):
        middle = (low + high) / 2
        coarse, fine = (dynamic_programming(rate, n, float(n), middle, 1.0, cells) for cells in (50, 100))
        low, high = (middle, high) if 2 * fine - coarse > 1e-2 else (low, middle)
    assert tube.maximum < 1.01 * high


@pytest.mark.slow
def test_the_gain_over_the_bessel_tube_without_drift():
    for n, gain in ((1, 0.107), (3, 0.073)):
        constants = Constants(rate=0.0, sigma=1.0, dimension=n)
        bessel = tune_tube(constants, horizon=1.0, delta=1e-3, method="bessel").maximum
        worst = tune_tube(constants, horizon=1.0, delta=1e-3, method="worst_case").maximum
        assert 1 - worst / bessel == pytest.approx(gain, abs=0.012)
