"""Quantiles of linear systems: the doors of the module together, against simulation of a million paths."""

import numpy as np
import pytest
from scipy.linalg import expm

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


def velocity_radius(count=150, begin=1e-3, horizon=5.0, fine=4):
    """Least z with P(exists t: |velocity| > z) <= DELTA; enclosures by sampling within the pieces, widened."""
    edges = np.concatenate(
        [np.geomspace(begin, 0.3, count // 3, endpoint=False), np.linspace(0.3, horizon, count - count // 3 + 1)]
    )
    times = (edges[:-1, None] + np.diff(edges)[:, None] * np.linspace(0, 1, fine)).ravel()
    moments = np.array([covariance(OSCILLATOR, FORCE, t) for t in times])
    flow = np.array([expm(OSCILLATOR * t) for t in times])
    row = np.array([0.0, 1.0])
    seed = np.linalg.solve(flow, (moments @ row)[..., None])[..., 0]
    shape = (count, fine, count, fine)
    cov = (seed @ (row @ flow).T).reshape(shape)
    drift = (seed @ (row @ OSCILLATOR @ flow).T).reshape(shape)
    variance = np.einsum("i,kij,j->k", row, moments, row).reshape(count, fine)

    def over(m, relative=1e-4):
        low, high = m.min(axis=(1, 3)), m.max(axis=(1, 3))
        return low - relative * np.abs(low), high + relative * np.abs(high)

    rates = gaussian.decorrelation_rates(hull(variance), np.full(count, 0.25), over(cov), over(drift))
    clock = gaussian.markov_clock(np.diff(edges), rates)
    spread = np.sqrt(variance)
    ends = np.stack([spread[:, 0], spread[:, -1]], axis=-1)

    def bound(z):
        return gaussian.double(gaussian.clock_crossing(clock, z / ends))

    return gaussian.least_scale(bound, np.log10(DELTA), start=1.5)


def position_radius(count=200, horizon=5.0, fine=4):
    edges = np.linspace(0, horizon, count + 1)
    times = (edges[:-1, None] + np.diff(edges)[:, None] * np.linspace(0, 1, fine)).ravel()
    moments = np.array([covariance(OSCILLATOR, FORCE, t) for t in times]).reshape(count, fine, 2, 2)
    parts = [hull(moments[..., i, j]) for i, j in ((0, 0), (0, 1), (1, 1))]
    parts = [(np.maximum(low, 0.0) if k != 1 else low, high) for k, (low, high) in enumerate(parts)]

    def bound(z):
        one = gaussian.crossing_rate(np.diff(edges), np.full(count, z), *parts, start_variance=0.0)
        return gaussian.double(one)

    return gaussian.least_scale(bound, np.log10(DELTA), start=1.3)


def oscillator_maxima(paths, seed=0, steps=250, horizon=5.0):
    """Largest |position| and |velocity| of each path: exact transitions, bridges within steps for the velocity."""
    import numba

    step = horizon / steps
    flow = expm(OSCILLATOR * step)
    root = np.linalg.cholesky(covariance(OSCILLATOR, FORCE, step))

    @numba.njit(cache=False)
    def run(flow, root, paths, steps, rng, spread):
        out = np.empty((paths, 2))
        for i in range(paths):
            x, v, top_x, top_v = 0.0, 0.0, 0.0, 0.0
            for _ in range(steps):
                a, b = rng.standard_normal(), rng.standard_normal()
                x_new = flow[0, 0] * x + flow[0, 1] * v + root[0, 0] * a
                v_new = flow[1, 0] * x + flow[1, 1] * v + root[1, 0] * a + root[1, 1] * b
                gap = (v_new - v) ** 2 - 2 * spread * np.log(rng.random())
                top_v = max(top_v, 0.5 * (abs(v + v_new) + np.sqrt(gap)))
                x, v = x_new, v_new
                top_x = max(top_x, abs(x))
            out[i, 0], out[i, 1] = top_x, top_v
        return out

    return run(flow, root, paths, steps, np.random.default_rng(seed), 0.25 * step)


@pytest.mark.slow
def test_oscillator_radii_are_within_five_percent_of_the_simulated_quantiles():
    paths = 1_000_000
    maxima = oscillator_maxima(paths)
    radii = np.array([position_radius(), velocity_radius()])
    quantiles = np.quantile(maxima, 1 - DELTA, axis=0)
    exceeded = np.mean(maxima > radii, axis=0)
    assert np.all(exceeded <= DELTA + 4 * np.sqrt(DELTA / paths))
    assert np.all(radii <= 1.05 * quantiles)


def chain_at_rest(step=0.1, stiffness=10.0, damper=2.0, friction=1.0, sigma=0.43):
    """Three masses in a row, linearised at rest: transition, noise matrix, and the four constrained directions."""
    couple = np.array([[-1.0, 1, 0], [1, -2, 1], [0, 1, -2]])
    eye = np.eye(3)
    lower = np.hstack([step * stiffness * couple, eye + step * (damper * couple - friction * eye)])
    transition = np.vstack([np.hstack([eye, step * eye]), lower])
    noise = np.vstack([np.zeros((3, 3)), step * sigma * eye])
    rows = np.array([[-1.0, 0, 0, 0, 0, 0], [1, -1, 0, 0, 0, 0], [0, 1, -1, 0, 0, 0], [0, 0, 0, 0, 0, 1]])
    return transition, noise, rows


@pytest.mark.slow
def test_chain_levels_are_within_three_percent_of_the_simulated_quantiles():
    transition, noise, rows = chain_at_rest()
    steps, paths, delta = 50, 2_000_000, 2e-3
    moment, variances, covariances = np.zeros((6, 6)), [], []
    for _ in range(steps):
        moment = transition @ moment @ transition.T + noise @ noise.T
        variances.append(np.einsum("ji,ik,jk->j", rows, moment, rows))
        covariances.append(np.einsum("ji,ik,jk->j", rows @ transition, moment, rows))
    v, c = np.array(variances).T, np.array(covariances).T[:, :-1]
    # the position sees no noise in the first step: its variance is an exact 0
    v = (np.maximum(v * (1 - 1e-12), 0), v * (1 + 1e-12))
    c = (c - 1e-12 * np.abs(c), c + 1e-12 * np.abs(c))
    levels = np.array(
        [
            gaussian.least_scale(
                lambda z, j=j: gaussian.exceedance_chain(
                    np.full(steps, z), (v[0][j], v[1][j]), (c[0][j], c[1][j])
                ),
                np.log10(delta),
                start=0.2,
            )
            for j in range(4)
        ]
    )
    rng = np.random.default_rng(0)
    maxima = []
    for _ in range(10):
        z = np.zeros((paths // 10, 6))
        top = np.full((len(z), 4), -np.inf)
        for _ in range(steps):
            z = z @ transition.T
            z[:, 3:] += noise[3, 0] * rng.standard_normal((len(z), 3))
            top = np.maximum(top, z @ rows.T)
        maxima.append(top)
    peaks = np.concatenate(maxima)
    quantiles = np.quantile(peaks, 1 - delta, axis=0)
    exceeded = np.mean(peaks > levels, axis=0)
    assert np.all(exceeded <= delta + 4 * np.sqrt(delta / paths))
    assert np.all(levels <= 1.03 * quantiles)
