"""Constants along a tube in the Euclidean norm or in a metric fitted to the tube, whichever spreads the noise less."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from certbound.constants.bounds import constants_along
from certbound.constants.model_data import model_of
from certbound.constants.programs import rate_proposals, sampled_polytope
from certbound.constants.state_jacobian import StateJacobian
from certbound.errors import SolverError
from certbound.rigor.intervals import Interval
from certbound.tubes.constants import Constants


def fitted_constants_along(source: Any, times: ArrayLike, boxes: Interval, *, refine: int = 16) -> Constants:
    """Constants per time piece in the better of two metrics: the identity, and one fitted to the boxes.

    Proves what `constants_along` proves, in the metric of the result. The fitted one nearly minimises the largest
    rate or gain over Jacobians at the middles of the boxes; it is kept where the mean square of the deviation
    (`noise_spread`) is smaller, and the metrics are scaled to ||x||_2 <= ||x||_P so that the two compare.

    Parameters
    ----------
    source : system or Problem
    times : array_like, shape (K + 1,)
    boxes : Interval, shape (K, n)
    refine : int
        As for `constants_along`.

    Returns
    -------
    Constants

    Raises
    ------
    EnclosureError, ValueError
        As `constants_along`; a fit that fails leaves the identity.

    Source: Thm K4 and Sec. 6 of docs/theory.md.
    """
    plain = constants_along(source, times, boxes, refine=refine)
    model = model_of(source, None, float(np.asarray(times, dtype=float)[-1]))
    if model.dimension == 1:
        return plain
    jacobian = StateJacobian(model.dynamics, model.state_slots, model.ranges)
    middles = model.along(np.asarray(times, dtype=float), boxes).mid[:, list(jacobian.active)]
    matrices = jacobian.values(middles)
    matrices = matrices[np.isfinite(matrices).all(axis=(1, 2))]
    if not len(matrices):
        return plain
    try:
        proposals = rate_proposals(sampled_polytope(matrices), continuous=model.continuous)
    except SolverError:
        return plain
    found = [constants_along(source, times, boxes, metric=one.metric, refine=refine) for one in proposals]
    return min([plain, *found], key=noise_spread)


def noise_spread(constants: Constants) -> float:
    """log of the largest mean square of ||X - x||_P that the constants allow over their pieces, in floating point.

    It solves v' = 2 c v + nu sigma^2 (CT) or v+ = L^2 v + nu sigma^2 (DT) from v = 0; -inf without noise.
    """
    if constants.times is None:
        raise ValueError("`constants` must have time pieces, got constants that hold at all times.")
    spans = np.diff(np.asarray(constants.times, dtype=float))
    rates = np.asarray(constants.slope, dtype=float)
    values = np.broadcast_to(rates, spans.shape)
    power = np.broadcast_to(constants.nu * np.asarray(constants.sigma, dtype=float) ** 2, spans.shape)
    level, largest = -np.inf, -np.inf  # logarithms: an expanding rate over a long tube overflows
    with np.errstate(divide="ignore"):
        added = np.log(power)
    for value, span, share in zip(values, spans, added):
        if constants.continuous:
            growth = 2 * float(value) * float(span)
            room = np.log(span) + (np.log(np.expm1(growth) / growth) if 0 < abs(growth) < 500 else max(growth, 0.0))
        else:
            growth, room = 2 * float(np.log(value)), 0.0
        level = float(np.logaddexp(level + growth, share + room))
        largest = max(largest, level)
    return largest
