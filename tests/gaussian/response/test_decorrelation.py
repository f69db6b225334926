"""Near rates, needs and second moments against responses integrated finely."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from certbound.gaussian.response.decorrelation import BATCH, BESIDE, decorrelation, pairs_of
from certbound.gaussian.response.linear_response import LinearResponse, continuous_response
from certbound.gaussian.response.moments import smooth_moments
from certbound.gaussian.scalar.slepian import node_clock

Array = NDArray[np.float64]

PARTS, FINE, STEP = 40, 8, 0.05


def response(n: int, seed: int, diffusion: Array, start: Array) -> LinearResponse:
    """Slopes that move linearly on every part and jump between parts."""
    rng = np.random.default_rng(seed)
    slope = -0.7 * np.eye(n) + 0.6 * rng.standard_normal((1, 1, n, n)) + 0.1 * rng.standard_normal((1, PARTS, n, n))
    drift = 0.8 * rng.standard_normal((1, PARTS, n, n))
    return continuous_response(slope, drift, STEP, diffusion, start)


def integrated(r: LinearResponse, diffusion: Array) -> tuple[Array, Array]:
    """Phi(t, 0) and V at FINE points of every part and at the end, by four Runge-Kutta steps each."""
    n, h = diffusion.shape[0], STEP / FINE / 4
    phi, v = np.eye(n), r.covariance[0, 0].copy()
    phis, vs = [phi], [v]
    for k in range(PARTS):
        for j in range(FINE * 4):
            def rate(x: tuple[Array, Array], tau: float, k: int = k) -> tuple[Array, Array]:
                a = r.slope[0, k] + tau * r.drift[0, k]
                return a @ x[0], a @ x[1] + x[1] @ a.T + diffusion @ diffusion.T

            x, tau = (phi, v), j * h
            one = rate(x, tau)
            two = rate((x[0] + h / 2 * one[0], x[1] + h / 2 * one[1]), tau + h / 2)
            three = rate((x[0] + h / 2 * two[0], x[1] + h / 2 * two[1]), tau + h / 2)
            four = rate((x[0] + h * three[0], x[1] + h * three[1]), tau + h)
            phi, v = (y + h / 6 * (a + 2 * b + 2 * c + d) for y, a, b, c, d in zip(x, one, two, three, four))
            if j % 4 == 3:
                phis.append(phi)
                vs.append(v)
    return np.array(phis), np.array(vs)


@pytest.mark.parametrize(("n", "seed"), [(1, 0), (2, 1), (3, 2), (3, 5)])
def test_a_clock_of_the_needs_dominates_the_decorrelation_between_all_times(n: int, seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    diffusion, w = 0.4 * np.eye(n) + 0.1 * rng.standard_normal((n, n)), rng.standard_normal(n)
    r = response(n, seed, diffusion, 0.3 * np.eye(n))
    found = decorrelation(r, w, diffusion, 0)
    assert found is not None
    phi, v = integrated(r, diffusion)
    variance = np.einsum("i,kij,j->k", w, v, w)
    # Phi(t, s) = Phi(t) Phi(s)^{-1}
    rows, columns = phi.transpose(0, 2, 1) @ w, np.linalg.inv(phi) @ (v @ w)[..., None]
    correlation = rows @ columns[..., 0].T / np.sqrt(variance[:, None] * variance)
    times = np.arange(len(v)) / FINE
    for limit in (0.2, 1.0):
        clock = node_clock(found.durations, found.near, found.needs, limit=limit)
        nodes = np.concatenate([[0.0], np.cumsum(clock.increments)])
        reading = np.interp(times, np.arange(PARTS + 1), nodes)
        blocks, waste = np.append(clock.starts, PARTS), []
        for start, stop in itertools.pairwise(blocks):
            inside = np.arange(start * FINE, stop * FINE + 1)
            s, t = np.triu_indices(len(inside), 1)
            psi = -np.log(correlation[inside[t], inside[s]])
            clocked = reading[inside[t]] - reading[inside[s]]
            assert np.all(clocked >= psi - 1e-9)
            waste.append(float(np.min(clocked / np.maximum(psi, 1e-9))))
        assert min(waste) <= 1.5  # some pair of times nearly decides


def test_the_needs_are_second_order() -> None:
    rate, diffusion = 0.8, np.array([[0.5]])
    excess = []
    for parts in (20, 40, 80):
        h = 2.0 / parts
        slope = np.full((1, parts, 1, 1), -rate)
        r = continuous_response(slope, 0 * slope, h, diffusion, np.array([[0.25 / (2 * rate)]]))
        found = decorrelation(r, np.ones(1), diffusion, 0)
        assert found is not None
        assert np.all(found.near >= rate)
        assert np.all(np.diagonal(found.needs, 1) >= rate * h)
        clock = node_clock(found.durations, found.near, found.needs, limit=9.0)
        excess.append(float(clock.increments.sum()) / (2 * rate) - 1)
    assert 0 <= excess[2] < 0.006
    assert excess[0] > 10 * excess[2]


def test_smooth_moments_enclose_those_of_a_fine_integration() -> None:
    diffusion = np.array([[0.0], [0.0], [0.6]])
    rng = np.random.default_rng(3)
    slope = np.array([[[[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, -2.0, -1.5]]]]) + np.zeros((1, PARTS, 1, 1))
    drift = np.zeros_like(slope)
    drift[..., 2, :] = rng.standard_normal((1, PARTS, 3))
    r = continuous_response(slope, drift, STEP, diffusion, 0.01 * np.eye(3))
    w = np.array([1.0, 0.5, 0.0])
    found = smooth_moments(r, w, diffusion)
    _, v = integrated(r, diffusion)
    widths = []
    for k in range(PARTS):
        for j in range(FINE):
            alpha = w @ (r.slope[0, k] + j * STEP / FINE * r.drift[0, k])
            at = v[k * FINE + j]
            for box, value in ((found.variance, w @ at @ w), (found.covariance, alpha @ at @ w),
                               (found.velocity, alpha @ at @ alpha)):
                assert box.lo[k] - 1e-9 <= value <= box.hi[k] + 1e-9
        widths.append(found.variance.hi[k] - found.variance.lo[k])
    assert max(widths) <= 1.3 * np.abs(np.diff(np.einsum("i,kij,j->k", w, v[::FINE], w))).max()
    assert abs(found.start.hi - w @ r.covariance[0, 0] @ w) < 1e-9


def test_no_rates_where_the_variance_vanishes() -> None:
    diffusion = np.array([[0.5]])
    slope = np.full((1, 10, 1, 1), -1.0)
    r = continuous_response(slope, 0 * slope, 0.1, diffusion, np.zeros((1, 1)))
    assert decorrelation(r, np.ones(1), diffusion, 0) is None
    assert decorrelation(r, np.ones(1), diffusion, 3) is not None


@pytest.mark.parametrize("n", [1, 3])
def test_pairs_of_nodes_come_in_batches_with_all_that_is_made_of_them(n: int) -> None:
    count = 300
    batches = [len(pairs.a) for pairs in pairs_of(np.tile(0.99 * np.eye(n), (count, 1, 1)), np.zeros(count))]
    assert sum(batches) == count * (count + 1) // 2
    assert max(batches) * n * (n + BESIDE) <= BATCH + count * n * (n + BESIDE)
    assert len(batches) > 3
