"""The barrier proof as data: the polynomial, and its three levels with a little room for the checker's own bounds."""

from __future__ import annotations

import math

import numpy as np

from certbound.errors import CertificateError
from certbound.problem.problem import Problem
from certbound.safety.answers import EngineAnswer, Proof, exact
from certbound.safety.engines import Barrier

_SLACK = 0.01
_MORE = (1.0, 5.0, 25.0)
_LEAST = 1e-6
_LOG10 = math.log(10.0)


def barrier_proof(problem: Problem, answer: EngineAnswer, attempt: int = 0) -> Proof:
    """The proof's data, the claimed log10 of the probability, and no assumptions.

    CertificateError where no barrier was found, or it bounds nothing once its levels have been rounded for the checker.
    """
    barrier: Barrier | None = answer.details
    if barrier is None:
        raise CertificateError("no barrier was found.")
    horizon = float(problem.horizon)
    room = _room(barrier.log10_probability(horizon), problem.delta) * _MORE[min(attempt, len(_MORE) - 1)] / 3
    stated = Barrier(
        exponents=barrier.exponents, coefficients=barrier.coefficients, center=barrier.center, scale=barrier.scale,
        start=_above(barrier.start, room), boundary=-_above(-barrier.boundary, room),
        growth=0.0 if barrier.inflow > 0 else _above(max(barrier.growth, 0.0), room / horizon),
        inflow=barrier.inflow * math.exp(2 * room),
    )  # fmt: skip
    log10 = stated.log10_probability(horizon)
    log10 += 1e-12 * (1 + abs(log10))
    if not log10 < 0:
        raise CertificateError("the barrier bounds nothing once its levels have been rounded for the checker.")
    data = {
        "engine": "barrier",
        "center": exact(stated.center),
        "scale": exact(stated.scale),
        "exponents": stated.exponents.tolist(),
        "coefficients": exact(stated.coefficients),
        "growth": exact(stated.growth),
        "start": exact(stated.start),
        "boundary": exact(stated.boundary),
    }
    if stated.inflow > 0:
        data["inflow"] = exact(stated.inflow)
    return data, log10, []


def _room(log10: float, delta: float) -> float:
    """What may be given away of the exponent: little, and not what SAFE rests on."""
    room = _SLACK * (1 + 0.1 * abs(log10))
    left = math.log10(delta) - log10
    return max(min(room, left / 2) if left > 0 else room, _LEAST) * _LOG10


def _above(value: float, room: float) -> float:
    return float(np.nextafter(value + room, np.inf))
