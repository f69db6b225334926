"""Receding-horizon control on the noise-free state."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import certbound as cb
from tests.synthesis.conftest import cart


@pytest.fixture
def controller(problem: cb.Problem, planned: Any) -> cb.PredictiveController:
    return cb.PredictiveController(problem, horizon=15, plan=planned, terminal="riccati")


def test_all_steps_together_are_a_verified_plan(controller: cb.PredictiveController) -> None:
    reports = [controller.step() for _ in range(20)]
    assert all(report.feasible for report in reports)
    assert controller.unbroken
    assert controller.verify().status == "SAFE"


def test_the_state_moves_under_the_input_that_was_applied(controller: cb.PredictiveController) -> None:
    first = controller.step()
    moved = np.array([[1, 0.1], [0, 1]]) @ first.state + np.array([0, 0.1]) * first.input
    np.testing.assert_allclose(controller.step().state, moved, atol=1e-12)


def test_a_prediction_of_the_whole_horizon_begins_like_the_plan(problem: cb.Problem, planned: Any) -> None:
    controller = cb.PredictiveController(problem, horizon=20, plan=planned)
    np.testing.assert_allclose(controller.step().input, planned.plan[0], atol=1e-3)


def test_planning_from_a_measured_state_breaks_the_argument(controller: cb.PredictiveController) -> None:
    controller.step()
    assert controller.unbroken
    controller.step(state=[0.9, -0.3])
    assert not controller.unbroken


def test_a_step_without_a_point_is_softened_and_reported(controller: cb.PredictiveController) -> None:
    report = controller.step(state=[1.45, 0.79])  # it leaves through the upper end of the box, brake as it may
    assert not report.feasible
    assert report.softened > 0
    assert np.all(np.abs(report.input) <= 3 + 1e-9)
    assert not controller.unbroken


def test_a_terminal_set_out_of_reach_is_missed_before_a_constraint(problem: cb.Problem, planned: Any) -> None:
    controller = cb.PredictiveController(problem, horizon=5, plan=planned, terminal="riccati")
    reports = [controller.step() for _ in range(20)]
    assert not reports[0].feasible
    assert max(report.softened for report in reports) <= 1e-6
    assert reports[-1].feasible
    assert not controller.unbroken
    assert controller.verify().status == "SAFE"


def test_reset_begins_again(controller: cb.PredictiveController) -> None:
    first = controller.step()
    controller.step(state=[0.9, 0.0])
    controller.reset()
    assert controller.unbroken
    np.testing.assert_allclose(controller.step().input, first.input, atol=1e-4)


@pytest.mark.parametrize("horizon", [0, -1, 2.5, True])
def test_horizons_that_are_no_positive_number_are_refused(problem: cb.Problem, planned: Any, horizon: Any) -> None:
    with pytest.raises(ValueError, match="`horizon` must be a positive number of pieces"):
        cb.PredictiveController(problem, horizon=horizon, plan=planned)


def test_other_refusals(problem: cb.Problem, planned: Any, controller: cb.PredictiveController) -> None:
    with pytest.raises(ValueError, match="`terminal` must be"):
        cb.PredictiveController(problem, horizon=5, plan=planned, terminal="nonsense")
    sticking = cb.TerminalSet(region=cb.Box([-0.5, -0.8], [1.5, 0.8]))
    with pytest.raises(ValueError, match="must lie inside the tightened constraints"):
        cb.PredictiveController(problem, horizon=5, plan=planned, terminal=sticking)
    with pytest.raises(ValueError, match="`plan` must be one of this problem"):
        cb.PredictiveController(cart(horizon=15), horizon=5, plan=planned)
    with pytest.raises(ValueError, match="`state` must hold 2 finite numbers"):
        controller.step(state=[1.0])
    with pytest.raises(ValueError, match="`verify` needs all 20 steps"):
        controller.verify()
    for _ in range(20):
        controller.step(state=[0.5, 0.0])
    with pytest.raises(ValueError, match="noise-free states only"):
        controller.verify()
