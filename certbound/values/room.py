"""The box that a problem keeps its state in, rounded inward (for upper bounds) and outward (for lower bounds)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.problem import Problem
from certbound.problem.sets import Inside, Quadratic
from certbound.rigor.intervals import Interval
from certbound.values.sets import as_stays, contains

Ends = tuple[float, float]

_ALONG = 33
_WITHIN = 1 - 1e-9  # so that points on the rim pass the test in outward-rounded arithmetic


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Room:
    """The safe box: a path that stays in the inner one is safe, and a path that leaves the outer one is not."""

    inner_low: tuple[float, ...]
    inner_high: tuple[float, ...]
    outer_low: tuple[float, ...]
    outer_high: tuple[float, ...]


def safe_room(problem: Problem) -> Room:
    """The safe set as a box: the part around the start that obstacles leave, in one state.

    Raises
    ------
    InfeasibleError
        Windows, moving sets, curved or oblique sets in several states, or an unbounded safe set.
    """
    room = limits_of(problem)
    for name, low, high in zip(problem.system.states, room.inner_low, room.inner_high):
        if not np.isfinite([low, high]).all():
            where = "below" if low == -np.inf else "above"
            raise InfeasibleError(
                f"value functions need a bounded safe set, and {name} is unbounded {where}; a bound that paths hardly "
                f"reach will do: add a `domain`, or a constraint on {name}."
            )
        if not low < high:
            raise InfeasibleError("the safe set has no interior.")
    return room


def limits_of(problem: Problem) -> Room:
    """The box of all limits, infinite where there is none.

    Raises
    ------
    InfeasibleError
        Windows, moving sets, curved or oblique sets in several states.
    """
    constraints = as_stays(problem.constraints)
    for constraint in constraints:
        refuse_windows(constraint, problem)
    return limits_among(problem, constraints)


def limits_among(problem: Problem, constraints: Sequence[Inside]) -> Room:
    """The box of some of the limits, to stay within, whenever they are due; infinite where there is none.

    Raises
    ------
    InfeasibleError
        Moving sets, curved or oblique sets in several states.
    """
    n = problem.system.dimension
    lows, highs = [[-np.inf] * n, [-np.inf] * n], [[np.inf] * n, [np.inf] * n]
    for constraint in constraints:
        refuse_moving(constraint)
        for axis, side, inner, outer in _faces(constraint, problem):
            for place, value in enumerate((inner, outer)):
                if side == 0:
                    lows[place][axis] = max(lows[place][axis], value)
                else:
                    highs[place][axis] = min(highs[place][axis], value)
    ends = [tuple(float(value) for value in row) for row in (*lows, *highs)]
    return Room(inner_low=ends[0], outer_low=ends[1], inner_high=ends[2], outer_high=ends[3])


def refuse_windows(constraint: Inside, problem: Problem) -> None:
    """Refuse, in words, a constraint that moves or does not hold at all times."""
    refuse_moving(constraint)
    if constraint.during is not None and constraint.during != (0.0, float(problem.horizon)):
        raise InfeasibleError(f"value functions do not serve constraints over a window yet ('{constraint.label}').")


def refuse_moving(constraint: Inside) -> None:
    """Refuse, in words, a constraint that moves."""
    if constraint.region.moving:
        raise InfeasibleError(f"value functions do not serve moving sets yet ('{constraint.label}').")


def _faces(constraint: Inside, problem: Problem) -> list[tuple[int, int, float, float]]:
    """(state, side, inner place, outer place) of each face of a constraint."""
    n, region = problem.system.dimension, constraint.region
    if n > 1 and (constraint.outside or region.form.round):
        count = "two" if n == 2 else "three"
        raise InfeasibleError(f"value functions in {count} states serve boxes only, not '{constraint.label}'.")
    return _beside(constraint, problem) if constraint.outside else faces_of(constraint)


def faces_of(constraint: Inside) -> list[tuple[int, int, float, float]]:
    """(state, side, inner place, outer place) of each face of a region whose faces lie along the coordinates."""
    region = constraint.region
    center = region.center_at()
    if isinstance(region.form, Quadratic):  # in one state
        reach, middle = float(np.sqrt(region.form.matrix[0, 0])), float(center[0])
        size = abs(middle) + reach
        return [(0, 0, *_rounded(middle - reach, 0, size)), (0, 1, *_rounded(middle + reach, 1, size))]
    faces: list[tuple[int, int, float, float]] = []
    for normal, bound in zip(region.form.normals, region.form.bounds):
        used = np.flatnonzero(normal)
        if len(used) != 1:
            raise InfeasibleError(f"value functions serve faces along the coordinates only, not '{constraint.label}'.")
        axis, side = region.places(len(normal))[used[0]], int(normal[used[0]] > 0)
        offset, middle = float(bound / normal[used[0]]), float(center[used[0]])
        exact = region.form.axial and not middle
        size = 0.0 if exact else abs(offset) + abs(middle)
        near, far = _rounded(offset + middle, side, size)
        faces.append((axis, side, constraint.inward(side, near), far))
    return faces


def _beside(constraint: Inside, problem: Problem) -> list[tuple[int, int, float, float]]:
    """The face that an obstacle shows to the starts, in one state."""
    faces = {side: (inner, outer) for _, side, inner, outer in faces_of(constraint)}
    low, high = -np.inf, np.inf  # the obstacle's ends, as far as it has them
    if 0 in faces:
        low = min(faces[0])
    if 1 in faces:
        high = max(faces[1])
    if problem.initial.random:
        raise InfeasibleError(f"a random start lies on both sides of '{constraint.label}', as value functions see it.")
    around = problem.initial.hull()
    if around.hi[0] < low:
        return [(0, 1, constraint.inward(1, low), max(faces[0]))]
    if around.lo[0] > high:
        return [(0, 0, constraint.inward(0, high), min(faces[1]))]
    raise InfeasibleError(f"the starts must lie on one side of '{constraint.label}'.")


def _rounded(place: float, side: int, size: float) -> Ends:
    """A computed face, moved inward and outward by more than its rounding error."""
    slack = 4e-16 * size
    return (place + slack, place - slack) if side == 0 else (place - slack, place + slack)


def points_of(problem: Problem) -> Array | None:
    """Points that are surely starts, shape (N, n), up to the rim; None where the starts fill their box."""
    start, around = problem.initial, problem.initial.hull()
    if start.random or (start.form.axial and start.center is None):
        return None
    half = _WITHIN * (around.hi - around.lo) / 2
    steps = np.meshgrid(*[np.linspace(-1, 1, _ALONG)] * len(half), indexing="ij")
    points = start.middle + half * np.stack([step.ravel() for step in steps], axis=1)
    if isinstance(start.form, Quadratic):
        rows = points - start.middle
        length = np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", rows, np.linalg.pinv(start.form.matrix), rows), 1e-300))
        rim = start.middle + _WITHIN * rows / length[:, None]
        points = np.concatenate([points, rim[length > 0.5]])
    return np.asarray(points[contains(start, Interval.point(points), 0)[0]])


def starts_of(problem: Problem) -> list[tuple[float, float]]:
    """The bounding box of the starts, rounded outward."""
    start = problem.initial
    if start.random:
        raise InfeasibleError(f"value functions do not serve starts of the kind {type(start).__name__}.")
    around = start.hull()
    return [(float(a), float(b)) for a, b in zip(around.lo, around.hi)]
