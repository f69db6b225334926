"""Random starts with noise after them: bounds from cells of the start hold on both sides of what is simulated."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import certbound as cb
from certbound.errors import EngineError
from certbound.reach.starts import bound_noisy_start
from certbound.reach.starts.noisy import NoisyStart


def turning(**changes: object) -> cb.Problem:
    system = cb.DiscreteSystem(
        lambda x: [0.9 * x[0] + 0.1 * x[1], -0.1 * x[0] + 0.9 * x[1]], states=2, noise=cb.Gaussian(std=0.02)
    )
    start = cb.GaussianStart([0.0, 0.3], [[0.09, 0.03], [0.03, 0.04]])
    problem = cb.Problem(
        system, initial=start, safe=[cb.Inside(cb.Box([-0.8, -0.8], [0.8, 0.8]))], horizon=20, delta=0.02
    )
    return problem.replace(**changes)


def never(found: object) -> bool:
    return False


def test_cells_of_a_linear_model_come_near_what_is_simulated_from_both_sides() -> None:
    problem = turning()
    seen: list[float] = []
    found = bound_noisy_start(problem, most=250, enough=never, found=lambda bounds: seen.append(bounds.upper))
    simulated = cb.simulate_exits(problem, paths=200_000, halve=False)
    assert found.lower <= simulated.upper
    assert found.upper >= simulated.lower
    assert 0.5 * simulated.probability < found.lower
    assert found.upper < 1.7 * simulated.probability
    assert all(later <= (1 + 1e-9) * first for first, later in itertools.pairwise(seen))


def test_without_spread_there_is_nothing_to_cut_and_a_singular_covariance_is_refused() -> None:
    with pytest.raises(EngineError, match="not random"):
        bound_noisy_start(turning(initial=[0.0, 0.0]), most=10, enough=never)
    singular = turning(initial=cb.GaussianStart([0.0, 0.3], [[0.09, 0.09], [0.09, 0.09]]))
    with pytest.raises(EngineError, match="not singular"):
        bound_noisy_start(singular, most=10, enough=never)


def test_laws_that_are_not_normal_have_no_lower_bound_here() -> None:
    system = cb.DiscreteSystem(lambda x: 0.9 * x, states=1, noise=cb.Uniform(halfwidth=0.1))
    problem = cb.Problem(
        system, initial=cb.GaussianStart([0.0], [[0.25]]), safe=[cb.Inside(cb.Box([-1], [1]))], horizon=5, delta=0.1
    )
    found = bound_noisy_start(problem, most=40, enough=never)
    assert found.lower == 0
    assert found.upper >= cb.simulate_exits(problem, paths=50_000, halve=False).lower
    assert found.upper < 0.2


def test_obstacles_and_curved_models_are_bounded_by_the_engine_of_each_cell() -> None:
    still = cb.ContinuousSystem(
        lambda x: [x[2], x[3], 0, 0], states=4, diffusion=np.vstack([np.zeros((2, 2)), 0.02 * np.eye(2)])
    )
    start = cb.GaussianStart([0, 0, 1, 0], np.diag([0.1, 1.0, 0.001, 0.001]))
    ball = cb.Outside(cb.Ball([5, 0], 0.6, coordinates=(0, 1)))
    problem = cb.Problem(still, initial=start, safe=[ball], horizon=8, delta=0.01)
    found = bound_noisy_start(problem, most=24, enough=never)
    simulated = cb.simulate_exits(problem, paths=10_000, steps=200, halve=False)
    assert found.lower <= simulated.upper
    assert simulated.lower <= found.upper < 0.75  # the mean meets the ball, and without cells nothing below 1 is proved


def test_cells_of_whose_points_nothing_is_proved_are_not_halved(monkeypatch: pytest.MonkeyPatch) -> None:
    looked: list[float] = []

    def nothing(self: object, middle: np.ndarray, half: np.ndarray) -> tuple[float, float]:
        looked.append(float(half.max()))
        return 1.0, 0.0

    monkeypatch.setattr(NoisyStart, "_alone", nothing)
    system = cb.DiscreteSystem(
        lambda x: [0.9 * x[0] + 0.1 * x[1] ** 2, 0.9 * x[1]], states=2, noise=cb.Gaussian(std=0.02)
    )
    problem = turning(system=system, safe=[cb.Outside(cb.Ball([1.0, 1.0], 0.2))])
    found = bound_noisy_start(problem, most=250, enough=never)
    assert (found.lower, found.upper) == (0.0, 1.0)
    assert len(looked) == 3 * 16
    assert sum(half == 0 for half in looked) == 2 * 16


def test_a_window_between_two_times_that_are_looked_at_is_seen_from_the_nearest_one() -> None:
    """Nowhere in the window anything was seen, of which no number came, and the engine failed."""
    system = cb.ContinuousSystem(
        lambda x: [x[1], -x[0] - 0.5 * x[1]], states=2, diffusion=[[0.0, 0.0], [0.05, 0.02]]
    )
    start = cb.GaussianStart([0.0, 0.0], [[0.04, 0.0], [0.0, 0.04]])
    safe = [cb.Inside(cb.HalfSpace([0.0, 1.0], 0.45), during=(0.123456, 0.123456))]
    problem = cb.Problem(system, initial=start, safe=safe, horizon=1.0, delta=0.1)
    found = bound_noisy_start(problem, most=60, enough=never)
    simulated = cb.simulate_exits(problem, paths=50_000, halve=False)
    assert found.lower <= simulated.upper
    assert simulated.lower <= found.upper < 2 * simulated.upper


@pytest.mark.filterwarnings("error")
def test_errors_of_rounding_that_outgrow_all_floats_are_refused_in_words() -> None:
    """States in units 1e9 apart: one bound for all entries of the response then bounds none of them."""
    big, small = 9.61e6, 0.0118
    turning = cb.ContinuousSystem(
        lambda x: [x[1] / small * 0.776 * big, (-0.776 * (x[0] / big) - 0.476 * (x[1] / small)) * small],
        states=2, diffusion=[[0, 0], [0, 0.0007]],
    )  # fmt: skip
    start = cb.GaussianStart([big / 2, 0], [[2.3e11, 106.0], [106.0, 4e-7]])
    safe = [cb.Inside(cb.HalfSpace([2.8e-10, 1], 0.0052))]
    problem = cb.Problem(turning, initial=start, safe=safe, horizon=1.71, delta=1e-3)
    with pytest.raises(ArithmeticError, match="floats bear"):
        NoisyStart(problem)
