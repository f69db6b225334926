"""Certified constants of a model: c or L in a norm, sigma, nu, found by branch and bound and never by trust.

c bounds the matrix measure mu_P(D_x f) (CT), L the norm ||D_x f||_P (DT), over every state of the domain,
every input, disturbance and time; sigma and nu bound the noise in the same norm (Assumptions 1-3 of the
paper).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.constants.certification import certify, record, relative_widths, slope_weights
from certbound.constants.enclosures import Metric, split_boxes
from certbound.constants.metrics import check_objective, improve
from certbound.constants.model_data import Model, model_of
from certbound.constants.noise_bounds import bound_noise
from certbound.constants.state_jacobian import StateJacobian
from certbound.errors import EnclosureError
from certbound.parallel import alone
from certbound.rigor.intervals import Interval
from certbound.tubes.constants import Constants


@alone()
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
    check_objective(objective)
    if not isinstance(metric, str):
        return certify(model, metric, tolerance=tolerance, budget=budget)
    if metric not in ("auto", "euclidean"):
        raise ValueError(f'`metric` must be "auto", "euclidean" or a matrix, got {metric!r}.')
    euclidean = certify(model, None, tolerance=tolerance, budget=budget)
    if metric == "euclidean":
        return euclidean
    return improve(model, euclidean, objective=objective, horizon=horizon, delta=delta)


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
    return record(model, norm, noise, values, largest, count, jacobian.remark("given metric"), ends, where)


def _piecewise(model: Model, jacobian: StateJacobian, norm: Metric, boxes: Interval, refine: int) -> tuple[Array, int]:
    quantity = norm.measure if model.continuous else norm.norm
    owner = np.arange(len(boxes))
    parts = boxes
    while True:
        direct = quantity(jacobian.enclose(parts))
        form = jacobian.spread(parts)
        weights = relative_widths(parts, jacobian.box)
        if form is not None:
            direct = np.minimum(direct, quantity(*form))
            weights = slope_weights(norm, form[1], weights)
        if len(parts) * 2 > refine * len(boxes) or not jacobian.active:
            break
        parts = split_boxes(parts, weights)
        owner = np.concatenate([owner, owner])
    values = np.full(len(boxes), -np.inf)
    np.maximum.at(values, owner, direct)
    return values, len(parts)
