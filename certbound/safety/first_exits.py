"""First-exit times of one state: P(exit before s) for every s up to the horizon from above and below, and the mean.

Where neither the model nor what it must respect depends on time, P(exit before s | X_0 = x) is the value function of
the horizon T at time T - s. One value function is proved for T and, since short times lie at the end of its grid, one
each for shorter and shorter horizons, which are read for the times above the next one: in places where log P moves by
little. The rarer leaving is, the closer the horizons.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.checks import instance, vector
from certbound.display import Shown, rounded
from certbound.errors import EngineError, InfeasibleError, contained
from certbound.parallel import alone
from certbound.problem.goals import check_end, until
from certbound.problem.model import sources
from certbound.problem.problem import Problem
from certbound.problem.reductions import bring_to_rest
from certbound.problem.sets import Box, Faces, Inside
from certbound.problem.systems import ContinuousSystem
from certbound.rigor.intervals import Interval
from certbound.safety.answers import EngineAnswer, LimitBounds, Request, bound_limits, limits_of
from certbound.safety.engines import values_engine
from certbound.values.chains import bound_chain
from certbound.values.charts import Chart
from certbound.values.continuous import bound_exits, bound_mean_time, chart_slabs_of
from certbound.values.discrete import chart_failures
from certbound.watch import OutOfTime, poll, share_of_time

_STEP = 0.004  # of log P, between two times at which a curve is read
_FEWER = {1.0: 1.4, 0.05: 1.27}  # ratio of a horizon to the next shorter one, where P is at most so much
_SHORTEST = 40  # horizons
_RARE = -6.0  # log10 of a probability below which no shorter horizon is looked at
_HALF = 0.5  # of the time that is left, at most, for the mean by one function
_TIMES = 5  # where limits move
_EFFORT = 0.3  # of value functions, for each of them
_SHARE = 0.004  # cells of discrete time, as `FailureBounds` has them
_INTERVALS = {"continuous": 16, "discrete": 64}  # over which the density is told, at most
_SECONDS = 4.0  # of work for one limit by itself, in discrete time


@dataclass(frozen=True, eq=False, kw_only=True)
class Density:
    """Bounds of the mean density of the exit time over intervals, from every start.

    Parameters
    ----------
    times : ndarray, shape (K + 1,)
        Ends of the intervals, from 0 to T.
    lower, upper : ndarray, shape (K,)
        Of P(times[k] < exit time <= times[k + 1]) over the length of the interval: per unit of time, or step.
    """

    times: Array
    lower: Array
    upper: Array

    def to_dict(self) -> dict[str, Any]:
        """``times``, ``lower`` and ``upper``."""
        return {name: getattr(self, name).tolist() for name in ("times", "lower", "upper")}


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class ExitTimes(Shown):
    """When a path leaves its safe set: lower <= P(exit before s from the worst start) <= upper, proved.

    Parameters
    ----------
    problem : Problem
        What is asked.
    times : ndarray, shape (K,)
        Rising times s in [0, T]; steps in discrete time.
    lower, upper : ndarray, shape (K,)
        Bounds of the probability, both rising with s.
    mean_lower : float
        The mean time of leaving is at least this, from every start and under every disturbance.
    mean_upper : float or None
        It is at most this from every start; None where nothing was proved.
    density : Density or None
        Bounds of the density of the exit time, from every start.
    by_limit : tuple of LimitBounds
        Which limit is met first, within T: bounds of the probability that it is one of those that a path breaks first.
        Empty where that was not asked for.
    """

    problem: Problem
    times: Array
    lower: Array
    upper: Array
    mean_lower: float
    mean_upper: float | None
    density: Density | None = None
    by_limit: tuple[LimitBounds, ...] = ()

    def at(self, s: float) -> tuple[float, float]:
        """Bounds at any time up to the horizon, by the times beside it.

        Raises
        ------
        ValueError
            If the time lies outside [0, T].
        """
        if not 0 <= s <= float(self.problem.horizon):
            raise ValueError(f"`s` must lie in [0, {float(self.problem.horizon):g}], got {s!r}.")
        before = int(np.searchsorted(self.times, s, side="right")) - 1
        after = int(np.searchsorted(self.times, s))
        low = float(self.lower[before]) if before >= 0 else 0.0
        return low, float(self.upper[after]) if after < len(self.times) else 1.0

    def summary(self) -> str:
        """The end of the curves and the mean, in one line."""
        unit = self.problem.time_unit
        low, high = _ends_text(self.lower[-1], self.upper[-1])
        most = "" if self.mean_upper is None else f" ... {rounded(self.mean_upper, up=True, digits=5)}"
        least = rounded(self.mean_lower, up=False, digits=5)
        return (
            f"P(exit within {self.problem.horizon:g} {unit}) in [{low}, {high}], "
            f"mean exit time {least + most if most else 'at least ' + least} {unit}"
        )

    def rows(self) -> list[tuple[str, str]]:
        """A few times with their bounds."""
        found = []
        for k in np.unique(np.linspace(0, len(self.times) - 1, 6).round().astype(int))[1:]:
            low, high = _ends_text(self.lower[k], self.upper[k])
            found.append((f"before {self.times[k]:.4g}", f"{low} ... {high}"))
        return found

    def to_dict(self) -> dict[str, Any]:
        """``times``, ``lower``, ``upper``, ``mean_lower``, ``mean_upper``, ``density`` and ``by_limit``."""
        found: dict[str, Any] = {name: getattr(self, name).tolist() for name in ("times", "lower", "upper")}
        found |= {"mean_lower": self.mean_lower, "mean_upper": self.mean_upper}
        found["density"] = None if self.density is None else self.density.to_dict()
        return found | {"by_limit": [asdict(one) for one in self.by_limit]}

    def to_columns(self) -> dict[str, Array]:
        """Times and both curves, as ``pandas.DataFrame`` takes them."""
        return {"time": self.times, "lower": self.lower, "upper": self.upper}


def _ends_text(low: float, high: float) -> tuple[str, str]:
    return rounded(float(low), up=False, digits=4), rounded(float(high), up=True, digits=4)


@alone()
def bound_exit_times(
    problem: Problem, times: Sequence[float] | None = None, *, by_limit: bool = False
) -> ExitTimes:
    """Bound P(exit before s) for every s <= T from above and below, and the mean time of leaving.

    The mean comes first, and long horizons before short ones: once a limit of time is over, what was proved of them
    stands for all times.

    Parameters
    ----------
    problem : Problem
        One state, limits that hold over the whole horizon, and a set of starts. Where limits move there is a bound of
        its own for every time; otherwise they stand still, and the model does not depend on time.
    times : sequence of float, optional
        Where the curves are wanted; those of the value functions when omitted, a few where limits move.
    by_limit : bool
        Whether to bound also which limit is met first: a value function more for each of two limits.

    Returns
    -------
    ExitTimes

    Raises
    ------
    InfeasibleError
        If the problem is none of these, or nothing was proved; the message says why.
    ValueError
        If a time lies outside [0, T].

    Examples
    --------
    >>> import certbound as cb
    >>> system = cb.DiscreteSystem(lambda x: 0.9 * x, states=["x"], noise=cb.Gaussian(std=0.3))
    >>> problem = cb.Problem(system, initial=[0.2], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=60)
    >>> found = bound_exit_times(problem)
    >>> low, high = found.at(20)  # 0.555
    >>> 0.554 < low < high < 0.556
    True

    Source: Thm K8 of theory, one state.
    """
    instance("problem", problem, Problem)
    _check(problem)
    if any(constraint.region.moving for constraint in problem.constraints):
        return _within_moving_limits(problem, times)
    mean = _mean_by_function(problem)  # before the curves, which may take all of the time
    try:
        with contained("values"):
            upper, lower, share = (_continuous if isinstance(problem.system, ContinuousSystem) else _discrete)(problem)
    except EngineError as error:
        raise InfeasibleError(f"exit times could not be bounded: {error}") from error
    except OutOfTime:
        if mean is None:
            raise
        upper, lower, share = [], [], 0.0
    grid = np.unique([s for s, *_ in (*upper, *lower)] + [0.0, float(problem.horizon)])
    above = _above(upper, grid)
    below, least = (_below(lower, grid, k) for k in (1, 2))
    mean_lower, mean_upper = _sharper(mean, *_means(problem, grid, above, least, share))
    found = ExitTimes(
        problem=problem, times=grid, lower=below, upper=above, mean_lower=mean_lower, mean_upper=mean_upper,
        density=_density(problem, grid, above, least),
        by_limit=_by_limit(problem, float(above[-1]), float(below[-1])) if by_limit else (),
    )  # fmt: skip
    if times is None:
        return found
    asked = np.unique(vector("times", times))
    ends = np.array([found.at(float(s)) for s in asked])
    return replace(found, times=asked, lower=ends[:, 0], upper=ends[:, 1])


Curve = list[tuple[float, float, float]]
"""(s, bound from the worst start, bound that holds for every start)."""


def _check(problem: Problem) -> None:
    check_end(problem, "a curve of exit times")
    if problem.ending:
        raise InfeasibleError("exit times count leaving the domain as an exit; leave `leaving` out.")
    states = len(problem.closed_loop.outputs)  # ValueError of inputs without a plan
    if states != 1:
        raise InfeasibleError(
            f"exit times are bounded in one state, the problem has {states}; sweep over the horizon "
            "(`certbound sweep --over horizon=A:B:N`) for bounds at single times."
        )
    if not problem.constraints:
        raise InfeasibleError("exit times need a limit by which paths may leave; add a constraint.")
    if len(problem.starts) > 1 or problem.initial.random:
        raise InfeasibleError("exit times need one set of starts; take the members of a union one by one.")
    if problem.unknown:
        raise InfeasibleError("exit times have no bounds for unknown constants; give them values.")
    window = (0.0, float(problem.horizon))
    for constraint in problem.constraints:
        if constraint.during not in (None, window):
            raise InfeasibleError(f"exit times need limits that always hold, not '{constraint.label}'.")


def _within_moving_limits(problem: Problem, times: Sequence[float] | None) -> ExitTimes:
    """One value function for each time, of limits that are brought to rest: the last time comes first."""
    resting, horizon = bring_to_rest(problem), float(problem.horizon)
    asked = np.linspace(0.0, horizon, _TIMES + 1)[1:] if times is None else np.unique(vector("times", times))
    if asked[0] < 0 or asked[-1] > horizon:
        raise ValueError(f"`times` must lie in [0, {horizon:g}], got {asked.tolist()}.")
    whole = np.unique(np.ceil(asked)) if problem.system.time == "discrete" else asked
    upper: Curve = []
    lower: Curve = []
    refused = "the time was over."
    try:
        for s in whole[whole > 0][::-1].tolist():
            poll(f"exit times up to {s:g}")
            answer = _by(s, resting.above)
            refused = answer.reason
            upper += [(s, _power(answer.log10_delta, up=True), 1.0)] if answer.applicable else []
            answer = answer if resting.exact else _by(s, resting.below)
            least = answer.log10_lower if answer.applicable else None
            lower += [] if least is None else [(s, _power(least, up=False), 0.0)]
    except OutOfTime:
        if not upper and not lower:
            raise
    if not upper and not lower:
        raise InfeasibleError(f"exit times could not be bounded: {refused}")
    grid = np.unique([0.0, *whole.tolist(), horizon])
    above, below = _above(upper, grid), _below(lower, grid, 1)
    mean, _ = _means(problem, grid, above, np.zeros(len(grid)), 0.0)
    found = ExitTimes(problem=problem, times=grid, lower=below, upper=above, mean_lower=mean, mean_upper=None)
    if times is None:
        return found
    ends = np.array([found.at(float(s)) for s in asked])
    return replace(found, times=asked, lower=ends[:, 0], upper=ends[:, 1])


def _by(s: float, problem: Problem | None) -> EngineAnswer:
    """What value functions say of failing by a time; nothing where there is no problem."""
    if problem is None:
        return EngineAnswer(applicable=False, reason="nothing is left to be safe in.")
    with contained("values"):
        return values_engine(until(problem, s), Request(effort=_EFFORT))


def _continuous(problem: Problem) -> tuple[Curve, Curve, float]:
    """Upper and lower bounds by s, and the least probability over all states of leaving within T."""
    upper: Curve = []
    lower: Curve = []
    share, horizon = 0.0, float(problem.horizon)
    for k in range(_SHORTEST):
        poll(f"exit times up to {horizon:g}")
        ratio = _FEWER[min(p for p in _FEWER if not upper or upper[-1][1] <= p)]
        shorter = horizon / ratio if k + 1 < _SHORTEST else 0.0
        try:
            charts = chart_slabs_of(problem.replace(horizon=horizon), step=_STEP, last=horizon - shorter)
        except OutOfTime:
            if not upper:
                raise
            break
        upper += _read(problem, charts.upper, horizon, up=True)
        lower += _read(problem, charts.lower, horizon, up=False)
        if k == 0 and charts.lower:
            share = 10.0 ** float(charts.lower[0].log10.min())
        if not charts.upper or math.log10(max(upper[-1][1], 1e-300)) < _RARE:
            break
        horizon = shorter
    if not upper:
        raise InfeasibleError("no value function over the whole safe set could be proved.")
    return upper, lower, share


def _discrete(problem: Problem) -> tuple[Curve, Curve, float]:
    tape, rows = problem.closed_loop, problem.input_sequence
    found = sources(tape)
    clock = any(0 in slots for slots in found)
    if clock or (rows is not None and np.any(rows != rows[0])):
        raise InfeasibleError("exit times at all horizons at once need a model that does not depend on time.")
    charts = chart_failures(problem, share=_SHARE, times=int(problem.horizon))
    upper = _read(problem, charts.upper, problem.horizon, up=True)
    lower = _read(problem, charts.lower, problem.horizon, up=False)
    share = 10.0 ** float(charts.lower[0].log10.min()) if charts.lower else 0.0
    return upper, lower, share


def _read(problem: Problem, charts: Sequence[Chart], horizon: float, *, up: bool) -> Curve:
    """(s, worst, every start) of charts."""
    around = problem.initial.hull()
    low, high = float(around.lo[0]), float(around.hi[0])
    found = []
    for chart in charts:
        axis = chart.axes[0]
        if low < high:
            met = (axis[:-1] < high) & (axis[1:] > low)
            ends = chart.log10[met]
            whole = bool(axis[0] <= low and high <= axis[-1] and len(ends))
            most, least = (float(ends.max()), float(ends.min())) if whole else (0.0, -np.inf)
        else:
            most = least = float(chart.at(np.array([[low]]), up=up)[0])
        s = float(horizon) - chart.time
        gap = Fraction(s) - (Fraction(float(horizon)) - Fraction(chart.time))
        if gap > 0 if up else gap < 0:
            s = float(np.nextafter(s, -np.inf if up else np.inf))
        found.append((s, _power(most, up=up), _power(least, up=up)))
    return found


def _power(log10: float, *, up: bool) -> float:
    """10**log10 rounded up or down, in [0, 1]."""
    value = float(10.0**log10)
    return min(max(value * (1 + (1e-12 if up else -1e-12)), 0.0), 1.0)


def _above(curve: Curve, grid: Array) -> Array:
    """The smallest bound at each time or a later one: 1 where there is none."""
    found = np.ones(len(grid))
    for s, value, _ in curve:
        found[grid <= s] = np.minimum(found[grid <= s], value)
    return found


def _below(curve: Curve, grid: Array, place: int) -> Array:
    """The largest bound at each time or an earlier one: 0 where there is none."""
    found = np.zeros(len(grid))
    for row in curve:
        found[grid >= row[0]] = np.maximum(found[grid >= row[0]], row[place])
    return found


def _density(problem: Problem, grid: Array, above: Array, least: Array) -> Density:
    """Differences of the curves: P(a < exit <= b) <= P(exit by b) - P(exit by a), each from its side.

    ``least`` bounds the probability from every start, under the worst disturbance: another one may leave later, so that
    with a disturbance nothing is taken off, and nothing is known from below.
    """
    horizon = float(problem.horizon)
    times = np.linspace(0.0, horizon, _INTERVALS[problem.system.time] + 1)
    if problem.system.time == "discrete":
        times = np.unique(np.round(times))
    most = above[np.searchsorted(grid, times)]
    kept = least[np.searchsorted(grid, times, side="right") - 1] * (problem.system.disturbance is None)
    length = np.diff(times)
    lower = np.maximum((kept[1:] - most[:-1]) / length, 0.0) * (1 - 1e-12)
    return Density(times=times, lower=lower, upper=(most[1:] - kept[:-1]) / length * (1 + 1e-12))


def _by_limit(problem: Problem, upper: float, lower: float) -> tuple[LimitBounds, ...]:
    """Bounds of which limit is met first: between two limits, each with the other one as an end that does not fail.

    From one start, without a disturbance, P(this one) = P(leaving) - P(the other one).
    """
    names, sides = limits_of(problem), _sides(problem)
    uppers: dict[tuple[int, int], float] = {}
    lowers: dict[tuple[int, int], float] = {}
    ends = [] if sides is None else [_first_at(problem, sides[k][0], sides[1 - k][0], up=bool(k)) for k in (0, 1)]
    plain = problem.fixed_start and problem.system.disturbance is None
    for k, (least, most) in enumerate(ends):
        limits = sides[k][1] if sides else []
        most = min(most, upper * (1 + 1e-12) - ends[1 - k][0] * (1 - 1e-12)) if plain else most
        uppers |= {limit: _log10(most, up=True) for limit in limits}
        lowers |= {limits[0]: _log10(least, up=False)} if len(limits) == 1 else {}
    rest = _log10(lower, up=False)
    return bound_limits(
        names, _log10(upper, up=True), None if rest == -math.inf else rest, uppers=[uppers], lowers=lowers
    )


def _log10(value: float, *, up: bool) -> float:
    """log10 of a probability, rounded up or down: -inf only downward."""
    if value <= 0:
        return -300.0 if up else -math.inf
    return min(math.log10(value) * (1 - 1e-14) + 1e-14, 0.0) if up else math.log10(value) * (1 + 1e-14) - 1e-14


Side = tuple[float, list[tuple[int, int]]]
"""Where a limit lies, and the limits on this side: those that are met together count as met first."""


def _sides(problem: Problem) -> tuple[Side, Side] | None:
    """The lower and the upper limit of the state; None where there are not just two, or where floats round them."""
    low: list[tuple[float, tuple[int, int]]] = []
    high: list[tuple[float, tuple[int, int]]] = []
    for number, constraint in enumerate(problem.kept):
        region, form = constraint.region, constraint.region.form
        plain = isinstance(region, Box) and region.center is None and not constraint.outside
        if not plain or not isinstance(form, Faces):
            return None
        own = number if number < len(problem.safe) else -1
        for place, (row, bound) in enumerate(zip(form.normals[:, 0], form.bounds)):
            (high if row > 0 else low).append((float(bound if row > 0 else -bound), (own, place)))
    if not low or not high:
        return None
    least, most = max(end for end, _ in low), min(end for end, _ in high)
    return (least, [limit for _, limit in low]), (most, [limit for _, limit in high])


def _first_at(problem: Problem, place: float, other: float, *, up: bool) -> tuple[float, float]:
    """Bounds of P(the state leaves at ``place`` within T, before it leaves at the ``other`` end); 0 and 1 for none."""
    inside, ends = ((-math.inf, place), (other, math.inf)) if up else ((place, math.inf), (-math.inf, other))
    alone = problem.replace(
        safe=[Inside(Box(*([end] for end in inside)))], domain=Box(*([end] for end in ends)), leaving="ends"
    )
    try:
        with contained("values"), share_of_time(_HALF if not up else 1.0):
            if isinstance(problem.system, ContinuousSystem):
                found = bound_exits(alone)
                least = 0.0 if found.lower is None else _power(found.lower, up=False)
                return least, max(_power(found.upper, up=True), 1e-300)
            chain = bound_chain(alone, seconds=_SECONDS)
            return chain.lower, chain.upper
    except (EngineError, InfeasibleError, OutOfTime):
        return 0.0, 1.0


def _mean_by_function(problem: Problem) -> tuple[float, float | None] | None:
    """Bounds of the mean by one function of the state; None where it proves nothing."""
    try:
        with contained("mean time"), share_of_time(_HALF):
            return bound_mean_time(problem)
    except EngineError:
        pass
    return None


def _sharper(
    found: tuple[float, float | None] | None, low: float, high: float | None
) -> tuple[float, float | None]:
    """The better of these bounds of the mean and of those by one function."""
    if found is None:
        return low, high
    return max(low, found[0]), min((end for end in (high, found[1]) if end is not None), default=None)


def _means(problem: Problem, grid: Array, above: Array, least: Array, share: float) -> tuple[float, float | None]:
    """Bounds of the mean time of leaving: the integral of P(not left) up to T, and what may come after.

    From any state, leaving within T has at least the probability ``share``, so that the mean time that a path which
    has not left still takes is at most T/share.
    """
    steps = Interval.point(np.diff(grid))
    discrete = problem.system.time == "discrete"
    # in discrete time the exit step exceeds s on all of [s, s + 1)
    kept = (1 - above[1:]) * (1 - 1e-12) if not discrete else (1 - above[:-1]) * (1 - 1e-12)
    low = float((steps * Interval.point(np.maximum(kept, 0.0))).sum().lo)
    if problem.system.disturbance is not None or not share > 0:
        return low, None
    still = (1 - least) * (1 + 1e-12)
    inside = float((steps * Interval.point(still[:-1])).sum().hi)
    tail = float(still[-1]) * float(problem.horizon) / share
    return low, (inside + tail) * (1 + 1e-12)
