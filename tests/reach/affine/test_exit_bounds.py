"""Which problems have an exact law, and what follows for them."""

import numpy as np
import pytest

import certbound as cb
from certbound.reach.affine import affine_answer, affine_failing


def problem_of(drift, safe=None, horizon=20.0, states=2, noise=((0.0,), (0.4,)), initial=(0.0, 0.0), **more):
    system = cb.ContinuousSystem(drift, states=states, diffusion=np.array(noise), **more)
    safe = [cb.Inside(cb.Box([-2.0, -np.inf], [2.0, np.inf]))] if safe is None else safe
    return cb.Problem(system, initial=initial, safe=safe, horizon=horizon, delta=0.05)


def oscillator(x):
    return np.array([x[1], -x[0] - 0.5 * x[1]])


def test_a_linear_oscillator_is_bounded_from_both_sides():
    problem = problem_of(oscillator)
    above, below = affine_answer(problem), affine_failing(problem)
    assert below.probability < 10**above.log10_delta < 2 * below.probability
    assert set(above.by_limit) == {(0, 0), (0, 1)}
    assert "exact law" in above.reason


def test_longer_horizons_and_nearer_limits_are_never_safer():
    values = [affine_answer(problem_of(oscillator, horizon=h)).log10_delta for h in (5.0, 20.0, 200.0, 2000.0)]
    assert values == sorted(values)
    boxes = [[cb.Inside(cb.Box([-b, -np.inf], [b, np.inf]))] for b in (2.5, 2.0, 1.8)]
    values = [affine_answer(problem_of(oscillator, safe=box)).log10_delta for box in boxes]
    assert values == sorted(values)


def test_a_constant_force_moves_the_middle():
    def pushed(x):
        return np.array([x[1], 0.5 - x[0] - 0.5 * x[1]])

    up = affine_answer(problem_of(pushed)).by_limit
    assert max(up.values()) > affine_answer(problem_of(oscillator)).log10_delta
    moved = problem_of(pushed, safe=[cb.Inside(cb.Box([-1.5, -np.inf], [2.5, np.inf]))], initial=(0.5, 0.0))
    assert affine_answer(moved).log10_delta == pytest.approx(affine_answer(problem_of(oscillator)).log10_delta, abs=0.1)


def test_a_disturbance_counts_at_its_worst():
    def disturbed(x, d):
        return np.array([x[1], d[0] - x[0] - 0.5 * x[1]])

    found = [
        affine_answer(problem_of(disturbed, disturbance=cb.Box([-size], [size]))).log10_delta
        for size in (0.0, 0.1, 0.3)
    ]
    assert found == sorted(found)
    assert found[0] == pytest.approx(affine_answer(problem_of(oscillator)).log10_delta, abs=0.1)
    assert found[0] + 0.05 < found[1]


@pytest.mark.parametrize(
    "drift",
    [
        lambda x: np.array([x[1], -np.sin(x[0]) - 0.5 * x[1]]),
        lambda t, x: np.array([x[1], np.sin(t) - x[0] - 0.5 * x[1]]),
        lambda x: np.array([x[1], -abs(x[0]) - 0.5 * x[1]]),
    ],
    ids=["curved", "driven in time", "kinked"],
)
def test_other_models_are_left_to_other_engines(drift):
    assert affine_answer(problem_of(drift)) is None
    assert affine_failing(problem_of(drift)) is None


def test_round_limits_are_left_to_other_engines():
    assert affine_answer(problem_of(oscillator, safe=[cb.Inside(cb.Ball([0.0, 0.0], 2.0))])) is None


def test_a_random_start_is_part_of_the_law():
    start = cb.GaussianStart([0.0, 0.0], [[0.16, 0.0], [0.0, 0.16]])
    random = affine_answer(problem_of(oscillator, initial=start)).log10_delta
    assert random >= affine_answer(problem_of(oscillator)).log10_delta
    assert affine_failing(problem_of(oscillator, initial=start)).probability <= 10**random


def test_the_lower_bound_starts_within_the_set_and_is_that_of_the_point():
    for start in (cb.Box([-0.3, -0.2], [0.4, 0.1]), cb.Ball([0.1, 0.0], 1e-17)):  # whose hull is all rounding
        problem = problem_of(oscillator, initial=start)
        found = affine_failing(problem)
        assert start.contains(np.array(found.start))
        assert found.probability == affine_failing(problem.replace(initial=found.start)).probability
