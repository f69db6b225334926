"""Random starts without noise after them: both bounds hold, and are near each other."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

import certbound as cb
from certbound.errors import EngineError
from certbound.reach.starts import StartBounds, bound_silent_start


def model(matrix: Any, shift: Any = None) -> cb.ContinuousSystem:
    a, n = np.asarray(matrix, dtype=float), len(matrix)
    b = np.zeros(n) if shift is None else np.asarray(shift)
    return cb.ContinuousSystem(lambda x: a @ x + b, states=n, diffusion=np.zeros((n, 1)))


def bounded(problem: cb.Problem, cells: int = 3000, ratio: float = 1.05) -> StartBounds:
    return bound_silent_start(problem, most=cells, enough=lambda found: found.upper <= ratio * found.lower)


def holds(found: StartBounds, truth: float, ratio: float) -> None:
    assert found.lower <= truth <= found.upper
    assert found.upper <= ratio * found.lower


@pytest.mark.parametrize("mean", [0.0, 0.3, -2.0])
def test_a_state_that_decays_fails_at_the_start_or_never(mean: float) -> None:
    start = cb.GaussianStart([mean], [[0.25]])
    problem = cb.Problem(model([[-0.5]]), initial=start, safe=[cb.Inside(cb.Box([-1], [1.3]))], horizon=2)
    holds(bounded(problem), norm.cdf(-1, mean, 0.5) + norm.sf(1.3, mean, 0.5), 1.05)


def test_a_state_that_turns_is_worst_at_its_amplitude() -> None:
    """(x, y) turns about 0 by more than half a round: |x| reaches the amplitude, whose square is exponential."""
    start = cb.GaussianStart([0, 0], 0.04 * np.eye(2))
    safe = [cb.Inside(cb.Box([-0.6, -np.inf], [0.6, np.inf]))]
    problem = cb.Problem(model([[0, 1], [-1, 0]]), initial=start, safe=safe, horizon=3.2)
    holds(bounded(problem), float(np.exp(-0.36 / 0.08)), 1.15)


def test_an_obstacle_is_met_by_those_who_are_in_its_shadow() -> None:
    """At a speed that nearly all have alike, a ball is met where the offset across is less than its radius."""
    covariance = np.diag([0.01, 4.0, 1e-10, 1e-10])
    start = cb.GaussianStart([-5, 0.5, 2, 0], covariance)
    still = model([[0, 0, 1, 0], [0, 0, 0, 1], [0] * 4, [0] * 4])
    ball = cb.Outside(cb.Ball([0, 0], 0.8, coordinates=(0, 1)))
    problem = cb.Problem(still, initial=start, safe=[ball], horizon=5)
    truth = norm.cdf(0.8, 0.5, 2.0) - norm.cdf(-0.8, 0.5, 2.0)
    found = bounded(problem, 2000, 1.03)
    assert found.lower <= truth * (1 + 1e-6)
    assert found.upper >= truth * (1 - 1e-6)
    assert found.upper <= 1.1 * found.lower


def test_a_mean_in_an_obstacle_says_little_of_how_often_it_is_met() -> None:
    start = cb.GaussianStart([0, 0], [[4, 1], [1, 9]])
    obstacle = cb.Outside(cb.Box([-0.5, -0.25], [0.5, 0.25]))
    problem = cb.Problem(model(np.zeros((2, 2))), initial=start, safe=[obstacle], horizon=1, delta=0.1)
    law = multivariate_normal([0, 0], [[4, 1], [1, 9]])
    corner = [(0.5, 0.25, 1), (-0.5, 0.25, -1), (0.5, -0.25, -1), (-0.5, -0.25, 1)]
    truth = sum(sign * law.cdf([x, y]) for x, y, sign in corner)
    holds(bounded(problem), truth, 1.05)
    verdict = cb.verify_safety(problem)
    assert verdict.status == "SAFE"
    assert verdict.log10_lower is not None
    assert cb.verify_safety(problem.replace(delta=0.001)).status == "UNSAFE"


def test_a_singular_covariance_and_its_decimals_are_taken_alike() -> None:
    gain = np.array([0.3, 0.1, 0.2])
    turning = model([[-0.1, 1, 0], [-1, -0.1, 0], [0, 0, -0.5]])
    safe = [cb.Inside(cb.Ellipsoid([0, 0, 0], np.diag([0.25, 0.25, 0.16])))]
    found = []
    for covariance in (np.outer(gain, gain), np.round(np.outer(gain, gain), 14)):
        start = cb.GaussianStart([0, 0, 0], covariance)
        found.append(bounded(cb.Problem(turning, initial=start, safe=safe, horizon=4)))
    truth = 2 * norm.sf(1 / np.sqrt(np.sum(gain**2 * np.array([4, 4, 6.25]))))
    for one in found:
        holds(one, truth, 1.05)


def test_steps_and_windows_count_as_they_are_stated() -> None:
    system = cb.DiscreteSystem(lambda x: 0.5 * x, states=1, noise=cb.Gaussian(std=0.0))
    safe = [cb.Inside(cb.HalfSpace([1.0], 1.0), during=(2, 3))]
    problem = cb.Problem(system, initial=cb.GaussianStart([0.0], [[4.0]]), safe=safe, horizon=5)
    holds(bounded(problem, ratio=1.001), norm.sf(4.0, 0, 2.0), 1.001)


def test_time_may_change_the_model_and_a_jump_is_met() -> None:
    system = cb.ContinuousSystem(lambda t, x: [np.where(t < 1, 1.0, -1.0)], states=1, diffusion=[[0.0]])
    problem = cb.Problem(
        system, initial=cb.GaussianStart([0.0], [[0.01]]), safe=[cb.Inside(cb.HalfSpace([1.0], 1.1))], horizon=2
    )
    holds(bounded(problem, ratio=1.01), norm.sf(1.0), 1.01)


def test_who_touches_a_face_from_inside_has_not_left_and_who_touches_an_obstacle_has_met_it() -> None:
    """A state that takes one value with certainty: a start of which the other state alone is random."""
    start = cb.GaussianStart([1.0, 0.0], [[0, 0], [0, 1.0]])
    still = model(np.zeros((2, 2)))
    kept = cb.Problem(still, initial=start, safe=[cb.Inside(cb.HalfSpace([1.0, 0.0], 1.0))], horizon=1)
    met = kept.replace(safe=[cb.Outside(cb.HalfSpace([-1.0, 0.0], -1.0))])
    assert bounded(kept).lower == 0
    assert bounded(met).upper == 1


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"initial": [0.0, 0.0]}, "not random"), ({"horizon": np.inf}, "finite horizon"),
        ({"system": cb.ContinuousSystem(lambda x: -x, states=2, diffusion=np.eye(2))}, "no noise after"),
        ({"system": cb.ContinuousSystem(lambda x: -(x**3), states=2, diffusion=np.zeros((2, 1)))}, "linear"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_in_words(change: dict[str, Any], word: str) -> None:
    start, safe = cb.GaussianStart([0, 0], np.eye(2)), [cb.Inside(cb.Box([-5, -5], [5, 5]))]
    problem = cb.Problem(model(-np.eye(2)), initial=start, safe=safe, horizon=1).replace(**change)
    with pytest.raises(EngineError, match=word):
        bounded(problem)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("rate", [1.0, 300.0])
def test_paths_that_overflow_are_refused_in_words(rate: float) -> None:
    """The mean stays at 0, and paths from all other starts run away, slowly or beyond all floats."""
    problem = cb.Problem(
        model([[rate]]), initial=cb.GaussianStart([0.0], [[1e-4]]), safe=[cb.Inside(cb.Box([-1], [1]))], horizon=2.0
    )
    if rate == 1.0:
        found = bounded(problem)
        truth = 2 * norm.sf(100 * np.exp(-2.0))
        assert found.lower <= truth <= found.upper
        return
    with pytest.raises((ArithmeticError, EngineError), match="beyond"):
        bounded(problem.replace(horizon=4.0))


def test_a_limit_that_no_start_comes_near_counts_for_nothing_without_a_warning() -> None:
    """It lies 1e160 standard deviations away, the square of which is no float."""
    start = cb.GaussianStart([0.0, 0.0], np.diag([1.0, 1e-8]))
    limits = [cb.Inside(cb.HalfSpace([1.0, 0.0], 2.0)), cb.Inside(cb.HalfSpace([0.0, 1.0], 1e156))]
    problem = cb.Problem(model([[0.0, 0.0], [0.0, 0.0]]), initial=start, safe=limits, horizon=1.0)
    with np.errstate(over="raise"):
        holds(bounded(problem), float(norm.sf(2.0)), 1.05)
