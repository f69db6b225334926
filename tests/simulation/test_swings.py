"""Light oscillators and stiff models with four steps each: the limits contain the truth."""

from __future__ import annotations

import numpy as np
import pytest

from certbound.simulation.estimates.montecarlo import simulate_exits
from certbound.simulation.estimates.statistics import bound_binomial
from tests.simulation.swings import MODELS, reference

CONFIDENCE = 1.0 - 1e-6
STEPS = (250, 500, 1000, 2500)
SWINGS = [name for name in MODELS if not name.startswith(("stiff", "two rates", "fast"))]


def limits(counted):
    """Within three of its standard deviations the truth is known."""
    exits, paths = counted
    share = exits / paths
    return share - 3.0 * np.sqrt(share / paths), share + 3.0 * np.sqrt(share / paths)


def contains(result, truth):
    low, high = limits(truth)
    return result.lower <= high and low <= result.upper


@pytest.mark.slow
@pytest.mark.parametrize("steps", STEPS)
@pytest.mark.parametrize("name", MODELS)
def test_the_limits_contain_the_truth_whatever_the_step(name, steps):
    model = MODELS[name]
    result = simulate_exits(model.problem(), paths=10_000, rng=steps, steps=steps, confidence=CONFIDENCE)
    assert contains(result, model.truth)
    assert result.refuted <= limits(model.truth)[1]


@pytest.mark.parametrize(("name", "steps"), [("soft .02", 500), ("ship roll .05", 250), ("stiff slow manifold", 250)])
def test_with_few_steps_too(name, steps):
    model = MODELS[name]
    result = simulate_exits(model.problem(), paths=4000, rng=1, steps=steps, confidence=CONFIDENCE, halve=False)
    assert result.scheme == "exponential"
    assert contains(result, model.truth)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lin .3", "stiff cubic", "pendulum .01"])
def test_the_reference_in_numpy_counts_what_stands_in_the_table(name):
    model = MODELS[name]
    exits = reference(model, 2000, 3000, np.random.default_rng(0))
    lower, upper = bound_binomial(exits, 2000, CONFIDENCE)
    low, high = limits(model.truth)
    assert lower <= high
    assert low <= upper


def test_twelve_swings_and_six_stiff_models_are_looked_at():
    assert (len(SWINGS), len(MODELS)) == (12, 18)
