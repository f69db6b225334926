"""Means of value functions by brute force."""

from __future__ import annotations

import numpy as np

from certbound.values.discrete.functions import ValueFunction
from certbound.values.grids import Grid


def random_function(rng: np.random.Generator, grid: Grid, *, fixed: float = 0.0) -> ValueFunction:
    """Node values in [0, 1], bends of both signs, and a share of cells with a constant."""
    n = grid.dimension
    bend = np.stack([rng.uniform(-1, 1, grid.shape) / grid.widths(i) ** 2 for i in range(n)])
    mask = rng.uniform(size=grid.shape) < fixed
    level = np.where(mask, rng.uniform(size=grid.shape), 0.0)
    return ValueFunction(
        grid=grid,
        nodal=rng.uniform(size=grid.node_shape),
        bend=np.where(mask, 0.0, bend),
        fixed=mask if fixed else None,
        level=level,
    )


def mean_after_noise(value: ValueFunction, points: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """E U(m + w) by Gauss's rule on every cell, w normal; points (P, n)."""
    root, weight = np.polynomial.legendre.leggauss(16)
    places, weights = [], []
    for axis in value.grid.axes:
        width = np.diff(axis)[:, None]
        places.append((axis[:-1, None] + width * (root + 1) / 2).ravel())
        weights.append((width * weight / 2).ravel())
    y = np.stack([part.ravel() for part in np.meshgrid(*places, indexing="ij")], axis=1)
    w = np.prod([part.ravel() for part in np.meshgrid(*weights, indexing="ij")], axis=0)
    white = np.linalg.inv(np.linalg.cholesky(covariance))
    w = w * np.linalg.det(white) / np.sqrt(2 * np.pi) ** len(covariance)
    places = white @ y.T
    share = value.values(y)
    found = []
    for point in points @ white.T:
        density = np.exp(-0.5 * np.sum((places - point[:, None]) ** 2, axis=0)) * w
        found.append(np.sum(density * share) + 1 - np.sum(density))
    return np.array(found)


def mean_over_boxes(value: ValueFunction, points: np.ndarray, half: np.ndarray) -> np.ndarray:
    """E U(m + w), w uniform on [-half, half], by Gauss's rule between all nodes; points (P, n)."""
    root, weight = np.polynomial.legendre.leggauss(3)
    found = []
    for point in points:
        places, weights = [], []
        for axis, middle, r in zip(value.grid.axes, point, half):
            inner = axis[(axis > middle - r) & (axis < middle + r)]
            cuts = np.concatenate([[middle - r], inner, [middle + r]])
            width = np.diff(cuts)[:, None]
            places.append((cuts[:-1, None] + width * (root + 1) / 2).ravel())
            weights.append((width * weight / (4 * r)).ravel())
        y = np.stack([part.ravel() for part in np.meshgrid(*places, indexing="ij")], axis=1)
        w = np.prod([part.ravel() for part in np.meshgrid(*weights, indexing="ij")], axis=0)
        found.append(np.sum(w * value.values(y)))
    return np.array(found)
