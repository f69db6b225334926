"""The engines of value functions (Thms K8, K10): the probability of failing itself, from both sides, for few states."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from certbound.display import rounded
from certbound.errors import EnclosureError, InfeasibleError
from certbound.problem.goals import until
from certbound.problem.problem import Problem
from certbound.problem.systems import DiscreteSystem
from certbound.safety.answers import AS_IT_IS, SPARED, EngineAnswer, Request
from certbound.values.chains import bound_chain, bound_drifting
from certbound.values.continuous import (
    ExitBounds,
    SureExit,
    bound_exits,
    bound_lasting,
    bound_rate,
    is_confined,
    leaves_surely,
)  # fmt: skip
from certbound.values.directed import bound_directed_failure
from certbound.values.discrete import FailureBounds, bound_failure, bound_long_run
from certbound.values.semilagrangian import bound_exits_by_steps, serves
from certbound.watch import seconds_left

_SECONDS = 20.0  # about what may be spent
_GRANT = 0.7  # of the time that is left, where all of it may be spent: what does not come to its end is lost
_LEAST = 1e-3
_FLOOR = -300.0
_BACKWARD = 20.0  # of work, where it is asked alone
_BRIEF = (0.8, 0.4)  # of that, where it is asked among others and nothing limits the time, in three states and in two:
# for the rest once they prove nothing; in three states less than that seldom proves anything
_RATIO, _RATIO_WITH_EFFORT = 1.05, 1.0001  # of the two bounds below which grids are not refined
_CLOSE = 1.2  # ratio of the two bounds below which no other engine is needed


def values_engine(problem: Problem, asked: Request = AS_IT_IS) -> EngineAnswer:
    """Certified bounds of the probability of failing, on finer and finer grids; nothing where another has answered.

    Proves: log10_lower <= log10 of the largest probability of failing over starts and disturbances <= log10_delta.
    """
    if asked.quick:
        return EngineAnswer(applicable=False, method="values", reason=SPARED)
    most = _SECONDS
    limit = asked.effort * most if asked.effort is not None else most if asked.thorough else most / 4
    limit = max(limit if asked.effort is not None else min(limit, seconds_left()), _LEAST)
    return replace(_answered(problem, asked, limit), effort=limit / most)


def _answered(problem: Problem, asked: Request, limit: float) -> EngineAnswer:
    """The answer to work that stands for so many seconds."""
    try:
        if problem.system.time == "continuous" and problem.endless:
            return _lasting(problem)
        if problem.reach is None and serves(problem):
            part = limit if asked.effort is not None else _GRANT * seconds_left()
            whole = max(min(limit, part), _LEAST)  # one grid: its steps end, or all is lost
            return _continuous(_confined(problem, limit) or bound_exits_by_steps(problem, seconds=whole))
        if not isinstance(problem.system, DiscreteSystem):
            answer = _continuous(_exits(problem, limit, asked))
            return answer if answer.log10_delta < 0 else _by_rate(problem) or _without_end(problem, limit) or answer
        found = _failure(problem, limit, _RATIO_WITH_EFFORT if asked.at_length else _RATIO)
    except (InfeasibleError, EnclosureError) as error:
        sure = leaves_surely(problem) if problem.endless else None
        lasting = _surely(problem, sure) if sure is not None else _by_rate(problem) or _without_end(problem, limit)
        return lasting or EngineAnswer(applicable=False, method="values", reason=str(error))
    return _answer(problem, found)


def _lasting(problem: Problem) -> EngineAnswer:
    """An infinite horizon in continuous time."""
    found = _by_rate(problem)
    if found is not None and found.log10_lower is not None:
        return found
    sure = leaves_surely(problem)
    if sure is not None:
        return _surely(problem, sure)
    if problem.system.dimension > 1:
        raise InfeasibleError(
            "a value function in continuous time needs an end, and the horizon is infinite; without one a single state "
            "is served, with limits and targets that stand still, for a model that does not depend on time, and "
            "several states where noise leads every path out: along one that is bounded on both sides, everywhere."
        )
    return found or _by_function(problem)


def _surely(problem: Problem, sure: SureExit) -> EngineAnswer:
    """Noise along a bounded state leads every path out."""
    name, unit = problem.system.states[sure.state], problem.time_unit
    mean = f", after at most {rounded(sure.mean, up=True, digits=3)} {unit} in the mean" if sure.mean < math.inf else ""
    words = f"every path leaves in the end{mean}: the limits bound {name} on both sides, and its noise vanishes nowhere"
    return EngineAnswer(log10_delta=0.0, log10_lower=0.0, reason=f"{words}.", method="values", details=sure,
                        conclusive=True)  # fmt: skip


def _by_function(problem: Problem) -> EngineAnswer:
    """What a function of the state alone says of all times; nothing from below of a horizon that ends."""
    found = bound_lasting(problem)
    lower = found.lower / math.log(10) if problem.endless and found.lower > -math.inf else None
    least = "" if lower is None else f" and at least 10^{rounded(lower, up=False, digits=6)}"
    upper = found.upper / math.log(10)
    words = f"the probability of ever failing is at most 10^{rounded(upper, up=True, digits=6)}{least}"
    return EngineAnswer(
        log10_delta=min(upper * (1 - 1e-15), 0.0), log10_lower=None if lower is None else lower * (1 + 1e-15),
        reason=f"{words}, by a function of the state alone.", method="values", details=found,
        conclusive=lower is not None and upper <= lower + math.log10(_CLOSE),
    )  # fmt: skip


def _without_end(problem: Problem, limit: float) -> EngineAnswer | None:
    """What all times say of a horizon without a target, which may end; None where nothing is proved."""
    timed = problem.input_sequence is not None or any(one.during is not None for one in problem.safe)
    if problem.system.dimension > 1 or problem.reach is not None or timed:
        return None
    try:
        if problem.system.time == "continuous":
            return _by_function(problem)
        found, drift = bound_drifting(problem.replace(horizon=math.inf), seconds=limit, delta=problem.delta)
        answer = replace(_answer(problem, found), details=drift)
        return answer if problem.endless else replace(answer, log10_lower=None, conclusive=False)
    except (InfeasibleError, EnclosureError):
        return None


def _by_rate(problem: Problem) -> EngineAnswer | None:
    """What the rate of leaving says of the horizon; None where none is proved."""
    plain = problem.reach is None and not problem.ending and all(
        one.during in (None, (0.0, float(problem.horizon))) for one in problem.kept
    )
    if problem.system.time != "continuous" or problem.system.dimension != 1 or not plain or problem.initial.random:
        return None
    rate = bound_rate(problem)
    if rate is None:
        return None
    least, most = rate.before(float(problem.horizon))
    shares = [rounded(rate.share[0], up=False, digits=4), rounded(rate.share[1], up=True, digits=4)]
    rates = [rounded(rate.rate[0], up=False, digits=4), rounded(rate.rate[1], up=True, digits=4)]
    words = f"for every T, P(leaving before T) <= 1 - {shares[0]} exp(-{rates[1]} T)"
    if rate.rate[0] > 0:
        words += f", and at least 1 - {shares[1]} exp(-{rates[0]} T): every path leaves in the end"
    return EngineAnswer(
        log10_delta=log10_outward(most, up=True),
        log10_lower=None if least < 10.0**_FLOOR else log10_outward(least, up=False),
        reason=f"{words}.", method="values", details=rate,
    )


def _failure(problem: Problem, limit: float, ratio: float) -> FailureBounds:
    asked: dict[str, Any] = {"seconds": limit, "delta": problem.delta, "ratio": ratio}
    try:  # what noise along one direction leaves to chains otherwise
        found: FailureBounds | None = bound_directed_failure(problem, **asked)
    except InfeasibleError:
        found = None
    if found is not None and (found.upper < 1 or found.lower > 0):
        return found
    found = bound_long_run(problem, **asked)
    if found is not None:
        return found
    target = problem.reach
    try:
        if target is None:
            return bound_failure(problem, **asked)
        if not target.stays:
            first, last = target.during or (0, problem.horizon)
            plain = until(problem, int(last))
            return bound_failure(plain, target=target.region, since=int(first), **asked)
        first, last = target.during or (0, problem.horizon)
        return bound_failure(
            until(problem, problem.horizon), target=target.region, since=int(first), until=int(last), **asked
        )
    except InfeasibleError as error:
        refused = str(error)
    try:
        return bound_chain(problem, **asked | {"seconds": min(2 * limit, seconds_left())})
    except InfeasibleError as error:
        raise InfeasibleError(f"{refused.rstrip('.')}; and {error}") from error


def _confined(problem: Problem, limit: float) -> ExitBounds | None:
    """Splines where noise moves one state only, and no path crosses the other one's ends; None if they say nothing."""
    try:
        found = bound_exits(problem, seconds=limit, delta=problem.delta) if is_confined(problem) else None
    except (InfeasibleError, EnclosureError):
        return None
    return found if found is not None and found.upper < 0 else None


def _exits(problem: Problem, limit: float, asked: Request) -> ExitBounds:
    target = problem.reach
    if target is None:
        return bound_exits(problem, seconds=limit, delta=problem.delta, above=not asked.below,
                           below=not asked.above)  # fmt: skip
    first, last = target.during or (0.0, float(problem.horizon))
    if first > 0:
        raise InfeasibleError("value functions in continuous time need a target that counts from the beginning.")
    return bound_exits(until(problem, last), target=target.region, seconds=limit)


def _continuous(found: ExitBounds) -> EngineAnswer:
    close = found.lower is not None and found.upper <= found.lower + math.log10(_CLOSE)
    return EngineAnswer(
        log10_delta=found.upper,
        log10_lower=found.lower,
        hoped=found.hoped,
        reason=found.words,
        method="values",
        details=found,
        conclusive=close,
    )


def _answer(problem: Problem, found: FailureBounds) -> EngineAnswer:
    cells = " x ".join(str(count) for count in found.cells)
    least, most = rounded(found.lower, up=False, digits=4), rounded(found.upper, up=True, digits=4)
    below = f" and at least {least}" if found.lower > 0 else ""
    reason = f"the probability of failing is at most {most}{below}, on a grid of {cells} cells"
    if found.rate is not None and found.before is not None:
        reason += f". {_for_all(found.rate, found.before)}"
    if found.lower > problem.delta:
        reason += f": more than the {problem.delta!r} that is asked, from some start"
    return EngineAnswer(
        log10_delta=log10_outward(found.upper, up=True),
        log10_lower=None if found.lower < 10.0**_FLOOR else log10_outward(found.lower, up=False),
        reason=reason + ".",
        method="values",
        details=found,
        conclusive=found.upper <= _CLOSE * found.lower,
    )


def _for_all(rate: tuple[float, float], before: tuple[int, float, float]) -> str:
    """What is known of every horizon."""
    low, high = rounded(rate[0], up=False, digits=4), rounded(rate[1], up=True, digits=4)
    least, most = rounded(before[1], up=False, digits=4), rounded(before[2], up=True, digits=4)
    below = f"1 - {_power(least, low, before[0])}" if rate[0] > 0 else least
    return (
        f"For every T from {before[0]}: {below} <= P(leaving within T steps) <= "
        f"1 - {_power(most, high, before[0])}"
    )


def _power(share: str, rate: str, steps: int) -> str:
    return f"(1 - {share})(1 - {rate})^(T - {steps})"


def log10_outward(probability: float, *, up: bool) -> float:
    """log10 rounded up or down, at least -300."""
    value = math.log10(max(probability, 10.0**_FLOOR))
    slack = 1e-14 * abs(value) + 1e-15
    return min(value + slack, 0.0) if up else min(value - slack, 0.0)


def backward_engine(problem: Problem, asked: Request = AS_IT_IS) -> EngineAnswer:
    """Certified bounds of the probability of failing, on finer and finer grids; nothing where another has answered.

    Proves: log10_lower <= log10 of the largest probability of failing over starts <= log10_delta.
    """
    if asked.quick:
        return EngineAnswer(applicable=False, method="backward", reason=SPARED)
    from certbound.values.kolmogorov import Bounds, bound_failing

    whole = asked.thorough or seconds_left() < math.inf  # others have turns in between, and know what is left
    brief = 1.0 if whole else _BRIEF[problem.system.dimension < 3]
    effort = brief if asked.effort is None else asked.effort
    answer = EngineAnswer(applicable=False, method="backward")
    try:
        before = asked.before if isinstance(asked.before, Bounds) else None
        if before is not None:
            answer = _carried(problem, before)
        for found in bound_failing(problem, seconds=effort * _BACKWARD, delta=problem.delta, before=before):
            answer = _carried(problem, found)
            asked.found(answer)
    except (InfeasibleError, EnclosureError) as error:
        return EngineAnswer(applicable=False, method="backward", reason=str(error))
    return replace(answer, effort=effort)


def _carried(problem: Problem, found: Any) -> EngineAnswer:
    cells = " x ".join(str(count) for count in found.cells)
    least, most = rounded(found.lower, up=False, digits=4), rounded(found.upper, up=True, digits=4)
    known = [f"at most {most}"] * (found.upper < 1) + [f"at least {least}"] * (found.lower > 0)
    how = f"by a solution on {cells} cells whose error is carried"
    reason = f"the probability of failing is {' and '.join(known)}, {how}"
    if not known:
        reason = f"nothing is proved of the probability of failing {how}"
    if found.lower > problem.delta:
        reason += f": more than the {problem.delta!r} that is asked, from some start"
    return EngineAnswer(
        log10_delta=log10_outward(found.upper, up=True),
        log10_lower=log10_outward(found.lower, up=False) if found.lower > 0 else None,
        reason=f"{reason}.", method="backward", details=found,
        conclusive=found.upper <= _CLOSE * found.lower,
    )  # fmt: skip
