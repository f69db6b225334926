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
    Start,
    check_power,
    check_start,
    exit_level,
    mixture_level,
    mixture_tube,
    union_level,
    union_may_help,
)
from certbound.tubes.objective import Clearance, Objective, make_objective, read_clearance
from certbound.tubes.paper import BASELINES, baseline_tube
from certbound.tubes.schedule import Schedule, make_schedule, spread
from certbound.tubes.tube import Tube, log10_upper, supremum

__all__ = ["METHODS", "applicable_methods", "bound_exit_probability", "tube_objective", "tune_tube"]

METHODS = ("auto", "kummer", "bessel", "mixture", "exact", "worst_case", *BASELINES)
"""Every name that ``method`` takes."""

SLOW = ("mixture", "exact", "worst_case")
"""Methods that take seconds; ``auto`` tries them with ``thorough=True``."""

_FAR = 2e-3
"""Standard deviation in units of the clearance below which the search works at a smaller scale."""

_log = logging.getLogger(__name__)
_QUICK = ("kummer", "bessel", "thm2", "thm2_cosh", "thm3_cosh", "thm3_sharp", "thm4", "prop3_sharp", "thm5_sharp")


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
    schedule = make_schedule(constants, horizon)
    goal = make_objective(objective, schedule.horizon, continuous=schedule.continuous)
    start = start or Start()
    check_start(schedule, start, constants.dimension)
    moving = start.offset > 0 or start.sigma > 0
    if moving and method not in ("auto", "kummer", "bessel"):
        raise ValueError(f"`start` needs `method` 'auto', 'kummer' or 'bessel', got {method!r}.")
    if (epsilon is not None or step is not None) and method not in BASELINES:
        raise ValueError(f"`epsilon` and `step` belong to the paper's methods; `method` is {method!r}.")

    best: Tube | None = None
    value = math.inf
    for name in applicable_methods(constants) if method == "auto" else (method,):
        tube: Tube | None
        if name in SLOW:
            tube = _slow_tube(constants, schedule, delta, goal, name, seed=None)
        elif name in ("kummer", "bessel"):
            bessel = name == "bessel"
            tube = _family_tube(constants, schedule, delta, goal, start, bessel=bessel, unless=value)
        elif moving:
            continue
        else:
            tube = baseline_tube(
                constants,
                name,
                horizon=schedule.horizon,
                delta=delta,
                objective=goal,
                epsilon=epsilon,
                step=step,
                unless=value,
            )
        if tube is None:
            continue
        other = tube_objective(tube, goal) if method == "auto" else value
        if best is None or other < value:
            best, value = tube, other
    if best is None:
        raise InfeasibleError(f"no tube of `method` {method!r} was found; try 'kummer'.")
    if method == "auto" and thorough and not moving and value > 0:
        best = _thorough_tube(constants, schedule, delta, goal, best)
    return _cut_by_bound(best, schedule, start)


def _cut_by_bound(tube: Tube, schedule: Schedule, start: Start) -> Tube:
    """The pointwise minimum with the almost-sure bound, where the noise has one."""
    bound = tube.constants.noise_bound
    if bound is None or start.sigma > 0 or tube.level != "trajectory":
        return tube
    pieces = len(schedule.lengths)
    bounds = spread(np.atleast_1d(np.asarray(bound, dtype=float))[:pieces], pieces)
    return replace(tube, bounded=AlmostSureProfile(schedule=schedule, bounds=bounds, start=start.offset))


def _thorough_tube(constants: Constants, schedule: Schedule, delta: float, goal: Objective, best: Tube) -> Tube:
    """The best of ``best`` and the slow methods that apply; one that fails is left out."""
    value, seed, decided = tube_objective(best, goal), best, False
    names = ["exact"] * constants.isotropic + ["worst_case"] * constants.continuous + ["mixture"]
    for name in names:
        if decided and name == "mixture":
            continue  # a first-passage law is the limit of every mixture
        try:
            tube = _slow_tube(constants, schedule, delta, goal, name, seed=seed)
        except (InfeasibleError, SolverError) as error:
            _log.debug("%s is left out: %s", name, error)
            continue
        if (other := tube_objective(tube, goal)) < value:
            best, value = tube, other
            decided = decided or (name != "mixture" and goal.kind == "scale" and goal.clearance is None)
    return best


def _slow_tube(
    constants: Constants, schedule: Schedule, delta: float, goal: Objective, method: str, *, seed: Tube | None
) -> Tube:
    """A tube of a slow method; ``seed`` is a valid tube to start from."""
    if np.max(schedule.sigmas) == 0:
        raise InfeasibleError(f"`method` {method!r} needs noise, sigma is 0; use 'kummer' (the radius is 0).")
    if seed is None:
        seed = _family_tube(constants, schedule, delta, goal, Start(), bessel=False)
    assert seed is not None
    if method == "mixture":
        return mixture_tube(constants, schedule, delta, goal, seed=seed, objective=goal.given)
    return first_passage_tube(
        constants, horizon=schedule.horizon, delta=delta, worst=method == "worst_case", objective=goal.given,
        above=seed.maximum,
    )  # fmt: skip


def applicable_methods(constants: Constants) -> list[str]:
    """Names that ``auto`` compares for these constants: certified, trajectory level, hypotheses fulfilled."""
    time = "continuous" if constants.continuous else "discrete"
    slope = constants.rate if constants.rate is not None else constants.gain
    contracting = bool(np.all(np.asarray(slope) < (0 if constants.continuous else 1)))
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


def _family_tube(
    constants: Constants,
    schedule: Schedule,
    delta: float,
    goal: Objective,
    start: Start,
    *,
    bessel: bool,
    unless: float = math.inf,
) -> Tube | None:
    """Thm K1, or its Bessel form, with the best parameters found; None when a first look exceeds ``unless``."""
    if bessel and not schedule.any_power:
        # isotropic proxy: nu = n always holds
        schedule = replace_nu(schedule, float(constants.dimension))
    unit = schedule.unit
    idle = schedule.idle_time() if goal.kind == "final" else 0.0
    if idle > 0:
        schedule = schedule.idled(idle)
    cut = schedule if goal.clearance is None else schedule.refined(goal.clearance.ends(schedule))
    search = Search(
        schedule=cut.graded(6 if goal.kind != "mean" else 16), kind=goal.kind, weights=np.ones(1),
        log_delta=math.log(delta), bessel=bessel, start=start,
    )  # fmt: skip
    search = replace(search, weights=goal.weights(search.schedule))
    if np.max(schedule.sigmas) == 0:
        a, v0 = (1.0 if bessel else 0.0), 1.0
    else:
        if unless < math.inf and search.worse_than(1.3 * unless):
            return None
        a, v0 = search.solve()
    check_power(schedule, a, bessel=bessel)
    profile = KummerProfile(schedule=schedule, a=a, v0=v0, delta=delta, bessel=bessel, start=start)
    parameters = {"a": a, "v0": v0 * unit**2, **({"idle": idle} if idle > 0 else {})}
    return Tube(
        method="bessel" if bessel else "kummer", parameters=parameters, level="trajectory",
        certified=True, delta=delta, horizon=schedule.horizon, constants=constants, objective=goal.given,
        profile=profile,
    )  # fmt: skip


def replace_nu(schedule: Schedule, nu: float) -> Schedule:
    """The same data with another effective dimension, for which every Kummer parameter is valid."""
    return replace(schedule, nu=nu, any_power=True)


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
    schedule = make_schedule(constants, horizon)
    held = read_clearance(clearance, schedule.horizon, continuous=schedule.continuous)
    start = start or Start()
    check_start(schedule, start, constants.dimension)
    if np.max(schedule.sigmas) == 0 and start == Start():
        return -1e12
    cut = schedule.refined(held.ends(schedule))
    best = 0.0
    forms: list[tuple[Schedule, bool]] = [(cut, False)]
    scaled = cut if cut.any_power else replace_nu(cut, float(constants.dimension))
    if np.max(cut.rates) >= 0:
        forms.append((scaled, True))
    for data, bessel in forms:
        graded = data.graded(4)
        search = Search(
            schedule=graded, kind="probability", weights=Objective(None, "scale", held).weights(graded), bessel=bessel,
            start=start,
        )  # fmt: skip
        # far out the parameters hardly change, but the sums grow: they are sought nearer
        farthest = float(np.max(np.sqrt(graded.nodes[1]) * (schedule.unit / search.weights)))
        if 0 < farthest < _FAR:
            search = replace(search, weights=search.weights * (farthest / _FAR))
        a, v0 = search.solve()
        best = min(best, exit_level(data, held, a=a, v0=v0, bessel=bessel, start=start))
        if not bessel:
            pair = (a, v0, False)
    if start == Start() and not scaled.continuous and union_may_help(scaled, held, best):
        best = min(best, union_level(scaled, held))
    if thorough and start == Start():
        best = min(best, _thorough_level(constants, cut, held, pair, best))
    return max(best, -1e12)


def _thorough_level(
    constants: Constants, schedule: Schedule, held: Clearance, pair: tuple[float, float, bool], best: float
) -> float:
    """log10 of the probability by the slow methods that apply."""
    levels = [0.0]
    try:
        levels.append(mixture_level(schedule, held, best=[pair]))
    except SolverError as error:
        _log.debug("mixture is left out: %s", error)
    laws = [bound_exact_exit] * constants.isotropic + [bound_worst_exit] * constants.continuous
    if np.all(held.values == held.values[0]) and best > -9:
        for law in laws:
            target = min(0.5, 10.0 ** min(best, *levels))
            try:
                value = law(constants, horizon=schedule.horizon, radius=float(held.values[0]), target=target)
            except InfeasibleError as error:
                _log.debug("%s is left out: %s", law.__name__, error)
                continue
            levels.append(log10_upper(value) if value > 0 else 0.0)
    return min(levels)
