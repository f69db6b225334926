"""The convex path."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import certbound as cb
from tests.synthesis.conftest import cart


@pytest.mark.parametrize("solver", ["CLARABEL", "OSQP"])
def test_on_a_linear_system_it_is_the_nonlinear_programs_answer(problem: cb.Problem, planned: Any, solver: str) -> None:
    found = cb.ConvexPlanner(problem, horizon=20, solver=solver).solve([1, 0], erosion=planned.erosion)
    assert found.feasible
    assert found.cost == pytest.approx(planned.cost, rel=1e-3)
    np.testing.assert_allclose(found.states, planned.states, atol=0.02)


def test_a_program_is_solved_again_from_other_states(problem: cb.Problem) -> None:
    planner = cb.ConvexPlanner(problem, horizon=10)
    state = np.array([1.0, 0.0])
    for _ in range(20):
        found = planner.solve(state)
        assert found.feasible
        state = planner.piece(state, found.inputs[0], 0.0)[0]
    fresh = cb.ConvexPlanner(problem, horizon=10).solve(state)
    np.testing.assert_allclose(planner.solve(state).inputs, fresh.inputs, atol=1e-4)
    assert np.abs(fresh.inputs).max() > 1e-2


def test_an_obstacle_is_passed_by_linearising_it() -> None:
    system = cb.linear_system(np.eye(2), 0.1 * np.eye(2), inputs=cb.Box([-2, -2], [2, 2]), noise=cb.Gaussian(std=0.001))
    safe = [cb.Outside(cb.Ball([1.0, 0.1], 0.3)), cb.Outside(cb.Box([0.4, -0.6], [0.6, -0.3])),
            cb.Inside(cb.Ball([1, 0], 2.0))]  # fmt: skip
    problem = cb.Problem(system, initial=[2, 0], safe=safe, horizon=30, cost=([1, 1], [0.01, 0.01]))
    planner, state = cb.ConvexPlanner(problem, horizon=12), np.array([2.0, 0.0])
    for _ in range(30):
        found = planner.solve(state)
        state = planner.piece(state, found.inputs[0], 0.0)[0]
        assert np.linalg.norm(state - [1.0, 0.1]) >= 0.3 - 1e-5
    assert np.linalg.norm(state) < 0.1


def test_nonlinear_dynamics_are_linearised_along_the_last_prediction() -> None:
    system = cb.DiscreteSystem(
        lambda x, u: [x[0] + 0.1 * x[1], x[1] + 0.1 * (np.sin(x[0]) + u[0])], states=2, inputs=cb.Box([-3], [3]),
        noise=cb.Gaussian(std=0.001),
    )  # fmt: skip
    safe = [cb.Inside(cb.Box([-1, -1], [1, 1]))]
    problem = cb.Problem(system, initial=[0.8, 0], safe=safe, horizon=15, cost=([1, 1], [0.01]))
    planned = cb.synthesize_plan(problem, method="linear")
    planner = cb.ConvexPlanner(problem, horizon=15)
    found = planner.solve([0.8, 0], erosion=planned.erosion, turns=6)
    assert not planner.linear
    np.testing.assert_allclose(found.inputs, planned.plan, atol=2e-3)


def test_slack_is_reported() -> None:
    found = cb.ConvexPlanner(cart(), horizon=10).solve([1.45, 0.79])
    assert not found.feasible
    assert found.softened > 0.01


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"horizon": 0}, "`horizon` must be a positive number"),
        ({"horizon": 5, "solver": "MAGIC"}, "`solver` must be one of"),
    ],
)
def test_bad_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        cb.ConvexPlanner(cart(), **options)


def test_bad_states_and_sets_are_refused() -> None:
    with pytest.raises(ValueError, match="`state` must hold 2 numbers"):
        cb.ConvexPlanner(cart(), horizon=5).solve([1.0])
    with pytest.raises(ValueError, match="`solver` 'OSQP' cannot keep"):
        cb.ConvexPlanner(cart(safe=[cb.Inside(cb.Ball([0, 0], 2))]), horizon=5, solver="OSQP")
    with pytest.raises(ValueError, match="must have inputs"):
        cb.ConvexPlanner(cb.load("ou"), horizon=5)
