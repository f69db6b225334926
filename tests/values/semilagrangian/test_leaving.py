"""Bounds for noise in one of two coordinates, against simulation."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.special import ndtr

import certbound as cb
from certbound.problem.model import compile_numpy
from certbound.safety.engines import values
from certbound.values.semilagrangian import bound_exits_by_steps, leaving
from certbound.values.semilagrangian.groundwork import Plan
from certbound.values.semilagrangian.leaving import bound_by_steps
from certbound.values.semilagrangian.noisy_axis import setting_of
from certbound.watch import OutOfTime, Watch

COARSE = Plan(count=20, fine=1.0, wide=0.012, cell=0.4, spare=1e-7)


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
        pytest.param(  # a mass on a spring in wind
            lambda x: -2 * x[0] - x[1], 0.8, [-0.8, -3], [0.8, 3], (0.1, 0.0), 2.0, marks=pytest.mark.slow
        ),
        pytest.param(
            lambda x: x[0] - x[0] ** 3 - 0.5 * x[1], 0.5, [0.3, -2], [1.7, 2], (1.0, 0.1), 2.0, marks=pytest.mark.slow
        ),
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
    problem = mechanical(lambda x: -2 * x[0] - x[1], 0.8, [-0.8, -3], [0.8, 3], 0.25, (0.5, 0.4))
    system = cb.ContinuousSystem(lambda x: [-2 * x[1] - x[0], x[0]], states=2, diffusion=[[0.8], [0.0]])
    turned = cb.Problem(system, initial=[0.4, 0.5], safe=[cb.Inside(cb.Box([-3, -0.8], [3, 0.8]))], horizon=0.25)
    plan = Plan(count=4, fine=1.0, wide=0.02, cell=0.5, spare=1e-7)
    bound = bound_by_steps(setting_of(problem), plan)
    assert bound == bound_by_steps(setting_of(turned), plan)
    assert bound > 1e-4  # ten times what is paid for rare events


def test_a_start_that_runs_into_a_face_is_sure_to_fail_and_a_longer_horizon_never_safer() -> None:
    force = (lambda x: -2 * x[0] - x[1], 0.8, [-0.8, -3], [0.8, 3])
    short, long = (replace(COARSE, count=count) for count in (6, 8))
    doomed = setting_of(mechanical(*force, 0.375, (0.79, 2.0)))
    assert bound_by_steps(doomed, short) == pytest.approx(1.0, rel=1e-3)
    safer, riskier = (setting_of(mechanical(*force, horizon, (0.5, 0.4))) for horizon in (0.375, 0.5))
    assert 0.01 < bound_by_steps(safer, short) < bound_by_steps(riskier, long) < 0.1


def exit_at_the_end() -> float:
    """P(|p| > .8 at time .8), from .1 at rest: a lower bound of the probability of leaving until then."""
    a = np.array([[0.0, 1.0], [-2.0, -1.0]])
    times = np.linspace(0, 0.8, 401)
    loads = np.array([expm(a * t)[0, 1] for t in times])
    spread = 0.8 * math.sqrt(np.trapezoid(loads**2, times))
    mean = 0.1 * expm(a * 0.8)[0, 0]
    return float(ndtr((mean - 0.8) / spread) + ndtr((-mean - 0.8) / spread))


def test_the_engine_answers_mechanical_problems(monkeypatch) -> None:
    monkeypatch.setattr(values, "_SECONDS", 1.0)
    problem = mechanical(lambda x: -2 * x[0] - x[1], 0.8, [-0.8, -3], [0.8, 3], 0.8, (0.1, 0.0))
    answer = values.values_engine(problem)
    assert answer.applicable
    assert "along the flow" in answer.reason
    exact = exit_at_the_end()
    assert math.log10(exact) < answer.log10_delta < math.log10(60 * exact)


def test_bad_arguments_are_named() -> None:
    problem = mechanical(lambda x: -2 * x[0] - x[1], 0.8, [-0.8, -3], [0.8, 3], 0.6, (0.1, 0.0))
    with pytest.raises(ValueError, match="`seconds` must be positive"):
        bound_exits_by_steps(problem, seconds=0)
    disturbed = cb.ContinuousSystem(
        lambda x, d: [x[1], d[0] - x[0]], states=2, diffusion=[[0.0], [0.3]], disturbance=cb.Box([-0.1], [0.1])
    )
    with pytest.raises(cb.InfeasibleError, match="neither disturbances nor plans"):
        bound_exits_by_steps(problem.replace(system=disturbed))


def test_more_work_buys_finer_plans_and_the_clock_is_not_asked() -> None:
    setting = setting_of(mechanical(lambda x: -2 * x[0] - x[1], 0.8, [-0.8, -3], [0.8, 3], 0.5, (0.1, 0.0)))
    turn = leaving._turn(setting)
    assert leaving._affordable(setting, turn, 1.0) == [leaving._PLANS[0]]
    first, chosen = leaving._affordable(setting, turn, 1.2e7)
    assert first == leaving._PLANS[0]
    assert chosen in leaving._PLANS[1:-1]


def test_the_steps_end_when_the_time_is_over() -> None:
    setting = setting_of(mechanical(lambda x: -2 * x[0] - x[1], 0.8, [-0.8, -3], [0.8, 3], 0.5, (0.1, 0.0)))
    ticks = itertools.count()
    with pytest.raises(OutOfTime), Watch(limit=3.0, clock=lambda: next(ticks)).running():
        bound_by_steps(setting, COARSE)
