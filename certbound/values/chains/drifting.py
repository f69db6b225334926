"""Infinite horizons of one state in discrete time that drifts away from its only limit.

With y the distance from the limit, y+ = y + h(y) + w, h >= mu > 0 wherever y >= 0, and E exp(-theta w) <=
exp(theta^2 S/2), exp(-theta y) is a supermartingale for theta = 2 mu/S up to the first step beyond the limit, where it
is more than 1. Hence P(ever leaving) <= exp(-theta y), the inequality of Lundberg. It is sharp in the exponent only;
but beyond a distance M, which counts as a target, it says next to nothing is left:

    P(leaving before M) <= P(ever leaving) <= P(leaving before M, or never getting there) + exp(-theta M).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from flint import fmpq, fmpq_poly

from certbound.errors import InfeasibleError
from certbound.problem.problem import Problem
from certbound.problem.sets import HalfSpace, Reach
from certbound.problem.systems import DiscreteSystem
from certbound.values.discrete import FailureBounds, bound_long_run
from certbound.values.exact import interval_of, polynomial_of
from certbound.values.sets import as_stays

_ENOUGH = 8.0  # theta M - theta y of the starts
_SHARES = (1 - 1e-9, 0.9, 0.5)


@dataclass(frozen=True, kw_only=True, slots=True)
class Drifting:
    """P(ever leaving) <= exp(-rate y), y = x - limit, or limit - x where ``mirrored``."""

    rate: float
    limit: float
    mirrored: bool
    log: float  # of the bound from the worst start


def bound_by_drift(problem: Problem) -> Drifting:
    """Lundberg's inequality.

    Raises
    ------
    InfeasibleError
        Unless there is one state, one limit, no target, a polynomial without time, inputs and disturbances that leads
        away from the limit everywhere, and noise of a fixed size.
    """
    system = problem.system
    if not isinstance(system, DiscreteSystem) or system.dimension != 1 or system.gain is not None:
        raise InfeasibleError("a drift bounds one state in discrete time with noise of a fixed size.")
    if problem.reach is not None or problem.ending or problem.initial.random or len(problem.starts) > 1:
        raise InfeasibleError("a drift bounds problems without a target, from a set of starts.")
    low, high = -math.inf, math.inf
    for constraint in as_stays(problem.kept):
        if constraint.outside or constraint.during not in (None, (0.0, float(problem.horizon))):
            raise InfeasibleError("a drift bounds limits that always hold.")
        first, last = interval_of(constraint.region)
        low, high = max(low, first), min(high, last)
    if math.isinf(low) == math.isinf(high):
        raise InfeasibleError("a drift bounds leaving by a limit on one side only.")
    mirrored = math.isinf(low)
    sign, limit = (-1, high) if mirrored else (1, low)
    model = None
    if system.disturbance is None and problem.input_sequence is None:
        model = polynomial_of(problem.closed_loop, sign)
    if model is None:
        raise InfeasibleError("a drift is found in polynomials without time, inputs and disturbances.")
    ahead = (model - fmpq_poly([0, 1]))(fmpq_poly([sign * fmpq(*limit.as_integer_ratio()), 1]))
    variance = float((system.noise_matrix @ system.noise.proxy @ system.noise_matrix.T)[0, 0]) * (1 + 1e-12)
    least = float(ahead[0])
    for share in _SHARES:
        rate = 2 * least * share / variance if variance > 0 else math.inf
        if not 0 < rate < math.inf:
            break
        room = ahead - fmpq(*(rate * variance / 2 * (1 + 1e-12)).as_integer_ratio())
        if all(coefficient >= 0 for coefficient in room.coeffs()):
            around = problem.initial.hull()
            nearest = float(limit - around.hi[0] if mirrored else around.lo[0] - limit)
            return Drifting(rate=rate, limit=limit, mirrored=mirrored, log=min(-rate * nearest * (1 - 1e-12), 0.0))
    raise InfeasibleError("no drift leads away from the limit wherever it is kept.")


def bound_drifting(problem: Problem, *, seconds: float, delta: float | None = None) -> tuple[FailureBounds, Drifting]:
    """Both bounds over an infinite horizon, by a target far away.

    Raises
    ------
    InfeasibleError
        As `bound_by_drift`.
    """
    drift = bound_by_drift(problem)
    around, sign = problem.initial.hull(), -1.0 if drift.mirrored else 1.0
    farthest = float(around.hi[0] if sign > 0 else -around.lo[0])
    place = farthest + _ENOUGH / drift.rate
    left = math.exp(-drift.rate * (place - sign * drift.limit)) * (1 + 1e-12)
    far = Reach(HalfSpace([-sign], -place))
    upper = math.exp(drift.log) * (1 + 1e-12)
    try:
        found = bound_long_run(problem.replace(reach=far), seconds=seconds, delta=delta)
    except InfeasibleError:
        found = None
    if found is None:
        return FailureBounds(upper=upper, lower=0.0, cells=(0,), share=0.0, seconds=0.0, tried=()), drift
    most = float(np.nextafter(found.upper + left, np.inf))
    return replace(found, upper=min(upper, most, 1.0), rate=None, before=None), drift
