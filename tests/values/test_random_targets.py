"""Targets drawn at random: bounds of failing around simulations, close to each other and to verdicts on either side."""

import numpy as np
import pytest

import certbound as cb
from certbound.problem.goals import until
from certbound.values.discrete import bound_failure


def drawn(rng, states):
    gain = rng.uniform(0.5, 0.95) * np.eye(states)
    if states > 1:
        gain = gain + rng.uniform(-0.15, 0.15, (states, states))
    system = cb.DiscreteSystem(
        lambda x: gain @ x, states=states, noise=cb.Gaussian(std=rng.uniform(0.1, 0.3, states))
    )
    return cb.Problem(
        system, initial=rng.uniform(0.4, 0.8, states) * rng.choice([-1, 1], states), horizon=int(rng.integers(3, 15)),
        safe=[cb.Inside(cb.Box(-np.ones(states), np.ones(states)))],
        reach=cb.Box(*(np.ones(states) * end for end in rng.uniform(0.15, 0.4) * np.array([-1, 1]))),
    )  # fmt: skip


def bounds(problem):
    return bound_failure(until(problem, problem.horizon), target=problem.reach.region, seconds=0.5)


def check(problem, seed):
    """Both bounds, which a simulation does not contradict, and its share of failures."""
    found = bounds(problem)
    counts = cb.simulate_exits(problem, paths=100_000, rng=seed, confidence=0.9999, halve=False)
    assert found.lower <= counts.upper
    assert counts.lower <= found.upper
    return found.lower, found.upper, counts.probability


@pytest.mark.parametrize("count", [6, pytest.param(30, marks=pytest.mark.slow)])
def test_random_targets(count):
    rng = np.random.default_rng(7)
    found = [check(drawn(rng, 1 + (k % 3 == 2)), k) for k in range(count)]
    assert np.median([upper / lower for lower, upper, _ in found]) < 1.2
    settled = [
        (lower > share / 1.3, upper <= min(1.3 * share, 1)) for lower, upper, share in found if 1e-6 < share < 0.9
    ]
    assert np.mean(settled) >= 0.9
