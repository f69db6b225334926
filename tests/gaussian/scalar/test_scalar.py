"""The doors of the sub-room: what each proves is said, and a quantile of a linear system against a million paths."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

from certbound.gaussian import scalar as gaussian

DELTA = 1e-3


def test_every_door_is_documented_with_what_it_proves():
    for name in set(gaussian.__all__) - {"Bounds"}:
        text = getattr(gaussian, name).__doc__
        assert len(text) > 60, name


def covariance(drift, noise, time):
    """Covariance of dZ = drift Z dt + noise dW from 0, by Van Loan's matrix exponential."""
    n = len(drift)
    block = np.block([[-drift, noise @ noise.T], [np.zeros((n, n)), drift.T]]) * time
    result = expm(block)
    return result[n:, n:].T @ result[:n, n:]


OSCILLATOR, FORCE = np.array([[0.0, 1.0], [-1.0, -1.0]]), np.array([[0.0], [0.5]])


def hull(values):
    return values.min(axis=-1), values.max(axis=-1)


def position_radius(count=200, horizon=5.0, fine=4):
    edges = np.linspace(0, horizon, count + 1)
    times = (edges[:-1, None] + np.diff(edges)[:, None] * np.linspace(0, 1, fine)).ravel()
    moments = np.array([covariance(OSCILLATOR, FORCE, t) for t in times]).reshape(count, fine, 2, 2)
    parts = [hull(moments[..., i, j]) for i, j in ((0, 0), (0, 1), (1, 1))]
    parts = [(np.maximum(low, 0.0) if k != 1 else low, high) for k, (low, high) in enumerate(parts)]

    def excess(z):
        one = gaussian.crossing_rate(np.diff(edges), np.full(count, z), *parts, start_variance=0.0)
        return one + np.log10(2) - np.log10(DELTA)

    return brentq(excess, 0.5, 5.0, xtol=1e-6) + 1e-6


def oscillator_maxima(paths, seed=0, steps=250, horizon=5.0):
    """Largest |position| of each path, by exact transitions."""
    import numba

    step = horizon / steps
    flow = expm(OSCILLATOR * step)
    root = np.linalg.cholesky(covariance(OSCILLATOR, FORCE, step))

    @numba.njit(cache=False)
    def run(flow, root, paths, steps, rng):
        out = np.empty(paths)
        for i in range(paths):
            x, v, top = 0.0, 0.0, 0.0
            for _ in range(steps):
                a, b = rng.standard_normal(), rng.standard_normal()
                x_new = flow[0, 0] * x + flow[0, 1] * v + root[0, 0] * a
                v_new = flow[1, 0] * x + flow[1, 1] * v + root[1, 0] * a + root[1, 1] * b
                x, v = x_new, v_new
                top = max(top, abs(x))
            out[i] = top
        return out

    return run(flow, root, paths, steps, np.random.default_rng(seed))


@pytest.mark.slow
def test_the_radius_of_an_oscillators_position_is_within_five_percent_of_the_simulated_quantile():
    paths, radius = 1_000_000, position_radius()
    maxima = oscillator_maxima(paths)
    assert np.mean(maxima > radius) <= DELTA + 4 * np.sqrt(DELTA / paths)
    assert radius <= 1.05 * np.quantile(maxima, 1 - DELTA)
