"""Constants in a given metric, proved by branch and bound whatever proposed the metric."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.constants.enclosures import Metric, Supremum, bound_supremum, random_points
from certbound.constants.jacobians import affine_set
from certbound.constants.model_data import Model
from certbound.constants.network_slopes import bound_by_slopes
from certbound.constants.noise_bounds import NoiseBound, bound_noise
from certbound.constants.recheck import certify_gain, certify_rate
from certbound.constants.state_jacobian import StateJacobian
from certbound.errors import EnclosureError, InfeasibleError
from certbound.rigor.intervals import Interval
from certbound.tubes.constants import Constants, Proof

FIRST_BUDGET = 4000
"""Boxes before the affine structure of the Jacobian is looked for."""
MOST_SIDES = 8
"""Coordinates above which bisection is left out where the affine structure gives a bound."""
SMALL = 12
"""States up to which as many Jacobians are sampled as is usual."""
LARGE = 24
"""States above which no side is bisected where there are many and the affine structure gives a bound."""
EXACT = 1e-9
"""A relative gap that leaves nothing to gain."""

BY_SLOPES = "slopes of a network's activations"
"""How a bound is called that no certificate states: the checker proves Jacobians over boxes."""

SMALLEST_GAIN = 1e-12
"""Stands for L = 0, which the tubes exclude."""
_HUGE = 1e300  # entries of a sample from which on its measure would overflow


def certify(
    model: Model, metric: ArrayLike | None, *, status: str = "closed form", tolerance: float, budget: int
) -> Constants:
    """Constants in a given metric, certified by branch and bound whatever proposed the metric."""
    norm = Metric(metric, model.dimension)
    jacobian = StateJacobian(model.dynamics, model.state_slots, model.ranges)
    found = _supremum(model, jacobian, norm, tolerance, budget)
    upper = found.upper
    if upper - found.sampled > tolerance * max(1.0, abs(found.sampled)):  # intervals lose much to a network
        upper = min(upper, bound_by_slopes(model, norm.matrix))
        status = BY_SLOPES if upper < found.upper else status
    if not np.isfinite(upper):
        _refuse(model, jacobian, found)
    noise, status = bound_noise(model, norm), jacobian.remark(status)
    return record(model, norm, noise, np.array(upper), found.sampled, found.boxes, status, None)


def _supremum(model: Model, jacobian: StateJacobian, norm: Metric, tolerance: float, budget: int) -> Supremum:
    quantity = norm.measure if model.continuous else norm.norm
    sampled = norm.sample_measure if model.continuous else norm.sample_norm

    def bound(boxes: Interval, threshold: float) -> tuple[Array, Array]:
        uppers = quantity(jacobian.enclose(boxes))
        weights = relative_widths(boxes, jacobian.box)
        bounded = np.isfinite(boxes.lo).all(axis=1) & np.isfinite(boxes.hi).all(axis=1)
        sharpen = np.flatnonzero(bounded & (uppers > threshold))
        form = jacobian.spread(boxes[sharpen]) if len(sharpen) else None
        if form is not None:
            uppers[sharpen] = np.minimum(uppers[sharpen], quantity(*form))
            weights[sharpen] = slope_weights(norm, form[1], weights[sharpen])
        return uppers, weights

    def value(points: Array) -> Array:
        matrices = jacobian.values(points)
        defined = (np.abs(matrices) < _HUGE).all(axis=(-1, -2))
        result = np.full(len(points), np.nan)
        if defined.any():
            result[defined] = sampled(matrices[defined])
        return result

    limit = tolerance * _scale(jacobian, norm)
    starts = jacobian.starts()
    search = functools.partial(
        bound_supremum, bound, value, jacobian.box, tolerance=limit, starts=starts, share=_effort(model.dimension)
    )
    unbounded = not (np.isfinite(jacobian.box.lo) & np.isfinite(jacobian.box.hi)).all()
    many = len(jacobian.active) > 3
    budget = max(1, int(budget * min(1.0, (6 / model.dimension) ** 2)))  # a box costs the more, the larger n
    large = len(jacobian.active) > MOST_SIDES and model.dimension > LARGE
    if unbounded or large:
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


def relative_widths(boxes: Interval, box: Interval) -> Array:
    """Widths of the sides of boxes, as shares of the whole box's."""
    with np.errstate(all="ignore"):
        share = (boxes.hi - boxes.lo) / np.maximum(box.hi - box.lo, 1e-300)
    return np.where(np.isfinite(share), share, np.where(np.isinf(boxes.hi - boxes.lo), 2.0, 1e-3))


def slope_weights(norm: Metric, spread: Any, fallback: Array) -> Array:
    """How much each side of a box adds to the spread of the Jacobian: the heaviest is halved first."""
    size = spread.slopes.mag
    finite = np.isfinite(size).all(axis=(-1, -2, -3)) & np.isfinite(spread.reach).all(axis=-1)
    safe = np.where(finite[:, None, None, None], size, 0.0)
    with np.errstate(all="ignore"):  # weights only order the halving: an overflow is as good as any
        seen = np.abs(norm.transform(safe))
        weights = np.where(finite[:, None], spread.reach, 0.0) * np.sqrt(np.sum(seen**2, axis=(-1, -2)))
    return np.where(finite[:, None], weights, fallback)


def _effort(dimension: int) -> float:
    """Share of the usual samples: a singular value decomposition costs n^3."""
    return min(1.0, (SMALL / dimension) ** 3)


def _scale(jacobian: StateJacobian, norm: Metric) -> float:
    """max(1, largest sampled norm of the Jacobian)."""
    count = max(8, int(256 * _effort(jacobian.dimension)))
    matrices = jacobian.values(random_points(np.random.default_rng(1), jacobian.box, count))
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


def record(
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
