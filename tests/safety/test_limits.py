"""What `find_limits` says would be SAFE is SAFE, and nearly the most that would be."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import log_ndtr

import certbound as cb
from certbound.safety import limits
from certbound.safety.limits import Limits, find_limits, smaller_verdicts
from certbound.safety.verdict import Verdict


def walk(bound: float = 4.0, sigma: float = 1.0, steps: int = 16) -> cb.Problem:
    """A random walk: over k steps its exit probability is close to 4 Q(bound / (sigma sqrt(k)))."""
    system = cb.linear_system([[1.0]], noise=cb.Gaussian(std=sigma))
    safe = [cb.Inside(cb.Box([-bound], [bound]))]
    return cb.Problem(system, initial=[0.0], safe=safe, horizon=steps, delta=1e-3)


def status(problem: cb.Problem) -> str:
    return cb.verify_safety(problem, method="linear").status


def test_limits_of_a_random_walk() -> None:
    verdict = cb.verify_safety(walk(), method="linear")
    assert verdict.status == "UNSAFE"
    found = find_limits(verdict)
    assert found.delta == pytest.approx(10**verdict.log10_delta)
    assert status(walk(steps=int(found.horizon))) == "SAFE"
    assert status(walk(steps=int(found.horizon) + 1)) != "SAFE"
    assert status(walk(sigma=found.noise)) == "SAFE"
    assert status(walk(sigma=1.3 * found.noise)) != "SAFE"
    assert status(walk(bound=4.0 + found.widening)) == "SAFE"
    assert status(walk(bound=4.0 + 0.7 * found.widening)) != "SAFE"
    assert "SAFE would be: delta" in found.summary()


def test_of_an_infinite_horizon_finite_ones_are_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    first = cb.verify_safety(walk(), method="linear")
    forever = replace(first, problem=walk().replace(horizon=math.inf))

    def decided(problem: cb.Problem, **_: object) -> Verdict:
        return replace(first, status="SAFE" if problem.horizon <= 100 else "UNKNOWN")

    monkeypatch.setattr(limits, "decide", decided)
    assert find_limits(forever).horizon == 64


def drift(factor: float = 1.0) -> cb.Problem:
    system = cb.ContinuousSystem(
        lambda x: -x, states=1, diffusion=lambda x: np.array([[factor * (0.5 + 0.1 * np.tanh(x[0]))]])
    )
    return cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=1.0, delta=1e-2)


@pytest.mark.slow
def test_noise_that_depends_on_the_state_is_scaled() -> None:
    verdict = cb.verify_safety(drift(), method="constants")
    assert verdict.status == "UNKNOWN"
    found = find_limits(verdict)
    assert cb.verify_safety(drift(found.noise), method="constants").status == "SAFE"
    assert cb.verify_safety(drift(1.3 * found.noise), method="constants").status == "UNKNOWN"


def test_a_safe_verdict_is_refused() -> None:
    with pytest.raises(ValueError, match="not SAFE"):
        find_limits(cb.verify_safety(walk(bound=40.0), method="linear"))


def test_the_smallest_probability_is_proved_and_far_below_what_was_asked() -> None:
    problem = cb.load("chain_rest")
    first = cb.verify_safety(problem)
    *_, best = smaller_verdicts(first)
    assert best.status == "SAFE"
    assert best.log10_delta < 2 * first.log10_delta
    assert cb.verify_safety(problem.replace(delta=best.problem.delta)).status == "SAFE"
    with pytest.raises(ValueError, match="SAFE one"):
        next(smaller_verdicts(cb.verify_safety(walk(), method="linear")))


def test_the_smallest_probability_is_near_the_truth_where_that_is_known() -> None:
    verdict = cb.verify_safety(walk(bound=20.0), method="linear")
    best = [verdict, *smaller_verdicts(verdict, method="linear")][-1]
    truth = np.log10(4) + log_ndtr(-20.0 / 4.0) / np.log(10)
    assert truth - 0.6 < best.log10_delta <= verdict.log10_delta


def test_what_would_be_safe_is_rounded_to_the_side_that_was_proved() -> None:
    found = Limits(delta=0.0012341, horizon=1.23459, noise=0.98765, widening=0.12341)
    assert found.summary() == (
        "SAFE would be: delta = 0.00124, or a horizon of 1.234, or noise 0.987 times as large, "
        "or constraints moved outward by 0.124."
    )
