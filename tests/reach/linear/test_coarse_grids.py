"""Grids with too few pieces of time are tried before a fine one: each is a proof, and none is worse for it."""

from __future__ import annotations

import math

import numpy as np
import pytest

import certbound as cb
from certbound.reach.linear import LinearAnswer, linear_answer
from certbound.reach.linear.hopes import coarser
from certbound.reach.linear.linearisation import Linearisation


def fast_actuator(sigma: float = 0.02, delta: float = 1e-3) -> cb.Problem:
    """A pendulum whose motor follows a feedback within a hundredth of a second, and a filter."""
    system = cb.ContinuousSystem(
        lambda x: [x[1], -np.sin(x[0]) - x[1] + x[2], 40 * (-x[0] - x[1] - x[2]), x[0] - x[3]], states=4,
        diffusion=[[0.0], [sigma], [0.0], [0.0]],
    )
    safe = [cb.Inside(cb.Box([-0.5, -np.inf, -np.inf, -np.inf], [0.5, np.inf, np.inf, np.inf]))]
    start = cb.Box([0.1, 0, -0.1, 0], [0.12, 0.01, -0.1, 0])
    return cb.Problem(system, initial=start, safe=safe, horizon=0.6, delta=delta)


def test_a_bound_that_meets_delta_is_found_on_a_grid_that_is_not_dear() -> None:
    problem, told = fast_actuator(), []
    counts = coarser(problem, 1)
    assert counts == sorted(counts)
    assert counts[-1] < Linearisation.of(problem).pieces
    answer = linear_answer(problem, found=told.append)
    assert isinstance(answer, LinearAnswer)
    assert answer.run.engine.pieces in counts
    assert answer.log10_delta <= -3
    assert told[-1].log10_delta == answer.log10_delta


def test_grids_are_as_they_were_where_they_are_cheap() -> None:
    linear = cb.ContinuousSystem(lambda x: [x[1], -50 * x[1], x[3], -x[2]], states=4, diffusion=np.eye(4))
    assert coarser(cb.Problem(linear, initial=[0.0] * 4, safe=[], horizon=1.0), 1) == []
    assert coarser(fast_actuator().replace(horizon=0.1), 1) == []
    assert coarser(cb.load("pendulum"), 1) == []


def test_a_first_bound_is_kept_where_a_finer_grid_proves_less(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = fast_actuator(sigma=1.0)
    first: list[LinearAnswer] = []

    def lost(*_: object) -> None:
        raise LookupError

    monkeypatch.setattr("certbound.reach.linear.answer.best_of", lost)
    with pytest.raises(LookupError):  # at the fine grid, after the coarse ones
        linear_answer(problem, found=first.append)
    assert first
    assert math.log10(problem.delta) < first[-1].log10_delta < 0
