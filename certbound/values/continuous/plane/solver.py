"""Floating-point proposals of V in two states; nothing here is certified.

The equation of V = log u is that of `proposal`, with mixed second derivatives where a has them and a source s that is
handed in: V_tau = sup_d f.grad V + tr(a V'') / 2 + |g' grad V|^2 / 2 + s. Collocation with quintic splines along both
axes. A step is ROS2 with an approximate factorisation, (I - g h J_x)(I - g h J_y), which keeps order 2 whatever the
factorisation leaves out (Hundsdorfer and Verwer, Numerical Solution of Time-Dependent Advection-Diffusion-Reaction
Equations, Sec. IV.5); g = 1/2 and steps of about a cell keep it stable at outflow.

*Steep fronts.* Where noise is small V is close to a maximum over ways out: smooth, but with convex kinks as wide as one
over the jump of grad V, less than a cell. Three things keep such V on the grid, each on the side that costs little. At
T, V = -k d beside each face (d the distance): no floor, whose kink would travel through the grid, and slopes that no
later parabola exceeds by much. At kinks that a cell cannot hold a is raised until it can (`_viscosity`): V'' > 0 there,
so that V's own residual falls; and since what V tells travels into kinks, it changes near them alone. Beside faces the
inward drift is weakened (`weakened`), so that layers fit the cells: V rises towards the face, and the residual falls
by what the drift lost times that slope.
"""

from __future__ import annotations

import itertools
import math
from typing import Protocol

import numpy as np

from certbound.arrays import Array
from certbound.lazy import compiled
from certbound.values.continuous.plane.plane_grids import Plan, Plane, Source, layer_rate, slab_times, spread_nodes
from certbound.values.continuous.proposal import Splines
from certbound.values.continuous.surface import Surface
from certbound.watch import poll

_GAMMA = 0.5
_COURANT = 1.5
_GIVEN = 10.0  # how far V is below 0 where paths go, where no plan says so
_GATE = 0.004  # a source weakens where V is above minus this, and ends at 0
_MOST_STEPS = 40_000
_PER_SLAB = 80  # on average, beyond which steps are a sign of oscillations
_BENT = 1.5  # jump of V' over five points, times a cell, above which a is raised
_ZONE = 0.88  # of the width over the number of cells: how far from a face the inward drift is weakened
_FALL = 0.5  # half of what V may fall by over the cell beside a face, where the drift is inward


class _Timed(Protocol):
    @property
    def horizon(self) -> float: ...


class Stepper(Protocol):
    """What `integrated` asks for: V as an array, its rate, steps, and the surface through what was found."""

    @property
    def plane(self) -> _Timed: ...
    @property
    def plan(self) -> Plan: ...
    def start(self) -> Array: ...
    def rate(self, tau: float, value: Array) -> Array: ...
    def steps(self, tau: float, value: Array, span: float) -> int: ...
    def step(self, tau: float, value: Array, h: float) -> Array: ...
    def surface(self, times: Array, values: list[Array], first: list[Array], last: list[Array]) -> Surface: ...


def integrated(solver: Stepper) -> Surface | None:
    """What a solver makes of its start; None where that breaks down or needs too many steps."""
    plane, plan = solver.plane, solver.plan
    times = slab_times(plane.horizon, plan)
    value, taken = solver.start(), 0
    values, first, last = [value], [], []
    for begin, end in itertools.pairwise(times):
        first.append(solver.rate(begin, value))
        steps = solver.steps(begin, value, end - begin)
        taken += steps
        if taken > min(_MOST_STEPS, _PER_SLAB * len(times)):
            return None
        step = (end - begin) / steps
        for part in range(steps):
            poll("a proposal of the value function")
            try:
                value = solver.step(begin + part * step, value, step)
            except ZeroDivisionError:  # V has run off, and a matrix has no inverse
                return None
        if not np.isfinite(value).all() or value.max() > 30:
            return None
        values.append(value)
        last.append(solver.rate(end, value))
    return solver.surface(times, values, first, last)


class Solver:
    """V at Greville's points of both axes, shape (count_x, count_y)."""

    gamma = _GAMMA
    degree = 5

    def __init__(self, plane: Plane, plan: Plan, source: Source | None) -> None:
        self.plane, self.plan = plane, plan
        self.nodes = [self.grid(axis) for axis in (0, 1)]
        self.splines = [Splines(nodes, self.degree) for nodes in self.nodes]
        self.inverse = [self.fitted(one.dense[0]) for one in self.splines]
        self.slope = [one.dense[1] @ inverse for one, inverse in zip(self.splines, self.inverse)]
        self.bend = [one.dense[2] @ inverse for one, inverse in zip(self.splines, self.inverse)]
        points = [one.points for one in self.splines]
        self.x, self.y = np.meshgrid(*points, indexing="ij")
        self.gaps = np.meshgrid(*(np.gradient(one) for one in points), indexing="ij")
        widths = [np.interp(one, nodes, np.gradient(nodes)) for one, nodes in zip(points, self.nodes)]
        self.widths = np.meshgrid(*widths, indexing="ij")
        self.edge = np.zeros(self.x.shape, dtype=bool)
        for axis, side in itertools.product((0, 1), (0, 1)):
            if not plane.held[axis][side]:
                np.moveaxis(self.edge, axis, 0)[-side] = True
        self.fixed = self._model(0.0) if plane.autonomous else None
        self.source = None
        if source is not None:
            places = [np.clip(place, axis[0], axis[-1]) for place, axis in zip(points, source.axes)]
            self.source = source.times, source.at(places)

    def fitted(self, dense: Array) -> Array:
        """The matrix from V at the points to a spline's coefficients; ``dense`` leads back."""
        return np.asarray(np.linalg.inv(dense))

    def grid(self, axis: int) -> Array:
        """The nodes along an axis."""
        return spread_nodes(self.plane, self.plan, axis)

    def _model(self, t: float) -> tuple[Array, Array]:
        return self.plane.drift(t, self.x, self.y), self.plane.square(t, self.x, self.y)

    def start(self) -> Array:
        sides = []
        for axis, place in enumerate((self.x, self.y)):
            for side in (0, 1):
                if self.plane.held[axis][side]:
                    continue
                rate, bend, curve = self._layer(axis, side)
                depth = rate * (place - self.plane.low[axis] if side == 0 else self.plane.high[axis] - place)
                sides.append(np.log1p(bend * depth) + 0.5 * curve * depth**2 * np.exp(-depth) - depth)
        sides += self._given_up()
        far = np.logaddexp.reduce(sides)
        with np.errstate(divide="ignore"):  # 1 - the product of 1 - exp(side), which far from the faces is the sum
            near = np.log(-np.expm1(np.sum([np.log1p(-np.exp(np.minimum(side, 0.0))) for side in sides], axis=0)))
        value = np.logaddexp(np.where(far < -15, far, near), self.plan.floor)
        value[self.edge] = 0.0
        return np.asarray(value)

    def _given_up(self) -> list[Array]:
        """V rises to 0 at T also between where paths go and a held face far beyond: fronts there would cost much."""
        if self.plane.visited is None:
            return []
        depth = max(-self.plan.floor, 1.0) if self.plan.floor > -math.inf else _GIVEN
        found = []
        for axis, place in enumerate((self.x, self.y)):
            least, most = self.plane.visited[axis]
            for side, beyond in ((0, least - place), (1, place - most)):
                if self.plane.held[axis][side]:
                    found.append(-np.logaddexp(0.0, depth * (1 - 2 * beyond / (most - least))))
        return found

    def _layer(self, axis: int, side: int) -> tuple[float, Array, Array]:
        """k, c and b of the layer (1 + c k d) exp(b (k d)^2 exp(-k d) / 2 - k d); a u'' / 2 + f u' = 0 on the face."""
        rate = layer_rate(self.plane, self.plan, axis, side)
        place = [self.x, self.y]
        place[axis] = np.full(self.x.shape, self.plane.low[axis] if side == 0 else self.plane.high[axis])
        a = self.plane.across(axis, place, self.plane.horizon)
        inward = self.plane.drift(self.plane.horizon, *place)[0, axis] * (1 if side == 0 else -1)
        share = inward / (rate * a)
        bend = np.clip((0.5 - share) / np.maximum(1 - share, 0.1), 0.0, 0.9)
        return rate, bend, np.clip(2 * share - 1, 0.0, 2.0)

    def face(self, tau: float) -> tuple[Array | float, Array | float]:
        """V and its rate on the faces."""
        return 0.0, 0.0

    @np.errstate(over="ignore", invalid="ignore")  # a proposal that breaks down is no number, and is left
    def _right(self, tau: float, value: Array) -> tuple[Array, Array, Array, Array]:
        drift, a = self.fixed or self._model(self.plane.horizon - tau)
        vx, vy = self.slope[0] @ value, value @ self.slope[1].T
        along_drift = drift[:, 0] * vx + drift[:, 1] * vy
        best = np.argmax(along_drift, axis=0) if len(drift) > 1 else np.zeros(value.shape, dtype=int)
        force = np.take_along_axis(drift, best[None, None], axis=0)[0]
        force = self._eased(force, a, (vx, vy), value)
        bend = self.bend[0] @ value, value @ self.bend[1].T
        own, a = a, a + self._viscosity(a, (vx, vy), bend)
        bends = a[0, 0] * bend[0] + a[1, 1] * bend[1]
        if np.any(a[0, 1]):
            bends = bends + 2 * a[0, 1] * (vx @ self.slope[1].T)
        energy = own[0, 0] * vx * vx + 2 * own[0, 1] * vx * vy + own[1, 1] * vy * vy
        rate = force[0] * vx + force[1] * vy + 0.5 * (bends + energy)
        rate = rate + self._fed(tau, value)
        rate[self.edge] = self.face(tau)[1]
        speed_x = force[0] + own[0, 0] * vx + own[0, 1] * vy
        speed_y = force[1] + own[1, 1] * vy + own[0, 1] * vx
        return rate, speed_x, speed_y, a

    def _eased(self, force: Array, a: Array, slopes: tuple[Array, Array], value: Array) -> Array:
        """The drift, weakened beside faces where that makes V rise."""
        weak = weakened(self.plane, self.plan, force, a, (self.x, self.y), value)
        return np.stack([np.where((w - f) * v > 0, w, f) for w, f, v in zip(weak, force, slopes)])

    def _fed(self, tau: float, value: Array) -> Array:
        return self._source(tau) * np.clip(-value / _GATE, 0.0, 1.0)

    def _falls(self, tau: float, value: Array) -> Array:
        """How fast what the source gives falls with V."""
        return np.where((value < 0) & (value > -_GATE), self._source(tau) / _GATE, 0.0)

    def _viscosity(self, a: Array, slopes: tuple[Array, Array], bends: tuple[Array, Array]) -> Array:
        """What is added to a (on its diagonal) where V has convex kinks along an axis that its cells cannot hold."""
        from scipy.ndimage import maximum_filter1d, minimum_filter1d

        found = np.zeros((2, 2, *self.x.shape))
        for axis, (slope, bend) in enumerate(zip(slopes, bends)):
            jump = maximum_filter1d(slope, 5, axis=axis) - minimum_filter1d(slope, 5, axis=axis)
            more = a[axis, axis] * np.maximum(self.gaps[axis] * jump / _BENT - 1, 0.0)
            found[axis, axis] = np.where(bend > 0, more, 0.0)
        return found

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
        fastest = max(float(np.max(np.abs(v) / w)) for v, w in zip((speed_x, speed_y), self._reaches()))
        return max(4, math.ceil(min(span * fastest / _COURANT, 1e6)) if math.isfinite(fastest) else 4)

    def _reaches(self) -> list[Array]:
        """The width of a cell along both axes, of which V may not move by more than a few in a step."""
        return list(self.widths)

    def _divided(self, right: Array, speeds: tuple[Array, Array], a: Array, step: float, fed: Array) -> Array:
        """(I - g h J_x)^-1 (I - g h J_y)^-1 (I - g h J_s)^-1 applied, J_s = -``fed`` being the source's part."""
        right = right / (1 + self.gamma * step * fed)
        for axis in (1, 0):
            own = self.splines[axis]
            line = np.ascontiguousarray(right if axis == 0 else right.T)
            speed = np.ascontiguousarray(speeds[axis] if axis == 0 else speeds[axis].T)
            half = np.ascontiguousarray(0.5 * (a[0, 0] if axis == 0 else a[1, 1].T) * np.ones(line.shape))
            solve_lines(own.at[0], own.at[1], own.at[2], speed, half, self.gamma * step, line, *self.plane.held[axis])
            line = own.dense[0] @ line
            right = line if axis == 0 else line.T
        return right

    def step(self, tau: float, value: Array, h: float) -> Array:
        rate, speed_x, speed_y, a = self._right(tau, value)
        fed = self._falls(tau, value)
        k1 = self._divided(rate, (speed_x, speed_y), a, h, fed)
        again = self._right(tau + h, value + h * k1)[0]
        k2 = self._divided(again - 2 * k1, (speed_x, speed_y), a, h, fed)
        value = value + 1.5 * h * k1 + 0.5 * h * k2
        value[self.edge] = self.face(tau + h)[0]
        return np.asarray(value)

    def surface(self, times: Array, values: list[Array], first: list[Array], last: list[Array]) -> Surface:
        maps = [np.stack([m @ inverse for m in one.at_nodes], axis=1)
                for one, inverse in zip(self.splines, self.inverse)]  # fmt: skip

        def data(tables: list[Array]) -> Array:
            part = np.einsum("iap,kpq->kiaq", maps[0], np.array(tables), optimize=True)
            found = np.einsum("jbq,kiaq->kiajb", maps[1], part, optimize=True)[::-1]
            if not self.plan.below:
                for side in (0, 1):  # V = 0 on the faces, exactly
                    if not self.plane.held[0][side]:
                        found[:, -side, 0] = 0.0
                    if not self.plane.held[1][side]:
                        found[:, :, :, -side, 0] = 0.0
            return np.asarray(found)

        forward = self.plane.horizon - times[::-1]
        forward[0], forward[-1] = 0.0, self.plane.horizon
        return Surface(
            axes=tuple(self.nodes), times=forward, values=data(values), start_rates=-data(last),
            end_rates=-data(first),
        )  # fmt: skip


def weakened(plane: Plane, plan: Plan, drift: Array, a: Array, places: tuple[Array, Array], value: Array) -> Array:
    """The drift with its inward part cut near the faces, so that layers which hardly a path crosses fit the grid.

    The layer falls from 0 to V beyond it; the drift that is left makes it about as thick as the zone.
    """
    result = []
    for axis, place in enumerate(places):
        width = plane.high[axis] - plane.low[axis]
        zone = _ZONE * width / plan.cells
        weak = drift[axis] * np.ones(place.shape)
        for distance, sign in ((place - plane.low[axis], 1.0), (plane.high[axis] - place, -1.0)):
            if plane.held[axis][int(sign < 0)]:
                continue
            share = np.clip(2 - distance / zone, 0.0, 1.0)
            line = distance[:, 0] if axis == 0 else distance[0]
            beyond = np.take(value, [np.argmin(np.abs(line - 1.5 * zone))], axis=axis)
            steepest = _FALL / (5 * np.partition(line, 1)[1])  # Greville's first point is a fifth of the cell away
            most = a[axis, axis] * np.minimum((2 + np.maximum(-beyond, 0.0)) / zone, steepest)
            weak = weak - sign * share * np.maximum(sign * weak - most, 0.0)
        result.append(weak)
    return np.stack(result)


@compiled
def solve_lines(
    mass: Array, slope: Array, bend: Array, speed: Array, half: Array, step: float, right: Array, first: bool,
    last: bool,
) -> None:
    """Solve (mass - step (speed slope + half bend)) k = right along the first axis, line by line, in place.

    The three matrices are given by the rows of their bands (entry (i, k) belongs to column i + k - band); the first and
    the last row are those of ``mass``, unless they are said to be like the others. ``speed``, ``half`` and ``right``
    have shape (rows, lines). No pivots.
    """
    size, wide = mass.shape
    band = (wide - 1) // 2
    work = np.empty((size, wide))
    for line in range(right.shape[1]):
        for i in range(size):
            inside = step if (i > 0 or first) and (i < size - 1 or last) else 0.0
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
