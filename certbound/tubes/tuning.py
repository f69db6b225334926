"""The two questions of this room: the best tube for a level, and the level of a given clearance."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from certbound.errors import InfeasibleError
from certbound.tubes.baselines import BASELINES, baseline_tube
from certbound.tubes.constants import Constants
from certbound.tubes.exit import exit_level
from certbound.tubes.kummer import KummerProfile, Start, check_delta, check_power, check_start
from certbound.tubes.objective import Objective, make_objective, read_clearance
from certbound.tubes.schedule import Schedule, make_schedule
from certbound.tubes.search import Search
from certbound.tubes.tube import Tube, supremum

__all__ = ["METHODS", "applicable_methods", "bound_exit_probability", "tube_objective", "tune_tube"]

METHODS = ("auto", "kummer", "bessel", "mixture", "exact", *BASELINES)
"""Every name that ``method`` takes."""

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
        The paper's free parameters; optimised when omitted.
    thorough : bool
        Let ``"auto"`` try the slow methods as well (mixture, exact).
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
    (True, 1.3398)
    """
    delta = check_delta(delta)
    if method not in METHODS:
        raise ValueError(f"`method` must be one of {', '.join(METHODS)}, got {method!r}.")
    schedule = make_schedule(constants, horizon)
    goal = make_objective(objective, schedule.horizon)
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
        if name in ("kummer", "bessel"):
            bessel = name == "bessel"
            tube = _family_tube(constants, schedule, delta, goal, start, bessel=bessel, unless=value)
        elif name in ("mixture", "exact"):
            raise InfeasibleError(f"`method` {name!r} is not available for these constants; use 'auto'.")
        elif moving:
            continue
        else:
            tube = baseline_tube(
                constants, name, horizon=schedule.horizon, delta=delta, objective=goal, epsilon=epsilon, step=step,
                unless=value,
            )  # fmt: skip
        if tube is None:
            continue
        other = tube_objective(tube, goal) if method == "auto" else value
        if best is None or other < value:
            best, value = tube, other
    if best is None:
        raise InfeasibleError(f"no tube of `method` {method!r} was found; try 'kummer'.")
    return best


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
    cut = schedule if goal.clearance is None else schedule.refined(goal.clearance.ends(schedule))
    search = Search(
        schedule=cut.graded(6 if goal.kind != "mean" else 16), kind=goal.kind, weights=np.ones(1),
        log_delta=math.log(delta), bessel=bessel, start=start,
    )  # fmt: skip
    search = replace(search, weights=goal.weights(search.schedule))
    if np.max(schedule.sigmas) == 0:
        a, v0 = (1.0 if bessel else 0.0), 1.0
    else:
        if search.first_look() > 1.3 * unless:
            return None
        a, v0, _ = search.solve()
    check_power(schedule, a, bessel=bessel)
    profile = KummerProfile(schedule=schedule, a=a, v0=v0, delta=delta, bessel=bessel, start=start)
    return Tube(
        method="bessel" if bessel else "kummer", parameters={"a": a, "v0": v0 * unit**2}, level="trajectory",
        certified=True, delta=delta, horizon=schedule.horizon, constants=constants, objective=goal.given,
        profile=profile,
    )  # fmt: skip


def replace_nu(schedule: Schedule, nu: float) -> Schedule:
    """The same data with another effective dimension, for which every Kummer parameter is valid."""
    return replace(schedule, nu=nu, any_power=True)


def bound_exit_probability(
    constants: Constants, *, horizon: float, clearance: Any, start: Start | None = None
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
    held = read_clearance(clearance, schedule.horizon)
    start = start or Start()
    check_start(schedule, start, constants.dimension)
    if np.max(schedule.sigmas) == 0 and start == Start():
        return -1e12
    cut = schedule.refined(held.ends(schedule))
    best = 0.0
    forms: list[tuple[Schedule, bool]] = [(cut, False)]
    if np.max(cut.rates) >= 0:
        forms.append((cut if cut.any_power else replace_nu(cut, float(constants.dimension)), True))
    for data, bessel in forms:
        graded = data.graded(6)
        search = Search(
            schedule=graded, kind="probability", weights=Objective(None, "scale", held).weights(graded), bessel=bessel,
            start=start,
        )  # fmt: skip
        a, v0, _ = search.solve()
        best = min(best, exit_level(data, held, a=a, v0=v0, bessel=bessel, start=start))
    return max(best, -1e12)
