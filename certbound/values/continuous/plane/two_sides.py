"""Two states: propose V, hand what a proof would have to pay back to the proposal as a source, and prove it.

R, the residual, is sampled on every patch. Where it is positive the theorem pays for the worst patch of each slab all
over the plane, which is far too much where the worst ones lie in corners that hardly a path visits. With s >= R as a
source of V's equation the residual of the next proposal is about R - s <= 0, and u grows only by what a path meets on
its way out. All this is proposal, the proof is that of `hypotheses`.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np

from certbound.arrays import Array
from certbound.problem.problem import Problem
from certbound.values.charts import Chart
from certbound.values.continuous.held_faces import check_noise, held_face, rarely_reached, resolved
from certbound.values.continuous.hypotheses import (
    LIFTS,
    Model,
    chart_above,
    covers,
    extreme_over,
    prove_upper,
    raised_above,
    sampled,
)  # fmt: skip
from certbound.values.continuous.payment import Payment
from certbound.values.continuous.plane.monotone import propose_monotone
from certbound.values.continuous.plane.plane_below import bound_plane_below, plan_below
from certbound.values.continuous.plane.plane_grids import Pair, Plan, Plane, Source, slab_times
from certbound.values.continuous.plane.plane_proposal import propose_plane
from certbound.values.continuous.plane.plane_reach import closed_plane, led, plane_of, reach_of
from certbound.values.continuous.surface import Surface
from certbound.values.room import Room, limits_of, points_of, starts_of
from certbound.watch import OutOfTime

Proposed = tuple[Surface, Payment]
Found = tuple[float, float | None, str, tuple[list[Proposed], list[Proposed]]]
Propose = Callable[[Plane, Plan, Source | None], Surface | None]

_FACTOR = 1.12
_TOPS = (-0.02, -0.1)  # where V is above, the proof may lift it over 0 instead
_CAP = 50.0
_GRANTED = 0.005  # eps that the proof may pay, in units of the bound, summed over the horizon
RATE = 7_000  # patches that are proposed and proved in a second
_PASSES = 2
_CLOSE = 0.15
_POOR = 0.5  # of log P: where a proof would lose more, monotone proposals are made too
_RAISED = (0.6, 1.5, 2.5)  # times a: what they keep of it at kinks, one after the other
_HOPELESS = (60.0, 1000.0)  # what a first proposal may lose (log P); sources make less of it, more so of monotone ones
_VARIED = 1.0  # about how much V varies on a patch
_SHARES = (0.12, 0.8)  # of the patches, for one grid after the other
_LONGER = 4.0  # leads beside faces that no path crosses, where the noise across others may vanish in places
_DEEP = 3.0  # how far below log P the floor is there
_FLOORS = (-7.0, -20.0, -50.0)
_FIRST = 0.02  # of the lead: slabs start shorter there
_SLOPING = (-0.3,)  # and sources leave the cells at the faces alone, whose layers they would bend
_RARE = 5.0  # how far below log P is what faces may be left out for
_NEARER = (0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 1.0)  # of the way to a face, where one is wanted that hardly a path reaches
_VISITED = 0.05  # as next, of where cells are small
_BEYOND = 0.35  # how far beyond simulated paths a box ends, in units of their extent
_ALIKE = 0.03  # of log P, which a smaller box may add to a rough guess
BELOW = 0.6  # of as many patches again, for a lower bound
_NEVER = -20.0  # of log P: below that no proposal has led to a lower bound yet
_SLOWLY = 0.14  # of the time to go, a slab: short enough there, however fine the cells are


def two_states(
    problem: Problem, model: Model, room: Room, deadline: float, wanted: float
) -> Found:
    """The upper bound on one grid after another, and the lower one where the upper one is above ``wanted``.

    The seconds until the deadline are turned into a number of patches, so that the bound does not depend on the clock.
    What certificates state of both sides comes last.
    """
    starts = starts_of(problem)
    plain, rare = model, -math.inf
    room = closed_plane(problem, model, room)
    inner, model = held_plane(plane_of(problem, model, room.inner_low, room.inner_high, starts), model)
    if led(model):
        visited = np.transpose(reach_of(problem, inner.drift, inner.square, _VISITED))
        inner = replace(inner, visited=((visited[0, 0], visited[0, 1]), (visited[1, 0], visited[1, 1])))
    if held_anywhere(inner):
        inner, written, rare = released(problem, inner, plain, rough_level(inner))
        model = written or model
        near = _near(problem, inner)
        inner = near if rough_level(near) < rough_level(inner) + _ALIKE else inner
    else:
        check_noise(model, (0.0, inner.horizon), list(zip(room.inner_low, room.inner_high)))
        if wanted < math.inf:
            check_noise(model, (0.0, inner.horizon), list(zip(room.outer_low, room.outer_high)))
    patches = RATE * max(1.0, round(deadline - time.perf_counter(), 1))
    outer = None if held_anywhere(inner) else plane_of(problem, model, room.outer_low, room.outer_high, starts)
    return bound_box(problem, model, (inner, outer), (rough_level(inner), patches, rare), wanted)


def bound_box(
    problem: Problem, model: Model, boxes: tuple[Plane, Plane | None], work: tuple[float, float, float], wanted: float
) -> Found:
    """Both bounds of log P, the lower one on the second box where the upper one is above ``wanted``.

    ``work`` holds about log P, the patches that are granted, and ``rare`` of `bound_plane_above`.
    """
    (inner, outer), (level, patches, rare) = boxes, work
    if outer is not None and level < _NEVER:  # all is granted to the upper bound then
        patches, outer = patches * (1 + BELOW if level > wanted else 1.0), None
    upper, done, proposed = bound_plane_above(inner, model, level, patches, rare)
    below: list[Proposed] = []
    if upper > wanted and outer is not None:
        plan = plan_below(outer, min(level, upper), BELOW * patches)
        with contextlib.suppress(OutOfTime):
            found = bound_plane_below(outer, model, plan, outer.starts, points_of(problem))
            below += [] if found is None else [found]
        done.append(f"{plan.cells}^2 below")
    lower = max((payment.log for _, payment in below), default=None)
    return upper, lower, f"value function in two states, cells: {', '.join(done)}", (proposed, below)


def confined(problem: Problem, model: Model, room: Room) -> bool:
    """Whether noise moves one state only, and no path crosses the ends of the other one."""
    if not led(model):
        return False
    room = closed_plane(problem, model, room)
    plane, _ = held_plane(plane_of(problem, model, room.inner_low, room.inner_high, starts_of(problem)), model)
    return any(all(sides) for sides in plane.held)


def bound_plane_above(
    plane: Plane, model: Model, level: float, patches: float, rare: float = -math.inf
) -> tuple[float, list[str], list[Proposed]]:
    """An upper bound of log P(leaving the box) on one grid after another, what was done, and what was proved.

    ``rare`` is the log of the probability of a face that was left out (`released`), which no certificate states.
    """
    upper, done = 0.0, []
    proposed: list[Proposed] = []
    stated = rare == -math.inf and not held_anywhere(plane)  # certificates know of no face that paths do not cross
    plans = {plan.cells: plan for plan in (plan_above(plane, level, share * patches) for share in _SHARES)}
    kinds: list[Propose] = [propose_plane] if held_anywhere(plane) else _several()
    for plan in plans.values():
        try:
            surface = _promising(plane, model, plan, kinds=kinds)
            if surface is not None:
                payment = prove_upper(surface, model, plane.starts, plane.held)
                paid = with_rare(payment, rare)
                if paid < upper:
                    upper = paid
                    proposed += [(raised_above(surface, plane.held), payment)] if stated else []
        except OutOfTime:
            if upper < 0:
                break
            raise
        done.append(f"{plan.cells}^2")
    return upper, done, proposed


def plan_above(plane: Plane, level: float, patches: float) -> Plan:
    """The finest grid with about so many patches; slabs grow fewer as fast as cells do.

    Where failing is rare (log P the ``level``) a longer lead costs little, and makes for fronts that are less steep.
    """
    held = held_anywhere(plane)
    share = _LONGER if held else 0.32 * min(max(-level / 3, 1.0), 3.0)
    floor = level - _DEEP if held and level < 0 else -math.inf
    slowly = _SLOWLY if level < _NEVER and not held else 0.0
    for cells in itertools.count(16):
        plan = Plan(
            cells=cells, growth=max(min(6 / cells, 0.3), slowly), lead=share / cells * plane.horizon, floor=floor,
            first=_FIRST if held else 0.1,
        )  # fmt: skip
        if cells**2 * len(slab_times(plane.horizon, plan)) > patches:
            break
    return plan


@lru_cache(maxsize=4)  # a plane is asked again as faces are left out
def rough_level(plane: Plane) -> float:
    """log P from a coarse proposal; 0 where that breaks down."""
    plans = [Plan(cells=28, growth=0.4, lead=0.02 * plane.horizon)]
    if held_anywhere(plane):
        plans = [Plan(cells=28, growth=0.25, lead=_LONGER / 28 * plane.horizon, floor=floor) for floor in _FLOORS]
    level = 0.0
    for plan in plans:
        rough = propose_plane(plane, plan)
        if rough is None and not held_anywhere(plane):
            rough = propose_monotone(plane, plan, None, _RAISED[0])
        level = level if rough is None else min(level, float(extreme_over(rough, plane.starts, upper=True)))
        if level > plan.floor + 1:
            break
    return level


def held_anywhere(plane: Plane) -> bool:
    """Whether no path crosses some face of the box."""
    return any(itertools.chain(*plane.held))


def chart_plane(problem: Problem, model: Model, room: Room, levels: list[float], seconds: float) -> list[Chart]:
    """Upper bounds from every cell at t = 0, sharp at the levels of log P; none where no proposal comes to an end."""
    plane = plane_of(problem, model, room.inner_low, room.inner_high, starts_of(problem))
    least = rough_level(plane)
    levels = sorted({max(level, least) for level in levels})
    plan = plan_above(plane, levels[0], _SHARES[0] * RATE * seconds)
    surface = _promising(plane, model, plan, levels[-1])
    return [] if surface is None else chart_above(surface, model, levels, [0])


def _several() -> list[Propose]:
    """The ways of proposing, the most accurate one first, then those that serve layers thinner and thinner."""
    return [propose_plane, *(partial(propose_monotone, raised=factor) for factor in _RAISED)]


def _promising(
    plane: Plane, model: Model, plan: Plan, level: float | None = None, kinds: list[Propose] | None = None
) -> Surface | None:
    """The proposal whose bound will be the smallest where V is the ``level``, or over the starts.

    The monotone ones are asked where splines through V break down, or the proof would lose much. ``kinds`` are tried
    in turn. On the next grid what breaks down comes last, and what promises nothing stays only if all do: the nearest.
    """
    best: Sketch | None = None
    nearest: Propose | None = None
    vain = list[Propose]()
    for propose in list(kinds := _several() if kinds is None else kinds):
        tops = _SLOPING if held_anywhere(plane) else _TOPS if propose is propose_plane else _TOPS[1:]
        found = _refined(plane, model, plan, level, propose, tops)
        if found is None:  # the last one to be asked on the next grid
            kinds.append(kinds.pop(kinds.index(propose)))
            continue
        if best is not None and found.start >= best.estimate():
            break
        vain += [propose] if found.estimate() >= 0 else []
        if best is None or found.estimate() < best.estimate():
            best, nearest = found, propose
        if best.estimate() < best.start + _POOR:
            break
    if best is None or (level is None and best.estimate() >= 0):
        kinds[:] = kinds if nearest is None else [nearest]
        return None
    kinds[:] = [propose for propose in kinds if propose not in vain or propose is nearest]
    return best.surface if covers(best.surface, plane.horizon, plane.low, plane.high, within=True) else None


def _refined(
    plane: Plane, model: Model, plan: Plan, level: float | None, propose: Propose, tops: Sequence[float]
) -> Sketch | None:
    """The best of a few proposals, each with a source made of what the last one would pay."""
    surface = propose(plane, plan, None)
    if surface is None:
        return None
    first = best = Sketch.of(surface, model, plane.starts, level)
    if first.estimate() > first.start + _HOPELESS[propose is not propose_plane]:
        return None
    for top in tops:
        sketch, source = first, None
        for _ in range(_PASSES):
            more = Source.above(sketch.surface, _FACTOR * sketch.needed(top))
            source = more if source is None else source.plus(more)
            surface = propose(plane, plan, source)
            if surface is None:
                break
            sketch = Sketch.of(surface, model, plane.starts, level)
            best = min(best, sketch, key=lambda one: one.estimate())
        if best.estimate() < best.start + _CLOSE:
            break
    return best


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Sketch:
    """A proposal with samples of what its proof would pay for: R, but for what eps pays, and V's least values."""

    surface: Surface
    start: float
    excess: Array
    low: Array

    @classmethod
    def of(cls, surface: Surface, model: Model, starts: list[Pair], level: float | None = None) -> Sketch:
        """What eps pays is counted where V is highest on a patch: a proof knows no more of where R is."""
        start = extreme_over(surface, starts, upper=True) if level is None else level
        highest, low, high = sampled(surface, model)
        paid = _GRANTED / float(surface.times[-1]) * np.exp(np.minimum(start - np.maximum(low + _VARIED, high), 50.0))
        return cls(surface=surface, start=start, excess=np.maximum(highest - paid, 0.0), low=low)

    def needed(self, top: float) -> Array:
        """The source that would do where V is below ``top``."""
        return np.where(self.low < top, np.minimum(self.excess, _CAP), 0.0)

    def estimate(self) -> float:
        """About what the proof will find."""
        worst = [np.where(self.low < -lift, self.excess, 0.0).max(axis=(1, 2)) for lift in LIFTS]
        return self.start + min(lift + float(rate @ self.surface.steps) for lift, rate in zip(LIFTS, worst))


def held_plane(plane: Plane, model: Model) -> tuple[Plane, Model]:
    """The plane, ended at faces that no path crosses, and the model as it is written on their inner side."""
    span, box = (0.0, plane.horizon), list(zip(plane.low, plane.high))
    held = [[False, False], [False, False]]
    for axis, side in itertools.product((0, 1), (0, 1)):
        place = held_face(model, box, plane.starts[axis], span, axis, side)
        if place is not None:
            held[axis][side] = True
            box[axis] = (place, box[axis][1]) if side == 0 else (box[axis][0], place)
    if not any(itertools.chain(*held)):
        return plane, model
    (low, high), sides = zip(*box), [(row[0], row[1]) for row in held]
    plane = replace(plane, low=low, high=high, held=(sides[0], sides[1]))
    return plane, resolved(model, span, box)


def released(
    problem: Problem, plane: Plane, model: Model, level: float
) -> tuple[Plane, Model | None, float]:
    """The plane without faces that hardly a path reaches, whose layers would cost much, and the log of their price.

    Let W be the plane's box. A path fails only if it leaves W: at such a face, which is what the price bounds, or at
    another one; V is wanted up to then. So where the drift leads inside nothing is asked of V at the face, and where it
    leads out the box may go on, to 0 if no path crosses that. ``model`` is as it was asked; that given back is written
    for the box, and None where the plane stays as it is. ``level`` is about log P.
    """
    limits, span = limits_of(problem), (0.0, plane.horizon)
    box = [[plane.low[axis], plane.high[axis]] for axis in (0, 1)]
    price, free = -math.inf, []
    sides = [(axis, side) for axis, side in itertools.product((0, 1), (0, 1)) if not plane.held[axis][side]]
    cut = [one for one in sides if not math.isfinite((limits.inner_low, limits.inner_high)[one[1]][one[0]])]
    for axis, side in (one for one in cut if _ends_at_0(model, box, plane, *one)):
        box[axis][side] = 0.0
        sides.remove((axis, side))
    for axis, side in sides:
        inside = _leads_inside(plane, axis, side)
        begin, end = plane.starts[axis][side], box[axis][side]
        for share in _NEARER if inside else (1.0,):  # the nearer the face, the finer the grid
            ends = [(row[0], row[1]) for row in box]
            place = begin + share * (end - begin) if share < 1 else end
            ends[axis] = (place, ends[axis][1]) if side == 0 else (ends[axis][0], place)
            log = rarely_reached(model, ends, plane.starts[axis], span, axis, side)
            if log < level - _RARE:
                break
        if log < level - _RARE and (inside or _ends_at_0(model, box, plane, axis, side)):
            box[axis][side] = place if inside else 0.0
            free += [(axis, side)] if inside else []
            price = float(np.logaddexp(price, log))
    low, high = (box[0][0], box[1][0]), (box[0][1], box[1][1])
    found, written = held_plane(replace(plane, low=low, high=high, held=((False, False), (False, False))), model)
    held = [tuple(found.held[axis][side] or (axis, side) in free for side in (0, 1)) for axis in (0, 1)]
    found = replace(found, held=((held[0][0], held[0][1]), (held[1][0], held[1][1])))
    return (found, written, price) if rough_level(found) <= level + _ALIKE else (plane, None, -math.inf)


def _ends_at_0(model: Model, box: list[list[float]], plane: Plane, axis: int, side: int) -> bool:
    """Whether 0 is beyond a side, and no path crosses it from a box that goes on to there."""
    wider = [(row[0], row[1]) for row in box]
    end = wider[axis][side]
    if not (end > 0 if side == 0 else end < 0):
        return False
    wider[axis] = (0.0, wider[axis][1]) if side == 0 else (wider[axis][0], 0.0)
    return held_face(model, wider, plane.starts[axis], (0.0, plane.horizon), axis, side) == 0.0


def _leads_inside(plane: Plane, axis: int, side: int) -> bool:
    """Whether the drift nowhere leads out at a face, in floats."""
    ends = [np.linspace(low, high, 33) for low, high in zip(plane.low, plane.high)]
    ends[axis] = np.array([(plane.low, plane.high)[side][axis]])
    x, y = np.meshgrid(*ends, indexing="ij")
    drifts = [plane.drift(t, x, y)[:, axis] for t in np.linspace(0, plane.horizon, 5)]
    return all(np.all(one * (1 - 2 * side) >= 0) for one in drifts)


def with_rare(payment: Payment, rare: float) -> float:
    """The payment's bound and the price of faces that were left out.

    Paths that end there were not counted among those that pay w = exp(inf V(T, .)) in the end: P (1 - w) is at most
    what the theorem says of all paths and w times the price more.
    """
    if rare == -math.inf or payment.terms is None:
        return payment.log
    end = payment.terms.end
    if not end < -1:
        return 0.0
    return min(float(np.logaddexp(payment.log, rare + 0.5)) + 1e-12, 0.0)  # 1 / (1 - w) < e^0.5


def _near(problem: Problem, plane: Plane) -> Plane:
    """The plane, ended not far beyond simulated paths on the sides that some path may cross."""
    reach = reach_of(problem, lambda t, x, y: plane.drift(t, x, y), plane.square, _BEYOND)
    ends = [
        [float(end if plane.held[axis][side] else pick(end, reach[side][axis])) for axis, end in enumerate(box)]
        for side, (box, pick) in enumerate(((plane.low, max), (plane.high, min)))
    ]
    return replace(plane, low=(ends[0][0], ends[0][1]), high=(ends[1][0], ends[1][1]))
