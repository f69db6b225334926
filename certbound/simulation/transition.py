"""The exact transition of a linear stochastic system over one step."""

from __future__ import annotations

import math

import numpy as np

from certbound.arrays import Array

_SMOOTH = 0.25  # variance of a bridge over that of a step's noise, between that of positions and that of noisy states


def exact_transition(matrix: Array, offset: Array, diffusion: Array, step: float) -> tuple[Array, Array, Array]:
    """The law of x(h) for dx = (A x + B v + b) dt + G dW with v constant: N(F x + E v + e, L L').

    ``matrix`` (n, n + k) is [A, B], ``offset`` (n,) b, ``diffusion`` (n, m) G and ``step`` h in seconds. Returned are
    [F, E] (n, n + k), e (n,) and L (n, r), r the rank of the covariance.

    Notes
    -----
    The covariance is Van Loan's block exponential (1978) over h/2^j with ‖A‖ h/2^j <= 1/2, doubled j times by
    S(2h) = S(h) + F(h) S(h) F(h)'.

    Examples
    --------
    >>> move, shift, factor = exact_transition(np.array([[-1.0]]), np.array([1.0]), np.array([[1.0]]), 0.5)
    >>> bool(np.isclose(move[0, 0], np.exp(-0.5))), bool(np.isclose(factor[0, 0] ** 2, (1 - np.exp(-1)) / 2))
    (True, True)
    """
    from scipy.linalg import expm

    n, width = matrix.shape
    block = np.zeros((width + 1, width + 1))
    block[:n, :width], block[:n, width] = matrix, offset
    move = expm(block * step)[:n]
    stiffness = float(np.linalg.norm(matrix[:, :n], 2)) * step
    halvings = max(math.ceil(math.log2(max(stiffness, 1e-300))) + 1, 0)
    short = step / 2**halvings
    pair = np.block([[-matrix[:, :n], diffusion @ diffusion.T], [np.zeros((n, n)), matrix[:, :n].T]])
    exponential = expm(pair * short)
    flow = exponential[n:, n:].T
    covariance = flow @ exponential[:n, n:]
    for _ in range(halvings):
        covariance = covariance + flow @ covariance @ flow.T
        flow = flow @ flow
    return move[:, :width], move[:, width], _factor((covariance + covariance.T) / 2)


def bridge_spread(matrix: Array, diffusion: Array, step: float) -> Array:
    """The noise of a Brownian bridge that is as wide in the middle of a step as the path between its ends, (n, k).

    For dx = A x dt + G dW, given both ends. A mode that dies out within a step keeps to them more closely than a
    Brownian motion, by sqrt(tanh(a h/2)/(a h/2)) at rate -a; what follows noise at once spreads as that does. Rows
    of states that are smooth on a step, as positions, are 0: a bridge is a sixteenth as wide there as the noise of a
    step (in variance), and as wide where noise acts.

    Examples
    --------
    >>> spread = bridge_spread(np.array([[-8.0]]), np.array([[1.0]]), 0.5)
    >>> bool(np.isclose(spread[0, 0] ** 2, 0.5 * np.tanh(2.0) / 2.0))
    True
    """
    n = len(matrix)
    move, _, factor = exact_transition(matrix, np.zeros(n), diffusion, step / 2.0)
    half = factor @ factor.T
    scale = np.sqrt(np.diag(move @ half @ move.T + half))
    inverse = np.divide(1.0, scale, out=np.zeros(n), where=scale > 0.0)
    half, move = half * np.outer(inverse, inverse), inverse[:, None] * move * scale
    reach = move @ half
    left = half - reach.T @ np.linalg.lstsq(reach @ move.T + half, reach, rcond=None)[0]
    rough = 4.0 * np.diag(left) > _SMOOTH
    spread = 2.0 * scale[:, None] * _factor(0.5 * (left + left.T) * np.outer(rough, rough))
    return spread if spread.shape[1] else np.zeros((n, 1))


def _factor(covariance: Array) -> Array:
    """L with L L' = covariance: Cholesky's, or one without the directions that get no noise."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    inverse = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0)
    correlation = covariance * np.outer(inverse, inverse)
    values, vectors = np.linalg.eigh(correlation)
    if values[0] > 1e-10:
        return np.asarray(scale[:, None] * np.linalg.cholesky(correlation))
    kept = values > 1e-12
    return np.asarray(scale[:, None] * vectors[:, kept] * np.sqrt(values[kept]))
