"""Several rows together, against simulation and the sum of their own events."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from certbound.gaussian.response.linear_response import LinearResponse, discrete_response
from certbound.gaussian.response.martingale_windows import logsumexp
from certbound.gaussian.response.overlaps import log_any_exceedance
from certbound.gaussian.response.step_events import StepEvents

Array = NDArray[np.float64]

STEPS = 30
MATRIX = np.array([[1.0, 0.3], [-0.3, 0.85]])
NOISE = np.array([[0.02, 0.0], [0.0, 0.09]])


def response(steps: int = STEPS) -> LinearResponse:
    slope = np.broadcast_to(MATRIX, (1, steps, 2, 2))
    return discrete_response(slope, NOISE, 1e-17, np.zeros((1, 2, 2)))


def simulated(rows: list[Array], levels: list[Array], paths: int, seed: int) -> float:
    rng = np.random.default_rng(seed)
    x, hit = np.zeros((paths, 2)), np.zeros(paths, dtype=bool)
    for t in range(1, STEPS + 1):
        x = x @ MATRIX.T + rng.standard_normal((paths, 2)) * np.sqrt(np.diag(NOISE))
        for row, level in zip(rows, levels, strict=True):
            hit |= x @ row[t] > level[t]
    return float(hit.mean())


@pytest.mark.parametrize("scale", [2.4, 3.0])
def test_overlaps_bring_the_bound_near_the_simulated_probability(scale: float) -> None:
    events = StepEvents(response(), 0, gaussian=True)
    rows = [np.tile(w, (STEPS + 1, 1)) for w in ([1.0, 0.0], [0.0, 1.0], [0.6, 0.9])]
    levels = [scale * np.full(STEPS + 1, events.along(row).profile.max()) for row in rows]
    alone = logsumexp(np.array([events.along(r).log_exceedance(z) for r, z in zip(rows, levels, strict=True)]))
    paths = 400_000
    truth = simulated(rows, levels, paths, 1)
    found, spread = np.exp(log_any_exceedance(events, rows, levels)), 3 * np.sqrt(truth / paths)
    assert found >= truth - spread
    assert found - truth <= 0.6 * (np.exp(alone) - truth) + spread


def test_a_row_given_twice_is_nearly_paid_once() -> None:
    events = StepEvents(response(), 0, gaussian=True)
    row = np.tile([1.0, 0.0], (STEPS + 1, 1))
    level = 2.5 * np.full(STEPS + 1, events.along(row).profile.max())
    once = np.exp(events.along(row).log_exceedance(level))
    twice = np.exp(log_any_exceedance(events, [row, row * (1 + 1e-9)], [level, level]))
    assert once * 0.9 <= twice <= 1.6 * once


def test_never_above_the_sum_and_certain_where_a_level_is_negative() -> None:
    events = StepEvents(response(), 0, gaussian=True)
    rows = [np.tile(w, (STEPS + 1, 1)) for w in ([1.0, 0.0], [-1.0, 0.0])]
    deviation = events.along(rows[0]).profile.max()
    for scale in (0.1, 1.0, 4.0, 12.0, np.inf):
        levels = [np.full(STEPS + 1, scale * deviation)] * 2
        alone = logsumexp(np.array([events.along(r).log_exceedance(z) for r, z in zip(rows, levels, strict=True)]))
        assert log_any_exceedance(events, rows, levels) <= min(alone, 0.0)
    below = np.where(np.arange(STEPS + 1) == 3, -1e-9, np.inf)
    assert log_any_exceedance(events, rows, [below, levels[1]]) == 0.0


def test_sub_gaussian_noise_has_no_joint_law() -> None:
    events = StepEvents(response(), 0, gaussian=False)
    row = np.tile([1.0, 0.0], (STEPS + 1, 1))
    with pytest.raises(ValueError, match="no joint law"):
        log_any_exceedance(events, [row], [np.ones(STEPS + 1)])
