"""Verdicts on limits that move: near the truth where engines serve what rests, and never as if it stood still."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

import certbound as cb
from certbound.errors import CertificateError, EngineError, InfeasibleError, contained
from certbound.safety.answers import EngineAnswer, Request
from certbound.safety.certificate import problem_data
from certbound.safety.portfolio import ENGINES
from certbound.safety.verdict import verdict_of

TIME = cb.ContinuousSystem(lambda x: -x, states=["x"], diffusion=0.5)
PLANE = cb.ContinuousSystem(lambda x: [x[1] - x[0], -x[0] - x[1]], states=["x", "y"], diffusion=0.3 * np.eye(2))
STEPS = cb.DiscreteSystem(lambda x: 0.8 * x, states=["x"], noise=cb.Gaussian(std=0.2))
PAIRS = cb.DiscreteSystem(lambda x: 0.8 * x, states=["x", "y"], noise=cb.Gaussian(std=0.2))


def falling(t: Any) -> Any:
    return 1 - 0.2 * t


def moving_sets(n: int) -> list[cb.Inside]:
    """Sets of every kind whose sides move; at time 0 most of them are much larger than later."""
    e, eye = np.eye(n)[0], np.eye(n)
    return [
        cb.Inside(cb.Box([-1] * n, [falling, *[1] * (n - 1)])),
        cb.Inside(cb.HalfSpace(e, falling)),
        cb.Inside(cb.Ball(np.zeros(n), falling)),
        cb.Inside(cb.Polytope(np.vstack([eye, -eye]), [falling, *[1] * (2 * n - 1)])),
        cb.Outside(cb.Ball(2 + np.zeros(n), lambda t: 0.5 + 0.3 * t)),
        cb.Outside(cb.Box([lambda t: 1.5 - 0.3 * t, *[-1] * (n - 1)], [3] * n)),
        cb.Outside(cb.HalfSpace(-e, lambda t: 0.2 * t - 1)),
    ]


def asked(name: str, ask: Any, problem: cb.Problem) -> Any:
    """What an engine answers; None where it refuses, in words of its own."""
    try:
        with contained(name):
            return ask(problem)
    except EngineError as error:
        if "defect" in str(error):
            raise
        return None


@pytest.mark.parametrize("name", ENGINES)
@pytest.mark.parametrize("system", [TIME, PLANE, STEPS, PAIRS])
def test_no_engine_takes_a_side_that_moves_for_one_that_rests(name: str, system: Any) -> None:
    n, row = system.dimension, ENGINES[name]
    for constraint in moving_sets(n):
        problem = cb.Problem(system, initial=np.zeros(n), safe=[constraint], horizon=2, delta=0.3)
        for ask in (lambda one: row.prove(one, Request()), lambda one: row.below and row.below(one)):
            answer = asked(name, ask, problem)
            assert answer is None or not answer.applicable, constraint.label


def test_nothing_else_takes_a_side_that_moves_for_one_that_rests() -> None:
    problem = cb.Problem(TIME, initial=[0], safe=[cb.Inside(cb.HalfSpace([1], falling))], horizon=2, delta=0.3)
    for ask in (
        cb.bound_metrics,
        lambda one: cb.bound_reach(one).distance_to(one.safe[0]),
        cb.synthesize if hasattr(cb, "synthesize") else cb.bound_metrics,
    ):
        with pytest.raises((InfeasibleError, ValueError), match=r"mov|inputs"):
            ask(problem)


def test_bounds_of_discrete_limits_that_move_hold_a_simulation() -> None:
    safe = [cb.Inside(cb.Box([lambda t: -0.9 * np.exp(-0.05 * t)], [lambda t: 0.9 * np.exp(-0.05 * t)]))]
    problem = cb.Problem(STEPS, initial=[0], safe=safe, horizon=10, delta=0.2)
    found = cb.verify_safety(problem, method="values")
    counts = cb.simulate_exits(problem, paths=40_000, rng=np.random.default_rng(0))
    assert found.log10_lower is not None
    assert counts.lower - 0.01 <= 10**found.log10_lower <= 10**found.log10_delta <= counts.upper + 0.01
    assert 10**found.log10_delta < 1.02 * 10**found.log10_lower
    assert found.status == "UNSAFE"
    assert "step by step" in found.reason
    still = problem.replace(safe=[cb.Inside(cb.Box([-0.9], [0.9]))])
    assert cb.verify_safety(still, method="values").log10_delta < found.log10_delta - 0.1


@pytest.mark.slow
def test_bounds_of_a_bound_that_collapses_hold_its_closed_form() -> None:
    v, a, k, T = -1.0, 1.2, 0.25, 1.0
    system = cb.ContinuousSystem(lambda x: v + 0 * x, states=["x"], diffusion=1.0)
    safe = [cb.Inside(cb.HalfSpace([1], lambda t: a - k * t))]
    problem = cb.Problem(system, initial=[0], safe=safe, horizon=T, delta=0.1)
    m = v + k  # the distance to the line is a Brownian motion with this drift
    truth = norm.cdf((m * T - a) / np.sqrt(T)) + np.exp(2 * m * a) * norm.cdf((-m * T - a) / np.sqrt(T))
    found = cb.verify_safety(problem, method="values")
    assert found.log10_lower is not None
    assert 10**found.log10_lower <= truth <= 10**found.log10_delta <= 1.05 * truth


@pytest.mark.slow
def test_a_target_that_comes_nearer_is_bounded_from_both_sides() -> None:
    system = cb.ContinuousSystem(lambda x: 0.8 - x, states=["x"], diffusion=0.5)
    safe = [cb.Inside(cb.HalfSpace([-1], lambda t: np.exp(-t / 2)))]
    target = cb.HalfSpace([-1], lambda t: -np.exp(-t / 2))
    problem = cb.Problem(system, initial=[0], safe=safe, reach=target, horizon=2, delta=0.2)
    found = cb.verify_safety(problem, method="values", time_limit=10)
    assert found.status == "SAFE"
    counts = cb.simulate_exits(problem, paths=40_000, rng=np.random.default_rng(0))
    assert counts.lower - 0.002 <= 10**found.log10_delta <= 1.25 * counts.probability
    assert found.log10_lower is None or 10**found.log10_lower <= counts.upper + 0.002


def test_no_certificate_states_limits_that_move_and_it_is_said_why() -> None:
    problem = cb.Problem(STEPS, initial=[0], safe=[cb.Inside(cb.HalfSpace([1], falling))], horizon=3, delta=0.3)
    found = cb.verify_safety(problem)
    assert found.status == "SAFE"
    assert found.certificate is None
    with pytest.raises(CertificateError, match="no certificate states limits that move"):
        found.certificate_text(problem)


def test_centers_that_move_are_certified_where_the_problem_is_proved_as_it_is() -> None:
    safe = [cb.Inside(cb.Box([-2], [2], center=lambda t: [0.2 * t]))]
    problem = cb.Problem(TIME, initial=[0], safe=safe, horizon=1, delta=0.01)
    found = cb.verify_safety(problem)
    assert found.status == "SAFE"
    assert json.loads(found.certificate_text(problem))["claim"]


def test_times_of_leaving_limits_that_move_hold_a_simulation() -> None:
    safe = [cb.Inside(cb.Box([-0.9], [lambda t: 0.9 * np.exp(-0.05 * t)]))]
    problem = cb.Problem(STEPS, initial=[0], safe=safe, horizon=6, delta=0.2)
    found = cb.bound_exit_times(problem, times=[3, 6])
    for k, low, high in zip((3, 6), found.lower, found.upper, strict=True):
        counts = cb.simulate_exits(problem.replace(horizon=k), paths=40_000, rng=np.random.default_rng(0))
        assert counts.lower - 0.002 <= low <= high <= counts.upper + 0.004
    assert found.mean_lower > 5


def test_a_problem_whose_sides_move_is_compared_with_no_certificate() -> None:
    problem = cb.Problem(TIME, initial=[0], safe=[cb.Inside(cb.HalfSpace([1], falling))], horizon=2, delta=0.3)
    with pytest.raises(CertificateError, match="no certificate states limits that move"):
        problem_data(problem)


def test_safe_starts_are_those_at_time_0() -> None:
    safe = [cb.Inside(cb.Box([lambda t: -1 - 0 * t], [falling]))]
    problem = cb.Problem(STEPS, initial=[0], safe=safe, horizon=3, delta=0.2)
    starts = cb.verify_safety(problem, method="values").safe_starts()
    high = max(box[0][1] for box in starts.boxes.tolist())
    assert 0 < high < 1
    edge = cb.simulate_exits(problem.replace(initial=[high]), paths=40_000, rng=np.random.default_rng(0))
    assert edge.lower <= 0.2


def test_stated_constants_are_not_those_of_coordinates_that_move() -> None:
    problem = cb.Problem(TIME, initial=[0], safe=[cb.Inside(cb.HalfSpace([1], falling))], horizon=2, delta=0.3)
    found = cb.verify_safety(problem, constants=cb.Constants(rate=-1.0, sigma=0.5, dimension=1))
    assert found.status == "UNKNOWN"
    assert "stated constants" in found.reason


def test_what_is_not_served_is_unknown_and_says_what_would_work() -> None:
    jumps = cb.Inside(cb.HalfSpace([1], lambda t: np.where(t < 1, 1.0, 0.9)))
    found = cb.verify_safety(cb.Problem(TIME, initial=[0], safe=[jumps], horizon=2, delta=0.3))
    assert found.status == "UNKNOWN"
    assert "during" in found.reason


def test_a_ball_that_rests_and_one_that_moves_are_not_brought_to_rest_by_turns(monkeypatch: Any) -> None:
    searched: list[list[bool]] = []

    def found(problem: cb.Problem, *_: Any, **__: Any) -> cb.Verdict:
        searched.append([one.region.moving for one in problem.safe])
        assert len(searched) < 9, "each ball is brought to rest by what lets another one move"
        return verdict_of(problem, {"linear": EngineAnswer(applicable=False, reason="nothing.")}, "linear")

    monkeypatch.setattr("certbound.safety.decision._searched", found)
    swinging, resting = cb.Ball(lambda t: [0.1 * np.sin(t), 0.0], 0.5), cb.Ball([0.0, 0.0], 0.4)
    problem = cb.Problem(PLANE, initial=[0, 0], safe=[cb.Inside(swinging), cb.Inside(resting)], horizon=2, delta=1e-9)
    assert cb.verify_safety(problem).status == "UNKNOWN"
    assert searched == [[True, False], [False, True]]
    searched.clear()
    falling_ball = cb.Ball(lambda t: [0.0, -0.1 * t], 0.6)
    three = problem.replace(safe=[*problem.safe[:1], cb.Inside(falling_ball)])
    assert cb.verify_safety(three).status == "UNKNOWN"
    assert searched == [[True, True], [False, True], [True, False]]
    searched.clear()
    closing = cb.Ball(lambda t: [0.1 * np.sin(t), 0.0], lambda t: 0.5 - 0.1 * t)
    assert cb.verify_safety(problem.replace(safe=[cb.Inside(closing), cb.Inside(resting)])).status == "UNKNOWN"
    assert searched == 2 * [[False, True], [True, False]]  # from above and from below
