"""Noise that depends on the state: the linear response against simulation, closed forms and additive noise."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

import certbound as cb
from certbound.reach.linear.answer import linear_answer, linear_reach
from certbound.reach.linear.diffusion import DiffusionRun
from certbound.reach.linear.linearisation import Linearisation
from certbound.reach.linear.run import LinearRun
from certbound.reach.linear.shares import Share

Array = NDArray[np.float64]


def growing(gain: float = 0.3, bound: float = 0.2, **changes: object) -> cb.Problem:
    """dx = -x dt + .1 (1 + gain sin x) dW, from .5, to stay above -bound."""
    system = cb.ContinuousSystem(lambda x: -x, states=1, diffusion=lambda t, x: [[0.1 * (1 + gain * np.sin(x[0]))]])
    safe = [cb.Inside(cb.HalfSpace([-1.0], bound))]
    given = {"initial": [0.5], "safe": safe, "horizon": 2.0, "delta": 1e-2}
    return cb.Problem(system, **{**given, **changes})  # type: ignore[arg-type]


def oscillator(bound: float = 0.52) -> cb.Problem:
    """Noise on the velocity that grows with it."""
    system = cb.ContinuousSystem(
        lambda t, x: [x[1], -x[0] - 0.5 * x[1]],
        states=2,
        diffusion=lambda t, x: [[0.0], [0.1 * (1 + 0.5 * np.tanh(x[1]))]],
    )
    safe = [cb.Inside(cb.Box([-bound, -bound], [bound, bound]))]
    return cb.Problem(system, initial=cb.Box([0.4, -0.05], [0.45, 0.05]), safe=safe, horizon=3.0, delta=5e-2)


def pendulum(bound: float = 0.345) -> cb.Problem:
    system = cb.ContinuousSystem(
        lambda t, x: [x[1], -9.81 * np.sin(x[0]) - 0.5 * x[1]],
        states=2,
        diffusion=lambda t, x: [[0.0], [0.05 + 0.02 * np.cos(x[0])]],
    )
    safe = [cb.Inside(cb.HalfSpace([-1.0, 0.0], bound))]
    return cb.Problem(system, initial=[0.4, 0.0], safe=safe, horizon=1.15, delta=1e-2)


def free(bound: float) -> cb.Problem:
    """No drift, and noise that more than doubles on the way to the bound."""
    system = cb.ContinuousSystem(
        lambda t, x: [0 * x[0]], states=1, diffusion=lambda t, x: [[0.1 * (1 + 0.9 * np.tanh(5 * x[0]))]]
    )
    safe = [cb.Inside(cb.HalfSpace([1.0], bound))]
    return cb.Problem(system, initial=[0.0], safe=safe, horizon=1.0, delta=1e-2)


def level(problem: cb.Problem, nonlinear: Share) -> float:
    """log10 of the bound for one delta_N, by the engine that fits the noise."""
    engine = Linearisation.of(problem)
    additive = isinstance(problem.system.diffusion, np.ndarray)  # type: ignore[union-attr]
    run = LinearRun(engine) if additive else DiffusionRun(engine)
    return run.probability(nonlinear).log_probability / float(np.log(10.0))


@pytest.mark.parametrize(("build", "steps"), [(growing, 200), (oscillator, 300), (pendulum, 1500)])
@pytest.mark.parametrize("paths", [20_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
def test_simulation_does_not_contradict_the_bound(build: Callable[[], cb.Problem], steps: int, paths: int) -> None:
    problem = build()
    found = cb.simulate_exits(problem, paths=paths, rng=np.random.default_rng(1), steps=steps, halve=False)
    bound = 10 ** level(problem, Share.of(problem.delta / 10))
    assert found.exits > 0  # the simulation can tell
    assert found.lower <= bound < 0.3


def test_noise_frozen_on_the_nominal_would_be_unsound_and_is_not_what_is_proved() -> None:
    problem = free(0.4)
    frozen = problem.replace(system=cb.ContinuousSystem(lambda t, x: [0 * x[0]], states=1, diffusion=[[0.1]]))
    found = cb.simulate_exits(problem, paths=40_000, rng=np.random.default_rng(2), steps=200, halve=False)
    assert 10 ** level(frozen, Share.of(1e-3)) < found.lower  # the formula without M
    assert found.lower <= 10 ** level(problem, Share.of(1e-3)) < 0.3


def test_the_bound_tends_to_that_of_additive_noise() -> None:
    changes = {"safe": [cb.Inside(cb.Box([-0.4], [0.9]))], "delta": 1e-9}
    additive = growing(0.0, **changes)
    assert isinstance(additive.system.diffusion, np.ndarray)  # type: ignore[union-attr]
    limit = level(additive, Share(-45.0))
    levels = [level(growing(gain, **changes), Share(-45.0)) for gain in (1e-1, 1e-2, 1e-4)]
    assert limit <= levels[2] < levels[1] < levels[0]
    assert levels[2] == pytest.approx(limit, abs=0.02)


def test_all_noise_goes_into_the_martingale_where_it_varies_most() -> None:
    system = cb.ContinuousSystem(lambda x: -x, states=1, diffusion=lambda t, x: [[0.3 * x[0]]])
    safe = [cb.Inside(cb.HalfSpace([1.0], 2.0))]
    problem = cb.Problem(system, initial=[1.0], safe=safe, horizon=2.0, delta=5e-2)
    run = DiffusionRun(Linearisation.of(problem))
    outcome = run.probability(Share(-4.0))
    assert run.accepted[Share(-4.0)].reference is run.references[1]
    assert outcome.log_probability < np.log(0.1)


def test_the_deviation_tube_holds_simulated_deviations() -> None:
    problem = growing(0.8)
    answer = linear_answer(problem)
    tube, reach = answer.tube, answer.reach
    assert tube is not None
    assert reach is not None
    paths = cb.sample_paths(problem, paths=4000, rng=np.random.default_rng(3), points=100)
    nominal = 0.5 * np.exp(-np.linspace(0, 2, 101))
    half = tube.extent([1.0], np.linspace(0, 2, 101))
    assert np.mean((np.abs(paths[:, :, 0] - nominal) > half).any(axis=1)) <= 0.01
    assert half[-1] < 8 * 0.1 / np.sqrt(2)
    assert all(reach.contains(2.0 * k / 100, paths[0, k]) for k in range(0, 101, 5))


def test_the_tube_that_bounds_the_noise_contains_what_follows_from_it() -> None:
    run = DiffusionRun(Linearisation.of(oscillator()))
    outcome = run.probability(Share.of(1e-3))
    assert outcome.bounds is not None
    levels, _ = run.levels(Share.of(1e-3))
    low, high = run.deviations(levels, *outcome.bounds)  # type: ignore[misc]
    active = len(run.engine.model.active)
    again = run.excess(run.held.reference, low[:, :active], high[:, :active])
    assert again is not None
    assert all(bool(np.all(b.contains(a))) for a, b in zip(again, run.held.excess, strict=True))


def test_a_problem_is_answered_safe_and_assumes_nothing() -> None:
    verdict = cb.verify_safety(growing(bound=0.4), method="linear")
    assert verdict.status == "SAFE"
    assert "Assumption" not in verdict.reason
    assert '"stopped"' in verdict.certificate_text(growing(bound=0.4))
    assert not verdict.answers["linear"].foresight
    additive = cb.ContinuousSystem(lambda x: -x, states=1, diffusion=[[0.1]])
    assert cb.verify_safety(growing(bound=0.4).replace(system=additive), method="linear").answers["linear"].foresight


def test_noise_that_is_undefined_on_the_tube_proves_nothing() -> None:
    system = cb.ContinuousSystem(lambda x: -x, states=1, diffusion=lambda t, x: [[0.1 * np.sqrt(x[0])]])
    safe = [cb.Inside(cb.Box([-1.0], [1.0]))]
    problem = cb.Problem(system, initial=[0.1], safe=safe, horizon=3.0, delta=1e-2)
    assert linear_answer(problem).log10_delta == 0
    with pytest.raises(ArithmeticError):
        linear_reach(problem)


def test_noise_that_jumps_on_the_tube_is_not_taken_for_constant() -> None:
    system = cb.ContinuousSystem(lambda x: -x, states=1, diffusion=lambda t, x: [[np.where(x[0] > 0.1, 0.4, 0.05)]])
    safe = [cb.Inside(cb.HalfSpace([1.0], 0.5))]
    problem = cb.Problem(system, initial=[0.0], safe=safe, horizon=2.0, delta=1e-2)
    assert list(Linearisation.of(problem).model.active) == [0]
    assert linear_answer(problem).log10_delta == 0  # a path that meets the jump: nothing is proved
    far = problem.replace(initial=[-0.5], safe=[cb.Inside(cb.HalfSpace([1.0], 0.05))], horizon=0.5)
    assert linear_answer(far).log10_delta < -2  # beyond reach of the jump


def test_a_diffusion_of_time_alone_is_bounded_as_well() -> None:
    system = cb.ContinuousSystem(lambda x: -x, states=1, diffusion=lambda t, x: [[0.1 + 0.05 * np.sin(t)]])
    problem = growing().replace(system=system)
    found = cb.simulate_exits(problem, paths=40_000, rng=np.random.default_rng(4), steps=200, halve=False)
    assert found.lower <= 10 ** level(problem, Share.of(1e-3)) < 0.1


def test_a_reach_tube_asks_for_no_limits_and_no_target() -> None:
    """It was as good as its probability of leaving could be asked for, which a target forbids."""
    plain, aimed = growing(), growing(reach=cb.Box([-1.0], [0.3]))
    found, same = linear_reach(plain), linear_reach(aimed)
    assert found.end == same.end == 2.0
    np.testing.assert_array_equal(found.hull.hi, same.hull.hi)
    assert found.log10_delta <= -2.0
    rng, x, left = np.random.default_rng(3), np.full(2000, 0.5), np.zeros(2000, dtype=bool)
    low, high = found.hull.lo[:, 0], found.hull.hi[:, 0]
    times = np.linspace(0.0, 2.0, 401)
    for t in times[1:]:
        x = x - 0.005 * x + 0.1 * (1 + 0.3 * np.sin(x)) * np.sqrt(0.005) * rng.standard_normal(2000)
        piece = min(int(t / 2.0 * len(low)), len(low) - 1)
        left |= (x < low[piece]) | (x > high[piece])
    assert left.mean() <= 0.015
