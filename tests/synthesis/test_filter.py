"""The safety filter."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import certbound as cb
from tests.synthesis.conftest import cart

CONSTANTS = cb.Constants(gain=1.0, sigma=0.002, dimension=2)


def integrator(**changes: Any) -> cb.Problem:
    """Two integrators among obstacles."""
    system = cb.linear_system(
        np.eye(2), 0.1 * np.eye(2), inputs=cb.Box([-1, -1], [1, 1]), noise=cb.Gaussian(std=0.002)
    )
    safe = [cb.Outside(cb.Ball([1.0, 0.05], 0.4)), cb.Inside(cb.Box([-1, -1], [3, 1]))]
    return cb.Problem(system, **({"initial": [0.0, 0.0], "safe": safe, "horizon": 30, "delta": 1e-3} | changes))


def test_an_input_that_is_safe_passes_unchanged() -> None:
    guard = cb.SafetyFilter(integrator())
    report = guard.step([-0.1, 0.2])
    assert report.changed == 0
    np.testing.assert_array_equal(report.input, [-0.1, 0.2])


def test_driving_at_an_obstacle_is_bent_and_stays_guaranteed() -> None:
    guard = cb.SafetyFilter(integrator())
    reports = [guard.step([1.0, 0.0]) for _ in range(30)]
    assert max(report.changed for report in reports) > 0.1
    assert all(report.feasible and report.room >= -1e-9 for report in reports)
    assert guard.guaranteed
    assert guard.verify().status == "SAFE"


def test_inputs_from_measured_states_keep_the_noisy_system_safe() -> None:
    guard, rng = cb.SafetyFilter(integrator()), np.random.default_rng(0)
    for _ in range(20):
        guard.reset()
        x = np.zeros(2)
        for _ in range(30):
            x = x + 0.1 * guard.step(np.array([2.0, 0.0]) - x).input + 0.002 * rng.standard_normal(2)
            assert np.linalg.norm(x - [1.0, 0.05]) > 0.4
        assert guard.guaranteed


def test_the_filtered_input_solves_the_quadratic_program() -> None:
    guard = cb.SafetyFilter(integrator(), decay=1.0)
    guard.state = np.array([0.55, 0.05])
    guard._room = np.array([0.05, 1.0, 1.0, 1.0, 1.0])  # of the obstacle, and of the box's sides
    wanted = np.array([1.0, 0.0])
    report = guard.step(wanted)
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 401), np.linspace(-1, 1, 401)), axis=-1).reshape(-1, 2)
    following = np.array([0.55, 0.05]) + 0.1 * grid
    kept = np.linalg.norm(following - [1.0, 0.05], axis=1) - 0.4 >= guard._radii[0]
    best = np.min(np.linalg.norm(grid[kept] - wanted, axis=1))
    assert np.linalg.norm(report.input - wanted) == pytest.approx(best, abs=5e-3)


def test_a_steady_tube_leaves_an_input_to_a_system_that_can_stand_still() -> None:
    kept = []
    for steady in (True, False):
        guard = cb.SafetyFilter(integrator(safe=[cb.Outside(cb.Ball([1.0, 0.0], 0.4))]), steady=steady)
        for _ in range(30):
            guard.step([1.0, 0.0])
        kept.append(guard.state[0])
        assert guard.guaranteed
    assert kept[0] == pytest.approx(0.6 - guard._radii.max(), abs=0.01)


def test_a_step_without_a_point_is_reported_and_ends_the_guarantee() -> None:
    guard = cb.SafetyFilter(cart(), constants=CONSTANTS)
    reports = [guard.step([3.0]) for _ in range(20)]  # position lags behind speed: one step does not look far enough
    assert not all(report.feasible for report in reports)
    assert not guard.guaranteed


def test_stated_constants_guarantee_nothing() -> None:
    guard = cb.SafetyFilter(cart(), constants=CONSTANTS)
    assert not guard.guaranteed


def test_a_one_time_tube_guarantees_nothing() -> None:
    assert not cb.SafetyFilter(integrator(), tube="markov").guaranteed


@pytest.mark.parametrize("decay", [0.0, 1.5, -1.0])
def test_a_decay_out_of_range_is_refused(decay: float) -> None:
    with pytest.raises(ValueError, match="`decay` must lie in"):
        cb.SafetyFilter(integrator(), decay=decay)


def test_other_refusals() -> None:
    guard = cb.SafetyFilter(integrator())
    with pytest.raises(ValueError, match="`desired` must hold 2 finite inputs"):
        guard.step([np.nan, 0.0])
    with pytest.raises(ValueError, match="`verify` needs all 30 steps"):
        guard.verify()
    start = cb.GaussianStart([0, 0], 0.01 * np.eye(2))
    with pytest.raises(ValueError, match="must start in a set"):
        cb.SafetyFilter(integrator(initial=start))
    pushed = cb.linear_system(
        np.eye(2), np.eye(2), E=np.eye(2), inputs=cb.Box([-1, -1], [1, 1]), disturbance=cb.Box([-1, -1], [1, 1]),
        noise=cb.Gaussian(std=0.1),
    )  # fmt: skip
    with pytest.raises(ValueError, match="must have no disturbance"):
        cb.SafetyFilter(integrator().replace(system=pushed))
    with pytest.raises(ValueError, match="must have inputs"):
        cb.SafetyFilter(cb.load("ou"))
