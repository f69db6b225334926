"""A region with curved walls: propose V, hand what a proof would have to pay back as a source, and prove it.

The way of `two_sides`, with what the region meets of each cell in place of all cells.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from certbound.arrays import Array, Index
from certbound.errors import InfeasibleError
from certbound.problem.problem import Problem
from certbound.problem.sets import Region as Set
from certbound.values.continuous.curved.boundaries import Walls
from certbound.values.continuous.curved.continuation import propose_within
from certbound.values.continuous.curved.cuts import Cuts
from certbound.values.continuous.curved.proof import Lot, highest_over, look_over, prove_within, raised_over_walls
from certbound.values.continuous.curved.region import Region, region_of
from certbound.values.continuous.held_faces import check_noise
from certbound.values.continuous.hypotheses import LIFTS, Model, covers, extreme_over
from certbound.values.continuous.plane import (
    Found,
    Plan,
    Plane,
    Source,
    bound_box,
    floats_of,
    held_plane,
    released,
    rough_level,
    slab_times,
)
from certbound.values.continuous.residual import sample_in_plane, value_range
from certbound.values.continuous.surface import Surface
from certbound.values.room import limits_of, starts_of
from certbound.watch import OutOfTime

if TYPE_CHECKING:
    from certbound.values.continuous.curved.target_ramps import TargetRamps

_FACTOR = 1.12
_TOP = -0.1  # where V is above, the proof may lift it over 0 instead
_CAP = 50.0
_GRANTED = 0.005  # eps that the proof may pay, in units of the bound, summed over the horizon
_RATE = 7_000  # patches that are proposed and proved in a second
_PASSES = 2
_CLOSE = 0.05
_HOPELESS = 60.0  # what a first proposal may lose (log P)
_VARIED = 1.0  # about how much V varies on a patch
_SHARES = (0.1, 1.0)  # of the patches, for one grid after the other
_STEEP = 1.0  # how far V falls at most over a cell at a wall, at the horizon
_SAMPLES = (4, 5, 5)
_SELDOM = math.log(1e-7)  # log P below which U itself is not proposed
_LEAST, _COST, _MOST = 2.5, 0.0075, 60  # seconds that it takes, about those of a proposal over cells^2, most cells
_BELOW, _LEAST_BELOW = 0.8, 8.0  # of as many seconds again, for the lower bound; with fewer it has to decide
_FEWEST_BELOW = 40  # cells without which there hardly is one
_NEARLY = 0.3  # of log P above a rough guess: then log U is proposed, too
_RANK = 1e-9  # of the squared noise: a smaller share in some direction everywhere is none
Squares = Callable[[float, Array, Array], Array]
Between = Callable[[Problem, Model, Plane, Plane | None, float, float, Callable[[float, float], Found]], Found]
_ALIKE = 0.03  # of log P, which a smaller box may add to a rough guess


def bound_region(problem: Problem, model: Model, deadline: float, wanted: float, between: Between) -> Found:
    """The upper bound on one grid after another, and the lower one where that is above ``wanted``.

    In a box ``between`` (`straight.bound_between`) is asked first. Certificates know no curved limits.
    """
    plain, granted = model, max(1.0, round(deadline - time.perf_counter(), 1))
    plane, region, level, model = _setting(problem, model)
    if not region.walls.groups:
        upper, lower, words, stated = _in_box(problem, plain, model, (plane, level), deadline, wanted, between)
        return upper, lower, words.replace("two states", "two states on a box that few paths leave"), stated
    patches = _RATE * granted
    upper, done = 0.0, list[str]()
    served = plane.autonomous and len(model.branches) == 1 and level > _SELDOM
    if served and granted >= _LEAST:
        from certbound.values.continuous.curved.near_walls import bound_near_walls

        cells = min(math.isqrt(int(granted / _COST)), _MOST)
        upper = bound_near_walls(plane, region.walls, model, problem.initial, cells)
        done.append(f"{cells}^2")
    for share in _SHARES if upper > level + _NEARLY else ():
        plan = _plan(plane, level, share * patches)
        try:
            surface = _promising(plane, region.walls, model, plan, problem.initial)
            if surface is not None:
                upper = min(upper, prove_within(surface, region.walls, model, problem.initial).log)
        except OutOfTime:
            if upper < 0:
                break
            raise
        done.append(f"{plan.cells}^2")
    lower = None
    due = granted >= _LEAST_BELOW or -math.inf < wanted < level
    if upper > wanted and wanted < math.inf and served and due:
        from certbound.values.continuous.curved.near_walls_below import bound_near_walls_below

        cells = min(max(math.isqrt(int(_BELOW * granted / _COST)), _FEWEST_BELOW), _MOST)
        with contextlib.suppress(OutOfTime, InfeasibleError):  # noise that may vanish somewhere
            lower = bound_near_walls_below(problem, plane, region.walls, model, cells, math.exp(level))
        done.append(f"{cells}^2 below")
    words = f"value function in two states within curved limits, cells: {', '.join(done)}"
    return upper, lower, words, ([], [])


def ramps_for(plane: Plane, target: Set, cells: int, upper: bool) -> TargetRamps:
    """What proposes the probability of arriving in a target of axial faces."""
    from certbound.values.continuous.curved.target_ramps import ramps_to

    return ramps_to(plane, target, cells, upper)


def _in_box(
    problem: Problem, plain: Model, model: Model, rough: tuple[Plane, float], deadline: float, wanted: float,
    between: Between,
) -> Found:
    """Both bounds where limits are missing, which the box has as faces that count above and do not count below."""
    plane, level = rough
    held, rare = any(itertools.chain(*plane.held)), -math.inf
    if held:
        plane, written, rare = released(problem, plane, plain, level)
        if written is not None:
            model, level = written, rough_level(plane)
    outer = None if held or wanted == math.inf else _outer(problem, model, plane)

    def by_logs(deadline: float, wanted: float) -> Found:
        patches = _RATE * max(1.0, round(deadline - time.perf_counter(), 1))
        return bound_box(problem, model, (plane, outer), (level, patches, rare), wanted)

    if held:
        return by_logs(deadline, wanted)
    inner = plane if outer is None else replace(plane, cut=outer.cut)
    return between(problem, model, inner, outer, deadline, wanted, by_logs)


def _outer(problem: Problem, model: Model, plane: Plane) -> Plane | None:
    """The box for lower bounds: a side is a limit, or the box is only cut there; None where noise vanishes."""
    room = limits_of(problem)
    cut = [(low > a, high < b) for low, high, a, b in zip(plane.low, plane.high, room.inner_low, room.inner_high)]
    low = [here if own[0] else there for here, there, own in zip(plane.low, room.outer_low, cut)]
    high = [here if own[1] else there for here, there, own in zip(plane.high, room.outer_high, cut)]
    try:
        check_noise(model, (0.0, plane.horizon), list(zip(low, high)))
    except InfeasibleError:
        return None
    return replace(plane, low=(low[0], low[1]), high=(high[0], high[1]), cut=(cut[0], cut[1]))


def _setting(problem: Problem, model: Model) -> tuple[Plane, Region, float, Model]:
    """The problem in floats, the region, and about log P; the box is a small one if that makes no difference.

    Without walls the box ends at faces that no path crosses, and the model is written for their inner side.
    """
    drifts, squares = floats_of(model)
    found = []
    for near in (False, True):
        region = region_of(problem, drifts, squares, near=near)
        _refuse_noiseless(squares, region, float(problem.horizon))
        plane = Plane(
            low=region.low, high=region.high, horizon=float(problem.horizon), drift=drifts, square=squares,
            starts=starts_of(problem), autonomous=model.autonomous,
        )  # fmt: skip
        plane, own = (plane, model) if region.walls.groups else held_plane(plane, model)
        found.append((plane, region, _rough_level(plane, region.walls), own))
    return found[1] if found[1][2] < found[0][2] + _ALIKE else found[0]


def _refuse_noiseless(squares: Squares, region: Region, horizon: float) -> None:
    """The bound would hold, but no smooth V that is near the truth does."""
    points = np.meshgrid(*(np.linspace(low, high, 9) for low, high in zip(region.low, region.high)), indexing="ij")
    a = squares(horizon, *points) * np.ones((2, 2, 9, 9))
    if not np.all(np.isfinite(a)):
        raise InfeasibleError("the noise has no finite size somewhere in the safe set; value functions prove nothing.")
    if np.all(a[0, 0] * a[1, 1] - a[0, 1] ** 2 <= _RANK * (a[0, 0] + a[1, 1]) ** 2):
        raise InfeasibleError(
            "value functions within curved limits or among obstacles need noise of full rank, that is in every "
            "direction; here some has none (noise in the velocities only, say), and value functions prove nothing."
        )


def _plan(plane: Plane, level: float, patches: float) -> Plan:
    """The finest grid with about so many patches; slabs grow fewer as fast as cells do."""
    for cells in itertools.count(16):
        plan = _with(plane, cells, min(9 / cells, 0.3), level - 4)
        if cells**2 * len(slab_times(plane.horizon, plan)) > patches:
            break
    return plan


def _with(plane: Plane, cells: int, growth: float, floor: float) -> Plan:
    """A plan whose layers at the walls are resolved by its cells."""
    x, y = (np.linspace(low, high, 9) for low, high in zip(plane.low, plane.high))
    square = plane.square(plane.horizon, *np.meshgrid(x, y, indexing="ij"))
    width = [(high - low) / cells / 1.3 for low, high in zip(plane.low, plane.high)]
    ages = [2 * (1.3 * h / _STEEP) ** 2 / max(float(np.median(square[k, k])), 1e-300) for k, h in enumerate(width)]
    lead = max(0.32 / cells * plane.horizon, min(*ages, 0.1 * plane.horizon))
    return Plan(cells=cells, growth=growth, lead=lead, floor=floor)


def _rough_level(plane: Plane, walls: Walls) -> float:
    """log P from a coarse proposal; the floor is lowered until it does not matter."""
    if not walls.groups:
        return rough_level(plane)
    level = 0.0
    for floor in (-8.0, -20.0, -45.0):
        surface = propose_within(plane, _with(plane, 28, 0.4, floor), walls)
        if surface is None:
            continue
        level = min(level, _start(surface, plane))
        if level > floor + 2:
            break
    return level


def _start(surface: Surface, plane: Plane) -> float:
    return min(0.0, extreme_over(surface, plane.starts, upper=True))


def _promising(plane: Plane, walls: Walls, model: Model, plan: Plan, initial: Set) -> Surface | None:
    """The proposal whose bound will be the smallest."""
    surface = propose_within(plane, plan, walls)
    if surface is None:
        return None
    first = best = _Sketch.of(surface, walls, model, initial)
    if first.estimate() > first.start + _HOPELESS:
        return None
    sketch, source = first, None
    for _ in range(_PASSES):
        more = Source.above(sketch.surface, _FACTOR * sketch.needed(_TOP))
        source = more if source is None else source.plus(more)
        surface = propose_within(plane, plan, walls, source)
        if surface is None:
            break
        sketch = _Sketch.of(surface, walls, model, initial)
        best = min(best, sketch, key=lambda one: one.estimate())
        if best.estimate() < best.start + _CLOSE:
            break
    if best.estimate() >= 0:
        return None
    return best.surface if covers(best.surface, plane.horizon, plane.low, plane.high, within=True) else None


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Sketch:
    """A proposal with samples of what its proof would pay for, patch by patch: R, but for what eps pays."""

    surface: Surface
    start: float
    excess: Array
    low: Array
    slab: Index
    cell: Index

    @classmethod
    def of(cls, surface: Surface, walls: Walls, model: Model, initial: Set) -> _Sketch:
        cuts = Cuts.of(surface.axes, walls)
        surface = raised_over_walls(surface, cuts)
        start = highest_over(surface, walls, initial)

        def look(lot: Lot) -> tuple[Array, Array, Index, Index]:
            highest = sample_in_plane(lot.patches, lot.drifts, lot.squares, lot.place, _SAMPLES, upper=True)
            return highest, value_range(lot.patches)[0], lot.slab, lot.cell

        found = look_over(surface, cuts, model, _SAMPLES, look)
        highest, low, slab, cell = (np.concatenate(parts) for parts in zip(*found))
        paid = _GRANTED / float(surface.times[-1]) * np.exp(np.minimum(start - low - _VARIED, 50.0))
        return cls(surface=surface, start=start, excess=np.maximum(highest - paid, 0.0), low=low, slab=slab, cell=cell)

    def needed(self, top: float) -> Array:
        """The source that would do where V is below ``top``."""
        table = np.zeros((self.surface.slabs, int(np.prod(self.surface.cells))))
        np.maximum.at(table, (self.slab, self.cell), np.where(self.low < top, np.minimum(self.excess, _CAP), 0.0))
        return table.reshape(self.surface.slabs, *self.surface.cells)

    def estimate(self) -> float:
        """About what the proof will find."""
        best = np.inf
        for lift in LIFTS:
            worst = np.zeros(self.surface.slabs)
            np.maximum.at(worst, self.slab, np.where(self.low < -lift, self.excess, 0.0))
            best = min(best, lift + float(worst @ self.surface.steps))
        return self.start + best
