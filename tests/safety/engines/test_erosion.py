"""Rooms of constraints, gathered for the probability and for the reason."""

from __future__ import annotations

import numpy as np
import pytest

from certbound.problem.noise import Gaussian
from certbound.problem.problem import Problem
from certbound.problem.sets.constraints import GaussianStart, Inside, Outside
from certbound.problem.sets.regions import Ball, Box, HalfSpace
from certbound.problem.systems import ContinuousSystem, DiscreteSystem
from certbound.reach.contraction.uniform import contraction_tube
from certbound.rigor.norms import Norm
from certbound.safety.engines.constants import constants_engine
from certbound.safety.engines.erosion import Erosion, erode
from certbound.tubes.constants import Constants


def line(safe, horizon=2.0, domain=None) -> Problem:
    """x1' = 1, x2' = 0 from the origin."""
    system = ContinuousSystem(lambda x: [1.0, 0.0 * x[1]], states=2, diffusion=np.eye(2))
    return Problem(system, initial=[0.0, 0.0], safe=safe, horizon=horizon, domain=domain)


def eroded(problem, constants=None) -> Erosion:
    constants = constants or Constants(rate=0.0, sigma=1.0, dimension=problem.system.dimension)
    return erode(contraction_tube(problem, constants), problem, Norm(problem.system.dimension, constants.metric))


def test_rooms_follow_the_nominal_over_whole_pieces():
    erosion = eroded(line([Inside(HalfSpace([1.0, 0.0], 3.0)), Outside(Ball([1.0, 2.0], 0.5))]))
    assert erosion.radius.shape == (2, len(erosion.starts))
    assert erosion.radius[0] == pytest.approx(3.0 - erosion.ends, abs=1e-6)
    assert np.all(erosion.radius[0] <= 3.0 - erosion.ends)
    gap = np.hypot(np.maximum(0, np.maximum(erosion.starts - 1, 1 - erosion.ends)), 2.0) - 0.5
    assert np.all(erosion.radius[1] <= gap + 1e-12)
    assert np.all(erosion.radius[1] >= gap - 0.02)


def test_the_domain_is_a_constraint():
    erosion = eroded(line([], domain=Box([-1, -1], [2.5, 1])))
    assert erosion.labels == ("the model's domain",)
    assert erosion.least[-1] == pytest.approx(0.5, abs=1e-6)


def test_windows_leave_the_rest_free_and_the_profile_says_so():
    erosion = eroded(line([Inside(HalfSpace([1.0, 0.0], 3.0), during=(1.0, 1.5))]))
    times, values = erosion.profile()
    assert times[0] == 0.0
    assert times[-1] == 2.0
    middle = (times[:-1] + times[1:]) / 2
    assert np.all(np.isfinite(values[(middle > 1.0) & (middle < 1.5)]))
    assert np.all(np.isinf(values[(middle < 0.9) | (middle > 1.6)]))


def test_moving_obstacles_are_followed():
    chasing = Outside(Ball(lambda t: [t, 1.0], 0.25))
    assert eroded(line([chasing])).least == pytest.approx(0.75, abs=1e-6)


def test_the_tightest_place_is_named():
    safe = [Inside(HalfSpace([1.0, 0.0], 3.0)), Inside(HalfSpace([0.0, 1.0], 0.25))]
    tightest = eroded(line(safe)).tightest()
    assert tightest.constraint == 1
    assert tightest.label == "x2 <= 0.25"
    assert tightest.margin == pytest.approx(0.25)
    growing = eroded(line(safe[:1])).tightest(needed=np.linspace(0, 0.5, 128))
    assert growing.time == 2.0
    assert growing.margin == pytest.approx(0.5, abs=1e-6)


def test_margins_are_euclidean_whatever_the_metric():
    metric = np.array([[4.0, 1.0], [1.0, 2.0]])
    constants = Constants(rate=0.0, sigma=1.0, dimension=2, metric=metric)
    problem = line([Inside(HalfSpace([3.0, 4.0], 50.0))])
    assert eroded(problem, constants).tightest().margin == pytest.approx((50 - 6) / 5, rel=1e-6)
    assert eroded(problem).tightest().margin == pytest.approx((50 - 6) / 5, rel=1e-6)


def test_discrete_time_owes_nothing_at_step_zero_and_covers_the_last_step():
    system = DiscreteSystem(lambda x: [x[0] + 1.0], states=1, noise=Gaussian(std=0.1))
    problem = Problem(system, initial=[0.0], safe=[Inside(Box([0.0], [4.0]))], horizon=3)
    constants = Constants(gain=1.0, sigma=0.1, dimension=1)
    erosion = erode(contraction_tube(problem, constants), problem, Norm(1))
    assert erosion.least == pytest.approx([0.0, 1.0, 2.0, 1.0], abs=1e-12)
    assert not erosion.broken()
    times, values = erosion.profile()
    assert times.tolist() == [0, 1, 2, 3]
    assert values == pytest.approx([np.inf, 1.0, 1.0])
    assert erosion.profile(random_start=True)[1][0] == pytest.approx(0.0, abs=1e-12)
    one = erode(contraction_tube(problem.replace(horizon=1), constants), problem, Norm(1))
    assert one.profile()[1] == pytest.approx([1.0])


def test_a_random_start_needs_room_at_step_zero():
    system = DiscreteSystem(lambda x: 0.9 * x, states=2, noise=Gaussian(std=[0.05, 0.05]))
    start = GaussianStart([0.0, 1.0], np.diag([0.01, 0.0]))
    problem = Problem(system, initial=start, safe=[Inside(HalfSpace([0.0, 1.0], 1.0))], horizon=5)
    answer = constants_engine(problem)
    assert not answer.log10_delta < 0
    assert "leaves no room" in answer.reason
    assert "at step 0; start elsewhere" in answer.reason


def test_a_reach_tube_that_breaks_a_constraint_is_broken():
    assert eroded(line([Inside(HalfSpace([1.0, 0.0], 1.5))])).broken()
    assert not eroded(line([Inside(HalfSpace([1.0, 0.0], 2.5))])).broken()


def test_nothing_asked_means_endless_room():
    erosion = eroded(line([]))
    assert np.all(np.isinf(erosion.least))
    assert erosion.tightest().margin == np.inf
    assert not erosion.broken()


def test_cutting_and_picking():
    erosion = eroded(line([Inside(HalfSpace([1.0, 0.0], 3.0)), Inside(HalfSpace([0.0, 1.0], 0.25))]))
    cut = erosion.capped(np.full(len(erosion.starts), 0.1))
    assert np.all(cut.least == 0.1)
    assert erosion.only(1).labels == ("x2 <= 0.25",)
    assert erosion.only(0).least == pytest.approx(3.0 - erosion.ends, abs=1e-6)


def test_twelve_states():
    n = 12
    system = ContinuousSystem(lambda x: -x, states=n, diffusion=np.eye(n))
    problem = Problem(system, initial=np.full(n, 0.5), safe=[Inside(Box(-np.ones(n), np.ones(n)))], horizon=1.0)
    constants = Constants(rate=-1.0, sigma=1.0, dimension=n)
    assert eroded(problem, constants).least[0] == pytest.approx(0.5, abs=1e-6)
