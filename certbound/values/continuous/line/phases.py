"""The safe interval of one state, piece by piece of time: limits from windows, moving sets and obstacles.

Between the ends of windows the active constraints are the same: a `Phase`. At such an end all constraints whose
windows touch it hold: a `Gate`, which a path must pass (one that is outside when a constraint begins has failed).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from certbound.errors import InfeasibleError
from certbound.problem.model import JUMPS, Graph, Tape, arithmetic, needed
from certbound.problem.problem import Problem
from certbound.problem.sets import Inside, Quadratic
from certbound.rigor.intervals import Interval
from certbound.values.sets import as_stays

_SLACK = 4e-16
Side = Tape | float | None


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Limit:
    """One end of a constraint: the place center(t) + offset, the offset rounded for upper bounds or for lower ones."""

    side: int
    center: Tape | None
    offset: float


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Phase:
    """A piece of time, and a box of the coordinate y with x = origin(t) + width(t) y (x = y where these are None).

    ``closed`` tells at which of the two faces a path that leaves has failed; at the others the line is only cut, or
    ``held``: no path crosses them (`certbound.values.continuous.held_faces`).
    """

    start: float
    end: float
    low: float
    high: float
    closed: tuple[bool, bool]
    held: tuple[bool, bool] = (False, False)
    origin: Tape | None = None
    width: Tape | None = None

    def place(self, y: Interval, t: float) -> Interval:
        """x of y at a time."""
        x = y if self.width is None else y * value_at(self.width, t)
        return x if self.origin is None else x + value_at(self.origin, t)

    def local(self, x: Interval, t: float) -> Interval:
        """y of x at a time."""
        y = x if self.origin is None else x - value_at(self.origin, t)
        return y if self.width is None else y / value_at(self.width, t)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Gate:
    """Where a path must be at an instant; infinite where nothing bounds it."""

    time: float
    low: float
    high: float


def value_at(tape: Tape, t: float) -> Interval:
    """Enclosure of a function of time."""
    value: Interval = tape.evaluate(arithmetic("interval"), [Interval.point(t)])[0]
    return value


def last_instant(problem: Problem) -> float:
    """The time after which nothing is asked any more."""
    ends = [float(problem.horizon) if c.during is None else c.during[1] for c in problem.constraints]
    return max(ends, default=0.0)


def limits_of(problem: Problem, *, inner: bool) -> list[tuple[Limit, tuple[float, float]]]:
    """Every end of every constraint with its window.

    Raises
    ------
    InfeasibleError
        An obstacle beside which the start does not stand, or one that appears when paths may be on both sides of it.
    """
    found = []
    for constraint in as_stays(problem.constraints):
        window = constraint.during or (0.0, float(problem.horizon))
        around = constraint.region.extent()
        ends = {0: float(around.lo[0]), 1: float(around.hi[0])}
        kept = {side: end for side, end in ends.items() if np.isfinite(end)}
        for side, end in (_beside(constraint, kept, problem) if constraint.outside else kept).items():
            facing = (1 - side) if constraint.outside else side
            found.append((_limit(constraint, facing, end, inner), window))
    return found


def _limit(constraint: Inside, side: int, end: float, inner: bool) -> Limit:
    region = constraint.region
    exact = region.form.axial if not isinstance(region.form, Quadratic) else region.form.even
    if region.center is None or region.moving:
        size, middle = (0.0 if exact else abs(end)), 0.0
    else:
        middle = float(region.center_at()[0])
        size = abs(end) + abs(middle) if middle or not exact else 0.0
    inward = (1 if side == 0 else -1) * (1 if inner else -1)
    center = region.center if isinstance(region.center, Tape) else None
    offset = end + middle + inward * _SLACK * size
    if inner:
        offset = constraint.inward(side, offset)
    return Limit(side=side, center=center, offset=offset)


def _beside(constraint: Inside, ends: dict[int, float], problem: Problem) -> dict[int, float]:
    """The end that an obstacle shows to the starts."""
    if constraint.during is not None and constraint.during[0] > 0:
        raise InfeasibleError(
            f"value functions do not serve '{constraint.label}': it appears while paths may be on either side of it."
        )
    start = problem.initial
    if start.random:  # a start beyond the obstacle has not failed, and belongs to another room
        raise InfeasibleError(f"value functions do not serve a random start beside '{constraint.label}'; use a set.")
    around, low, high = constraint.region.hull(0.0), start.hull().lo[0], start.hull().hi[0]
    if 0 in ends and high < around.lo[0]:
        return {0: ends[0]}
    if 1 in ends and low > around.hi[0]:
        return {1: ends[1]}
    raise InfeasibleError(f"the starts must lie on one side of '{constraint.label}'.")


def pieces(
    problem: Problem, cuts: tuple[float, float], *, inner: bool, breaks: Sequence[float] = ()
) -> tuple[list[Phase], list[Gate]]:
    """Phases in order, and the gate at the end of each; at ``cuts`` the line is cut where nothing bounds it.

    ``breaks`` are more times at which phases end.
    """
    limits, end = limits_of(problem, inner=inner), last_instant(problem)
    ends = [t for _, window in limits for t in window]
    instants = sorted({0.0, end, *(min(t, end) for t in (*ends, *breaks))})
    phases, gates = [], []
    for first, last in itertools.pairwise(instants):
        active = [limit for limit, window in limits if window[0] <= first and last <= window[1]]
        phases.append(phase_of(active, first, last, cuts))
        touched = [limit for limit, window in limits if window[0] <= last <= window[1]]
        gates.append(_gate(touched, last, inner))
    return phases, gates


def _gate(limits: list[Limit], t: float, inner: bool) -> Gate:
    ends = [-np.inf, np.inf]
    for limit in limits:
        place = Interval.point(limit.offset)
        if limit.center is not None:
            place = place + value_at(limit.center, t)
        low_end = (limit.side == 0) == inner  # inward rounds a lower end up and an upper end down
        value = float(place.hi if low_end else place.lo)
        ends[limit.side] = max(ends[0], value) if limit.side == 0 else min(ends[1], value)
    return Gate(time=t, low=ends[0], high=ends[1])


def phase_of(limits: list[Limit], start: float, end: float, cuts: tuple[float, float]) -> Phase:
    """The phase of some limits of one state; at ``cuts`` where none is on that side.

    Raises
    ------
    InfeasibleError
        A limit may jump: the coordinates in which it stands still would jump with it, and no path does.
    """
    if any(limit.center is not None and _may_jump(limit.center) for limit in limits):
        raise InfeasibleError("value functions in continuous time need limits that move without jumps.")
    sides = [_strongest([limit for limit in limits if limit.side == side], side) for side in (0, 1)]
    closed = (sides[0] is not None, sides[1] is not None)
    ends = [cut if side is None else side for side, cut in zip(sides, cuts)]
    if all(isinstance(side, float) for side in ends):
        return Phase(start=start, end=end, low=float(ends[0]), high=float(ends[1]), closed=closed)  # type: ignore[arg-type]
    centers = {id(limit.center) for limit in limits}
    if len(centers) == 1 and all(closed):  # both ends move with one centre
        offsets = [[limit.offset for limit in limits if limit.side == side] for side in (0, 1)]
        return Phase(
            start=start, end=end, low=max(offsets[0]), high=min(offsets[1]), closed=closed, origin=limits[0].center
        )
    graph = Graph(("t",))
    nodes = [_node(graph, side) for side in ends]
    origin = graph.tape([nodes[0]], (1,))
    width = graph.tape([graph.apply("sub", nodes[1], nodes[0])], (1,))
    return Phase(start=start, end=end, low=0.0, high=1.0, closed=closed, origin=origin, width=width)


def _may_jump(center: Tape) -> bool:
    """Whether operations are used that jump although their slopes are bounded on both sides."""
    used = needed(center.nodes, center.outputs)
    return any(kept and node.op in (*JUMPS, "atan2") for kept, node in zip(used, center.nodes))


def held_at(phase: Phase, faces: tuple[float | None, float | None]) -> Phase:
    """The phase, ended at faces that no path crosses, where these lie within its limits."""
    if phase.origin is not None or phase.width is not None:
        return phase
    low, high = faces
    held = (low is not None and low >= phase.low, high is not None and high <= phase.high)
    return replace(
        phase, low=low if held[0] and low is not None else phase.low,
        high=high if held[1] and high is not None else phase.high,
        closed=(phase.closed[0] and not held[0], phase.closed[1] and not held[1]), held=held,
    )  # fmt: skip


def _strongest(limits: list[Limit], side: int) -> Side:
    """The innermost of several limits on one side, as a number or as a function of time."""
    if not limits:
        return None
    if all(limit.center is None for limit in limits):
        return (max if side == 0 else min)(limit.offset for limit in limits)
    graph = Graph(("t",))
    nodes = []
    for limit in limits:
        node = graph.const(limit.offset)
        nodes.append(node if limit.center is None else graph.apply("add", node, _node(graph, limit.center)))
    total = nodes[0]
    for node in nodes[1:]:
        total = graph.apply("max" if side == 0 else "min", total, node)
    return graph.tape([total], (1,))


def _node(graph: Graph, side: Tape | float | None) -> int:
    if isinstance(side, Tape):
        return int(side.evaluate(graph.arithmetic(), [graph.input(0)])[0])
    assert side is not None
    return graph.const(side)


def check_room(phases: Sequence[Phase]) -> None:
    """Refuse an interval without an interior, at some time of a phase.

    Raises
    ------
    InfeasibleError
    """
    for phase in phases:
        wide = np.ones(1)
        if phase.width is not None:
            ends = np.linspace(phase.start, phase.end, 129)
            spans = Interval(ends[:-1], ends[1:])
            wide = (Interval.point(np.zeros(128)) + phase.width.evaluate(arithmetic("interval"), [spans])[0]).lo
        if not (phase.low < phase.high and np.all(wide > 0)):
            raise InfeasibleError(f"the safe set has no interior at some time in [{phase.start:g}, {phase.end:g}].")
