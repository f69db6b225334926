"""The engine of the backward equation: a solution in floats, its error bounded where it is and carried (Thm K10)."""

from __future__ import annotations

from dataclasses import replace

from certbound.display import rounded
from certbound.errors import EnclosureError, InfeasibleError
from certbound.problem.problem import Problem
from certbound.safety.answers import AS_IT_IS, SPARED, EngineAnswer, Request
from certbound.safety.engines.values import log10_outward
from certbound.values.backward import Bounds, bound_failing

_SECONDS = 30.0  # of work, where it is asked alone
_FIRST = 0.2  # of that, where it is asked among others
_CLOSE = 1.2  # ratio of the two bounds below which no other engine is needed


def backward_engine(problem: Problem, asked: Request = AS_IT_IS) -> EngineAnswer:
    """Certified bounds of the probability of failing, on finer and finer grids; nothing where another has answered.

    Proves: log10_lower <= log10 of the largest probability of failing over starts <= log10_delta.
    """
    if asked.quick:
        return EngineAnswer(applicable=False, method="backward", reason=SPARED)
    effort = asked.effort if asked.effort is not None else 1.0 if asked.thorough else _FIRST
    answer = EngineAnswer(applicable=False, method="backward")
    try:
        for found in bound_failing(problem, seconds=effort * _SECONDS, delta=problem.delta):
            answer = _answer(problem, found)
            asked.found(answer)
    except (InfeasibleError, EnclosureError) as error:
        return EngineAnswer(applicable=False, method="backward", reason=str(error))
    return replace(answer, effort=effort)


def _answer(problem: Problem, found: Bounds) -> EngineAnswer:
    cells = " x ".join(str(count) for count in found.cells)
    least, most = rounded(found.lower, up=False, digits=4), rounded(found.upper, up=True, digits=4)
    below = f" and at least {least}" if found.lower > 0 else ""
    reason = f"the probability of failing is at most {most}{below}, by a solution on {cells} cells whose error is carried"
    if found.lower > problem.delta:
        reason += f": more than the {problem.delta!r} that is asked, from some start"
    return EngineAnswer(
        log10_delta=log10_outward(found.upper, up=True),
        log10_lower=log10_outward(found.lower, up=False) if found.lower > 0 else None,
        reason=f"{reason}.", method="backward", details=found,
        conclusive=found.upper <= _CLOSE * found.lower,
    )  # fmt: skip
