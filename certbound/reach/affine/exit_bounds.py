"""The exit probability of an affine model with additive noise, from its exact law."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from flint import ctx

from certbound.display import log10_text
from certbound.gaussian.affine import Inaccurate, Stated, bound_exits, bound_exits_below, stated_exits
from certbound.problem.problem import Problem
from certbound.reach.affine.reading import AffineModel, affine_model

T = TypeVar("T")

_BITS = (192, 512, 1400, 4000)
_GUARD = 64  # bits of the checker's balls beyond those with which pieces were found
_FEW, _PART = 8, -4.0  # limits that a lower bound counts, and the least logarithm of their part of the likeliest one
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


def affine_answer(
    problem: Problem, first: Callable[[AffineAnswer], object] = lambda answer: None
) -> AffineAnswer | None:  # fmt: skip
    """The answer; ``first`` is told the sum over limits before that is made smaller.

    None where the model is not affine, its noise not additive, or its limits are no fixed half-spaces.

    Balls take as many bits as keep every variance accurate, whatever the stiffness.
    """
    model = affine_model(problem)
    if model is None:
        return None

    def answer(total: float, logs: tuple[float, ...]) -> AffineAnswer:
        return AffineAnswer(model=model, log10_delta=_log10(total), logs=tuple(_log10(log) for log in logs))

    def go_on(total: float, logs: tuple[float, ...]) -> bool:
        first(answer(total, logs))
        return True

    found = _accurate(lambda: bound_exits(model.law(), model.rows, model.limits, go_on))
    return None if found is None else answer(found[0].log_probability, found[0].logs)


@dataclass(frozen=True, eq=False, kw_only=True)
class AffinePieces:
    """Pieces of time for a certificate of the exact law, the limits that they serve, and bits for balls."""

    model: AffineModel
    stated: Stated
    bits: int

    @property
    def log10_delta(self) -> float:
        """About what the checker proves of them."""
        return _log10(math.log(min(sum(map(math.exp, self.stated.logs)), 1.0) + 1e-300))


def affine_pieces(problem: Problem, near: float) -> AffinePieces | None:
    """Pieces whose enclosures add about the part ``near`` to the bound; None where `affine_answer` has none either."""
    model = affine_model(problem)
    if model is None:
        return None
    found = _accurate(lambda: stated_exits(model.law(), model.rows, model.limits, near))
    return None if found is None else AffinePieces(model=model, stated=found[0], bits=found[1] + _GUARD)


@dataclass(frozen=True, eq=False, kw_only=True)
class AffineFailing:
    """P(fail) >= ``probability`` from ``start``; ``label`` names the limit that is likeliest to be exceeded."""

    probability: float
    start: tuple[float, ...]
    label: str


def affine_failing(problem: Problem) -> AffineFailing | None:
    """A lower bound from one start: the mean, or the middle of the set, under the disturbances' middle.

    None where `affine_answer` has none, for limits that count in a window of time only, or where nothing is found.
    """
    if not (problem.initial.random or problem.fixed_start or len(problem.starts) > 1):
        problem = problem.replace(initial=problem.initial.middle)  # which is of the set, as no middle of a hull need be
    model = affine_model(problem)
    if model is None or any(limit.during is not None for limit in model.limits):
        return None

    def failing() -> AffineFailing:
        law = model.law()
        logs = bound_exits(law, model.rows, model.limits, lambda total, logs: False).logs
        order = sorted(range(len(logs)), key=lambda place: -logs[place])
        likely = [place for place in order[:_FEW] if logs[place] > logs[order[0]] + _PART]
        asked = [(model.limits[k].direction, model.limits[k].sign, model.limits[k].bound) for k in likely]
        start = tuple(float(law.mean[i, 0].mid()) for i in range(problem.system.dimension))
        found = bound_exits_below(law, model.rows, asked)
        return AffineFailing(probability=found, start=start, label=model.names[order[0]])

    found = _accurate(failing)
    return found[0] if found is not None and found[0].probability > 0 else None


def _accurate(work: Callable[[], T]) -> tuple[T, int] | None:
    """What is found with as few bits as keep every variance accurate, and these bits; None where none of them do."""
    for bits in _BITS:
        with ctx.workprec(bits):
            try:
                return work(), bits
            except Inaccurate:
                continue
    return None


def _log10(log: float) -> float:
    """Rounded up, finite and at most 0."""
    value = max(log / math.log(10.0), _LEAST)
    return min(value + 1e-14 * (1 + abs(value)), 0.0)
