"""Three states: propose V, hand what a proof would have to pay back to the proposal as a source, and prove it.

The way of `plane.two_sides`, for the upper bound. The surface is looked at in slices along the first state, which are
surfaces too, so that memory is that of the surface: about 200 bytes a patch.
"""

from __future__ import annotations

import itertools
import math
import time
from dataclasses import dataclass, replace

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.model import compile_numpy
from certbound.problem.problem import Problem
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
    joined,
    raised_above,
    sampled,
    up,
)  # fmt: skip
from certbound.values.continuous.payment import Payment
from certbound.values.continuous.plane import Plan, Source, integrated, slab_times
from certbound.values.continuous.space.space_box import closed_room
from certbound.values.continuous.space.space_grids import Space
from certbound.values.continuous.space.space_solver import SpaceSolver
from certbound.values.continuous.surface import Surface
from certbound.values.room import starts_of
from certbound.watch import OutOfTime

_FACTORS = (0.5, 0.6, 0.8, 1.12, 1.12, 1.12)
"""Of what a proof would pay, for one source after the other: a node takes the largest value around it, so that the
first ones are too large where they need not be."""
_TOP = -0.03  # where V is above, the proof may lift it over 0 instead
_CAP = 50.0
_GRANTED = 0.005  # eps that the proof may pay, in units of the bound, summed over the horizon
_SLACK = 0.02  # of log P, which bounds of R may add to its samples
_RATE = 4_000  # patches that are proposed and proved in a second of a processor
_CLOCKED = 2.5  # times the work, where the model depends on time: it is read anew on every slab
_MOST = 3_000_000  # patches, which take 600 MB
_CLOSE = 0.1
_WORTH = 0.03  # of log P: a pass that gains less is the last one
_HOPELESS = 60.0  # what a first proposal may lose (log P)
_SHARES = (0.05, 0.95)  # of the patches, for one grid after the other
_FAR = 1.5  # of log P, between the bound and a rough guess
_FEWEST = 8  # cells along an axis
_ROUGH = 0.7  # of log P, for the error of a rough guess


def three_states(problem: Problem, model: Model, deadline: float, hoped: float = math.inf) -> tuple[float, str]:
    """The upper bound of log P on a small grid and on a large one, and what was done.

    The seconds until the deadline are turned into a number of patches, so that the bound does not depend on the clock.

    Raises
    ------
    InfeasibleError
        The safe set is no box; a rough guess of log P is above ``hoped``; or nothing was proved, and some state has no
        noise of its own.
    """
    space = _space(problem, model)
    patches = min(_RATE * max(1.0, round(deadline - time.perf_counter(), 1)) / _effort(model), _MOST)
    upper, done = 0.0, []
    level = _rough_level(space)
    if level > hoped + _ROUGH:
        raise InfeasibleError(
            f"a rough guess of the probability, which nothing proves, is {math.exp(level):.1g}, more than is asked; "
            "value functions are left out, since another bound is proved: ask for them by name."
        )
    plans = {plan.cells: plan for plan in (_plan(space, level, share * patches) for share in _SHARES)}
    for plan in plans.values():
        try:
            sketch = _promising(space, model, plan)
            if sketch is not None:
                upper = min(upper, prove_in_space(sketch.surface, model, space.starts, sketch.near()).log)
        except OutOfTime:
            if upper < 0:
                break
            raise
        done.append(f"{plan.cells}^3")
    if upper == 0.0 and not all(space.noisy(axis) for axis in range(3)):
        raise InfeasibleError(
            "value functions in three states proved nothing: where a state has no noise of its own they have fronts "
            "that grids of this size do not follow."
        )
    words = f"value function in three states, cells: {', '.join(done)}"
    if level < 0 and upper > level + _FAR:
        words += f"; a rough guess that nothing proves is {math.exp(level):.1g}: more time, as by name, may prove more"
    return upper, words


def _effort(model: Model) -> float:
    """What a patch costs, relative to a drift of degree 2 or 3 without time and disturbance."""
    samples = float(np.prod(model.counts())) / 7**4
    return samples * (1 + len(model.branches)) / 2 * (1.0 if model.autonomous else _CLOCKED)


def prove_in_space(
    surface: Surface, model: Model, starts: list[tuple[float, float]], near: Array | None = None
) -> Payment:
    """As `prove_upper`, slice by slice; ``near`` as for `examine`."""
    surface = raised_above(surface)
    start = up(extreme_over(surface, starts, upper=True))
    need = Need(spare=NEGLIGIBLE / float(surface.times[-1]), start=start, top=0.0)
    per = int(np.prod(surface.cells[1:]))
    proofs, first_cells = [], []
    for first, part in surface.rows():
        own = None if near is None else near[:, first : first + part.cells[0]]
        proofs.append(examine(part, model, need, upper=True, near=own))
        first_cells.append(first * per)
    proof = Proof(
        ranges=joined([one.ranges for one in proofs]), slab=np.concatenate([one.slab for one in proofs]),
        cell=np.concatenate([one.cell + first for one, first in zip(proofs, first_cells)]),
    )  # fmt: skip
    payment, lift = cheapest(proof, need, surface, start)
    return replace(payment, lift=lift)


def _plan(space: Space, level: float, patches: float) -> Plan:
    """The finest grid with about so many patches; slabs grow fewer as fast as cells do."""
    share = 0.32 * min(max(-level / 3, 1.0), 3.0)
    for cells in itertools.count(_FEWEST):
        plan = Plan(cells=cells, growth=min(6 / cells, 0.35), lead=share / cells * space.horizon)
        if (cells + 1) ** 3 * len(slab_times(space.horizon, plan)) > patches:
            break
    return plan


def _rough_level(space: Space) -> float:
    """log P from a coarse proposal; 0 where that breaks down."""
    rough = integrated(SpaceSolver(space, Plan(cells=12, growth=0.4, lead=0.03 * space.horizon), None))
    return 0.0 if rough is None else min(0.0, float(extreme_over(rough, space.starts, upper=True)))


def _promising(space: Space, model: Model, plan: Plan) -> _Sketch | None:
    """The proposal whose bound will be the smallest."""
    surface, source = integrated(SpaceSolver(space, plan, None)), None
    if surface is None:
        return None
    sketch = best = _Sketch.of(surface, model, space.starts)
    if sketch.estimate() > sketch.start + _HOPELESS:
        return None
    for factor in _FACTORS:
        more = Source.above(sketch.surface, factor * sketch.needed(_TOP))
        source = more if source is None else source.plus(more)
        surface = integrated(SpaceSolver(space, plan, source))
        if surface is None:
            break
        sketch = _Sketch.of(surface, model, space.starts)
        gain = best.estimate() - sketch.estimate()
        best = min(best, sketch, key=lambda one: one.estimate())
        if gain < _WORTH or best.estimate() < best.start + _CLOSE:
            break
    if best.estimate() >= 0 or not covers(best.surface, space.horizon, space.low, space.high, within=True):
        return None
    return best


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Sketch:
    """A proposal with samples of what its proof would pay for: R, what eps pays of it, and V's least values."""

    surface: Surface
    start: float
    highest: Array
    paid: Array
    low: Array

    @classmethod
    def of(cls, surface: Surface, model: Model, starts: list[tuple[float, float]]) -> _Sketch:
        start = extreme_over(surface, starts, upper=True)
        found = [sampled(part, model) for _, part in surface.rows()]
        highest, low, high = (np.concatenate(parts, axis=1) for parts in zip(*found))
        paid = _GRANTED / float(surface.times[-1]) * np.exp(np.minimum(start - high, 50.0))
        return cls(surface=surface, start=start, highest=highest, paid=paid, low=low)

    @property
    def excess(self) -> Array:
        return np.maximum(self.highest - self.paid, 0.0)

    def needed(self, top: float) -> Array:
        """The source that would do where V is below ``top``."""
        return np.where(self.low < top, np.minimum(self.excess, _CAP), 0.0)

    def estimate(self) -> float:
        """About what the proof will find."""
        return self.start + min(lift + float(rates @ self.surface.steps) for lift, rates in self._rates())

    def _rates(self) -> list[tuple[float, Array]]:
        """lam of each slab for every lift."""
        return [(lift, np.where(self.low < -lift, self.excess, 0.0).max(axis=(1, 2, 3))) for lift in LIFTS]

    def near(self) -> Array:
        """How far above its samples R may be bounded without a larger payment, and a little farther."""
        lift, rates = min(self._rates(), key=lambda pair: pair[0] + float(pair[1] @ self.surface.steps))
        allowed = rates[:, None, None, None] + self.paid - np.maximum(self.highest, 0.0)
        slack = _SLACK * (1 / float(self.surface.times[-1]) + 1 / (self.surface.slabs * self.surface.steps)) / 2
        return np.where(self.low < -lift, np.maximum(allowed, 0.0) + slack[:, None, None, None], np.inf)


def _space(problem: Problem, model: Model) -> Space:
    drift, square = compile_numpy(model.drift.tape), compile_numpy(model.square.tape)
    corners = [[float(value.mid) for value in branch] for branch in model.branches]

    def drifts(t: float, *x: Array) -> Array:
        return np.array([np.moveaxis(drift(t, *x, *corner), -1, 0) for corner in corners])

    def squares(t: float, *x: Array) -> Array:
        return np.moveaxis(square(t, *x), (-2, -1), (0, 1))

    low, high = closed_room(problem, drifts, squares)
    return Space(
        low=low, high=high, horizon=float(problem.horizon), drift=drifts, square=squares, starts=starts_of(problem),
        autonomous=model.autonomous,
    )  # fmt: skip
