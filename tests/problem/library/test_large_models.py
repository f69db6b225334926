"""Models with many states: what they are at small size, and that their constants are certified."""

from __future__ import annotations

import numpy as np
import pytest

import certbound as cb
from certbound.problem.library.grid import ANGLES, BUSES, INERTIA, LINES, grid
from certbound.problem.library.large_models import formation, heat, kuramoto
from certbound.problem.model import compile_numpy


def test_every_bus_of_the_grid_is_connected_and_ten_have_machines():
    reached = {1}
    for _ in range(BUSES):
        reached |= {b for line in LINES for b in line[:2] if reached & set(line[:2])}
    assert reached == set(range(1, BUSES + 1))
    assert len(LINES) == 46
    assert len(ANGLES) == BUSES
    assert len(INERTIA) == 10


def test_the_power_flow_is_a_rest_of_the_grid_and_flows_add_up_to_nothing():
    problem = grid()
    f = compile_numpy(problem.system.dynamics)
    assert np.abs(f(0.0, *np.zeros(78))).max() < 1e-12
    x = np.concatenate([np.random.default_rng(0).uniform(-0.05, 0.05, BUSES), np.zeros(BUSES)])
    mass = np.array([INERTIA.get(bus + 1, 5.0) for bus in range(BUSES)])
    pull = f(0.0, *x)[BUSES:] + 4.0 * x[:BUSES]  # without the droop only lines push
    assert abs(mass @ pull) < 1e-9 * np.abs(mass * pull).max()


@pytest.mark.parametrize(
    ("problem", "least", "most"),
    [
        (formation(agents=3), -0.3, -0.15),
        (heat(nodes=5), -8.0, -7.0),
        (kuramoto(oscillators=5), -np.cos(0.7) - 1e-9, -np.cos(0.7) + 1e-6),
    ],
    ids=["formation", "heat", "kuramoto"],
)
def test_rates_of_small_ones_are_certified(problem, least, most):
    constants = cb.bound_constants(problem)
    assert constants.certified
    assert least <= constants.rate <= most


@pytest.mark.slow
def test_rates_of_large_ones_are_certified_close_to_what_sampling_finds():
    for problem, most in ((grid(), -0.66), (formation(), -0.183), (heat(), -7.86), (kuramoto(), -0.764)):
        constants = cb.bound_constants(problem)
        assert constants.certified
        assert constants.rate <= most
        assert constants.gap < 1e-3


@pytest.mark.slow
def test_the_grid_is_safe_under_noise():
    verdict = cb.verify_safety(grid(), method="kummer")
    assert verdict.status == "SAFE"
    assert verdict.log10_delta < -10
