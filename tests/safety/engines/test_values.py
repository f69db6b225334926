"""The engine of value functions."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

import certbound as cb
import certbound.values.kolmogorov as kolmogorov
from certbound.checker import check_data, parse
from certbound.problem.problem import Problem
from certbound.safety.answers import EngineAnswer, Request
from certbound.safety.engines import values
from certbound.safety.engines.values import log10_outward, values_engine
from certbound.safety.portfolio import ENGINES
from certbound.safety.verification import verify_safety
from certbound.values.kolmogorov.door import Bounds


def logistic(**changes: object) -> Problem:
    system = cb.DiscreteSystem(lambda x: 2.8 * x * (1 - x), states=1, noise=cb.Gaussian(std=0.04))
    problem = Problem(system, initial=cb.Box([0.6], [0.7]), safe=[cb.Inside(cb.Box([0.35], [0.95]))], horizon=20)
    return problem.replace(**changes)


def test_both_sides_are_answered() -> None:
    answer = values_engine(logistic())
    assert answer.applicable
    assert answer.log10_lower is not None
    assert answer.log10_lower < math.log10(8.24e-4) < answer.log10_delta < answer.log10_lower + 0.03
    assert "at most 0.0008" in answer.reason


def test_a_verdict_by_name_is_safe_or_says_that_it_cannot_be() -> None:
    assert verify_safety(logistic(), method="values").status == "SAFE"
    strict = verify_safety(logistic(delta=5e-4), method="values")
    assert strict.status == "UNSAFE"
    assert "more than the 0.0005 that is asked" in strict.reason


def test_auto_takes_the_engine_where_the_others_prove_too_little() -> None:
    system = cb.DiscreteSystem(lambda x: x - 0.3 * x**3, states=1, noise=cb.Gaussian(std=0.2))
    problem = Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-1.6], [1.6]))], horizon=10)
    verdict = verify_safety(problem)
    assert verdict.status == "SAFE"
    assert verdict.method == "values"
    report = check_data(parse(verdict.certificate_text(problem)))
    assert report.valid
    assert verdict.log10_delta - 1e-9 <= report.log10_delta <= math.log10(problem.delta)


def test_it_is_left_out_when_another_engine_has_answered() -> None:
    assert not values_engine(logistic(), Request(quick=True)).applicable


@pytest.mark.parametrize(
    ("problem", "words"),
    [
        (Problem(cb.DiscreteSystem(lambda x: 0.5 * x, states=4, noise=cb.Gaussian(std=0.1)), initial=np.zeros(4),
                 safe=[cb.Inside(cb.Box([-1] * 4, [1] * 4))], horizon=2), "at most 3 states"),
        (Problem(cb.DiscreteSystem(lambda x: 0.5 * x, states=1, noise=cb.SubGaussian(proxy_std=0.1)), initial=[0.0],
                 safe=[cb.Inside(cb.Box([-1], [1]))], horizon=2), "class of laws"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_said_in_words(problem: Problem, words: str) -> None:
    answer = values_engine(problem)
    assert not answer.applicable
    assert words in answer.reason


@pytest.mark.parametrize("probability", [1.0, 0.3, 1e-3, 2.5e-11, 0.0])
def test_logarithms_are_rounded_outward(probability: float) -> None:
    up, down = log10_outward(probability, up=True), log10_outward(probability, up=False)
    assert 10.0**up >= probability * (1 - 1e-15)
    assert down <= up <= 0.0


def test_a_window_that_bounds_no_state_beyond_it_is_served() -> None:
    system = cb.DiscreteSystem(lambda x: 0.9 * x, states=1, noise=cb.Gaussian(std=0.1), noise_matrix=lambda x: [[x[0]]])
    within = cb.Inside(cb.Box([-1], [1]), during=(1, 2))
    answer = values_engine(Problem(system, initial=[0.3], safe=[within], horizon=3))
    assert answer.applicable
    assert answer.log10_delta < -10


def test_the_backward_equation_is_solved_briefly_first_and_in_full_once_nothing_else_is_proved(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The second request goes on where the first one ended."""
    asked: list[float] = []
    known: list[Bounds | None] = []

    def bound_failing(
        problem: Problem, *, seconds: float, delta: float, before: Bounds | None = None
    ) -> Iterator[Bounds]:  # fmt: skip
        asked.append(seconds)
        known.append(before)
        yield Bounds(lower=0.0, upper=0.5, cells=(9, 9), steps=9, runs=1, estimate=0.2, work=1.0)

    monkeypatch.setattr(kolmogorov, "bound_failing", bound_failing)
    nothing = EngineAnswer(applicable=False, reason="nothing")
    for name, row in ENGINES.items():
        if name != "backward":
            monkeypatch.setitem(ENGINES, name, replace(row, prove=lambda *given: nothing, below=None))
    system = cb.ContinuousSystem(lambda x: [x[1], -x[0]], states=2, diffusion=[[0.0], [0.5]])
    safe = [cb.Inside(cb.Box([-1, -3], [1, 3]))]
    assert verify_safety(Problem(system, initial=[0, 0], safe=safe, horizon=4.0, delta=0.1)).status == "UNKNOWN"
    assert asked[-1] == values._BACKWARD
    assert asked[0] <= 0.5 * values._BACKWARD
    assert known[0] is None
    assert known[-1] is not None
