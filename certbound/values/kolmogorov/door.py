"""The door: certified bounds of the probability of failing by a solution whose error the process carries (Thm K10)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from time import perf_counter

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.problem import Problem
from certbound.problem.sets import GaussianStart
from certbound.values.kolmogorov.axes import plan_axes
from certbound.values.kolmogorov.box_setting import Setting, stages_of
from certbound.values.kolmogorov.carry import Side
from certbound.values.kolmogorov.error_shares import Shape, better_shapes
from certbound.values.kolmogorov.splines import Derivatives, cells_of, unit
from certbound.values.kolmogorov.start_law import StartMean
from certbound.values.kolmogorov.witness import Witness
from certbound.watch import poll, seconds_left

_COARSEST = {2: 0.08, 3: 0.1}  # cell of the first grid, as a share of the range
_STEPS = 0.8  # steps of the first grid for each of its cells along the range; better ones follow the error
_PASSES, _USUAL = 12, 5  # at most, and in most cases
_AT_LEAST = 8  # where that many serve: to end a little late is better than to have proved nothing
_ROUGH, _CORRECTED = 0.4, 0.4  # a solution with a look at it, and one correction, in units of a pass that proves
_WHOLE = _USUAL + _ROUGH + _CORRECTED  # what a grid takes
_ROUNDS = 2  # grids whose axes are improved, before the first one on which anything is proved
_STALLED = 0.7  # of what was left before: where a pass leaves more, v is lifted; two that do are the last ones
_LIFT = 0.01  # of v, where failing is nearly sure: corners that no grid resolves leave residuals there
_CLOSE = 1.01  # ratio of the bounds that ends the search
_PAID = 0.005  # of the answer: what is left of the residual that need not be carried any more
_ENOUGH = 0.97  # of the target: a bound that low may be written down with fewer digits
_GROWTH = 6.0  # the largest factor of work from one grid to the next
_LEAST = 1.5  # the smallest one that is worth it
_CHEAP = 0.1  # of the work that is left: a proof that takes no more is made, whether it decides or not
_PROVED = 2.7  # what is proved of the error, in units of what the first pass finds of it without proof, measured
_SHARE, _ORDER = 0.8, 3.0  # of what the target leaves, that an error may take; how fast errors fall with cells
_FAR = 2.0  # ratio of the coarsest solution to the target, beyond which it says which bound decides
_FEWEST = 8  # steps of a stage
_STARTS = 9  # points along each side of a start set
RATE = {2: 1.8e5, 3: 1.5e5}
"""Cells of space and time a second, by the number of states: a pass of residuals and correction on one core."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Bounds:
    """Certified bounds of the probability of failing from the worst start.

    Attributes
    ----------
    lower, upper : float
    cells : tuple of int
        Of the grid of the better of the two.
    steps : int
    runs : int
        Grids that were tried.
    estimate : float
        The probability by the numerical solution; nothing is proved of it.
    work : float
        Cells of space and time that passes went over.
    witnesses : tuple of Witness
        What proves the bounds, from coarse to fine: for certificates.
    search : Search, optional
        What goes on from here.
    """

    lower: float
    upper: float
    cells: tuple[int, ...]
    steps: int
    runs: int
    estimate: float
    work: float
    witnesses: tuple[Witness, ...] = ()
    search: Search | None = None


def bound_failing(
    problem: Problem, *, seconds: float = 20.0, delta: float = 0.0, before: Bounds | None = None
) -> Iterator[Bounds]:  # fmt: skip
    """Bound P(X_t leaves the safe set for some t <= T) from both sides, on finer and finer grids (Thm K10).

    Parameters
    ----------
    problem : Problem
        Continuous time, two or three states, limits along the coordinates, each in a window of its own; any noise.
    seconds : float
        How long to refine, in units of work (`RATE`), with what was done ``before``: the bounds do not depend on the
        machine or its load. Nothing is proved where the coarsest grid takes more.
    delta : float
        Where the numerical solution says on which side of ``delta`` the answer lies, only the bound that shows it is
        looked for; 0 for both.
    before : Bounds, optional
        What was found of the same problem with less work: the search goes on from there.

    Yields
    ------
    Bounds
        The best so far, after every side of every grid.

    Raises
    ------
    InfeasibleError
        The problem is not of this kind; the message says why.
    EnclosureError
        The model is undefined somewhere in the safe set.
    """
    rate = RATE[_dimension(problem)]
    known = None if before is None else before.search
    search = known if known is not None and known.problem is problem and known.delta == delta else None
    yield from (search or Search(problem, delta)).until(seconds * rate)


def _dimension(problem: Problem) -> int:
    if problem.system.dimension not in _COARSEST:
        raise InfeasibleError("values with a carried error serve two and three states here.")
    return problem.system.dimension


class Search:
    """Grids that get finer, and the bounds that they prove.

    Parameters
    ----------
    problem : Problem
    delta : float
        As of `bound_failing`.
    """

    def __init__(self, problem: Problem, delta: float) -> None:
        self.problem, self.delta = problem, delta
        self.stages = stages_of(problem)
        self.setting = self.stages[0]
        self.starts, self.cell = starts_in(problem), _COARSEST[_dimension(problem)]
        self.lower, self.upper, self.work, self.cost, self.runs = 0.0, 1.0, 0.0, 0.0, 0
        self.only = bool(problem.unknown) or self.setting.torn  # constants are no worst disturbance
        self.sides: tuple[bool, ...] = (True,) if self.only else (True, False)
        self.shapes: dict[bool, Shapes] = {}
        self.kept: tuple[Witness, ...] = ()
        self.estimate, self.error = math.nan, 0.0
        self.pace = RATE[_dimension(problem)]

    def decided(self) -> bool:
        """Whether the bounds are near each other, or one of them has passed the target."""
        return self.upper <= max(_CLOSE * self.lower, self.delta) or self.lower > self.delta > 0

    def room(self, budget: float) -> float:
        """Work that may still be done: what is left of the budget, and what the time that is left allows."""
        return min(budget - self.work, self.pace * seconds_left())

    def until(self, budget: float) -> Iterator[Bounds]:
        """Bounds, until so much work is done in all, or about until the time is over."""
        silent: Side | None = None  # the last one that nothing was said of
        while not self.decided():
            if self.cost and not self._finer(budget):
                if silent is not None:
                    yield self._bounds(silent, proved=self.upper < 1 or self.lower > 0)
                return
            begun, self.runs, self.cost = self.work, self.runs + 1, 0.0
            for above in self.sides:
                side = self._side(above) if self.runs == 1 else self._fitting(above, budget)
                self.cost += _WHOLE * side.work
                if self.runs == 1 and self.work - begun + _WHOLE * side.work > budget:  # an upper bound at least
                    yield self._bounds(side, proved=self.work > 0)
                    return
                if above and self._far_above(side):
                    continue
                side = silent = self._solved(side)
                if above and len(self.sides) > 1 and self.estimate > _FAR * self.delta > 0:
                    continue
                last = _LEAST * self.cost > self.room(budget)
                if self._worth(side, budget) or (last and not self._hopeless(side)):
                    self._prove(side, last, budget)
                    silent = None
                    yield self._bounds(side)
                if self.decided():
                    return
                if self.delta > 0 and (_FAR * self.estimate < self.delta or self.cost > _CHEAP * budget):
                    break

    def _far_above(self, side: Side) -> bool:
        """Whether the first solution, on axes that nothing improved yet, leaves no doubt that a lower bound decides."""
        if self.runs > 1 or len(self.sides) == 1 or not self.delta > 0:
            return False
        _propose(side)
        self.estimate = abs(largest_at_start(side, self.starts)[0])
        return self.estimate > _FAR**2 * self.delta

    def _side(self, above: bool) -> Side:
        count = math.ceil(_STEPS / self.cell)
        known = self.shapes.get(above) or self.shapes.get(not above)
        return side_of(self.stages, self.cell, count, above, _scaled(known, self.cell))

    def _fitting(self, above: bool, budget: float) -> Side:
        """A side on a grid that what is left of the work about suffices for.

        Grids of the two sides have axes of their own, so that one side's work says little of the other's.
        """
        side = self._side(above)
        over = min(_WHOLE * side.work / max(_LEAST * self.room(budget), 1.0), _GROWTH)
        if over <= 1.0:
            return side
        self.cell *= over ** (1 / (self.setting.dimension + 1))
        return self._side(above)

    def _solved(self, side: Side) -> Side:
        """Solve on one grid, or on better ones with as many cells; the side on these, once corrected."""
        above = side.above
        if not side.values:
            _propose(side)
        rounds = 0 if above in self.shapes or side.later is not None else 1 if self.shapes else _ROUNDS
        side, parts = adapted(side, self.starts, rounds)
        value = largest_at_start(side, self.starts)[0]
        self.estimate, self.error = abs(value), math.inf
        self.work += _ROUGH * (1 + rounds) * side.work
        if parts is not None:
            self.shapes[above] = (self.cell, better_shapes(side, parts, self.starts.places))
            side.correct([np.add.reduce(one) for one in parts])
            self.work += _CORRECTED * side.work
            self.error = abs(largest_at_start(side, self.starts)[0] - value)
        return side

    def _worth(self, side: Side, budget: float) -> bool:
        """Whether a bound of this grid is worth its proof: it will decide, it is cheap, or nothing is known of it."""
        if not self.delta or not math.isfinite(self.error):
            return True
        if side.above == (self.estimate < self.delta) and _USUAL * side.work <= _CHEAP * self.room(budget):
            return True
        found = self.estimate + (1 if side.above else -1) * _PROVED * self.error
        return found <= self.delta if side.above else found > self.delta

    def _hopeless(self, side: Side) -> bool:
        """Whether a proof would say nothing: its work is of more use to others."""
        found = self.estimate + (1 if side.above else -1) * self.error
        return found >= 1 if side.above else found <= 0

    def _prove(self, side: Side, last: bool, budget: float) -> None:
        above = side.above
        target = math.inf if last or not self.delta else self.delta if above else -self.delta
        enough = -math.inf if not self.delta else _ENOUGH * self.delta if above else -self.delta / _ENOUGH
        most, begun = max(self.room(budget) / side.work, _AT_LEAST), perf_counter()
        bound, value, passes = refined(side, self.starts, target, enough=enough, most=most)
        if passes >= _USUAL:
            self.pace = passes * side.work / max(perf_counter() - begun, 1e-3)
        self.work += passes * side.work
        self.kept += Witness.of(side)
        self.error = abs(abs(value) - self.estimate) / _PROVED
        if above:
            self.upper = min(self.upper, bound)
        else:
            self.lower = max(self.lower, -bound)

    def _finer(self, budget: float) -> bool:
        """Choose the next grid by the work that is left; False where that is too little for one that is worth it."""
        dimension, delta = self.setting.dimension, self.delta
        growth = min(_GROWTH, self.room(budget) / self.cost)
        if growth < _LEAST:
            return False
        if delta > 0:
            room = _SHARE * abs(delta - self.estimate)
            needed = (_PROVED * self.error / max(room, 1e-300)) ** ((dimension + 1) / _ORDER)
            growth = min(max(min(growth, needed), _LEAST) * len(self.sides), _GROWTH)
            self.sides = (self.estimate < delta or self.only,)
        self.cell /= growth ** (1 / (dimension + 1))
        return True

    def _bounds(self, side: Side, proved: bool = True) -> Bounds:
        return Bounds(
            lower=self.lower, upper=self.upper, cells=cells_of(side.axes), steps=len(side.steps),
            runs=self.runs if proved else 0, estimate=self.estimate, work=self.work, witnesses=self.kept, search=self,
        )  # fmt: skip


def _propose(side: Side) -> None:
    for stage in side.stages[::-1]:
        stage.propose()


Shapes = tuple[float, list[Shape]]
"""The cell of a grid, and the widths that are better for as many cells."""


def _scaled(shapes: Shapes | None, cell: float) -> list[Shape]:
    return [] if shapes is None else [shape.scaled(cell / shapes[0]) for shape in shapes[1]]


def adapted(side: Side, starts: Starts, rounds: int) -> tuple[Side, list[Array] | None]:
    """A grid that is better for this problem with as much work, and about its residuals, as `Side.rough_parts`."""
    if side.later is not None:
        return side, None
    while side.finite:
        parts = side.rough_parts()
        if not rounds:
            return side, parts
        *shapes, longest = better_shapes(side, parts, starts.places)
        side = side.on(shapes, longest)
        side.propose()
        rounds -= 1
    return side, None


def side_of(
    stages: Sequence[Setting], cell: float, count: int, above: bool, shapes: Sequence[Shape] = ()
) -> Side:  # fmt: skip
    """One bound on one grid, of the first of the stages.

    ``count`` steps go over all of them, or those of the last one of ``shapes``, which are those of `better_shapes`.
    """
    cells = np.full(stages[0].dimension, cell)
    plans = plan_axes(stages, cells, 0 if above else 1, shapes[:-1])
    later: Side | None = None
    for one, plan in zip(reversed(stages), reversed(plans)):
        span = one.horizon - one.begin
        usual = span / math.ceil(one.pace * max(math.ceil(span / stages[-1].horizon * count), _FEWEST))
        longest = shapes[-1] if shapes else partial(np.full_like, fill_value=usual)
        later = Side(one, cells, longest, above, later=later, plan=plan)
    assert later is not None
    return later


def refined(
    side: Side, starts: Starts, target: float = math.inf, residuals: list[Array] | None = None, *,
    enough: float = -math.inf, most: float = math.inf,
) -> tuple[float, float, float]:  # fmt: skip
    """The bound of one side: passes of the carried error until what is left of the residual is paid.

    Passes end early once v at the start, which only grows, is beyond ``target``, the bound is below ``enough``, or
    ``most`` of them are made; the first ``residuals`` may be known. The bound, v there, and what it took in passes.
    """
    best, passes, rest, stalled, before, lifted = math.inf, 0.0, 0.0, 0, math.inf, False
    if side.later is not None:
        rest = _settled(side.later, _PAID * abs(largest_at_start(side, starts)[0]))
        side.propose()
    while True:
        poll("solving for the error that is left")
        if not side.finite:
            return best, math.inf, passes
        rough, value = side.begun, largest_at_start(side, starts)[1]
        paid, hopeless = False, value >= min(1.0 if side.above else 0.0, target)
        if residuals is None:
            residuals = side.residuals(rough)
            passes += _ROUGH if rough else 1.0
        if not rough:
            left, missing = _unpaid(side, residuals)
            bound = value + (left + rest + missing) * (1 + 1e-9) + 1e-15
            best = min(best, bound)
            side.remember(value, bound)
            paid = left + rest + missing <= _PAID * abs(value) or best <= enough
            stalled = stalled + 1 if side.steady and left + missing > _STALLED * before else 0
            before = left + missing
        if paid or hopeless or side.passes == _PASSES or stalled == 2 or (passes >= most and math.isfinite(best)):
            return best, value, passes
        if stalled and side.above and not lifted:
            side.lift(_LIFT)
            lifted, before = True, math.inf
        residuals = side.corrected(residuals)
        passes += 1.0


def _unpaid(side: Side, residuals: Sequence[Array]) -> tuple[float, float]:
    """What is left of the residuals, and the most that v lacks at the end and at faces."""
    lengths = side.steps if side.clock is None else side.steps * (1 + side.clock)
    left = sum(float(h) * float(r.max()) for h, r in zip(lengths, residuals))
    return left, side.lacking()


def _settled(side: Side, enough: float) -> float:
    """Passes for a later stage until at most ``enough`` is left; what is left of it and of those after it."""
    rest = 0.0
    if side.later is not None:
        rest = _settled(side.later, enough)
        side.propose()
    unpaid, residuals = math.inf, None
    while True:
        poll("solving for the error that is left of a later stage")
        if not side.finite:
            return math.inf
        rough = side.begun
        if residuals is None:
            residuals = side.residuals(rough)
        unpaid = math.inf if rough else sum(_unpaid(side, residuals))
        if unpaid <= enough or side.passes == _PASSES:
            break
        residuals = side.corrected(residuals)
    return (rest + unpaid) * (1 + 1e-9)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Starts:
    """Boxes around the starts, points that are proved to be starts, shapes (S, n) and (P, n), and normal starts."""

    low: Array
    high: Array
    points: Array
    means: tuple[StartMean, ...] = ()

    @property
    def places(self) -> Array:
        """Starts that stand for all of them."""
        return np.concatenate([self.points, *(mean.places for mean in self.means)])


def starts_in(problem: Problem) -> Starts:
    n = problem.system.dimension
    means: list[StartMean] = []
    lows: list[Array] = []
    highs: list[Array] = []
    points: list[Array] = []
    for start in problem.starts:
        if isinstance(start, GaussianStart) and start.spread:
            means.append(StartMean(start))
            continue
        if isinstance(start, GaussianStart):
            for rows in (lows, highs, points):
                rows.append(start.middle)
            continue
        hull = start.hull(0.0)
        low, high = np.asarray(hull.lo, dtype=float), np.asarray(hull.hi, dtype=float)
        lows.append(low)
        highs.append(high)
        middle = np.asarray(start.middle, dtype=float)
        shares = product(*([0.0] if a == b else np.linspace(-1, 1, 5) for a, b in zip(low, high)))
        for share in shares:
            point = middle + np.array(share) * (high - low) / 2 * (1 - 1e-9)
            if start.contains(point):
                points.append(point)
    low, high, within = (np.array(rows).reshape(-1, n) for rows in (lows, highs, points))
    return Starts(low=low, high=high, points=within, means=tuple(means))


def largest_at_start(side: Side, starts: Starts) -> tuple[float, float]:
    """v(0, .) over the starts: roughly at the worst of them, and the certified number of the side.

    From above that is an upper bound over all starts; from below the least of v over some of them, rounded up. Of
    starts beyond the box of the axes, where v is not known, 1 is said from above and 0 from below. Of a normal start it
    is the mean.
    """
    found = [mean.bound(side) for mean in starts.means]
    if len(starts.low):
        found.append(_largest_of_sets(side, starts))
    pick = max if side.above else min
    return pick(rough for rough, _ in found), pick(bound for _, bound in found)


def _largest_of_sets(side: Side, starts: Starts) -> tuple[float, float]:
    coefficients = side.values[-1]
    ends = np.array([[axis.nodes[0], axis.nodes[-1]] for axis in side.axes]).T
    if not side.above:
        within = np.all((starts.points >= ends[0]) & (starts.points <= ends[1]), axis=1)
        within &= [not (ok and _stops_start(side, one[None], one[None])) for ok, one in zip(within, starts.points)]
        low = min((_value(side, coefficients, point) for point in starts.points[within]), default=0.0)
        return low, low + _rounding(coefficients)
    if np.any(starts.low < ends[0]) or np.any(starts.high > ends[1]) or _stops_start(side, starts.low, starts.high):
        return 1.0, 1.0
    best, rough = -math.inf, -math.inf
    derivatives = Derivatives(side.axes, coefficients[None])
    n = len(side.axes)
    for low, high in zip(starts.low, starts.high):
        lines = [np.unique(np.linspace(a, b, _STARTS if a < b else 1)) for a, b in zip(low, high)]
        samples = coefficients
        for k, (axis, line) in enumerate(zip(side.axes, lines)):
            samples = axis.at_points(line, 0).along(samples, k)
        most = float(samples.max())
        extra = 0.0
        for k, line in enumerate(lines):
            if len(line) > 1:
                size = _over_box(side, derivatives.size(unit(k, n, 2))[0], low, high)
                extra += float(np.diff(line).max()) ** 2 / 8 * size * (1 + 1e-9)
        rough, best = max(rough, most), max(best, most + extra + _rounding(coefficients))
    return rough, best


def _stops_start(side: Side, lows: Array, highs: Array) -> bool:
    """Whether one of some boxes meets a cell that may have failed at once."""
    if not side.setting.shapes:
        return False
    unsafe = side.shapes.failed.copy()
    unsafe[side.shapes.cut] = True
    return any(_over_box(side, unsafe.astype(float), low, high) > 0 for low, high in zip(lows, highs))


def _over_box(side: Side, cells: Array, low: Array, high: Array) -> float:
    """The largest of the values of the cells that meet a box."""
    places = []
    for axis, a, b in zip(side.axes, low, high):
        first = max(int(np.searchsorted(axis.nodes, a, side="left")) - 1, 0)
        last = min(int(np.searchsorted(axis.nodes, b, side="right")), axis.cells)
        places.append(slice(first, max(last, first + 1)))
    return float(cells[tuple(places)].max())


def _value(side: Side, coefficients: Array, point: Sequence[float] | Array) -> float:
    for k, (axis, place) in enumerate(zip(side.axes, point)):
        coefficients = axis.at_points(np.array([place]), 0).along(coefficients, k)
    return float(coefficients.reshape(()))


def _rounding(coefficients: Array) -> float:
    return 1e-13 * float(np.abs(coefficients).max())


__all__ = ["Bounds", "Setting", "bound_failing"]
