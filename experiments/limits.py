"""The exact constant radius: P(sup |S_t| > R) = delta for the linear isotropic Gaussian system, in floating point.

A yardstick that shares no code with ``certbound.tubes``: it is compared with, never certified. Continuous time solves
the backward equation by finite volumes with the weight s^(n-1) e^(c s^2/sigma^2), exactly in time for c <= 0 and by
Crank-Nicolson after four implicit half steps for c > 0; discrete time (n = 1 or 3) applies the kernel of |S| on
Gauss-Legendre nodes. Four to five digits.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.linalg import eigh_tridiagonal
from scipy.linalg.lapack import dgttrf, dgttrs
from scipy.optimize import brentq

__all__ = ["continuous_radius", "discrete_radius", "exact_radius"]

SPECTRAL_LIMIT = 10


def exact_radius(
    *, rate: float | None = None, gain: float | None = None, n: int, horizon: float, delta: float, sigma: float = 1.0
) -> float:
    """The radius for a rate (continuous time) or a gain (discrete time)."""
    if rate is not None:
        return continuous_radius(rate, n, horizon, delta, sigma)
    assert gain is not None
    return discrete_radius(gain, n, int(horizon), delta, sigma)


def continuous_radius(rate: float, n: int, horizon: float, delta: float, sigma: float = 1.0) -> float:
    """Continuous time, dS = rate S dt + sigma dW in n dimensions."""
    spread = sigma * math.sqrt(horizon if rate == 0 else math.expm1(2 * rate * horizon) / (2 * rate))
    # in many dimensions the value at the centre is too small a part of a mode for double precision
    law = _implicit if rate > 0 or n > SPECTRAL_LIMIT else _spectral
    return _solve(lambda radius: law(rate, n, horizon, radius, sigma), spread, n, delta)


def discrete_radius(gain: float, n: int, steps: int, delta: float, sigma: float = 1.0) -> float:
    """Discrete time, S+ = gain S + w, w ~ N(0, sigma^2 I) in n = 1 or 3 dimensions."""
    spread = sigma * math.sqrt(steps if gain == 1 else (gain ** (2 * steps) - 1) / (gain**2 - 1))
    return _solve(lambda radius: _chain(gain, n, steps, radius / sigma), spread, n, delta)


def _solve(law: Callable[[float], float], spread: float, n: int, delta: float) -> float:
    level = math.log(delta)

    def gap(radius: float) -> float:
        return math.log(max(law(radius), 1e-300)) - level

    low = spread * math.sqrt(n) * 0.5
    while gap(low) < 0:
        low *= 0.7
    high = low * 1.4
    while gap(high) > 0:
        low, high = high, high * 1.4
    return float(brentq(gap, low, high, rtol=1e-7))


def _volumes(rate: float, n: int, radius: float, sigma: float, cells: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rates between neighbouring cells (up, down) and the rate of the last cell into the boundary."""
    width = radius / cells
    middle = (np.arange(cells) + 0.5) * width
    edge = np.arange(1, cells + 1) * width

    def weight(s: np.ndarray) -> np.ndarray:
        return (n - 1) * np.log(s) + rate * s**2 / sigma**2

    factor = sigma**2 / (2 * width**2)
    up = factor * np.exp(weight(edge) - weight(middle))
    up[-1] *= 2
    down = factor * np.exp(weight(edge[:-1]) - weight(middle[1:]))
    return up, down, middle


def _spectral(rate: float, n: int, horizon: float, radius: float, sigma: float, cells: int = 500) -> float:
    up, down, _ = _volumes(rate, n, radius, sigma, cells)
    diagonal = -up.copy()
    diagonal[1:] -= down
    # modes faster than this are below 1e-19 at the horizon
    slow = {"select": "v", "select_range": (-45 / horizon, 1e-9)}
    values, vectors = eigh_tridiagonal(diagonal, np.sqrt(up[:-1] * down), **slow)
    # similarity to the symmetric form: log of the square root of the weight, relative to the first cell
    scale = np.concatenate([[0.0], np.cumsum(0.5 * (np.log(up[:-1]) - np.log(down)))])
    ones = vectors.T @ np.exp(scale)
    return float(1 - np.sum(vectors[0] * np.exp(values * horizon) * ones))


def _implicit(rate: float, n: int, horizon: float, radius: float, sigma: float, steps: int = 1200) -> float:
    cells = int(min(20_000, max(800, 50 * rate * (radius / sigma) ** 2)))
    up, down, _ = _volumes(rate, n, radius, sigma, cells)
    diagonal = -up.copy()
    diagonal[1:] -= down
    source = np.zeros(cells)
    source[-1] = up[-1]
    value = np.zeros(cells)
    step = horizon / steps
    for count, length, share in ((4, step / 2, 1.0), (steps - 2, step, 0.5)):
        theta = share * length
        parts = dgttrf(-theta * down, 1 - theta * diagonal, -theta * up[:-1])[:5]
        for _ in range(count):
            right = value + length * source
            if share < 1:
                moved = diagonal * value
                moved[:-1] += up[:-1] * value[1:]
                moved[1:] += down * value[:-1]
                right += (length - theta) * moved
            value = dgttrs(*parts, right)[0]
    return float(value[0])


def _chain(gain: float, n: int, steps: int, radius: float) -> float:
    if n not in (1, 3):
        raise ValueError(f"`n` must be 1 or 3 in discrete time, got {n}.")
    count = int(max(60, 4 * radius))
    nodes, weights = np.polynomial.legendre.leggauss(count)
    r, w = radius * (nodes + 1) / 2, radius * weights / 2
    mean = gain * r[:, None]
    near, far = (np.exp(-((r - sign * mean) ** 2) / 2) / math.sqrt(2 * math.pi) for sign in (1, -1))
    kernel = (near + far if n == 1 else (near - far) * r / mean) * w
    if np.any(kernel.sum(axis=1) > 1 + 1e-9):
        raise ArithmeticError("`count` is too small: the kernel's rows sum to more than 1.")
    survival = np.ones(count)
    for _ in range(steps - 1):
        survival = kernel @ survival
    first = np.exp(-(r**2) / 2) * (2 / math.sqrt(2 * math.pi)) * (1 if n == 1 else r**2)
    return float(1 - (first * w) @ survival)
