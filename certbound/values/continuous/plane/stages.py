"""The safe box of two states piece by piece of time, as the windows of constraints come and go.

Between the ends of windows the box is that of one set of constraints: a `Stage`. At its end all constraints whose
closed windows touch that instant hold: a gate, in which a path has to be. All grids take their nodes from one master
list an axis, on which the ends of all boxes and gates lie, so that cells of neighbouring stages are the same.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.problem import Problem
from certbound.values.continuous.plane.plane_grids import Pair, Plane, mean_deviation
from certbound.values.continuous.plane.plane_reach import reach_of
from certbound.values.grids import graded_axis
from certbound.values.room import faces_of
from certbound.values.sets import as_stays

_BEYOND = 0.6  # of the paths' extent, where nothing bounds a state
_LAYER = 0.03  # of the box: how near to a face cells crowd
_CROWD = 0.3  # how many lie there, in units of the evenly spread ones

Limit = tuple[int, int, float, Pair]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Stage:
    """A piece of time with its box, the gate at its end, and whether the box is only cut at some face."""

    start: float
    end: float
    low: Pair
    high: Pair
    gate_low: Pair
    gate_high: Pair
    cut: bool


def windowed(problem: Problem) -> bool:
    """Whether a constraint holds over a part of the horizon only."""
    whole = (0.0, float(problem.horizon))
    return any(c.during is not None and c.during != whole for c in problem.constraints)


def stages_of(problem: Problem, plane: Plane, *, inner: bool) -> list[Stage]:
    """The stages in order, faces rounded inward or outward.

    Raises
    ------
    InfeasibleError
        Obstacles, moving, curved or oblique sets, constraints at time 0 alone, or a box or a gate without interior.
    """
    limits, whole = list[Limit](), (0.0, float(problem.horizon))
    for constraint in as_stays(problem.constraints):
        if constraint.outside or constraint.region.form.round or constraint.region.moving:
            raise InfeasibleError(f"value functions over windows serve fixed boxes only, not '{constraint.label}'.")
        window = (whole[0], whole[1]) if constraint.during is None else constraint.during
        faces = faces_of(constraint)
        limits += [(axis, side, near if inner else far, window) for axis, side, near, far in faces]
    last = max(window[1] for *_, window in limits)
    if any(window[1] == 0 for *_, window in limits):
        raise InfeasibleError("value functions do not serve constraints at time 0 alone.")
    reached = reach_of(problem, plane.drift, plane.square, _BEYOND)
    instants = sorted({0.0, last, *(t for *_, window in limits for t in window)})
    return [_stage(limits, first, end, reached) for first, end in itertools.pairwise(instants)]


def _stage(limits: list[Limit], start: float, end: float, reached: list[Array]) -> Stage:
    box = _box([limit for limit in limits if limit[3][0] <= start and end <= limit[3][1]])
    gate = _box([limit for limit in limits if limit[3][0] <= end <= limit[3][1]])
    cut = not np.isfinite(box).all()
    box = np.where(np.isfinite(box), box, reached)
    if not (np.all(box[0] < box[1]) and np.all(gate[0] < gate[1])):
        raise InfeasibleError(f"the safe set has no interior at some time in [{start:g}, {end:g}].")
    ends = [(float(a), float(b)) for a, b in (*box, *gate)]
    return Stage(start=start, end=end, low=ends[0], high=ends[1], gate_low=ends[2], gate_high=ends[3], cut=cut)


def _box(limits: list[Limit]) -> Array:
    box = np.array([[-np.inf] * 2, [np.inf] * 2])
    for axis, side, place, _ in limits:
        box[side, axis] = max(box[side, axis], place) if side == 0 else min(box[side, axis], place)
    return box


def master_nodes(stages: Sequence[Stage], plane: Plane, cells: int) -> tuple[Array, Array]:
    """Nodes of both axes over all boxes, about ``cells`` of them, with the ends of boxes and gates among them."""
    low = tuple(min(stage.low[axis] for stage in stages) for axis in (0, 1))
    high = tuple(max(stage.high[axis] for stage in stages) for axis in (0, 1))
    hull = Plane(
        low=(low[0], low[1]), high=(high[0], high[1]), horizon=plane.horizon, drift=plane.drift, square=plane.square,
        starts=plane.starts, autonomous=plane.autonomous,
    )  # fmt: skip
    return _axis(stages, hull, 0, cells), _axis(stages, hull, 1, cells)


def _axis(stages: Sequence[Stage], hull: Plane, axis: int, cells: int) -> Array:
    low, high = hull.low[axis], hull.high[axis]
    ends = {
        end for stage in stages
        for pair in (stage.low, stage.high, stage.gate_low, stage.gate_high) if low < (end := pair[axis]) < high
    }  # fmt: skip
    fine = np.linspace(low, high, 2001)
    density = 1 / mean_deviation(hull, axis, fine)
    density = density / np.trapezoid(density, fine)
    for end in (low, high, *ends):
        weight = 1 / (np.abs(fine - end) + _LAYER * (high - low))
        density += _CROWD * weight / np.trapezoid(weight, fine)
    widths = np.trapezoid(density, fine) / (cells * density)
    starts = [end for end in hull.starts[axis] if _apart(end, [low, high, *ends], widths.min())]
    return graded_axis(low, high, fine, widths, [*ends, *starts])


def _apart(place: float, others: Sequence[float], least: float) -> bool:
    return math.isfinite(place) and min(abs(place - other) for other in others) > 0.3 * least


def nodes_within(master: tuple[Array, Array], stage: Stage) -> tuple[Array, Array]:
    """The nodes that lie in a stage's box."""
    found = [nodes[(nodes >= low) & (nodes <= high)] for nodes, low, high in zip(master, stage.low, stage.high)]
    return found[0], found[1]
