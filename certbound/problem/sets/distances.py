"""How far a state is from a constraint, in a weighted norm (plain floats: for proposals and pictures).

The tube around x is {x + y: ‖y‖_P <= r}; ``clearance`` is a radius r up to which it respects the constraint.
What a verdict needs is proved elsewhere, with outward rounding.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.problem.sets.constraints import Inside
from certbound.problem.sets.forms import Faces, Quadratic, Region


def face_erosion(normals: ArrayLike, inverse_metric: ArrayLike | None = None) -> Array:
    """sqrt(a' P^-1 a) for rows a, shape (..., n): what a unit tube takes from {a.x <= b}."""
    a = np.asarray(normals, dtype=float)
    spread = a if inverse_metric is None else a @ np.asarray(inverse_metric, dtype=float)
    return np.asarray(np.sqrt(np.maximum(np.sum(a * spread, axis=-1), 0.0)))


def round_erosion(block: ArrayLike) -> float:
    """sqrt(lambda_max(C P^-1 C')): what a unit tube takes from a ball, given that block of P^-1."""
    return float(np.sqrt(np.linalg.eigvalsh(np.asarray(block, dtype=float))[-1]))


def clearance(
    constraint: Inside, x: ArrayLike, inverse_metric: ArrayLike | None = None, t: float = 0.0
) -> Array:
    """Signed distance of states to a constraint: every x + y with ‖y‖_P below it satisfies the constraint.

    Exact for half-spaces, for staying inside a polyhedron, and for balls and ellipsoids where P is a multiple
    of the identity on their coordinates; a lower bound in magnitude of safety elsewhere. Negative where x
    violates.

    Parameters
    ----------
    constraint : Inside or Outside
        At time ``t``, whatever its window.
    x : array_like, shape (..., n)
        States.
    inverse_metric : array_like, shape (n, n), optional
        P^-1 of the norm sqrt(y' P y); the identity when omitted.
    t : float
        Time, for a moving centre.

    Returns
    -------
    ndarray, shape (...)

    Examples
    --------
    >>> from certbound.problem.sets import Ball, Outside
    >>> float(clearance(Outside(Ball([0.0, 0.0], 1.0)), [3.0, 4.0]))
    4.0
    """
    region = constraint.region.at(t) if constraint.region.changing else constraint.region
    y = region.local(x) - region.center_at(t)
    block = _block(region, np.shape(x)[-1], inverse_metric)
    inside = not constraint.outside
    match region.form:
        case Faces() as form:
            if not len(form.bounds):
                return np.full(y.shape[:-1], np.inf if inside else -np.inf)
            room = (form.bounds - y @ form.normals.T) / face_erosion(form.normals, block)
            return np.asarray(np.min(room, axis=-1) if inside else np.max(-room, axis=-1))
        case Quadratic() as form:
            room = form.radius - np.linalg.norm(y @ form.root.T, axis=-1)
            return np.asarray((room if inside else -room) / round_erosion(form.root @ block @ form.root.T))


def _block(region: Region, dimension: int, inverse_metric: ArrayLike | None) -> Array:
    inverse = np.eye(dimension) if inverse_metric is None else np.asarray(inverse_metric, dtype=float)
    if inverse.shape != (dimension, dimension):
        raise ValueError(f"`inverse_metric` must have shape {(dimension, dimension)}, got {inverse.shape}.")
    places = region.places(dimension)
    return np.asarray(inverse[np.ix_(places, places)])
