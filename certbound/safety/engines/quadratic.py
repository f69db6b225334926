"""The engine of quadratic value bounds (Thm K9): several states at everyday noise."""

from __future__ import annotations

import math

from certbound.errors import EnclosureError, InfeasibleError
from certbound.problem.problem import Problem
from certbound.quadratic import QuadraticBound, StepsBound, bound_quadratic, bound_steps
from certbound.safety.answers import AS_IT_IS, SPARED, EngineAnswer, Request
from certbound.watch import seconds_left

_SECONDS = 20.0  # about what may be spent, but by who asks for this engine alone, with a limit of his own
_SPARED = {3: 5.0, 12: 18.0}  # the same, by the number of states, where other engines are asked too
_LEAST = 0.1
_ANY = 1.0  # a target that any bound meets, even none: what the first walls say, unrefined
_HASTE = 4.0  # seconds for these: the engine at work waits
_FEW = 3  # states below which value functions on grids say more
_LONG = 100  # steps from which on two states are asked for too


def quadratic_engine(problem: Problem, asked: Request = AS_IT_IS) -> EngineAnswer:
    """A certified bound of the probability of failing by semidefinite programming; nothing where another has answered.

    Proves: P(failing) <= 10**log10_delta for every start and every disturbance that does not see coming noise.
    """
    if asked.quick:
        return EngineAnswer(applicable=False, method="quadratic", reason=SPARED)
    long = problem.system.time == "discrete" and problem.horizon >= _LONG  # a grid takes its time at every step
    if not asked.thorough and problem.system.dimension < (2 if long else _FEW):
        reason = "left to value functions on grids, which say more in one or two states."
        return EngineAnswer(applicable=False, method="quadratic", reason=reason)
    try:
        most = next((most for n, most in _SPARED.items() if problem.system.dimension <= n), _SECONDS)
        left = seconds_left()
        alone = asked.at_length or (asked.thorough and problem.system.dimension >= _FEW)
        most = min(most, _HASTE) if asked.first else most
        usual = (asked.effort or 1.0) * _SECONDS if asked.thorough else most
        limit = max(left if alone and left < math.inf else min(usual, left), _LEAST)
        target = _ANY if asked.first else problem.delta
        if problem.system.time == "discrete":
            before = asked.before if isinstance(asked.before, StepsBound) else StepsBound()
            return _answer(before if before.complete else bound_steps(
                problem, target=target, seconds=limit, found=lambda bound: asked.found(_answer(bound)),
            ))  # fmt: skip
        best = bound_quadratic(
            problem, target=target, seconds=limit, before=asked.before,
            found=lambda bound: asked.found(_answer(bound)),
        )  # fmt: skip
    except (InfeasibleError, EnclosureError) as error:
        return EngineAnswer(applicable=False, method="quadratic", reason=str(error))
    return _answer(best)


def _answer(bound: QuadraticBound | StepsBound) -> EngineAnswer:
    return EngineAnswer(log10_delta=bound.upper, reason=bound.words + ".", method="quadratic", details=bound)
