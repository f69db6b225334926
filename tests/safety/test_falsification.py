"""Noise-free trajectories that provably leave."""

from __future__ import annotations

import numpy as np
import pytest

from certbound.problem.noise import Gaussian
from certbound.problem.problem import Problem
from certbound.problem.sets.constraints import GaussianStart, Inside, Outside
from certbound.problem.sets.regions import Ball, Box, HalfSpace
from certbound.problem.systems import ContinuousSystem, DiscreteSystem
from certbound.reach.nominal.flow import Flow
from certbound.safety import falsification
from certbound.safety.falsification import find_violation


def drift(safe, horizon=2.0, initial=(0.0, 0.0), d=0.0, domain=None) -> Problem:
    system = ContinuousSystem(
        lambda x, d: [1.0 + d[0], 0.2 * np.sin(x[0])], states=2, diffusion=np.eye(2), disturbance=Box([-d], [d])
    )
    return Problem(system, initial=initial, safe=safe, horizon=horizon, domain=domain)


@pytest.mark.parametrize(
    "constraint",
    [
        Inside(HalfSpace([1.0, 0.0], 1.5)),
        Inside(Box([-1, -1], [1.5, 1])),
        Inside(Ball([0.0, 0.0], 1.5)),
        Outside(Ball([1.0, 0.0], 0.3)),
        Outside(Box([0.9, -0.5], [1.1, 0.5])),
        Outside(HalfSpace([-1.0, 0.0], -1.5)),
        Outside(Ball(lambda t: [t, 0.0], 0.3, coordinates=(0, 1)), during=(1.0, 2.0)),
    ],
)
def test_a_trajectory_that_leaves_is_proved_to(constraint):
    problem = drift([constraint])
    violation = find_violation(problem)
    assert violation is not None
    assert violation.constraint.region is constraint.region
    x = violation.reach.center(violation.time)
    assert not constraint.satisfied(x, violation.time)
    assert violation.depth > 0


def test_a_trajectory_that_stays_is_not_accused():
    safe = [Inside(HalfSpace([1.0, 0.0], 2.5)), Outside(Ball([1.0, 1.0], 0.5))]
    assert find_violation(drift(safe)) is None


def test_windows_are_respected():
    assert find_violation(drift([Inside(HalfSpace([1.0, 0.0], 1.5), during=(0.0, 1.4))])) is None
    assert find_violation(drift([Inside(HalfSpace([1.0, 0.0], 1.5), during=(2.0, 2.0))])) is not None


def test_corners_of_the_start_and_of_the_disturbance_are_tried():
    safe = [Inside(HalfSpace([1.0, 0.0], 2.45))]
    assert find_violation(drift(safe)) is None
    assert find_violation(drift(safe, initial=Box([-0.5, 0.0], [0.5, 0.0]))) is not None
    assert find_violation(drift(safe, d=0.3)) is not None


def test_leaving_the_domain_is_no_violation():
    assert find_violation(drift([], domain=Box([-1, -1], [1.5, 1]))) is None


def test_a_bare_touch_is_not_proved():
    """The trajectory ends exactly on the boundary: no interval can prove that it leaves."""
    system = ContinuousSystem(lambda x: [1.0], states=1, diffusion=0.1)
    problem = Problem(system, initial=[0.0], safe=[Inside(HalfSpace([1.0], 2.0))], horizon=2.0)
    assert find_violation(problem) is None


def test_discrete_time_and_random_starts():
    system = DiscreteSystem(lambda x: [1.2 * x[0]], states=1, noise=Gaussian(std=0.1))
    safe = [Inside(HalfSpace([1.0], 2.0))]
    assert find_violation(Problem(system, initial=[1.0], safe=safe, horizon=3)) is None
    late = find_violation(Problem(system, initial=[1.0], safe=safe, horizon=5))
    assert late is not None
    assert late.time in (4, 5)
    random = Problem(system, initial=GaussianStart([1.0], [[0.01]]), safe=safe, horizon=5)
    assert find_violation(random) is None  # its mean leaves, which says nothing of what is drawn
    alone = Problem(system, initial=GaussianStart([1.0], [[0.0]]), safe=safe, horizon=5)
    assert find_violation(alone) is not None  # nothing is drawn


def test_a_trajectory_that_blows_up_first_breaks_the_constraint():
    system = ContinuousSystem(lambda x: [x[0] ** 2], states=1, diffusion=0.1)
    problem = Problem(system, initial=[1.0], safe=[Inside(HalfSpace([1.0], 3.0))], horizon=0.9)
    violation = find_violation(problem)
    assert violation is not None
    assert violation.time > 0.66


def test_a_wrong_proposal_is_not_believed(monkeypatch):
    """The sampled path is off by 0.6 and seems to leave; its enclosure shows that it does not."""
    from certbound.safety import falsification

    honest = falsification.follow
    calls = []

    def lying(*arguments):
        times, paths = honest(*arguments)
        calls.append(1)
        return times, paths + 0.6

    monkeypatch.setattr(falsification, "follow", lying)
    assert find_violation(drift([Inside(HalfSpace([1.0, 0.0], 2.5))])) is None
    assert calls


@pytest.mark.parametrize("time", ["continuous", "discrete"])
def test_affine_dynamics_are_followed_as_step_by_step(time: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def motion(t, x, u, d):
        return [0.9 * x[1] + np.cos(t) + u[0], -0.5 * x[0] - 0.3 * x[1] + d[0] * t]

    build = ContinuousSystem if time == "continuous" else DiscreteSystem
    noise = {"diffusion": 0.01 * np.eye(2)} if time == "continuous" else {"noise": Gaussian(std=0.01)}
    system = build(motion, states=2, inputs=Box([-1.0], [1.0]), disturbance=Box([-0.2], [0.3]), **noise)
    plan = np.linspace(-1, 1, 6)[:, None]
    problem = Problem(
        system, initial=Box([-1, -1], [1, 0]), safe=[Inside(Box([-90, -90], [90, 90]))], horizon=6, plan=plan
    )
    flow = Flow(problem)
    starts, signals = falsification.candidates(problem, flow, np.random.default_rng(0))
    times, whole = falsification.follow(flow, starts, signals)
    monkeypatch.setattr(falsification, "_WHOLE", -1)
    again, single = falsification.follow(flow, starts, signals)
    assert np.array_equal(times, again)
    assert np.abs(single).max() > 1
    assert np.allclose(whole, single, rtol=1e-12, atol=1e-12)


def test_what_jumps_is_not_followed_as_affine() -> None:
    system = DiscreteSystem(lambda x: [0.5 * x[0] + np.sign(x[0] - 1.0)], states=1, noise=Gaussian(std=0.01))
    flow = Flow(Problem(system, initial=[3.0], safe=[Inside(Box([-9.0], [9.0]))], horizon=2))
    paths = falsification.follow(flow, np.array([[3.0]]), np.zeros((1, 0)))[1]
    assert paths[0, :, 0] == pytest.approx([3.0, 2.5, 2.25])
