"""What a problem's constraints ask of a metric: directions along which erosion hurts, and the room over time.

All in floating point: the numbers only weigh the proposals. The room at a time is the smallest distance of
sampled noise-free paths to the constraint then; a safety proof measures it again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.constants.programs.least_erosion import Rooms
from certbound.problem.model import compile_numpy
from certbound.problem.problem import Problem
from certbound.problem.sets import Faces, Inside

_STEPS = 400
_PATHS = 33
_SMALLEST_SHARE = 0.02


@dataclass(frozen=True, eq=False, kw_only=True)
class Target:
    """A direction of erosion of the constraint ``problem.constraints[constraint]``, and the room along it.

    ``direction``, shape (n, r), is a (r = 1) or the coordinates of a round constraint: the erosion is r_t
    sqrt(lambda_max(a^T P^-1 a)). ``rooms``, shape (K,), are at the times behind the start; inf outside the window.
    """

    direction: Array
    rooms: Array
    constraint: int


def constraint_targets(problem: Problem) -> tuple[Array, list[Target]]:
    """Times (K,) behind the start, and one target per half-space, ball, ellipsoid or obstacle.

    Parallel half-spaces of one constraint (the two sides of a box) share a target. A problem of which no constraint
    bounds anything is a ValueError.
    """
    times, paths = nominal_paths(problem)
    found: list[Target] = []
    for index, constraint in enumerate(problem.constraints):
        during = (0.0, float(times[-1])) if constraint.during is None else constraint.during
        window = (times >= during[0] - 1e-9) & (times <= during[1] + 1e-9)
        if not window[1:].any():
            window = np.arange(len(times)) == max(int(np.searchsorted(times, during[0])), 1)
        for direction, room in _faces(constraint, times, paths):
            inside = np.where(window, room, np.inf)[1:]
            found.append(Target(direction=direction, rooms=inside, constraint=index))
    found = _joined(found)
    if not found:
        raise ValueError('`objective="erosion"` needs a constraint with a bound; give `directions=`.')
    return times[1:], found


def rooms_of(times: Array, targets: list[Target]) -> Rooms:
    """The targets as one record; a room that is gone already is replaced by a small one."""
    rooms = np.stack([target.rooms for target in targets])
    largest = float(np.max(rooms, where=np.isfinite(rooms), initial=0.0))
    floor = _SMALLEST_SHARE * largest if largest > 0 else 1.0
    directions = tuple(target.direction for target in targets)
    return Rooms(directions=directions, times=times, rooms=np.maximum(rooms, floor))


def cut_rooms(rooms: Rooms, horizon: float) -> Rooms:
    """The rooms up to another horizon; beyond the last time the least room is asked."""
    if horizon == rooms.times[-1]:
        return rooms
    least = np.min(rooms.rooms, axis=1, keepdims=True)
    return Rooms(directions=rooms.directions, times=np.array([float(horizon)]), rooms=least)


def stated_rooms(
    directions: Sequence[ArrayLike] | None, clearances: ArrayLike | None, dimension: int, horizon: float
) -> Rooms:
    """Directions and constant rooms that a caller states, checked; rooms of 1 when omitted."""
    if not directions:
        raise ValueError('`objective="erosion"` needs `directions=`, at least one.')
    normals = []
    for direction in directions:
        a = np.asarray(direction, dtype=float)
        if a.ndim not in (1, 2) or len(a) != dimension or not np.all(np.isfinite(a)) or not a.any():
            raise ValueError(f"`directions` must be finite, not zero, of {dimension} entries, got {direction!r}.")
        normals.append(a.reshape(dimension, -1))
    room = np.ones(len(normals)) if clearances is None else np.asarray(clearances, dtype=float)
    if room.shape != (len(normals),) or not np.all(room > 0):
        raise ValueError(f"`clearances` must hold {len(normals)} positive numbers, got {clearances!r}.")
    return Rooms(directions=tuple(normals), times=np.array([horizon]), rooms=room[:, None])


def nominal_paths(problem: Problem, *, paths: int = _PATHS) -> tuple[Array, Array]:
    """Times (K + 1,) and sampled noise-free paths (paths, K + 1, n), the first from the middle of everything."""
    system, tape = problem.system, problem.closed_loop
    rng = np.random.default_rng(0)
    x = np.concatenate([problem.initial.middle[None], problem.initial.sample(rng, paths - 1)])
    box = system.disturbance
    d = np.zeros((paths, 0)) if box is None else box.sample(rng, paths)
    if box is not None:
        d[0] = (box.low + box.high) / 2
    function = compile_numpy(tape)
    rows = problem.input_sequence
    horizon = float(problem.horizon)
    discrete = system.time == "discrete"
    steps = int(horizon) if discrete else _STEPS
    times = np.linspace(0.0, horizon, steps + 1)

    def rate(t: float, state: Array) -> Array:
        inputs: list[Any] = []
        if rows is not None:
            row = int(t) if discrete else int(t / horizon * len(rows))
            inputs = list(rows[min(row, len(rows) - 1)])
        value = function(t, *state.T, *inputs, *d.T)
        return np.broadcast_to(np.asarray(value, dtype=float), state.shape)

    result = np.empty((paths, steps + 1, system.dimension))
    result[:, 0] = x
    h = horizon / steps
    with np.errstate(all="ignore"):
        for k, t in enumerate(times[:-1]):
            if discrete:
                x = rate(float(t), x)
            else:
                k1 = rate(t, x)
                k2 = rate(t + h / 2, x + h / 2 * k1)
                k3 = rate(t + h / 2, x + h / 2 * k2)
                x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(t + h * (1 - 1e-12), x + h * k3))
            result[:, k + 1] = x
    good = np.asarray(np.isfinite(result).all(axis=(1, 2)))
    good[0] = True
    return times, np.nan_to_num(result[good])


def _faces(constraint: Inside, times: Array, paths: Array) -> list[tuple[Array, Array]]:
    """(direction, room at each time) of each face."""
    region, n = constraint.region, paths.shape[-1]
    places = region.places(n)
    select = np.eye(n)[:, places]
    moving = np.array([region.center_at(float(t)) for t in times]) if region.moving else region.center_at()
    local = paths[..., places] - moving
    if isinstance(region.form, Faces):
        A, b = region.form.normals, region.form.bounds
        room = np.asarray(b - local @ A.T)
        if not constraint.outside:
            return [(select @ a[:, None], room[..., j].min(axis=0)) for j, a in enumerate(A)]
        # the face that separates best where the paths come nearest
        distance = -room / np.linalg.norm(A, axis=1)
        nearest = distance.max(axis=-1)
        face = int(np.argmax(distance.reshape(-1, len(b))[int(np.argmin(nearest))]))
        return [(select @ A[face][:, None], nearest.min(axis=0) * float(np.linalg.norm(A[face])))]
    values, vectors = np.linalg.eigh(region.form.shape)
    size, scale = region.form.radius, np.asarray((vectors / np.sqrt(values)) @ vectors.T)
    distance = np.linalg.norm(local @ scale, axis=-1)
    if not constraint.outside:
        return [(select @ scale, np.asarray((size - distance).min(axis=0)))]
    closest = local.reshape(-1, local.shape[-1])[int(np.argmin(distance))] @ scale
    normal = closest / max(float(np.linalg.norm(closest)), 1e-300)
    return [(select @ scale @ normal[:, None], np.asarray((distance - size).min(axis=0)))]


def _joined(targets: list[Target]) -> list[Target]:
    """Parallel directions of one constraint (the two sides of a box) as one, with the smaller room."""
    kept: list[Target] = []
    for target in targets:
        size = float(np.linalg.norm(target.direction))
        if size == 0:
            continue
        for place, other in enumerate(kept):
            if other.constraint != target.constraint or other.direction.shape != target.direction.shape:
                continue
            ratio = size / float(np.linalg.norm(other.direction))
            same = other.direction * ratio
            if np.allclose(same, target.direction) or np.allclose(same, -target.direction):
                room = np.minimum(other.rooms, target.rooms / ratio)
                kept[place] = Target(direction=other.direction, rooms=room, constraint=other.constraint)
                break
        else:
            kept.append(target)
    return kept
