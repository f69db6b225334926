"""Limits that move as limits that rest: the same paths fail."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.errors import InfeasibleError
from certbound.problem.model import Tape, compile_numpy
from certbound.problem.reductions import RestingLimits, bring_to_rest
from certbound.problem.reductions.resting_limits import by_coordinates

Reduction = Callable[[cb.Problem], RestingLimits]

FLOW = cb.ContinuousSystem(lambda x: 0.3 - np.sin(x), states=["x"], diffusion=lambda x: [[0.4 + 0.1 * x[0] ** 2]])
PAIR = cb.ContinuousSystem(
    lambda x: [x[1] - x[0] ** 3, -x[0] - 0.5 * x[1]], states=["x", "y"], diffusion=0.4 * np.eye(2)
)
STEPS = cb.DiscreteSystem(lambda x: 0.8 * np.sin(x) + 0.1, states=["x"], noise=cb.Gaussian(std=0.3))
PAIRS = cb.DiscreteSystem(
    lambda x: [0.7 * x[0] + 0.2 * x[1], 0.6 * x[1] - 0.1 * x[0] ** 2], states=["x", "y"], noise=cb.Gaussian(std=0.3)
)


def failing(problem: cb.Problem, noise: np.ndarray, horizon: float) -> np.ndarray:
    """Which paths fail, with the same noise (steps, paths, n): of a flow by Euler's scheme."""
    steps, count, _ = noise.shape
    discrete = problem.system.time == "discrete"
    h = 1.0 if discrete else horizon / steps
    gain: Any = (
        (problem.system.fixed_gain if problem.system.gain is None else problem.system.gain)
        if discrete
        else problem.system.diffusion
    )
    move = compile_numpy(problem.closed_loop)
    x = np.tile(problem.initial.middle, (count, 1))
    failed, arrived = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
    for k in range(steps + 1):
        t, broken = k * h, np.zeros(count, dtype=bool)
        for constraint in problem.kept:
            first, last = constraint.during or (0.0, horizon)
            broken |= ~constraint.satisfied(x, t) & (first - 1e-9 <= t <= last + 1e-9)
        if problem.reach is not None:
            arrived |= problem.reach.region.contains(x, t) & ~failed & ~broken
        failed |= broken & ~arrived
        if k < steps:
            g = compile_numpy(gain)(t, *x.T) if isinstance(gain, Tape) else gain
            pushed = np.einsum("...ij,...j->...i", np.broadcast_to(g, (count, *np.shape(g)[-2:])), noise[k])
            x = move(t, *x.T) + 0.3 * pushed if discrete else x + h * move(t, *x.T) + np.sqrt(h) * pushed
    return failed if problem.reach is None else failed | ~arrived


def both(problem: cb.Problem, steps: int, reduced: Reduction, count: int = 3000) -> tuple[np.ndarray, ...]:
    """Failing paths of the problem, and of what is above and below it."""
    found = reduced(problem)
    noise = np.random.default_rng(5).standard_normal((steps, count, problem.system.dimension))
    assert found.above is not None
    assert found.below is not None
    return tuple(failing(one, noise, float(problem.horizon)) for one in (problem, found.above, found.below))


def band(low: Any, high: Any) -> list[cb.Inside]:
    return [cb.Inside(cb.Box(low, high))]


def closing(t: Any) -> Any:
    return np.exp(-0.1 * t)


EXACT: dict[str, cb.Problem] = {
    "closing": cb.Problem(STEPS, initial=[0], safe=band([lambda t: -closing(t)], [closing]), horizon=8),
    "one side": cb.Problem(STEPS, initial=[0], safe=[cb.Inside(cb.HalfSpace([1], lambda t: 1 - 0.05 * t))], horizon=8),
    "apart": cb.Problem(
        STEPS, initial=[0], horizon=8,
        safe=[cb.Inside(cb.Box([-10], [0], center=lambda t: [closing(t)])),
              cb.Inside(cb.Box([0], [10], center=lambda t: [-closing(t)]))],
    ),
    "jump": cb.Problem(STEPS, initial=[0], safe=band([-1], [lambda t: np.where(t < 4, 1.0, 0.75)]), horizon=8),
    "by turns": cb.Problem(
        STEPS, initial=[0], horizon=8,
        safe=[cb.Inside(cb.HalfSpace([1], lambda t: 1.5 - 0.125 * t)),
              cb.Inside(cb.HalfSpace([1], lambda t: 0.75 + 0.0625 * t))],
    ),
    "window": cb.Problem(PAIRS, initial=[0, 0], safe=band([lambda t: -closing(t), -1], [closing, 1]), horizon=8),
    "obstacle": cb.Problem(STEPS, initial=[0], safe=[cb.Outside(cb.HalfSpace([-1], lambda t: -closing(t)))], horizon=8),
    "slope": cb.Problem(PAIRS, initial=[0, 0], safe=[cb.Inside(cb.HalfSpace([1, 1], lambda t: 1 - t / 16))], horizon=8),
    "ball": cb.Problem(PAIRS, initial=[0, 0], safe=[cb.Inside(cb.Ball([0, 0], lambda t: 1.25 - t / 16))], horizon=8),
}  # fmt: skip


@pytest.mark.parametrize("name", EXACT)
def test_the_same_paths_fail_where_all_limits_rest(name: str) -> None:
    assert by_coordinates(EXACT[name]).exact
    plain, above, below = both(EXACT[name], 8, by_coordinates)
    assert 0.01 < plain.mean() < 0.98
    assert np.count_nonzero(plain != above) <= 1  # rounding
    assert np.array_equal(above, below)


BOTH: dict[str, Callable[[], cb.Problem]] = {
    "windows": lambda: cb.Problem(
        STEPS, initial=[0], horizon=8,
        safe=[cb.Inside(cb.HalfSpace([1], closing)),
              cb.Inside(cb.HalfSpace([-1], lambda t: 0.4 + 0.1 * t), during=(2, 6))],
    ),
    "target": lambda: cb.Problem(
        STEPS, initial=[0], horizon=8, safe=band([lambda t: -closing(t) - 0.2], [10]), reach=cb.Box([closing], [10])
    ),
    "obstacle": lambda: cb.Problem(
        PAIRS, initial=[0, 0], horizon=8,
        safe=[*band([lambda t: -closing(t) - 0.3] * 2, [lambda t: closing(t) + 0.3] * 2),
              cb.Outside(cb.Box([0.6, -0.2], [0.9, 0.2]))],
    ),
    "domain": lambda: cb.Problem(
        PAIRS, initial=[0, 0], horizon=8, safe=[cb.Inside(cb.HalfSpace([1, 0], closing))],
        domain=cb.Box([-1, -1], [5, 1]),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", EXACT)
def test_step_by_step_the_same_paths_fail(name: str) -> None:
    assert bring_to_rest(EXACT[name]).states == ()
    plain, above, below = both(EXACT[name], 8, bring_to_rest)
    assert np.array_equal(plain, above)
    assert np.array_equal(plain, below)


@pytest.mark.parametrize("name", BOTH)
def test_more_paths_fail_above_and_fewer_below_where_limits_still_move(name: str) -> None:
    plain, above, below = both(BOTH[name](), 8, by_coordinates)
    assert np.count_nonzero(plain & ~above) <= 1
    assert np.count_nonzero(below & ~plain) <= 1


@pytest.mark.parametrize("system", [FLOW, PAIR])
def test_drift_and_noise_of_a_flow_are_those_of_the_coordinates(system: cb.ContinuousSystem) -> None:
    n = system.dimension
    safe = band([lambda t: -0.9 + 0.2 * np.sin(t)] * n, [lambda t: 1.1 * closing(t)] * n)
    plain, above, _ = both(cb.Problem(system, initial=[0.1] * n, safe=safe, horizon=1.0), 500, bring_to_rest)
    assert 0.01 < plain.mean() < 0.9
    assert np.mean(plain != above) < 0.01  # errors of Euler's scheme


def test_far_limits_ask_for_nothing_more_where_nearer_ones_rest() -> None:
    flow = cb.ContinuousSystem(lambda x: 0.5 - x, states=["x"], diffusion=0.4)
    far = [cb.Inside(cb.Box([0], [10], center=lambda t: [-closing(t)]))]
    target = cb.Box([0], [10], center=lambda t: [closing(t)])
    found = bring_to_rest(cb.Problem(flow, initial=[0], safe=far, reach=target, horizon=2.0))
    assert found.exact
    assert found.above is not None
    assert found.above.safe[0].region.low.tolist() == [-1.0]
    assert found.above.reach is not None
    assert found.above.reach.region.low.tolist() == [1.0]


@pytest.mark.parametrize(
    ("safe", "options", "words"),
    [
        (band([-1], [lambda t: np.where(t < 0.5, 1.0, 0.8)]), {}, "jump in t.*during"),
        (band([lambda t: t - 1], [lambda t: 1 - t]), {}, "meet"),
        (band([-1], [1]), {}, "no limit that moves"),
        (band([-1], [lambda t: 1 + np.sqrt(t - 0.0)]), {"horizon": np.inf}, "infinite"),
    ],
)
def test_what_cannot_be_brought_to_rest_is_refused_with_the_cure(safe: Any, options: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        bring_to_rest(cb.Problem(FLOW, initial=[0], safe=safe, **({"horizon": 1.0} | options)))


def test_sets_of_states_that_move_in_different_ways_are_refused() -> None:
    safe = [*band([-1, -1], [closing, lambda t: 1 + t]), cb.Outside(cb.Ball([2, 2], 0.5))]
    with pytest.raises(InfeasibleError, match="different ways"):
        bring_to_rest(cb.Problem(PAIR, initial=[0, 0], safe=safe, horizon=1.0))
