"""Noise that jumps at known times, in one state: phases on either side."""

from __future__ import annotations

import operator
from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.problem.model import between_jumps
from certbound.values.continuous import bound_exits
from tests.values.line_truth import bracket


def _problem(gain: Any, drift: Any = lambda t, x: -x, horizon: float = 2.0) -> cb.Problem:
    system = cb.ContinuousSystem(drift, states=1, diffusion=gain)
    return cb.Problem(system, initial=[0.0], safe=[cb.Inside(cb.Box([-1.0], [1.0]))], horizon=horizon)


@pytest.mark.usefixtures("lighter")
def test_noise_that_jumps_is_bounded_closely_from_both_sides() -> None:
    problem = _problem(lambda t: [[np.where(t < 1, 0.2, 0.5)]])
    found = bound_exits(problem, seconds=0.2)
    assert found.lower is not None
    low, high = bracket(problem, -2.0, 2.0, cells=400, steps=150)
    lower, upper = 10**found.lower, 10**found.upper
    assert low / 1.2 <= lower <= 1.01 * high
    assert 0.99 * low <= upper <= 1.1 * high


def test_between_jumps_a_model_is_what_it_says_there() -> None:
    system = cb.ContinuousSystem(lambda t, x: np.where(t < 0.3, x, 2 * x) + np.floor(t), states=1, diffusion=1.0)
    parts = between_jumps(system.dynamics, 1, 1.5)
    assert [end for end, _ in parts] == [0.3, 1.0, 1.5]
    for (_, tape), t, value in zip(parts, (0.1, 0.5, 1.2), (1.0, 2.0, 3.0)):
        assert tape.evaluate(_FLOATS, [t, 1.0]) == [value]
        assert not any(node.op in ("lt", "floor") for node in tape.nodes)
    plain = cb.ContinuousSystem(lambda t, x: np.sin(t) * x, states=1, diffusion=1.0).dynamics
    assert between_jumps(plain, 1, 1.5) == [(1.5, plain)]


_FLOATS: dict[str, Any] = {
    "const": float, "add": operator.add, "sub": operator.sub, "mul": operator.mul, "neg": operator.neg,
}  # fmt: skip


def test_noise_that_vanishes_for_a_while_is_refused() -> None:
    with pytest.raises(cb.InfeasibleError, match="noise of full rank"):
        bound_exits(_problem(lambda t: [[np.where(t < 1, 0.0, 0.5)]]), seconds=0.2)
