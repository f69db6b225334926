"""One proved step of the filter, and the extents of sets with many sides."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

import certbound as cb
from certbound.constants import bound_constants
from certbound.reach.nominal.integration import nominal_curve
from certbound.rigor.intervals import Interval
from certbound.synthesis.controllers import held_steps
from certbound.synthesis.controllers.held_steps import HeldSteps
from certbound.synthesis.planning import Planner
from certbound.synthesis.tightening import nominal_spread

TURN = np.array([[0.0, 6.0], [-6.0, 0.0]])


def steps_of(problem: cb.Problem, count: int) -> HeldSteps:
    tube = cb.tune_tube(bound_constants(problem), horizon=problem.horizon, delta=problem.delta)
    plan = np.zeros((count, len(problem.system.input_names)))
    return HeldSteps(problem=problem.replace(plan=plan), tube=tube, times=np.linspace(0, problem.horizon, count + 1))


def rotation(**changes: Any) -> cb.Problem:
    system = cb.linear_system(TURN, np.eye(2), inputs=cb.Box([-1, -1], [1, 1]), diffusion=1e-3 * np.eye(2))
    options = {"initial": [0.5, 0.0], "safe": [cb.Inside(cb.Ball([0, 0], 1.0))], "horizon": 1, "delta": 1e-3}
    return cb.Problem(system, **(options | changes))


def test_the_link_contains_the_exact_flow_under_held_inputs() -> None:
    proofs = steps_of(rotation(), 4)
    x = state = np.array([0.5, 0.0])
    link, _ = proofs.start(state)
    for k, u in enumerate([[1.0, 0.0], [-1.0, 0.5], [0.0, 1.0], [0.3, -1.0]]):
        found = proofs.advance(link, state, k, np.array(u))
        state, link = found.state, found.link
        flow = expm(TURN * 0.25)
        x = flow @ x + np.linalg.solve(TURN, (flow - np.eye(2)) @ np.array(u))
        assert np.linalg.norm(x - link.end.mid) <= link.radius + 1e-14
        assert link.radius < 1e-5
        assert found.proved


def test_an_integrator_that_is_wrong_is_charged(monkeypatch: pytest.MonkeyPatch) -> None:
    def wrong(flow: Any, points: Any, **options: Any) -> Any:
        curve = nominal_curve(flow, points, **options)
        coefficients = np.array(curve.coefficients)
        coefficients[..., 1, :] += 0.5  # a velocity that the model does not have
        return replace(curve, coefficients=coefficients)

    monkeypatch.setattr(held_steps, "nominal_curve", wrong)
    monkeypatch.setattr(held_steps, "LARGEST_DIVISION", 1)
    proofs = steps_of(rotation(), 4)
    state = np.array([0.5, 0.0])
    found = proofs.advance(proofs.start(state)[0], state, 0, np.zeros(2))
    assert np.linalg.norm(expm(TURN * 0.25) @ state - found.link.end.mid) > 0.05
    assert np.linalg.norm(expm(TURN * 0.25) @ state - found.link.end.mid) <= found.link.radius


def test_a_state_off_the_link_is_charged() -> None:
    proofs = steps_of(rotation(), 4)
    state = np.array([0.5, 0.0])
    link, _ = proofs.start(state)
    exact, off = (proofs.advance(link, state + shift, 0, np.zeros(2)) for shift in (0.0, 0.1))
    assert off.link.radius >= 0.1 * np.sqrt(2) - 1e-9 > exact.link.radius
    assert off.room[0] < exact.room[0] - 0.1


def test_the_extent_of_the_start_grows_with_the_gain_in_discrete_time() -> None:
    system = cb.linear_system([[2.0]], [[1.0]], inputs=cb.Box([-1], [1]), noise=cb.Gaussian(std=1e-3))
    start = cb.Box([-0.1], [0.1])
    problem = cb.Problem(system, initial=start, safe=[cb.Inside(cb.Box([-0.5], [0.5]))], horizon=3, delta=1e-3)
    proofs = steps_of(problem, 3)
    link, kept = proofs.start(np.zeros(1))
    assert kept
    state, radii, proved = np.zeros(1), [], []
    for k in range(3):
        found = proofs.advance(link, state, k, np.zeros(1))
        state, link = found.state, found.link
        radii.append(link.radius)
        proved.append(found.proved)
    np.testing.assert_allclose(radii, [0.2, 0.4, 0.8], rtol=1e-12)
    assert proved == [True, True, False]


def test_windows_are_asked_within_a_step_of_continuous_time() -> None:
    off = {"safe": [cb.Inside(cb.HalfSpace([1, 0], 2.0)), cb.Inside(cb.Box([0.0, -1], [1, 1]), (0.0, 0.1))]}
    on = {"safe": [cb.Inside(cb.HalfSpace([1, 0], 2.0)), cb.Inside(cb.Box([0.0, -1], [1, 1]), (0.0, 0.5))]}
    early = {"safe": [cb.Inside(cb.HalfSpace([1, 0], 2.0)), cb.Inside(cb.Box([0.0, -1], [1, 1]), (0.25, 0.28))]}
    state, proved = np.array([0.5, 0.0]), []
    for changes in (off, on, early):  # the first state changes its sign at t = pi/12
        proofs = steps_of(rotation(**changes), 2)
        proved.append(proofs.advance(proofs.start(state)[0], state, 0, np.zeros(2)).proved)
    assert proved == [True, False, False]


@pytest.mark.parametrize("n", [3, 14, 20])
def test_the_spread_covers_every_corner_of_the_start(n: int) -> None:
    rng = np.random.default_rng(n)
    root = rng.standard_normal((n, n)) / n + 0.2 * np.eye(n)
    system = cb.linear_system(np.eye(n), np.eye(n), inputs=cb.Box([-1] * n, [1] * n), noise=cb.Gaussian(std=0.01))
    half = rng.uniform(0.5, 1.5, n)
    free = [cb.Inside(cb.HalfSpace(np.eye(n)[0], 1e3))]
    planner = Planner(cb.Problem(system, initial=cb.Box(-half, half), safe=free, horizon=1))
    constants = cb.Constants(gain=1.0, sigma=0.01, dimension=n, metric=root.T @ root)
    path = planner.rollout(planner.guess())
    spread = nominal_spread(planner.problem, planner.plant, planner.grid, constants, path.states, path.inputs)
    corner = np.ones(n)
    for _ in range(50):  # the longest corner that coordinate-wise climbing finds
        corner = np.where(root.T @ (root @ (half * corner)) >= 0, 1.0, -1.0)
    assert spread[0] >= np.linalg.norm(root @ (half * corner)) * (1 - 1e-12)


def test_the_spread_covers_every_corner_of_many_disturbances() -> None:
    n = 10
    box = cb.Box([-1.0] * n, [1.0] * n)
    row = np.ones((1, n))
    row[0, 0] = -1.0  # the longest corner is not among the first 256
    system = cb.linear_system(
        [[1.0]], [[1.0]], E=row, inputs=cb.Box([-1], [1]), disturbance=box, noise=cb.Gaussian(std=0.01)
    )
    problem = cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-99], [99]))], horizon=2)
    planner = Planner(problem)
    constants, path = cb.Constants(gain=1.0, sigma=0.01, dimension=1), planner.rollout(planner.guess())
    spread = nominal_spread(problem, planner.plant, planner.grid, constants, path.states, path.inputs)
    np.testing.assert_allclose(spread, [0.0, 10.0, 20.0], rtol=1e-12, atol=1e-300)


def test_the_extent_of_a_point_is_nothing() -> None:
    link, kept = steps_of(rotation(), 2).start(np.array([0.5, 0.0]))
    assert link.radius == 0.0
    assert kept
    assert isinstance(link.end, Interval)
