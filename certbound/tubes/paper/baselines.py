"""Tubes by the paper's names: checks of the hypotheses, and the best epsilon and step (``docs/theory.md``, Sec. 2)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from certbound.tubes.paper.radii import RootProfile, Tail, best_epsilon, best_growth, growth, sharp_tail
from certbound.tubes.paper.windows import WindowProfile, event_count, window_scale
from certbound.tubes.question import Question
from certbound.tubes.schedule import Schedule, integral
from certbound.tubes.tube import Profile, Tube


@dataclass(frozen=True, kw_only=True)
class Baseline:
    """One named formula."""

    time: str  # ``"continuous"``, ``"discrete"`` or ``"both"``
    kind: str  # roots of :class:`certbound.tubes.paper.radii.RootProfile`, or ``"windows"``
    level: str  # ``"trajectory"`` or ``"one time"``
    title: str  # its source
    tail: str = "growth"  # kind of B
    printed: bool = False  # a variant that keeps an error of the paper: never certified, never chosen

_CT, _DT, _ONE, _ALL = "continuous", "discrete", "one time", "trajectory"
_MOST_WINDOWS = 512
_SLACK = 0.85  # the sharp tail gains at most that over the growth bound that the estimates use
BASELINES: dict[str, Baseline] = {
    "prop1": Baseline(time=_CT, kind="variance", level=_ONE, title="Prop 1 (paper)"),
    "prop1_cosh": Baseline(time=_CT, kind="variance", level=_ONE, tail="cosh", title="Prop 1, n = 1"),
    "prop1_sharp": Baseline(time=_CT, kind="variance", level=_ONE, tail="sharp", title="item 7.11"),
    "prop2": Baseline(time=_DT, kind="variance", level=_ONE, title="Prop 2 (paper)"),
    "prop2_sharp": Baseline(time=_DT, kind="variance", level=_ONE, tail="sharp", title="item 7.11"),
    "prop3": Baseline(time=_DT, kind="variance", level=_ALL, title="Prop 3 (paper)"),
    "prop3_sharp": Baseline(time=_DT, kind="variance", level=_ALL, tail="sharp", title="item 7.11"),
    "thm2": Baseline(time=_CT, kind="scaled", level=_ALL, title="Thm 2 (paper)"),
    "thm2_cosh": Baseline(time=_CT, kind="scaled", level=_ALL, tail="cosh", title="Thm 2, n = 1"),
    "thm3": Baseline(time=_CT, kind="windows", level=_ALL, title="Thm 3 (paper)"),
    "thm3_cosh": Baseline(time=_CT, kind="windows", level=_ALL, tail="cosh", title="Thm 3, n = 1"),
    "thm3_sharp": Baseline(time=_CT, kind="windows", level=_ALL, tail="sharp", title="items 7.11, 7.15"),
    "thm3_as_printed": Baseline(time=_CT, kind="windows", level=_ALL, printed=True, title="Thm 3 with N = T/step (E6)"),
    "thm4": Baseline(time=_DT, kind="scaled", level=_ALL, title="Thm 4 (paper), corrected (E1)"),
    "thm4_as_printed": Baseline(
        time=_DT, kind="printed", level=_ALL, printed=True, title="Thm 4 without the factor 1/L (E1)"
    ),
    "thm5": Baseline(time=_DT, kind="windows", level=_ALL, title="Thm 5 (paper)"),
    "thm5_sharp": Baseline(time=_DT, kind="windows", level=_ALL, tail="sharp", title="items 7.11, 7.15"),
    "thm5_as_printed": Baseline(time=_DT, kind="windows", level=_ALL, printed=True, title="Thm 5 with N = T/step (E6)"),
    "markov": Baseline(time="both", kind="variance", level=_ONE, tail="moment", title="Markov, E||S||^2 <= nu V"),
    "chebyshev": Baseline(time="both", kind="variance", level=_ONE, tail="moment", title="Chebyshev, nu = n"),
}
"""Every named formula but the Kummer family."""


def baseline_tube(
    question: Question,
    delta: float,
    method: str,
    *,
    epsilon: float | None = None,
    step: float | None = None,
    unless: float = math.inf,
) -> Tube | None:
    """A tube by a formula of the paper, its free parameters stated or optimised.

    Parameters
    ----------
    question : Question
        Its goal is what ``step`` minimises (``epsilon`` has one best value for all of them).
    delta : float
        As in :func:`certbound.tune_tube`.
    method : str
        A key of :data:`BASELINES`.
    epsilon : float, optional
        In (0, 1).
    step : float, optional
        Window length, in (0, T]; whole in discrete time.

    unless : float
        None is returned when a quick estimate of the objective exceeds this value by 15 %.

    Raises
    ------
    ValueError
        If a hypothesis of the theorem fails (the message says which theorem applies) or a parameter is out of range.

    Source: Props 1-3, Thms 2-5 (paper), with E1-E6 and items 7.11, 7.15 of docs/theory.md.
    """
    row = BASELINES[method]
    _check_hypotheses(question, method, row)
    if epsilon is not None and not 0 < epsilon < 1:
        raise ValueError(f"`epsilon` must lie in (0, 1), got {epsilon}.")
    if step is not None:
        step = _checked_step(step, question.schedule)
    builder = _Builder(question, delta, method, epsilon)
    if unless < math.inf and builder.estimate(step) > unless / _SLACK:
        return None
    profile, parameters = builder.windows(step) if row.kind == "windows" else builder.roots()
    certified = row.level == _ALL and not row.printed
    return question.tube(method, delta, parameters, profile, level=row.level, certified=certified)


def check_method(method: str, *, continuous: bool, dimension: int) -> None:
    """Refuse a method of the paper whose theorem is for the other time, or for one dimension only.

    Raises
    ------
    ValueError
        If that is so; methods that are not the paper's pass.
    """
    row = BASELINES.get(method)
    if row is None:
        return
    asked = "both" if row.time == "both" else ("continuous" if continuous else "discrete")
    if row.time != asked:
        other = {"continuous": "`rate` (continuous time)", "discrete": "`gain` (discrete time)"}[row.time]
        use = "thm4 or thm5" if row.time == "continuous" else "thm2 or thm3"
        raise ValueError(f"`method` {method!r} needs constants with {other}; use {use}, or 'auto'.")
    if row.tail == "cosh" and dimension != 1:
        raise ValueError(f"`method` {method!r} needs dimension 1, got {dimension}; drop '_cosh'.")


def _check_hypotheses(question: Question, method: str, row: Baseline) -> None:
    constants, schedule = question.constants, question.schedule
    check_method(method, continuous=constants.continuous, dimension=constants.dimension)
    worst = float(np.max(schedule.slopes))
    if row.kind == "windows" and row.tail != "sharp":
        if constants.continuous and worst >= 0:
            raise ValueError(f"`method` {method!r} (Thm 3) needs rate < 0, got {worst:g}; Thm 2 applies: use 'thm2'.")
        if not constants.continuous and worst >= 1:
            raise ValueError(f"`method` {method!r} (Thm 5) needs gain < 1, got {worst:g}; Thm 4 applies: use 'thm4'.")
    if row.printed and len(schedule.lengths) > 1:
        raise ValueError(f"`method` {method!r} is printed for constant data only; drop '_as_printed'.")


def _checked_step(step: float, schedule: Schedule) -> float:
    value = float(step)
    if not 0 < value <= schedule.horizon:
        raise ValueError(f"`step` must lie in (0, {schedule.horizon:g}], got {step}.")
    if not schedule.continuous and value != round(value):
        raise ValueError(f"`step` must be a whole number of steps in discrete time, got {step}.")
    return value


@dataclass(frozen=True, eq=False)
class _Builder:
    question: Question
    delta: float
    method: str
    epsilon: float | None

    @property
    def row(self) -> Baseline:
        return BASELINES[self.method]

    @property
    def schedule(self) -> Schedule:
        return self.question.schedule

    def tail(self, count: float) -> Tail:
        """B for a number of events, with the best free parameter."""
        row, n, nu = self.row, self.question.constants.dimension, self.question.constants.nu
        if row.tail == "sharp":
            return sharp_tail(delta=self.delta, dimension=nu if self.schedule.any_power else n, count=count)
        if row.tail == "moment":
            weight = nu if self.method == "markov" else float(n)
            return Tail(kind="moment", delta=self.delta, dimension=n, weight=weight)
        if row.tail == "cosh":
            return Tail(kind="cosh", delta=self.delta, dimension=n, count=count)
        level = math.log(count) - math.log(self.delta)
        epsilon = best_epsilon(n, level) if self.epsilon is None else float(self.epsilon)
        return Tail(kind="growth", delta=self.delta, dimension=n, count=count, epsilon=epsilon)

    def size(self, count: float) -> float:
        """B in floating point (the growth bound stands for the sharp one)."""
        n, level = self.question.constants.dimension, math.log(count) - math.log(self.delta)
        if self.row.tail == "cosh":
            return 2 * math.log(2) + 2 * level
        return best_growth(n, level) if self.epsilon is None else growth(self.epsilon, n, level)

    def estimate(self, step: float | None) -> float:
        """Objective in floating point, roughly: the growth bound stands for the sharp one, steps are halved."""
        data, row = self.schedule, self.row
        if row.kind == "windows":
            scale = self._closed_scale() if self._plain else self._sum_scale
            return scale(step) if step is not None else rough_scale(data, scale, self._most)
        roots, weights = self.question.goal.roots(data, scaled=row.kind == "scaled")
        with np.errstate(over="ignore", invalid="ignore"):
            scale_value = float(np.max(roots / weights)) * math.sqrt(self.size(self._steps)) * data.unit
        return scale_value if scale_value == scale_value else math.inf

    @property
    def _most(self) -> int:
        """Largest number of windows to try: sums over windows are evaluated one by one."""
        return 1 << 40 if self._plain else _MOST_WINDOWS

    @property
    def _plain(self) -> bool:
        return len(self.schedule.lengths) == 1 and self.row.tail != "sharp"

    def roots(self) -> tuple[Profile, dict[str, Any]]:
        """One-root formulas."""
        tail = self.tail(self._steps)
        return RootProfile(schedule=self.schedule, tail=tail, kind=self.row.kind), _parameters(tail)

    @property
    def _steps(self) -> float:
        """Number of events of a one-root formula: Prop 3 adds the steps up."""
        return self.schedule.horizon if self.method.startswith("prop3") else 1.0

    def windows(self, step: float | None) -> tuple[Profile, dict[str, Any]]:
        """Thms 3 and 5."""
        data = self.schedule
        if step is None:
            step = best_step(data, self._closed_scale() if self._plain else self._sum_scale, self._most)
        tail = self.tail(self._events(step))
        profile: Profile = WindowProfile(schedule=data, tail=tail, step=step)
        if self._plain:
            windows = _window_count(data.horizon, step)
            profile = RootProfile(schedule=data, tail=tail, kind="windows", step=step, count=windows)
        return profile, {**_parameters(tail), "step": step}

    def _events(self, step: float) -> float:
        data = self.schedule
        if self.row.tail == "sharp":
            return event_count(data.horizon, step, continuous=data.continuous)
        windows = data.horizon / step if self.row.printed else _window_count(data.horizon, step)
        return windows if not data.continuous and step == 1 else 2 * windows

    def _closed_scale(self) -> Callable[[float], float]:
        """Objective of Thms 3 and 5 for constant data, as a function of the step."""
        data = self.schedule
        roots, weights = self.question.goal.roots(data)
        rate, noise = data.rates[0], data.noise[0]
        shrink = 1.0 if data.continuous else math.exp(2 * rate)

        def scale(step: float) -> float:
            inside = step if data.continuous else step - 1
            window = math.sqrt(noise * float(integral(-2 * rate, np.asarray(inside))) * shrink)
            return data.unit * float(np.max((roots + window) / weights)) * math.sqrt(self.size(self._events(step)))

        return scale

    def _sum_scale(self, step: float) -> float:
        """Objective of the window sums, as a function of the step."""
        data, weights = self.question.goal.pieces(self.schedule)
        with np.errstate(over="ignore", invalid="ignore"):
            scale = window_scale(data, step, weights, final=self.question.goal.kind == "final")
            scale *= math.sqrt(self.size(self._events(step)))
        return scale if scale == scale else math.inf


def _parameters(tail: Tail) -> dict[str, Any]:
    if tail.kind == "growth":
        return {"epsilon": tail.epsilon}
    return {"power": tail.power} if tail.kind == "sharp" else {}


def _window_count(horizon: float, step: float) -> int:
    """N = ceil(T/step), forgiving the rounding of the quotient."""
    return max(1, math.ceil(horizon / step * (1 - 1e-12)))


def best_step(schedule: Schedule, scale: Callable[[float], float], most: int) -> float:
    """The step with the least objective: T/N over whole N up to ``most`` in CT, whole steps of at least T/most in DT.

    The objective is one valley in N (a falling root plus a slowly rising level) up to the ceilings of DT.
    """
    horizon = schedule.horizon
    if not schedule.continuous:
        return _best_whole(lambda k: scale(float(k)), int(horizon), math.ceil(horizon / most))
    count = _best_whole(lambda k: scale(horizon / k), most)
    return horizon / count


def rough_scale(schedule: Schedule, scale: Callable[[float], float], most: int) -> float:
    """Least objective over doubled window counts (CT) or steps (DT)."""
    best, k, limit = math.inf, 1, most
    if not schedule.continuous:
        k, limit = math.ceil(schedule.horizon / most), int(schedule.horizon)
    first = k
    while k <= limit:
        value = scale(schedule.horizon / k if schedule.continuous else float(k))
        if value > best and k >= 8 * first:
            break
        best, k = min(best, value), 2 * k
    return best


def _best_whole(function: Callable[[int], float], limit: int, least: int = 1) -> int:
    """Whole number in [least, limit] of the least value: doubling, then thirds, then all the neighbours."""
    known: dict[int, float] = {}

    def value(k: int) -> float:
        if k not in known:
            known[k] = function(k)
        return known[k]

    k = least
    value(k)  # one step a window is a formula of its own (Thm 5)
    while k < limit and (k < 4 * least or value(min(2 * k, limit)) <= value(k)):
        k = min(2 * k, limit)
    low, high = max(least, k // 4), min(limit, 2 * k)
    while high - low > 8:
        a, b = low + (high - low) // 3, high - (high - low) // 3
        if value(a) <= value(b):
            high = b
        else:
            low = a
    for j in range(max(least, low - 4), min(limit, high + 4) + 1):
        value(j)
    return min(known, key=lambda j: known[j])
