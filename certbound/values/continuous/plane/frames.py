"""Limits of two states that move over the whole horizon: coordinates in which they stand still.

With x_i = o_i(t) + w_i(t) y_i the process Y has the drift (f_i - o_i' - w_i' y_i) / w_i and the squared diffusion
a_ij / (w_i w_j), each state as in one (`line.phases`, `line.moved_model`).
"""

from __future__ import annotations

import contextlib
import itertools
import time
from collections.abc import Sequence

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.model import Graph, Tape, jacobian
from certbound.problem.problem import Problem
from certbound.problem.sets import Inside
from certbound.rigor.intervals import Interval
from certbound.values.continuous.coefficients import Reader
from certbound.values.continuous.held_faces import check_noise
from certbound.values.continuous.hypotheses import Model
from certbound.values.continuous.line import Limit, Phase, check_room, phase_of, value_at
from certbound.values.continuous.plane.plane_below import bound_plane_below, plan_below
from certbound.values.continuous.plane.plane_grids import Pair, Plane
from certbound.values.continuous.plane.plane_reach import plane_of
from certbound.values.continuous.plane.two_sides import BELOW, RATE, bound_plane_above, rough_level
from certbound.values.room import faces_of, points_of, starts_of
from certbound.values.sets import as_stays
from certbound.watch import OutOfTime

_ALONG = 5

Frames = Sequence[Phase]


def moving(problem: Problem) -> bool:
    """Whether a limit moves."""
    return any(constraint.region.moving for constraint in problem.constraints)


def frames_of(problem: Problem, *, inner: bool) -> list[Phase]:
    """One frame a state, its limits rounded inward or outward.

    Raises
    ------
    InfeasibleError
        Windows, obstacles, curved or oblique sets, a state without a limit on both sides, or a box without interior.
    """
    limits: list[list[Limit]] = [[], []]
    for constraint in as_stays(problem.constraints):
        form, moves = constraint.region.form, constraint.region.moving
        if constraint.outside or form.round or (moves and not form.axial):
            raise InfeasibleError(f"value functions serve moving boxes only, not '{constraint.label}'.")
        if constraint.during is not None and constraint.during != (0.0, float(problem.horizon)):
            raise InfeasibleError("value functions in two states serve moving limits or windows, not both.")
        for axis, side, near, far, center in _faces(constraint):
            limits[axis].append(Limit(side=side, center=center, offset=near if inner else far))
    frames = []
    for name, own in zip(problem.system.states, limits):
        if {limit.side for limit in own} != {0, 1}:
            raise InfeasibleError(f"value functions with moving limits need limits on both sides of {name}.")
        frames.append(phase_of(own, 0.0, float(problem.horizon), (-np.inf, np.inf)))
    check_room(frames)
    return frames


def _faces(constraint: Inside) -> list[tuple[int, int, float, float, Tape | None]]:
    """(state, side, inner offset, outer offset, centre) of each face of a constraint."""
    region = constraint.region
    if not region.moving:
        return [(*face, None) for face in faces_of(constraint)]
    center, around = region.center, region.extent()
    found: list[tuple[int, int, float, float, Tape | None]] = []
    for k, axis in enumerate(region.places(2)):
        own = Tape(inputs=center.inputs, nodes=center.nodes, outputs=(center.outputs[k],), shape=(1,))
        ends = ((0, float(around.lo[k])), (1, float(around.hi[k])))
        found += [(axis, side, constraint.inward(side, end), end, own) for side, end in ends if np.isfinite(end)]
    return found


def bound_moving(
    problem: Problem, model: Model, deadline: float, wanted: float
) -> tuple[float, float | None, str]:
    """Natural logarithms of an upper bound and, where that is above ``wanted``, a lower one (or None), and words.

    Raises
    ------
    InfeasibleError
        What `frames_of` refuses, or noise that vanishes.
    """
    inner, outer = (frames_of(problem, inner=side) for side in (True, False))
    patches = RATE * max(1.0, round(deadline - time.perf_counter(), 1))
    plane, moved = _plane_in(problem, model, inner)
    level = rough_level(plane)
    upper, done, _ = bound_plane_above(plane, moved, level, patches)
    lower, points = None, points_in(problem, outer)
    if upper > wanted and points is not None:
        plane, moved = _plane_in(problem, model, outer)
        plan = plan_below(plane, min(level, upper), BELOW * patches)
        with contextlib.suppress(OutOfTime):
            found = bound_plane_below(plane, moved, plan, plane.starts, points)
            lower = None if found is None else found[1].log
        done.append(f"{plan.cells}^2 below")
    return upper, lower, f"value function in two states that move with the limits, cells: {', '.join(done)}"


def _plane_in(problem: Problem, model: Model, frames: Frames) -> tuple[Plane, Model]:
    moved = model_in(frames, model)
    low, high = tuple(frame.low for frame in frames), tuple(frame.high for frame in frames)
    check_noise(moved, (0.0, float(problem.horizon)), list(zip(low, high)))
    return plane_of(problem, moved, low, high, starts_in(problem, frames)), moved


def starts_in(problem: Problem, frames: Frames) -> list[Pair]:
    """A box around the starts in the frames' coordinates."""
    ends = [_local(frame, Interval(*pair)) for frame, pair in zip(frames, starts_of(problem))]
    return [(float(end.lo), float(end.hi)) for end in ends]


def points_in(problem: Problem, frames: Frames) -> Array | None:
    """Points that are surely starts in the frames' coordinates; None where rounding leaves none."""
    if points_of(problem) is not None:
        return None
    rows = []
    for frame, (low, high) in zip(frames, starts_of(problem)):
        first, last = _local(frame, Interval.point(low)).hi, _local(frame, Interval.point(high)).lo
        if first > last:
            return None
        rows.append(np.linspace(first, last, _ALONG).clip(first, last))
    return np.array(list(itertools.product(*rows)))


def _local(frame: Phase, x: Interval) -> Interval:
    """y of x at time 0, exact where the frame does nothing then."""
    if frame.origin is not None:
        origin = value_at(frame.origin, 0.0)
        x = x if origin.lo == 0 == origin.hi else x - origin
    if frame.width is not None:
        width = value_at(frame.width, 0.0)
        x = x if width.lo == 1 == width.hi else x / width
    return x


def model_in(frames: Frames, model: Model) -> Model:
    """The model in the frames' coordinates, over ("t", "y0", "y1", *disturbances)."""
    return Model(
        drift=Reader(_moved(frames, model.drift.tape, drift=True), 3),
        square=Reader(_moved(frames, model.square.tape, drift=False), 3),
        branches=model.branches,
    )


def _moved(frames: Frames, tape: Tape, *, drift: bool) -> Tape:
    graph = Graph((tape.inputs[0], "y0", "y1", *tape.inputs[3:]))
    inputs = [graph.input(slot) for slot in range(len(tape.inputs))]
    time, y = inputs[0], inputs[1:3]

    def of_time(source: Tape | None, order: int, none: float) -> int:
        if source is None:
            return graph.const(none)
        function = jacobian(source, [0]) if order else source
        return int(function.evaluate(graph.arithmetic(), [time])[0])

    wide = [of_time(frame.width, 0, 1.0) for frame in frames]
    places = [
        graph.apply("add", of_time(frame.origin, 0, 0.0), graph.apply("mul", width, own))
        for frame, width, own in zip(frames, wide, y)
    ]
    values = tape.evaluate(graph.arithmetic(), [time, *places, *inputs[3:]])
    if not drift:
        scaled = [
            graph.apply("div", values[2 * i + j], graph.apply("mul", wide[i], wide[j]))
            for i, j in itertools.product((0, 1), repeat=2)
        ]
        return graph.tape(scaled, (2, 2))
    rows = []
    for value, frame, width, own in zip(values, frames, wide, y):
        growth = graph.apply("mul", of_time(frame.width, 1, 0.0), own)
        speed = graph.apply("add", of_time(frame.origin, 1, 0.0), growth)
        rows.append(graph.apply("div", graph.apply("sub", value, speed), width))
    return graph.tape(rows, (2,))
