"""Clocks and crossing rates of the Gaussian response against simulation and against the windows."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

import certbound as cb
from certbound.gaussian.response.clocks import ClockBound, ClockEvents, RateBound
from certbound.gaussian.response.events import WindowEvents
from certbound.reach.linear.linearisation import Linearisation

Array = NDArray[np.float64]

MATRIX = np.array([[0.0, 1.0], [-1.0, -1.0]])
DIFFUSION = np.diag([0.0, 0.5])


def events(matrix: Array, diffusion: Array, horizon: float) -> ClockEvents:
    n = len(matrix)
    system = cb.linear_system(matrix, diffusion=diffusion)
    problem = cb.Problem(
        system, initial=np.zeros(n), safe=[cb.Inside(cb.Box([-9.0] * n, [9.0] * n))], horizon=horizon, delta=1e-3
    )
    engine = Linearisation.of(problem)
    windows = WindowEvents(engine.response, 0, max(1, round(0.05 / engine.step)), np.log(1e-6))
    return ClockEvents(windows, diffusion)


def largest(matrix: Array, diffusion: Array, horizon: float, paths: int, seed: int) -> Array:
    """Running maximum of every state along exactly simulated paths (on a grid, so a little too small)."""
    n, steps = len(matrix), 500
    h = horizon / steps
    block = np.zeros((2 * n, 2 * n))
    block[:n, :n], block[:n, n:], block[n:, n:] = -matrix, diffusion @ diffusion.T, matrix.T
    large = expm(block * h)
    f, q = large[n:, n:].T, large[n:, n:].T @ large[:n, n:]
    root = np.linalg.cholesky((q + q.T) / 2 + 1e-18 * np.eye(n))
    rng = np.random.default_rng(seed)
    x, top = np.zeros((paths, n)), np.zeros((paths, n))
    for _ in range(steps):
        x = x @ f.T + rng.standard_normal((paths, n)) @ root.T
        top = np.maximum(top, x)
    return top


@pytest.mark.parametrize(("state", "kind"), [(0, RateBound), (1, ClockBound)])
def test_the_sharper_bounds_stay_above_the_simulated_probability(state: int, kind: type) -> None:
    found = events(MATRIX, DIFFUSION, 4.0)
    row = np.eye(2)[state]
    assert isinstance(found.bound(row), kind)
    pieces = found.windows.response.pieces
    event = found.along(np.broadcast_to(row, (pieces, 2)))
    top = np.sort(largest(MATRIX, DIFFUSION, 4.0, 20_000, 5)[:, state])
    for share in (0.05, 0.01, 0.003):
        level = float(top[int((1 - share) * len(top))])
        bound = np.exp(event.log_exceedance(np.full(pieces, level)))
        assert bound >= share - 3 * np.sqrt(share / len(top))
        assert bound <= 2.2 * share + 3 * np.sqrt(share / len(top))


def test_a_row_of_zeros_never_moves() -> None:
    found = events(MATRIX, DIFFUSION, 4.0)
    pieces = found.windows.response.pieces
    event = found.along(np.zeros((pieces, 2)))
    assert event.profile.max() < 1e-100
    assert event.log_exceedance(np.full(pieces, 1e-3)) < np.log(1e-5)


def test_a_clock_beats_the_windows_and_never_loses_to_them() -> None:
    found = events(np.array([[-0.5]]), np.array([[0.1**0.5]]), 5.0)
    pieces = found.windows.response.pieces
    rows = np.ones((pieces, 1))
    sharp, plain = found.along(rows), found.windows.along(rows)
    for level in (0.5, 1.2858, 2.0, 6.0):
        levels = np.full(pieces, level)
        assert sharp.log_exceedance(levels) <= plain.log_exceedance(levels)
    # 1.2858 is the exact two-sided radius at 1e-3 (theory of first passages)
    log = sharp.log_exceedance(np.full(pieces, 1.2858)) + np.log(2.0)
    assert np.log(1e-3) <= log <= np.log(1.5e-3)


def test_twelve_states() -> None:
    matrix = -np.eye(12) + 0.3 * np.eye(12, k=1)
    found = events(matrix, 0.1 * np.eye(12), 1.0)
    pieces = found.windows.response.pieces
    event = found.along(np.broadcast_to(np.eye(12)[3], (pieces, 12)))
    top = largest(matrix, 0.1 * np.eye(12), 1.0, 4000, 6)[:, 3]
    level = float(np.quantile(top, 0.98))
    assert 0.01 <= np.exp(event.log_exceedance(np.full(pieces, level))) <= 0.05
