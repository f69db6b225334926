"""Does the start satisfy the constraints that are due at time 0?"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.sets.constraints import GaussianStart, Inside
from certbound.problem.sets.distances import clearance
from certbound.problem.sets.forms import Faces, Quadratic, Region

_ROUNDING, _SLACK = 1e-12, 1e-9
"""Shares of a state's size by which the start's centre, and its farthest part, may miss a constraint."""


def check_start(initial: Region | GaussianStart, constraints: Sequence[Inside], *, apart: bool = False) -> None:
    """Refuse a start that violates a constraint that is due at time 0, with a ValueError that names it.

    A random start violates some with a probability, which counts: where its mean lies says nothing of that.
    ``apart``: with an InfeasibleError also one that may touch an obstacle then.
    """
    if apart:
        _refuse_touching(initial, constraints)
    center = initial.middle
    for constraint in constraints:
        if constraint.during is not None and constraint.during[0] > 0:
            continue
        constraint = constraint.at_first()
        with np.errstate(all="ignore"):
            place = constraint.region.center_at()
        if not np.all(np.isfinite(place)):
            raise ValueError(
                f"`safe` must have centres that are defined when their sets count, but that of '{constraint.label}' is "
                f"{place.tolist()} at time 0; mend the centre, or give the set a later `during`."
            )
        fault = "" if initial.spread else _fault(initial, center, constraint)
        if fault:
            raise ValueError(
                f"`initial` must satisfy every constraint that is due at time 0, but {fault} violates "
                f"'{constraint.label}'; move the start or change the constraint."
            )


def _refuse_touching(initial: Region | GaussianStart, constraints: Sequence[Inside]) -> None:
    """InfeasibleError where a start may touch an obstacle that is due at time 0: it has failed there.

    For bounds in discrete time that look at the steps from the first one on.
    """
    for constraint in constraints:
        region, due = constraint.region, constraint.during is None or constraint.during[0] <= 0
        if not (constraint.outside and due) or initial.random:
            continue
        region.refuse_changing()
        near = _touches(initial, region, -_ROUNDING * _size(initial, region))
        if near or bool(region.contains(initial.middle)):
            raise InfeasibleError(f"a start touches the edge of '{constraint.label}', where it has failed.")


def check_target(target: Region, constraints: Sequence[Inside], dimension: int) -> None:
    """Refuse a target that surely lies outside of a constraint that always holds, with a ValueError that names it."""
    for constraint in constraints:
        region = constraint.region
        if region.moving or target.moving or constraint.during is not None or not isinstance(region.form, Faces):
            continue
        form = region.form
        rows = region.lifted(form.normals, dimension)
        bounds = form.bounds + form.normals @ region.center_at()
        slack = _SLACK * (1 + np.abs(bounds))
        apart = -target.support(-rows) > bounds + slack
        hidden = target.support(rows) < bounds - slack
        if np.all(hidden) if constraint.outside else np.any(apart):
            raise ValueError(
                f"`reach` must meet the safe set, but the target lies wholly where '{constraint.label}' is broken; "
                "move the target or change the constraint."
            )


def _fault(initial: Region | GaussianStart, center: Array, constraint: Inside) -> str:
    size = _size(initial, constraint.region)
    if _misses(center, constraint, size):
        text = "(" + ", ".join(f"{value:g}" for value in center) + ")"
        return f"the mean {text}" if initial.random else f"its centre {text}"
    if initial.random:
        return ""
    sticks_out = _touches if constraint.outside else _leaves
    return "a part of it" if sticks_out(initial, constraint.region, _SLACK * size) else ""


def _size(initial: Any, region: Region) -> Array:
    """How large each state is in the start and in the set's centre, shape (n,): what rounding is measured by."""
    eye = np.eye(initial.dimension)
    ends = [initial.mean] if initial.random else [initial.support(eye), initial.support(-eye)]
    size: Array = np.max(np.abs(ends), axis=0)
    size[region.places(initial.dimension)] += np.abs(region.center_at())
    return size


def _misses(center: Array, constraint: Inside, size: Array) -> bool:
    """Whether a point violates the constraint by more than rounding, which must decide nothing on an edge."""
    if np.any(constraint.satisfied(center)):
        return False
    with np.errstate(divide="ignore", invalid="ignore"):  # nothing is left of a face along states that are 0
        return bool(clearance(constraint, center, np.diag(size**2)) < -_ROUNDING)


def _leaves(initial: Any, region: Region, slack: Array) -> bool:
    """Whether the start surely has a point outside the region."""
    places = region.places(initial.dimension)
    match region.form:
        case Quadratic() as form:
            farthest = initial.reaches(region.center_at(), places)[1]
            return form.even and bool(farthest > form.radius + np.max(slack[places]))
        case Faces() as form:
            rows = region.lifted(form.normals, initial.dimension)
            reach = initial.support(rows) - form.normals @ region.center_at()
            return bool(np.any(reach > form.bounds + np.abs(rows) @ slack))


def _touches(initial: Any, region: Region, slack: Array) -> bool:
    """Whether the start surely has a point inside the region."""
    places = region.places(initial.dimension)
    match region.form:
        case Quadratic() as form:
            nearest = initial.reaches(region.center_at(), places)[0]
            return form.even and bool(nearest < form.radius - np.max(slack[places]))
        case Faces() as form if len(form.bounds) == 1 and region.coordinates is None:
            nearest = -initial.support(-form.normals)[0] - form.normals[0] @ region.center_at()
            return bool(nearest < form.bounds[0] - np.abs(form.normals[0]) @ slack)
        case Faces() as form if form.axial and initial.form.axial:
            low, high = (ends[places] for ends in (initial.hull().lo, initial.hull().hi))
            around = region.hull()
            return bool(np.all((low < around.hi - slack[places]) & (high > around.lo + slack[places])))
    return False
