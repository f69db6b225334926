"""Which metric to use: proposals by semidefinite programs, each certified before it is returned.

``propose_metrics`` proposes, ``improve`` certifies the proposals of one model and keeps the best, ``bound_metrics``
gives each constraint a metric of its own and ``split_delta`` shares delta between them (Sec. 6 of docs/theory.md,
"one metric per constraint").
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.constants.certification import certify
from certbound.constants.jacobians import AffineSet, JacobianSet, as_set
from certbound.constants.least_eroding import (
    Tightening,
    candidate_sets,
    certified,
    erosion_ratio,
    is_gaussian,
    model_set,
    noise_matrices,
    tried,
)
from certbound.constants.model_data import Model, model_of
from certbound.constants.programs import (
    ErosionSearch,
    RadiusModel,
    Rooms,
    constraint_targets,
    cut_rooms,
    rate_proposals,
    rooms_of,
    stated_rooms,
)
from certbound.parallel import alone, crew, result_of
from certbound.problem.problem import Problem
from certbound.problem.sets import Box
from certbound.problem.systems import System
from certbound.tubes.constants import Constants
from certbound.watch import poll

_GAIN = 1e-3
"""Smallest decrease of c or L for which another metric than the identity is worth its name."""


def propose_metrics(
    source: Any,
    *,
    objective: str = "rate",
    horizon: float | None = None,
    delta: float | None = None,
    directions: Sequence[ArrayLike] | None = None,
    clearances: ArrayLike | None = None,
    noise: Sequence[ArrayLike] | None = None,
    continuous: bool | None = None,
    gaussian: bool = False,
    domain: Any = None,
) -> list[Array]:
    """Metrics worth certifying, the most promising first. Nothing about them is proved.

    Parameters
    ----------
    source : Problem, ContinuousSystem, DiscreteSystem or python-control system; or a Jacobian set
        A set (or vertices) needs ``continuous`` and, for erosion, ``noise``.
    objective : "rate" or "erosion"
        Small c or L; or small erosion along ``directions`` relative to ``clearances``.
    horizon, delta : float, optional
        For erosion; a problem's own when omitted.
    directions : sequence of array_like, each (n,) or (n, r), optional
        For erosion; a problem's constraints when omitted.
    clearances : array_like, shape (len(directions),), optional
        Room along each direction; ones when omitted.
    noise : sequence of array_like, each (n, m), optional
        Noise matrices at unit proxy; the system's own when omitted.
    continuous, gaussian : bool
        For a bare set: continuous time; Gaussian noise in discrete time.
    domain : Box, optional
        As for ``bound_constants``.

    Returns
    -------
    list of ndarray, each (n, n)
        Smallest eigenvalue 1: ||x||_2 <= ||x||_P.

    Raises
    ------
    ValueError
        For an unknown objective, or erosion without horizon, delta, directions or noise.
    EnclosureError
        If the Jacobian is unbounded or undefined on the domain.
    SolverError
        If no program could be solved.

    Source: Sec. 6 and 7.17 of docs/theory.md.
    """
    check_objective(objective)
    if isinstance(source, JacobianSet | np.ndarray | list | tuple):
        if continuous is None:
            raise ValueError("`continuous` must be given with a Jacobian set: True for a rate, False for a gain.")
        members, matrices = as_set(source), [np.asarray(G, dtype=float) for G in noise or []]
        targets = None
    else:
        model = model_of(source, domain, horizon)
        members, matrices = model_set(model), noise_matrices(model)
        continuous, gaussian = model.continuous, is_gaussian(model)
        horizon, delta = _horizon(model, horizon), delta if delta is not None else _delta(model)
        targets = None if objective == "rate" or directions is not None else _targets(model, horizon)
    if objective == "rate":
        return [p.metric for p in rate_proposals(members, continuous=continuous)]
    horizon, delta = _required(horizon, delta)
    if targets is None:
        targets = stated_rooms(directions, clearances, members.dimension, horizon)
    if not matrices:
        raise ValueError('`objective="erosion"` needs `noise`: the noise matrices at unit proxy.')
    radius = RadiusModel(
        continuous=continuous, dimension=members.dimension, horizon=horizon, delta=delta, gaussian=gaussian
    )
    return [p.metric for p in ErosionSearch(members, matrices, radius).proposals(targets)]


def improve(
    model: Model, euclidean: Constants, *, objective: str, horizon: float | None = None, delta: float | None = None
) -> Constants:
    """The best certified constants of a model: in the identity metric (``euclidean``), or in one that was proposed.

    ``horizon`` and ``delta`` are for the objective "erosion", the problem's own when omitted: without them, or without
    constraints, that is a ValueError.
    """
    check_objective(objective)
    if objective == "erosion":
        horizon, delta = _required(_horizon(model, horizon), _delta(model) if delta is None else delta)
        return Tightening(model, euclidean, horizon=horizon, delta=delta).best(_targets(model, horizon))
    if model.dimension == 1:
        return euclidean
    found, wanted = [euclidean], euclidean.worst_slope - _GAIN * max(1e-3, abs(euclidean.worst_slope))
    for members in candidate_sets(model):
        for proposal in tried(partial(rate_proposals, members, continuous=model.continuous, wanted=wanted)):
            found += certified(model, proposal)
    best = min(found, key=lambda constants: constants.worst_slope)
    return best if best.worst_slope < wanted else euclidean


@alone()
def bound_metrics(
    problem: Problem, *, horizon: float | None = None, delta: float | None = None, domain: Any = None, jobs: int = 1
) -> tuple[Constants, ...]:
    """Certified constants in a metric of its own for each constraint of a problem.

    Used together, each tube serves its constraint alone and delta is shared by the union bound: `split_delta`.

    Parameters
    ----------
    problem : Problem
    horizon, delta : float, optional
        The problem's own when omitted; the metrics are tuned for equal shares of delta.
    domain : Box, optional
        As for ``bound_constants``.
    jobs : int
        Processes that work side by side.

    Returns
    -------
    tuple of Constants
        In the order of ``problem.constraints``.

    Raises
    ------
    TypeError
        If ``problem`` is no Problem.
    InfeasibleError, EnclosureError, ValueError
        As ``bound_constants``.

    Source: "one metric per constraint", Sec. 4 and 6 of docs/theory.md.
    """
    found = dict(each_metric(problem, horizon=horizon, delta=delta, domain=domain, jobs=jobs))
    return tuple(found[index] for index in range(len(problem.constraints)))


def each_metric(
    problem: Problem,
    *,
    only: Sequence[int] | None = None,
    horizon: float | None = None,
    delta: float | None = None,
    domain: Any = None,
    jobs: int = 1,
) -> Iterator[tuple[int, Constants]]:
    """The same one by one as they are found, each with its place among ``problem.constraints``.

    Those come first whose constraints lose most of their room in the metric that the search starts from; ``only`` are
    the places that are asked for (all when omitted). Parameters and errors are those of `bound_metrics`.
    """
    if not isinstance(problem, Problem):
        raise TypeError(f"`problem` must be a Problem, got {type(problem).__name__}.")
    model = model_of(problem, domain, horizon)
    euclidean = certify(model, None, tolerance=5e-3, budget=60_000)
    span = float(problem.horizon) if horizon is None else float(horizon)
    times, targets = constraint_targets(problem)
    share = (problem.delta if delta is None else delta) / len(problem.constraints)
    work = Tightening(model, euclidean, horizon=span, delta=share)
    rooms: dict[int, Rooms] = {}
    for index in range(len(problem.constraints)) if only is None else only:
        own = [target for target in targets if target.constraint == index]
        if own:
            rooms[index] = cut_rooms(rooms_of(times, own), span)
        else:
            yield index, euclidean
    order = sorted(rooms, key=lambda index: -work.promise(rooms[index]))
    if jobs < 2 or len(order) < 2:
        for place, index in enumerate(order):
            poll(f"a metric for constraint {place + 1} of {len(order)}")
            yield index, work.best(rooms[index])
        return
    first, rest = order[0], order[1:]
    yield first, work.best(rooms[first])  # what the others share is found on the way
    with crew(jobs) as workers:
        yield from _side_by_side(workers, {index: partial(work.best, rooms[index]) for index in rest})


def _side_by_side(workers: Any, tasks: dict[int, Any]) -> Iterator[tuple[int, Constants]]:
    waiting, count = list(tasks), 0
    while count < len(tasks):
        while waiting and len(tasks) - len(waiting) - count < workers.width:
            index = waiting.pop(0)
            workers.begin(index, tasks[index])
        for index, answer in workers.finished():
            count += 1
            yield index, result_of(answer)
        poll(f"a metric for constraint {count + 2} of {len(tasks) + 1}")


def split_delta(
    problem: Problem, constants: Sequence[Constants], *, horizon: float | None = None, delta: float | None = None
) -> Array:
    """Shares of delta, one per constraint, that make the largest erosion over room as small as possible.

    The erosion of a constraint is a decreasing function of log delta_j and the constraint on the shares is convex
    in it, so that the optimum equalises the ratios where it can: one scalar bisection.

    Parameters
    ----------
    problem : Problem
    constants : sequence of Constants
        One per constraint, as `bound_metrics` returns them.
    horizon, delta : float, optional
        The problem's own when omitted.

    Returns
    -------
    ndarray, shape (len(problem.constraints),)
        Positive, with sum at most delta.

    Raises
    ------
    ValueError
        If the number of constants is wrong.
    """
    if len(constants) != len(problem.constraints):
        raise ValueError(f"`constants` must hold {len(problem.constraints)} records, got {len(constants)}.")
    span = float(problem.horizon) if horizon is None else float(horizon)
    total = float(problem.delta if delta is None else delta)
    times, targets = constraint_targets(problem)
    grid = np.log(total) + np.linspace(np.log(1e-3 / len(constants)), 0.0, 5)
    ratios = []
    for index, record in enumerate(constants):
        own = [target for target in targets if target.constraint == index]
        rooms = None if not own else cut_rooms(rooms_of(times, own), span)
        ratios.append(np.zeros(len(grid)) if rooms is None else _ratios(record, rooms, span, np.exp(grid)))
    low, high = 0.0, float(max(curve[0] for curve in ratios))

    def shares(level: float) -> Array:
        # the smallest share at which each ratio falls to the level
        return np.array([np.exp(np.interp(-level, -curve, grid)) for curve in ratios])

    for _ in range(60):
        middle = (low + high) / 2
        low, high = (low, middle) if shares(middle).sum() <= total else (middle, high)
    found = shares(high)
    return np.asarray(found * (total * (1 - 1e-12) / found.sum()))


def check_objective(objective: str) -> None:
    """Refuse an objective that is neither "rate" nor "erosion"."""
    if objective not in ("rate", "erosion"):
        raise ValueError(f'`objective` must be "rate" or "erosion", got {objective!r}.')


def jacobian_set(source: Problem | System, domain: Box | None = None, *, tolerance: float = 1e-3) -> AffineSet:
    """The Jacobian D_x f of a model over a domain, as an affine set.

    Proves: D_x f(t, x, u, d) lies in the set for every time, state of the domain, input and disturbance.

    Parameters
    ----------
    source : Problem, ContinuousSystem or DiscreteSystem
        A problem's closed loop, or a system over all inputs that it allows.
    domain : Box, optional
        States; the problem's domain, or all of R^n, when omitted.
    tolerance : float
        Wanted distance between a range and its sampled part, relative to the range's size.

    Raises
    ------
    EnclosureError
        If the Jacobian is unbounded, undefined or jumping on the domain.
    """
    return model_set(model_of(source, domain, None), tolerance=tolerance)


def _horizon(model: Model, horizon: float | None) -> float | None:
    return float(model.problem.horizon) if horizon is None and model.problem is not None else horizon


def _delta(model: Model) -> float | None:
    return None if model.problem is None else float(model.problem.delta)


def _required(horizon: float | None, delta: float | None) -> tuple[float, float]:
    if horizon is None or delta is None:
        name = "horizon" if horizon is None else "delta"
        raise ValueError(f'`objective="erosion"` needs `{name}=`; give it, or pass a Problem.')
    if not 0 < delta < 1:
        raise ValueError(f"`delta` must lie in (0, 1), got {delta}.")
    if not 0 < horizon < np.inf:
        raise ValueError(f"`horizon` must be positive and finite, got {horizon}.")
    return horizon, delta


def _targets(model: Model, horizon: float | None) -> Rooms:
    if model.problem is None:
        raise ValueError('`objective="erosion"` needs a Problem, whose constraints say along what to erode.')
    return cut_rooms(rooms_of(*constraint_targets(model.problem)), _required(horizon, 0.5)[0])


def _ratios(constants: Constants, rooms: Rooms, horizon: float, deltas: Array) -> Array:
    """Erosion over room at several levels, made non-increasing."""
    values = [erosion_ratio(constants, rooms, horizon, float(delta)) for delta in deltas]
    return np.minimum.accumulate(np.array(values))
