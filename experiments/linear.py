"""The paper's linear example dX = c X dt + sigma dW, X_0 = 0: exact sample paths, and tubes by name.

Paths are drawn from the exact Gaussian transition, independently of ``certbound.simulation``; between two
grid points the running maximum is drawn from the Brownian bridge, so that no exit between them is missed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

import certbound as cb
from certbound.tubes.tube import Tube
from experiments.limits import continuous_radius

__all__ = ["DELTA", "SIGMA", "Limit", "largest_deviations", "limit", "paths", "tube"]

SIGMA = math.sqrt(0.1)
DELTA = 1e-3


def tube(method: str, rate: float, horizon: float, *, delta: float = DELTA, **parameters: Any) -> Tube:
    """A tube of the scalar system by one method."""
    constants = cb.Constants(rate=rate, sigma=SIGMA, dimension=1, isotropic=True)
    return cb.tune_tube(constants, horizon=horizon, delta=delta, method=method, **parameters)


@dataclass(frozen=True)
class Limit:
    """A constant radius, asked like a tube."""

    maximum: float

    def radius(self, times: np.ndarray) -> np.ndarray:
        """The radius at each time."""
        return np.full(np.shape(times), self.maximum)


def limit(rate: float, horizon: float, *, delta: float = DELTA) -> Limit:
    """The exact constant radius of the scalar system."""
    return Limit(continuous_radius(rate, 1, horizon, delta, SIGMA))


def step_factors(rate: float, step: float) -> tuple[float, float]:
    """X(t + step) = factor X(t) + deviation N(0, 1), exactly."""
    growth = math.exp(rate * step)
    variance = SIGMA**2 * (step if rate == 0 else math.expm1(2 * rate * step) / (2 * rate))
    return growth, math.sqrt(variance)


def paths(rate: float, horizon: float, *, count: int, points: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Times (points + 1,) and paths (count, points + 1)."""
    rng = np.random.default_rng(seed)
    growth, deviation = step_factors(rate, horizon / points)
    noise = deviation * rng.standard_normal((points, count))
    values = np.zeros((points + 1, count))
    for k in range(points):
        values[k + 1] = growth * values[k] + noise[k]
    return np.linspace(0.0, horizon, points + 1), values.T


def largest_deviations(rate: float, horizon: float, *, count: int, steps: int, seed: int) -> np.ndarray:
    """sup over [0, horizon] of |X| for each of ``count`` paths, with a bridge between grid points.

    On a short step the diffusion's bridge is a Brownian one up to terms of order step^1.5. Only the side of
    the bridge that is nearer to its level is drawn: the other one matters far below the levels in use.
    """
    rng = np.random.default_rng(seed)
    step = horizon / steps
    growth, deviation = step_factors(rate, step)
    largest = np.zeros(count)
    for start in range(0, count, 100_000):
        block = slice(start, min(start + 100_000, count))
        size = block.stop - block.start
        now, top = np.zeros(size), np.zeros(size)
        for _ in range(steps):
            following = growth * now + deviation * rng.standard_normal(size)
            spread = 2 * SIGMA**2 * step * rng.standard_exponential(size)
            middle = np.abs(now + following)
            top = np.maximum(top, (middle + np.sqrt((following - now) ** 2 + spread)) / 2)
            now = following
        largest[block] = top
    return largest
