"""Limits that move: a verdict on the problem in coordinates in which they rest (`certbound.problem.reductions`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from certbound.errors import InfeasibleError
from certbound.problem.problem import Problem
from certbound.problem.reductions import RestingLimits, bring_to_rest
from certbound.problem.sets import Inside
from certbound.safety.answers import EngineAnswer, is_at_most, is_more_than
from certbound.safety.verdict import Verdict, verdict_of
from certbound.watch import Watch

_PLAIN = 0.3  # of the time that is left, for the problem as it is where only centres move
_ABOVE = 0.6  # of the time that is left, for upper bounds where lower ones are those of another problem

Decided = Callable[[Problem], Verdict]


def is_moving(problem: Problem) -> bool:
    """Whether a set that the problem asks for moves."""
    return any(constraint.region.moving for constraint in _asked_of(problem))


def moving_verdict(
    problem: Problem, watch: Watch, decided: Decided, plainly: Decided, *, method: str, stated: bool
) -> Verdict:
    """The verdict on a problem with sets that move, from those on the problem in which their limits rest.

    Where only centres move the problem comes first as it is, by ``plainly``: certificates state what is proved so.
    ``stated`` tells whether constants were stated: they are those of the states, and of no other coordinates.
    """
    changing = any(constraint.region.changing for constraint in _asked_of(problem))
    if stated and not changing:
        return plainly(problem)
    if stated:
        return _nothing(problem, method, "stated constants are not those of coordinates that move with limits.")
    try:
        resting = bring_to_rest(problem)
    except InfeasibleError as error:
        return _nothing(problem, method, str(error)) if changing else plainly(problem)
    moving = _motions(problem)

    def nearer(other: Problem) -> Verdict:
        return decided(other) if _motions(other) < moving else plainly(other)

    if changing:
        return _at_rest(problem, resting, watch, nearer, method)
    plain = _within(watch, _PLAIN, problem, plainly)
    return plain if plain.status != "UNKNOWN" else _better(plain, _at_rest(problem, resting, watch, nearer, method))


def _motions(problem: Problem) -> tuple[int, int]:
    """How many sets change, and how many move: where coordinates leave no fewer, others would undo what they did."""
    regions = [constraint.region for constraint in _asked_of(problem)]
    return sum(one.changing for one in regions), sum(one.moving for one in regions)


def _asked_of(problem: Problem) -> list[Inside]:
    return [*problem.safe, *([] if problem.reach is None else [problem.reach])]


def _within(watch: Watch, share: float, problem: Problem, decided: Decided) -> Verdict:
    """A verdict within a share of the time that is left; it is what is known once that is over."""
    with watch.share(share):
        return decided(problem)
    raise AssertionError("a search ends with a verdict")


def _nothing(problem: Problem, method: str, reason: str) -> Verdict:
    answer = EngineAnswer(applicable=False, method=method, reason=reason)
    return verdict_of(problem, {method: answer}, method)


def _at_rest(problem: Problem, resting: RestingLimits, watch: Watch, decided: Decided, method: str) -> Verdict:
    """What the problem with limits at rest proves: one problem from both sides, or one from each side."""
    if resting.exact and resting.above is not None:
        return _said_of(problem, resting, decided(resting.above))
    found = _nothing(problem, method, "nothing is left to be safe in where limits are narrowed so that they rest.")
    if resting.above is not None:
        found = _said_of(problem, resting, _within(watch, _ABOVE, resting.above, decided))
        unsafe = found.status.startswith("UNSAFE")  # of a smaller set: no lower bound
        found = replace(found, status="UNKNOWN" if unsafe else found.status, log10_lower=None)
    if found.status == "SAFE" or resting.below is None:
        return found
    below = _said_of(problem, resting, decided(resting.below))
    if not below.status.startswith("UNSAFE"):
        return replace(found, log10_lower=below.log10_lower)
    return replace(
        below, log10_delta=found.log10_delta, answers=found.answers, stated=found.stated or problem, margin=None,
        time=None, constraint=None, tube=None, reach=None, constants=None, deviation=None,
    )  # fmt: skip


def _said_of(problem: Problem, resting: RestingLimits, found: Verdict) -> Verdict:
    """A verdict in coordinates that move as one on the problem: what is said of places is left out."""
    assert found.problem is not None
    if not resting.states:
        reason = f"with limits that are stated step by step: {found.reason}"
        return replace(found, problem=problem, stated=found.problem, reason=reason)
    reason = f"in coordinates of {', '.join(resting.states)} that move with the limits: {found.reason}"
    return replace(
        found, problem=problem, stated=found.problem, reason=reason, margin=None, time=None, constraint=None,
        tube=None, reach=None, constants=None, deviation=None,
    )  # fmt: skip


def _better(plain: Verdict, found: Verdict) -> Verdict:
    """The smaller upper bound and the larger lower one of two verdicts on a problem, of which one decides nothing."""
    assert found.problem is not None
    level = min(plain.log10_delta, found.log10_delta)
    lowers = [one.log10_lower for one in (plain, found) if one.log10_lower is not None]
    lower = max(lowers, default=None)
    best = found if found.log10_delta < plain.log10_delta or found.status != "UNKNOWN" else plain
    safe = is_at_most(level, found.problem.delta)
    unsafe = lower is not None and is_more_than(lower, found.problem.delta)
    status = best.status if best.status != "UNKNOWN" else "SAFE" if safe else "UNSAFE" if unsafe else "UNKNOWN"
    spent = {**plain.seconds, **found.seconds}
    return replace(best, status=status, log10_delta=level, log10_lower=lower, seconds=spent)
