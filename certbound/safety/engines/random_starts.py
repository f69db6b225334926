"""Random starts: the average over cells of what is drawn, from both sides; or a set of starts for other engines.

For those nearly all of the mass is in an ellipsoid, and the rest counts as failing.
P(failing) <= P(X_0 outside E) + sup over x in E of P(failing from x), for every E. With (X_0 - m)' S^-1 (X_0 - m) a
chi-squared variable of n degrees of freedom, P(X_0 outside E) = Q(n / 2, r^2 / 2) for E = {that is at most r^2}.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from flint import arb

from certbound.display import rounded
from certbound.errors import EngineError
from certbound.problem.problem import Problem
from certbound.problem.sets import Box, Ellipsoid
from certbound.reach.starts import StartBounds, bound_noisy_start, bound_silent_start, in_half_spaces, is_silent
from certbound.rigor.balls import precision, upper
from certbound.safety.answers import AS_IT_IS, SPARED, EngineAnswer, Request, is_at_most

Prove = Callable[[Problem, Request], EngineAnswer]

_SILENT = (20_000, 200_000)  # cells where the start alone is random: usually, and at length
_NOISY = (60, 1000, 20_000)  # cells where noise follows: at first, thoroughly, at length
_MANY = 4  # states from which on cells of all directions are too many to stay within half-spaces
_CLOSE = 1.1  # ratio of the bounds below which no other engine is needed
_RATIO = 1.02  # ratio at which cells are small enough
_SHARES = (0.1, 0.3, 0.7)  # of delta, at most, for starts outside the ellipsoid: the first that is a safe start
_WIDER = (1e-9, 1e-12)  # of the covariance, of its trace: more than rounding can take away


def truncated(problem: Problem) -> tuple[Problem, float]:
    """The problem from an ellipsoid of starts, with what is left of delta, and the mass outside, rounded up.

    Raises
    ------
    EngineError
        If no ellipsoid that holds enough of the starts keeps the constraints that are due at time 0.

    Examples
    --------
    >>> import certbound as cb
    >>> system = cb.ContinuousSystem(lambda x: -x, states=2, diffusion=0.1 * np.eye(2))
    >>> safe = [cb.Inside(cb.Ball([0, 0], 1))]
    >>> start = cb.GaussianStart([0, 0], 0.01 * np.eye(2))
    >>> inner, outside = truncated(cb.Problem(system, initial=start, safe=safe, horizon=1, delta=1e-3))
    >>> round(float(np.sqrt(inner.initial.shape[0, 0])), 4), 0.998e-4 < outside < 1e-4
    (0.4292, True)
    """
    if np.trace(problem.initial.covariance) == 0:
        return problem.replace(initial=Box(problem.initial.mean, problem.initial.mean)), 0.0
    for share in _SHARES:
        with contextlib.suppress(ValueError):
            return _within(problem, share)
    raise EngineError(
        f"the ellipsoid that holds all but {_SHARES[-1] * float(problem.delta):.2g} of the random start breaks a "
        "constraint at time 0; give a larger delta, or a start that spreads less."
    )


def _within(problem: Problem, share: float) -> tuple[Problem, float]:
    """The same, with a part of delta for starts outside; ValueError where the ellipsoid breaks a constraint."""
    from scipy.stats import chi2

    start, delta = problem.initial, float(problem.delta)
    covariance, trace = start.covariance, float(np.trace(start.covariance))
    square = float(chi2.isf(0.999 * share * delta, start.dimension))
    shape = square * ((1 + _WIDER[0]) * covariance + _WIDER[1] * trace * np.eye(start.dimension))
    with precision():
        outside = upper((arb(square) / 2).gamma_upper(arb(start.dimension) / 2, 1))
    return problem.replace(initial=Ellipsoid(start.mean, shape), delta=float(f"{(1 - share) * delta:.12g}")), outside


def prove_truncated(prove: Prove, problem: Problem, request: Request) -> EngineAnswer:
    """What an engine that serves no random start proves of a problem that has one."""
    inner, outside = truncated(problem)

    def of_all(answer: EngineAnswer) -> EngineAnswer:
        if not answer.applicable:
            return answer
        total = math.nextafter(10.0**answer.log10_delta * (1 + 1e-14) + outside, math.inf)
        log10 = min(0.0, math.log10(total) + 1e-14) if answer.log10_delta < 0 else 0.0
        words = answer.reason.rstrip(".")
        reason = f"{words}. That is from an ellipsoid of starts; those outside it have probability {outside:.3g}."
        return replace(
            answer, log10_delta=log10, log10_lower=None, reason=reason, conclusive=False, truncated=True
        )

    found = request.found
    return of_all(prove(inner, replace(request, before=None, found=lambda answer: found(of_all(answer)))))


def starts_engine(problem: Problem, asked: Request = AS_IT_IS) -> EngineAnswer:
    """Bounds of the probability of failing over a random start.

    Proves: 10**log10_lower <= P(failing) <= 10**log10_delta, the start drawn as the problem says.
    """
    if asked.quick:
        return EngineAnswer(applicable=False, reason=SPARED, method="starts")

    def found(bounds: StartBounds) -> None:
        asked.found(_answer(problem, bounds))

    def by_cells() -> EngineAnswer:
        most = _SILENT[asked.at_length]
        return _answer(problem, bound_silent_start(problem, most=most, enough=_near, found=found))

    silent = is_silent(problem)
    many = problem.system.dimension >= _MANY and in_half_spaces(problem)
    if silent and not many:
        with contextlib.suppress(EngineError):
            return by_cells()
    patient = asked.at_length or asked.thorough

    def decided(bounds: StartBounds) -> bool:
        return _near(bounds) or (not patient and _settles(problem, bounds))

    most = _NOISY[2 if asked.at_length else int(asked.thorough)]
    try:
        return _answer(problem, bound_noisy_start(problem, most=most, enough=decided, found=found))
    except EngineError:
        if not (silent and many):
            raise
        return by_cells()


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
