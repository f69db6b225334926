"""Floating-point proposals of V in two states; nothing here is certified.

The equation of V = log u is that of `proposal`, with mixed second derivatives where a has them and a source s that is
handed in: V_tau = sup_d f.grad V + tr(a V'') / 2 + |g' grad V|^2 / 2 + s. Collocation with quintic splines along both
axes. A step is ROS2 with an approximate factorisation, (I - g h J_x)(I - g h J_y), which keeps order 2 whatever the
factorisation leaves out (Hundsdorfer and Verwer, Numerical Solution of Time-Dependent Advection-Diffusion-Reaction
Equations, Sec. IV.5); g = 1/2 and steps of a few cells keep it stable at outflow.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit

from certbound.arrays import Array
from certbound.values.continuous.proposal import Splines, through
from certbound.values.continuous.surface import Surface
from certbound.watch import poll

Pair = tuple[float, float]

_GAMMA = 0.5
_COURANT = 3.0
_GATE = 0.004  # a source weakens where V is above minus this, and ends at 0
_MOST_STEPS = 40_000


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Plane:
    """The problem in floats: drift (branches, 2, ...) and a (2, 2, ...) at (t, x, y), on a box."""

    low: Pair
    high: Pair
    horizon: float
    drift: Callable[[float, Array, Array], Array]
    square: Callable[[float, Array, Array], Array]
    starts: list[Pair]
    autonomous: bool


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Plan:
    """How a proposal is made: cells along each axis, the slabs' growth, and what it starts from.

    At T there is a layer at each face, as if it had evolved for the time ``lead``, over V = ``floor``.
    """

    cells: int
    growth: float
    lead: float
    floor: float


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Source:
    """What V's equation gets in addition, at the nodes of a surface: linear between them in t, x and y.

    ``values`` has shape (K + 1, N_1 + 1, N_2 + 1), times forward.
    """

    times: Array
    axes: tuple[Array, ...]
    values: Array

    @classmethod
    def above(cls, surface: Surface, needed: Array) -> Source:
        """At least ``needed`` (K, N_1, N_2), which must not be negative, on each patch: at nodes the largest around."""
        slabs, rows, columns = needed.shape
        values = np.zeros((slabs + 1, rows + 1, columns + 1))
        for a, b, c in itertools.product((0, 1), repeat=3):
            part = values[a : a + slabs, b : b + rows, c : c + columns]
            np.maximum(part, needed, out=part)
        return cls(times=surface.times, axes=surface.axes, values=values)

    def plus(self, other: Source) -> Source:
        """The sum of two sources on the same grid."""
        return Source(times=self.times, axes=self.axes, values=self.values + other.values)

    def at(self, points: list[Array]) -> Array:
        """Values at the ends of the slabs and the products of points along the axes."""
        x, y = (_linear(nodes, place) for nodes, place in zip(self.axes, points))
        return np.asarray(np.einsum("pi,kij,qj->kpq", x, self.values, y, optimize=True))


def _linear(nodes: Array, points: Array) -> Array:
    left = np.clip(np.searchsorted(nodes, points) - 1, 0, len(nodes) - 2)
    share = (points - nodes[left]) / (nodes[left + 1] - nodes[left])
    matrix = np.zeros((len(points), len(nodes)))
    matrix[np.arange(len(points)), left] = 1 - share
    matrix[np.arange(len(points)), left + 1] = share
    return matrix


def propose_plane(plane: Plane, plan: Plan, source: Source | None = None) -> Surface | None:
    """V on a tensor grid; None where the integration breaks down or needs too many steps."""
    return integrated(Solver(plane, plan, source))


def integrated(solver: Solver) -> Surface | None:
    """What a solver makes of its start; None where that breaks down or needs too many steps."""
    plane, plan = solver.plane, solver.plan
    times = slab_times(plane.horizon, plan)
    value, taken = solver.start(), 0
    values, first, last = [value], [], []
    for begin, end in itertools.pairwise(times):
        first.append(solver.rate(begin, value))
        steps = solver.steps(begin, value, end - begin)
        taken += steps
        if taken > _MOST_STEPS:
            return None
        step = (end - begin) / steps
        for part in range(steps):
            poll("a proposal of the value function")
            value = solver.step(begin + part * step, value, step)
        if not np.isfinite(value).all() or value.max() > 30:
            return None
        values.append(value)
        last.append(solver.rate(end, value))
    return solver.surface(times, values, first, last)


def slab_times(horizon: float, plan: Plan) -> Array:
    """Ends of the slabs in time to go, short at first."""
    times = [0.0]
    while times[-1] < horizon:
        times.append(times[-1] + min(plan.growth * (0.1 * plan.lead + times[-1]), horizon * plan.growth / 4))
    return np.array(times) * (horizon / times[-1])


class Solver:
    """V at Greville's points of both axes, shape (count_x, count_y)."""

    def __init__(self, plane: Plane, plan: Plan, source: Source | None) -> None:
        self.plane, self.plan = plane, plan
        self.nodes = [self.grid(axis) for axis in (0, 1)]
        self.splines = [Splines(nodes) for nodes in self.nodes]
        self.inverse = [np.linalg.inv(one.dense[0]) for one in self.splines]
        self.slope = [one.dense[1] @ inverse for one, inverse in zip(self.splines, self.inverse)]
        self.bend = [one.dense[2] @ inverse for one, inverse in zip(self.splines, self.inverse)]
        points = [one.points for one in self.splines]
        self.x, self.y = np.meshgrid(*points, indexing="ij")
        self.widths = np.meshgrid(*(np.gradient(one) for one in points), indexing="ij")
        self.edge = np.ones(self.x.shape, dtype=bool)
        self.edge[1:-1, 1:-1] = False
        self.fixed = self._model(0.0) if plane.autonomous else None
        self.source = None if source is None else (source.times, source.at(points))

    def grid(self, axis: int) -> Array:
        """The nodes along an axis."""
        return spread_nodes(self.plane, self.plan, axis)

    def _model(self, t: float) -> tuple[Array, Array, Array]:
        drift, square = self.plane.drift(t, self.x, self.y), self.plane.square(t, self.x, self.y)
        weak = _weakened(self.plane, self.plan, drift[0], square, self.x, self.y)
        return drift, square, weak

    def start(self) -> Array:
        product = np.ones(self.x.shape)
        for axis, place in enumerate((self.x, self.y)):
            for side in (0, 1):
                rate, bend, curve = self._layer(axis, side)
                depth = rate * (place - self.plane.low[axis] if side == 0 else self.plane.high[axis] - place)
                layer = (1 + bend * depth) * np.exp(0.5 * curve * depth**2 * np.exp(-depth) - depth)
                product = product * (1 - layer)
        least = math.exp(self.plan.floor)
        value = np.log(least + (1 - least) * (1 - product))
        value[self.edge] = 0.0
        return value

    def _layer(self, axis: int, side: int) -> tuple[float, Array, Array]:
        """k, c and b of the layer (1 + c k d) exp(b (k d)^2 exp(-k d) / 2 - k d); a u'' / 2 + f u' = 0 on the face."""
        rate = _layer_rate(self.plane, self.plan, axis, side)
        place = [self.x, self.y]
        place[axis] = np.full(self.x.shape, self.plane.low[axis] if side == 0 else self.plane.high[axis])
        a = self.plane.square(self.plane.horizon, *place)[axis, axis]
        inward = self.plane.drift(self.plane.horizon, *place)[0, axis] * (1 if side == 0 else -1)
        share = inward / (rate * a)
        bend = np.clip((0.5 - share) / np.maximum(1 - share, 0.1), 0.0, 0.9)
        return rate, bend, np.clip(2 * share - 1, 0.0, 2.0)

    def _right(self, tau: float, value: Array) -> tuple[Array, Array, Array, Array]:
        drift, a, weak = self.fixed or self._model(self.plane.horizon - tau)
        vx, vy = self.slope[0] @ value, value @ self.slope[1].T
        along_drift = drift[:, 0] * vx + drift[:, 1] * vy
        best = np.argmax(along_drift, axis=0) if len(drift) > 1 else np.zeros(value.shape, dtype=int)
        force = np.take_along_axis(drift, best[None, None], axis=0)[0]
        force = np.stack([np.where((w - f) * v > 0, w, f) for w, f, v in zip(weak, force, (vx, vy))])
        bends = a[0, 0] * (self.bend[0] @ value) + a[1, 1] * (value @ self.bend[1].T)
        if np.any(a[0, 1]):
            bends = bends + 2 * a[0, 1] * (vx @ self.slope[1].T)
        energy = a[0, 0] * vx * vx + 2 * a[0, 1] * vx * vy + a[1, 1] * vy * vy
        rate = force[0] * vx + force[1] * vy + 0.5 * (bends + energy)
        rate = rate + self._source(tau) * np.clip(-value / _GATE, 0.0, 1.0)
        rate[self.edge] = 0.0
        speed_x = force[0] + a[0, 0] * vx + a[0, 1] * vy
        speed_y = force[1] + a[1, 1] * vy + a[0, 1] * vx
        return rate, speed_x, speed_y, a

    def _source(self, tau: float) -> Array:
        if self.source is None:
            return np.zeros(self.x.shape)
        times, values = self.source
        t = self.plane.horizon - tau
        left = min(max(int(np.searchsorted(times, t)) - 1, 0), len(times) - 2)
        share = (t - times[left]) / (times[left + 1] - times[left])
        return np.asarray((1 - share) * values[left] + share * values[left + 1])

    def rate(self, tau: float, value: Array) -> Array:
        return self._right(tau, value)[0]

    def steps(self, tau: float, value: Array, span: float) -> int:
        """How many steps a slab needs, so that nothing moves by more than a few cells in one."""
        _, speed_x, speed_y, _ = self._right(tau, value)
        fastest = max(float(np.max(np.abs(v) / w)) for v, w in zip((speed_x, speed_y), self.widths))
        return max(4, math.ceil(min(span * fastest / _COURANT, 1e6)) if math.isfinite(fastest) else 4)

    def _divided(self, right: Array, speeds: tuple[Array, Array], a: Array, step: float, fed: Array) -> Array:
        """(I - g h J_x)^-1 (I - g h J_y)^-1 (I - g h J_s)^-1 applied, J_s = -``fed`` being the source's part."""
        right = right / (1 + _GAMMA * step * fed)
        for axis in (1, 0):
            own = self.splines[axis]
            line = np.ascontiguousarray(right if axis == 0 else right.T)
            speed = np.ascontiguousarray(speeds[axis] if axis == 0 else speeds[axis].T)
            half = np.ascontiguousarray(0.5 * (a[0, 0] if axis == 0 else a[1, 1].T) * np.ones(line.shape))
            _solve_lines(own.at[0], own.at[1], own.at[2], speed, half, _GAMMA * step, line)
            line = own.dense[0] @ line
            right = line if axis == 0 else line.T
        return right

    def step(self, tau: float, value: Array, h: float) -> Array:
        rate, speed_x, speed_y, a = self._right(tau, value)
        fed = np.where((value < 0) & (value > -_GATE), self._source(tau) / _GATE, 0.0)
        k1 = self._divided(rate, (speed_x, speed_y), a, h, fed)
        again = self._right(tau + h, value + h * k1)[0]
        k2 = self._divided(again - 2 * k1, (speed_x, speed_y), a, h, fed)
        return value + 1.5 * h * k1 + 0.5 * h * k2

    def surface(self, times: Array, values: list[Array], first: list[Array], last: list[Array]) -> Surface:
        maps = [np.stack([m @ inverse for m in one.at_nodes], axis=1)
                for one, inverse in zip(self.splines, self.inverse)]  # fmt: skip

        def data(tables: list[Array]) -> Array:
            part = np.einsum("iap,kpq->kiaq", maps[0], np.array(tables), optimize=True)
            found = np.einsum("jbq,kiaq->kiajb", maps[1], part, optimize=True)[::-1]
            found[:, [0, -1], 0] = 0.0  # V = 0 on the faces, exactly
            found[:, :, :, [0, -1], 0] = 0.0
            return np.asarray(found)

        forward = self.plane.horizon - times[::-1]
        forward[0], forward[-1] = 0.0, self.plane.horizon
        return Surface(
            axes=tuple(self.nodes), times=forward, values=data(values), start_rates=-data(last),
            end_rates=-data(first),
        )  # fmt: skip


def spread_nodes(plane: Plane, plan: Plan, axis: int, more: Callable[[Array], Array] | None = None) -> Array:
    """Nodes where the noise is small, and at the faces or as ``more`` weighs places; bent to the starts."""
    low, high = plane.low[axis], plane.high[axis]
    fine = np.linspace(low, high, 4001)
    density = 1 / _mean_deviation(plane, axis, fine)
    density = density / np.trapezoid(density, fine)
    for side, distance in ((0, fine - low), (1, high - fine)) if more is None else ():
        weight = 1 / (distance + 1 / _layer_rate(plane, plan, axis, side))
        density += 0.5 * weight / np.trapezoid(weight, fine)
    density = density if more is None else density * more(fine)
    total = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
    nodes = np.interp(np.linspace(0, total[-1], plan.cells + 1), total, fine)
    nodes[0], nodes[-1] = low, high
    return through(nodes, plane.starts[axis])


def _mean_deviation(plane: Plane, axis: int, places: Array) -> Array:
    """The root of a's diagonal along an axis, averaged over the other one, and kept from being too small."""
    others = np.linspace(plane.low[1 - axis], plane.high[1 - axis], 17)
    x, y = np.meshgrid(places, others, indexing="ij") if axis == 0 else np.meshgrid(others, places, indexing="ij")
    square = plane.square(plane.horizon, x, y)[axis, axis] * np.ones(x.shape)
    root = np.sqrt(np.maximum(square, 0.0)).mean(axis=1 - axis)
    return np.asarray(np.maximum(root, 0.2 * root.max()))


def _layer_rate(plane: Plane, plan: Plan, axis: int, side: int) -> float:
    """The rate of the start profile at a face: the largest that a layer of age ``lead`` has along it."""
    ends = [np.linspace(plane.low[k], plane.high[k], 33) for k in (0, 1)]
    ends[axis] = np.array([plane.low[axis] if side == 0 else plane.high[axis]])
    x, y = np.meshgrid(*ends, indexing="ij")
    a = np.maximum(plane.square(plane.horizon, x, y)[axis, axis] * np.ones(x.shape), 1e-300)
    inward = np.max(plane.drift(plane.horizon, x, y)[:, axis] * (1 if side == 0 else -1), axis=0)
    return float(np.max(np.maximum(1.3 * np.sqrt(2 / (a * plan.lead)), inward / (1.5 * a))))


def _weakened(plane: Plane, plan: Plan, drift: Array, a: Array, x: Array, y: Array) -> Array:
    """The drift with its inward part cut off near the faces, so that layers which no path crosses fit the grid."""
    result = []
    for axis, place in enumerate((x, y)):
        width = plane.high[axis] - plane.low[axis]
        zone = 0.04 * width
        most = 0.5 * a[axis, axis] * (6 - plan.floor) / zone
        weak = drift[axis] * np.ones(x.shape)
        for distance, sign in ((place - plane.low[axis], 1.0), (plane.high[axis] - place, -1.0)):
            share = np.clip(2 - distance / zone, 0.0, 1.0)
            cut = sign * np.minimum(sign * weak, most)
            weak = np.where(distance < 2 * zone, share * cut + (1 - share) * weak, weak)
        result.append(weak)
    return np.stack(result)


@njit(cache=True)
def _solve_lines(mass: Array, slope: Array, bend: Array, speed: Array, half: Array, step: float, right: Array) -> None:
    """Solve (mass - step (speed slope + half bend)) k = right along the first axis, line by line, in place.

    The three matrices are given by the rows of their bands (entry (i, k) belongs to column i + k - band); the first and
    the last row are those of ``mass``. ``speed``, ``half`` and ``right`` have shape (rows, lines). No pivots.
    """
    size, wide = mass.shape
    band = (wide - 1) // 2
    work = np.empty((size, wide))
    for line in range(right.shape[1]):
        for i in range(size):
            inside = step if 0 < i < size - 1 else 0.0
            for k in range(wide):
                work[i, k] = mass[i, k] - inside * (speed[i, line] * slope[i, k] + half[i, line] * bend[i, k])
        for i in range(size):
            for j in range(i + 1, min(size, i + band + 1)):
                factor = work[j, i - j + band]
                if factor != 0.0:
                    factor /= work[i, band]
                    for k in range(1, band + 1):
                        if i + k < size:
                            work[j, i + k - j + band] -= factor * work[i, k + band]
                    right[j, line] -= factor * right[i, line]
        for i in range(size - 1, -1, -1):
            total = right[i, line]
            for k in range(1, band + 1):
                if i + k < size:
                    total -= work[i, k + band] * right[i + k, line]
            right[i, line] = total / work[i, band]
