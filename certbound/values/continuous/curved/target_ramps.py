"""Floating-point proposals of the probability Q of arriving in a target; nothing here is certified.

The solver is that of curved walls, the target being an obstacle that paths arrive at: Q = 1 on its edge, 0 at the
horizon and on the faces of the box. What the least squares make of Q inside of the target nobody asks for.

*From below* (failing from above) Q is 0 on all faces and at the horizon, and rises to 1 on the edge within a ramp;
where the edge comes near a face it stays below. *From above* the ramp is over before the horizon, and faces rise to
1 where they come near the target; corners of the target bulge, and the equation is asked for up to the target itself.

*Corners of the box* in which the noises go together so that Q bends more than any spline: there Q is a little below 0
from below, where nothing is asked of it, and a little above 0 from above, bent downward.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from certbound.arrays import Array, Mask
from certbound.problem.sets import Faces, Region
from certbound.values.continuous.curved.boundaries import Deep
from certbound.values.continuous.curved.continuation import crowded_nodes
from certbound.values.continuous.curved.walled_ramps import WalledRamps
from certbound.values.continuous.plane import Plan, Plane, Source, bent, sides_of
from certbound.values.continuous.straight import SMALL, left_at, stage_rates
from certbound.values.continuous.surface import Surface

_CROWD = 1.0
_ROUND = {False: 1.4, True: 0.9}  # corners, in cells: inside the target, and around it
_BULGE = 2.5  # of the latter: how far along the edges corners of the target bulge
_CELLS, _SHARE = 3, 0.4  # how far corners of the box reach, and how far Q is off 0 there, in units of Q where they end
_CLOSELY = 0.02  # correlated
_SHIFT = 5.0  # ramps before the horizon, from above: sources feed each other in younger layers
_UNIT = 0.7  # a cell beside the target, in units of the evenly spread ones
_HAIR = 1e-9  # of the box
_NEAR = 3.0  # cells over which Q goes from 0 to 1 where the target's edge meets a face


class TargetRamps(WalledRamps):
    """Q near 1 on the walls. ``ends`` are places along each axis through which lines of the grid go."""

    shift = _SHIFT

    def __init__(self, plane: Plane, walls: Deep, cells: int, ends: list[list[float]], *, arrives: bool) -> None:
        self.ends, self.arrives = ends, arrives
        super().__init__(plane, walls, cells)
        self.count, self.moves = np.zeros(len(self.count)), self.moves.copy()
        self.moves[self.edge] = 0.0
        widths = [np.interp(self.curve[:, k], one[:-1], np.diff(one)) for k, one in enumerate(self.nodes)]
        away = [np.minimum(self.curve[:, k] - plane.low[k], plane.high[k] - self.curve[:, k]) for k in (0, 1)]
        near = np.minimum(away[0] / widths[0], away[1] / widths[1]) / _NEAR
        self.goal = _smooth(near) if arrives else np.ones(len(self.curve))
        edge = np.zeros(len(self.edge))
        if not arrives:
            x, y = (one.ravel()[self.edge] for one in self.places)
            wide = [np.interp(place, one[:-1], np.diff(one)) for place, one in zip((x, y), self.nodes)]
            edge = _smooth(1 - walls.depth(x, y) / (_NEAR * np.maximum(*wide)))
        own = csc_matrix(self.mass[self.edge][:, self.edge])
        self.on_faces = splu(own).solve(edge)
        self.first = np.zeros(len(self.count))
        self.corners = [one for one in itertools.product((0, 1), (0, 1)) if self._bent(one)]
        if self.corners:
            self.first = self._in_corners()

    def _bent(self, corner: tuple[int, int]) -> bool:
        """Whether the noises go together in a corner so that both lead along one of its faces."""
        a = self.plane.square(0.0, *(np.array([nodes[-side]]) for nodes, side in zip(self.nodes, corner)))
        together = (1 if corner[0] == corner[1] else -1) * a[0, 1] / np.sqrt(a[0, 0] * a[1, 1])
        return bool(np.all(together > _CLOSELY))

    def _in_corners(self) -> Array:
        """The coefficients of what Q is at the horizon, and on the faces at all times, in the corners of the box."""
        plain, found = self.failing(None), np.zeros(self.places[0].shape)
        for corner in self.corners:
            part, end = np.ones(found.shape), []
            for nodes, place, side in zip(self.nodes, self.places, corner):
                inner = nodes[-1 - _CELLS] if side else nodes[_CELLS]
                away = (place - nodes[-side]) / (inner - nodes[-side])
                part = part * np.maximum(1 - away**2, 0.0) ** 3
                end.append(-1 - _CELLS if side else _CELLS)
            most = float(np.abs(plain.values[:, end[0], 0, end[1], 0]).max()) / SMALL
            found = np.maximum(found, _SHARE * most * part)
        sign = -1.0 if self.arrives else 1.0
        return np.asarray(splu(csc_matrix(self.mass)).solve(sign * found.ravel()))

    def due(self, x: Array, y: Array) -> Mask:
        assert isinstance(self.walls, _Rounded)
        return np.asarray((self.walls.beyond(x, y) if self.walls.around else self.walls.depth(x, y)) > 0)

    def grid(self, axis: int, plan: Plan) -> Array:
        nodes = crowded_nodes(self.plane, plan, axis, self.curve, _CROWD)
        return bent(nodes, [*self.ends[axis], *self.plane.starts[axis]])

    def _weakened(self, force: Array, a: Array, places: Sequence[Array], faces: Sequence[tuple[bool, bool]]) -> Array:
        return super()._weakened(force, a, places, faces) if self.arrives else force

    def edges(self, value: Array, step: float, fed: Array, ages: Array) -> Array:
        return np.outer(1 - left_at(ages / self.lead), self.on_faces) + self.first[self.edge]

    def _step(self, value: Array, step: float, fed: Array, ages: Array) -> Array:
        fed = fed * np.ones(len(value) + self.values.shape[0])
        risen = 1 - left_at(ages / self.lead)
        asked = np.outer(stage_rates(step), np.asarray(self.values @ value)) + fed[:, len(value) :]
        right = [self.edges(value, step, fed, ages), asked, np.outer(risen, self.goal)]
        return self.solved(step, np.concatenate(right, axis=1))

    def failing(self, source: Source | None) -> Surface:
        """V = -e Q, the source being taken off Q's equation where it is to be below, and added above."""
        return self.surface(source, below=self.arrives)

    def scaled(self, whole: Surface, below: bool) -> Surface:
        """-e Q."""
        return Surface(
            axes=whole.axes, times=whole.times, values=-SMALL * whole.values, start_rates=-SMALL * whole.start_rates,
            end_rates=-SMALL * whole.end_rates,
        )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Rounded:
    """A box or another polytope with rounded corners, within it, or (``around``) around it; sizes of cells ``unit``."""

    target: Region
    unit: Array
    around: bool

    def depth(self, x: Array, y: Array) -> Array:
        """About how far points are outside, negative inside."""
        reach, rho = self._reach(x, y), _ROUND[self.around]
        if len(reach) == 1:
            return np.asarray(-reach[0] * self.unit.min())
        deep = rho * np.logaddexp.reduce([-one / rho for one in reach])
        if self.around:
            near = (np.sort(reach, axis=0)[:2] ** 2).sum(axis=0)
            deep = deep - rho * math.log(2) * np.exp(-near / (_BULGE * rho) ** 2)
        return np.asarray(deep * self.unit.min())

    def beyond(self, x: Array, y: Array) -> Array:
        """How far points are outside of the target itself, in cells."""
        return np.asarray(-np.min(self._reach(x, y), axis=0))

    def _reach(self, x: Array, y: Array) -> list[Array]:
        """How far the target's faces are, in cells."""
        form = self.target.form
        assert isinstance(form, Faces)
        z = np.stack([(x, y)[place] for place in self.target.places(2)], axis=-1) - self.target.center_at()
        unit = self.unit[list(self.target.places(2))]
        return [
            (bound - z @ row) / float(np.sqrt(((unit * row) ** 2).sum()))
            for row, bound in zip(form.normals, form.bounds)
        ]


def ramps_to(plane: Plane, target: Region, cells: int, upper: bool) -> TargetRamps:
    """The solver for a target that is a polytope with faces along the states; lines of the grid go by its faces.

    They lie a hair inside for upper bounds of failing and outside for lower ones, so that rounding decides nothing.
    """
    size = np.array(plane.high) - np.array(plane.low)
    hair = [_HAIR * float(one) * (1 if upper else -1) for one in size]
    moved = [[place for place in (low + h, high - h) if math.isfinite(place)]
             for h, (low, high) in zip(hair, sides_of(target))]  # fmt: skip
    rounded = _Rounded(target=target, unit=_UNIT * size / cells, around=not upper)
    return TargetRamps(plane, rounded, cells, moved, arrives=upper)


def _smooth(s: Array) -> Array:
    s = np.clip(s, 0.0, 1.0)
    return np.asarray(s**3 * (10 - 15 * s + 6 * s * s))
