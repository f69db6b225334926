"""The suite of models: sound, tight, fast; a million random points a model on request."""

from __future__ import annotations

import time

import numpy as np
import pytest

import certbound as cb
from experiments.constants_suite import boxes_per_second, sample, suite

QUICK = ("unicycle", "lorenz", "chain", "dubins", "quadrotor", "cart_pole")


@pytest.mark.parametrize("name", QUICK)
def test_constants_are_sound_and_tight_on_the_suite(name):
    source, domain = suite()[name]
    k = cb.bound_constants(source, domain, metric="euclidean")
    found, size = sample(source, domain, 5000, np.random.default_rng(0))
    assert found <= (k.gain if k.rate is None else k.rate)
    assert k.gap <= 0.01 * max(1.0, size)


@pytest.mark.slow
@pytest.mark.parametrize("name", suite())
def test_a_million_points_never_exceed_the_certified_value(name):
    source, domain = suite()[name]
    start = time.process_time()
    k = cb.bound_constants(source, domain, metric="euclidean")
    seconds = time.process_time() - start
    found, size = sample(source, domain, 1_000_000, np.random.default_rng(0))
    assert found <= (k.gain if k.rate is None else k.rate)
    assert k.gap <= 0.01 * max(1.0, size)
    assert seconds < 10


@pytest.mark.slow
def test_a_hundred_thousand_boxes_are_enclosed_in_a_second():
    assert boxes_per_second() >= 1e5
