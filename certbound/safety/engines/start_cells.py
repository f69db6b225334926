"""The engine of random starts: the probability of failing as an average over cells of the start, from both sides."""

from __future__ import annotations

import math

from certbound.display import rounded
from certbound.problem.problem import Problem
from certbound.reach.starts import StartBounds, bound_silent_start
from certbound.safety.answers import AS_IT_IS, SPARED, EngineAnswer, Request

_CELLS, _MOST = 20_000, 200_000  # first, and at length
_CLOSE = 1.1  # ratio of the bounds below which no other engine is needed
_RATIO = 1.02


def starts_engine(problem: Problem, asked: Request = AS_IT_IS) -> EngineAnswer:
    """Bounds of the probability of failing over a random start.

    Proves: 10**log10_lower <= P(failing) <= 10**log10_delta, the start drawn as the problem says.
    """
    if asked.quick:
        return EngineAnswer(applicable=False, reason=SPARED, method="starts")
    bounds = bound_silent_start(
        problem, most=_MOST if asked.at_length else _CELLS, enough=lambda found: found.upper <= _RATIO * found.lower,
        found=lambda found: asked.found(_answer(problem, found)),
    )  # fmt: skip
    return _answer(problem, bounds)


def _answer(problem: Problem, found: StartBounds) -> EngineAnswer:
    level = 0.0 if found.upper >= 1 else math.log10(found.upper) if found.upper > 0 else -1e12
    level = min(level + 1e-14 * (1 + abs(level)), 0.0)
    lower = math.log10(found.lower) if found.lower > 0 else None
    lower = None if lower is None else lower - 1e-14 * (1 + abs(lower))
    likeliest = max(range(len(found.shares)), key=lambda k: found.shares[k], default=None)
    label = None if likeliest is None or not found.shares[likeliest] else str(problem.safe[likeliest].label)
    words = (
        f"the starts whose paths fail have a probability between {rounded(found.lower, up=False, digits=4)} and "
        f"{rounded(found.upper, up=True, digits=4)}, by {found.cells} cells of the start"
    )
    return EngineAnswer(
        log10_delta=level, log10_lower=lower, constraint=label, reason=f"{words}.", method="starts", foresight=False,
        conclusive=found.upper <= _CLOSE * found.lower, details=found,
    )  # fmt: skip
