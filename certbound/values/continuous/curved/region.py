"""What a problem in the plane asks for: a box whose faces lie along the coordinates, and walls within it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.problem import Problem
from certbound.problem.sets import Inside, Quadratic
from certbound.values.continuous.curved.boundaries import Walls
from certbound.values.continuous.plane import Floats, reach_of
from certbound.values.room import faces_of, refuse_windows
from certbound.values.sets import as_stays

_MARGIN = 0.1  # of the walls' extent: the box reaches beyond them, so that V may be continued there
_BEYOND = (0.6, 0.25)  # of the paths' extent, where nothing bounds a state, and where the box is to be small

@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Region:
    """A path that stays in the box and in the region of the walls is safe."""

    low: tuple[float, float]
    high: tuple[float, float]
    walls: Walls


def walled(problem: Problem) -> bool:
    """Whether the safe set of a problem in the plane is more than a box: obstacles, other limits, or a missing one."""
    kept = as_stays(problem.constraints)
    if not boxed(problem):
        return True
    sides = np.vstack([np.eye(2), -np.eye(2)])
    return bool(np.isinf(np.min([constraint.region.support(sides) for constraint in kept], axis=0)).any())


def boxed(problem: Problem) -> bool:
    """Whether all limits lie along the coordinates."""
    return all(not constraint.outside and _square(constraint) for constraint in as_stays(problem.constraints))


def _square(constraint: Inside) -> bool:
    form = constraint.region.form
    return not isinstance(form, Quadratic) and all(np.count_nonzero(row) == 1 for row in form.normals)


def limits_around(problem: Problem) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """(low, high) of the limits along the coordinates, rounded inward, and outward; infinite where there is none."""
    low, high = np.full((2, 2), -np.inf), np.full((2, 2), np.inf)  # inner and outer, for each state
    for constraint in as_stays(problem.constraints):
        if not constraint.outside and _square(constraint):
            for axis, side, *ends in faces_of(constraint):
                if side == 0:
                    low[:, axis] = np.maximum(low[:, axis], ends)
                else:
                    high[:, axis] = np.minimum(high[:, axis], ends)
    return (low[0], high[0]), (low[1], high[1])


def region_of(problem: Problem, drift: Floats, square: Floats, *, near: bool) -> Region:
    """The box and the walls; with ``near`` a box that ends not far beyond simulated paths.

    Where the walls bound a state the box reaches beyond them; where nothing does, it ends far beyond simulated paths.
    Any box will do: leaving it counts as failing.

    Raises
    ------
    InfeasibleError
        Windows and moving sets; a box without width, where no path that was simulated moves along a state.
    """
    low, high = limits_around(problem)[0]
    around = [np.full(2, -np.inf), np.full(2, np.inf)]
    walls, ends = [], []
    for constraint in as_stays(problem.constraints):
        refuse_windows(constraint, problem)
        if not constraint.outside and _square(constraint):
            continue
        walls.append(constraint)
        own = [-np.asarray(constraint.region.support(-np.eye(2))), np.asarray(constraint.region.support(np.eye(2)))]
        if constraint.outside:
            ends += own
        else:
            around = [np.maximum(around[0], own[0]), np.minimum(around[1], own[1])]
    reach = reach_of(problem, drift, square, _BEYOND[near], (low, high))
    margin = _MARGIN * np.minimum(reach[1] - reach[0], around[1] - around[0])
    outer = [np.maximum(low, around[0] - margin), np.minimum(high, around[1] + margin)]
    far = [np.isinf(outer[0]) | near, np.isinf(outer[1]) | near]
    found = [_clear(reach[side], ends, margin, sign) for side, sign in ((0, -1.0), (1, 1.0))]
    low = np.where(far[0], np.maximum(outer[0], found[0]), outer[0])
    high = np.where(far[1], np.minimum(outer[1], found[1]), outer[1])
    if not np.all(low < high):
        raise InfeasibleError("no box of any width was found around simulated paths; value functions prove nothing.")
    return Region(low=(float(low[0]), float(low[1])), high=(float(high[0]), float(high[1])), walls=Walls.of(walls))


def _clear(place: Array, ends: list[Array], margin: Array, sign: float) -> Array:
    """The end of the box, moved outward where it would leave a narrow gap beside an obstacle."""
    for end in sorted(ends, key=lambda one: sign * float(one.sum())):
        place = np.where(np.abs(place - end) < margin, end + sign * margin, place)
    return place
