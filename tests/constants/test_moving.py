"""Rates in coordinates that move: what is proved of them, and what it does for tubes."""

from __future__ import annotations

import numpy as np
import pytest

import certbound as cb
from certbound.constants import constants_along, moving_constants_along
from certbound.errors import InfeasibleError
from certbound.problem.library.large_models import formation
from certbound.problem.model import compile_numpy, jacobian
from certbound.rigor.intervals import Interval

TIMES = np.linspace(0.0, 2.0, 21)


def pendulum(sigma=0.1):
    def rate(t, x):
        return [x[1], -(2.0 + np.sin(t)) * np.sin(x[0]) - 0.3 * x[1]]

    return cb.ContinuousSystem(rate, states=2, diffusion=[[0.0], [sigma]])


def boxes(half=0.2):
    middle = np.stack([0.3 * np.cos(TIMES[:-1]), -0.3 * np.sin(TIMES[:-1])], axis=1)
    return Interval(middle - half, middle + half)


def turned(times):
    """Frames of no symmetry."""
    zero, one = np.zeros(len(times)), np.ones(len(times))
    rows = [[one + 0.2 * np.sin(times), 0.3 * np.cos(times)], [zero - 0.1 * times, 0.7 + 0.1 * times]]
    return np.moveaxis(np.array(rows), -1, 0)


def test_frames_that_stand_still_have_the_rates_of_their_metric():
    metric = np.array([[2.0, 0.3], [0.3, 1.0]])
    still = np.tile(np.linalg.cholesky(metric).T, (len(TIMES), 1, 1))
    moving = moving_constants_along(pendulum(), TIMES, boxes(), frames=still, refine=16)
    plain = constants_along(pendulum(), TIMES, boxes(), metric=metric, refine=16)
    np.testing.assert_allclose(moving.rate, plain.rate, rtol=0.02, atol=2e-3)
    np.testing.assert_allclose(moving.sigma, plain.sigma, rtol=1e-9)


def test_no_rate_lies_below_that_of_a_point_and_a_time():
    system, frames = pendulum(), turned(TIMES)
    found = moving_constants_along(system, TIMES, boxes(), frames=frames, refine=64)
    slope = compile_numpy(jacobian(system.dynamics, (1, 2)))
    rng, where = np.random.default_rng(0), boxes()
    worst = np.full(len(TIMES) - 1, -np.inf)
    for k in range(len(worst)):
        span = TIMES[k + 1] - TIMES[k]
        for share in (0.0, 1.0, *rng.random(20)):
            x = where.lo[k] + rng.choice([0.0, 1.0, 0.5], 2) * where.width[k]
            T, rise = frames[k] + share * (frames[k + 1] - frames[k]), (frames[k + 1] - frames[k]) / span
            whole = (rise + T @ slope(TIMES[k] + share * span, *x)) @ np.linalg.inv(T)
            worst[k] = max(worst[k], np.linalg.eigvalsh((whole + whole.T) / 2)[-1])
            assert np.linalg.norm(T @ [0.0, 0.1]) <= found.sigma[k] * (1 + 1e-12)
    assert np.all(worst <= found.rate)
    assert np.all(found.rate - worst < 0.25)
    assert found.effective_dimension == pytest.approx(1.0)


def test_what_is_searched_makes_the_tube_smaller_and_holds_linear_noise():
    system, where, rows = pendulum(), boxes(0.02), np.array([[1.0, 0.0]])
    still = moving_constants_along(system, TIMES, where, frames=np.tile(np.eye(2), (len(TIMES), 1, 1)))
    moving = moving_constants_along(system, TIMES, where, directions=rows)
    tubes = [cb.tune_tube(found.constants(), horizon=2.0, delta=1e-2) for found in (still, moving)]
    extents = [found.extent(tube, rows) for found, tube in zip((still, moving), tubes)]
    assert extents[1].max() < 0.7 * extents[0].max()
    deviation = 0.1 * np.sqrt(2.0 / 3.0)  # about that of the linear model, from sigma^2 t^3/3, damped
    assert extents[1].max() > deviation
    assert not moving.constants().certified


def test_what_cannot_be_had_is_refused():
    with pytest.raises(ValueError, match=r"`frames` must be finite, of shape \(21, 2, 2\)"):
        moving_constants_along(pendulum(), TIMES, boxes(), frames=np.eye(2))
    singular = np.tile(np.diag([1.0, 1e-3]), (len(TIMES), 1, 1))
    singular[5] = np.diag([1.0, 1.0])
    with pytest.raises(ValueError, match="change by less than half on every piece"):
        moving_constants_along(pendulum(), TIMES, boxes(), frames=singular)
    with pytest.raises(ValueError, match=r"`boxes` must have shape \(20, 2\)"):
        moving_constants_along(pendulum(), TIMES, boxes()[:3])
    with pytest.raises(InfeasibleError, match="moving coordinates need continuous time"):
        moving_constants_along(cb.load("chain_rest"), [0.0, 1.0], Interval(np.zeros((1, 6)), np.ones((1, 6))))
    with pytest.raises(InfeasibleError, match="found for up to 6 states, not 100"):
        moving_constants_along(formation(), [0.0, 1.0], Interval(np.zeros((1, 100)), np.ones((1, 100))))
