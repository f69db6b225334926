"""Does the start satisfy the constraints that are due at time 0?"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certbound.problem.sets.constraints import GaussianStart, Inside, Outside
from certbound.problem.sets.distances import clearance
from certbound.problem.sets.regions import Ball, Box, Ellipsoid

__all__ = ["check_start"]

Array = NDArray[np.float64]
_ROUNDING, _SLACK = 1e-12, 1e-9
"""Shares of a state's size by which the start's centre, and its farthest part, may miss a constraint."""


def check_start(initial: Box | Ball | Ellipsoid | GaussianStart, constraints: Sequence[Inside]) -> None:
    """Refuse a start that violates a constraint, wholly or (where that is easily decided) in part.

    Raises
    ------
    ValueError
        Naming the constraint and how the start violates it.
    """
    center = _center(initial)
    for constraint in constraints:
        if constraint.during is not None and constraint.during[0] > 0:
            continue
        fault = _fault(initial, center, constraint)
        if fault:
            raise ValueError(
                f"`initial` must satisfy every constraint that is due at time 0, but {fault} violates "
                f"'{constraint.label}'; move the start or change the constraint."
            )


def _center(initial: Box | Ball | Ellipsoid | GaussianStart) -> Array:
    if isinstance(initial, Box):
        return np.asarray((initial.low + initial.high) / 2)
    return np.asarray(initial.mean if isinstance(initial, GaussianStart) else initial.center)


def _fault(initial: Any, center: Array, constraint: Inside) -> str:
    size = _size(initial, constraint.region)
    if _misses(center, constraint, size):
        text = "(" + ", ".join(f"{value:g}" for value in center) + ")"
        return f"the mean {text}" if isinstance(initial, GaussianStart) else f"its centre {text}"
    if isinstance(initial, GaussianStart):
        return ""
    sticks_out = _leaves if not isinstance(constraint, Outside) else _touches
    return "a part of it" if sticks_out(initial, center, constraint.region, _SLACK * size) else ""


def _size(initial: Any, region: Any) -> Array:
    """How large each state is in the start and in the set's centre, shape (n,): what rounding is measured by."""
    eye = np.eye(initial.dimension)
    ends = [initial.mean] if isinstance(initial, GaussianStart) else [initial.support(eye), initial.support(-eye)]
    size: Array = np.max(np.abs(ends), axis=0)
    size[slice(None) if region.coordinates is None else list(region.coordinates)] += np.abs(region.center_at())
    return size


def _misses(center: Array, constraint: Inside, size: Array) -> bool:
    """Whether a point violates the constraint by more than rounding, which must decide nothing on an edge."""
    if np.any(constraint.satisfied(center)):
        return False
    with np.errstate(divide="ignore", invalid="ignore"):  # nothing is left of a face along states that are 0
        return bool(clearance(constraint, center, np.diag(size**2)) < -_ROUNDING)


def _leaves(initial: Any, center: Array, region: Any, slack: Array) -> bool:
    """Whether the start surely has a point outside the region."""
    if isinstance(region, (Ball, Ellipsoid)):
        if not isinstance(region, Ball):
            return False
        return bool(_farthest(initial, region) > region.radius + np.max(region.local(slack)))
    normals, bounds = region.halfspaces()
    if not len(bounds):
        return False
    full = np.zeros((len(bounds), len(center)))
    full[:, range(len(center)) if region.coordinates is None else list(region.coordinates)] = normals
    reach = initial.support(full) - normals @ region.center_at()
    return bool(np.any(reach > bounds + np.abs(full) @ slack))


def _touches(initial: Any, center: Array, region: Any, slack: Array) -> bool:
    """Whether the start surely has a point inside the region."""
    if isinstance(region, Ball):
        return bool(_nearest(initial, region) < region.radius - np.max(region.local(slack)))
    normals, bounds = region.halfspaces() if not isinstance(region, Ellipsoid) else (np.empty(0), np.empty(0))
    if len(bounds) == 1 and region.coordinates is None:
        return bool(-initial.support(-normals)[0] < bounds[0] - np.abs(normals[0]) @ slack)
    if isinstance(region, Box) and isinstance(initial, Box):
        offset = region.center_at()
        low, high = region.low + offset, region.high + offset
        below = region.local(initial.low) < high - region.local(slack)
        above = region.local(initial.high) > low + region.local(slack)
        return bool(np.all(below & above))
    return False


def _farthest(initial: Any, region: Ball) -> float:
    """Largest distance of the start from the region's centre (for an ellipsoid: of its own centre)."""
    origin = region.center_at()
    if isinstance(initial, Box):
        low, high = region.local(initial.low), region.local(initial.high)
        return float(np.linalg.norm(np.maximum(np.abs(low - origin), np.abs(high - origin))))
    reach = initial.radius if isinstance(initial, Ball) else 0.0
    return float(np.linalg.norm(region.local(initial.center) - origin)) + reach


def _nearest(initial: Any, region: Ball) -> float:
    origin = region.center_at()
    if isinstance(initial, Box):
        closest = np.clip(origin, region.local(initial.low), region.local(initial.high))
        return float(np.linalg.norm(closest - origin))
    reach = initial.radius if isinstance(initial, Ball) else 0.0
    return float(np.linalg.norm(region.local(initial.center) - origin)) - reach
