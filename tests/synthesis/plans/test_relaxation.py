"""Proofs that no plan exists: two routes agree, and no plan beats a bound."""

from __future__ import annotations

import numpy as np
import pytest

import certbound as cb
from certbound.synthesis.faces import faces_of
from certbound.synthesis.planning import Planner, Tightened
from certbound.synthesis.plans.relaxation import bound_scale, empty_at_once
from tests.synthesis.conftest import cart


def test_the_bound_is_the_solvers_value_on_a_linear_system() -> None:
    planner = Planner(cart())
    erosion = np.full((20, 4), 0.1) * np.linspace(0.5, 1.5, 20)[:, None]
    found = planner.plan("scale", Tightened(erosion=erosion, inputs=np.zeros((21, 1))), planner.guess())
    bound = bound_scale(planner.problem, planner.grid, planner.faces, erosion)
    assert found.scale <= bound * (1 + 1e-6)  # the solver ends within its tolerance
    assert bound == pytest.approx(found.scale, rel=1e-5)


def test_the_bound_lies_above_every_plan_of_a_nonlinear_system() -> None:
    system = cb.DiscreteSystem(
        lambda x, u: [x[0] + 0.1 * x[1], x[1] + 0.1 * (u[0] - np.tanh(x[1]) + 0.3 * np.sin(x[0]))], states=2,
        inputs=cb.Box([-1], [1]), noise=cb.Gaussian(std=0.01),
    )  # fmt: skip
    problem = cb.Problem(system, initial=[0.9, 0.3], safe=[cb.Inside(cb.Box([-1, -1], [1, 1]))], horizon=15)
    planner = Planner(problem)
    erosion = np.full((15, 4), 0.05)
    found = planner.plan("scale", Tightened(erosion=erosion, inputs=np.zeros((16, 1))), planner.guess())
    bound = bound_scale(problem, planner.grid, planner.faces, erosion)
    assert np.isfinite(bound)
    assert found.scale <= bound
    rng = np.random.default_rng(0)
    for _ in range(200):
        states = planner.program.rollout(planner.start, rng.uniform(-1, 1, (15, 1)))
        rooms = [face.room(states[1:], np.arange(1.0, 16.0)) for face in planner.faces]
        assert np.min(rooms) / 0.05 <= bound * (1 + 1e-9)


@pytest.mark.parametrize(
    "problem",
    [
        cart(inputs=cb.Box([-np.inf], [np.inf])),
        cb.Problem(
            cb.DiscreteSystem(lambda x, u: [x[0] ** 3 + u[0]], states=1, inputs=cb.Box([-1], [1])), initial=[0],
            safe=[cb.Inside(cb.Box([-1], [1]))], horizon=5,
        ),
    ],
    ids=["unbounded inputs", "unbounded terms"],
)  # fmt: skip
def test_nothing_is_claimed_where_nothing_can_be_bounded(problem: cb.Problem) -> None:
    planner = Planner(problem)
    erosion = np.full((planner.grid.points, planner.program.parts), 9.0)
    assert bound_scale(problem, planner.grid, planner.faces, erosion) == np.inf


def test_a_box_narrower_than_the_tube_is_empty() -> None:
    faces, times = faces_of(cart()), np.arange(21.0)
    erosion = np.full((20, 4), 0.1)
    assert empty_at_once(faces, erosion, times) is None
    erosion[7:, [1, 3]] = 0.81
    found = empty_at_once(faces, erosion, times)
    assert found is not None
    assert found[1] == 8.0
    assert "[side" in found[0]


def test_a_ball_smaller_than_the_tube_is_empty() -> None:
    faces = faces_of(cart(safe=[cb.Inside(cb.Ball([1, 0], 0.5))]))
    assert empty_at_once(faces, np.full((20, 1), 0.49), np.arange(21.0)) is None
    assert empty_at_once(faces, np.full((20, 1), 0.51), np.arange(21.0)) == (faces[0].label, 1.0)
