"""Bounds of the probability of failing within the horizon, from above and from below, refined until they are close."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np

from certbound.arrays import Array, Mask
from certbound.problem.goals import check_end
from certbound.problem.problem import Problem
from certbound.problem.sets import Box, Region
from certbound.problem.systems import DiscreteSystem
from certbound.rigor.intervals import Interval
from certbound.values.charts import Chart, Charts, from_probability
from certbound.values.discrete.cubic import CubicTransition, all_alike, cubic_transition
from certbound.values.discrete.fields import Tables
from certbound.values.discrete.functions import ValueFunction
from certbound.values.discrete.induction import (
    AnyTransition,
    Parts,
    Zones,
    assembled,
    back_above,
    back_below,
    final,
    jointly,
    nodes_below,
    values_above,
    zones_of,
)
from certbound.values.discrete.layout import (
    Boxes,
    FailureBounds,
    boxes_of,
    grid_of,
    order_of,
    seconds_of,
    shares_of,
    start_grid,
    widths_of,
    without_hopeless,
)
from certbound.values.discrete.scaled import ScaledDynamics, ScaledTransition, dynamics_of, noise_of
from certbound.values.discrete.shocks import Inapplicable, shocks_of_start
from certbound.values.discrete.steps import Step
from certbound.values.discrete.transitions import Transition
from certbound.values.discrete.uniform_noise import LineTables, UniformTables, UniformTransition
from certbound.values.grids import Grid, corners
from certbound.values.sets import active_at, contains, respected
from certbound.watch import OutOfTime, poll

MOST_STATES = 3
_UNIFORM_FLOOR = 1e-9  # means over boxes are known up to an absolute error
_MOST_STEPS = 100_000
_MOST_NODES = 3_000_000
_NODE_SECONDS = {False: 1e-4, True: 2e-3}
"""Roughly what a node of a first grid takes, without and with a common factor in the noise; measured, for refusing."""
_PATIENCE = 1.0  # seconds for which grids are refined although the question is answered
_CHARTED = 300_000  # parts of cells that a map has at most
_APART = 20_000  # cells from which on both sides are worth two threads
_FLOOR = 1e-16  # where what lies beyond ten standard deviations begins to count


def bound_failure(
    problem: Problem,
    *,
    target: Region | None = None,
    since: int = 0,
    until: int | None = None,
    ratio: float = 1.05,
    delta: float | None = None,
    seconds: float = 20.0,
    parts: int = 4,
) -> FailureBounds:
    """Bound the probability of failing, on finer and finer grids.

    Failing is to break a constraint at a step of its window; with a ``target``, to break one before the target was
    entered, or never to enter it.

    Parameters
    ----------
    problem : Problem
        In discrete time, with at most three states and Gaussian noise on each.
    target : Region, optional
        Set that ends the danger.
    since : int
        First step at which it does.
    until : int, optional
        Where the target must be stayed in until the horizon: the last step at which it may be entered.
    ratio : float
        Stop once upper <= ratio * lower.
    delta : float, optional
        Stop also once upper is a hundredth of it, or lower a hundred times (or half).
    seconds : float
        Stop before a grid whose cells, at fixed rates, would take longer than this with all before it.
    parts : int
        Parts along each side of the set of disturbances.

    Raises
    ------
    Inapplicable
        If value functions do not fit the problem; the message says why.
    """
    work = Work(problem, target, parts, since, until)
    begun = time.perf_counter()
    upper, lower, spent = 1.0, 0.0, 0.0
    tried, cells = list[tuple[float, float, float]](), tuple[int, ...]()
    shares = work.first_shares(seconds)
    while shares:
        if tried:
            affordable = partial(work.fits, seconds=seconds - spent)
            shares = without_hopeless(shares, tried[-1], ratio, order_of(work.shocks, work.cubic), affordable)
        share = shares.pop(0)
        layout = work.layout(share)
        if layout is None:
            if not tried:
                raise Inapplicable(work.too_large)
            break
        finest = max((grid.shape for grid in layout), key=math.prod)
        if not tried:
            work.check_first(math.prod(finest), seconds)
        cost = work.cost(layout)
        if tried and spent + cost > seconds:
            break
        try:
            found = work.bounds(layout, share)
        except (Inapplicable, OutOfTime):
            if not tried:
                raise
            break
        spent += cost
        upper, lower, cells = min(upper, found[0]), max(lower, found[1]), finest
        if not tried:
            shares = [other for other in shares_of(work.n, work.shocks, cubic=work.cubic) if other < share]
        tried.append((share, *found))
        settled = delta is not None and spent > _PATIENCE and (upper <= delta / 100 or lower >= min(100 * delta, 0.5))
        if upper <= ratio * lower or settled or upper < (_UNIFORM_FLOOR if work.shocks.uniform else _FLOOR):
            break
    seconds = time.perf_counter() - begun
    return FailureBounds(
        upper=upper, lower=lower, cells=cells, share=tried[-1][0], seconds=seconds, tried=tuple(tried)
    )


class Work:
    """One problem: its noise, its boxes, its steps."""

    too_large = (
        f"value functions would need more than {_MOST_NODES} nodes: the safe set is very many standard "
        "deviations of the noise wide. Use another engine, which is at its best there."
    )

    def __init__(
        self, problem: Problem, target: Region | None, parts: int, since: int = 0, until: int | None = None
    ) -> None:
        system = problem.system
        if not isinstance(system, DiscreteSystem):
            raise Inapplicable("this engine's backward induction needs discrete time.")
        if system.dimension > MOST_STATES:
            raise Inapplicable(f"value functions on grids take at most {MOST_STATES} states, not {system.dimension}.")
        check_end(problem, "a step by step induction")
        if problem.horizon > _MOST_STEPS:
            raise Inapplicable(f"a step by step induction takes at most {_MOST_STEPS} steps, not {problem.horizon}.")
        self.problem, self.target, self.n, self.since, self.until = problem, target, system.dimension, since, until
        self.horizon, self.ending = int(problem.horizon), target if since == 0 and until is None else None
        asked = problem.constraints  # which refuses a problem with a target of its own
        self.limits = problem.safe if problem.ending else asked
        self.beyond = 0.0 if problem.ending else 1.0
        self.dynamics = dynamics_of(problem, parts)
        self.shocks = noise_of(problem, self.dynamics)
        self.boxes: Boxes = boxes_of(problem, self.shocks, self.dynamics)
        self.beyond_below = 0.0 if self.boxes.cut else self.beyond
        self.start_shocks = shocks_of_start(problem.initial.covariance) if problem.initial.random else None
        self.random = self.start_shocks is not None
        self._alike = target is None and all_alike(self.dynamics, self.shocks)
        self.cubic = False  # whether functions have second derivatives at the nodes
        self._last: tuple[object, AnyTransition] | None = None
        self._lengths: dict[int, list[tuple[Array, Array]]] = {}
        self._starts: dict[float, Grid] = {}

    def check_first(self, nodes: int, seconds: float) -> None:
        """Refuse a first grid that would take several times the ``seconds`` that may be spent."""
        rounds = 1 if self.dynamics.steady else self.horizon
        needed = nodes * rounds * _NODE_SECONDS[self.shocks.common]
        if needed > 4 * seconds:
            raise Inapplicable(
                f"value functions would take about {needed:.0f} s on their coarsest grid, of {nodes} cells, and "
                f"{seconds:g} s may be spent: the safe set is many standard deviations of the noise wide. Use another "
                "engine, which is at its best there."
            )

    def first_shares(self, seconds: float) -> list[float]:
        """Sizes of cells to try; such as suit cubics where these may serve, and the first of them costs little."""
        shares = shares_of(self.n, self.shocks, cubic=True)
        layout = self.layout(shares[0]) if self._alike else None
        fits = layout is not None and self.cost(layout) <= seconds / 4 and bool(self.zones(layout[-1], 0).safe.all())
        return shares if fits else shares_of(self.n, self.shocks)

    def cost(self, layout: list[Grid]) -> float:
        """Seconds that a layout stands for, at fixed rates: bounds must not depend on the machine's load."""
        boxes = float(self.dynamics.parts) ** len(self.problem.system.disturbance_names)
        return boxes * (1 if self.until is None else 3) * seconds_of(layout, self.shocks)  # functions

    def fits(self, share: float, seconds: float) -> bool:
        """Whether grids with cells of this size exist and cost no more."""
        layout = self.layout(share)
        return layout is not None and self.cost(layout) <= seconds

    # ---- grids -----------------------------------------------------------------------------------------------

    def layout(self, share: float) -> list[Grid] | None:
        """The grids of all steps (step 0 is used for random starts only); None if they are too large."""
        grids: list[Grid] = []
        made: dict[bytes, Grid] = {}
        for t in range(self.horizon + 1):
            low, high = self.boxes.low[t], self.boxes.high[t]
            active = active_at(self.limits, t)
            moving = any(c.region.moving for c in active) or (self.target is not None and self.target.moving)
            key = b"".join([low.tobytes(), high.tobytes(), repr([id(c) for c in active]).encode()])
            key += repr(t if moving else 0).encode()
            if key not in made:
                when = 0 if self.dynamics.steady else min(t, self.horizon - 1)
                lengths = self._lengths_at(when, t)
                made[key] = grid_of(low, high, lengths, share, active, self.target, self.shocks, t)
            grids.append(made[key])
            if math.prod(grids[-1].node_shape) > _MOST_NODES:
                return None
        return grids

    def _lengths_at(self, when: int, t: int) -> list[tuple[Array, Array]]:
        if t not in self._lengths:
            self._lengths[t] = widths_of(self.problem, self.dynamics, self.shocks, self.boxes, t, when)
        return self._lengths[t]

    # ---- both bounds -----------------------------------------------------------------------------------------

    def bounds(self, grids: list[Grid], share: float) -> tuple[float, float]:
        """(upper, lower) from the grids."""
        end = 0 if self.random else 1
        above: Parts | ValueFunction
        below: Parts | ValueFunction
        if self.until is None:
            *_, (_, above, below) = self._backward(grids, share, end)
        else:
            above, below = self._staying(grids, share, end, self.until)
        upper, lower = self.at_random(above, below) if self.random else self.over_start(above, below, share)
        leak = self.boxes.leak * (1 + 1e-9)
        return min(max(upper, 0.0), 1.0), max(lower - leak, 0.0)

    def _backward(
        self, grids: list[Grid], share: float, end: int
    ) -> Iterator[tuple[int, ValueFunction, ValueFunction]]:
        """(step, function above, function below), from the horizon back to step ``end``."""
        last = self.horizon
        zones = [self.zones(grid, t) for t, grid in enumerate(grids)]
        above = final(grids[last], zones[last], above=True, beyond=self.beyond)
        below = final(grids[last], zones[last], above=False, beyond=self.beyond_below)
        yield last, above, below
        smooth = self._smooth_step(grids[end:], zones[last])
        self.cubic = smooth is not None
        used: AnyTransition | None = None
        with ThreadPoolExecutor(1) as beside:  # one side on another core: neither knows of the other
            for t in range(last - 1, end - 1, -1):
                poll(f"values at step {t}, {math.prod(grids[t].shape)} cells")
                before, step = used, smooth or self._kept_transition(t, grids[t], grids[t + 1], share)
                used = step
                if before is used and math.prod(grids[t].shape) >= _APART and self.shocks.sizes is None:
                    other = beside.submit(back_below, step, below, zones[t])
                    above, below = back_above(step, above, zones[t]), other.result()
                else:  # what a step keeps for later is made by one thread
                    above, below = back_above(step, above, zones[t]), back_below(step, below, zones[t])
                yield t, above, below

    def _staying(self, grids: list[Grid], share: float, end: int, until: int) -> tuple[Parts, Parts]:
        """Functions above and below at step ``end`` where the target, if met until a step, must be stayed in."""
        above: Parts = ()
        below: Parts = ()
        for t in range(self.horizon, end - 1, -1):
            poll(f"values at step {t}, {math.prod(grids[t].shape)} cells")
            zones, grid = self.zones(grids[t], t), grids[t]
            plain, done, undone = replace(zones, has_target=False), zones.done, zones.undone
            kept = replace(plain, safe=zones.safe & done, unsafe=zones.unsafe | undone)
            if t == self.horizon:
                ends = ((True, self.beyond), (False, self.beyond_below))
                high, low = (final(grid, kept, above=side, beyond=value) for side, value in ends)
            else:
                step = self._kept_transition(t, grid, grids[t + 1], share)
                high, low = back_above(step, high, kept), back_below(step, low, kept)
            if t == until:
                nodal, bend, every = 0.0 * high.nodal, 0.0 * high.bend, np.ones(grid.shape)
                failed = [assembled(grid, nodal, bend, every > 0, every, b) for b in (self.beyond, self.beyond_below)]
                above, below = jointly(failed[0], high, done), jointly(failed[1], low, ~undone)
            elif t < until:  # W is at least V
                above = jointly(back_above(step, above[0], plain, *above[1:]), high, ~undone)
                below = jointly(back_below(step, below[0], plain, *below[1:]), low, done)
        return above, below

    def _smooth_step(self, grids: list[Grid], zones: Zones) -> CubicTransition | None:
        """The step of all grids, if they are one, all of it safe and smooth."""
        fits = self._alike and len(grids) > 1 and len({id(grid) for grid in grids}) == 1 and bool(zones.safe.all())
        found = cubic_transition(self.dynamics, 0, grids[0], self.shocks) if fits else None
        self._alike = found is not None  # else not tried again
        return found

    def _kept_transition(self, t: int, grid: Grid, after: Grid, share: float) -> AnyTransition:
        """The transition of a step, the same one as long as nothing changes."""
        key = (grid, after, 0 if self.dynamics.steady else t)
        if self._last is None or self._last[0] != key:
            self._last = key, self.transition(t, grid, after, share)
        return self._last[1]

    def charts(self, share: float, steps: Sequence[int]) -> Charts:
        """Both bounds on all cells at some steps; lower ones only where constraints bound every state."""
        grids = self.layout(share)
        if grids is None:
            raise Inapplicable(self.too_large)
        upper, lower = [], []
        for t, above, below in self._backward(grids, share, 0):
            if t not in steps:
                continue
            above, below = above.flat(above=True), below.flat(above=False)
            parts = next((parts for parts in (8, 4, 2) if above.nodal.size * parts**self.n <= _CHARTED), 1)
            active, cells = active_at(self.limits, t), grids[t].cells()
            masks = [*respected(active, cells, t), respected(active, cells, t, interiors=True)[1]]
            whole = [np.kron(mask.reshape(grids[t].shape), np.ones([parts] * self.n, dtype=bool)) for mask in masks]
            safe, broken, inner = (mask > 0 for mask in whole)  # for starts, unlike later on, faces count
            axes, _, high = above.ranges_within(parts)
            log10 = from_probability(np.where(safe, high, 1.0), up=True)
            upper.append(Chart(time=float(t), axes=axes, log10=log10))
            if self.boxes.leak == 0:
                low = np.where(inner & ~broken, 0.0, below.ranges_within(parts)[1])
                lower.append(Chart(time=float(t), axes=axes, log10=from_probability(low, up=False)))
        return Charts(upper=tuple(upper[::-1]), lower=tuple(lower[::-1]))

    def zones(self, grid: Grid, t: int) -> Zones:
        return zones_of(grid, active_at(self.limits, t), self.target, t, ends=t >= self.since)

    def transition(self, t: int, grid: Grid, after: Grid, share: float) -> AnyTransition:
        if isinstance(self.dynamics, ScaledDynamics):
            return ScaledTransition(self.dynamics, t, grid, after, self.zones(grid, t).unsafe)
        step = self.dynamics.step(t, grid)
        if self.shocks.uniform:
            kind = LineTables if self.shocks.laplace or self.shocks.steps is not None else UniformTables
            return UniformTransition(step, kind(after, self.shocks, *step.hull(), fineness=max(2 / share, 4.0)))
        return Transition(step, Tables(after, self.shocks, *step.hull(), cubic=self.cubic))

    def at_random(self, above: ValueFunction | Parts, below: ValueFunction | Parts) -> tuple[float, float]:
        """Mean over a Gaussian start: one more convolution, read at the mean."""
        assert self.start_shocks is not None
        mean = self.problem.initial.mean
        tops, bottoms = (one if isinstance(one, tuple) else (one,) for one in (above, below))
        tables = Tables(tops[0].grid, self.start_shocks, mean, mean, cubic=self.cubic)
        point = Grid(axes=tuple(np.array([value]) for value in mean))
        image = (Interval.point(mean[None]), np.ones(1, dtype=bool))
        transition = Transition(Step(grid=point, vertices=[image], cells=[], pieces=np.empty((0, 0))), tables)
        highs = [at + error for one in tops for at, error in transition.at_nodes(tables.field(one, order=0))]
        slack = 0.0 if len(tops) == 1 else 1e-15
        return float(np.sum(highs)) + slack, float(nodes_below(transition, *bottoms, order=0)[0].item()) - slack

    def over_start(
        self, above: ValueFunction | Parts, below: ValueFunction | Parts, share: float
    ) -> tuple[float, float]:
        """Largest value over the initial set, on a grid of its own."""
        initial = self.problem.initial
        region = Box(initial.mean, initial.mean) if initial.random else initial
        tops, bottoms = (one if isinstance(one, tuple) else (one,) for one in (above, below))
        grid = self._starts.setdefault(share, start_grid(region, self._lengths_at(0, 0), share))
        cells = grid.cells()
        stays = self.target if self.until is not None and self.since == 0 else None
        if stays is not None and not contains(stays, cells, 0)[1].all():
            raise Inapplicable("value functions take no start in a target that is to be stayed in from then on.")
        meets, (safe, _) = ~contains(region, cells, 0)[1], respected(active_at(self.limits, 0), cells, 0)
        if self.ending is not None:
            meets &= ~(contains(self.ending, cells, 0)[0] & safe)
        if not meets.any():
            return 0.0, 0.0
        transition = self._kept_transition(0, grid, tops[0].grid, share)
        upper = self._highest(transition, tops, meets) if np.all(safe[meets]) else 1.0
        values = np.maximum.reduce(nodes_below(transition, *bottoms, order=0)).ravel()
        inside = contains(region, Interval.point(grid.nodes()), 0)[0]
        if self.ending is not None:
            inside &= contains(self.ending, Interval.point(grid.nodes()), 0)[1]
        return upper, float(values[inside].max()) if inside.any() else 0.0

    def _highest(self, transition: AnyTransition, above: Parts, meets: Mask) -> float:
        nodal, bend, known, level = values_above(transition, *above)
        top = np.maximum.reduce(corners(nodal))
        for i in range(self.n):
            top = top + np.maximum(-bend[i], 0.0) * transition.step.grid.widths(i) ** 2 / 8 * (1 + 1e-12)
        top = np.where(known, top, level).ravel()[meets]
        return float(top.max())
