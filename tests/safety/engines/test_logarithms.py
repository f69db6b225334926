"""Engines in logarithms of states whose noise is in proportion to them."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from statistics import NormalDist
from typing import Any

import numpy as np
import pytest
from flint import arb

import certbound as cb
from certbound.checker import check_data
from certbound.checker.reading import Record
from certbound.checker.report import Budget
from certbound.checker.statement import read_model
from certbound.checker.statement.by_ito import logarithmic_model
from certbound.problem.model import Tape, compile_numpy
from certbound.rigor.balls import precision
from certbound.safety.answers import AS_IT_IS, EngineAnswer, Request
from certbound.safety.certificate import certificate_text, problem_data
from certbound.safety.engines import Logarithmic, by_logarithms, linear_engine
from certbound.safety.engines.turning import logarithmic
from certbound.safety.verdict import verdict_of


def prices(**changes: Any) -> cb.Problem:
    """A price with noise in proportion, and its limits."""
    system = cb.ContinuousSystem(lambda x: 0.05 * x, states=["p"], diffusion=lambda x: [[0.2 * x[0]]])
    safe = [cb.Inside(cb.Box([0.5], [2.0])), cb.Inside(cb.HalfSpace([1.0], 3.0))]
    return cb.Problem(system, **{"initial": [1.0], "safe": safe, "horizon": 1.0, "delta": 0.01} | changes)


def stated(problem: cb.Problem) -> cb.Problem:
    """The same in logarithms."""
    found = logarithmic(problem)
    assert found is not None
    return found[1]


def stocks() -> cb.Problem:
    """Prey and hunters in a push from outside, noise in proportion in the first alone."""
    system = cb.ContinuousSystem(
        lambda x, d: [x[0] * (1.1 - 0.4 * x[1]) + 0.3, x[0] * x[0] * x[1] / (1 + x[0]) - x[1] + d[0] * x[1]],
        states=["prey", "hunters"], disturbance=cb.Box([-0.1], [0.1]),
        diffusion=lambda x: [[0.1 * x[0] - 0.02 * x[0] * x[1], 0.05 * x[0]], [0.03, 0.1 * x[1]]],
    )  # fmt: skip
    box = cb.Inside(cb.Box([0.5, 0.4], [3.0, 4.0]))
    return cb.Problem(system, initial=[1.0, 2.0], safe=[box], horizon=0.5, delta=0.2)


def test_the_rates_are_those_of_itos_formula_and_the_checker_derives_the_same() -> None:
    problem = stocks()
    places, other = logarithmic(problem) or ((), problem)
    assert places == (0,)
    model = read_model(json.loads(json.dumps(problem_data(problem))), Budget(math.inf))
    proof = Record({"engine": "logarithms", "states": [0], "proof": {}}, "proof", ("engine", "states", "proof"))
    derived = logarithmic_model(model, proof)
    assert isinstance(derived.noise.diffusion, Tape)
    assert isinstance(other.system.diffusion, Tape)
    for x, y, d in ((0.7, 0.5, 0.1), (2.5, 3.0, -0.05)):
        f = [x * (1.1 - 0.4 * y) + 0.3, x * x * y / (1 + x) - y + d * y]
        g = np.array([[0.1 * x - 0.02 * x * y, 0.05 * x], [0.03, 0.1 * y]])
        rates = [f[0] / x - 0.5 * (g[0] ** 2).sum() / x**2, f[1]]
        for dynamics, diffusion in (
            (other.system.dynamics, other.system.diffusion), (derived.dynamics, derived.noise.diffusion)
        ):  # fmt: skip
            assert compile_numpy(dynamics)(0.0, math.log(x), y, d) == pytest.approx(rates, rel=1e-13)
            gains = np.asarray(compile_numpy(diffusion)(0.0, math.log(x), y), dtype=float)
            assert gains.reshape(2, 2) == pytest.approx(np.vstack([g[:1] / x, g[1:]]), rel=1e-13)


def test_noise_in_proportion_is_constant_and_both_sides_round_limits_alike() -> None:
    problem = prices()
    other = stated(problem)
    assert other.system.diffusion.tolist() == [[0.2]]
    model = read_model(json.loads(json.dumps(problem_data(problem))), Budget(math.inf))
    proof = Record({"engine": "logarithms", "states": [0], "proof": {}}, "proof", ("engine", "states", "proof"))
    with precision():
        derived = logarithmic_model(model, proof)
    assert derived.noise.constant()[0, 0] == arb(0.2)
    assert derived.by_ito
    box, half = (one.region for one in derived.constraints)
    assert [-box.bounds[1], box.bounds[0]] == [*other.safe[0].region.low, *other.safe[0].region.high]
    assert half.bounds == [other.safe[1].region.bound]
    assert half.bounds[0] <= math.nextafter(math.log(3), math.inf)


def test_the_bound_of_a_price_is_above_the_truth_and_near_it() -> None:
    answer = linear_engine(stated(prices()))
    normal, drift, sigma, limit = NormalDist(), 0.05 - 0.02, 0.2, math.log(2)
    truth = sum(
        normal.cdf((a - limit) / sigma) + math.exp(2 * a * limit / sigma**2) * normal.cdf((-limit - a) / sigma)
        for a in (drift, -drift)
    )  # of both limits, each by itself: the reflection principle
    assert math.log10(truth) - 1e-3 < answer.log10_delta < math.log10(truth) + 0.5


def test_constant_noise_in_logarithms_is_no_leave_to_foresee() -> None:
    system = cb.ContinuousSystem(
        lambda x, d: [0.05 * x[0] + d[0] * x[0], 0.01 * x[1]], states=["p", "q"], disturbance=cb.Box([-0.05], [0.05]),
        diffusion=lambda x: [[0.2 * x[0], 0.0], [0.05 * x[1], 0.1 * x[1]]],
    )  # fmt: skip
    safe = [cb.Inside(cb.Box([0.5, 0.5], [2.0, 2.0]))]
    problem = cb.Problem(system, initial=[1.0, 1.0], safe=safe, horizon=1.0, delta=0.1)
    assert linear_engine(stated(problem)).foresight
    answer = by_logarithms(linear_engine)(problem, AS_IT_IS)
    assert isinstance(answer.details, Logarithmic)
    assert not answer.foresight
    assert "in the coordinates log p, log q" in answer.reason
    assert re.search("the largest part of that probability is .* for '[pq] [<>]= (0.5|2)'", answer.reason)
    report = check_data(json.loads(certificate_text(problem, verdict_of(problem, {"linear": answer}))))
    assert report.valid
    assert "does not see coming noise" in report.claim


@pytest.mark.parametrize(
    "safe",
    [
        [cb.Inside(cb.Box([0.0], [2.0]))],
        [cb.Inside(cb.Box([0.5], [2.0]), during=(0, 0.5))],
        [cb.Inside(cb.Box([0.5], [2.0])), cb.Inside(cb.Ball([1.0], 5.0))],
        [cb.Outside(cb.Box([-1.0], [0.5])), cb.Inside(cb.HalfSpace([1.0], 3.0))],
    ],
)
def test_states_that_no_limit_keeps_positive_or_that_are_asked_for_otherwise_stay(safe: list[Any]) -> None:
    assert logarithmic(prices(safe=safe)) is None


def test_obstacles_grow_and_limits_shrink() -> None:
    safe = [cb.Inside(cb.Box([0.5], [3.0])), cb.Outside(cb.Box([2.0], [2.5]))]
    other = stated(prices(safe=safe)).safe[1].region
    assert other.low[0] <= math.log(2.0)
    assert other.high[0] >= math.log(2.5)
    assert max(abs(other.low[0] - math.log(2.0)), abs(other.high[0] - math.log(2.5))) < 1e-15


def test_for_lower_bounds_all_is_rounded_the_other_way() -> None:
    safe = [cb.Inside(cb.Box([0.5], [3.0])), cb.Outside(cb.Box([2.0], [2.5]))]
    problem = prices(safe=safe, initial=cb.Box([0.9], [1.1]))
    above, below = stated(problem), (logarithmic(problem, below=True) or ((), problem))[1]
    inner, outer = above.initial.hull(), below.initial.hull()
    with precision():
        assert arb(float(outer.lo[0])) > arb(0.9).log() > arb(float(inner.lo[0]))
        assert arb(float(outer.hi[0])) < arb(1.1).log() < arb(float(inner.hi[0]))
        for k, sign, ends in ((0, 1, (0.5, 3.0)), (1, -1, (2.0, 2.5))):  # limits are wider, obstacles smaller
            narrow, wide = above.safe[k].region, below.safe[k].region
            assert sign * (arb(ends[0]).log() - arb(float(wide.low[0]))) > 0 > sign * (
                arb(ends[0]).log() - arb(float(narrow.low[0]))
            )
            assert sign * (arb(float(wide.high[0])) - arb(ends[1]).log()) > 0 > sign * (
                arb(float(narrow.high[0])) - arb(ends[1]).log()
            )
    with pytest.raises(cb.InfeasibleError, match="no logarithm"):
        logarithmic(prices(initial=[1.1]), below=True)
    with pytest.raises(cb.InfeasibleError, match="no box"):
        logarithmic(prices(initial=cb.Ball([1.0], 0.1)), below=True)


def test_a_lower_bound_in_logarithms_is_proved_of_fewer_starts() -> None:
    problem = stocks().replace(initial=cb.Box([0.9, 1.9], [1.1, 2.1]))
    first = stated(problem)

    def prove(given: cb.Problem, asked: Request = AS_IT_IS) -> EngineAnswer:
        plain, narrow = given is problem, given.initial.hull().lo[0] == first.initial.hull().lo[0]
        lower = {(True, False): -3.0, (False, True): -1.0, (False, False): -1.5}[plain, narrow and not plain]
        return EngineAnswer(log10_delta=-0.3 if plain else -0.5, log10_lower=lower, reason="so.", method="values")

    found = by_logarithms(prove, again=True)(problem, replace(AS_IT_IS, thorough=True))
    assert (found.log10_delta, found.log10_lower) == (-0.5, -1.5)
    assert isinstance(found.details, Logarithmic)
    assert found.details.plain.log10_lower == -3.0  # what certificates state


def test_a_lower_bound_that_is_hoped_for_in_logarithms_is_asked_for_once() -> None:
    problem = stocks().replace(initial=cb.Box([0.9, 1.9], [1.1, 2.1]))
    asked_for = []

    def prove(given: cb.Problem, asked: Request = AS_IT_IS) -> EngineAnswer:
        assert given is not problem  # what is hoped for is near enough
        asked_for.append((asked.above, asked.below))
        if asked.above:
            return EngineAnswer(log10_delta=-0.5, hoped=-0.9, reason="so.", method="values")
        return EngineAnswer(log10_lower=-0.8, reason="so.", method="values")

    found = by_logarithms(prove)(problem, AS_IT_IS)
    assert (found.log10_delta, found.log10_lower) == (-0.5, -0.8)
    assert asked_for == [(True, False), (False, True)]
