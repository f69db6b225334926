"""Proposals of V in a region with curved walls: the solver of `plane`, continued across the walls.

Nothing here is certified. The equation is solved at the points that lie inside. Outside, V is continued from there: at
each point a polynomial is fitted to V at the inner points around and to V = 0 at points of the walls, so that the
spline has no kink where the walls cut a cell. In a step the points outside stand still and follow at its end.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from certbound.arrays import Array, Index, Mask
from certbound.values.continuous.curved.boundaries import Deep, Walls
from certbound.values.continuous.plane import Plan, Plane, Solver, Source, integrated, spread_nodes
from certbound.values.continuous.surface import Surface

if TYPE_CHECKING:
    from scipy.sparse import csr_array

_NEAR = 0.02  # points so near a wall, in cells, count as outside: the polynomial is better there than the equation
_FIT, _FADE = 2.5, 6.5  # depths, in cells, down to which V is continued by a cubic, and at which it is 0
_CROWD = 2.0  # how much denser the grid is around walls than it would be
_DEGREE = 1  # of the polynomial that V is fitted by beside the distance to a wall; higher ones are unstable
_INNER, _BESIDE, _WEIGHT = 4.0, 2.5, 0.8  # in cells: how far points count, and how fast they lose weight
_ON_WALL = 30.0  # weight of V = 0 at corners
_FOLLOW = 0.5  # how far the points outside follow in a step: all the way is not stable
_MOST = 60  # points that a polynomial is fitted to


def propose_within(plane: Plane, plan: Plan, walls: Walls, source: Source | None = None) -> Surface | None:
    """V on a tensor grid, near 0 on the walls; None where the integration breaks down or needs too many steps."""
    return integrated(_Fenced(plane, plan, source, walls))


class _Fenced(Solver):
    def __init__(self, plane: Plane, plan: Plan, source: Source | None, walls: Walls) -> None:
        self.walls = walls
        self.curve = wall_points(walls, plane, 4 * plan.cells)
        super().__init__(plane, plan, source)
        self.edge = self.edge | self.outside
        self.filling = _filling(_Limits(walls, plane, self.curve), self.x, self.y, self.widths, self.outside)

    def grid(self, axis: int) -> Array:
        return crowded_nodes(self.plane, self.plan, axis, self.curve)

    @functools.cached_property
    def depth(self) -> Array:
        return np.asarray(self.walls.depth(self.x, self.y))

    @functools.cached_property
    def outside(self) -> Mask:
        return np.asarray(self.depth < _NEAR * np.minimum(*self.widths))

    def _model(self, t: float) -> tuple[Array, Array]:
        drift, square = super()._model(t)
        kept = np.where(self.outside, 0.0, 1.0)
        return drift * kept, square * kept

    def _eased(self, force: Array, a: Array, slopes: tuple[Array, Array], value: Array) -> Array:
        return force  # the box ends where hardly a path gets to

    def start(self) -> Array:
        """A layer at the walls besides those at the faces, flat where a u'' / 2 + f u' is to vanish."""
        t, places = self.plane.horizon, (self.x[:, 0], self.y[0])
        slope = np.gradient(self.depth, *places)
        slope = [part / np.maximum(np.hypot(*slope), 1e-9) for part in slope]
        bent = [np.gradient(part, *places) for part in slope]
        square, drift = self.plane.square(t, self.x, self.y), self.plane.drift(t, self.x, self.y)[0]
        pairs = [(i, j) for i in (0, 1) for j in (0, 1)]
        across = np.maximum(sum(square[i, j] * slope[i] * slope[j] for i, j in pairs), 1e-300)
        inward = sum(drift[i] * slope[i] for i in (0, 1)) + 0.5 * sum(square[i, j] * bent[i][j] for i, j in pairs)
        rate = 1.3 * np.sqrt(2 / (across * self.plan.lead))
        share = inward / (rate * across)
        deep = np.maximum(rate * self.depth, 0.0)
        bend, curve = np.clip((0.5 - share) / np.maximum(1 - share, 0.1), 0.0, 0.9), np.clip(2 * share - 1, 0.0, 2.0)
        layer = np.minimum((1 + bend * deep) * np.exp(0.5 * curve * deep**2 * np.exp(-deep) - deep), 1.0)
        u = np.exp(super().start())
        return self._filled(np.log(u + (1 - u) * layer))

    def _filled(self, value: Array) -> Array:
        value = value.copy()
        value[self.outside] = 0.0
        value += (self.filling @ value.ravel()).reshape(value.shape)
        value[[0, -1]] = value[:, [0, -1]] = 0.0
        return value

    def rate(self, tau: float, value: Array) -> Array:
        return self._filled(super().rate(tau, value))

    def step(self, tau: float, value: Array, h: float) -> Array:
        new = super().step(tau, value, h)
        return np.where(self.outside, (1 - _FOLLOW) * value + _FOLLOW * self._filled(new), new)


def crowded_nodes(plane: Plane, plan: Plan, axis: int, curve: Array, crowd: float = _CROWD) -> Array:
    """Nodes along an axis, denser around the walls' points ``curve``."""
    places = curve[:, axis]
    if not len(places):
        return spread_nodes(plane, plan, axis)
    low, high = places.min(), places.max()
    margin = 0.1 * (plane.high[axis] - plane.low[axis])

    def more(fine: Array) -> Array:
        away = np.maximum(np.maximum(low - fine, fine - high), 0.0)
        return np.asarray(1 + crowd / (1 + (away / margin) ** 2))

    return spread_nodes(plane, plan, axis, more)


def wall_points(walls: Deep, plane: Plane, count: int) -> Array:
    """Points of the walls within the box, shape (M, 2), where the lines of an even grid cross them."""
    axes = [np.linspace(low, high, count + 1) for low, high in zip(plane.low, plane.high)]
    found = []
    for axis in (0, 1):
        x, y = np.meshgrid(*axes, indexing="ij")
        inside = walls.depth(x, y) > 0
        first = [slice(None), slice(None)]
        second = [slice(None), slice(None)]
        first[axis], second[axis] = slice(None, -1), slice(1, None)
        crossed = inside[tuple(first)] != inside[tuple(second)]
        low = np.stack([part[tuple(first)][crossed] for part in (x, y)])
        high = np.stack([part[tuple(second)][crossed] for part in (x, y)])
        sign = inside[tuple(first)][crossed]
        for _ in range(40):
            middle = 0.5 * (low + high)
            same = (walls.depth(*middle) > 0) == sign
            low, high = np.where(same, middle, low), np.where(same, high, middle)
        found.append(0.5 * (low + high).T)
    return np.concatenate(found)


class _Limits:
    """The walls and then the four faces of the box: points of each that bound the region, and distances from each.

    ``group`` says to which obstacle a wall belongs; negative numbers are no obstacle's.
    """

    def __init__(self, walls: Walls, plane: Plane, curve: Array) -> None:
        self.walls, self.plane = walls, plane
        self.group = [k if outside else -1 for k, (own, outside) in enumerate(walls.groups) for _ in own] + [-1] * 4
        labels = [np.argmin(np.abs(walls.depths(*curve.T)), axis=0)]
        points = [curve]
        for axis, side in itertools.product((0, 1), (0, 1)):
            along = np.linspace(plane.low[1 - axis], plane.high[1 - axis], 401)
            place = np.full(along.shape, (plane.low, plane.high)[side][axis])
            face = np.stack([place, along] if axis == 0 else [along, place], axis=1)
            face = face[walls.depth(*face.T) > 0]
            points.append(face)
            labels.append(np.full(len(face), len(self.group) - 4 + 2 * axis + side))
        self.points, self.labels = np.concatenate(points), np.concatenate(labels)

    def distances(self, x: Array, y: Array) -> Array:
        """Positive on the safe side of each, shape (walls + 4, ...)."""
        low, high = self.plane.low, self.plane.high
        faces = np.array([x - low[0], high[0] - x, y - low[1], high[1] - y])
        return np.concatenate([self.walls.depths(x, y), faces])

    def smooth(self, seen: Array) -> bool:
        """Whether V is likely to be a smooth function times the distances: not at a corner of an obstacle."""
        own = [self.group[label] for label in seen if self.group[label] >= 0]
        return len(set(own)) == len(own)


def _filling(limits: _Limits, x: Array, y: Array, widths: Sequence[Array], outside: Mask) -> csr_array:
    """The matrix from V at inner points to V at the points outside that lie near a wall."""
    from scipy.sparse import csr_array

    points, cells = np.stack([x.ravel(), y.ravel()], axis=1), np.stack([one.ravel() for one in widths], axis=1)
    inner, distances, across = np.flatnonzero(~outside), limits.distances(*points.T), cells.min(axis=1)
    on_wall = limits.labels < len(limits.group) - 4
    rows, columns, entries = [], [], []
    for place in np.flatnonzero(outside) if on_wall.any() else ():
        own, wall = ((some - points[place]) / cells[place] for some in (points[inner], limits.points))
        deep = float(np.hypot(*wall[on_wall].T).min())
        if deep > _FADE:
            continue
        chosen, beside = _around(own, wall, deep)
        if len(chosen) < 6:
            continue
        seen = np.unique(limits.labels[beside])
        if limits.smooth(seen):
            factor = np.prod(distances[seen] / across[place], axis=0)
            weights = _smooth_weights(own[chosen], factor[inner[chosen]], float(factor[place]), deep)
        else:
            weights = _corner_weights(own[chosen], wall[beside], deep)
        rows.append(np.full(len(chosen), place))
        columns.append(inner[chosen])
        entries.append(weights)
    shape = (x.size, x.size)
    if not rows:
        return csr_array(shape)
    return csr_array((np.concatenate(entries), (np.concatenate(rows), np.concatenate(columns))), shape=shape)


def _around(own: Array, wall: Array, deep: float) -> tuple[Index, Index]:
    """Inner points on the same side of the wall as the nearest one, and points of the wall, near the origin."""
    distance, gap = np.hypot(*own.T), np.hypot(*wall.T)
    foot = wall[np.argmin(gap)]
    length = float(np.hypot(*foot))
    facing = (own - foot) @ foot > -length if length > 0.3 else np.ones(len(own), dtype=bool)
    chosen = np.flatnonzero(facing & (distance < deep + _INNER))
    beside = np.flatnonzero(gap < max(deep + _BESIDE, 1.01 * length))
    chosen = chosen[np.argsort(distance[chosen], kind="stable")[:_MOST]]
    return chosen, beside[np.argsort(gap[beside], kind="stable")[:_MOST]]


def _shares(deep: float) -> tuple[float, float]:
    """How much of a curved and of a plain continuation is taken at a depth in cells."""
    share = float(np.clip(deep - _FIT, 0.0, 1.0))
    fade = float(np.clip((_FADE - deep) / (_FADE - _FIT - 1.0), 0.0, 1.0))
    return 1 - share, share * fade * fade * (3 - 2 * fade)


def _smooth_weights(own: Array, factor: Array, here: float, deep: float) -> Array:
    """V = (distance to the wall) times a polynomial, which vanishes on a curved wall as V does."""
    importance = np.exp(-((np.hypot(*own.T) / (deep + _WEIGHT)) ** 2) / 2)
    total = np.zeros(len(own))
    for degree, part in zip((_DEGREE if len(own) >= 12 else 1, 1), _shares(deep)):
        table = _monomials(own, degree) * (factor * importance)[:, None]
        total += part * here * importance * np.linalg.lstsq(table.T, np.eye(table.shape[1])[0], rcond=1e-10)[0]
    return total


def _corner_weights(own: Array, wall: Array, deep: float) -> Array:
    """A polynomial fitted to V at the inner points and to 0 at the walls."""
    points = np.concatenate([own, wall])
    importance = np.exp(-((np.hypot(*points.T) / (deep + _WEIGHT)) ** 2) / 2)
    importance[len(own) :] *= _ON_WALL * np.sqrt(len(own) / len(wall))
    total = np.zeros(len(own))
    for degree, part in zip((2 if len(own) >= 12 else 1, 1), _shares(deep)):
        table = _monomials(points, degree) * importance[:, None]
        solved = np.linalg.lstsq(table.T, np.eye(table.shape[1])[0], rcond=1e-10)[0]
        total += part * (solved * importance)[: len(own)]
    return total


def _monomials(points: Array, degree: int) -> Array:
    """Monomials up to a degree, the constant first."""
    x, y = points.T
    return np.stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)], axis=1)
