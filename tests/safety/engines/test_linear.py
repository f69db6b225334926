"""The linear-response engine among the others: what it must not answer."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.checker import check_data, parse
from certbound.safety.certificate import certificate_text

JUMPS = {
    "step": lambda x: [0.5 * x[0] + np.where(x[0] > 0.2, 0.8, 0.0)],
    "sign": lambda x: [0.5 * x[0] + 0.8 * np.sign(x[0] - 0.2)],
    "floor": lambda x: [0.5 * x[0] + 0.8 * np.floor(x[0] / 0.2)],
}


def stepping(move: Any, states: list[str] | None = None, **changes: Any) -> cb.Problem:
    names = states or ["x"]
    system = cb.DiscreteSystem(move, states=names, noise=cb.Gaussian(std=0.1))
    box = cb.Box([-2.0] * len(names), [0.9] * len(names))
    given = {"initial": [0.1] * len(names), "safe": [cb.Inside(box)], "horizon": 4, "delta": 1e-3, **changes}
    return cb.Problem(system, **given)


@pytest.mark.parametrize("kind", JUMPS)
def test_a_jump_in_a_state_that_enters_linearly_otherwise_is_not_overlooked(kind: str) -> None:
    """The derivative of a step is 0: the linearisation alone proves 1e-13 where a tenth of the paths exit."""
    problem = stepping(JUMPS[kind])
    verdict = cb.verify_safety(problem, method="linear")
    assert verdict.status == "UNKNOWN"
    assert "may jump" in verdict.answers["linear"].reason
    both = cb.verify_safety(problem)
    assert (both.method, both.status) in (("values", "SAFE" if kind == "sign" else "UNSAFE"),)
    if kind == "step":
        assert cb.simulate_exits(problem, paths=10_000, rng=1, halve=False).lower > 0.01


def test_the_same_in_continuous_time_and_through_another_state() -> None:
    system = cb.ContinuousSystem(lambda x: [-x[0] + np.where(x[0] > 0.2, 5.0, 0.0)], states=["x"], diffusion=[[0.1]])
    problem = cb.Problem(system, initial=[0.1], safe=[cb.Inside(cb.Box([-2], [0.9]))], horizon=1.0)
    assert cb.verify_safety(problem, method="linear").status == "UNKNOWN"
    coupled = stepping(lambda x: [0.5 * np.sin(x[0]) + np.where(x[1] > 0.2, 2.0, 0.0), 0.5 * x[1]], ["x", "y"])
    verdict = cb.verify_safety(coupled, method="linear")
    assert verdict.status == "UNKNOWN"
    assert "with y" in verdict.reason


def test_a_jump_in_time_is_answered() -> None:
    problem = stepping(lambda t, x: [0.5 * x[0] + np.where(t > 1.5, 0.1, 0.0)])
    verdict = cb.verify_safety(problem, method="linear")
    assert verdict.status == "SAFE"
    assert check_data(parse(certificate_text(problem, verdict))).valid


def test_reach_tubes_do_not_overlook_it_either() -> None:
    problem = stepping(JUMPS["step"])
    for noise in (True, False):
        with pytest.raises(ArithmeticError, match="may jump"):
            cb.bound_reach(problem, noise=noise, method="linear")
