"""Directions that separate a point from a convex obstacle as well as possible in a given metric (proposals
only).

With noise of shape Q around the point q, the best direction maximises (a.q - h(a)) / sqrt(a^T Q a), h the
obstacle's support function; it is Q^-1 (q - y) for the obstacle's point y nearest to q in the norm of Q^-1.
"""

from __future__ import annotations

import numpy as np

from certbound.arrays import Array

SWEEPS = 60


def round_directions(points: Array, shape: Array, matrix: Array) -> Array:
    """Directions away from the ellipsoid {y^T shape^-1 y <= 1} for points (..., q) relative to its centre.

    With shape = L L^T, z = L^-1 q and L^-1 Q L^-T = U diag(e) U^T, the nearest point has coordinates
    w_i = z_i/(1 + mu e_i) in the basis U, mu >= 0 such that ||w|| = 1, and the direction is L^-T U w.
    """
    scale = np.trace(shape) / len(shape)
    if scale <= 0:  # a ball of radius 0: a point
        return _usable(np.asarray(np.linalg.solve(matrix, points[..., None])[..., 0], dtype=float))
    root = np.linalg.cholesky(shape)
    inverse = np.linalg.inv(root)
    values, basis = np.linalg.eigh(inverse @ matrix @ inverse.T)
    values = np.maximum(values, 1e-300)
    z = points @ inverse.T @ basis
    low, high = np.full(z.shape[:-1], -60.0), np.full(z.shape[:-1], 60.0)
    unit = np.log(np.mean(values))
    for _ in range(60):
        middle = (low + high) / 2
        w = z / (1 + np.exp(middle - unit)[..., None] * values)
        outside = np.sum(w * w, axis=-1) > 1
        low, high = np.where(outside, middle, low), np.where(outside, high, middle)
    w = z / (1 + np.exp(low - unit)[..., None] * values)
    return _usable(w @ basis.T @ inverse)


def polyhedral_weights(points: Array, faces: Array, bounds: Array, matrix: Array) -> list[Array]:
    """Weights lam >= 0 (..., m): the direction faces^T lam keeps the point off {faces y <= bounds}.

    Two proposals: the single best face, and the direction to the nearest point by Hildreth's dual coordinate
    ascent on max_{lam >= 0} lam.(faces q - bounds) - lam^T G lam / 2, G = faces Q faces^T. ``bounds`` (..., m) and
    ``matrix`` (..., n, n) may differ from point to point.
    """
    if len(faces) == 0:
        return []
    excess = points @ faces.T - bounds
    gram = faces @ matrix @ faces.T
    diagonal = np.maximum(np.diagonal(gram, axis1=-2, axis2=-1), 1e-300)
    single = np.zeros(excess.shape)
    best = np.argmax(excess / np.sqrt(diagonal), axis=-1)
    np.put_along_axis(single, best[..., None], 1.0, axis=-1)
    if len(faces) == 1:
        return [single]
    weights = np.zeros(excess.shape)
    for _ in range(SWEEPS):
        for i in range(len(faces)):
            spent = np.sum(weights * gram[..., :, i], axis=-1) - weights[..., i] * gram[..., i, i]
            weights[..., i] = np.maximum((excess[..., i] - spent) / diagonal[..., i], 0.0)
    total = np.sum(weights, axis=-1, keepdims=True)
    return [single, np.where(total > 0, weights / np.where(total > 0, total, 1.0), single)]


def _usable(directions: Array) -> Array:
    """Unit vectors; an arbitrary one where the direction vanishes."""
    length = np.linalg.norm(directions, axis=-1, keepdims=True)
    fallback = np.zeros(directions.shape[-1])
    fallback[0] = 1.0
    return np.where(length > 0, directions / np.where(length > 0, length, 1.0), fallback)
