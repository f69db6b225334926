"""Proposals of V = log(w + (1 - w) P(failing)) with a target: 0 on the box's faces and at the horizon, low within it.

Inside the target nothing is asked of V, so that it is drawn to log w there: from its faces on for upper bounds, and
from a little outside for lower ones. Depths are measured in cells.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Mask
from certbound.problem.sets import Faces, Region
from certbound.rigor.intervals import Interval
from certbound.values.continuous.plane.plane_grids import Pair, Plan, Plane, Source, layer_rate, mean_deviation
from certbound.values.continuous.plane.solver import Solver, integrated
from certbound.values.continuous.surface import Surface
from certbound.values.sets import contains

_RAMP = 3.0  # cells over which V falls into the target at the horizon
_DRAWN = 2.0  # how fast V is drawn in the target, in units of the noise over a cell
_SOFT = 2.5  # cells over which that sets in
_APART = 1.5  # cells between a target's edge and where V is drawn, if that edge does not lie on the grid's lines
_ROUND = 1.0  # cells by which a corner is rounded, about
_EARLY = 0.5  # cells outside of the target from which on V is low for lower bounds
_CROWD = 1.3  # how many cells lie near each end of the target, in units of the evenly spread ones
_NEAR = 0.006  # of the box: how near
_UNITS = 3.0  # how much wider than at the edge a cell may be that depths are measured by
_FACE = 3.0  # cells from a face of the box within which V leaves what it is in the target
_WIDER = 3.0  # how much more slowly V rises beside the target there, for lower bounds
_CORNER = 3.0  # cells from a corner of the box within which there is no source
_STIFF = 20.0  # by how much what V is drawn by may exceed one over a step
_BENT = 0.05  # what a cell may lose of its width where nodes are moved to places


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Fate:
    """What becomes of the paths in the cells of a grid, shape ``cells``.

    ``alive``: not all of the cell lies in the target; ``met``: cells that hold all points of the target.
    """

    alive: Mask
    met: Mask

    @classmethod
    def of(cls, axes: tuple[Array, ...], target: Region) -> Fate:
        low = np.meshgrid(*(axis[:-1] for axis in axes), indexing="ij")
        high = np.meshgrid(*(axis[1:] for axis in axes), indexing="ij")
        cells = Interval(*(np.stack([side.ravel() for side in ends], axis=1) for ends in (low, high)))
        inside, outside = (mask.reshape(low[0].shape) for mask in contains(target, cells, 0))
        met = ~outside
        if target.form.axial:
            met &= np.logical_and.outer(*(_holding(axis, *ends) for axis, ends in zip(axes, sides_of(target))))
        return cls(alive=~inside, met=met)


def sides_of(target: Region) -> list[Pair]:
    """The ends of a region along both states; infinite where there is none."""
    around, places = target.hull(), target.places(2)
    sides = {place: (float(low), float(high)) for place, low, high in zip(places, around.lo, around.hi)}
    return [sides.get(axis, (-math.inf, math.inf)) for axis in (0, 1)]


def _holding(axis: Array, low: float, high: float) -> Mask:
    """Cells of an axis that hold an interval's points, without those that a neighbour makes unnecessary."""
    holding = (axis[:-1] <= high) & (axis[1:] >= low)
    spare = axis[1:] == low
    spare[-1] = False
    other = axis[:-1] == high if low < high else np.zeros(len(axis) - 1, dtype=bool)
    other[0] = False
    return np.asarray(holding & ~spare & ~other)


def propose_to_target(
    plane: Plane, plan: Plan, target: Region, source: Source | None = None, *, upper: bool
) -> Surface | None:
    """V with a target on a tensor grid; None where the integration breaks down."""
    return integrated(SolverToTarget(plane, plan, source, target, upper=upper))


class SolverToTarget(Solver):
    """V is ``plan.floor`` in the target and 0 at the horizon outside of it."""

    gamma = 1 - 0.5**0.5  # steps that damp what is stiff: cells beside the target are small

    def __init__(self, plane: Plane, plan: Plan, source: Source | None, target: Region, *, upper: bool) -> None:
        self.target, self.upper = target, upper
        super().__init__(plane, plan, source)
        depth, kept = self._depth(), self._off_faces()
        offset = (0.0 if upper else _EARLY) if target.form.axial else _APART
        ramp = _RAMP if upper else _RAMP * (1 + _WIDER * (1 - kept))
        falls = smooth((depth - offset) / ramp) * kept if upper else smooth((depth + offset + ramp) / ramp)
        self.profile = plan.floor * falls
        fast = [np.abs(self._model(plane.horizon)[1][k, k]) / self.widths[k] ** 2 for k in (0, 1)]
        begin = offset if upper else -offset - _SOFT
        share = np.clip((depth - begin) / _SOFT, 0.0, 1.0) ** 2 * (kept if upper else 1.0)
        self.drawn = _DRAWN * np.maximum(*fast) * share
        self.spared = self._beside_corners()

    def _off_faces(self) -> Array:
        """0 on the box's faces and 1 from a few cells on, but for faces that lie wholly in the target."""
        found = np.ones(self.x.shape)
        for axis, place in enumerate((self.x, self.y)):
            for side, distance in ((0, place - self.plane.low[axis]), (1, self.plane.high[axis] - place)):
                face = np.take(self._depth(), -side, axis=axis)
                if face.min() < 0:
                    found = found * smooth(distance / (_FACE * self.widths[axis]))
        return found

    def _beside_corners(self) -> Array:
        """0 at the box's corners, where V = 0 along both faces lets nothing change V; 1 from a few cells on."""
        shares = [
            np.clip(np.minimum(place - low, high - place) / (_CORNER * width), 0.0, 1.0)
            for place, low, high, width in zip((self.x, self.y), self.plane.low, self.plane.high, self.widths)
        ]
        return np.asarray(1 - (1 - shares[0]) * (1 - shares[1]))

    def _width_at_edge(self, axis: int) -> float:
        """A cell's width at the target's ends along a state, in the middle where it has none."""
        nodes = self.nodes[axis]
        ends = [end for end in ends_of(self.target, axis) if nodes[0] <= end <= nodes[-1]]
        places = ends or [0.5 * (nodes[0] + nodes[-1])]
        return float(np.interp(places, nodes, np.gradient(nodes)).max())

    def _depth(self) -> Array:
        """How deep in the target the points lie, in cells; negative outside."""
        form, places = self.target.form, self.target.places(2)
        center = self.target.center_at()
        y = np.stack([(self.x, self.y)[place] for place in places], axis=-1) - center
        h = np.stack(
            [np.minimum(self.widths[k], _UNITS * self._width_at_edge(k)) for k in places], axis=-1
        )
        if isinstance(form, Faces):
            reach = [
                (bound - y @ normal) / np.sqrt(((h * normal) ** 2).sum(axis=-1))
                for normal, bound in zip(form.normals, form.bounds)
            ]
            if self.upper:  # rounded corners inside of the target's
                return np.asarray(-_ROUND * np.logaddexp.reduce([-depth / _ROUND for depth in reach]))
            beyond = np.sqrt(np.sum(np.minimum(reach, 0.0) ** 2, axis=0))  # and outside of them
            return np.asarray(np.where(beyond > 0, -beyond, np.min(reach, axis=0)))
        inverse = form.root.T @ form.root / max(form.radius, 1e-300) ** 2
        pulled = y @ inverse
        gauge = np.sqrt(np.maximum((y * pulled).sum(axis=-1), 1e-12))
        return np.asarray((1 - gauge) * gauge / np.maximum(np.sqrt(((h * pulled) ** 2).sum(axis=-1)), 1e-12))

    def grid(self, axis: int) -> Array:
        plane, plan = self.plane, self.plan
        low, high = plane.low[axis], plane.high[axis]
        fine = np.linspace(low, high, 4001)
        density = 1 / mean_deviation(plane, axis, fine)
        density = density / np.trapezoid(density, fine)
        for side, distance in ((0, fine - low), (1, high - fine)):
            density += _layer(fine, distance + 1 / layer_rate(plane, plan, axis, side), 0.35)
        ends = ends_of(self.target, axis)
        for end in ends:
            if low < end < high:
                density += _layer(fine, np.abs(fine - end) + _NEAR * (high - low), _CROWD)
        total = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
        nodes = np.interp(np.linspace(0, total[-1], plan.cells + 1), total, fine)
        nodes[0], nodes[-1] = low, high
        return bent(nodes, [*ends, *plane.starts[axis]])

    def start(self) -> Array:
        return self.profile.copy()

    def face(self, tau: float) -> tuple[Array | float, Array | float]:
        return self.profile[self.edge], 0.0

    def _eased(self, force: Array, a: Array, slopes: tuple[Array, Array], value: Array) -> Array:
        return super()._eased(force, a, slopes, value) if self.upper else force

    def _viscosity(self, a: Array, slopes: tuple[Array, Array], bends: tuple[Array, Array]) -> Array:
        return super()._viscosity(a, slopes, bends) if self.upper else np.zeros((2, 2, *self.x.shape))

    def _fed(self, tau: float, value: Array) -> Array:
        given = super()._fed(tau, value) if self.upper else -self._source(tau)
        return np.asarray(given + self.drawn * (self.plan.floor - value))

    def _source(self, tau: float) -> Array:
        return np.asarray(self.spared * super()._source(tau))

    def _falls(self, tau: float, value: Array) -> Array:
        given = super()._falls(tau, value) if self.upper else np.zeros(value.shape)
        return np.asarray(given + self.drawn)

    def steps(self, tau: float, value: Array, span: float) -> int:
        return max(super().steps(tau, value, span), math.ceil(span * float(self.drawn.max()) / _STIFF))


def _layer(places: Array, distance: Array, share: float) -> Array:
    weight = 1 / distance
    return np.asarray(share * weight / np.trapezoid(weight, places))


def smooth(s: Array) -> Array:
    """From 0 at 0 to 1 at 1, twice continuously differentiable."""
    s = np.clip(s, 0.0, 1.0)
    return np.asarray(s**3 * (10 - 15 * s + 6 * s * s))


def ends_of(region: Region, axis: int) -> list[float]:
    """The finite ends of a region along a state, those of an axial one exactly."""
    around, places = region.hull(), region.places(2)
    if axis not in places:
        return []
    k = places.index(axis)
    return [float(end) for end in (around.lo[k], around.hi[k]) if np.isfinite(end)]


def bent(nodes: Array, points: list[float]) -> Array:
    """Nodes moved a little so that inner ones lie on the points, the first ones first, where no cell vanishes."""
    known = {0: float(nodes[0]), len(nodes) - 1: float(nodes[-1])}
    for point in dict.fromkeys(points):
        if not nodes[0] < point < nodes[-1]:
            continue
        k = 1 + int(np.argmin(np.abs(nodes[1:-1] - point)))
        tried = {**known, k: point} if k not in known else known
        moved = _moved(nodes, tried)
        if np.all(np.diff(moved) > _BENT * np.diff(nodes)):
            known = tried
    return _moved(nodes, known)


def _moved(nodes: Array, known: dict[int, float]) -> Array:
    order = sorted(known)
    moved = nodes + np.interp(np.arange(len(nodes)), order, [known[k] - nodes[k] for k in order])
    moved[order] = [known[k] for k in order]
    return np.asarray(moved)
