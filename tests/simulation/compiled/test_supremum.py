"""The record of a path with the bridges between its steps, against its exact law."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit

from certbound.simulation.compiled.streams import seed_stream
from certbound.simulation.compiled.supremum import STRETCH, raise_top

PATHS = 200_000
SPREAD = 0.04


@njit
def records(stream, values, top, spread, paths):
    """Records of ``paths`` stretches with the same values at the steps."""
    found = np.empty(paths)
    track = np.empty(len(values))
    for path in range(paths):
        for k in range(len(values)):
            track[k] = values[k]
        found[path] = raise_top(stream, track, len(values) - 1, top, spread, 40.0)
    return found


def probability_below(values, level):
    """That no bridge exceeds a level."""
    gaps = np.maximum(level - values, 0.0)
    return float(np.prod(-np.expm1(-2 * gaps[1:] * gaps[:-1] / SPREAD)))


@pytest.mark.parametrize("count", [1, 5, 8, 20])
@pytest.mark.parametrize("drop", [0.0, 0.3])
def test_the_record_follows_the_law_of_the_bridges(count, drop):
    values = np.append(1.0, 1.0 - drop - 0.1 * np.random.default_rng(count).random(count))
    top = 1.0 + 0.5 * drop  # reached earlier
    found = records(seed_stream(7, count), values, top, SPREAD, PATHS)
    for level in (top, top + 0.1, top + 0.25):
        exact = probability_below(values, level)
        error = 4.5 * np.sqrt(exact * (1 - exact) / PATHS) + 1e-12
        assert abs(float(np.mean(found <= level)) - exact) < error


def test_a_stretch_starts_where_the_last_one_ended():
    track = np.linspace(0.0, 1.0, STRETCH + 1)
    raise_top(seed_stream(1, 0), track, STRETCH, 1.0, 1e-4, 40.0)
    assert track[0] == 1.0
