"""Two states and windows: one surface a stage, joined at gates, from both sides.

Where a stage ends, V may jump in one direction. Above, V >= min(V_next, 0) where a path may pass the gate, and V >= 0
where it may not; below, V <= V_next where it may pass. The grids share their nodes, so that on a cell of both the gap
V_next - V is one polynomial with the differences of the data.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from certbound.arrays import Array, Mask
from certbound.problem.problem import Problem
from certbound.values.continuous.held_faces import check_noise
from certbound.values.continuous.hypotheses import (
    NEGLIGIBLE,
    Model,
    Need,
    chained,
    examine,
    extreme_over,
    patched_of,
    raised_above,
    top_of,
    up,
)  # fmt: skip
from certbound.values.continuous.payment import Payment, pay_lower, pay_upper
from certbound.values.continuous.plane.later import LaterAbove, LaterBelow, values_of
from certbound.values.continuous.plane.plane_below import SketchBelow
from certbound.values.continuous.plane.plane_grids import Pair, Plan, Plane, Source, slab_times
from certbound.values.continuous.plane.plane_reach import plane_of
from certbound.values.continuous.plane.solver import integrated
from certbound.values.continuous.plane.stages import Stage, master_nodes, nodes_within, stages_of
from certbound.values.continuous.plane.two_sides import RATE, Sketch
from certbound.values.continuous.surface import Surface
from certbound.values.room import points_of, starts_of
from certbound.watch import OutOfTime

_SHARES = (0.12, 0.5)  # of the patches, for one grid after the other
_COARSE = 24
_FEWEST = 16  # cells along each axis
_GROWTH = 0.25
_LEAD = 0.32  # of a stage over the number of cells
_LEAD_BELOW = 100.0  # of a stage over the square of that number
_PASSES = 2
_FACTOR = 1.12
_TOP = -0.02
_CAP = 50.0
_SHARE = 0.005  # of P: what V starts from, for lower bounds
_LIFTS = (0.0, 0.003, 0.01, 0.03, 0.1, 0.2)

Proposed = tuple[tuple[Surface, ...], Payment]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Chain:
    """One side's stages, and what is asked of them."""

    plane: Plane
    model: Model
    stages: list[Stage]
    starts: list[Pair]
    points: Array | None
    upper: bool


def bound_windows(
    problem: Problem, model: Model, deadline: float
) -> tuple[float, float | None, str, tuple[list[Proposed], list[Proposed]]]:
    """Natural logarithms of an upper and a lower bound (None: there is none), words, and what certificates state.

    Raises
    ------
    InfeasibleError
        Obstacles, moving, curved or oblique sets, constraints at time 0 alone, or noise that vanishes.
    """
    starts, points = starts_of(problem), points_of(problem)
    floats = plane_of(problem, model, (0.0, 0.0), (0.0, 0.0), starts)
    above, below = (
        _Chain(
            plane=floats, model=model, stages=stages_of(problem, floats, inner=side), starts=starts, points=points,
            upper=side,
        )
        for side in (True, False)
    )  # fmt: skip
    for stage in (*above.stages, *below.stages):
        check_noise(model, (stage.start, stage.end), list(zip(stage.low, stage.high)))
    patches = RATE * max(1.0, round(deadline - time.perf_counter(), 1))
    rough = _surfaces(above, _COARSE, 0.0, passes=0)
    level = 0.0 if rough is None else min(0.0, extreme_over(rough[0], starts, upper=True))
    upper, lower, done = 0.0, -math.inf, list[str]()
    proposed, lowered = list[Proposed](), list[Proposed]()
    for cells in sorted({_cells(above.stages, share * patches) for share in _SHARES}):
        with contextlib.suppress(OutOfTime):
            surfaces = _surfaces(above, cells, level, passes=_PASSES)
            if surfaces is not None:
                ready, payment = prove_chain_above(surfaces, above)
                proposed += [(ready, payment)] if payment.log < upper else []
                upper = min(upper, payment.log)
            surfaces = None if any(stage.cut for stage in below.stages) else _surfaces(
                below, cells, min(level, upper), passes=_PASSES
            )
            least = None if surfaces is None else prove_chain_below(surfaces, below)
            if surfaces is not None and least is not None and least.log > lower:
                lowered.append((tuple(surfaces), least))
                lower = least.log
        done.append(f"{cells}^2 in {len(above.stages)} stages")
    words = f"value function in two states, cells: {', '.join(done)}"
    return upper, None if lower == -math.inf else lower, words, (proposed, lowered)


def _cells(stages: Sequence[Stage], patches: float) -> int:
    """How many cells an axis so many patches allow."""
    cells = _FEWEST
    while cells**2 * sum(len(slab_times(s.end - s.start, _plan(s, cells, 0.0, upper=True))) for s in stages) < patches:
        cells += 1
    return cells


def _plan(stage: Stage, cells: int, level: float, *, upper: bool) -> Plan:
    span = stage.end - stage.start
    if upper:
        return Plan(cells=cells, growth=_GROWTH, lead=_LEAD / cells * span)
    lead = min(_LEAD_BELOW / cells**2, 0.4) * span
    return Plan(cells=cells, growth=_GROWTH, lead=lead, floor=level + math.log(_SHARE), below=True)


def _surfaces(chain: _Chain, cells: int, level: float, *, passes: int) -> list[Surface] | None:
    """The surfaces of all stages, each the best of a few proposals; None where one breaks down."""
    master, found = master_nodes(chain.stages, chain.plane, cells), list[Surface]()
    for stage in reversed(chain.stages):
        surface = _promising(chain, stage, master, level, found[0] if found else None, passes)
        if surface is None:
            return None
        found.insert(0, surface)
    return found


def _promising(
    chain: _Chain, stage: Stage, master: tuple[Array, Array], level: float, follows: Surface | None, passes: int
) -> Surface | None:
    plane, model = chain.plane, chain.model
    local = replace(
        plane, low=stage.low, high=stage.high, horizon=stage.end - stage.start, nodes=nodes_within(master, stage),
        drift=lambda t, x, y: plane.drift(stage.start + t, x, y),
        square=lambda t, x, y: plane.square(stage.start + t, x, y),
    )  # fmt: skip
    plan = _plan(stage, len(master[0]), level, upper=chain.upper)
    after = None if follows is None else values_of(follows)
    source: Source | None = None
    best: tuple[float, Surface] | None = None
    for _ in range(passes + 1):
        solver = (LaterAbove if chain.upper else LaterBelow)(local, plan, source, stage, after)
        surface = integrated(solver)
        if surface is None:
            break
        if not passes:
            return _placed(surface, stage)
        sketch = (Sketch if chain.upper else SketchBelow).of(_placed(surface, stage), model, chain.starts, level=level)
        cost = _cost(sketch, level)
        if best is None or cost < best[0]:
            best = cost, sketch.surface
        due = np.minimum(sketch.excess, _CAP)
        due = np.where(sketch.low < _TOP, due, 0.0) if isinstance(sketch, Sketch) else due
        more = Source.above(surface, _FACTOR * due)
        source = more if source is None else source.plus(more)
    return None if best is None else best[1]


def _cost(sketch: Sketch | SketchBelow, level: float) -> float:
    """About what log P loses."""
    return abs(sketch.estimate() - level)


def _placed(surface: Surface, stage: Stage) -> Surface:
    """The surface with its clock set to the stage."""
    times = stage.start + surface.times
    times[0], times[-1] = stage.start, stage.end
    return replace(surface, times=times)


def _within(axes: Sequence[Array], low: Sequence[float], high: Sequence[float]) -> Mask:
    """Cells that lie in a box."""
    rows = [(axis[:-1] >= a) & (axis[1:] <= b) for axis, a, b in zip(axes, low, high)]
    return np.asarray(np.logical_and.outer(*rows))


def _gap(here: Surface, follows: Surface) -> tuple[Mask, Array, Array]:
    """Cells that both grids share, and bounds of V_next - V there, in their order."""
    kept = [
        (axis >= other[0]) & (axis <= other[-1]) for axis, other in zip(here.axes, follows.axes)
    ]
    back = [(other >= axis[0]) & (other <= axis[-1]) for axis, other in zip(here.axes, follows.axes)]
    nodes = [axis[own] for axis, own in zip(here.axes, kept)]
    same = all(np.array_equal(mine, other[own]) for mine, other, own in zip(nodes, follows.axes, back))
    shared = _within(here.axes, [mine[0] for mine in nodes], [mine[-1] for mine in nodes])
    if not same or min(len(mine) for mine in nodes) < 2:
        return np.zeros(here.cells, dtype=bool), np.empty(0), np.empty(0)
    data = follows.values[0][back[0]][:, :, back[1]] - here.values[-1][kept[0]][:, :, kept[1]]
    still = np.zeros((1, *data.shape))
    joint = Surface(
        axes=tuple(nodes), times=np.array([0.0, 1.0]), values=np.stack([data, data]), start_rates=still, end_rates=still
    )
    low, high = joint.range_at(0)
    return shared, low.ravel(), high.ravel()


def missing_above(here: Surface, stage: Stage, follows: Surface | None) -> float:
    """What has to be added to V at the end of a stage so that it joins the next one from above, off the gate 0."""
    need = -here.range_at(-1)[0]
    passing = _within(here.axes, stage.gate_low, stage.gate_high)
    if follows is None:
        return float(max(np.where(passing, -np.inf, need).max(), 0.0))
    shared, _, high = _gap(here, follows)
    gap = np.full(here.cells, np.inf)
    gap[shared] = high
    return float(max(np.where(passing, np.minimum(gap, need), need).max(), 0.0))


def missing_below(here: Surface, stage: Stage, follows: Surface) -> float:
    """What has to be taken from V at the end of a stage so that it joins the next one from below, in the gate."""
    shared, low, _ = _gap(here, follows)
    gap = np.full(here.cells, -np.inf)
    gap[shared] = low
    return float(max(np.where(_meeting(here.axes, stage), -gap, -np.inf).max(), 0.0))


def _meeting(axes: Sequence[Array], stage: Stage) -> Mask:
    """Cells that hold all points of the gate, which has an interior."""
    rows = [(axis[:-1] < b) & (axis[1:] > a) for axis, a, b in zip(axes, stage.gate_low, stage.gate_high)]
    return np.asarray(np.logical_and.outer(*rows))


def prove_chain_above(surfaces: Sequence[Surface], chain: _Chain) -> Proposed:
    """The surfaces, raised by what they miss, and an upper bound of log P(failing), whatever they are."""
    ready: list[Surface] = []
    for surface, stage in zip(reversed(surfaces), reversed(chain.stages)):
        if not _spans(surface, stage, within=True):
            return (), Payment(log=0.0)
        surface = raised_above(surface)
        for _ in range(3):  # values are rounded when they are raised
            missing = missing_above(surface, stage, ready[0] if ready else None)
            if 0 < missing < math.inf:
                surface = surface.raised(up(missing) + 1e-12)
        if missing > 0:
            return (), Payment(log=0.0)
        ready.insert(0, surface)
    level = up(extreme_over(ready[0], chain.starts, upper=True))
    span = float(ready[-1].times[-1] - ready[0].times[0])
    need = Need(spare=NEGLIGIBLE / span, start=level, top=0.0)
    proofs = [examine(surface, chain.model, need, upper=True) for surface in ready]
    steps = np.concatenate([surface.steps for surface in ready])
    floor = float(ready[-1].range_at(-1)[0].min())
    best = Payment(log=0.0)
    for lift in _LIFTS:
        if level + lift >= best.log:
            break
        parts = [patched_of(proof, proof.ranges.residual_high, need, steps, lift) for proof in proofs]
        payment = pay_upper(chained(parts, ready, need), up(level + lift), floor + lift - 1e-15 * (1 + abs(floor)))
        best = min(best, replace(payment, lift=lift), key=lambda one: one.log)
    return tuple(ready), best


def prove_chain_below(surfaces: Sequence[Surface], chain: _Chain) -> Payment | None:
    """A lower bound of log P(failing) over the stages, whatever the surfaces are; None where none is positive."""
    ready: list[Surface] = []
    for surface, stage in zip(reversed(surfaces), reversed(chain.stages)):
        if stage.cut or not _spans(surface, stage, within=False):
            return None
        highest = max(top_of(surface), missing_below(surface, stage, ready[0]) if ready else -math.inf)
        if not math.isfinite(highest):
            return None
        surface = surface.raised(-highest - 1e-12 * (1 + highest)) if highest > 0 else surface
        if ready and missing_below(surface, stage, ready[0]) > 0:
            return None
        ready.insert(0, surface)
    level = extreme_over(ready[0], chain.starts, upper=False, points=chain.points)
    if level == -math.inf:
        return None
    level = -up(-level)
    need = Need(spare=NEGLIGIBLE / float(ready[-1].times[-1] - ready[0].times[0]), start=level, top=np.inf)
    proofs = [examine(surface, chain.model, need, upper=False) for surface in ready]
    if any(np.any(proof.ranges.high > 0) for proof in proofs):
        return None
    steps = np.concatenate([surface.steps for surface in ready])
    parts = [patched_of(proof, -proof.ranges.residual_low, need, steps) for proof in proofs]
    last = ready[-1]
    ceiling = float(np.where(_meeting(last.axes, chain.stages[-1]), last.range_at(-1)[1], -np.inf).max())
    return pay_lower(chained(parts, ready, need), level, ceiling)


def _spans(surface: Surface, stage: Stage, *, within: bool) -> bool:
    """Whether a surface spans its stage, in its box or around it."""
    if surface.times[0] != stage.start or surface.times[-1] != stage.end:
        return False
    ends = [(axis[0], axis[-1]) for axis in surface.axes]
    pairs = zip(ends, stage.low, stage.high)
    return all(a <= x and y <= b if within else x <= a and b <= y for (x, y), a, b in pairs)
