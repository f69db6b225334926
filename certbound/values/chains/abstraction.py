"""Backward induction with functions that are constant on cells: any step, any target, targets to be stayed in.

For a cell c, a box w_k of noise of probability at most p_k, and U_{t+1} at least V_{t+1} on every cell,
    V_t(x) <= sum_k p_k max of U_{t+1} over the cells that f(t, c, d) + G(t, c) w_k meets,   x in c,
whatever the noise does with the state; below with minima, least probabilities, and any one disturbance. Outside the
grid V is 1, as a constraint is broken there, or 0, where leaving the domain ends a path. Where nothing bounds a state
at some step, the grid ends far beyond simulated paths, and V is taken for 1 there from above, and for 0 from below.

With a target that is to be stayed in, W_t is the probability of failing of who has arrived, by the same step, 1 off the
target; V_t = W_t on the target.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Integers, Mask
from certbound.errors import InfeasibleError
from certbound.problem.model import Tape, compile_numpy
from certbound.problem.problem import Problem
from certbound.problem.sets import Region
from certbound.problem.systems import DiscreteSystem
from certbound.rigor.intervals import Interval
from certbound.values.chains.extremes import Extremes, places
from certbound.values.chains.pieces import pieces_of
from certbound.values.discrete import FailureBounds, evaluate
from certbound.values.grids import Grid, graded_axis
from certbound.values.sets import active_at, box_around, contains, respected
from certbound.watch import OutOfTime, poll

_SIDES = {1: (150, 600, 2400, 9600), 2: (40, 80, 160, 320)}
"""Cells along each side, grid after grid, by the number of states ..."""
_PIECES = {1: (0.8, 96), 2: (0.25, 16)}
"""... and pieces of each entry of the noise, by the number of entries: so many for each of them, at least so many."""
_QUERY_SECONDS = 7e-8
_CACHED = 60_000_000  # numbers of images that are kept
_PARTS = 4
_MOST_STEPS = 100_000
_SEEN, _LONG = 500, 5000  # steps of a simulation that are kept, and that it has, at most
_PATHS, _RARE = 400, 0.005  # simulated paths, and the share of their places at either end for which cells grow
_GROWTH, _FAR = 16.0, 20.0  # by how much, a length of the rest away, and so many of these away the grid ends


def bound_chain(
    problem: Problem, *, seconds: float = 20.0, ratio: float = 1.05, delta: float | None = None
) -> FailureBounds:
    """Bound the probability of failing from both sides, on finer and finer grids.

    Parameters
    ----------
    problem : Problem
        Discrete time, one or two states, a set of starts, and noise with one or two independent entries of a law known
        by name.
    seconds : float
        About what may be spent, at a fixed rate; the first grid is finished in any case.
    ratio : float
        Stop once upper <= ratio * lower.
    delta : float, optional
        Stop also once the question is settled: upper below it, or lower above it.

    Returns
    -------
    FailureBounds

    Raises
    ------
    InfeasibleError
        If the problem is none of these; the message says why.
    """
    begun, left = time.perf_counter(), seconds
    chain = _Chain(problem)
    upper, lower, share = 1.0, 0.0, 1.0
    cells: tuple[int, ...] = ()
    tried: list[tuple[float, float, float]] = []
    for side in _SIDES[chain.n]:
        chain.cut(side)
        grid = chain.grid(side)
        cost = _QUERY_SECONDS * math.prod(grid.shape) * chain.queries
        if tried and cost > left:
            break
        left -= cost
        try:
            most, least = chain.bounds(grid)
        except OutOfTime:
            if not tried:
                raise
            break
        upper, lower, cells, share = min(upper, most), max(lower, least), grid.shape, 1 / side
        tried.append((share, upper, lower))
        if upper <= ratio * lower or (delta is not None and (upper <= delta or lower > delta)):
            break
    return FailureBounds(
        upper=upper, lower=lower, cells=cells, share=share, seconds=time.perf_counter() - begun, tried=tuple(tried)
    )


def chain_grid(problem: Problem, side: int) -> Grid:
    """The grid of `bound_chain` with about so many cells along each side, which raises as that does."""
    return _Chain(problem).grid(side)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Sides:
    """Bounds on some boxes, shape (boxes,), or on the cells of a grid with a ring around, from above and below."""

    above: Array
    below: Array


class _Chain:
    """One problem: its noise, its sets, its steps."""

    def __init__(self, problem: Problem) -> None:
        system = problem.system
        if not isinstance(system, DiscreteSystem) or system.dimension not in _SIDES:
            raise InfeasibleError("value functions on chains serve one or two states in discrete time.")
        if problem.initial.random:
            raise InfeasibleError("value functions on chains do not serve a random start; use a set of starts.")
        if problem.horizon > _MOST_STEPS:
            raise InfeasibleError(f"value functions on chains take at most {_MOST_STEPS} steps.")
        self.problem, self.n, self.horizon = problem, system.dimension, int(problem.horizon)
        self.limits = problem.safe if problem.ending else problem.kept
        self.noise, self.entries = system.noise, system.noise_dimension
        self.cut(_SIDES[self.n][0])
        self.gain: Tape | Interval = Interval.point(system.noise_matrix) if system.gain is None else system.gain
        self.target: Region | None = None if problem.reach is None else problem.reach.region
        first, last = (0, self.horizon) if problem.reach is None else problem.reach.during or (0, self.horizon)
        self.window = int(first), int(last)
        self.stays = problem.reach is not None and problem.reach.stays
        if self.target is not None and not self.stays:
            self.horizon = self.window[1]
        self.boxes, self.corners = _disturbances(system)
        self.low, self.high = self._around()
        self.middle = self._middle() if np.isinf([self.low, self.high]).any() else (self.low, self.high)
        used = [node.args[0] for tape in self._tapes() for node in tape.nodes if node.op == "input"]
        self.steady = 0 not in used and problem.input_sequence is None

    def cut(self, side: int) -> None:
        """Cut the noise into pieces that suit so many cells along each side."""
        rate, least = _PIECES[min(self.entries, 2)]
        self.pieces = pieces_of(self.noise, 2 * (max(int(rate * side), least) // 2))

    @property
    def queries(self) -> int:
        """Boxes that are looked up for every cell."""
        return self.horizon * len(self.pieces.most) * (len(self.boxes) + len(self.corners)) * (1 + self.stays)

    def _tapes(self) -> list[Tape]:
        return [self.problem.closed_loop, *([self.gain] if isinstance(self.gain, Tape) else [])]

    def _around(self) -> tuple[Array, Array]:
        """Ends of what limits or the domain bound at every step, infinite where they do not."""
        if self.problem.ending:
            low, high = np.asarray(self.problem.domain.low), np.asarray(self.problem.domain.high)
        else:
            ends = [box_around(active_at(self.limits, t), self.n, t) for t in range(self.horizon + 1)]
            low, high = np.min([end[0] for end in ends], axis=0), np.max([end[1] for end in ends], axis=0)
        for i, name in enumerate(self.problem.system.states):
            if not low[i] < high[i]:
                raise InfeasibleError(f"value functions need a safe set with an interior, and `{name}` has none.")
        return low, high

    def _middle(self) -> tuple[Array, Array]:
        """Ends of where most paths are, limits included: a simulation in floats, of no consequence but for the grid."""
        rng, hull = np.random.default_rng(0), self.problem.initial.hull()
        x = rng.uniform(hull.lo, hull.hi, (_PATHS, self.n))
        tapes, middle = [compile_numpy(tape) for tape in self._tapes()], self.boxes[len(self.boxes) // 2].mid
        rows, gain, seen = self.problem.input_sequence, self.gain, [np.stack([hull.lo, hull.hi]), x]
        every = 1 + self.horizon // _SEEN
        for t in range(min(self.horizon, _LONG)):
            poll(f"simulated paths, step {t}")
            inputs = [] if rows is None else list(rows[t])
            noise = self.noise.sample(rng, _PATHS)
            with np.errstate(all="ignore"):
                factor = tapes[1](float(t), *x.T) if isinstance(gain, Tape) else gain.mid
                x = np.broadcast_to(tapes[0](float(t), *x.T, *inputs, *middle), x.shape)
                x = x + (factor * noise[:, None, :]).sum(axis=-1)
                inside = np.all((x >= self.low) & (x <= self.high) & np.isfinite(x), axis=1, keepdims=True)
            x = np.where(inside, x, hull.lo)
            seen += [x] if t % every == 0 or t + 1 == self.horizon else []
        low, high = np.quantile(np.concatenate(seen), [_RARE, 1 - _RARE], axis=0)
        low, high = np.minimum(low, hull.lo), np.maximum(high, hull.hi)
        low, high = np.where(np.isinf(self.low), low, self.low), np.where(np.isinf(self.high), high, self.high)
        size = np.maximum(np.abs(low), np.abs(high))
        least = 1e-3 * np.where(size > 0, size, 1.0)
        return np.where(high - low < least, low - least, low), np.where(high - low < least, high + least, high)

    def grid(self, side: int) -> Grid:
        """About so many cells along each side, with faces that follow the axes as nodes, and more where no limit is."""
        sets = [constraint.region for constraint in self.limits]
        sets += [] if self.target is None else [self.target]
        axes = []
        for i, (low, high) in enumerate(zip(*self.middle)):
            marks = [place for region in sets if not region.moving for place in _ends(region, self.n, i)]
            ends = [low - _FAR * (high - low) if np.isinf(self.low[i]) else low]
            ends += [high + _FAR * (high - low) if np.isinf(self.high[i]) else high]
            places = np.array(sorted({ends[0], low, high, ends[1]}))
            away = np.maximum(np.maximum(low - places, places - high), 0.0)
            axes.append(graded_axis(ends[0], ends[1], places, (high - low + _GROWTH * away) / side, marks))
        return Grid(axes=tuple(axes))

    # ---- the induction ---------------------------------------------------------------------------------------

    def bounds(self, grid: Grid) -> tuple[float, float]:
        """(upper, lower) from one grid."""
        cells = grid.cells()
        shape = (*grid.shape, 1)[:2]
        images = _Images(self, grid, cells)
        value, arrived = self._ended(cells)
        for t in range(self.horizon - 1, 0, -1):
            poll(f"values at step {t}, {len(cells)} cells")
            value, arrived = self._back(images, t, cells, self._ringed(value, shape), self._ringed(arrived, shape))
        value, arrived = self._ringed(value, shape), self._ringed(arrived, shape)
        return self._from_starts(grid, value, arrived)

    def _from_starts(self, grid: Grid, value: _Sides, arrived: _Sides) -> tuple[float, float]:
        start = self.problem.initial
        hull = start.hull()
        count = {1: 200, 2: 60}[self.n]
        lines = [np.linspace(a, b, count + 1) if a < b else np.array([a, b]) for a, b in zip(hull.lo, hull.hi)]
        parts = Grid(axes=tuple(lines))
        boxes, points = parts.cells(), Interval.point(parts.nodes())
        boxes = boxes[~contains(start, boxes, 0)[1]]
        points = points[contains(start, points, 0)[0]]
        most = self._back(_Images(self, grid, boxes), 0, boxes, value, arrived)[0].above.max(initial=0.0)
        least = self._back(_Images(self, grid, points), 0, points, value, arrived)[0].below.max(initial=0.0)
        return min(float(most), 1.0), max(float(least), 0.0)

    def _ended(self, cells: Interval) -> tuple[_Sides, _Sides]:
        """V and W at the horizon, on the cells."""
        safe, broken = respected(active_at(self.limits, self.horizon), cells, self.horizon)
        if self.target is None:
            value = _Sides(above=np.where(safe, 0.0, 1.0), below=np.where(broken, 1.0, 0.0))
            return value, value
        done, undone = contains(self.target, cells, self.horizon)
        late = self.horizon > self.window[1]  # it was to be met before
        arrived = _Sides(above=np.where(safe & done, 0.0, 1.0), below=np.where(broken | undone, 1.0, 0.0))
        return (_Sides(above=np.ones(len(cells)), below=np.ones(len(cells))) if late else arrived), arrived

    def _back(
        self, images: _Images, t: int, cells: Interval, value: _Sides, arrived: _Sides
    ) -> tuple[_Sides, _Sides]:
        """V and W one step back, on boxes."""
        safe, broken = respected(active_at(self.limits, t), cells, t)
        above, below = images.means(t, value)
        if self.stays and t >= self.window[1]:  # who has not arrived has failed, wherever the path ends
            above = below = np.ones(len(cells))
        if self.target is None:
            found = _Sides(above=np.where(safe, above, 1.0), below=np.where(broken, 1.0, below))
            return found, found
        done, undone = contains(self.target, cells, t)
        if self.stays:
            high, low = images.means(t, arrived)
            there = _Sides(above=np.where(safe & done, high, 1.0), below=np.where(broken | undone, 1.0, low))
        else:
            there = _Sides(above=np.zeros(len(cells)), below=np.zeros(len(cells)))
        if not self.window[0] <= t <= self.window[1]:
            done, undone = np.zeros_like(done), np.ones_like(undone)
        inside = np.where(done, there.above, np.where(undone, above, np.maximum(above, there.above)))
        least = np.where(done, there.below, np.where(undone, below, np.minimum(below, there.below)))
        return _Sides(above=np.where(safe, inside, 1.0), below=np.where(broken, 1.0, least)), there

    def _ringed(self, value: _Sides, shape: tuple[int, ...]) -> _Sides:
        """Tables over the cells with a ring around of what lies outside."""
        outside = 0.0 if self.problem.ending else 1.0
        above, below = value.above.reshape(shape), value.below.reshape(shape)
        for i in range(2):
            pads = [(1, 1) if k == i < self.n else (0, 0) for k in range(2)]
            cut = np.isinf([self.low[i], self.high[i]]) if i < self.n else np.zeros(2, dtype=bool)
            above = np.pad(above, pads, constant_values=[tuple(np.where(cut, 1.0, outside))] * 2)
            below = np.pad(below, pads, constant_values=[tuple(np.where(cut, 0.0, outside))] * 2)
        return _Sides(above=above, below=below)


class _Images:
    """Where boxes get to in one step: per box of disturbances and piece of the noise the cells that are met."""

    def __init__(self, chain: _Chain, grid: Grid, cells: Interval) -> None:
        self.chain, self.grid, self.cells = chain, grid, cells
        self.shape = (*(size + 2 for size in grid.shape), 1)[:2]  # of tables with a ring around
        size = len(cells) * len(chain.pieces.most) * 4 * (len(chain.boxes) + len(chain.corners))
        self.keeps = chain.steady and size <= _CACHED
        self.lost: dict[tuple[int, bool], Mask] = {}  # where the model is undefined
        self.kept: dict[tuple[int, bool], list[Integers]] = {}

    def means(self, t: int, value: _Sides) -> tuple[Array, Array]:
        """Bounds of sup_d E V_{t+1}(f + G w): from above over all disturbances, from below at their corners."""
        most, least = Extremes(value.above, np.maximum), Extremes(value.below, np.minimum)
        pieces, worst = self.chain.pieces, float(value.above.max())
        above = np.max([self._sum(t, k, most, pieces.most, True) for k in range(len(self.chain.boxes))], axis=0)
        below = np.max([self._sum(t, k, least, pieces.least, False) for k in range(len(self.chain.corners))], axis=0)
        return np.minimum(above * (1 + 1e-12) + pieces.rest * worst, 1.0), np.maximum(below * (1 - 1e-12), 0.0)

    def _sum(self, t: int, k: int, extremes: Extremes, weights: Array, above: bool) -> Array:
        total = np.zeros(len(self.cells))
        for boxes, weight in zip(self._met(t, k, above), weights, strict=True):
            if weight > 0:
                total += weight * extremes.over(boxes)
        return np.where(self.lost[k, above], 1.0 if above else 0.0, total)

    def _met(self, t: int, k: int, above: bool) -> Iterator[Integers]:
        """Places of the boxes of cells that are met, on the ringed grid, for each piece of the noise."""
        if not self.keeps:
            yield from self._computed(t, k, above)
            return
        if (k, above) not in self.kept:
            self.kept[k, above] = list(self._computed(t, k, above))
        yield from self.kept[k, above]

    def _computed(self, t: int, k: int, above: bool) -> Iterator[Integers]:
        chain, problem = self.chain, self.chain.problem
        box = (chain.boxes if above else chain.corners)[k]
        clock = [Interval.point(float(t)), *(self.cells[:, i] for i in range(chain.n))]
        rows = [] if problem.input_sequence is None else [Interval.point(float(u)) for u in problem.input_sequence[t]]
        image, bad, _ = evaluate(problem.closed_loop, [*clock, *rows, *(box[j] for j in range(len(box)))])
        gain: Interval = chain.gain if isinstance(chain.gain, Interval) else Interval.point(0.0)
        if isinstance(chain.gain, Tape):
            found, worse, _ = evaluate(chain.gain, clock)
            gain, bad = found.reshape(-1, *chain.gain.shape), bad | worse
        self.lost[k, above] = bad
        noise = chain.pieces.boxes
        for place in range(len(chain.pieces.most)):
            w = noise[place]
            ends = image + (gain * w).sum(axis=-1)
            yield self._indices(ends, bad)

    def _indices(self, ends: Interval, bad: Mask) -> Integers:
        """Places of the boxes of cells that hold the images; of all cells where these are unknown."""
        count = len(self.cells)
        first, last = np.zeros((2, count), dtype=int), np.zeros((2, count), dtype=int)
        for i, axis in enumerate(self.grid.axes):
            low = np.searchsorted(axis, np.broadcast_to(ends.lo[:, i], (count,)), side="left")
            high = np.searchsorted(axis, np.broadcast_to(ends.hi[:, i], (count,)), side="right")
            unknown = bad | ~np.isfinite(ends.lo[:, i]) | ~np.isfinite(ends.hi[:, i])
            first[i] = np.where(unknown, 0, low)
            last[i] = np.where(unknown, len(axis), high)
        return places(self.shape, first, last)


def _ends(region: Region, n: int, i: int) -> list[float]:
    """Where a region begins and ends along an axis."""
    places = region.places(n)
    if i not in places:
        return []
    hull = region.hull()
    return [float(end[places.index(i)]) for end in (hull.lo, hull.hi) if np.isfinite(end[places.index(i)])]


def _disturbances(system: DiscreteSystem) -> tuple[list[Interval], list[Interval]]:
    """Boxes that cover the disturbances, and their corners."""
    box = system.disturbance
    if box is None:
        return [Interval.point(np.zeros(0))], [Interval.point(np.zeros(0))]
    cuts = [np.linspace(a, b, _PARTS + 1) if a < b else np.array([a, b]) for a, b in zip(box.low, box.high)]
    parts = itertools.product(*(list(itertools.pairwise(cut)) for cut in cuts))
    boxes = [Interval(np.array([p[0] for p in part]), np.array([p[1] for p in part])) for part in parts]
    corners = itertools.product(*(sorted({float(a), float(b)}) for a, b in zip(box.low, box.high)))
    return boxes, [Interval.point(np.array(corner)) for corner in corners]
