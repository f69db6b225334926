"""Lower bounds of the probability of failing by the linear response: never above the truth, and near it if linear."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

import certbound as cb
from certbound.gaussian.response import Exceedances, discrete_response
from certbound.reach.below import least_failing
from certbound.reach.below.pushes import plainly
from certbound.reach.below.survival import survivors
from certbound.reach.linear import Linearisation
from certbound.safety.engines import linear_below


def walk(side, steps=4, during=None, start=0.0):
    system = cb.DiscreteSystem(lambda x: x, states=["x"], noise=cb.Gaussian(std=1.0))
    safe = [cb.Inside(cb.Box([-side], [np.inf]), during=during)]
    return cb.Problem(system, initial=[start], safe=safe, horizon=steps, delta=1e-4)


def test_one_time_of_a_random_walk_is_met_exactly():
    found = least_failing(walk(3.0, during=(4, 4)))
    assert found.probability == pytest.approx(norm.sf(3.0 / 2.0), rel=1e-9)
    assert found.probability <= norm.sf(1.5)


def test_both_faces_of_an_obstacle_count():
    system = cb.DiscreteSystem(lambda x: x, states=["x"], noise=cb.Gaussian(std=1.0))
    safe = [cb.Outside(cb.Box([2.0], [2.5]), during=(4, 4))]
    found = least_failing(cb.Problem(system, initial=[0.0], safe=safe, horizon=4, delta=1e-4))
    assert found.probability == pytest.approx(norm.sf(1.0) - norm.sf(1.25), rel=1e-9)


def test_what_the_levels_cost_is_taken_off():
    system = cb.DiscreteSystem(lambda x: x + 1e-9 * np.sin(x), states=["x"], noise=cb.Gaussian(std=1.0))
    safe = [cb.Inside(cb.Box([-5.0], [np.inf]), during=(4, 4))]
    found = least_failing(cb.Problem(system, initial=[0.0], safe=safe, horizon=4, delta=1e-4))
    assert found.levels > 0
    least = plainly(float(norm.cdf(found.cost - 2.5)) - found.levels, found.cost)
    assert found.probability == pytest.approx(least, rel=1e-4)


def test_what_the_linearisation_leaves_out_is_taken_off():
    system = cb.DiscreteSystem(lambda x: 0.5 * x - 2 * x**2, states=["x"], noise=cb.Gaussian(std=0.3))
    safe = [cb.Inside(cb.Box([-3.0], [0.5]))]
    found = least_failing(cb.Problem(system, initial=[0.0], safe=safe, horizon=2, delta=1e-3))
    first = np.linspace(-3, 0.5, 20001)
    stays = norm.pdf(first, scale=0.3) * norm.cdf((0.5 - 0.5 * first + 2 * first**2) / 0.3)
    truth = 1 - float(np.trapezoid(stays, first))
    late = cb.Problem(system, initial=[0.0], safe=[cb.Inside(safe[0].region, during=(2, 2))], horizon=2, delta=1e-4)
    assert 0 < found.probability < truth
    again = least_failing(late)
    whole = np.linspace(-3, 3, 20001)
    fails = norm.pdf(whole, scale=0.3) * norm.sf((0.5 - 0.5 * whole + 2 * whole**2) / 0.3)
    assert again is None or again.probability < float(np.trapezoid(fails, whole)) + 1e-12


def test_only_limits_that_are_asked_bound_those_who_have_not_failed():
    found = Linearisation(walk(2.0, during=(2, 4)))
    low, high = survivors(found)
    assert np.all(np.isinf(low[:2]))
    assert low[2:] == pytest.approx(-2.0)
    assert np.all(np.isinf(high))


def test_the_union_over_times_lies_between_the_likeliest_one_and_the_truth():
    cov = np.minimum.outer(np.arange(1, 5), np.arange(1, 5))
    truth = 1 - multivariate_normal(np.zeros(4), cov).cdf(np.full(4, 2.0))
    found = least_failing(walk(2.0))
    assert norm.sf(1.0) < found.probability <= truth * (1 + 1e-4)


def test_the_union_is_de_caens_bound():
    eye, three = np.eye(1)[None, None], np.ones((3, 1))
    response = discrete_response(np.repeat(0.5 * eye, 3, axis=1), np.eye(1), 0.0, np.zeros((1, 1)))
    events = Exceedances(nodes=np.arange(1, 4), rows=three, levels=np.ones(3), lost=np.zeros(3))
    cov = np.array([[1, 0.5, 0.25], [0.5, 1.25, 0.625], [0.25, 0.625, 1.3125]])
    single = norm.sf(1 / np.sqrt(np.diag(cov)))
    pairs = [[multivariate_normal(np.zeros(2), cov[np.ix_([k, m], [k, m])], allow_singular=True).cdf([-1, -1])
              for m in range(3)] for k in range(3)]
    both = np.where(np.eye(3) > 0, np.diag(single), pairs)
    expected = float(np.sum(single**2 / both.sum(axis=1)))
    assert events.union(response) == pytest.approx(expected, rel=1e-4)
    assert events.union(response) <= expected * (1 + 1e-5)


def test_rows_that_no_noise_has_reached_exceed_nothing():
    """At time 0 and along a state without noise: levels in standard deviations are infinite, without a word."""
    eye = np.eye(2)[None, None]
    response = discrete_response(np.repeat(0.5 * eye, 2, axis=1), np.diag([1.0, 0.0]), 0.0, np.zeros((1, 1)))
    rows = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 1.0], [1.0, 0.0]])
    events = Exceedances(nodes=np.array([0, 1, 2, 2]), rows=rows, levels=np.array([-1.0, -1.0, 0.5, 0.5]),
                         lost=np.zeros(4))  # fmt: skip
    assert events.chances(response)[:3].tolist() == [0.0, 0.0, 0.0]
    assert events.union(response) == pytest.approx(norm.sf(0.5 / math.sqrt(1.25)), rel=1e-6)


@pytest.mark.parametrize(("z", "cost"), [(-1.3, 2.0), (0.4, 1.0), (2.0, 0.5)])
def test_pushed_noise_costs_what_neyman_and_pearson_say(z, cost):
    assert plainly(float(norm.sf(z)), cost) == pytest.approx(norm.sf(z + cost), rel=1e-8)
    assert plainly(float(norm.sf(z)), cost) <= norm.sf(z + cost)


@pytest.mark.parametrize("start", [cb.Box([-0.5, -0.25], [0.5, 0.25]), cb.Ball([0.0, 0.0], 0.5)])
def test_a_start_on_the_side_of_the_nearest_limit_serves(start):
    system = cb.DiscreteSystem(lambda x: [x[0] + x[1], x[1]], states=2, noise=cb.Gaussian(std=0.1))
    safe = [cb.Inside(cb.Box([-np.inf, -np.inf], [0.8, np.inf]), during=(1, 1))]
    problem = cb.Problem(system, initial=start, safe=safe, horizon=1, delta=0.01)
    found = least_failing(problem)
    best = 0.75 if isinstance(start, cb.Box) else 0.5 * math.sqrt(2)
    assert bool(start.contains(found.start))
    assert found.start.sum() == pytest.approx(best, rel=1e-6)
    assert found.probability == pytest.approx(norm.sf((0.8 - best) / 0.1), rel=1e-4)
    assert least_failing(problem.replace(initial=[0.0, 0.0])) is None


BOX = cb.Inside(cb.Box([-0.7, -np.inf], [0.7, np.inf]))


def curved(safe, horizon=2.0, sigma=0.6, start=(0.0, 0.0), delta=0.01, **options):
    system = cb.ContinuousSystem(
        lambda x: [x[1], -np.sin(x[0]) - 0.5 * x[1]], states=["th", "w"], diffusion=[[0.0], [sigma]])
    return cb.Problem(system, initial=list(start), safe=safe, horizon=horizon, delta=delta, **options)


def exits(problem, paths=2000):
    found = cb.simulate_exits(problem, paths=paths, rng=np.random.default_rng(0), halve=False)
    return found.exits / paths


AVOIDED = {
    "ball": cb.Inside(cb.Ball([0.0, 0.0], 0.8)),
    "obstacle": cb.Outside(cb.Ball([0.7], 0.3, coordinates=[0])),
    "moving": cb.Outside(cb.Ball(lambda t: [1.3 - 0.4 * t], 0.3, coordinates=[0])),
    "late": cb.Inside(cb.Box([-0.5], [0.5], coordinates=[0]), during=(1.5, 1.5)),
}


@pytest.mark.parametrize("name", AVOIDED)
def test_a_pendulum_fails_at_least_as_often_as_is_proved(name):
    problem = curved([AVOIDED[name]], horizon=1.5)
    found = least_failing(problem)
    truth = exits(problem)
    assert 0.02 * truth < found.probability < truth + 4 * math.sqrt(truth / 2000)


def test_what_levels_and_pushes_cost_is_taken_off():
    problem = curved([cb.Inside(cb.Box([-np.inf, -np.inf], [0.9, np.inf]))], horizon=1.5)
    found = least_failing(problem)
    assert found.cost > 0
    assert found.levels > 0
    assert found.probability < norm.sf(found.cost - 1.0)


def test_a_system_that_fails_often_is_unsafe_at_once():
    verdict = cb.verify_safety(curved([BOX], horizon=1.0).replace(delta=1e-3), method="linear")
    assert verdict.status == "UNSAFE"
    assert "the noise breaks" in verdict.reason


def test_of_what_is_drawn_no_single_start_is_said():
    system = cb.DiscreteSystem(lambda x: 1.0 * x, states=1, noise=cb.Gaussian(std=0.1))
    problem = cb.Problem(
        system, initial=cb.GaussianStart([0.0], [[0.01]]), safe=[cb.Inside(cb.Box([-0.2], [0.2]))], horizon=3)
    assert "from what is drawn around (0) the noise breaks" in linear_below(problem).reason
    assert "from (0) the noise breaks" in linear_below(problem.replace(initial=[0.0])).reason


@pytest.mark.parametrize("options", [
    {"reach": cb.Reach(cb.Ball([0.0, 0.0], 0.1))}, {"domain": cb.Box([-3, -3], [3, 3]), "leaving": "ends"},
    {"horizon": 20.0, "delta": 0.5},
])
def test_targets_and_ends_and_what_is_seldom_have_no_such_bound(options):
    problem = curved([BOX], sigma=0.02, delta=0.5)
    assert least_failing(problem.replace(**options)) is None


def test_noise_that_follows_the_state_or_is_not_normal_has_none():
    system = cb.ContinuousSystem(lambda x: -x, states=["x"], diffusion=lambda x: [[1 + x[0] ** 2]])
    safe = [cb.Inside(cb.Box([-1], [1]))]
    assert least_failing(cb.Problem(system, initial=[0], safe=safe, horizon=1, delta=0.01)) is None
    steps = cb.DiscreteSystem(lambda x: x, states=["x"], noise=cb.Uniform(halfwidth=1.0))
    assert least_failing(cb.Problem(steps, initial=[0], safe=safe, horizon=5, delta=0.01)) is None


NARROW = cb.Inside(cb.Box([-3.0, -np.inf], [3.0, np.inf]), during=(0.4999, 0.5001))
HALF = cb.Inside(cb.Box([-np.inf], [0.5], coordinates=[0]))


def test_windows_between_the_times_of_a_grid_hide_nothing():
    both = least_failing(curved([NARROW, HALF], horizon=1.0))
    assert both.label == "th <= 0.5"
    assert both.probability > 0.02
    never = cb.Inside(cb.Box([-0.3, -np.inf], [0.3, np.inf]), during=(0.4997, 0.49971))
    assert least_failing(curved([never], horizon=1.0)) is None


def test_a_linear_model_is_followed_in_steps_whose_error_is_taken_off() -> None:
    """A turning mean that ends 1e-4 beside where the steps say: nearly every path was said to fail, and none does."""
    system = cb.ContinuousSystem(lambda x, y: [2 * y, -2 * x], states=["x", "y"], diffusion=1e-6 * np.eye(2))
    end, followed = math.cos(40.0), -0.66683076752
    limit = (end + followed) / 2
    safe = [cb.Inside(cb.HalfSpace([1.0, 0.0], limit), during=(20.0, 20.0))]
    problem = cb.Problem(system, initial=[1.0, 0.0], safe=safe, horizon=20.0)
    found = least_failing(problem)
    truth = norm.sf((limit - end) / (1e-6 * math.sqrt(20.0)))
    assert truth < 1e-20
    assert found is None or found.probability <= truth
