"""Long and infinite horizons of models in which all steps are alike: some steps back, and what they say of all others.

With S_n(x) the least probability, over the disturbances, of still being safe n steps on,
    S_{n+1}(x) = inf_d E S_n(f(x, d) + w) on the safe set, 0 off it,
a map that is monotone and homogeneous. So if psi <= S_n and the map takes psi to at least rho psi, then
    S_{n+m} >= rho^m psi   for every m,  hence  P(leaving within n + m) <= 1 - (1 - r)^m psi,  r = 1 - rho,
and the other way round from above. psi = 1 - U_n, with U_n of ``induction`` above P(leaving within n): the next U_{n+1}
is at least one step back of U_n, so that r is at most the largest (U_{n+1} - U_n)/(1 - U_n) over the safe cells. A
horizon of 10^9 steps costs what those n steps cost, and an infinite one gives 1 wherever r is proved to be positive.

With a target and an infinite horizon, U_n counts who has not arrived after n steps as failed, and falls with n towards
the truth; below nobody is counted who has neither arrived nor failed.
"""

from __future__ import annotations

import itertools
import math
import time
from dataclasses import replace

import numpy as np

from certbound.arrays import Array, Mask
from certbound.problem.goals import until
from certbound.problem.problem import Problem
from certbound.problem.sets import Box, Inside, Region
from certbound.rigor.intervals import Interval
from certbound.values.charts import Charts
from certbound.values.discrete.dominance import tail
from certbound.values.discrete.failures import Work
from certbound.values.discrete.functions import ValueFunction
from certbound.values.discrete.induction import AnyTransition, Zones, assembled, back_above, back_below, final
from certbound.values.discrete.kernels import REACH
from certbound.values.discrete.layout import FailureBounds, lasting_box, shares_of, start_box
from certbound.values.discrete.scaled import dynamics_of
from certbound.values.discrete.shocks import Inapplicable
from certbound.values.grids import Grid, over_corners
from certbound.values.sets import box_around
from certbound.watch import OutOfTime, poll

_LONG = 400
"""Steps from which on a horizon is long."""
_MOST = 20_000  # steps back on one grid
_LOST = 1e-3  # of the largest probability of being safe: cells with less are rounded
_SOON, _AT_LEAST, _NEGLIGIBLE = 32, 1024, 1e-17
_BETTER, _LESS = 0.9, 0.5  # of the gap, or of the upper bound: what twice as many steps back have to make of it
_DEAR, _BRIEF = 3, 2.0  # states from which on a step back is dear, and seconds at fixed rates of those that matter
_CHECKED, _OFTEN = 1.2, 1.04  # steps back between two looks at the bounds, as a ratio; and where looks need no rates
_NEXT = 0.8  # of the cells of the last grid: those of the next one are smaller
_ANSWERED = 1.25  # times the ratio asked for, once the probability is low enough and steps are dear


def _all_alike(problem: Problem) -> bool:
    """Whether all steps are alike."""
    whole = (0.0, float(problem.horizon))
    still = all(not c.region.moving and c.during in (None, whole) for c in problem.kept)
    return still and problem.input_sequence is None and dynamics_of(problem, 1).steady


def bound_long_run(
    problem: Problem, *, ratio: float = 1.05, delta: float | None = None, seconds: float = 20.0, parts: int = 4
) -> FailureBounds | None:
    """Bound the probability of leaving within a long horizon, or, with a target, of failing within an infinite one.

    Parameters
    ----------
    problem : Problem
        With a feedback law or none, and a model, limits and a target that do not change.
    ratio, delta, seconds, parts
        As `certbound.values.discrete.bound_failure` takes them.

    Returns
    -------
    FailureBounds or None
        Without a target with ``rate`` and ``before``; None where step by step does as well: the horizon is finite, and
        not long, or there is a target, or steps differ.

    Raises
    ------
    Inapplicable
        If value functions do not fit the problem; the message says why.
    """
    short = problem.ending or problem.horizon <= _LONG or problem.reach is not None or not _all_alike(problem)
    if short and not problem.endless:
        return None
    begun = time.perf_counter()
    run = _Run(problem, parts)
    if run.work.boxes.cut and not problem.endless:
        return None
    left, best = seconds, None
    tried: list[tuple[float, float, float]] = []
    for share in shares_of(run.work.n, run.work.shocks):
        if tried and share > _NEXT * tried[-1][0]:
            continue  # every grid is solved anew over all steps
        layout = run.work.layout(share)
        if layout is None:
            break
        cost = run.work.cost([layout[-1]])
        if tried and run.steps * cost > left:
            break
        try:
            brief = (delta or 0.0, _BRIEF / cost if run.work.n >= _DEAR else math.inf)
            found = run.bounds(layout[-1], share, ratio, left / cost, brief)
        except (Inapplicable, OutOfTime):
            if best is None:
                raise
            break
        left -= run.steps * cost
        tried.append((share, found.upper, found.lower))
        best = found if best is None else _better(best, found)
        if run.ended or _gap(best) <= ratio - 1 or (delta is not None and (best.upper <= delta / 100)):
            break
    if best is None:
        raise Inapplicable(run.work.too_large)
    if run.leak and best.rate is not None:  # what is paid once a step below is not part of the rate
        best = replace(best, rate=(0.0, best.rate[1]))
    return replace(best, seconds=time.perf_counter() - begun, tried=tuple(tried))


def chart_failures(problem: Problem, *, share: float, times: int = 1, parts: int = 4) -> Charts:
    """Bound the probability of failing from every safe state, not from the initial set alone.

    Parameters
    ----------
    problem : Problem
        As `bound_failure` takes it; where constraints do not bound a state, as far as paths from its initial set get.
    share : float
        Of the cells, as `FailureBounds` has it.
    times : int
        How many steps are charted, step 0 the first of them.
    parts : int
        Parts along each side of the set of disturbances.

    Raises
    ------
    Inapplicable
        If value functions do not fit the problem; the message says why.
    """
    work = Work(problem, None, parts)
    return work.charts(share, sorted({work.horizon * k // times for k in range(times)}))


def step_grids(problem: Problem, share: float, most: float = math.inf) -> list[Grid]:
    """The grids of all steps at one size of the cells, one object where steps share one; as certificates state them.

    Of a target that need not be stayed in up to the end of its window; one grid where there are more than ``most``
    steps, which must be alike. Inapplicable where value functions do not fit the problem, or grids would be too large.
    """
    if problem.horizon > most:
        found = _Run(problem, 1).work.layout(share)
        if found is None:
            raise Inapplicable(Work.too_large)
        return found[-1:]
    target = problem.reach
    if target is None:
        work = Work(problem, None, 1)
    else:
        first, last = target.during or (0, problem.horizon)
        plain = until(problem, problem.horizon if target.stays else int(last))
        work = Work(plain, target.region, 1, int(first))
    found = work.layout(share)
    if found is None:
        raise Inapplicable(work.too_large)
    return found


def _better(one: FailureBounds, other: FailureBounds) -> FailureBounds:
    """The better bounds of both; rates only with the number of steps that they belong to."""
    best = min(other, one, key=_rate_gap)
    return replace(best, upper=min(one.upper, other.upper), lower=max(one.lower, other.lower))


def _rate_gap(found: FailureBounds) -> float:
    low, high = found.rate or (0.0, 1.0)
    return math.log(high / low) if 0 < low <= high < 1 else math.inf


def _gap(found: FailureBounds) -> float:
    """How far the bounds are apart; where they say 1 of an infinite horizon, the rates."""
    low, high = (found.lower, found.upper) if found.rate is None or found.lower < 0.5 else found.rate
    return math.log(high / max(low, _NEGLIGIBLE)) if high > 0 else 0.0


class _Run:
    """One problem with all steps alike."""

    def __init__(self, problem: Problem, parts: int) -> None:
        if problem.ending:
            raise Inapplicable("value functions of infinite horizons count leaving the domain as failing here.")
        if not _all_alike(problem):
            raise Inapplicable(
                "value functions of infinite horizons need a feedback law, and a model and limits that do not change."
            )
        self.horizon = float(problem.horizon)
        self.target: Region | None = None if problem.reach is None else problem.reach.region
        if self.target is not None and self.target.moving:
            raise Inapplicable("value functions need a target that stands still where the horizon is infinite.")
        plain = _bounded(problem, parts)
        self.work = Work(plain, self.target, parts)
        self.leak = 0.0 if self.target is None else 2 * self.work.n * tail(REACH)
        if self.target is None and (self.work.boxes.leak > 0 or self.work.boxes.cut) and math.isfinite(self.horizon):
            self._last(plain, parts)
        if self.work.boxes.leak > 0 or (self.work.boxes.cut and math.isinf(self.horizon)):
            raise Inapplicable(
                "value functions of long horizons need limits on both sides of every state: add a constraint or a "
                "`domain`."
            )
        self.first = 0 if self.work.random else 1
        self.steps, self.ended = 0, False  # whether time ended a grid, of which the last bounds hold

    def _last(self, plain: Problem, parts: int) -> None:
        """Bound states without limits by a box that paths do not leave, but for tails: above who leaves it has failed.

        Below that is paid for once a step.
        """
        box = lasting_box(plain, self.work.shocks, self.work.dynamics)
        if box is None:
            return
        low, high = box_around(plain.constraints, self.work.n, 0)
        sides = np.where(np.isinf(low), box[0], -np.inf), np.where(np.isinf(high), box[1], np.inf)
        self.work = Work(plain.replace(safe=[*plain.safe, Inside(Box(*sides))]), None, parts)
        self.leak = 2 * self.work.n * tail(REACH)

    def bounds(
        self, grid: Grid, share: float, ratio: float, most: float, brief: tuple[float, float]
    ) -> FailureBounds:
        """The bounds on one grid, after so many steps back that more would not change much.

        They need not be closer than asked where the probability ``brief[0]`` holds after ``brief[1]`` steps or more.
        """
        best: FailureBounds | None = None
        ahead, look, before = self.horizon - self.first, 4.0, (0, math.inf, 1.0)
        zones = self.work.zones(grid, 0)
        transition = self.work.transition(0, grid, grid, share)
        above = final(grid, zones, above=True)
        below = final(grid, replace(zones, has_target=False), above=False)
        try:
            for n in itertools.count():
                last = n >= min(ahead, most, _MOST)
                if n >= look or last:
                    look = (_CHECKED if self.target is None else _OFTEN) * n
                    poll(f"values {n} steps back, {math.prod(grid.shape)} cells")
                    found = self._read(transition, zones, (above, below), n, share)
                    best, self.steps = found if best is None else _better(best, found), n
                    wide, twice = _gap(best), n >= 2 * before[0]
                    slow = wide > _BETTER * before[1] and best.upper > _LESS * before[2]
                    vain = twice and slow and self._stalls(best, n)
                    answered = best.upper <= brief[0] and n >= brief[1]
                    if last or vain or wide <= (ratio - 1) * (_ANSWERED if answered else 0.25):
                        break
                    before = (n, wide, best.upper) if twice else before
                above, below = back_above(transition, above, zones), back_below(transition, below, zones)
        except OutOfTime:
            if best is None:
                raise
            self.ended = True
        assert best is not None
        return best

    @staticmethod
    def _stalls(best: FailureBounds, n: int) -> bool:
        """Whether bounds that do not get better will not: at first nobody has arrived, or left from the middle."""
        waits = best.upper > 0.99 if best.rate is None else math.isinf(_rate_gap(best))
        return n >= (_AT_LEAST if waits else _SOON)

    def _read(
        self, transition: AnyTransition, zones: Zones, pair: tuple[ValueFunction, ValueFunction], n: int, share: float
    ) -> FailureBounds:
        """What n steps back say."""
        work, more, rate = self.work, self.horizon - self.first - n, None
        if self.target is None and more > 0:
            pair = rounded(zones, *pair)
            rate = rates(transition, zones, *pair)
        upper, lower = work.at_random(*pair) if work.random else work.over_start(*pair, share)
        lower -= (n + 1) * self.leak * (1 + 1e-9)
        upper = min(max(upper, 0.0), 1.0)
        before = (n + self.first, lower if rate is not None and rate[0] > 0 else max(lower, 0.0), upper)
        if rate is not None:
            upper, lower = later(upper, rate[1], more, up=True), later(lower, rate[0], more, up=False)
            lower -= self.horizon * self.leak * (1 + 1e-9) if self.leak else 0.0
        lower = min(max(lower, 0.0), 1.0)
        return FailureBounds(
            upper=upper, lower=lower, cells=pair[0].grid.shape, share=share, seconds=0.0, tried=(), rate=rate,
            before=before,
        )  # fmt: skip


def rounded(zones: Zones, above: ValueFunction, below: ValueFunction) -> tuple[ValueFunction, ValueFunction]:
    """Both functions, with constants on cells from which hardly anybody is safe: unsafe above, a little safer below."""
    most, (low, high) = above.range()[1], below.range()
    lost = 1 - _LOST * float(np.max(1 - np.minimum(most, 1.0)))
    higher = _levelled(above, most > lost, np.ones(above.grid.shape))
    return higher, _levelled(below, (high > lost) & ~zones.unsafe, np.minimum(low, lost))


def rates(transition: AnyTransition, zones: Zones, above: ValueFunction, below: ValueFunction) -> tuple[float, float]:
    """Of what is still safe, the shares that leave within one step: at least, at most."""
    least = least_rate(below, back_below(transition, below, zones))
    return least, largest_rate(above, back_above(transition, above, zones))


def _levelled(value: ValueFunction, cells: Mask, level: Array) -> ValueFunction:
    """The function with constants on some more cells."""
    before = np.zeros(value.grid.shape, dtype=bool) if value.fixed is None else value.fixed
    fixed = before | cells
    return assembled(value.grid, value.nodal, value.bend, fixed, np.where(cells, level, value.level), value.beyond)


def later(probability: float, rate: float, more: float, *, up: bool) -> float:
    """1 - (1 - p)(1 - r)^m, rounded up or down, in [0, 1]."""
    if not (rate > 0 and more > 0):
        return probability
    if rate >= 1 or probability >= 1:
        return 1.0
    logs = math.log1p(-probability) + more * math.log1p(-rate)
    value = -math.expm1(logs * (1 + 1e-14 if up else 1 - 1e-14))
    return min(max(value * (1 + 1e-14 if up else 1 - 1e-14), 0.0), 1.0)


def largest_rate(value: ValueFunction, after: ValueFunction) -> float:
    """At least (after - value)/(1 - value) wherever value is below 1."""
    _, rise = _rises(value, after)
    ends = value.range()[1]
    certain = _certain(value)
    if certain.all():
        return 1.0
    left = np.where(certain, 1.0, 1 - ends)
    ratio = np.where(certain, 0.0, np.where(left > 0, np.maximum(rise, 0.0) / np.maximum(left, 1e-300), 1.0))
    return float(min(ratio.max() * (1 + 1e-12), 1.0))


def least_rate(value: ValueFunction, after: ValueFunction) -> float:
    """At most (after - value)/(1 - value) wherever value is below 1."""
    rise, _ = _rises(value, after)
    left = 1 - np.minimum(value.range()[0], 1.0)  # more than 1 where the function is negative
    certain = _certain(value) & _certain(after)
    ratio = np.where(certain, 1.0, np.maximum(rise, 0.0) / np.maximum(left * (1 + 1e-12), 1e-300))
    return float(min(max(ratio.min() * (1 - 1e-12), 0.0), 1.0))


def _certain(value: ValueFunction) -> Mask:
    """Cells on which the function is 1."""
    if value.fixed is None:
        return np.zeros(value.grid.shape, dtype=bool)
    return np.asarray(value.fixed & (value.level >= 1))


def _rises(value: ValueFunction, after: ValueFunction) -> tuple[Array, Array]:
    """Bounds of after - value on every cell: on most of them multilinear plus parabolas once more."""
    gap = after.nodal - value.nodal
    slack = 4 * 2.0**-53 * (np.abs(after.nodal) + np.abs(value.nodal))
    low, high = over_corners(np.minimum, gap - slack), over_corners(np.maximum, gap + slack)
    for i in range(value.grid.dimension):
        bend = after.bend[i] - value.bend[i]
        loose = 4 * 2.0**-53 * (np.abs(after.bend[i]) + np.abs(value.bend[i]))
        arch = value.grid.widths(i) ** 2 / 8 * (1 + 1e-12)
        low = low - np.maximum(bend + loose, 0.0) * arch
        high = high + np.maximum(loose - bend, 0.0) * arch
    fixed = [one.fixed for one in (value, after) if one.fixed is not None]
    if fixed:
        (first, last), (next_first, next_last) = value.range(), after.range()
        either = np.logical_or.reduce(fixed)
        low, high = np.where(either, next_first - last, low), np.where(either, next_last - first, high)
    return low, high


def _bounded(problem: Problem, parts: int) -> Problem:
    """The problem of one step; a single state without a limit on the target's side is cut where no path gets to."""
    plain = problem.replace(horizon=1, reach=None, safe=[replace(c, during=None) for c in problem.safe])
    low, high = box_around(plain.constraints, plain.system.dimension, 0)
    if problem.reach is None or plain.system.dimension > 1 or np.isfinite([low, high]).all():
        return plain
    target = problem.reach.region.hull()
    behind = not np.isfinite(target.lo[0]), not np.isfinite(target.hi[0])  # the target goes on for ever
    first = float(low[0]) if np.isfinite(low[0]) else float(target.hi[0]) - 1e-9 if behind[0] else -math.inf
    last = float(high[0]) if np.isfinite(high[0]) else float(target.lo[0]) + 1e-9 if behind[1] else math.inf
    if not -math.inf < first < last < math.inf:
        raise Inapplicable("value functions need a limit wherever the target leaves a state without one.")
    inner = plain.replace(safe=[*plain.safe, Inside(Box([first], [last]))], initial=[(first + last) / 2])
    around = Work(inner, None, parts)
    if around.shocks.laplace:
        raise Inapplicable("value functions of infinite horizons need limits on both sides beside exponential tails.")
    below, above = around.dynamics.step(0, Grid(axes=(np.linspace(first, last, 257),))).hull()
    spread = np.sqrt(around.shocks.sigma.hi**2 + around.shocks.factor.mag**2) * (1 + 1e-12)
    reach = max(REACH, around.shocks.reach) * spread
    ends = Interval(below, above) + Interval(-reach, reach)
    start = start_box(problem)  # of a random one what lies beyond it is paid for as the tail of one more step
    edge = min(float(ends.lo[0]), first, float(start[0][0])), max(float(ends.hi[0]), last, float(start[1][0]))
    sides = [edge[0] if not np.isfinite(low[0]) else -np.inf], [edge[1] if not np.isfinite(high[0]) else np.inf]
    return plain.replace(safe=[*plain.safe, Inside(Box(*sides))])
