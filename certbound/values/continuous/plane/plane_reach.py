"""Models in floats, and where simulated paths get to: where a box may end that nothing bounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from certbound.arrays import Array
from certbound.problem.model import Node, compile_numpy
from certbound.problem.problem import Problem
from certbound.values.continuous.hypotheses import Model
from certbound.values.continuous.plane.plane_grids import Pair, Plane
from certbound.values.room import Room

_PATHS, _STEPS = 400, 200
_BEYOND = 0.35  # how far beyond simulated paths a box ends, in units of their extent
_PLACES = np.append(0.0, np.geomspace(0.01, 30.0, 40))
_ALONG = 65

Floats = Callable[[float, Array, Array], Array]


def reach_of(
    problem: Problem, drift: Floats, square: Floats, share: float, limits: tuple[Array, Array] | None = None
) -> list[Array]:
    """Ends of a box that hardly a path leaves, from simulated ones, which end where they leave the ``limits``."""
    low, high = (np.full(2, -np.inf), np.full(2, np.inf)) if limits is None else limits
    rng = np.random.default_rng(0)
    hull = problem.initial.hull()
    x = rng.uniform(hull.lo, hull.hi, (_PATHS, 2)).T
    least, most = x.min(axis=1), x.max(axis=1)
    step = float(problem.horizon) / _STEPS
    for k in range(_STEPS):
        t = k * step
        a = np.moveaxis(square(t, *x) * np.ones((2, 2, _PATHS)), -1, 0)
        values, vectors = np.linalg.eigh(a)
        root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
        noise = np.einsum("nij,nj->in", root, rng.standard_normal((_PATHS, 2)))
        moved = x + step * drift(t, *x)[0] + np.sqrt(step) * noise
        inside = np.all((x >= low[:, None]) & (x <= high[:, None]), axis=0)
        x = np.where(np.isfinite(moved) & inside, moved, x)
        least, most = np.minimum(least, x.min(axis=1)), np.maximum(most, x.max(axis=1))
    beyond = share * (most - least)
    return [least - beyond, most + beyond]


def closed_plane(problem: Problem, model: Model, room: Room) -> Room:
    """The room of two states with inner ends where there is none: leaving there will count, as if it were failing.

    A state without noise ends where the drift leads back all along, if it does so near by: no path leaves there.
    """
    if np.isfinite([*room.inner_low, *room.inner_high]).all():
        return room
    drift, square = floats_of(model)
    reach = reach_of(problem, drift, square, _BEYOND, (np.array(room.inner_low), np.array(room.inner_high)))
    inner = [np.array(room.inner_low), np.array(room.inner_high)]
    infinite = [np.isinf(one) for one in inner]
    inner = [np.where(far, place, one) for far, place, one in zip(infinite, reach, inner)]
    for axis in (0, 1):
        other = np.linspace(inner[0][1 - axis], inner[1][1 - axis], _ALONG)
        a = square(0.0, *np.meshgrid(*np.array(reach)))
        for side in (side for side in (0, 1) if infinite[side][axis] and not np.any(a[axis, axis])):
            sign = 2 * side - 1
            for place in reach[side][axis] + sign * (reach[1] - reach[0])[axis] * _PLACES:
                at = [np.full(_ALONG, place), other][:: 1 - 2 * axis]
                if all(np.all(sign * drift(t, *at)[:, axis] < 0) for t in np.linspace(0, problem.horizon, 5)):
                    inner[side][axis] = place
                    break
    return replace(room, inner_low=tuple(map(float, inner[0])), inner_high=tuple(map(float, inner[1])))

def led(model: Model) -> bool:
    """Whether noise surely moves one state of two only, and the other one is led by the drift."""
    tape = model.square.tape
    none = [tape.nodes[tape.outputs[place]] == Node("const", (), 0.0) for place in (0, 3)]
    return none.count(True) == 1


def floats_of(model: Model) -> tuple[Floats, Floats]:
    """The drift (branches, 2, ...) and a (2, 2, ...) of a model in floats, at (t, x, y)."""
    drift, square = compile_numpy(model.drift.tape), compile_numpy(model.square.tape)
    corners = [[float(value.mid) for value in branch] for branch in model.branches]

    def drifts(t: float, x: Array, y: Array) -> Array:
        return np.array([np.moveaxis(drift(t, x, y, *corner), -1, 0) for corner in corners])

    return drifts, lambda t, x, y: np.moveaxis(square(t, x, y), (-2, -1), (0, 1))


def plane_of(
    problem: Problem, model: Model, low: tuple[float, ...], high: tuple[float, ...], starts: list[Pair]
) -> Plane:
    """The model in floats on a box."""
    drift, square = floats_of(model)
    return Plane(
        low=(low[0], low[1]), high=(high[0], high[1]), horizon=float(problem.horizon), drift=drift, square=square,
        starts=starts, autonomous=model.autonomous,
    )  # fmt: skip
