"""Two states: proposals by quintic splines with steps split along the axes, and the search for the best bounds.

The equation of V = log u is that of `proposal`, with mixed second derivatives where a has them. A step is ROS2 with an
approximate factorisation, (I - g h J_x)(I - g h J_y), which keeps order 2 whatever the factorisation leaves out
(Hundsdorfer and Verwer, Numerical Solution of Time-Dependent Advection-Diffusion-Reaction Equations, Sec. IV.5).
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from certbound.problem.model import compile_numpy
from certbound.problem.problem import Problem
from certbound.values.continuous.hypotheses import Model, covers, extreme_over, prove_upper
from certbound.values.continuous.lines import solve_lines
from certbound.values.continuous.proposal import Splines, through
from certbound.values.continuous.room import Room, starts_of
from certbound.values.continuous.surface import Surface

__all__ = ["two_states"]

Array = NDArray[np.float64]
Pair = tuple[float, float]

_GAMMA = 1 - 0.5**0.5


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
    """How a proposal is made: cells along each axis, slabs' growth, steps a slab, the lead and the floor of V."""

    cells: int
    growth: float
    substeps: int
    lead: float
    floor: float


def two_states(problem: Problem, model: Model, room: Room, deadline: float) -> tuple[float, None, str]:
    """Refine the upper bound until the time is spent; lower bounds in two states are not looked for."""
    starts = starts_of(problem)
    plane = _plane(problem, model, room.inner_low, room.inner_high, starts)
    level, upper, done = _rough_level(plane), 0.0, []
    cells, growth, lead = 34, 0.28, 0.01  # a first answer in a few seconds
    for _ in range(5):
        begin = time.perf_counter()
        plan = Plan(cells=cells, growth=growth, substeps=8, lead=lead * plane.horizon, floor=level - 5)
        surface = propose_plane(plane, plan)
        if surface is not None and covers(surface, plane.horizon, plane.low, plane.high, within=True):
            level = min(level, extreme_over(surface, starts, upper=True))
            upper = min(upper, prove_upper(surface, model, starts).log)
            done.append(f"{cells}^2 x {surface.slabs}")
        spent = time.perf_counter() - begin
        if time.perf_counter() + 2.5 * spent > deadline:
            break
        cells, growth, lead = int(1.25 * cells), growth / 1.4, lead * 0.8
    words = f"value function in two states, cells x slabs of time: {', '.join(done) or 'none came to an end'}"
    return upper, None, words


def _rough_level(plane: Plane) -> float:
    """log P from a coarse proposal; the floor is lowered until it does not matter."""
    level = 0.0
    for floor in (-8.0, -20.0, -45.0):
        plan = Plan(cells=28, growth=0.4, substeps=6, lead=0.02 * plane.horizon, floor=floor)
        surface = propose_plane(plane, plan)
        if surface is None:
            continue
        level = min(level, extreme_over(surface, plane.starts, upper=True)) if level else float(
            extreme_over(surface, plane.starts, upper=True)
        )
        if level > floor + 2:
            break
    return level


def _plane(
    problem: Problem, model: Model, low: tuple[float, ...], high: tuple[float, ...], starts: list[Pair]
) -> Plane:
    drift, square = compile_numpy(model.drift.tape), compile_numpy(model.square.tape)
    corners = [[float(value.mid) for value in branch] for branch in model.branches]

    def drifts(t: float, x: Array, y: Array) -> Array:
        return np.array([np.moveaxis(drift(t, x, y, *corner), -1, 0) for corner in corners])

    return Plane(
        low=(low[0], low[1]), high=(high[0], high[1]), horizon=float(problem.horizon), drift=drifts,
        square=lambda t, x, y: np.moveaxis(square(t, x, y), (-2, -1), (0, 1)), starts=starts,
        autonomous=model.autonomous,
    )  # fmt: skip


def propose_plane(plane: Plane, plan: Plan) -> Surface | None:
    """V on a tensor grid; None where the integration breaks down."""
    solver = _Solver(plane, plan)
    times = _slab_times(plane.horizon, plan)
    value = solver.start()
    values, first, last = [value], [], []
    for begin, end in itertools.pairwise(times):
        first.append(solver.rate(begin, value))
        step = (end - begin) / plan.substeps
        for part in range(plan.substeps):
            value = solver.step(begin + part * step, value, step)
        if not np.isfinite(value).all() or value.max() > 30:
            return None
        values.append(value)
        last.append(solver.rate(end, value))
    return solver.surface(times, values, first, last)


def _slab_times(horizon: float, plan: Plan) -> Array:
    times = [0.0]
    while times[-1] < horizon:
        times.append(times[-1] + min(plan.growth * (0.4 * plan.lead + times[-1]), horizon * plan.growth / 4))
    return np.array(times) * (horizon / times[-1])


class _Solver:
    """V at Greville's points of both axes, shape (count_x, count_y)."""

    def __init__(self, plane: Plane, plan: Plan) -> None:
        self.plane, self.plan = plane, plan
        self.nodes = [_grid(plane, plan, axis) for axis in (0, 1)]
        self.splines = [Splines(nodes) for nodes in self.nodes]
        self.inverse = [np.linalg.inv(one.dense[0]) for one in self.splines]
        self.slope = [one.dense[1] @ inverse for one, inverse in zip(self.splines, self.inverse)]
        self.bend = [one.dense[2] @ inverse for one, inverse in zip(self.splines, self.inverse)]
        self.x, self.y = np.meshgrid(*(one.points for one in self.splines), indexing="ij")
        self.edge = np.ones(self.x.shape, dtype=bool)
        self.edge[1:-1, 1:-1] = False
        self.fixed = self._model(0.0) if plane.autonomous else None

    def _model(self, t: float) -> tuple[Array, Array, Array]:
        drift, square = self.plane.drift(t, self.x, self.y), self.plane.square(t, self.x, self.y)
        return drift, square, _weakened(self.plane, self.plan, drift[0], square, self.x, self.y)

    def start(self) -> Array:
        product = np.ones(self.x.shape)
        for axis, place in enumerate((self.x, self.y)):
            for side in (0, 1):
                rate, bend = self._layer(axis, side)
                distance = place - self.plane.low[axis] if side == 0 else self.plane.high[axis] - place
                product = product * (1 - (1 + bend * rate * distance) * np.exp(-rate * distance))
        least = math.exp(self.plan.floor)
        value = np.log(least + (1 - least) * (1 - product))
        value[self.edge] = 0.0
        return value

    def _layer(self, axis: int, side: int) -> tuple[float, Array]:
        """Rate k and bend c of the layer (1 + c k d) exp(-k d), for which a u'' / 2 + f u' = 0 on the face."""
        rate = _layer_rate(self.plane, self.plan, axis, side)
        place = [self.x, self.y]
        place[axis] = np.full(self.x.shape, self.plane.low[axis] if side == 0 else self.plane.high[axis])
        a = self.plane.square(self.plane.horizon, *place)[axis, axis]
        inward = self.plane.drift(self.plane.horizon, *place)[0, axis] * (1 if side == 0 else -1)
        inward = np.minimum(inward, 0.4 * rate * a)
        return rate, np.clip((0.5 * rate * a - inward) / (rate * a - inward), 0.0, 0.9)

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
        rate[self.edge] = 0.0
        speed_x = force[0] + a[0, 0] * vx + a[0, 1] * vy
        speed_y = force[1] + a[1, 1] * vy + a[0, 1] * vx
        return rate, speed_x, speed_y, a

    def rate(self, tau: float, value: Array) -> Array:
        return self._right(tau, value)[0]

    def _divided(self, right: Array, speeds: tuple[Array, Array], a: Array, step: float) -> Array:
        """(I - g h J_x)^-1 (I - g h J_y)^-1 applied."""
        for axis in (1, 0):
            own = self.splines[axis]
            line = np.ascontiguousarray(right if axis == 0 else right.T)
            speed = np.ascontiguousarray(speeds[axis] if axis == 0 else speeds[axis].T)
            half = np.ascontiguousarray(0.5 * (a[0, 0] if axis == 0 else a[1, 1].T) * np.ones(line.shape))
            solve_lines(own.at[0], own.at[1], own.at[2], speed, half, _GAMMA * step, line)
            line = own.dense[0] @ line
            right = line if axis == 0 else line.T
        return right

    def step(self, tau: float, value: Array, h: float) -> Array:
        rate, speed_x, speed_y, a = self._right(tau, value)
        k1 = self._divided(rate, (speed_x, speed_y), a, h)
        again = self._right(tau + h, value + h * k1)[0]
        k2 = self._divided(again - 2 * k1, (speed_x, speed_y), a, h)
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


def _grid(plane: Plane, plan: Plan, axis: int) -> Array:
    low, high = plane.low[axis], plane.high[axis]
    fine = np.linspace(low, high, 4001)
    density = np.full(len(fine), 1.0 / (high - low))
    for side, distance in ((0, fine - low), (1, high - fine)):
        weight = 1 / (distance + 1 / _layer_rate(plane, plan, axis, side))
        density += 0.5 * weight / np.trapezoid(weight, fine)
    total = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
    nodes = np.interp(np.linspace(0, total[-1], plan.cells + 1), total, fine)
    nodes[0], nodes[-1] = low, high
    return through(nodes, plane.starts[axis])


def _layer_rate(plane: Plane, plan: Plan, axis: int, side: int) -> float:
    """The rate of the start profile at a face: the largest that a layer of age ``lead`` has along it."""
    ends = [np.linspace(plane.low[k], plane.high[k], 33) for k in (0, 1)]
    ends[axis] = np.array([plane.low[axis] if side == 0 else plane.high[axis]])
    x, y = np.meshgrid(*ends, indexing="ij")
    a = plane.square(plane.horizon, x, y)[axis, axis] * np.ones(x.shape)
    return float(np.max(1.3 * np.sqrt(2 / (np.maximum(a, 1e-300) * plan.lead))))


def _weakened(plane: Plane, plan: Plan, drift: Array, a: Array, x: Array, y: Array) -> Array:
    """The drift with its inward part cut off near the faces, so that layers which no path crosses fit the grid."""
    result = []
    for axis, place in enumerate((x, y)):
        width = plane.high[axis] - plane.low[axis]
        zone = 0.12 * width
        most = 0.5 * a[axis, axis] * (6 - plan.floor) / zone
        weak = drift[axis] * np.ones(x.shape)
        for distance, sign in ((place - plane.low[axis], 1.0), (plane.high[axis] - place, -1.0)):
            share = np.clip(2 - distance / zone, 0.0, 1.0)
            cut = sign * np.minimum(sign * weak, most)
            weak = np.where(distance < 2 * zone, share * cut + (1 - share) * weak, weak)
        result.append(weak)
    return np.stack(result)
