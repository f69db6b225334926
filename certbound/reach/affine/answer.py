"""The exit probability of an affine model with additive noise, from its exact law."""

from __future__ import annotations

import math
from dataclasses import dataclass

from flint import ctx

from certbound.display import log10_text
from certbound.gaussian.affine.trace import Inaccurate
from certbound.gaussian.affine.upper import bound_exits
from certbound.problem.problem import Problem
from certbound.reach.affine.reading import AffineModel, affine_model

_BITS = (192, 512, 1400, 4000)
_LEAST = -1e12  # log10 of a probability that is not told apart from 0


@dataclass(frozen=True, eq=False, kw_only=True)
class AffineAnswer:
    """log10 of bounds of P(some limit is exceeded), and of each limit's own."""

    model: AffineModel
    log10_delta: float
    logs: tuple[float, ...]

    @property
    def by_limit(self) -> dict[tuple[int, int], float]:
        """log10 of bounds of P(a path leaves through a limit), by the numbers of constraint and limit."""
        return dict(zip(self.model.places, self.logs))

    @property
    def reason(self) -> str:
        """What takes most, in words."""
        worst = max(range(len(self.logs)), key=self.logs.__getitem__)
        return f"the exact law of the linear model gives {log10_text(self.logs[worst])} for '{self.model.names[worst]}'"


def affine_answer(problem: Problem) -> AffineAnswer | None:
    """The answer; None where the model is not affine, its noise not additive, or its limits are no fixed half-spaces.

    Balls take as many bits as keep every variance accurate, whatever the stiffness.
    """
    model = affine_model(problem)
    if model is None:
        return None
    for bits in _BITS:
        with ctx.workprec(bits):
            try:
                found = bound_exits(model.law(), model.rows, model.limits)
            except Inaccurate:
                continue
        logs = tuple(_log10(log) for log in found.logs)
        return AffineAnswer(model=model, log10_delta=_log10(found.log_probability), logs=logs)
    return None


def _log10(log: float) -> float:
    """Rounded up, finite and at most 0."""
    value = max(log / math.log(10.0), _LEAST)
    return min(value + 1e-14 * (1 + abs(value)), 0.0)
