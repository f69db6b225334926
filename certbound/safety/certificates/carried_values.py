"""Proofs by the backward equation as data: one function a side, rounded to what its bound allows (Thm K10)."""

from __future__ import annotations

import base64
import math
import zlib
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from certbound.arrays import Array
from certbound.errors import CertificateError
from certbound.problem.problem import Problem
from certbound.problem.sets import GaussianStart
from certbound.safety.answers import EngineAnswer, Proof, exact
from certbound.safety.certificates.step_values import (
    INWARD,
    ROOMS,
    check_starts,
    claimed,
    claimed_below,
    some_starts,
)

if TYPE_CHECKING:
    from certbound.values.kolmogorov import RoundedSide, RoundedStage, Witness

_SHARE = 1e-3  # of a bound, by which rounding may raise it
_OF_ROOM = 0.2  # of the distance to delta, by which it may
_FINER = 8.0  # smaller rounding, effort after effort
_CLOSE = 0.02  # of the best bound: so much weaker a coarser grid may be
_MOST_BYTES = 5 * 10**6
"""Of the packed arrays."""


def backward_proof(problem: Problem, answer: EngineAnswer, attempt: int = 0) -> Proof:
    """The proof's data, the claimed log10 of the probability, and no assumptions.

    CertificateError where the checker knows no proof of what was bounded, or where its arrays are too large.
    """
    found, room = _rounded(problem, answer, attempt, above=True)
    if not found.bound < 1:
        raise CertificateError("no function was found that bounds the probability below 1.")
    level = claimed(math.log10(max(found.bound, 1e-300)), problem.delta, room)
    return _stated(found) | _law(problem), level, []


def backward_proof_below(problem: Problem, answer: EngineAnswer, attempt: int = 0) -> Proof:
    """The same for the lower bound."""
    check_starts(problem)
    found, room = _rounded(problem, answer, attempt, above=False)
    if not found.bound < 0:
        raise CertificateError("no function was found that bounds the probability from below.")
    level = claimed_below(math.log10(-found.bound), problem.delta, room)
    more: dict[str, Any] = {"side": "lower"} | _law(problem)
    if not problem.initial.random:
        more["starts"] = exact(some_starts(problem))
    if problem.system.disturbance is not None:
        more["disturbances"] = exact(found.disturbances)
    return _stated(_outward(found)) | more, level, []


def _rounded(problem: Problem, answer: EngineAnswer, attempt: int, *, above: bool) -> tuple[RoundedSide, float]:
    """The coarsest function that proves what the best one does, rounded; and the room of the claim."""
    known: tuple[Witness, ...] = getattr(answer.details, "witnesses", ())
    kept = [one for one in known if one.side.above == above]
    if not kept:
        raise CertificateError("the engine kept no function that a certificate can state.")
    effort = min(attempt, len(ROOMS) - 1)
    chosen = coarsest(problem, kept)
    if chosen.side.setting.shapes:
        raise CertificateError(
            "no certificate of the backward equation states limits yet that do not lie along the coordinates: "
            f"'{chosen.side.setting.shapes[0].label}'; the bound holds without one."
        )
    sign = 1.0 if above else -1.0
    left = sign * (problem.delta - sign * chosen.bound)  # positive where the bound decides
    most = _SHARE * abs(chosen.bound)
    room = (min(most, _OF_ROOM * left) if left > 0 else most) / _FINER**effort
    if not room > 0:
        raise CertificateError("the engine's bound is 0 and leaves no room for rounding.")
    return chosen.rounded(room), ROOMS[effort]


def coarsest(problem: Problem, kept: list[Witness]) -> Witness:
    """The first of them that is about as good as the best, or that decides with some room."""
    best = min(one.bound for one in kept)
    target = problem.delta if kept[0].side.above else -problem.delta
    enough = max(best + _CLOSE * abs(best), target - _CLOSE * abs(target) if best < target else best)
    return next(one for one in kept if one.bound <= enough)


def _law(problem: Problem) -> dict[str, Any]:
    """Directions in which a normal start varies independently, and in how many parts each is cut; else nothing."""
    from certbound.values.kolmogorov import Witness

    start = problem.initial
    if not isinstance(start, GaussianStart):
        return {}
    found, parts = Witness.directions(start)
    if not len(found.rows):
        raise CertificateError("no certificate of the backward equation states a random start that does not vary.")
    return {"gains": exact(found.gains), "rows": exact(found.rows), "parts": parts}


def _outward(found: RoundedSide) -> RoundedSide:
    """With nodes a little beyond the limits and the target where they stood on them: whatever lies beyond is off."""
    steps = [INWARD * max(float(np.ptp(one.axes[k])) for one in found.stages) for k in range(len(found.outward))]
    stages = []
    for one in found.stages:
        axes = [axis.copy() for axis in one.axes]
        for axis, given, marks, step in zip(axes, one.axes, found.outward, steps):
            for place, sign in marks:
                axis[given == place] += sign * step
        stages.append(replace(one, axes=tuple(axes)))
    return replace(found, stages=tuple(stages))


def _stated(found: RoundedSide) -> dict[str, Any]:
    stages = [_stage(one) for one in found.stages]
    if sum(len(one["values"]) + len(one["rates"]) for one in stages) > _MOST_BYTES:
        raise CertificateError(f"the function takes over {_MOST_BYTES / 1e6:g} MB: too much for a certificate.")
    return {"engine": "backward", **(stages[0] if len(stages) == 1 else {"stages": stages})}


def _stage(one: RoundedStage) -> dict[str, Any]:
    values, rates = (_packed(rows) for rows in (one.values, one.rates))
    return {
        "axes": [exact(axis) for axis in one.axes], "times": exact(one.times), "units": exact(list(one.units)),
        "values": values, "rates": rates, "eta": exact(one.eta),
    }  # fmt: skip


def _packed(whole: Array) -> str:
    """Whole numbers as one compressed text: second differences in time, of differences along every axis.

    They are small and alike where the function is smooth.
    """
    found = whole.astype(np.int64)
    for axis in (0, *range(found.ndim)):
        found = np.diff(found, axis=axis, prepend=0)
    words = " ".join(map(str, found.ravel().tolist()))
    return base64.b64encode(zlib.compress(words.encode("ascii"))).decode("ascii")
