"""The door: bounds of the probability of leaving from both sides, for noise along one direction."""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Mask
from certbound.errors import InfeasibleError
from certbound.problem.problem import Problem
from certbound.rigor.intervals import Interval
from certbound.values.directed.directed_grids import PLANS, Layout
from certbound.values.directed.hats import Ranges, ranges_of
from certbound.values.directed.means import Means, means_of
from certbound.values.directed.noise_directions import directed
from certbound.values.directed.overshoots import Lines
from certbound.values.discrete import FailureBounds
from certbound.values.grids import Grid, corners
from certbound.values.sets import active_at, contains, respected
from certbound.watch import OutOfTime, poll

_STEP_SECONDS, _IMAGE_SECONDS = 5e-7, 1.5e-5  # what a node takes for one step, both bounds, and to find where it lands
_FIRST = 0.2  # share of the seconds for a first grid
_MOST_FIRST = 15  # times that, for which the coarsest one is refused
_TALLEST = 1e3


def bound_directed_failure(
    problem: Problem, *, seconds: float = 20.0, ratio: float = 1.05, delta: float | None = None
) -> FailureBounds:
    """Bound the probability of leaving, for noise along one direction of two states.

    Parameters
    ----------
    problem : Problem
        In discrete time, with two states, normal noise of one entry or on one state, and a set of starts.
    seconds : float
        About what may be spent, at fixed rates: bounds do not depend on the clock. The coarsest grid is finished in any
        case.
    ratio : float
        Stop once upper <= ratio * lower.
    delta : float, optional
        Stop also once upper is a hundredth of it, or lower a hundred times (or half).

    Raises
    ------
    InfeasibleError
        If the problem is another one; the message says why.
    """
    begun = time.perf_counter()
    work = directed(problem)
    layout = Layout(work)
    upper, lower, left = 1.0, 0.0, seconds
    tried: list[tuple[float, float, float]] = []
    cells: tuple[int, ...] = ()
    for share in (_FIRST, 1.0):
        found = _finest(layout, share * left, first=not tried)
        if found is None or (tried and found[0] >= tried[-1][0]):
            break
        apart, grid, cost = found
        try:
            most, least = _Induction(layout, grid).bounds()
        except (OutOfTime, InfeasibleError):
            if not tried:
                raise
            break
        left -= cost
        upper, lower, cells = min(upper, most), max(lower, least), grid.shape
        tried.append((apart, most, least))
        settled = delta is not None and (upper <= delta / 100 or lower >= min(100 * delta, 0.5))
        if upper <= ratio * lower or settled:
            break
    return FailureBounds(
        upper=upper, lower=lower, cells=cells, share=tried[-1][0], seconds=time.perf_counter() - begun,
        tried=tuple(tried),
    )  # fmt: skip


def _finest(layout: Layout, seconds: float, *, first: bool) -> tuple[float, Grid, float] | None:
    """The finest grid that takes no more, of a first one the coarsest at least: (share, grid, seconds)."""
    best = None
    for plan in PLANS:
        try:
            grid = layout.grid(plan)
        except InfeasibleError:
            if best is None:
                raise
            break
        nodes, horizon = len(grid.axes[0]) * len(grid.axes[1]), layout.work.horizon
        images = 1 if layout.work.steady else horizon
        cost = nodes * (horizon * _STEP_SECONDS + images * _IMAGE_SECONDS)
        if cost > seconds and (best is not None or not first):
            break
        if cost > _MOST_FIRST * seconds:
            raise InfeasibleError(f"value functions on lines would take about {cost:.0f} s on their coarsest grid.")
        best = plan[1], grid, cost
    return best


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Zone:
    """Cells that surely respect what is due at a step, and cells that surely do not."""

    safe: Mask
    broken: Mask


class _Induction:
    """Functions above and below on one grid, from the horizon back."""

    def __init__(self, layout: Layout, grid: Grid) -> None:
        self.layout, self.work, self.grid = layout, layout.work, grid
        self.ranges: Ranges = ranges_of(grid.axes[1], self.work.noise)
        self._means: Means | None = None
        self._zone: tuple[list[object], _Zone] | None = None

    def bounds(self) -> tuple[float, float]:
        """(upper, lower)."""
        last = self.work.horizon
        zone = self._zone_at(last)
        above: Lines | None = self._above(self._nodes(np.where(zone.safe, 0.0, 1.0)))
        below: Lines | None = self._below(self._nodes(np.where(zone.broken, -1.0, 0.0)), last)
        for t in range(last - 1, 0, -1):
            poll(f"values at step {t}, {self.grid.shape[0]} x {self.grid.shape[1]} cells")
            means, zone = self._means_at(t), self._zone_at(t)
            if above is not None:
                above = _kept(self._above(means.back(above, self._fixed_above(means, zone, t), 1.0)))
            if below is not None:
                fixed = self._fixed_below(means, zone, t)
                below = _kept(self._below(means.back(below, fixed, 0.0), t))
            if above is None and below is None:
                break
        return self._from_starts(above, below)

    def _from_starts(self, above: Lines | None, below: Lines | None) -> tuple[float, float]:
        grid, region = self.layout.start_grid(self.grid), self.work.problem.initial
        states = self.work.states(grid.cells())
        meets = ~contains(region, states, 0)[1]
        safe, broken = respected(active_at(self.work.limits, 0), states, 0)
        if not meets.any():
            meets[:] = True
        means = means_of(self.work, 0, grid, self.grid, self.ranges)
        if means is None:
            return 1.0, 0.0
        zone, upper, lower = _Zone(safe=safe, broken=broken), 1.0, 0.0
        if above is not None:
            fixed = np.where(meets, self._fixed_above(means, zone, 0), -np.inf)
            found = means.back(above, fixed, 1.0)
            upper = float(np.maximum.reduce(corners(found)).ravel()[meets].max())
        if below is not None:
            fixed = np.where(meets, self._fixed_below(means, zone, 0), -np.inf)
            lower = self._from_some(grid, -means.back(below, fixed, 0.0))
        return min(max(upper, 0.0), 1.0), min(max(lower, 0.0), 1.0)

    def _from_some(self, grid: Grid, values: Array) -> float:
        """The largest value of a function below at some starts: the least corner of the cells that may hold one."""
        hull, best = self.work.problem.initial.hull(), 0.0
        for share in itertools.product((0.0, 0.5, 1.0), repeat=2):
            point = np.clip(hull.lo + np.array(share) * (hull.hi - hull.lo), hull.lo, hull.hi)[None]
            if not contains(self.work.problem.initial, Interval.point(point), 0)[0].all():
                continue
            box, part = self.work.coordinates(Interval.point(point)), []
            for k, axis in enumerate(grid.axes):
                first = int(np.searchsorted(axis, box.lo[0, k], side="right"))
                last = int(np.searchsorted(axis, box.hi[0, k], side="left"))
                part.append(slice(max(min(first - 1, last), 0), last + 1))
            corner = values[part[0], part[1]]
            best = max(best, float(corner.min())) if np.isfinite(corner).all() and corner.size else best
        return best

    def _means_at(self, t: int) -> Means:
        if self._means is None or not self.work.steady:
            self._means = means_of(self.work, t, self.grid, self.grid, self.ranges)
        if self._means is None:
            raise InfeasibleError("value functions on lines would need more than half a gigabyte.")
        return self._means

    def _zone_at(self, t: int) -> _Zone:
        active = active_at(self.work.limits, t)
        key: list[object] = [id(one) for one in active]
        key += [t] if any(one.region.moving for one in active) else []
        if self._zone is None or self._zone[0] != key:
            closed = [one.closed() for one in active]  # an edge is a line of the grid, whose nodes take the worse side
            safe, broken = respected(closed, self.work.states(self.grid.cells()), t)
            self._zone = key, _Zone(safe=safe, broken=broken)
        return self._zone[1]

    def _nodes(self, cells: Array) -> Array:
        """At every node the largest value of the cells around it."""
        found = np.full(self.grid.node_shape, -np.inf)
        for part in corners(found):
            np.copyto(part, np.maximum(part, cells.reshape(self.grid.shape)))
        return found

    def _above(self, nodal: Array) -> Lines:
        return Lines(nodal=nodal, below=1.0, above=1.0)

    def _below(self, nodal: Array, t: int) -> Lines:
        """Minus a function below; what is beyond the ends of q has failed where that is sure, else nothing is known."""
        ends = self.layout.beyond(t, self.grid)[1]
        return Lines(nodal=nodal, below=-1.0 if ends[0] else 0.0, above=-1.0 if ends[1] else 0.0)

    def _fixed_above(self, means: Means, zone: _Zone, t: int) -> Array:
        """1 on cells that may be unsafe, from which paths may come beyond the lines, or that are unknown; else NaN."""
        free = np.zeros(len(zone.safe), dtype=bool)
        leaving = [means.leaves(side, edge=edge) for side, edge in enumerate(self.work.fails_on_ends(t + 1))]
        free[means.landing.live] = ~(leaving[0] | leaving[1])
        return np.where(free & zone.safe, np.nan, 1.0)

    def _fixed_below(self, means: Means, zone: _Zone, t: int) -> Array:
        """-1 on cells that have failed, or all whose paths have in a step; 0 on cells of which nothing is known."""
        live = means.landing.live
        lost, unknown, edges = zone.broken.copy(), ~live, self.work.fails_on_ends(t + 1)
        for side, sure in enumerate(self.layout.beyond(t + 1, self.grid)[0]):
            if sure:
                lost[live] |= means.leaves(side, wholly=True, edge=edges[side])
            else:
                unknown[live] |= means.leaves(side)
        return np.where(lost, -1.0, np.where(unknown, 0.0, np.nan))


def _kept(value: Lines) -> Lines | None:
    """None for a function that has grown beyond what says anything."""
    return value if value.size < _TALLEST else None
