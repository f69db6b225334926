"""u, and the error that the process carries: one function v a side with v_t + L v <= eta (Thm K10, 10.1 and 10.2).

From above v is the bound itself, u + e; from below v is its negative, -(u - e). On both sides v_t + sup_d L^d v <= eta
is asked where v < ``end`` (1 from above, 0 from below), v >= ``goal`` wherever paths can leave (from above 1; from
below -1 at limits and 0 at other ends of the box), and v(T) >= 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np

from certbound.arrays import Array, Mask
from certbound.rigor.intervals import Interval
from certbound.values.kolmogorov.axes import Grazing, Size, plan_axes
from certbound.values.kolmogorov.box_setting import Setting
from certbound.values.kolmogorov.face_exits import face_of, shortfall
from certbound.values.kolmogorov.slab_residual import Generator, residual_bound, rough_residual
from certbound.values.kolmogorov.solve import Discretised, discretised
from certbound.values.kolmogorov.sources import BREADTHS, at_knots, at_nodes
from certbound.values.kolmogorov.splines import DEGREE, Axis, Sampling, apply_dense, most_on_cells, sliding_max

END = 0.3  # times a cell's share of the range: the layer at the end, as a share of the horizon
_FIRST, _GROWTH = 12, 1.15  # steps within that layer, and how they grow: a front leaves it sharp, and blurs slowly
_MARGIN = 0.1  # by which a source exceeds what it pays for
_LARGEST = 1e100  # a coefficient
_STRIP, _PAD = 9, 5  # cells beyond noise-free and noisy limits, on which e lives
_SOFT = 3.0
_KILL = 10.0
_REACHED = 1.5
_ON_FACE = 0.3  # of the source that would raise e to what v lacks while a path crosses one cell
_BATCH = 300_000  # lattice points of the slabs that are looked at together
_RESOLVED = 3.0  # of the flow against paths times the width of a cell to squared noise
_SKETCH = 2  # points along each axis of a cell, where nothing is proved of its residual
_CLOCK = 1e-13  # share of the horizon by which that of an upper bound is longer, of a lower bound shorter


def ramp(y: Array) -> Array:
    """A C^2 step from 0 at 0 to 1 at 1."""
    z = np.clip(y, 0, 1)
    return np.asarray(z**3 * (10 - 15 * z + 6 * z * z))


def time_steps(horizon: float, count: int, layer: float) -> Array:
    """Lengths of the steps from the end backward: small in the end layer, growing to horizon / count."""
    largest, step = horizon / count, layer / _FIRST
    result: list[float] = []
    while step < largest and sum(result) + step < horizon:
        result.append(step)
        step *= _GROWTH
    rest = horizon - sum(result)
    more = max(int(np.ceil(rest / largest)), 1)
    return np.array(result + [rest / more] * more)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Mesh:
    """Nodes of a box, and beyond its limits by ``pad`` cells (lower and upper ends of each axis).

    ``at_limit`` is 1 at limits that paths may leave through, less where the flow is so strong against them that the
    grid does not resolve the layer: no exits need be counted there. ``leaving`` is the rate at which paths leave the
    cells about a node.
    """

    nodes: tuple[Array, ...]
    pad: tuple[tuple[int, int], ...]
    equation: Discretised
    layer: Array
    at_limit: Array
    rate: Array
    leaving: Array


def extended(nodes: Array, before: int, behind: int) -> Array:
    """The nodes, and their mirror images beyond both ends."""
    low = 2 * nodes[0] - nodes[before:0:-1] if before else nodes[:0]
    high = 2 * nodes[-1] - nodes[-2 : -2 - behind : -1] if behind else nodes[:0]
    return np.concatenate([low, nodes, high])


def mesh_of(
    setting: Setting,
    nodes: list[Array],
    grazing: list[Grazing],
    row: int,
    pad: tuple[int, int],
    kill: bool,
    span: float,
) -> Mesh:
    """A grid with its equation; ``pad`` counts cells beyond noise-free limits that paths graze, and noisy ones."""
    n = setting.dimension
    low, high = setting.low[row], setting.high[row]
    free = {(one.axis, one.side) for one in grazing}
    pads = tuple((pad[(i, 0) not in free], pad[(i, 1) not in free]) for i in range(n))
    lines = tuple(extended(nodes[i], *pads[i]) for i in range(n))
    points = np.array(np.meshgrid(*lines, indexing="ij"))
    shape = points.shape[1:]
    inside = np.clip(points, low.reshape(-1, *[1] * n), high.reshape(-1, *[1] * n))
    flow, spread = setting.flow(inside), setting.spread(inside).reshape(n, n, *shape)
    dead, at_limit, layer, rate = np.zeros(shape, bool), np.zeros(shape), np.ones(shape), np.zeros(shape)
    for i in range(n):
        for side, place in ((0, 0), (1, shape[i] - 1)):
            face = tuple(place if k == i else slice(None) for k in range(n))
            out = (2 * side - 1) * flow[i][face]
            leaves = (spread[i, i][face] > 0) | (out >= 0)
            dead[face] |= leaves
            against = -out * abs(lines[i][place] - lines[i][1 if side == 0 else -2])
            resolved = ramp(2 - against / (_RESOLVED * spread[i, i][face] + 1e-300)) if setting.noisy[i] else 1.0
            at_limit[face] = np.maximum(at_limit[face], leaves * float(setting.limited[side, i]) * resolved)
            width = np.sqrt(spread[i, i][face].max() * span) or np.maximum(out, 0).mean() * span
            third = abs(lines[i][place] - lines[i][3 if side == 0 else -4])
            layer = layer * ramp(np.abs(points[i] - lines[i][place]) / max(width, third))
    for i in range(n):
        for side in (0, 1):
            if pads[i][side] and (i, side) not in free:
                edge = (low, high)[side][i]
                out = (2 * side - 1) * (points[i] - edge)
                beyond = abs(lines[i][-1 if side else 0] - edge)
                speed = np.abs(flow[i]) / beyond + spread[i, i] / beyond**2
                rate += _KILL * speed * ramp(out / beyond)
    for one in grazing:
        edge = (low, high)[one.side][one.axis]
        out = (2 * one.side - 1) * (points[one.axis] - edge)
        if pads[one.axis][one.side]:
            beyond = abs(lines[one.axis][-1 if one.side else 0] - edge)
            rate += _KILL * np.abs(flow[one.axis]).max() / beyond * ramp(out / beyond)
        if kill:
            width = (0.3 * _SOFT**3 + 2) * one.scale
            rate += 3 * _SOFT * one.speed / width * _bump(out / width) * _bump(flow[one.axis] / (_SOFT * one.speed))
    layer[dead] = 0
    equation = discretised(lines, flow, spread, dead, rate)
    return Mesh(nodes=lines, pad=pads, equation=equation, layer=layer, at_limit=at_limit, rate=rate,
                leaving=_leaving(lines, flow, spread))  # fmt: skip


def _leaving(lines: tuple[Array, ...], flow: Array, spread: Array) -> Array:
    rate = np.zeros(flow.shape[1:])
    for i, line in enumerate(lines):
        width = np.gradient(line).reshape([-1 if k == i else 1 for k in range(len(lines))])
        rate += np.abs(flow[i]) / width + spread[i, i] / width**2
    return rate


def _bump(y: Array) -> Array:
    return np.asarray(np.exp(-y * y / 2))


def _nothing(part: float) -> float:
    return 0.0


def _between(first: Array, last: Array, part: float) -> Array:
    return (1 - part) * first + part * last


def _later(given: Callable[[float], Array | float], begin: float, step: float, part: float) -> Array | float:
    return given(begin + part * step)


def _generator(setting: Setting, axes: tuple[Axis, ...]) -> Generator:
    always = Interval.point(0.0)
    return Generator.of(axes, setting.drift.on(axes, always), setting.square.on(axes, always))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Best:
    """The pass that proved most: at least v at the start, the bound of the side, and the coefficients then."""

    value: float
    bound: float
    values: list[Array]
    rates: list[Array]


class Side:
    """One bound on one grid.

    Parameters
    ----------
    setting : Setting
    cell : ndarray, shape (n,)
        Width of a cell as a share of the range.
    steps : int
        Steps over the horizon.
    above : bool
        From above or from below.
    shapes : sequence of callable, optional
        A width at every place of each axis; without them cells follow the scales of the equation.
    """

    def __init__(
        self, setting: Setting, cell: Array, steps: int, above: bool, shapes: Sequence[Size] = (),
        parts: int = 4,
    ) -> None:  # fmt: skip
        self.setting, self.above, self.cell, self.count = setting, above, cell, steps
        row = 0 if above else 1
        self.layer = END * float(np.mean(cell)) * setting.horizon
        nodes, grazing = plan_axes(setting, cell, row, shapes)
        self.axes = tuple(Axis(line, Sampling(parts)) for line in nodes)
        self.mesh = mesh_of(setting, nodes, grazing, row, (0, 0) if above else (_STRIP, 0), above, self.layer)
        self.carrier = mesh_of(setting, nodes, grazing, row, (_STRIP, _PAD), False, self.layer)
        longer = 1 + (_CLOCK if above else -_CLOCK)  # the sum of the steps is rounded
        self.steps = time_steps(setting.horizon * longer, steps, self.layer)
        self.generator, self.sketch = (
            _generator(setting, axes) for axes in (self.axes, tuple(Axis(line, Sampling(_SKETCH)) for line in nodes))
        )
        self.maps = [axis.from_nodes(line) for axis, line in zip(self.axes, self.mesh.nodes)]
        self.carried_maps = [axis.from_nodes(line) for axis, line in zip(self.axes, self.carrier.nodes)]
        n, noisy = setting.dimension, setting.noisy
        self.faces = [
            face_of(self.axes, setting.drift, noisy[i], i, side, self._goal(bool(setting.limited[side, i])))
            for i in range(n)
            for side in (0, 1)
        ]
        self.passes = 0
        self.values: list[Array] = []
        self.rates: list[Array] = []
        self.best: Best | None = None

    def on(self, shapes: Sequence[Size]) -> Side:
        """The same side on axes of other shapes."""
        return Side(self.setting, self.cell, self.count, self.above, shapes)

    @property
    def begun(self) -> bool:
        """Whether the next source is still about the residual, and not above it."""
        return self.passes < len(BREADTHS) - 1

    @property
    def work(self) -> int:
        """Cells of space and time."""
        return int(np.prod([axis.cells for axis in self.axes])) * len(self.steps)

    @property
    def finite(self) -> bool:
        """Whether every coefficient is a number that no derivative overflows with: nothing is proved of others."""
        return all(bool(np.all(np.abs(row) < _LARGEST)) for rows in (self.values, self.rates) for row in rows)

    def _goal(self, limit: bool) -> float:
        return 1.0 if self.above else -1.0 if limit else 0.0

    def shortfalls(self) -> list[Array]:
        """What v lacks at every face where paths can leave, shapes (slabs, face cells)."""
        values, rates = np.array(self.values), np.array(self.rates)
        return [shortfall(self.axes, face, values, rates, self.steps) for face in self.faces]

    def shortfall_at_end(self) -> Array:
        """What v(T) lacks of 0 on every cell."""
        return np.asarray(np.maximum(most_on_cells(self.axes, -self.values[0][None])[0], 0.0))

    def lacking(self) -> float:
        """The most that v lacks at the end and at faces where paths can leave."""
        return max(float(self.shortfall_at_end().max()), *(float(missing.max()) for missing in self.shortfalls()))

    def remember(self, value: float, bound: float) -> None:
        """Keep the coefficients as they are now where they prove more than before."""
        if self.best is None or bound < self.best.bound:  # later passes replace the arrays and do not change them
            self.best = Best(value=value, bound=bound, values=list(self.values), rates=list(self.rates))

    def propose(self) -> None:
        """Solve for the survival A; v is 1 - A from above, A - 1 from below."""
        equation, span = self.mesh.equation, self.layer
        above, limit = self.above, self.mesh.at_limit

        def fall(tau: float) -> Array | float:
            if above or tau >= span:
                return 0.0
            return np.asarray(-30 * (tau / span) ** 2 * (1 - tau / span) ** 2 / span * limit)

        a = self.mesh.layer.copy() if above else np.ones(equation.shape)
        tau = 0.0
        self._keep(a, equation.speed(a, 0.0, fall(tau)))
        for step in self.steps:
            a = equation.step(a, step, _nothing, partial(_later, fall, tau, step))
            tau += step
            self._keep(a, equation.speed(a, 0.0, fall(tau)))

    def _keep(self, a: Array, speed: Array) -> None:
        sign = -1.0 if self.above else 1.0
        self.values.append(sign * (apply_dense(self.maps, a) - 1))
        self.rates.append(-sign * apply_dense(self.maps, speed))

    def residuals(self, rough: bool = False) -> list[Array]:
        """A bound of v_t + L v on every cell, slab by slab from the end backward; ``rough`` about that, and quicker."""
        generator = self.sketch if rough else self.generator
        lattice = int(np.prod([axis.sampling.parts for axis in generator.axes]))
        many = max(1, _BATCH * len(self.steps) // (lattice * self.work))
        with ThreadPoolExecutor(2) as pool:
            parts = pool.map(lambda k: self._bounded(generator, rough, k, k + many), range(0, len(self.steps), many))
            return [bound for part in parts for bound in part]

    def _bounded(self, generator: Generator, rough: bool, begin: int, end: int) -> list[Array]:
        steps = self.steps[begin:end]
        values, rates = (np.array(rows[begin : begin + len(steps) + 1]) for rows in (self.values, self.rates))
        bound = (rough_residual if rough else residual_bound)(generator, values, rates, steps)
        return list(np.where(self._decided(values, rates, steps), 0.0, np.maximum(bound, 0.0)))

    def _decided(self, values: Array, rates: Array, steps: Array) -> Mask:
        """Cells and slabs on which v is so large that nothing is asked of it any more."""
        h = steps.reshape(-1, *[1] * len(self.axes)) / 3
        parts = (values[1:], values[1:] + h * rates[1:], values[:-1] - h * rates[:-1], values[:-1])
        lowest = np.minimum.reduce(parts)
        for axis in range(len(self.axes)):
            lowest = -sliding_max(-lowest, axis + 1, DEGREE + 1)
        return np.asarray(lowest >= (1.0 if self.above else 0.0) + 1e-12 * np.abs(parts).max())

    def correct(self, residuals: list[Array]) -> None:
        """Solve for the error that the residuals leave, and for what v lacks at exits and at the end; add it to v."""
        equation, breadth = self.carrier.equation, min(self.passes, len(BREADTHS) - 1)
        spread = partial(at_nodes, pads=self.carrier.pad, breadth=BREADTHS[breadth])
        slabs = [spread(r) + b for r, b in zip(residuals, self._at_exits(spread))]
        ends = [(1 + _MARGIN) * s * equation.live for s in at_knots(slabs, self.steps, BREADTHS[breadth])]
        missing = (1 + _MARGIN) * spread(self.shortfall_at_end()) * equation.live
        e = equation.solve(self.steps[0], missing + self.steps[0] * ends[0])
        self._add(0, e, equation.speed(e, ends[0]))
        for k, step in enumerate(self.steps):
            e = equation.step(e, step, partial(_between, ends[k], ends[k + 1]), _nothing)
            self._add(k + 1, e, equation.speed(e, ends[k + 1]))
        self.passes += 1

    def _at_exits(self, spread: Callable[..., Array]) -> list[Array]:
        """Sources beyond the faces and on them, from which e takes what v lacks there, slab by slab.

        Beyond a face e is killed at a rate, and held near what v lacks by as large a source. Paths that graze a
        noise-free face hardly get there: a source on the face itself raises e while they are about it.
        """
        carrier = self.carrier
        total = [np.zeros(carrier.equation.shape) for _ in self.steps]
        for face, missing in zip(self.faces, self.shortfalls()):
            pad = carrier.pad[face.axis][face.side]
            if not missing.any():
                continue
            length = carrier.equation.shape[face.axis]
            beyond = slice(length - pad, length) if face.side else slice(0, pad)
            at = slice(length - pad - 1, length - pad) if face.side else slice(pad, pad + 1)
            place, on = (
                tuple(part if k == face.axis else slice(None) for k in range(len(self.axes))) for part in (beyond, at)
            )
            for k, one in enumerate(missing):
                if one.any():
                    around = spread(np.expand_dims(one, face.axis), skip=face.axis)
                    total[k][place] = np.maximum(total[k][place], _REACHED * around * carrier.rate[place])
                    if not self.setting.noisy[face.axis]:
                        total[k][on] = np.maximum(total[k][on], _ON_FACE * around * carrier.leaving[on])
        return total

    def _add(self, k: int, e: Array, speed: Array) -> None:
        self.values[k] = self.values[k] + apply_dense(self.carried_maps, e)
        self.rates[k] = self.rates[k] - apply_dense(self.carried_maps, speed)
