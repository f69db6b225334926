"""What a proposal in two states is made from: the problem in floats, a plan, a source, and where its nodes lie."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.values.continuous.proposal import through
from certbound.values.continuous.residual import along
from certbound.values.continuous.surface import Surface

Pair = tuple[float, float]
Sides = tuple[bool, bool]

_THINNEST = 0.2
_SPARSE = 6.0  # how fast cells grow outside of where simulated paths go, in units of its extent
_TOGETHER = 0.35  # correlation of both noises at a corner, from which on it is given up
_FADING = 0.2  # of the box: how far from a face that is no limit the others lead in fewer


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Plane:
    """The problem in floats: drift (branches, 2, ...) and a (2, 2, ...) at (t, x, y), on a box, perhaps with nodes."""

    low: Pair
    high: Pair
    horizon: float
    drift: Callable[[float, Array, Array], Array]
    square: Callable[[float, Array, Array], Array]
    starts: list[Pair]
    autonomous: bool
    nodes: tuple[Array, Array] | None = None
    held: tuple[Sides, Sides] = ((False, False), (False, False))  # faces that no path crosses
    visited: tuple[Pair, Pair] | None = None  # where simulated paths go, along each axis: cells are larger elsewhere
    cut: tuple[Sides, Sides] = ((False, False), (False, False))  # faces that are no limits: who leaves has not failed

    def across(self, axis: int, place: list[Array], t: float) -> Array:
        """a's entry across a face, not below a small share of its largest value where it may vanish."""
        a = self.square(t, *place)[axis, axis] * np.ones(np.broadcast_shapes(*(np.shape(one) for one in place)))
        least = _THINNEST * float(np.max(a)) if any(itertools.chain(*self.held)) else 0.0
        return np.asarray(np.maximum(a, max(least, 1e-300)))

    def counted(self, x: Array, y: Array, most: float = 1.0) -> tuple[Array, Array]:
        """1, and 0 where faces are given up; smooth between. And a rate at which paths cross that part.

        Given up are faces at which the box is only cut, and corners where both noises go together closely, with a
        correlation of at ``most`` that: U bends there more than any spline.
        """
        ends, a = (self.low, self.high), self.square(self.horizon, x, y) * np.ones((2, 2, *x.shape))
        force = np.abs(self.drift(self.horizon, x, y)[0]) * np.ones((2, *x.shape))
        share, lost, near, rate = np.ones(x.shape), np.zeros(x.shape), {}, {}
        for axis, side in itertools.product((0, 1), (0, 1)):
            width = _FADING * (self.high[axis] - self.low[axis])
            s = np.clip(np.abs((x, y)[axis] - ends[side][axis]) / width - 1e-9, 0.0, 1.0)
            near[axis, side] = 1 - s**3 * (10 - 15 * s + 6 * s * s)
            rate[axis, side] = force[axis] / width + a[axis, axis] / width**2
        parts: list[list[tuple[int, int]]] = [[one] for one in near if self.cut[one[0]][one[1]]]
        for i, j in itertools.product((0, 1), (0, 1)):
            linked = a[0, 1, -i, -j] ** 2 / (a[0, 0, -i, -j] * a[1, 1, -i, -j])
            together = _TOGETHER**2 < linked <= most**2
            parts += [[(0, i), (1, j)]] if together and not self.cut[0][i] and not self.cut[1][j] else []
        for part in parts:
            within = np.prod([near[one] for one in part], axis=0)
            share = share * (1 - within)
            lost = lost + within * max(float(rate[one].max(where=within > 0, initial=0.0)) for one in part)
        return share, lost


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Plan:
    """How a proposal is made: cells along each axis, the slabs' growth, and what it starts from.

    At T there is a layer at each face, as steep as if it had evolved for the time ``lead``; V >= ``floor``. For lower
    bounds (``below``) V is at most ``floor`` at T, and rises to 0 on the faces within ``lead``. The ``first`` share of
    that is what slabs grow from.
    """

    cells: int
    growth: float
    lead: float
    floor: float = -math.inf
    below: bool = False
    first: float = 0.1


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Source:
    """What V's equation gets in addition, at the nodes of a surface: linear between them in time and in each state.

    Beyond the nodes it is what it is at the last one.

    ``values`` has shape (K + 1, N_1 + 1, N_2 + 1, ...), times forward.
    """

    times: Array
    axes: tuple[Array, ...]
    values: Array

    @classmethod
    def above(cls, surface: Surface, needed: Array) -> Source:
        """At least ``needed`` (K, N_1, ...), which must not be negative, on each patch: at nodes the largest around."""
        values = np.zeros(tuple(size + 1 for size in needed.shape))
        for corner in itertools.product((0, 1), repeat=needed.ndim):
            part = values[tuple(slice(first, first + size) for first, size in zip(corner, needed.shape))]
            np.maximum(part, needed, out=part)
        return cls(times=surface.times, axes=surface.axes, values=values)

    def plus(self, other: Source) -> Source:
        """The sum of two sources on the same grid."""
        return Source(times=self.times, axes=self.axes, values=self.values + other.values)

    def at(self, points: list[Array]) -> Array:
        """Values at the ends of the slabs and the products of points along the axes."""
        found = self.values
        for axis, (nodes, place) in enumerate(zip(self.axes, points)):
            found = along(_linear(nodes, place), found, 1 + axis)
        return np.ascontiguousarray(found)


def _linear(nodes: Array, points: Array) -> Array:
    left = np.clip(np.searchsorted(nodes, points) - 1, 0, len(nodes) - 2)
    share = np.clip((points - nodes[left]) / (nodes[left + 1] - nodes[left]), 0.0, 1.0)
    matrix = np.zeros((len(points), len(nodes)))
    matrix[np.arange(len(points)), left] = 1 - share
    matrix[np.arange(len(points)), left + 1] = share
    return matrix


def slab_times(horizon: float, plan: Plan) -> Array:
    """Ends of the slabs in time to go, short at first."""
    times = [0.0]
    while times[-1] < horizon:
        times.append(times[-1] + min(plan.growth * (plan.first * plan.lead + times[-1]), horizon * plan.growth / 4))
    return np.array(times) * (horizon / times[-1])


def spread_nodes(plane: Plane, plan: Plan, axis: int, more: Callable[[Array], Array] | None = None) -> Array:
    """Nodes where the noise is small, and at the faces or as ``more`` weighs places; bent to the starts."""
    if plane.nodes is not None:
        return plane.nodes[axis]
    low, high = plane.low[axis], plane.high[axis]
    fine = np.linspace(low, high, 4001)
    density = 1 / mean_deviation(plane, axis, fine)
    density = density / np.trapezoid(density, fine)
    for side, distance in ((0, fine - low), (1, high - fine)) if more is None else ():
        if plane.held[axis][side]:
            continue
        weight = 1 / (distance + 1 / layer_rate(plane, plan, axis, side))
        density += 0.5 * weight / np.trapezoid(weight, fine)
    density = density if more is None else density * more(fine)
    if plane.visited is not None:
        least, most = plane.visited[axis]
        density = density / (1 + _SPARSE * np.maximum(np.maximum(least - fine, fine - most), 0.0) / (most - least))
    total = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
    nodes = np.interp(np.linspace(0, total[-1], plan.cells + 1), total, fine)
    nodes[0], nodes[-1] = low, high
    return through(nodes, plane.starts[axis])


def mean_deviation(plane: Plane, axis: int, places: Array) -> Array:
    """The root of a's diagonal along an axis, averaged over the other one, and kept from being too small."""
    others = np.linspace(plane.low[1 - axis], plane.high[1 - axis], 17)
    x, y = np.meshgrid(places, others, indexing="ij") if axis == 0 else np.meshgrid(others, places, indexing="ij")
    square = plane.square(plane.horizon, x, y)[axis, axis] * np.ones(x.shape)
    root = np.sqrt(np.maximum(square, 0.0)).mean(axis=1 - axis)
    return np.asarray(np.maximum(root, 0.2 * root.max()) if root.max() > 0 else np.ones(root.shape))


def layer_rate(plane: Plane, plan: Plan, axis: int, side: int) -> float:
    """The rate of the start profile at a face: the largest that a layer of age ``lead`` has along it."""
    ends = [np.linspace(plane.low[k], plane.high[k], 33) for k in (0, 1)]
    ends[axis] = np.array([plane.low[axis] if side == 0 else plane.high[axis]])
    x, y = np.meshgrid(*ends, indexing="ij")
    a = plane.across(axis, [x, y], plane.horizon)
    if plan.below:
        return float(np.max(rise(plane, plan, axis, side, x, y)))
    inward = np.max(plane.drift(plane.horizon, x, y)[:, axis] * (1 if side == 0 else -1), axis=0)
    return float(np.max(np.maximum(1.3 * np.sqrt(2 / (a * plan.lead)), inward / (1.5 * a))))


def rise(plane: Plane, plan: Plan, axis: int, side: int, x: Array, y: Array) -> Array:
    """k at a face, with a k^2 / 2 - f k = the speed at which V rises there."""
    place = [x, y]
    place[axis] = np.full(x.shape, plane.low[axis] if side == 0 else plane.high[axis])
    a = plane.square(plane.horizon, *place)[axis, axis] * np.ones(x.shape)
    drift = plane.drift(plane.horizon, *place)[:, axis] * (1 if side == 0 else -1)
    inward = np.maximum(drift.min(axis=0), 0.0)
    return np.asarray((inward + np.sqrt(inward**2 - 4 * a * plan.floor / plan.lead)) / np.maximum(a, 1e-300))
