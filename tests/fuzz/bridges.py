"""Brownian bridges between two times of a grid: whether a path has touched a set's faces in between.

Between gaps g and g' > 0 of variance v h a bridge touches 0 with probability exp(-2 g g'/(v h)); of a set to be avoided
all faces must be crossed, and the least likely one decides.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tests.fuzz.drafts import Shape

__all__ = ["gaps", "touched"]

Array = NDArray[np.float64]
LIMIT = 40.0
"""Exponent beyond which a bridge is not drawn."""


def gaps(shape: Shape, states: Array, t: float) -> tuple[Array, Array]:
    """How far states, shape (paths, n), are inside each face, and the slopes of that, shapes (faces, paths[, n]).

    A curved set has one face: the radius less the distance from the centre, in the set's own measure.
    """
    picked = list(range(states.shape[1])) if shape.coordinates is None else list(shape.coordinates)
    y = states[:, picked] - shape.middle(t, len(picked))
    if shape.kind in ("ball", "ellipsoid"):
        matrix = np.eye(len(picked)) / shape.data[0] ** 2 if shape.kind == "ball" else np.linalg.inv(shape.data[0])
        turned = y @ matrix
        size = np.sqrt(np.maximum(np.sum(turned * y, axis=1), 1e-300))
        values, slopes = (1.0 - size)[None], (-turned / size[:, None])[None]
    else:
        if shape.kind == "box":
            faces, bounds = np.vstack([np.eye(len(picked)), -np.eye(len(picked))]), np.concatenate([
                shape.data[1], -np.asarray(shape.data[0])
            ])  # fmt: skip
            faces, bounds = faces[np.isfinite(bounds)], bounds[np.isfinite(bounds)]
        else:
            faces, bounds = shape.data
        values = bounds[:, None] - faces @ y.T
        slopes = np.broadcast_to(-faces[:, None, :], (len(faces), len(y), len(picked)))
    whole = np.zeros((*slopes.shape[:2], states.shape[1]))
    whole[..., picked] = slopes
    return values, whole


def touched(
    shape: Shape, inside: bool, ends: tuple[float, Array, float, Array], noise: Array, slack: float,
    rng: np.random.Generator,
) -> NDArray[np.bool_]:  # fmt: skip
    """Which paths that stay in a set (or outside it) at both ends of a step leave (or meet) it in between.

    ``ends`` are time and states at the begin, and at the end; ``noise`` is g sqrt(h) at the begin, shape (paths, n,
    columns). The set is moved away by a share ``slack`` of its gaps' scale.
    """
    (old, slopes), (new, _) = gaps(shape, ends[1], ends[0]), gaps(shape, ends[3], ends[2])
    variance = np.sum(np.einsum("fpn,pnc->fpc", slopes, noise) ** 2, axis=-1)
    sign = 1.0 if inside else -1.0
    room = slack * (1.0 + np.abs(old))
    old, new = sign * old + room, sign * new + room
    with np.errstate(all="ignore"):
        exponent = np.where(variance > 0.0, 2.0 * old * new / variance, np.inf)
    exponent = np.where((old > 0.0) & (new > 0.0), exponent, np.inf if inside else 0.0)
    if not inside:
        exponent = np.max(exponent, axis=0, initial=0.0, keepdims=True)
        exponent[:, np.all(old <= 0.0, axis=0) | np.all(new <= 0.0, axis=0)] = np.inf  # in the set at an end: seen so
    hit = np.zeros(len(ends[1]), dtype=bool)
    for row in exponent:
        near = row < LIMIT
        hit[near] |= rng.random(np.count_nonzero(near)) < np.exp(-row[near])
    return hit
