"""Certified constants of a model: c or L in a norm, sigma, nu, found by branch and bound and never by trust.

c bounds the matrix measure mu_P(D_x f) (CT), L the norm ||D_x f||_P (DT), over every state of the domain,
every input, disturbance and time; sigma and nu bound the noise in the same norm (Assumptions 1-3 of the
paper).
"""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from certbound.constants.branching import Supremum, bound_supremum, random_points, split_boxes
from certbound.constants.coordinates import Metric
from certbound.constants.derivatives import StateJacobian
from certbound.constants.models import Model, model_of
from certbound.constants.noises import NoiseBound, bound_noise
from certbound.constants.recheck import certify_gain, certify_rate
from certbound.constants.structure import affine_set
from certbound.errors import EnclosureError, InfeasibleError
from certbound.rigor.intervals import Interval
from certbound.tubes.constants import Constants, Proof

__all__ = ["bound_constants", "constants_along"]

Array = NDArray[np.float64]

FIRST_BUDGET = 4000
"""Boxes before the affine structure of the Jacobian is looked for."""
MOST_SIDES = 8
"""Coordinates above which bisection is left out where the affine structure gives a bound."""
EXACT = 1e-9
"""A relative gap that leaves nothing to gain."""

SMALLEST_GAIN = 1e-12
"""Stands for L = 0, which the tubes exclude."""


def bound_constants(
    source: Any,
    domain: Any = None,
    *,
    metric: str | ArrayLike = "auto",
    objective: str = "rate",
    horizon: float | None = None,
    delta: float | None = None,
    tolerance: float = 5e-3,
    budget: int = 60_000,
) -> Constants:
    """Certified constants of a system or a problem.

    Proves: D_x f^T P + P D_x f <= 2 c P (CT) or D_x f^T P D_x f <= L^2 P (DT), and P^{1/2} g g^T P^{1/2} <=
    sigma^2 I, tr(P g g^T) <= nu sigma^2, for all states in the domain and all times, inputs, disturbances.

    Parameters
    ----------
    source : ContinuousSystem, DiscreteSystem, Problem, or python-control system
        A problem's plan is substituted for the inputs. Inputs without a plan range over their box, and do not
        matter where they enter affinely.
    domain : Box, optional
        States over which the constants hold; the problem's domain, or all of R^n, when omitted.
    metric : "auto", "euclidean" or array_like of shape (n, n)
        P; "auto" also tries the metrics that semidefinite programs propose, and keeps the best.
    objective : "rate" or "erosion"
        What "auto" makes small: c or L, or the erosion that the tube will cause (needs horizon and delta).
    horizon, delta : float, optional
        Those of the problem when omitted; times range over [0, horizon], or over [0, inf) without one.
    tolerance : float
        Aim for the gap, certified minus sampled, relative to max(1, largest ||D_x f||).
    budget : int
        Boxes to spend.

    Returns
    -------
    Constants
        Certified; ``rate`` in 1/s or ``gain`` per step.

    Raises
    ------
    InfeasibleError
        No domain was given, and the Jacobian is unbounded on R^n: the entry is named.
    EnclosureError
        The Jacobian is undefined or jumps on the domain: the expression and the box are named.
    ValueError
        The Jacobian is unbounded on the given domain, or an argument is malformed.

    Examples
    --------
    >>> from certbound.problem.systems import ContinuousSystem
    >>> k = bound_constants(ContinuousSystem(lambda x: -x + 0.5 * np.tanh(x), states=1, diffusion=0.1))
    >>> round(k.rate, 3), k.sigma, k.isotropic, k.certified
    (-0.5, 0.1, True, True)
    """
    model = model_of(source, domain, horizon)
    if objective not in ("rate", "erosion"):
        raise ValueError(f'`objective` must be "rate" or "erosion", got {objective!r}.')
    if not isinstance(metric, str):
        return certify(model, metric, tolerance=tolerance, budget=budget)
    if metric not in ("auto", "euclidean"):
        raise ValueError(f'`metric` must be "auto", "euclidean" or a matrix, got {metric!r}.')
    if metric == "euclidean":
        return certify(model, None, tolerance=tolerance, budget=budget)
    return _propose(model, objective, horizon, delta, tolerance, budget)


def _propose(
    model: Model,
    objective: str,
    horizon: float | None,
    delta: float | None,
    tolerance: float,
    budget: int,
) -> Constants:
    """The identity metric, so that a valid bound exists, and whatever the semidefinite programs propose."""
    from certbound.constants import metrics  # which certifies its proposals here

    euclidean = certify(model, None, tolerance=tolerance, budget=budget)
    return metrics.improve(model, euclidean, objective=objective, horizon=horizon, delta=delta)


def certify(
    model: Model, metric: ArrayLike | None, *, status: str = "closed form", tolerance: float, budget: int
) -> Constants:
    """Constants in a given metric, certified by branch and bound whatever proposed the metric."""
    norm = Metric(metric, model.dimension)
    jacobian = StateJacobian(model.dynamics, model.state_slots, model.ranges)
    found = _supremum(model, jacobian, norm, tolerance, budget)
    if not np.isfinite(found.upper):
        _refuse(model, jacobian, found)
    noise, status = bound_noise(model, norm), jacobian.remark(status)
    return _record(model, norm, noise, np.array(found.upper), found.sampled, found.boxes, status, None)


def _supremum(model: Model, jacobian: StateJacobian, norm: Metric, tolerance: float, budget: int) -> Supremum:
    quantity = norm.measure if model.continuous else norm.norm
    sampled = norm.sample_measure if model.continuous else norm.sample_norm

    def bound(boxes: Interval, threshold: float) -> tuple[Array, Array]:
        uppers = quantity(jacobian.enclose(boxes))
        weights = _relative_widths(boxes, jacobian.box)
        bounded = np.isfinite(boxes.lo).all(axis=1) & np.isfinite(boxes.hi).all(axis=1)
        sharpen = np.flatnonzero(bounded & (uppers > threshold))
        form = jacobian.spread(boxes[sharpen]) if len(sharpen) else None
        if form is not None:
            uppers[sharpen] = np.minimum(uppers[sharpen], quantity(*form))
            weights[sharpen] = _slope_weights(norm, form[1], weights[sharpen])
        return uppers, weights

    def value(points: Array) -> Array:
        matrices = jacobian.values(points)
        defined = np.isfinite(matrices).all(axis=(-1, -2))
        result = np.full(len(points), np.nan)
        if defined.any():
            result[defined] = sampled(matrices[defined])
        return result

    limit = tolerance * _scale(jacobian, norm)
    starts = jacobian.starts()
    search = functools.partial(bound_supremum, bound, value, jacobian.box, tolerance=limit, starts=starts)
    unbounded = not (np.isfinite(jacobian.box.lo) & np.isfinite(jacobian.box.hi)).all()
    many = len(jacobian.active) > 3
    budget = max(1, int(budget * min(1.0, (6 / model.dimension) ** 2)))  # a box costs the more, the larger n
    if unbounded:
        ceiling = _structural_bound(model, jacobian, norm)
        hopeless = len(jacobian.active) > MOST_SIDES and np.isfinite(ceiling)
        return search(budget=1 if hopeless else budget, ceiling=ceiling)
    found = search(budget=min(budget, FIRST_BUDGET))
    if not np.isfinite(found.sampled):
        return found
    close = found.upper - found.sampled <= limit
    if close and found.upper - found.sampled <= EXACT * abs(found.upper):
        return found
    ceiling = _structural_bound(model, jacobian, norm) if close or many else np.inf
    if close:  # where the parameters vary independently, the affine set leaves no gap at all
        return search(budget=1, ceiling=ceiling) if ceiling < found.upper else found
    if np.isinf(found.upper) and np.isinf(ceiling):
        return found
    return search(budget=budget, ceiling=ceiling, earlier=found)


def _structural_bound(model: Model, jacobian: StateJacobian, norm: Metric) -> float:
    """Bound over the affine set of all Jacobians: exact where its parameters vary independently."""
    try:
        members = affine_set(jacobian.tape, [jacobian.ranges[k] for k in range(len(jacobian.ranges))])
        matrix = np.eye(model.dimension) if norm.matrix is None else norm.matrix
        certified = certify_rate if model.continuous else certify_gain
        return certified(matrix, members)
    except EnclosureError:
        return np.inf


def _relative_widths(boxes: Interval, box: Interval) -> Array:
    with np.errstate(all="ignore"):
        share = (boxes.hi - boxes.lo) / np.maximum(box.hi - box.lo, 1e-300)
    return np.where(np.isfinite(share), share, np.where(np.isinf(boxes.hi - boxes.lo), 2.0, 1e-3))


def _slope_weights(norm: Metric, spread: Any, fallback: Array) -> Array:
    size = spread.slopes.mag
    finite = np.isfinite(size).all(axis=(-1, -2, -3)) & np.isfinite(spread.reach).all(axis=-1)
    safe = np.where(finite[:, None, None, None], size, 0.0)
    with np.errstate(all="ignore"):  # weights only order the halving: an overflow is as good as any
        seen = np.abs(norm.transform(safe))
        weights = np.where(finite[:, None], spread.reach, 0.0) * np.sqrt(np.sum(seen**2, axis=(-1, -2)))
    result: Array = np.where(finite[:, None], weights, fallback)
    return result


def _scale(jacobian: StateJacobian, norm: Metric) -> float:
    """max(1, largest sampled norm of the Jacobian)."""
    matrices = jacobian.values(random_points(np.random.default_rng(1), jacobian.box, 256))
    defined = np.isfinite(matrices).all(axis=(-1, -2))
    return max(1.0, float(np.max(norm.sample_norm(matrices[defined]), initial=0.0)))


def _refuse(model: Model, jacobian: StateJacobian, found: Supremum) -> None:
    cure = "give a smaller `domain=`" if model.bounded_by_user else "give `domain=cb.Box(low, high)`"
    try:
        reason = jacobian.explain(found.worst)
    except EnclosureError as error:
        if model.bounded_by_user:
            raise
        raise InfeasibleError(f"no constants hold on all of R^n: {error} Or {cure}.") from error
    if model.bounded_by_user:
        raise EnclosureError(f"`domain` must keep the Jacobian bounded, but {reason} is unbounded; {cure}.")
    raise InfeasibleError(f"no constants hold on all of R^n: {reason} is unbounded; {cure}.")


def _record(
    model: Model,
    norm: Metric,
    noise: NoiseBound,
    value: Array,
    sampled: float,
    boxes: int,
    status: str,
    times: Array | None,
    where: str | None = None,
) -> Constants:
    """The only place where a proof is attached to constants."""
    number: Any = float(value) if value.ndim == 0 else value
    gain: Any = None if model.continuous else np.maximum(number, SMALLEST_GAIN)
    found = Constants(
        rate=number if model.continuous else None,
        gain=gain,
        sigma=noise.sigma,
        dimension=model.dimension,
        effective_dimension=noise.effective_dimension,
        metric=norm.matrix,
        isotropic=noise.isotropic,
        gaussian=noise.gaussian,
        times=times,
    )
    proof = Proof(
        sampled=sampled, boxes=boxes, status=status, domain=where or model.domain_text, fingerprint=found.fingerprint
    )
    return replace(found, proof=proof)


def constants_along(
    source: Any,
    times: ArrayLike,
    boxes: Interval,
    *,
    metric: ArrayLike | None = None,
    refine: int = 1,
) -> Constants:
    """Constants per time piece over given boxes (reach set plus tube), for Thm K4.

    Proves: as `bound_constants`, for t in [times[k], times[k+1]] and states in boxes[k].

    Parameters
    ----------
    source : system or Problem
    times : array_like, shape (K + 1,)
        Piece ends, rising from 0; in discrete time whole steps, each piece holding for its own step.
    boxes : Interval, shape (K, n)
        States on each piece.
    metric : array_like, shape (n, n), optional
        P; the identity when omitted.
    refine : int
        Sub-boxes that each box is cut into along its heaviest sides (1: none).

    Returns
    -------
    Constants
        ``rate`` or ``gain`` and ``sigma`` per piece, and one nu with tr(P g g^T) <= nu sigma_t^2 on each.

    Raises
    ------
    EnclosureError, ValueError
        The Jacobian is undefined, jumps or is unbounded on a piece.
    """
    model = model_of(source, None, float(np.asarray(times, dtype=float)[-1]))
    ends = np.asarray(times, dtype=float)
    if boxes.shape != (len(ends) - 1, model.dimension):
        raise ValueError(
            f"`boxes` must have one row of {model.dimension} intervals for each of {len(ends) - 1} pieces, "
            f"got shape {boxes.shape}."
        )
    norm = Metric(metric, model.dimension)
    jacobian = StateJacobian(model.dynamics, model.state_slots, model.ranges)
    pieces = model.along(ends, boxes)
    active = Interval(pieces.lo[:, list(jacobian.active)], pieces.hi[:, list(jacobian.active)])
    values, count = _piecewise(model, jacobian, norm, active, refine)
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        reason = jacobian.explain(active[int(bad[0])])
        raise EnclosureError(f"`boxes` must keep the Jacobian bounded; on piece {bad[0]}, {reason} is unbounded.")
    matrices = jacobian.values(active.mid)
    sampled = norm.sample_measure(matrices) if model.continuous else norm.sample_norm(matrices)
    noise = bound_noise(model, norm, pieces)
    largest = float(sampled[np.argmax(values)])
    where = f"the given boxes, one for each of {len(boxes)} time pieces up to {ends[-1]:g}"
    return _record(model, norm, noise, values, largest, count, jacobian.remark("given metric"), ends, where)


def _piecewise(model: Model, jacobian: StateJacobian, norm: Metric, boxes: Interval, refine: int) -> tuple[Array, int]:
    quantity = norm.measure if model.continuous else norm.norm
    owner = np.arange(len(boxes))
    parts = boxes
    while True:
        direct = quantity(jacobian.enclose(parts))
        form = jacobian.spread(parts)
        weights = _relative_widths(parts, jacobian.box)
        if form is not None:
            direct = np.minimum(direct, quantity(*form))
            weights = _slope_weights(norm, form[1], weights)
        if len(parts) * 2 > refine * len(boxes) or not jacobian.active:
            break
        parts = split_boxes(parts, weights)
        owner = np.concatenate([owner, owner])
    values = np.full(len(boxes), -np.inf)
    np.maximum.at(values, owner, direct)
    return values, len(parts)
