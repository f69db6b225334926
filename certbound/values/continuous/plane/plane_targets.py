"""Targets of two states: the probability of failing to get there in time, before a limit, from both sides.

A path ends where it first meets the target, and fails if it leaves the box or the horizon comes before. V is looked at
on cells that do not lie in the target. Above, V >= 0 on the faces and at the horizon, off the target; below, V <= 0. On
the target's edge e^V >= w, or <= W, which is subtracted at last, as V's floor at the horizon is elsewhere.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from certbound.arrays import Array, Mask
from certbound.errors import InfeasibleError
from certbound.problem.problem import Problem
from certbound.problem.sets import Box, Faces, Region
from certbound.values.continuous.held_faces import check_noise
from certbound.values.continuous.hypotheses import (
    LIFTS,
    NEGLIGIBLE,
    Model,
    Need,
    Proof,
    cheapest,
    covers,
    examine,
    extreme_over,
    patched_of,
    sampled_residual,
    up,
)  # fmt: skip
from certbound.values.continuous.payment import Payment, pay_lower
from certbound.values.continuous.plane.plane_grids import Pair, Plan, Plane, Source, slab_times
from certbound.values.continuous.plane.plane_reach import plane_of, reach_of
from certbound.values.continuous.plane.target_proposal import Fate, propose_to_target, sides_of
from certbound.values.continuous.plane.two_sides import RATE
from certbound.values.continuous.residual import value_range
from certbound.values.continuous.surface import Surface
from certbound.values.room import limits_of, points_of, starts_of
from certbound.watch import OutOfTime

Proposed = tuple[Surface, Payment]

_FACTOR = 1.12
_TOP = -0.02
_CAP = 50.0
_GRANTED = 0.005
_VARIED = 1.0
_PASSES = 2
_SHARE = 1.0  # w in units of the probability of failing
_GROWTH = 0.2
_FEWEST = 16  # cells along each axis
_LEAD = 0.32  # of the horizon over the number of cells
_HIGHEST = math.log(0.5)  # of log w
_ROUNDS = 4  # of coarse proposals that find out about it
_COARSE = 24
_SHARES = (0.12, 0.5)  # of the patches, for one grid after the other
_BEYOND = 0.6  # of the paths' extent, where nothing bounds a state
INVERSE = 2.0**8  # 1 / e of V = -e Q
_FACTORS = (0.6, 0.9, 1.12, 1.12, 1.5, 2.0, 3.0, 4.0)  # of the residual, for one source after the other
_SAMPLED = 3  # of which samples tell
_WORSE = 3.0  # times the least residual of those before: sources do not help any more
_LITTLE = 0.02 / INVERSE  # a residual, summed over the horizon, that is never too much
_COST, _MOST = 0.015, 44  # seconds of both sides, over cells^2, and most cells
_BELOW = 28, 20  # the most cells for lower bounds, and those that are tried where there is none
_DEEP = 0.25  # of the box's width: how deep the box reaches into a target that takes up one of its sides


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Aim:
    """A problem with a target, as proofs of one side see it; at ``open`` faces (state, side) the box is only cut."""

    plane: Plane
    model: Model
    target: Region
    open: tuple[tuple[int, int], ...]
    upper: bool
    points: Array | None


def prove_failing_above(surface: Surface, aim: Aim) -> Proposed:
    """The surface, raised by what it misses, and an upper bound of log P(failing), whatever it is."""
    return proved_above(surface, aim)[:2]


def proved_above(surface: Surface, aim: Aim, negligible: float = NEGLIGIBLE) -> tuple[Surface, Payment, Proof | None]:
    """The same with what was seen; ``negligible`` stands for `NEGLIGIBLE`."""
    fate = Fate.of(surface.axes, aim.target)
    for _ in range(3):
        late = float(surface.range_at(-1)[0][fate.alive].min(initial=0.0))
        missing = -min(0.0, late, *_on_faces(surface, fate, _FACES)[0])
        surface = surface.raised(up(missing)) if missing > 0 else surface
    if missing > 0 or fate.alive.all() or not fate.alive.any():
        return surface, Payment(log=0.0), None
    start = up(extreme_over(surface, aim.plane.starts, upper=True))
    need = Need(spare=negligible / float(surface.times[-1]), start=start, top=0.0)
    proof = examine(surface, aim.model, need, upper=True, alive=fate.alive)
    payment, lift = cheapest(proof, need, surface, start, _around(surface, ~fate.alive)[0])
    return surface, replace(payment, lift=lift), proof


def prove_failing_below(surface: Surface, aim: Aim) -> Payment | None:
    """A lower bound of log P(failing) from the best start, whatever the surface is; None where none is positive."""
    found = proved_below(surface, aim)
    return None if found is None else found[0]


def proved_below(surface: Surface, aim: Aim, negligible: float = NEGLIGIBLE) -> tuple[Payment | None, Proof] | None:
    """The same with what was seen, where some start may count."""
    fate = Fate.of(surface.axes, aim.target)
    highest = _over(surface, ~fate.met)[1]
    surface = surface.raised(-highest - 1e-12 * (1 + highest)) if highest > 0 else surface
    if _may_lie_in(surface.axes, aim.plane.starts, fate.met):  # V says nothing of a path that is there already
        return None
    start = extreme_over(surface, aim.plane.starts, upper=False, points=aim.points)
    ceiling = max(_around(surface, fate.met)[1], *_on_faces(surface, fate, aim.open)[1], -700.0)
    if not start > ceiling:
        return None
    start = -up(-start)
    need = Need(spare=negligible / float(surface.times[-1]), start=start, top=np.inf, bottom=ceiling)
    proof = examine(surface, aim.model, need, upper=False, alive=~fate.met)
    if np.any(proof.ranges.high > 0):
        return None
    payment = pay_lower(patched_of(proof, -proof.ranges.residual_low, need, surface.steps), start, ceiling)
    return payment, proof


def _may_lie_in(axes: tuple[Array, ...], starts: Sequence[Pair], cells: Mask) -> bool:
    """Whether the box of the starts meets some of the closed cells."""
    near = [(axis[:-1] <= high) & (axis[1:] >= low) for axis, (low, high) in zip(axes, starts)]
    return bool(cells[np.ix_(*near)].any())


def _around(surface: Surface, over: Mask) -> tuple[float, float]:
    """Ends of V at all times where a path may enter the cells that are over."""
    low, high = math.inf, -math.inf
    for axis in (0, 1):
        rows = np.moveaxis(over, axis, 0)
        for node in range(1, len(rows)):
            entered = rows[node - 1] != rows[node]
            if entered.any():
                least, most = (part[:, entered] for part in surface.across(axis, node))
                low, high = min(low, float(least.min())), max(high, float(most.max()))
    return low, high


_FACES = tuple(itertools.product((0, 1), (0, 1)))


def _over(surface: Surface, cells: Mask) -> tuple[float, float]:
    """Bounds of V over some cells at all times."""
    low, high = math.inf, -math.inf
    for chunk in surface.chunks():
        ends = value_range(surface.patches(*chunk))
        within = [part.reshape(-1, *surface.cells)[:, cells] for part in ends]
        low = min(low, float(within[0].min(initial=np.inf)))
        high = max(high, float(within[1].max(initial=-np.inf)))
    return low, high


def _on_faces(surface: Surface, fate: Fate, faces: Sequence[tuple[int, int]]) -> tuple[list[float], list[float]]:
    """Bounds of V on faces of the box, off the target."""
    lows, highs = [math.inf], [-math.inf]
    for axis, side in faces:
        alive = np.take(fate.alive, -side, axis=axis)
        low, high = (part[:, alive] for part in surface.face_ranges(axis, side))
        lows.append(float(low.min(initial=np.inf)))
        highs.append(float(high.max(initial=-np.inf)))
    return lows, highs


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Sketch:
    """A proposal with samples of what its proof would pay for."""

    surface: Surface
    start: float
    excess: Array
    level: Array
    sign: float

    @classmethod
    def of(cls, surface: Surface, aim: Aim, granted: float = _GRANTED) -> _Sketch:
        start = extreme_over(surface, aim.plane.starts, upper=aim.upper, points=aim.points)
        worst, level = sampled_residual(surface, aim.model, upper=aim.upper)
        paid = granted / float(surface.times[-1]) * np.exp(np.minimum(start - level - _VARIED, 50.0))
        excess = np.maximum(worst - paid, 0.0) * Fate.of(surface.axes, aim.target).alive
        return cls(surface=surface, start=start, excess=excess, level=level, sign=1.0 if aim.upper else -1.0)

    def estimate(self) -> float:
        """About what the proof will find; the smaller the better above, below the larger."""
        if self.sign < 0:
            return self.start - float(self.excess.max(axis=(1, 2)) @ self.surface.steps)
        worst = [np.where(self.level < -lift, self.excess, 0.0).max(axis=(1, 2)) for lift in LIFTS]
        return self.start + min(lift + float(rate @ self.surface.steps) for lift, rate in zip(LIFTS, worst))

    def needed(self) -> Array:
        """The source that would do."""
        due = np.minimum(self.excess, _CAP)
        return np.where(self.level < _TOP, due, 0.0) if self.sign > 0 else due


def _promising(aim: Aim, plan: Plan) -> Surface | None:
    """The proposal whose bound will be the best of a few, each with a source made of what the last one would pay."""
    source: Source | None = None
    best: _Sketch | None = None
    for _ in range(_PASSES + 1):
        surface = propose_to_target(aim.plane, plan, aim.target, source, upper=aim.upper)
        if surface is None or not covers(surface, aim.plane.horizon, aim.plane.low, aim.plane.high, within=aim.upper):
            break
        sketch = _Sketch.of(surface, aim)
        if best is None or sketch.sign * sketch.estimate() < best.sign * best.estimate():
            best = sketch
        more = Source.above(surface, _FACTOR * sketch.needed())
        source = more if source is None else source.plus(more)
    return None if best is None else best.surface


class Solves(Protocol):
    """What proposes V = -e Q, Q being about the probability of arriving."""

    def failing(self, source: Source | None) -> Surface: ...


Likely = Callable[[Plane, Region, int, bool], Solves]


def _corrected(aim: Aim, solver: Solves) -> Proposed | None:
    """The best bound of proposals whose residual, as samples and then as bounds tell it, feeds the next one."""
    source: Source | None = None
    best: Proposed | None = None
    sign, least = (1.0, math.inf) if aim.upper else (-1.0, math.inf)
    try:
        for number, factor in enumerate(_FACTORS):
            surface = solver.failing(source)
            if not covers(surface, aim.plane.horizon, aim.plane.low, aim.plane.high, within=aim.upper):
                break
            sketch, fate = _Sketch.of(surface, aim, granted=0.0), Fate.of(surface.axes, aim.target)
            over = ~fate.alive if aim.upper else fate.met
            due = (sketch.level < 0 if aim.upper else sketch.level > _around(surface, over)[1]) & ~over
            needed = np.where(due, sketch.excess, 0.0)
            paid = float(needed.max(axis=(1, 2)) @ surface.steps)
            if not math.isfinite(paid) or paid > _WORSE * max(least, _LITTLE):
                break
            least = min(least, paid)
            if number >= _SAMPLED and paid < -surface.values[0].min(initial=0.0):
                made, payment, proof = _proved(surface, aim)
                if payment is not None and (best is None or sign * payment.log < sign * best[1].log):
                    best = made, payment
                if proof is not None:
                    excess = proof.ranges.residual_high if aim.upper else -proof.ranges.residual_low
                    table = np.zeros((surface.slabs, over.size))
                    table[proof.slab, proof.cell] = np.where(proof.ranges.low < 0, np.maximum(excess, 0.0), 0.0)
                    needed = table.reshape(needed.shape)
                if not np.isfinite(needed).all():
                    break
            more = Source.above(surface, factor * needed * INVERSE)
            source = more if source is None else source.plus(more)
    except OutOfTime:
        if best is None:
            raise
    return best


def _proved(surface: Surface, aim: Aim) -> tuple[Surface, Payment | None, Proof | None]:
    spare = NEGLIGIBLE / INVERSE
    if aim.upper:
        return proved_above(surface, aim, spare)
    return surface, *(proved_below(surface, aim, spare) or (None, None))


def bound_failing(
    problem: Problem, model: Model, target: Region, deadline: float, likely: Likely
) -> tuple[float, float | None, str, tuple[list[Proposed], list[Proposed]]]:
    """Natural logarithms of an upper and a lower bound of P(failing) (None: there is none), and words.

    ``problem`` has no target; the arrival has to be within its horizon. What certificates state of both comes last.
    ``likely`` proposes the probability of arriving itself, which is tried first.

    Raises
    ------
    InfeasibleError
        Windows, moving sets or targets, obstacles, curved limits, random starts, or noise that vanishes.
    """
    if target.moving:
        raise InfeasibleError("value functions in continuous time do not serve moving targets.")
    target = _simplified(target)
    aims = [_aim(problem, model, target, upper=side) for side in (True, False)]
    for aim in aims:
        check_noise(model, (0.0, aim.plane.horizon), list(zip(aim.plane.low, aim.plane.high)))
    patches = RATE * max(1.0, round(deadline - time.perf_counter(), 1))
    upper, lower, done = 0.0, -math.inf, list[str]()
    above, below = list[Proposed](), list[Proposed]()
    if target.form.axial and aims[0].plane.autonomous and len(model.branches) == 1:
        cells = min(max(round(math.sqrt(patches / RATE / _COST)), _FEWEST), _MOST)
        for aim, kept, number in ((aims[0], above, cells), *((aims[1], below, min(n, cells)) for n in _BELOW)):
            with contextlib.suppress(OutOfTime, RuntimeError, ValueError):  # a singular system, numbers that overflow
                found = None if kept else _corrected(aim, likely(aim.plane, target, number, aim.upper))
                kept += [] if found is None else [found]
        upper = min((one[1].log for one in above), default=0.0)
        lower = max((one[1].log for one in below), default=-math.inf)
        if upper < 0 and lower > -math.inf:
            return upper, lower, f"value function with a target in two states, cells: {cells}^2", (above, below)
        patches /= 2
        done.append(f"{cells}^2")
    floor, likelier = _floor(aims[0]), (bool(above), bool(below))
    for cells in sorted({_cells(aims[0].plane.horizon, share * patches) for share in _SHARES}):
        plan = _plan(aims[0].plane.horizon, floor, cells)
        with contextlib.suppress(OutOfTime):
            surface = _promising(aims[0], plan) if not likelier[0] else None
            if surface is not None:
                found = prove_failing_above(surface, aims[0])
                above += [found] if found[1].log < upper else []
                upper = min(upper, found[1].log)
            surface = _promising(aims[1], plan) if not likelier[1] else None
            payment = None if surface is None else prove_failing_below(surface, aims[1])
            if surface is not None and payment is not None and payment.log > lower:
                lower = payment.log
                below.append((surface, payment))
        done.append(f"{plan.cells}^2")
    words = f"value function with a target in two states, cells: {', '.join(done)}"
    return upper, None if lower == -math.inf else lower, words, (above, below)


def _plan(horizon: float, floor: float, cells: int) -> Plan:
    return Plan(cells=cells, growth=_GROWTH, lead=_LEAD / cells * horizon, floor=floor)


def _cells(horizon: float, patches: float) -> int:
    """How many cells an axis about so many patches allow."""
    cells = _FEWEST
    while cells**2 * len(slab_times(horizon, _plan(horizon, 0.0, cells))) < patches:
        cells += 1
    return cells


def _simplified(target: Region) -> Region:
    """A half-space along a state as a box, whose ends are exact."""
    form = target.form
    if isinstance(form, Faces) and not form.axial and target.center is None:
        units = (np.count_nonzero(form.normals, axis=1) == 1).all() and np.isin(form.normals, (-1.0, 0.0, 1.0)).all()
        if units:
            around = form.hull()
            return Box(around.lo, around.hi, coordinates=target.coordinates)
    return target


def _aim(problem: Problem, model: Model, target: Region, *, upper: bool) -> Aim:
    room = limits_of(problem)
    ends = [[*room.inner_low], [*room.inner_high]] if upper else [[*room.outer_low], [*room.outer_high]]
    starts, open_faces = starts_of(problem), list[tuple[int, int]]()
    goals = sides_of(target) if target.form.axial else [(math.inf, -math.inf)] * 2
    floats = plane_of(problem, model, (0.0, 0.0), (0.0, 0.0), starts)
    for axis, side in _FACES:
        place, (low, high) = ends[side][axis], goals[axis]
        other = goals[1 - axis]
        whole = other[0] <= ends[0][1 - axis] and ends[1][1 - axis] <= other[1]
        if whole and (place <= high if side else low <= place):  # the face lies in the target
            begin, across = (low, low - starts[axis][0]) if side else (high, starts[axis][1] - high)
            cut = begin + (1 if side else -1) * max(_DEEP * across, 0.0)
            ends[side][axis] = min(place, cut) if side else max(place, cut)
        elif not math.isfinite(place):
            reached = reach_of(problem, lambda t, x, y: floats.drift(t, x, y), floats.square, _BEYOND)
            ends[side][axis] = float(reached[side][axis])
            open_faces.append((axis, side))
    if not all(low < high for low, high in zip(*ends)):
        raise InfeasibleError("the safe set has no interior.")
    plane = replace(floats, low=(ends[0][0], ends[0][1]), high=(ends[1][0], ends[1][1]))
    return Aim(plane=plane, model=model, target=target, open=tuple(open_faces), upper=upper, points=points_of(problem))


def _floor(aim: Aim) -> float:
    """log w, w a share of the probability of failing that coarse proposals find."""
    floor = math.log(_SHARE)
    for _ in range(_ROUNDS):
        plan = Plan(cells=_COARSE, growth=0.4, lead=0.02 * aim.plane.horizon, floor=floor)
        surface = propose_to_target(aim.plane, plan, aim.target, upper=True)
        if surface is None:
            break
        fate = Fate.of(surface.axes, aim.target)
        level = extreme_over(surface, aim.plane.starts, upper=True)
        least = min(_around(surface, ~fate.alive)[0], 0.0)
        share = max(-math.expm1(min(least - level, 0.0)), 1e-3)  # of e^V that is not w
        found = min(max(level + math.log(share * _SHARE), -40.0), _HIGHEST)
        if abs(found - floor) < 0.3:
            break
        floor = found
    return floor
