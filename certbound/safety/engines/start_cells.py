"""The engine of random starts: the probability of failing as an average over cells of the start, from both sides."""

from __future__ import annotations

import math

from certbound.display import rounded
from certbound.errors import EngineError
from certbound.problem.problem import Problem
from certbound.reach.starts import StartBounds, bound_noisy_start, bound_silent_start, is_silent
from certbound.safety.answers import AS_IT_IS, SPARED, EngineAnswer, Request, is_at_most

_SILENT = (20_000, 200_000)  # cells where the start alone is random: usually, and at length
_NOISY = (60, 1000, 20_000)  # cells where noise follows: at first, thoroughly, at length
_CLOSE = 1.1  # ratio of the bounds below which no other engine is needed
_RATIO = 1.02  # ratio at which cells are small enough


def starts_engine(problem: Problem, asked: Request = AS_IT_IS) -> EngineAnswer:
    """Bounds of the probability of failing over a random start.

    Proves: 10**log10_lower <= P(failing) <= 10**log10_delta, the start drawn as the problem says.
    """
    if asked.quick:
        return EngineAnswer(applicable=False, reason=SPARED, method="starts")

    def found(bounds: StartBounds) -> None:
        asked.found(_answer(problem, bounds))

    if is_silent(problem):
        try:
            most = _SILENT[asked.at_length]
            return _answer(problem, bound_silent_start(problem, most=most, enough=_near, found=found))
        except EngineError as error:
            if "linear" not in str(error):
                raise
    level = 2 if asked.at_length else int(asked.thorough)
    decided = _near if asked.at_length or asked.thorough else lambda bounds: _near(bounds) or _settles(problem, bounds)
    return _answer(problem, bound_noisy_start(problem, most=_NOISY[level], enough=decided, found=found))


def _near(found: StartBounds) -> bool:
    return found.upper <= _RATIO * found.lower


def _settles(problem: Problem, found: StartBounds) -> bool:
    """Whether the bounds decide the question."""
    return found.lower > problem.delta or (found.upper > 0 and is_at_most(_level(found), problem.delta))


def _level(found: StartBounds) -> float:
    """log10 of the upper bound, rounded up."""
    level = math.log10(found.upper) if found.upper > 0 else -300.0
    return min(level + 1e-14 * (1 + abs(level)), 0.0) if found.upper < 1 else 0.0


def _answer(problem: Problem, found: StartBounds) -> EngineAnswer:
    lower = math.log10(found.lower) if found.lower > 0 else None
    lower = None if lower is None else lower - 1e-14 * (1 + abs(lower))
    likeliest = max(range(len(found.shares)), key=lambda k: found.shares[k], default=None)
    label = None if likeliest is None or not found.shares[likeliest] else str(problem.safe[likeliest].label)
    words = (
        f"over the random start the probability lies between {rounded(found.lower, up=False, digits=4)} and "
        f"{rounded(found.upper, up=True, digits=4)}, by {found.cells} cells of what is drawn"
    )
    return EngineAnswer(
        log10_delta=_level(found), log10_lower=lower, constraint=label, reason=f"{words}.", method="starts",
        conclusive=found.upper <= _CLOSE * found.lower, details=found,
    )  # fmt: skip
