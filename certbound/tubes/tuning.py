"""The two questions of this room: the best tube for a level, and the level of a given clearance."""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from typing import Any

import numpy as np

from certbound.errors import InfeasibleError, SolverError
from certbound.tubes.constants import Constants, check_delta
from certbound.tubes.exact import AlmostSureProfile, bound_exact_exit, bound_worst_exit, first_passage_tube
from certbound.tubes.kummer import (
    KummerProfile,
    Search,
    check_power,
    exit_level,
    mixture_level,
    mixture_tube,
    union_level,
    union_may_help,
)
from certbound.tubes.objective import Objective
from certbound.tubes.paper import BASELINES, baseline_tube
from certbound.tubes.question import Question, Start
from certbound.tubes.schedule import Schedule, spread
from certbound.tubes.tube import Tube, log10_upper, supremum

METHODS = ("auto", "kummer", "bessel", "mixture", "exact", "worst_case", *BASELINES)
"""Every name that ``method`` takes."""

SLOW = ("mixture", "exact", "worst_case")
"""Methods that take seconds; ``auto`` tries them with ``thorough=True``."""

_FAR = 2e-3
"""Standard deviation in units of the clearance below which the search works at a smaller scale."""

_log = logging.getLogger(__name__)
_FAMILY = ("kummer", "bessel")
_QUICK = (*_FAMILY, "thm2", "thm2_cosh", "thm3_cosh", "thm3_sharp", "thm4", "prop3_sharp", "thm5_sharp")


def tune_tube(
    constants: Constants,
    *,
    horizon: float,
    delta: float,
    objective: Any = "max",
    method: str = "auto",
    epsilon: float | None = None,
    step: float | None = None,
    thorough: bool = False,
    start: Start | None = None,
) -> Tube:
    """The tightest tube of a method: P(||S_t||_P <= r_t for all t in [0, T]) >= 1 - delta.

    Parameters
    ----------
    constants : Constants
        Rate (CT) or gain (DT), sigma, dimension; assumed when stated, proved when bounded.
    horizon : float
        T in s, or whole steps.
    delta : float
        Probability of leaving the tube, in (0, 1).
    objective : str or pair
        ``"max"`` (largest radius over [0, T]), ``"final"``, ``"mean"``, or ``(times, values)``: the least scale of a
        piecewise-constant clearance.
    method : str
        One of :data:`METHODS`. ``"auto"`` takes the best of all certified trajectory-level tubes; the one-time
        bounds (Props 1, 2, Markov, Chebyshev) and the printed variants only come by name.
    epsilon, step : float, optional
        The paper's free parameters; optimised when omitted, of no effect on formulas without them.
    thorough : bool
        Let ``"auto"`` try the slow methods as well: ``"exact"`` (isotropic noise), ``"worst_case"`` (continuous
        time) and ``"mixture"``; seconds instead of milliseconds.
    start : Start, optional
        Deviation at time 0 (Kummer and Bessel forms only; S_0 = 0 when omitted).

    Returns
    -------
    Tube
        The radius is evaluated in ball arithmetic from the parameters found: the search only proposes.

    Raises
    ------
    ValueError
        For a parameter out of range, an unknown method, or a method whose hypotheses fail.

    Source: Thms K1, K3 of docs/theory.md; Props 1-3, Thms 2-5 (paper).

    Examples
    --------
    >>> constants = Constants(rate=-0.5, sigma=0.1**0.5, dimension=1)
    >>> tube = tune_tube(constants, horizon=5.0, delta=1e-3)
    >>> tube.certified, round(tube.maximum, 4)
    (True, 1.3396)
    """
    delta = check_delta(delta)
    if method not in METHODS:
        raise ValueError(f"`method` must be one of {', '.join(METHODS)}, got {method!r}.")
    question = Question.of(constants, horizon, objective=objective, start=start)
    if question.moving and method not in ("auto", *_FAMILY):
        raise ValueError(f"`start` needs `method` 'auto', 'kummer' or 'bessel', got {method!r}.")
    if (epsilon is not None or step is not None) and method not in BASELINES:
        raise ValueError(f"`epsilon` and `step` belong to the paper's methods; `method` is {method!r}.")
    if method == "auto":
        tube = _best_tube(question, delta, thorough=thorough)
    else:
        tube = _tube_by(question, delta, method, epsilon=epsilon, step=step)
    if tube is None:
        raise InfeasibleError(f"no tube of `method` {method!r} was found; try 'kummer'.")
    return _cut_by_bound(tube, question)


def _best_tube(question: Question, delta: float, *, thorough: bool) -> Tube | None:
    """The best of all that apply; one whose first look promises no gain is left out."""
    best: Tube | None = None
    value = math.inf
    for name in applicable_methods(question.constants):
        if question.moving and name not in _FAMILY:
            continue
        tube = _tube_by(question, delta, name, unless=value)
        if tube is None:
            continue
        other = tube_objective(tube, question.goal)
        if best is None or other < value:
            best, value = tube, other
    if best is not None and thorough and not question.moving and value > 0:
        return _thorough_tube(question, delta, best)
    return best


def _tube_by(
    question: Question, delta: float, method: str, *, epsilon: float | None = None, step: float | None = None,
    unless: float = math.inf,
) -> Tube | None:
    """The tube of one method; None when a first look exceeds ``unless``."""
    if method in SLOW:
        return _slow_tube(question, delta, method, seed=None)
    if method in _FAMILY:
        return _family_tube(question, delta, bessel=method == "bessel", unless=unless)
    return baseline_tube(question, delta, method, epsilon=epsilon, step=step, unless=unless)


def _cut_by_bound(tube: Tube, question: Question) -> Tube:
    """The pointwise minimum with the almost-sure bound, where the noise has one."""
    bound, schedule = tube.constants.noise_bound, question.schedule
    if bound is None or question.start.sigma > 0 or tube.level != "trajectory":
        return tube
    pieces = len(schedule.lengths)
    bounds = spread(np.atleast_1d(np.asarray(bound, dtype=float))[:pieces], pieces)
    return replace(tube, bounded=AlmostSureProfile(schedule=schedule, bounds=bounds, start=question.start.offset))


def _thorough_tube(question: Question, delta: float, best: Tube) -> Tube:
    """The best of ``best`` and the slow methods that apply; one that fails is left out."""
    constants, goal = question.constants, question.goal
    value, seed, decided = tube_objective(best, goal), best, False
    names = ["exact"] * constants.isotropic + ["worst_case"] * constants.continuous + ["mixture"]
    for name in names:
        if decided and name == "mixture":
            continue  # a first-passage law is the limit of every mixture
        try:
            tube = _slow_tube(question, delta, name, seed=seed)
        except (InfeasibleError, SolverError) as error:
            _log.debug("%s is left out: %s", name, error)
            continue
        if (other := tube_objective(tube, goal)) < value:
            best, value = tube, other
            decided = decided or (name != "mixture" and goal.kind == "scale" and goal.clearance is None)
    return best


def _slow_tube(question: Question, delta: float, method: str, *, seed: Tube | None) -> Tube:
    """A tube of a slow method; ``seed`` is a valid tube to start from."""
    if question.silent:
        raise InfeasibleError(f"`method` {method!r} needs noise, sigma is 0; use 'kummer' (the radius is 0).")
    seed = seed or _family_tube(question, delta, bessel=False)
    assert seed is not None
    if method == "mixture":
        return mixture_tube(question, delta, seed=seed)
    return first_passage_tube(question, delta, worst=method == "worst_case", above=seed.maximum)


def applicable_methods(constants: Constants) -> list[str]:
    """Names that ``auto`` compares for these constants: certified, trajectory level, hypotheses fulfilled."""
    time = "continuous" if constants.continuous else "discrete"
    contracting = constants.worst_slope < (0 if constants.continuous else 1)
    names = []
    for name in _QUICK:
        row = BASELINES.get(name)
        if row is not None and (
            row.time != time
            or (row.tail == "cosh" and constants.dimension != 1)
            or (row.kind == "windows" and row.tail != "sharp" and not contracting)
        ):
            continue
        names.append(name)
    return names


def tube_objective(tube: Tube, goal: Objective) -> float:
    """Value of an objective: a rigorous upper bound except for the mean, which is a quadrature."""
    horizon, whole = tube.horizon, not tube.constants.continuous
    if goal.kind == "final":
        return float(tube.bound(horizon, horizon))
    if goal.kind == "mean":
        if whole:
            return float(np.mean(tube.radius(np.arange(1.0, horizon + 1))))
        grid = np.unique(np.append(np.linspace(0, horizon, 129), tube.profile.times))
        return float(np.trapezoid(tube.radius(grid), grid) / horizon)
    if goal.clearance is None:
        return tube.maximum
    held = goal.clearance
    scale = 0.0
    for begin, end, value in zip(held.times[:-1], held.times[1:], held.values):
        if whole:
            begin, end = math.ceil(begin), (end if end == horizon else math.ceil(end) - 1)
            if begin > end:
                continue
        if np.isfinite(value):
            scale = max(scale, supremum(tube.profile, float(begin), float(end), whole=whole) / float(value))
    return scale


def _family_tube(question: Question, delta: float, *, bessel: bool, unless: float = math.inf) -> Tube | None:
    """Thm K1, or its Bessel form, with the best parameters found; None when a first look exceeds ``unless``."""
    goal, start = question.goal, question.start
    schedule = question.with_any_power().schedule if bessel else question.schedule
    unit = schedule.unit
    idle = schedule.idle_time() if goal.kind == "final" else 0.0
    if idle > 0:
        schedule = schedule.idled(idle)
    graded = goal.cut(schedule).graded(6 if goal.kind != "mean" else 16)
    search = Search.of(question, graded, bessel=bessel, log_delta=math.log(delta))
    if question.silent:
        a, v0 = (1.0 if bessel else 0.0), 1.0
    else:
        if unless < math.inf and search.worse_than(1.3 * unless):
            return None
        a, v0 = search.solve()
    check_power(schedule, a, bessel=bessel)
    profile = KummerProfile(schedule=schedule, a=a, v0=v0, delta=delta, bessel=bessel, start=start)
    parameters = {"a": a, "v0": v0 * unit**2, **({"idle": idle} if idle > 0 else {})}
    return question.tube("bessel" if bessel else "kummer", delta, parameters, profile)


def bound_exit_probability(
    constants: Constants, *, horizon: float, clearance: Any, start: Start | None = None, thorough: bool = False
) -> float:
    """log10 of an upper bound of P(exists t in [0, T]: ||S_t||_P > clearance_t).

    Parameters
    ----------
    constants : Constants
        Rate or gain, sigma, dimension.
    horizon : float
        T in s, or whole steps.
    clearance : float or pair
        A number, or ``(times, values)``: lower bounds, ``values[k]`` on [times[k], times[k+1]). In continuous time
        the inequality is proved between the nodes, not only at them.
    start : Start, optional
        Deviation at time 0.
    thorough : bool
        Try mixtures and first-passage laws as well (seconds).

    Returns
    -------
    float
        Finite and at most 0 (0 when nothing is certified; -1e12 where there is no noise at all).

    Raises
    ------
    ValueError, TypeError
        For a clearance that is not positive, or a callable.

    Source: Thm K2, items 7.5 and 7.13 of docs/theory.md.

    Examples
    --------
    >>> constants = Constants(rate=-0.5, sigma=0.1**0.5, dimension=1)
    >>> bound_exit_probability(constants, horizon=5.0, clearance=1.34) < -3
    True
    """
    return least_exit_level(Question.of(constants, horizon, clearance=clearance, start=start), thorough=thorough)


def least_exit_level(question: Question, *, thorough: bool = False) -> float:
    """:func:`bound_exit_probability` for the clearance of a question."""
    if question.silent and not question.moving:
        return -1e12
    held, start, cut = question.clearance, question.start, question.cut
    scaled = replace(question, schedule=cut).with_any_power().schedule
    a, v0 = _parameters(question, cut)
    best, pair = exit_level(cut, held, a=a, v0=v0, start=start), (a, v0, False)
    if np.max(cut.rates) >= 0:
        a, v0 = _parameters(question, scaled, bessel=True)
        best = min(best, exit_level(scaled, held, a=a, v0=v0, bessel=True, start=start))
    if not question.moving and not scaled.continuous and union_may_help(scaled, held, best):
        best = min(best, union_level(scaled, held))
    if thorough and not question.moving:
        best = min(best, _thorough_level(question, cut, pair, best))
    return max(best, -1e12)


def _parameters(question: Question, schedule: Schedule, *, bessel: bool = False) -> tuple[float, float]:
    """(a, v_0) of about the least probability."""
    graded = schedule.graded(4)
    search = Search.of(question, graded, bessel=bessel)
    # far out the parameters hardly change, but the sums grow: they are sought nearer
    farthest = float(np.max(np.sqrt(graded.nodes[1]) * (schedule.unit / search.weights)))
    if 0 < farthest < _FAR:
        search = replace(search, weights=search.weights * (farthest / _FAR))
    return search.solve()


def _thorough_level(question: Question, cut: Schedule, pair: tuple[float, float, bool], best: float) -> float:
    """log10 of the probability by the slow methods that apply."""
    constants, held, levels = question.constants, question.clearance, [0.0]
    try:
        levels.append(mixture_level(cut, held, best=[pair]))
    except SolverError as error:
        _log.debug("mixture is left out: %s", error)
    laws = [bound_exact_exit] * constants.isotropic + [bound_worst_exit] * constants.continuous
    if np.all(held.values == held.values[0]) and best > -9:
        for law in laws:
            target = min(0.5, 10.0 ** min(best, *levels))
            try:
                value = law(constants, horizon=question.horizon, radius=float(held.values[0]), target=target)
            except InfeasibleError as error:
                _log.debug("%s is left out: %s", law.__name__, error)
                continue
            levels.append(log10_upper(value) if value > 0 else 0.0)
    return min(levels)
