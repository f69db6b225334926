"""u, and the error that the process carries: one function v a side with v_t + L v <= eta (Thm K10, 10.1 and 10.2).

From above v is the bound itself, u + e; from below v is its negative, -(u - e). On both sides v_t + sup_d L^d v <= eta
is asked where v < ``end`` (1 from above, 0 from below), v >= ``goal`` wherever paths can leave (from above 1; from
below -1 at limits and 0 at other ends of the box), and v(T) >= 0.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import chain, pairwise

import numpy as np

from certbound.arrays import Array, Index, Mask
from certbound.rigor.intervals import Interval
from certbound.values.enclosing import enclose
from certbound.values.kolmogorov.axes import Plan, Size, plan_axes
from certbound.values.kolmogorov.box_setting import Setting
from certbound.values.kolmogorov.equation import (
    ABOUT,
    BREADTHS,
    DEEP,
    Breadth,
    ChangingEquation,
    Mesh,
    at_knots,
    at_nodes,
    growing_steps,
    knots_of,
    mesh_of,
    ramp,
    time_steps,
)
from certbound.values.kolmogorov.face_exits import ALWAYS, Face, face_of, shortfall
from certbound.values.kolmogorov.factors import CLOCK, HALF, factor_of
from certbound.values.kolmogorov.failed_cells import Shapes, distance_to, most_kept, shortfall_on
from certbound.values.kolmogorov.residual import (
    Generator,
    most_at_knots,
    residual_bound,
    rough_residual,
)
from certbound.values.kolmogorov.splines import (
    DEGREE,
    Axis,
    Sampling,
    apply_dense,
    most_of_difference,
    most_on_cells,
    sliding_max,
)
from certbound.watch import OutOfTime, poll

END = 0.3  # times a cell's share of the range: the layer at the end, as a share of the horizon
_OFTEN = 1.2, 0.9  # cost of a cell of a model that changes, and what each extreme disturbance adds, measured
_MARGIN = 0.1, 0.02, 1.0
"""By which a source exceeds what it pays for: in the first passes, in two that pay all of it, and in later ones. To
these single cells are left, on which e pays two thirds of what it is to: a swing's lower bound took 12 passes with .02
and 7 with 1; more than 1 costs more than that."""

_LASTING = 0.5  # share of a slab's source that its neighbours have at least, where it pays: a source that ends at once
# leaves e a kink in time, and what that leaves moves through the slabs pass by pass
_RESOLVED = 8.0  # from below exits count from about this times the time in which noise crosses the cell at a limit,
# or its root times that of the flow across it
_LARGEST = 1e100  # a coefficient
_STRIP, _PAD = 9, 5  # cells beyond noise-free and noisy limits, on which e lives
_REACHED = 1.5
_ON_FACE = 0.3  # of the source that would raise e to what v lacks while a path crosses one cell
_BATCH = 300_000  # lattice points of the slabs that are looked at together
_CALM = {2: 3, 3: 1}
"""Passes before the first one with a calm e, by the number of states, measured: with 1 and with 3 of them an epidemic's
v is .20 and .38, Lorenz' lower side .101 and .103, Josephson's junction .0046 and .0045, a pendulum's lower bound
.039 and .048. Coarse grids want it, on finer ones e is larger with it."""

_MANY = 1.0  # log10 of the cells that paths leave within a step, from which on (to ten times as many) e is calm
_DEGREES = {2: 5, 3: 4}
"""Of interpolants where residuals are proved, by the number of states: in three those of degree 4 take a quarter less
time than those of degree 5, for bounds that are one hundredth wider."""

_SKETCH = 3  # degree of interpolants where little is at stake: of bulges, and where nothing is proved
_MAKING_ROOM = 3  # turns until axes have about as many cells as asked
_FREE = 0.75  # of the longest step: shorter ones follow a layer in time
_CLOCK = 1e-13  # share of the horizon by which that of an upper bound is longer, of a lower bound shorter


def rise(y: Array) -> Array:
    """A C^2 step from 0 at 0 to 1 at 1, odd about 0, where it is steepest."""
    z = np.clip(y, -1, 1)
    return np.asarray(z * (15 - 10 * z**2 + 3 * z**4) / 8)


def _across(marked: Mask, axis: int, dimension: int) -> tuple[slice | Mask, ...]:
    """An index of what is marked along one axis."""
    return tuple(marked if k == axis else slice(None) for k in range(dimension))


def _common(axes: tuple[Axis, ...], others: tuple[Axis, ...]) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """The cells that two grids with nodes in common share, in each of them."""
    own: list[slice] = []
    places: list[slice] = []
    for axis, other in zip(axes, others):
        low, high = max(axis.nodes[0], other.nodes[0]), min(axis.nodes[-1], other.nodes[-1])
        for line, parts in ((axis.nodes, own), (other.nodes, places)):
            parts.append(slice(int(np.searchsorted(line, low)), int(np.searchsorted(line, high))))
    return tuple(own), tuple(places)


def _largest_around(cells: Array) -> Array:
    """The largest of each cell and its neighbours."""
    from scipy.ndimage import maximum_filter

    return np.asarray(maximum_filter(cells, 3))


def _wider(shape: Size, factor: float, places: Array) -> Array:
    return factor * shape(places)


def _small(row: Array) -> bool:
    return bool(np.all(np.abs(row) < _LARGEST))


def _lasting(slabs: Sequence[Array]) -> list[Array]:
    """What is asked for in each slab, and a share of what is in those before and after it."""
    result = list(slabs)
    for _ in ("later", "earlier"):
        for k in range(1, len(result)):
            result[k] = np.maximum(result[k], _LASTING * result[k - 1])
        result.reverse()
    return result


def _nothing(part: float) -> float:
    return 0.0


def _between(first: Array, last: Array, part: float) -> Array:
    return (1 - part) * first + part * last


def _same(value: Array | float, part: float) -> Array | float:
    return value


def _later(given: Callable[[float], Array | float], begin: float, step: float, part: float) -> Array | float:
    return given(begin + part * step)


def _generator(setting: Setting, axes: tuple[Axis, ...]) -> Generator:
    return Generator.of(axes, *((one.drift.on(axes, ALWAYS), one.square.on(axes, ALWAYS)) for one in setting.operators))


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
    longest : callable
        The longest step at each time before the end.
    above : bool
        From above or from below.
    later : Side, optional
        Of the stage after this one.
    plan : (nodes, grazing), optional
        Of `plan_axes`, where there are several stages.
    """

    def __init__(
        self, setting: Setting, cell: Array, longest: Size, above: bool, later: Side | None = None,
        plan: Plan | None = None,
    ) -> None:  # fmt: skip
        self.setting, self.above, self.later, self.cell = setting, above, later, cell
        row = self.row = 0 if above else 1
        span = setting.horizon - setting.begin
        self.layer = END * float(np.mean(cell)) * span
        nodes, grazing = plan or plan_axes([setting], cell, row)[0]
        fresh = np.ones((2, len(nodes)), dtype=bool)
        if later is not None:
            after = later.setting
            fresh = np.array([after.low[row] != setting.low[row], after.high[row] != setting.high[row]])
        self.axes = tuple(Axis(line, Sampling(_DEGREES[setting.dimension])) for line in nodes)
        self.shapes = Shapes.of(setting.shapes, self.axes)
        self.mesh = mesh_of(
            setting, nodes, grazing, row, pad=(0, 0) if above else (_STRIP, 0), kill=above, span=self.layer,
            fresh=fresh, early=not above, shaped=True,
        )  # fmt: skip
        self.carrier = mesh_of(
            setting, nodes, grazing, row, pad=(_STRIP, _PAD), span=self.layer, fresh=fresh, solved=ABOUT,
            failed=self.shapes.failed,
        )  # fmt: skip
        longer = 1 + (_CLOCK if above else -_CLOCK)  # the sum of the steps is rounded
        self.steps = self.steps_of(longest) * longer
        self._follow_changes(longest)
        passed = np.cumsum(self.steps) - self.steps
        self.free = self.steps >= _FREE * longest(passed)
        self.free[-1] = True
        self.maps = [axis.from_nodes(line) for axis, line in zip(self.axes, self.mesh.nodes)]
        self.carried_maps = [axis.from_nodes(line) for axis, line in zip(self.axes, self.carrier.nodes)]
        n, noisy = setting.dimension, setting.noisy
        slabs = self._slabs() if setting.timed else ALWAYS
        every = [Interval(a, b) for a, b in setting.disturbance.T]
        self.faces = [
            face_of(
                self.axes, setting.drift, noisy[i], i, side, self._goal(bool(setting.limited[side, i])), slabs, every
            )
            for i in range(n) for side in (0, 1)
        ]  # fmt: skip
        self.arrived = self._cells_arrived(setting)
        self.stopped = self.arrived | self.shapes.failed
        self.faces = [self._among_live(face) for face in self.faces if not setting.around[face.side, face.axis]]
        if self.arrived.any():
            self.faces += self._target_faces()
        self.values: list[Array] = []
        self.rates: list[Array] = []
        self.policy: list[Index | None] = []
        self.passes = 0
        self.best: Best | None = None

    @cached_property
    def generator(self) -> Generator:
        """L on the axes."""
        return _generator(self.setting, self.axes)

    @cached_property
    def sketch(self) -> Generator:
        """The same with fewer points on a cell."""
        return _generator(self.setting, tuple(Axis(axis.nodes, Sampling(_SKETCH)) for axis in self.axes))

    def steps_of(self, longest: Size) -> Array:
        """Steps that grow from the layer at the end on, where no break of the clock is in their way."""
        return time_steps(self.setting.horizon - self.setting.begin, self._growing(longest), self.setting.dimension)

    def _growing(self, longest: Size) -> Size:
        return growing_steps(self.layer, longest, self.setting.dimension)

    def follow(self, k: int) -> None:
        """Set the equation of the carried error to knot ``k``."""
        self._now(self.carrier, k)

    def on(self, shapes: Sequence[Size], longest: Size) -> Side:
        """The same side, of the only stage, on axes and steps of other shapes, and with about as much work.

        Shapes leave out what limits that paths graze want besides; the other cells make room for it.
        """
        wanted = np.prod([axis.cells for axis in self.axes]) * len(self.steps) / len(self.steps_of(longest))
        wider = 1.0
        for _ in range(_MAKING_ROOM):
            scaled = [partial(_wider, shape, wider) for shape in shapes]
            plan = plan_axes([self.setting], self.cell, self.row, scaled)[0]
            over = float(np.prod([len(line) - 1 for line in plan[0]]) / wanted)
            wider *= max(over, 1.0) ** (1 / self.setting.dimension)
        return Side(self.setting, self.cell, longest, self.above, plan=plan)

    @property
    def begun(self) -> bool:
        """Whether the next source is about the residual, and may come from one that is not proved."""
        return self.passes == 0

    @property
    def steady(self) -> bool:
        """Whether all sources from now on are above the residual."""
        return self.passes >= len(BREADTHS)

    def _cells_arrived(self, setting: Setting) -> Mask:
        """Cells within the target of a stage, whose faces stand on nodes."""
        shape = tuple(axis.cells for axis in self.axes)
        if setting.target is None:
            return np.zeros(shape, dtype=bool)
        result = np.ones(shape, dtype=bool)
        for k, axis in enumerate(self.axes):
            low, high = setting.target[:, self.row, k]
            own = (axis.nodes[:-1] >= low) & (axis.nodes[1:] <= high)
            result &= own.reshape([-1 if j == k else 1 for j in range(len(self.axes))])
        return result

    def _among_live(self, face: Face) -> Face:
        """A face of the box without its cells in which paths have stopped."""
        there = np.take(self.stopped, -1 if face.side else 0, axis=face.axis)
        return replace(face, leaves=face.leaves & ~there)

    def _target_faces(self) -> list[Face]:
        """Faces of the target within the box, at which v is to be at least 0."""
        result = []
        for k, axis in enumerate(self.axes):
            along = np.flatnonzero(self.arrived.any(axis=tuple(j for j in range(len(self.axes)) if j != k)))
            leaves = np.asarray(self.arrived.any(axis=k))
            for side, place in ((0, int(along[0])), (1, int(along[-1]) + 1)):
                if 0 < place < axis.cells:
                    result.append(Face(axis=k, side=side, leaves=leaves, goal=0.0, place=place))
        return result

    def _follow_changes(self, longest: Size) -> None:
        """Knots, and what is known of the factors between them, where the generator changes."""
        setting, begin, horizon = self.setting, self.setting.begin, self.setting.horizon
        self.brief = np.zeros(len(self.steps), dtype=bool)  # slabs about breaks: too short to be carried
        self.clock: Array | None = None
        self.times = horizon - np.append(0.0, np.cumsum(self.steps))
        if setting.timed or setting.staged:  # a stage is as long as it is
            self.times = knots_of(begin, horizon, self._growing(longest), self.layer, setting.breaks, setting.dimension)
            self.steps = -np.diff(self.times)
            self.brief = self.steps < 4 * HALF * horizon
            self.clock = 2 * CLOCK * horizon / self.steps
        self.factors = [
            None
            if one.factor is None
            else factor_of(one.factor, self.times, (begin, horizon), setting.nodes, setting.gaps)
            for one in setting.operators
        ]
        if setting.changing:  # that no factor hides where the model is undefined
            ends = [axis.nodes for axis in self.axes]
            lines = [np.meshgrid(*rows, indexing="ij", sparse=True) for rows in zip(*((e[:-1], e[1:]) for e in ends))]
            cells = [Interval(low, high) for low, high in zip(*lines)]
            whole = Interval(begin, horizon)
            enclose(setting.drift.tape, [whole, *cells, *(Interval(a, b) for a, b in setting.disturbance.T)])
            enclose(setting.square.tape, [whole, *cells])

    def _slabs(self) -> Interval:
        """Times that hold the slabs."""
        horizon = self.setting.horizon
        off = CLOCK * horizon
        low, high = self.times[1:] - off, self.times[:-1] + off
        return Interval(np.maximum(low, self.setting.begin), np.minimum(high, horizon))

    def _now(self, mesh: Mesh, k: int, a: Array | None = None) -> None:
        """Set an equation to knot ``k``; with the survival ``a``, choose the worst disturbances there from it."""
        equation, setting = mesh.equation, self.setting
        if not isinstance(equation, ChangingEquation):
            return
        n, time = setting.dimension, float(self.times[k])
        if a is not None and len(self.policy) == k:
            self.policy.append(self._worst(mesh, time, a) if len(setting.nodes) > 1 else None)
        chosen = self.policy[k]
        if chosen is not None and chosen.shape != equation.shape:
            around = [(p - q, r - s) for (p, r), (q, s) in zip(mesh.pad, self.mesh.pad)]
            chosen = np.pad(chosen, around, mode="edge")
        acting = setting.nodes[0] if chosen is None else np.moveaxis(setting.nodes[chosen], -1, 0)

        def coefficients(time: float) -> tuple[Array, Array]:
            spread = setting.spread(mesh.inside, time).reshape(n, n, *equation.shape)
            live = 1.0 if mesh.ghosts is None else ~mesh.ghosts.nodes
            return setting.flow(mesh.inside, time, acting) * live, spread * live

        equation.now(time, coefficients)

    def _worst(self, mesh: Mesh, time: float, a: Array) -> Index:
        """Of the disturbances' nodes, at each node of the mesh, the one that lowers survival most."""
        slopes = np.gradient(a, *mesh.nodes)
        loss = [
            -sum(f * slope for f, slope in zip(self.setting.flow(mesh.inside, time, acting), slopes))
            for acting in self.setting.nodes
        ]
        return np.asarray(np.argmax(loss, axis=0), dtype=np.intp)

    @property
    def stages(self) -> list[Side]:
        """This side and those of the stages after it."""
        return [self, *([] if self.later is None else self.later.stages)]

    @property
    def work(self) -> int:
        """Cells of space and time of this and later stages, each as often as it costs one of a model that does not
        change."""
        return self.own_work + (0 if self.later is None else self.later.work)

    @property
    def own_work(self) -> int:
        """The same of this stage alone."""
        times = _OFTEN[0] + _OFTEN[1] * len(self.setting.nodes) if self.setting.changing else 1.0
        return int(times * np.prod([axis.cells for axis in self.axes]) * len(self.steps))

    @property
    def finite(self) -> bool:
        """Whether every coefficient is a number that no derivative overflows with: nothing is proved of others."""
        return all(_small(row) for rows in (self.values, self.rates) for row in rows)

    def _goal(self, limit: bool) -> float:
        return 1.0 if self.above else -1.0 if limit else 0.0

    def shortfalls(self) -> list[Array]:
        """What v lacks at every face where paths can leave, shapes (slabs, face cells)."""
        values, rates = np.array(self.values), np.array(self.rates)
        return [shortfall(self.axes, face, values, rates, self.steps) for face in self.faces]

    def shortfall_at_end(self) -> Array:
        """On every cell, what v at the stage's end lacks of 0, of what a limit that is due asks, or of the next v."""
        lacks = most_on_cells(self.axes, -self.values[0][None])[0]
        lacks[self.shapes.cut] = most_kept(self.axes, self.shapes, -self.values[0])
        if self.later is not None:
            own, places = _common(self.axes, self.later.axes)
            open_ = lacks + (1.0 if self.above else 0.0)  # beyond ends of the next stage that are no limits
            difference = most_of_difference(
                self.axes, self.later.axes, self.values[0], self.later.values[-1], own, places
            )  # fmt: skip
            beyond = self._cells_beyond(self.later.setting, limits=True)
            lost = lacks + self._goal(True)
            lacks = open_
            lacks[own] = difference
            lacks[beyond] = lost[beyond]
        due = self._cells_beyond(self.setting, limits=False)
        if due.any():
            lacks[due] = (most_on_cells(self.axes, -self.values[0][None])[0] + self._goal(True))[due]
        if self.later is not None:
            arrived = self._cells_arrived(self.later.setting)  # there the next v may be anything
            lacks[arrived] = most_on_cells(self.axes, -self.values[0][None])[0][arrived]
        lacks[self.stopped] = 0.0
        return np.asarray(np.maximum(lacks, 0.0))

    def shortfall_on_edges(self) -> Array:
        """What v lacks of its goal where paths leave shapes, shape (slabs, cells that they cut)."""
        values, rates = np.array(self.values), np.array(self.rates)
        return shortfall_on(self.axes, self.shapes, self._goal(True), values, rates, self.steps)

    def lacking(self) -> float:
        """The most that v lacks at the end and at faces where paths can leave."""
        missing = [self.shortfall_at_end(), *self.shortfalls(), self.shortfall_on_edges()]
        return max(float(one.max(initial=0.0)) for one in missing)

    def lift(self, share: float) -> None:
        """Raise v from above by a share of itself: nothing is asked any more where it was nearly 1."""
        for rows in (self.values, self.rates):
            rows[:] = [(1 + share) * row for row in rows]

    def remember(self, value: float, bound: float) -> None:
        """Keep the coefficients as they are now where they prove more than before."""
        if self.best is None or bound < self.best.bound:  # later passes replace the arrays and do not change them
            self.best = Best(value=value, bound=bound, values=list(self.values), rates=list(self.rates))

    def _cells_beyond(self, setting: Setting, limits: bool) -> Mask:
        """Cells beyond a limit of a stage, or beyond one that is due at its end; both stand on nodes."""
        result = np.zeros(tuple(axis.cells for axis in self.axes), dtype=bool)
        for k, axis in enumerate(self.axes):
            low, high = setting.due_low[self.row, k], setting.due_high[self.row, k]
            if limits:
                low, high = (
                    ends[self.row, k] if there else far for ends, there, far in
                    zip((setting.low, setting.high), setting.limited[:, k], (-np.inf, np.inf))
                )  # fmt: skip
            out = (axis.nodes[1:] <= low) | (axis.nodes[:-1] >= high)
            result |= out.reshape([-1 if j == k else 1 for j in range(len(self.axes))])
        return result

    def _handed_over(self) -> Array:
        """Survival at the stage's end at the mesh's nodes: that of the next stage, softly cut where a limit is due."""
        n, shape = len(self.axes), self.mesh.equation.shape
        lines = [np.clip(line, axis.nodes[0], axis.nodes[-1]) for line, axis in zip(self.mesh.nodes, self.axes)]
        a = np.ones(shape)
        if self.later is not None:
            v, setting = self.later.values[-1], self.later.setting
            for k, (line, axis) in enumerate(zip(lines, self.later.axes)):
                v = axis.at_points(np.clip(line, axis.nodes[0], axis.nodes[-1]), 0).along(v, k)
            a = np.ascontiguousarray(1 - v if self.above else 1 + v)
            for beyond_limits in (False, True):
                for k, line in enumerate(lines):
                    for side, end in enumerate((setting.low[self.row, k], setting.high[self.row, k])):
                        if setting.limited[side, k] == beyond_limits:
                            out = (2 * side - 1) * (line - end) > 0
                            given = 0.0 if beyond_limits or self.above else 1.0
                            a[_across(out, k, n)] = given
        for k, line in enumerate(lines):
            for side, rows in enumerate((self.setting.due_low, self.setting.due_high)):
                end = rows[self.row, k]
                if np.isfinite(end):
                    width = self._soft(k, float(end))
                    within = (1 - 2 * side) * (line - end) / width
                    a = a * ramp(within if self.above else 1 + within).reshape([-1 if j == k else 1 for j in range(n)])
        return a

    def _soft(self, k: int, end: float) -> float:
        """How far a limit that is due reaches: what noise smooths within the layer, and three cells."""
        axis = self.axes[k]
        place = int(np.clip(np.searchsorted(axis.nodes, end), 3, axis.cells - 3))
        cells = float(axis.nodes[place + 3] - axis.nodes[place - 3]) / 2
        spread = self.setting.spread(self.mesh.inside, self.setting.horizon)[k * len(self.axes) + k]
        return max(cells, float(np.sqrt(max(np.median(spread), 0.0) * self.layer)))

    def _until_resolved(self) -> Array:
        """At the mesh's nodes: how long before the end exits begin to be counted, from below.

        At a limit the solution has a layer as wide as paths diffuse by then, and cells that are wider than it leave
        more residual than these exits are worth.
        """
        setting, lines, n = self.setting, self.mesh.nodes, len(self.axes)
        noise, flow = (of(self.mesh.inside, setting.horizon) for of in (setting.spread, setting.flow))
        span = np.full(self.mesh.equation.shape, self.layer)
        for i in np.flatnonzero(setting.noisy):
            for side in np.flatnonzero(setting.limited[:, i]):
                face = tuple(slice(-1 if side else 0, None if side else 1) if k == i else slice(None) for k in range(n))
                gap = lines[i][-1] - lines[i][-2] if side else lines[i][1] - lines[i][0]
                out = np.maximum((2 * side - 1) * flow[i][face], 0.0)
                crossed = noise[i * n + i][face] / (_RESOLVED * gap**2) + out / (np.sqrt(_RESOLVED) * gap)
                span[face] = np.maximum(span[face], 1 / np.maximum(crossed, 1e-300))
        return np.asarray(np.minimum(span, setting.horizon - setting.begin))

    def propose(self) -> None:
        """Solve for the survival A; v is 1 - A from above, A - 1 from below."""
        equation, above, limit = self.mesh.equation, self.above, self.mesh.falls
        span = self.layer if above else self._until_resolved()
        longest = np.max(span)

        def fall(tau: float) -> Array | float:
            if above or tau >= longest:
                return 0.0
            passed = np.minimum(tau / span, 1.0)
            return np.asarray(-30 * (passed * (1 - passed)) ** 2 / span * limit * first)

        self.values, self.rates, self.policy, self.passes = [], [], [], 0
        a = self._handed_over()
        a = a * self.mesh.layer if above else a
        first = a.copy()
        tau = 0.0

        def kept(a: Array) -> None:
            speed = equation.speed(a, arrival, fall(tau))
            self._keep(a, speed if ghosts is None else ghosts.fill(speed))

        arrival, ghosts = self.mesh.arrival, self.mesh.ghosts
        if ghosts is not None:
            a = ghosts.fill(a * rise((distance_to(ghosts.nodes) - 0.5) / DEEP))
        self._now(self.mesh, 0, a)
        kept(a)
        for k, step in enumerate(self.steps):
            poll("solving the backward equation")
            if not self.brief[k]:
                a = equation.step(a, step, partial(_same, arrival), partial(_later, fall, tau, step))
                a = a if ghosts is None else ghosts.fill(a)
            tau += step
            self._now(self.mesh, k + 1, a)
            kept(a)

    def _keep(self, a: Array, speed: Array) -> None:
        sign = -1.0 if self.above else 1.0
        self.values.append(sign * (apply_dense(self.maps, a) - 1))
        self.rates.append(-sign * apply_dense(self.maps, speed))

    def residuals(self, rough: bool = False, final: Iterable[int] = ()) -> list[Array]:
        """A bound of v_t + L v on every cell, slab by slab from the end backward; ``rough`` about that, and quicker.

        ``final`` are knots up to which v will not change any more: slabs between them are bounded while it goes on.
        """
        found = self._over_slabs(rough, final)
        return [np.add.reduce(one) for one in found] if rough else found

    def rough_parts(self) -> list[Array]:
        """About the residuals at knots and what is more of them in between, shape (2, N_1, ...), slab by slab."""
        return self._over_slabs(True, ())

    def _over_slabs(self, rough: bool, final: Iterable[int]) -> list[Array]:
        count = len(self.steps)
        lattice = int(np.prod([axis.sampling.parts for axis in (self.sketch if rough else self.generator).axes]))
        many = max(1, _BATCH * count // (lattice * self.own_work))
        same = all(one is None for one in self.factors)
        _ = (self.sketch, rough or self.generator)  # what the threads share
        if same:
            _ = (self.sketch.images, rough or self.generator.images)
        begun, knots, slabs = 0, list[Future[Array]](), list[Future[list[Array]]]()
        with ThreadPoolExecutor(2) as pool:
            try:
                for k in final or [count]:
                    while begun < count and k >= min(begun + many, count):
                        end = min(begun + many, count)
                        if same and not rough:
                            knots.append(pool.submit(self._at_knots, slice(begun + (begun > 0), end + 1)))
                        slabs.append(pool.submit(self._bounded, rough, slice(begun, end), knots[-2:]))
                        begun = end
                bounds: list[Array] = []
                for part in slabs:
                    bounds += part.result()
                    poll("bounding what a solution leaves")
            except OutOfTime:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
        return bounds if begun == count else []

    def _at_knots(self, some: slice[int, int, int]) -> Array:
        return most_at_knots(self.generator, np.array(self.values[some]), np.array(self.rates[some]))

    def _bounded(self, rough: bool, some: slice[int, int, int], proved: Sequence[Future[Array]] = ()) -> list[Array]:
        """Of some slabs; what is ``proved`` at knots ends with theirs."""
        steps = self.steps[some]
        values, rates = (np.array(rows[some.start : some.stop + 1]) for rows in (self.values, self.rates))
        factors = [None if one is None else one.on(some) for one in self.factors]
        clock = None if self.clock is None else self.clock[some]
        if rough:
            bound = np.stack(rough_residual(self.sketch, values, rates, steps, factors, worst=self.above), axis=1)
        else:
            knots = np.concatenate([one.result() for one in proved])[-len(values) :] if proved else None
            bound = residual_bound(
                self.generator, self.sketch, values, rates, steps, factors, worst=self.above, clock=clock, knots=knots
            )
        done = self._decided(values, rates, steps) | self.stopped
        return list(np.where(done[:, None] if rough else done, 0.0, np.maximum(bound, 0.0)))

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
        for _ in self._corrected(residuals):
            pass

    def corrected(self, residuals: list[Array]) -> list[Array]:
        """The same; and the residuals that the sum leaves, proved slab by slab while e is being solved for.

        Of a sum that is not finite there are none.
        """
        return self.residuals(final=self._corrected(residuals))

    def _corrected(self, residuals: list[Array]) -> Iterator[int]:
        """Correct v from the end backward: the knots after which it is final, while they are finite."""
        equation, breadth = self.carrier.equation, BREADTHS[min(self.passes, len(BREADTHS) - 1)]
        paying = breadth is Breadth.ABOVE
        margin = _MARGIN[paying + (self.passes > len(BREADTHS))]
        spread = partial(at_nodes, pads=self.carrier.pad, breadth=breadth)
        residuals = [np.zeros_like(r) if brief else r for r, brief in zip(residuals, self.brief)]
        if paying:
            residuals = _lasting(residuals)
        slabs = [spread(r) + b for r, b in zip(residuals, self._at_exits(spread, breadth))]
        ends = [(1 + margin) * s * equation.live for s in at_knots(slabs, self.steps, breadth)]
        late = self.shortfall_at_end()
        late[self.shapes.cut] = np.maximum(late[self.shapes.cut], self.shortfall_on_edges()[0])
        errors = self._errors(ends, (1 + margin) * spread(late) * equation.live)
        if self.passes >= _CALM[self.setting.dimension]:
            errors = self._calmed(errors)
        self.passes += 1
        sound = True
        for k, (e, speed) in enumerate(errors):
            self.values[k] = self.values[k] + apply_dense(self.carried_maps, e)
            self.rates[k] = self.rates[k] - apply_dense(self.carried_maps, speed)
            sound = sound and _small(self.values[k]) and _small(self.rates[k])
            if sound:
                yield k

    def _errors(self, ends: Sequence[Array], missing: Array) -> Iterator[tuple[Array, Array]]:
        """e and -e_t at the knots from the end backward; ``ends`` holds sources there."""
        equation = self.carrier.equation
        self._now(self.carrier, 0)
        e = equation.solve(self.steps[0], missing + self.steps[0] * ends[0])
        yield e, equation.speed(e, ends[0])
        for k, step in enumerate(self.steps):
            poll("solving for the error that is left")
            if not self.brief[k]:
                e = equation.step(e, step, partial(_between, ends[k], ends[k + 1]), _nothing)
            self._now(self.carrier, k + 1)
            yield e, equation.speed(e, ends[k + 1])

    def _calmed(self, errors: Iterable[tuple[Array, Array]]) -> Iterator[tuple[Array, Array]]:
        """Rates of change of e that are divided differences in time where paths leave many cells within a step.

        There e follows its source at once. The rate that the equation gives is a difference of two numbers that are
        larger by the number of cells, and so is its error; a cubic in time that has this rate overshoots by as much.
        """
        before: tuple[Array, float] | None = None  # the mean rate of the slab before, and its length
        for k, ((e, speed), (after, _)) in enumerate(pairwise(chain(errors, [(np.zeros(()), np.zeros(()))]))):
            step = float(self.steps[k]) if k < len(self.steps) else 0.0
            mean = (after - e) / step if step else None
            longest = max(step, before[1] if before else 0.0)
            if before is None or mean is None:
                slope = mean if mean is not None else before[0] if before is not None else speed
            else:
                slope = (before[1] * mean + step * before[0]) / (before[1] + step)
            share = ramp(np.log10(self.carrier.leaving * longest + 1e-300) - _MANY)
            yield e, speed + share * (slope - speed)
            before = None if mean is None else (mean, step)

    def _at_exits(self, spread: Callable[..., Array], breadth: Breadth) -> list[Array]:
        """Sources beyond the faces and on them, from which e takes what v lacks there, slab by slab.

        Beyond a face e is killed at a rate, and held near what v lacks by as large a source. Paths that graze a
        noise-free face hardly get there: a source on the face itself raises e while they are about it.
        """
        carrier = self.carrier
        total = [np.zeros(carrier.equation.shape) for _ in self.steps]
        if len(self.shapes.cut[0]):
            lacks, none = np.zeros(self.shapes.failed.shape), [(0, 0)] * len(self.axes)
            for k, one in enumerate(self.shortfall_on_edges()):
                lacks[self.shapes.cut] = one
                around = at_nodes(_largest_around(np.pad(lacks, carrier.pad, mode="edge")), none, breadth)
                held = _REACHED * around * carrier.rate
                on_edge = _ON_FACE * spread(lacks) * carrier.leaving if self.passes > 1 else 0.0
                total[k] = np.maximum(held, on_edge)
        for face, missing in zip(self.faces, self.shortfalls()):
            if not missing.any():
                continue
            pad, length = carrier.pad[face.axis][face.side], carrier.equation.shape[face.axis]
            beyond = slice(length - pad, length) if face.side else slice(0, pad)
            at = slice(length - pad - 1, length - pad) if face.side else slice(pad, pad + 1)
            if face.place is not None:
                first = face.place + carrier.pad[face.axis][0]
                beyond = slice(0, first + 1) if face.side else slice(first, length)
            place, on = (
                tuple(part if k == face.axis else slice(None) for k in range(len(self.axes))) for part in (beyond, at)
            )
            for k, one in enumerate(missing):
                if one.any():
                    around = spread(np.expand_dims(one, face.axis), skip=face.axis)
                    total[k][place] = np.maximum(total[k][place], _REACHED * around * carrier.rate[place])
                    if not self.setting.noisy[face.axis] and face.place is None:
                        total[k][on] = np.maximum(total[k][on], _ON_FACE * around * carrier.leaving[on])
        return total
