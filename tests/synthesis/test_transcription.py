"""Multiple shooting: rollouts, the three programs, and what is measured afterwards."""

from __future__ import annotations

import numpy as np
import pytest

import certbound as cb
from certbound.synthesis.planning import Planner, Tightened
from tests.synthesis.conftest import cart


def tight(planner: Planner, size: float) -> Tightened:
    points, parts = planner.grid.points, planner.program.parts
    return Tightened(erosion=np.full((points, parts), size), inputs=np.zeros((points + 1, 1)))


def pendulum(**options: object) -> cb.Problem:
    system = cb.ContinuousSystem(
        lambda t, x, u: [x[1], np.sin(x[0]) - 0.1 * x[1] + u[0] + 0.1 * t], states=2, inputs=cb.Box([-5], [5]),
        diffusion=[[0], [0.01]],
    )  # fmt: skip
    settings = {"initial": [0.3, 0], "safe": [cb.Inside(cb.Box([-1, -1], [1, 1]))], "horizon": 1.0}
    return cb.Problem(system, **(settings | options))  # type: ignore[arg-type]


@pytest.mark.parametrize("source", [cart(), pendulum()])
def test_two_rollouts_agree(source: cb.Problem) -> None:
    planner = Planner(source)
    inputs = np.random.default_rng(0).uniform(-1, 1, (planner.grid.steps, 1))
    slow = planner.plant.rollout(planner.grid, planner.start, inputs)
    np.testing.assert_allclose(planner.program.rollout(planner.start, inputs), slow, rtol=1e-12, atol=1e-12)


def test_the_rollout_of_continuous_time_is_the_solution() -> None:
    system = cb.linear_system([[0, 1], [-1, 0]], [[0], [1]], inputs=cb.Box([-1], [1]), diffusion=0.1 * np.eye(2))
    safe = [cb.Inside(cb.Box([-5, -5], [5, 5]))]
    planner = Planner(cb.Problem(system, initial=[1, 0], safe=safe, horizon=2.0))
    states = planner.program.rollout(planner.start, np.zeros((40, 1)))
    times = planner.grid.times()
    np.testing.assert_allclose(states, np.stack([np.cos(times), -np.sin(times)], axis=1), atol=1e-7)


def test_the_cheapest_plan_keeps_the_tightened_constraints_and_touches_them() -> None:
    planner = Planner(cart())
    free, held = (planner.plan("cost", tight(planner, e), planner.guess()) for e in (0.0, 0.3))
    assert free.success
    assert held.success
    assert held.states[:, 1].min() == pytest.approx(-0.5, abs=1e-5)
    assert free.states[:, 1].min() < -0.6
    assert held.cost > free.cost


def test_the_scale_is_that_at_which_the_program_stops_having_a_point() -> None:
    planner = Planner(cart())
    widest = planner.plan("scale", tight(planner, 0.1), planner.guess())
    assert widest.success
    assert planner.plan("cost", tight(planner, 0.1 * widest.scale * 0.999), widest.inputs).success
    assert not planner.plan("cost", tight(planner, 0.1 * widest.scale * 1.01), widest.inputs).success


def test_the_soft_plan_keeps_the_constraints_themselves_and_reports_the_rest() -> None:
    planner = Planner(cart())
    soft = planner.plan("soft", tight(planner, 0.7), planner.guess())
    assert soft.success
    assert 0 < soft.slack.max() <= 0.7 + 1e-6
    assert np.all(np.abs(soft.states[:, 1]) <= 0.8 + 1e-6)
    assert not planner.plan("cost", tight(planner, 0.7), planner.guess()).success


def test_the_measured_cost_is_the_sum_of_its_stages() -> None:
    planner = Planner(cart())
    found = planner.plan("cost", tight(planner, 0.0), planner.guess())
    by_hand = np.sum(found.states**2) + 0.01 * np.sum(found.inputs**2)
    assert found.cost == pytest.approx(by_hand, rel=1e-12)


def test_a_users_stage_cost_is_minimised() -> None:
    planner = Planner(cart(), stage_cost=lambda t, x, u: (x[0] - 0.5) ** 2 + 1e-4 * u[0] ** 2)
    found = planner.plan("cost", tight(planner, 0.0), planner.guess())
    assert found.success
    assert found.states[-2, 0] == pytest.approx(0.5, abs=0.02)


def test_a_stage_cost_with_two_values_is_refused() -> None:
    with pytest.raises(ValueError, match="`stage_cost` must return one number"):
        Planner(cart(), stage_cost=lambda x, u: [x[0], u[0]])


def test_an_obstacle_is_passed_on_a_side_of_it() -> None:
    system = cb.linear_system(np.eye(2), 0.1 * np.eye(2), inputs=cb.Box([-2, -2], [2, 2]), noise=cb.Gaussian(std=0.001))
    safe = [
        cb.Outside(cb.Box([0.8, -0.5], [1.2, 0.52])),
        cb.Inside(cb.Ball([2, 0], 0.2), during=(25, 25)),
    ]
    planner = Planner(cb.Problem(system, initial=[0, 0], safe=safe, horizon=25))
    first = planner.first_plan()
    states = planner.program.rollout(planner.start, first.inputs)
    assert first.success
    assert not np.any(np.all((states > [0.8, -0.5]) & (states < [1.2, 0.52]), axis=1))
    assert np.linalg.norm(states[-1] - [2, 0]) <= 0.2
