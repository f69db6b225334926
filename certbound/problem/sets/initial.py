"""Does the start satisfy the constraints that are due at time 0?"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certbound.problem.sets.constraints import GaussianStart, Inside
from certbound.problem.sets.forms import Faces, Quadratic, Region

__all__ = ["check_start"]

Array = NDArray[np.float64]


def check_start(initial: Region | GaussianStart, constraints: Sequence[Inside]) -> None:
    """Refuse a start that violates a constraint, wholly or (where that is easily decided) in part.

    Raises
    ------
    ValueError
        Naming the constraint and how the start violates it.
    """
    center = initial.middle
    for constraint in constraints:
        if constraint.during is not None and constraint.during[0] > 0:
            continue
        fault = _fault(initial, center, constraint)
        if fault:
            raise ValueError(
                f"`initial` must satisfy every constraint that is due at time 0, but {fault} violates "
                f"'{constraint.label}'; move the start or change the constraint."
            )


def _fault(initial: Region | GaussianStart, center: Array, constraint: Inside) -> str:
    text = "(" + ", ".join(f"{value:g}" for value in center) + ")"
    if not np.any(constraint.satisfied(center)) and not _on_boundary(center, constraint):
        return f"the mean {text}" if initial.random else f"its centre {text}"
    if initial.random:
        return ""
    sticks_out = _touches if constraint.outside else _leaves
    return "a part of it" if sticks_out(initial, constraint.region) else ""


def _on_boundary(point: Array, constraint: Inside) -> bool:
    """True for a start on the edge of an obstacle's closed set, which rounding must not decide."""
    moved = point + 1e-12 * (1.0 + np.abs(point)) * np.array([[1.0], [-1.0]])
    return constraint.outside and bool(np.any(constraint.satisfied(moved)))


def _slack(value: Any) -> Any:
    return 1e-9 * (1.0 + np.abs(value))


def _leaves(initial: Any, region: Region) -> bool:
    """Whether the start surely has a point outside the region."""
    match region.form:
        case Quadratic() as form:
            farthest = initial.reaches(region.center_at(), region.places(initial.dimension))[1]
            return form.even and bool(farthest > form.radius + _slack(form.radius))
        case Faces() as form:
            reach = initial.support(region.lifted(form.normals, initial.dimension))
            return bool(np.any(reach - form.normals @ region.center_at() > form.bounds + _slack(form.bounds)))


def _touches(initial: Any, region: Region) -> bool:
    """Whether the start surely has a point inside the region."""
    match region.form:
        case Quadratic() as form:
            nearest = initial.reaches(region.center_at(), region.places(initial.dimension))[0]
            return form.even and bool(nearest < form.radius - _slack(form.radius))
        case Faces() as form if len(form.bounds) == 1 and region.coordinates is None:
            nearest = -initial.support(-form.normals)[0] - form.normals[0] @ region.center_at()
            return bool(nearest < form.bounds[0] - _slack(form.bounds[0]))
        case Faces() as form if form.axial and initial.form.axial:
            low, high = (ends[region.places(initial.dimension)] for ends in (initial.hull().lo, initial.hull().hi))
            around = region.hull()
            return bool(np.all((low < around.hi - _slack(0.0)) & (high > around.lo + _slack(0.0))))
    return False
