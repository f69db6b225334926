"""Which metric to use: proposals by semidefinite programs, each certified before it is returned.

``propose_metrics`` proposes, ``improve`` certifies the proposals of one model and keeps the best, ``bound_metrics``
gives each constraint a metric of its own and ``split_delta`` shares delta between them (Sec. 6 of docs/theory.md,
"one metric per constraint").
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.constants.certification import certify
from certbound.constants.enclosures import random_points
from certbound.constants.jacobians import AffineSet, JacobianSet, affine_set, as_set
from certbound.constants.model_data import Model, model_of
from certbound.constants.programs import (
    Proposal,
    RadiusModel,
    Rooms,
    constraint_targets,
    cut_rooms,
    erosion_factors,
    erosion_proposals,
    rate_proposals,
    rooms_of,
    sampled_polytope,
    stated_rooms,
)
from certbound.constants.state_jacobian import StateJacobian
from certbound.errors import EnclosureError, InfeasibleError, SolverError
from certbound.problem.model import Tape, compile_numpy, jacobian
from certbound.problem.problem import Problem
from certbound.problem.sets import Box
from certbound.problem.systems import ContinuousSystem, DiscreteSystem, System
from certbound.tubes.constants import Constants

_GAIN = 1e-3
"""Smallest decrease of c or L for which another metric than the identity is worth its name."""

_SAMPLES = 2000


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
        members, matrices = model_set(model), _noise_matrices(model)
        continuous, gaussian = model.continuous, _gaussian(model)
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
    return [p.metric for p in erosion_proposals(members, targets, matrices, radius)]


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
        return _least_erosion(model, euclidean, _targets(model, horizon), horizon, delta)
    if model.dimension == 1:
        return euclidean
    found = [euclidean]
    for members in _candidate_sets(model):
        for proposal in _tried(members, lambda s: rate_proposals(s, continuous=model.continuous)):
            found += _certified(model, proposal)
    best, plain = min(found, key=lambda constants: constants.worst_slope), euclidean.worst_slope
    return best if best.worst_slope < plain - _GAIN * max(1e-3, abs(plain)) else euclidean


def bound_metrics(
    problem: Problem, *, horizon: float | None = None, delta: float | None = None, domain: Any = None
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
    if not isinstance(problem, Problem):
        raise TypeError(f"`problem` must be a Problem, got {type(problem).__name__}.")
    model = model_of(problem, domain, horizon)
    euclidean = certify(model, None, tolerance=5e-3, budget=60_000)
    span = float(problem.horizon) if horizon is None else float(horizon)
    times, targets = constraint_targets(problem)
    share = (problem.delta if delta is None else delta) / len(problem.constraints)
    results = []
    for index in range(len(problem.constraints)):
        own = [target for target in targets if target.constraint == index]
        if own:
            results.append(_least_erosion(model, euclidean, cut_rooms(rooms_of(times, own), span), span, share))
        else:
            results.append(euclidean)
    return tuple(results)


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


def model_set(model: Model, *, tolerance: float = 1e-3) -> AffineSet:
    """The affine set of all Jacobians of a model over its ranges."""
    tape = jacobian(model.dynamics, model.state_slots)
    return affine_set(tape, [model.ranges[slot] for slot in range(len(model.ranges))], tolerance=tolerance)


def erosion_ratio(constants: Constants, rooms: Rooms, horizon: float, delta: float) -> float:
    """Largest erosion over room of the best quick tube, in floating point."""
    from certbound.tubes.tuning import tune_tube

    if constants.continuous:
        rooms = rooms.coarse(12)
    room = (rooms.rooms / erosion_factors(constants.matrix, rooms.directions)[:, None]).min(axis=0)
    if constants.continuous:  # both ends of a piece count
        times = np.concatenate([[0.0], rooms.times[:-1], [horizon]])
        values = np.minimum(room, np.concatenate([room[:1], room[:-1]]))
    else:
        steps = np.arange(1, int(horizon) + 1)
        values = np.concatenate([[np.inf], room[np.searchsorted(rooms.times, steps)]])
        times = np.arange(int(horizon) + 2.0)
    tube = tune_tube(constants, horizon=horizon, delta=delta, objective=(times, values))
    asked = np.isfinite(room)  # elsewhere nothing is asked, and an endless radius is no erosion
    with np.errstate(over="ignore"):  # a ratio beyond all floats is endless
        ratios = np.asarray(tube.radius(rooms.times))[asked] / room[asked]
    return float(np.max(ratios, initial=0.0))


def _least_erosion(model: Model, euclidean: Constants, targets: Rooms, horizon: float, delta: float) -> Constants:
    """The certified constants whose tube erodes least, among the identity metric and the proposals."""
    radius = RadiusModel(
        continuous=model.continuous, dimension=model.dimension, horizon=horizon, delta=delta, gaussian=_gaussian(model)
    )
    found, matrices = [euclidean], _noise_matrices(model)
    if model.dimension > 1 and any(G.any() for G in matrices):
        for members in _candidate_sets(model):
            for proposal in _tried(members, lambda s: erosion_proposals(s, targets, matrices, radius)):
                found += _certified(model, proposal)
    if len(found) == 1:
        return euclidean
    return min(found, key=lambda constants: erosion_ratio(constants, targets, horizon, delta))


def _candidate_sets(model: Model) -> list[JacobianSet]:
    """Sets to propose for: all Jacobians, structured; and samples of them, where that set is loose or missing."""
    try:
        structured = model_set(model)
    except EnclosureError:
        structured = None
    given: list[JacobianSet] = [] if structured is None else [structured]
    slots = StateJacobian(model.dynamics, model.state_slots, model.ranges)
    bounded = bool(np.isfinite(slots.box.lo).all() and np.isfinite(slots.box.hi).all())
    if not bounded or not slots.active:
        return given
    matrices = slots.values(random_points(np.random.default_rng(0), slots.box, _SAMPLES))
    matrices = matrices[np.isfinite(matrices).all(axis=(1, 2))]
    if not len(matrices):
        return given
    sampled = sampled_polytope(matrices)
    if structured is None:
        return [sampled]
    directions = np.random.default_rng(1).normal(size=(16, model.dimension, model.dimension))
    widths = [members.support(directions) + members.support(-directions) for members in (structured, sampled)]
    loose = bool(np.any(widths[0] > 1.1 * widths[1] + 1e-12 * np.abs(structured.J0).max()))
    return [*given, sampled] if loose else given


def _tried(members: JacobianSet, propose: Callable[[JacobianSet], list[Proposal]]) -> list[Proposal]:
    """The proposals, or none where every solver stalls or overflows: the identity metric is there already."""
    try:
        return propose(members)
    except (SolverError, np.linalg.LinAlgError):
        return []


def _certified(model: Model, proposal: Proposal) -> list[Constants]:
    try:
        return [certify(model, proposal.metric, status=proposal.status, tolerance=2e-3, budget=60_000)]
    except (EnclosureError, InfeasibleError):
        return []


def _noise_matrices(model: Model) -> list[Array]:
    """Noise matrices at unit proxy: the constant one, or samples of a state-dependent diffusion."""
    system = model.system
    if isinstance(system, DiscreteSystem):
        values, vectors = np.linalg.eigh(np.asarray(system.noise.proxy, dtype=float))
        return [np.asarray(system.noise_matrix @ (vectors * np.sqrt(np.maximum(values, 0.0))))]
    assert isinstance(system, ContinuousSystem)
    if not isinstance(system.diffusion, Tape):
        return [np.asarray(system.diffusion, dtype=float)]
    points = random_points(np.random.default_rng(0), model.ranges[: model.dimension + 1], 16)
    with np.errstate(all="ignore"):
        values = np.broadcast_to(compile_numpy(system.diffusion)(*points.T), (16, *system.diffusion.shape))
    return [np.asarray(G) for G in values if np.all(np.isfinite(G))]


def _gaussian(model: Model) -> bool:
    return not isinstance(model.system, DiscreteSystem) or bool(model.system.noise.gaussian)


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
