"""Bounds for noise in one of two coordinates, against simulation."""

from __future__ import annotations

import math

import numpy as np
import pytest

import certbound as cb
from certbound.problem.model import compile_numpy
from certbound.safety.engines.values import values_engine
from certbound.values.semilagrangian import bound_exits_by_steps
from certbound.values.semilagrangian.exits import bound_by_steps
from certbound.values.semilagrangian.layout import Plan
from certbound.values.semilagrangian.setting import setting_of

COARSE = Plan(count=24, fine=0.8, wide=0.008, cell=0.35, spare=1e-7)


def mechanical(force, s: float, low, high, horizon: float, start) -> cb.Problem:
    system = cb.ContinuousSystem(lambda x: [x[1], force(x)], states=2, diffusion=[[0.0], [s]])
    return cb.Problem(system, initial=list(start), safe=[cb.Inside(cb.Box(low, high))], horizon=horizon)


def simulated(problem: cb.Problem, paths: int, rng: np.random.Generator) -> tuple[float, float]:
    """Share of the paths that leave, seen at 800 times only, and its standard error."""
    setting = setting_of(problem)
    drift, parts = compile_numpy(setting.tape), 800
    d = setting.horizon / parts
    p, q = (np.full(paths, ends[0]) for ends in setting.starts)
    inside = np.ones(paths, dtype=bool)
    for _ in range(parts):
        f = drift(0.0, p, q)
        noise = setting.noise * math.sqrt(d) * rng.standard_normal(paths)
        p, q = p + d * (f[..., 0] + noise / 2), q + d * f[..., 1] + noise
        for x, ends in zip((p, q), setting.faces):
            inside &= (x >= ends[0]) & (x <= ends[1])
    share = 1 - inside.mean()
    return share, math.sqrt(share * (1 - share) / paths)


@pytest.mark.parametrize(
    ("force", "s", "low", "high", "start", "most"),
    [
        (lambda x: -2 * x[0] - x[1], 0.8, [-0.8, -3], [0.8, 3], (0.1, 0.0), 2.0),  # a mass on a spring in wind
        (lambda x: x[0] - x[0] ** 3 - 0.5 * x[1], 0.5, [0.3, -2], [1.7, 2], (1.0, 0.1), 2.0),
        (lambda x: -0.7 * x[1], 0.7, [-1, -1], [1, 1], (0.0, 0.2), 3.0),  # the face of q is reached as well
    ],
)
def test_the_bound_is_above_what_simulation_counts_and_near_it(force, s, low, high, start, most) -> None:
    problem = mechanical(force, s, low, high, 1.5, start)
    bound = bound_by_steps(setting_of(problem), COARSE)
    share, error = simulated(problem, 8000, np.random.default_rng(1))
    assert bound >= share - 4 * error
    assert bound <= most * (share + 4 * error)


def test_states_may_come_in_either_order() -> None:
    problem = mechanical(lambda x: -2 * x[0] - x[1], 0.8, [-0.8, -3], [0.8, 3], 0.5, (0.1, 0.0))
    system = cb.ContinuousSystem(lambda x: [-2 * x[1] - x[0], x[0]], states=2, diffusion=[[0.8], [0.0]])
    turned = cb.Problem(system, initial=[0.0, 0.1], safe=[cb.Inside(cb.Box([-3, -0.8], [3, 0.8]))], horizon=0.5)
    plan = Plan(count=8, fine=1.0, wide=0.02, cell=0.5, spare=1e-7)
    assert bound_by_steps(setting_of(problem), plan) == bound_by_steps(setting_of(turned), plan)


def test_a_start_outside_is_sure_to_fail_and_a_longer_horizon_never_safer() -> None:
    plan = Plan(count=8, fine=1.0, wide=0.02, cell=0.5, spare=1e-7)
    force = (lambda x: -2 * x[0] - x[1], 0.8, [-0.8, -3], [0.8, 3])
    assert bound_by_steps(setting_of(mechanical(*force, 0.5, (0.9, 0.0))), plan) == 1.0
    short, long = (bound_by_steps(setting_of(mechanical(*force, t, (0.1, 0.0))), plan) for t in (0.5, 1.0))
    assert short < long


def test_the_engine_answers_mechanical_problems() -> None:
    problem = mechanical(lambda x: -2 * x[0] - x[1], 0.8, [-0.8, -3], [0.8, 3], 0.6, (0.1, 0.0))
    answer = values_engine(problem)
    assert answer.applicable
    assert "along the flow" in answer.reason
    assert -3.0 < answer.log10_delta < -0.5


def test_bad_arguments_are_named() -> None:
    problem = mechanical(lambda x: -2 * x[0] - x[1], 0.8, [-0.8, -3], [0.8, 3], 0.6, (0.1, 0.0))
    with pytest.raises(ValueError, match="`seconds` must be positive"):
        bound_exits_by_steps(problem, seconds=0)
    disturbed = cb.ContinuousSystem(
        lambda x, d: [x[1], d[0] - x[0]], states=2, diffusion=[[0.0], [0.3]], disturbance=cb.Box([-0.1], [0.1])
    )
    with pytest.raises(cb.InfeasibleError, match="neither disturbances nor plans"):
        bound_exits_by_steps(problem.replace(system=disturbed))
