"""What the engine needs of a problem: its model as tapes and in floats, its box, and where paths go."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.goals import until
from certbound.problem.model import JUMPS, Graph, Tape, compile_numpy, sources
from certbound.problem.problem import Problem
from certbound.problem.sets import GaussianStart, Inside, Region
from certbound.problem.systems import ContinuousSystem
from certbound.values.enclosing import squared_diffusion
from certbound.values.kolmogorov.cell_fields import Fields
from certbound.values.kolmogorov.factors import HALF, clock_breaks, disturbance_nodes, pace_of
from certbound.values.kolmogorov.failed_cells import Places, ends_of, limits_and_shapes, places_of
from certbound.values.kolmogorov.products import Product, separated
from certbound.values.room import limits_among, refuse_windows
from certbound.values.sets import as_stays

_PATHS, _STEPS, _EVERY = 2000, 400, 10
_RARE = 2e-4  # share of the visits that lies beyond the range on either side
_NARROWEST = 0.1  # of the room between limits: the narrowest range
_AT_REST = 1e-3  # of its size, of 1 at 0: the same where there is a limit on one side at most
_MARGIN = 0.4  # of the range, beyond it, where no limit stands
_DEVIATIONS = 3.5  # of a normal start, which belong to the range
_MOMENTS = 7  # times at which an axis looks at a model that changes
_USUAL_STEPS = 40.0  # over the horizon where nothing changes with time, on the coarsest grid

Flow = Callable[..., Array]
"""Of points, shape (n, ...), a time, and disturbances, shape (m, ...) or (m,), to outputs, shape (outputs, ...)."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Operator:
    """One product of the generator: the factor c(t, d), None for 1, and the drift and squared noise that it has."""

    factor: Tape | None
    drift: Fields
    square: Fields


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Setting:
    """A problem in a box: dX = f(t, X, d) dt + g(t, X) dW, limits along the coordinates, one start set.

    Where limits are due in windows, it is one of the stages between the times at which they change.

    Attributes
    ----------
    drift, square : Fields
        Of f and of a = g g'.
    operators : tuple of Operator
        The same as a sum of products of functions of (t, d) and of x.
    disturbance : ndarray, shape (2, m)
        Ends of the box of d.
    nodes, gaps : ndarray, shapes (V, m) and (m,)
        Those d that stand for all, and what lies between them (`disturbance_nodes`).
    breaks : ndarray
        Times at which the clock makes the model jump or bend, about.
    timed : bool
        Whether the model changes with time.
    pace : float
        How many times more steps the model's changes in time ask for than a model that does not change.
    varies : tuple of bool
        Whether f_i or a_ii changes with time.
    low, high : ndarray, shape (2, n)
        Ends of the box: of the safe set rounded inward (row 0) and outward (row 1); where no limit stands, ends that
        paths hardly reach.
    limited : ndarray of bool, shape (2, n)
        Whether the lower and the upper end of a coordinate is a limit.
    noisy : tuple of bool
        Whether noise moves a coordinate at all.
    range : ndarray, shape (2, n)
        Between these ends paths spend nearly all their time.
    start_low, start_high : ndarray, shape (starts, n)
        A box around each start set.
    begin, horizon : float
        The times between which it is meant.
    staged : bool
        Whether there are more stages, or limits that are due at the end alone.
    due_low, due_high : ndarray, shape (2, n)
        Limits that are due at the end of the stage alone, rounded as ``low`` and ``high``; infinite for none.
    target : ndarray, shape (2, 2, n), or None
        Lower and upper ends of the target, rounded as ``low`` and ``high``: a path that is in it has not failed.
    shapes : tuple of Inside
        Obstacles and safe sets that are no limits along the coordinates.
    places : Places
        Where nodes serve these.
    around : ndarray of bool, shape (2, n)
        Whether the lower and the upper end of a coordinate is that of a box around such a safe set.
    """

    drift: Fields
    square: Fields
    operators: tuple[Operator, ...]
    disturbance: Array
    nodes: Array
    gaps: Array
    breaks: Array
    timed: bool
    pace: float
    varies: tuple[bool, ...]
    low: Array
    high: Array
    limited: Array
    noisy: tuple[bool, ...]
    range: Array
    start_low: Array
    start_high: Array
    begin: float
    horizon: float
    staged: bool
    due_low: Array
    due_high: Array
    target: Array | None
    shapes: tuple[Inside, ...]
    places: Places
    around: Array
    flow: Flow
    spread: Flow

    @property
    def dimension(self) -> int:
        """Number of states n."""
        return len(self.noisy)

    @property
    def changing(self) -> bool:
        """Whether the generator is more than one operator that lasts."""
        return len(self.operators) > 1 or self.operators[0].factor is not None

    @property
    def torn(self) -> bool:
        """Whether the drift jumps somewhere and disturbances act: nothing is said of the worst of these then."""
        jumps = any(node.op in JUMPS or node.op == "atan2" for one in self.operators for node in one.drift.tape.nodes)
        return len(self.nodes) > 1 and jumps

    def moments(self, axis: int | None = None) -> Array:
        """Times at which f_i or a_ii (or any of them) is looked at."""
        changes = any(self.varies) if axis is None else self.varies[axis]
        return np.linspace(self.begin, self.horizon, _MOMENTS) if changes else np.zeros(1)


def stages_of(problem: Problem) -> list[Setting]:
    """Read a problem: one setting for each stage of time between changes of its limits, in their order.

    Raises
    ------
    InfeasibleError
        What is not served yet: moving sets, obstacles in windows, starts that meet the target, models in which time
        or disturbances are not apart from the states; the message says which.
    """
    system = problem.system
    if not isinstance(system, ContinuousSystem):
        raise InfeasibleError("values with a carried error need continuous time here; the problem is discrete.")
    served = {
        "a plan that is an array": problem.input_sequence is None,
        "an infinite horizon": not problem.endless, "paths that end as they leave the domain": not problem.ending,
    }  # fmt: skip
    missing = [name for name, there in served.items() if not there]
    if missing:
        raise InfeasibleError(f"values with a carried error do not serve {missing[0]} yet.")
    n = system.dimension
    problem, target, opens = _with_target(problem)
    horizon = float(problem.horizon)
    limits, shapes = limits_and_shapes(as_stays(problem.constraints), n)
    if shapes and n > 2:
        raise InfeasibleError(
            f"values with a carried error serve in {n} states limits along the coordinates only, "
            f"not '{shapes[0].label}'."
        )
    for one in shapes:
        refuse_windows(one, problem)
    if shapes and any(isinstance(start, GaussianStart) for start in problem.starts):
        raise InfeasibleError("values with a carried error serve normal starts among limits along coordinates only.")
    ends, rooms, dues = _windows(problem, limits, opens)
    within = ends_of(shapes, n)
    rooms = [(np.maximum(low, within[0]), np.minimum(high, within[1])) for low, high in rooms]
    if target is not None:
        due = dues[-1]
        dues[-1] = target if due is None else (np.maximum(due[0], target[0]), np.minimum(due[1], target[1]))
    square = squared_diffusion(system.diffusion, system.states)
    fields = (Fields(problem.closed_loop, n), Fields(square, n))
    box = system.disturbance
    around = np.zeros((2, 0)) if box is None else np.array([box.low, box.high], dtype=float)
    operators = _operators(problem.closed_loop, square, fields, n)
    factors = [one.factor for one in operators if one.factor is not None]
    nodes, gaps = disturbance_nodes(factors, *around)
    timed = not all(one.autonomous for one in fields)
    middle = around.mean(axis=0)
    pace = max(1.0, 1 / (_USUAL_STEPS * pace_of(factors, horizon, middle))) if timed else 1.0
    read = [*sources(problem.closed_loop), *sources(square)]
    start_low, start_high = (np.array(rows) for rows in zip(*(_around(start) for start in problem.starts)))
    flow, spread = _InFloats(problem.closed_loop, middle), _InFloats(square)
    lows, highs = (np.array([room[side] for room in rooms]) for side in (0, 1))  # (stages, rows, n)
    limited = np.stack([np.isfinite(lows[:, 0]), np.isfinite(highs[:, 0])], axis=1)
    hit = None if opens else target
    visited = _visited(problem, start_low, start_high, ends, lows[:, 0], highs[:, 0], flow, around, hit, shapes)
    width = visited[:, 1] - visited[:, 0]
    free = [
        _beside((visited[:, 0] - _MARGIN * width).min(axis=0), lows, width.max(axis=0)),
        _beside((visited[:, 1] + _MARGIN * width).max(axis=0), highs, width.max(axis=0)),
    ]
    nowhere = np.full((2, n), np.inf)
    breaks = clock_breaks([problem.closed_loop, square], horizon) if timed else np.zeros(0)
    near = 4 * HALF * horizon
    return [
        Setting(
            drift=fields[0], square=fields[1], operators=operators, disturbance=around, nodes=nodes, gaps=gaps,
            breaks=breaks[(breaks > begin + near) & (breaks < end - near)], timed=timed, pace=pace,
            varies=tuple(0 in read[k] | read[n + k * n + k] for k in range(n)),
            low=np.where(limited[k, 0], lows[k], free[0]), high=np.where(limited[k, 1], highs[k], free[1]),
            limited=limited[k],
            noisy=tuple(fields[1].present[k * n + k] for k in range(n)), range=visited[k],
            start_low=start_low, start_high=start_high, begin=begin, horizon=end,
            staged=len(rooms) > 1 or dues[-1] is not None,
            due_low=-nowhere if due is None else due[0], due_high=nowhere if due is None else due[1],
            target=None if target is None or begin < opens else np.array(target), shapes=tuple(shapes),
            places=places_of(shapes, n), around=limited[k] & [lows[k, 0] == within[0], highs[k, 0] == within[1]],
            flow=flow, spread=spread,
        )
        for k, (begin, end, due) in enumerate(zip(ends[:-1], ends[1:], dues))
    ]  # fmt: skip


Ends = tuple[Array, Array]
"""Lower and upper ends of boxes, shapes (2, n): rounded inward (row 0) and outward (row 1)."""


def _with_target(problem: Problem) -> tuple[Problem, Ends | None, float]:
    """The problem up to the time when its target no longer counts, the target's ends, and from when on it counts."""
    target, horizon = problem.reach, float(problem.horizon)
    if target is None:
        return problem, None, 0.0
    first, last = target.during or (0.0, horizon)
    plain = until(problem, last)
    ends = _ends(plain, [Inside(target.region, label=target.label)])
    for start in plain.starts:
        low, high = _around(start)
        if first == 0 and (isinstance(start, GaussianStart) or np.all((high >= ends[0][1]) & (low <= ends[1][1]))):
            raise InfeasibleError("values with a carried error need a set of starts apart from the target.")
    return plain, ends, first


def _windows(
    problem: Problem, constraints: list[Inside], opens: float
) -> tuple[list[float], list[Ends], list[Ends | None]]:
    """Times between which limits do not change, the limits of each stage, and those that are due at its end alone.

    ``opens`` is one more such time.
    """
    horizon = float(problem.horizon)
    spans = [(0.0, horizon) if one.during is None else one.during for one in constraints]
    cuts = sorted({0.0, horizon, opens, *(float(t) for span in spans for t in span if 0 < t < horizon)})
    if (0.0, 0.0) in spans:
        raise InfeasibleError("values with a carried error do not serve a limit that is due at time 0 alone.")
    rooms, dues = [], list[Ends | None]()
    for begin, end in pairwise(cuts):
        lasting = [span[0] <= begin and span[1] >= end for span in spans]
        goes_on = [end < horizon and span[0] <= end < span[1] for span in spans]
        due = [span[0] <= end <= span[1] and not (a or b) for span, a, b in zip(spans, lasting, goes_on)]
        rooms.append(_ends(problem, [one for one, there in zip(constraints, lasting) if there]))
        dues.append(_ends(problem, [one for one, there in zip(constraints, due) if there]) if any(due) else None)
    return cuts, rooms, dues


def _ends(problem: Problem, constraints: list[Inside]) -> Ends:
    room = limits_among(problem, constraints)
    return np.array([room.inner_low, room.outer_low]), np.array([room.inner_high, room.outer_high])


def _beside(places: Array, limits: Array, width: Array) -> Array:
    """Ends where no limit stands, shape (2, n): at a limit of another stage where one is near."""
    result = np.array([places, places])
    for stage in limits:
        near = np.abs(stage[0] - places) < 0.5 * _MARGIN * width
        result = np.where(near, stage, result)
    return result


def _around(start: Region | GaussianStart) -> tuple[Array, Array]:
    """The ends of a box around a start set, or around nearly all of a normal start."""
    if isinstance(start, GaussianStart):
        size = _DEVIATIONS * np.sqrt(np.diag(start.covariance))
        return start.middle - size, start.middle + size
    hull = start.hull(0.0)
    return np.asarray(hull.lo, dtype=float), np.asarray(hull.hi, dtype=float)


def _operators(drift: Tape, square: Tape, fields: tuple[Fields, Fields], n: int) -> tuple[Operator, ...]:
    """The products of drift and noise, the one without a factor first, where there is one."""
    if fields[0].autonomous and fields[1].autonomous and len(drift.inputs) == n + 1:
        return (Operator(factor=None, drift=fields[0], square=fields[1]),)
    parts = separated(drift, n), separated(square, n)
    if parts[0] is None or parts[1] is None:
        raise InfeasibleError(
            "values with a carried error need time and disturbances as factors of functions of the state, as in "
            "a(t) x + b(t, d), and this model has them inside of such a function."
        )
    nothing = [_nothing(tape, n) for tape in (drift, square)]
    names = drift.inputs[n + 1 :]
    rows = [(one, None) for one in parts[0]] + [(None, one) for one in parts[1] if one.coefficient is not None]
    plain = [one for one in parts[1] if one.coefficient is None]
    result = []
    for first, second in rows:
        one = first or second
        assert one is not None
        other = second or (plain.pop() if one.coefficient is None and plain else None)
        result.append(_operator(one.coefficient, first, other, nothing, n, names))
    result += [_operator(None, None, one, nothing, n, names) for one in plain]
    return tuple(sorted(result, key=lambda one: one.factor is not None))


def _operator(
    factor: Tape | None, drift: Product | None, square: Product | None, nothing: list[Tape], n: int,
    names: tuple[str, ...],
) -> Operator:  # fmt: skip
    if factor is not None:  # that of the noise has no disturbances
        factor = replace(factor, inputs=(factor.inputs[0], *names))
    tapes = [empty if one is None else one.function for one, empty in zip((drift, square), nothing)]
    return Operator(factor=factor, drift=Fields(tapes[0], n), square=Fields(tapes[1], n))


def _nothing(tape: Tape, n: int) -> Tape:
    graph = Graph(tape.inputs[: n + 1])
    return graph.tape([graph.const(0.0)] * len(tape.outputs), (len(tape.outputs),))


class _InFloats:
    """A tape as a function of points, a time, and disturbances, which are ``usual`` ones where none are given."""

    def __init__(self, tape: Tape, usual: Array | None = None) -> None:
        self.tape, self.usual = tape, usual

    @cached_property
    def function(self) -> Callable[..., Array]:
        return compile_numpy(self.tape)

    def __reduce__(self) -> tuple[type, tuple[Tape, Array | None]]:
        return _InFloats, (self.tape, self.usual)

    def __call__(self, points: Array, time: float = 0.0, disturbance: Array | None = None) -> Array:
        acting = self.usual if disturbance is None else disturbance
        values = self.function(time, *points, *(() if acting is None else tuple(acting)))
        return np.ascontiguousarray(np.moveaxis(values.reshape(*points.shape[1:], len(self.tape.outputs)), -1, 0))


def _visited(
    problem: Problem, low: Array, high: Array, ends: Sequence[float], inner_low: Array, inner_high: Array, flow: Flow,
    disturbance: Array, target: Ends | None, shapes: Sequence[Inside],
) -> Array:  # fmt: skip
    """Quantiles of where simulated paths are while they are safe, shape (stages, 2, n).

    Each path has an extreme disturbance; ``ends`` and the limits' inner ends are those of the stages.
    """
    rng, n = np.random.default_rng(0), problem.system.dimension
    system = problem.system
    assert isinstance(system, ContinuousSystem)
    g = system.diffusion
    columns = g.shape[1]
    noise = _InFloats(g) if isinstance(g, Tape) else lambda x, t: np.asarray(g).reshape(n * columns, 1)
    extreme = disturbance[rng.integers(2, size=(len(disturbance.T), _PATHS)), np.arange(len(disturbance.T))[:, None]]
    which = rng.integers(len(low), size=_PATHS)
    x = low[which].T + (high - low)[which].T * rng.random((n, _PATHS))
    for k, start in enumerate(problem.starts):
        if isinstance(start, GaussianStart):
            x[:, which == k] = start.sample(rng, int((which == k).sum())).T
    low, high = np.clip(low, inner_low[0], inner_high[0]), np.clip(high, inner_low[0], inner_high[0])
    step, alive = problem.horizon / _STEPS, np.ones(_PATHS, dtype=bool)
    seen: list[list[Array]] = [[] for _ in ends[1:]]
    seen[0].append(x.copy())
    for k in range(_STEPS):
        stage = min(int(np.searchsorted(ends, (k + 1) * step)), len(ends) - 1) - 1
        kicks = noise(x, k * step).reshape(n, columns, -1) * rng.normal(size=(columns, _PATHS))
        moved = x + step * flow(x, k * step, extreme) + math.sqrt(step) * kicks.sum(axis=1)
        x = np.where(alive, moved, x)
        alive &= np.all((x > inner_low[stage][:, None]) & (x < inner_high[stage][:, None]), axis=0)
        for shape in shapes:
            alive &= shape.satisfied(x.T)
        if target is not None:
            alive &= ~np.all((x > target[0][0][:, None]) & (x < target[1][0][:, None]), axis=0)
        if (k % _EVERY == 0 or not seen[stage]) and alive.any():
            seen[stage].append(x[:, alive])
    result = []
    for k, parts in enumerate(seen):
        points = np.concatenate(parts or seen[k - 1], axis=1)
        points = points[:, np.isfinite(points).all(axis=0)]
        least, most = np.quantile(points, [_RARE, 1 - _RARE], axis=1)
        if k == 0:
            least, most = np.minimum(least, low.min(axis=0)), np.maximum(most, high.max(axis=0))
        room = inner_high[k] - inner_low[k]
        size = np.maximum(np.abs(least), np.abs(most))
        narrow = np.where(np.isfinite(room), _NARROWEST * room, _AT_REST * np.where(size > 0, size, 1.0))
        more = np.maximum(narrow - (most - least), 0.0) / 2
        result.append((least - more, most + more))
    return np.array(result)
