"""Starts that are unions: a verdict on every member, and of them the worst."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

from certbound.problem.problem import Problem
from certbound.safety.verdict import Verdict
from certbound.watch import OutOfTime, Watch

_LONGER = 1.5  # times its share of the time, without which no member is asked again


def worst_verdict(problem: Problem, watch: Watch, decided: Callable[[Problem], Verdict]) -> Verdict:
    """The verdict on a problem whose start is a union: that of its worst member, with all of them as ``members``.

    The probability from the worst start of a union is that from the worst start of a member, so that the largest of
    the members' bounds is one, and so is the largest of their lower bounds. Each member has an equal share of the time
    that is left; a noise-free trajectory that leaves ends the search. Where somebody waits for a limit, what is left
    of it then goes to members that are undecided.
    """
    found, shares, members = list[Verdict](), list[float](), list(_members(problem))
    with watch.running():
        for share, member in members:
            shares.append(share * watch.left)
            found.append(_asked(member, watch, share, decided))
            if found[-1].status == "UNSAFE_NOMINAL":
                break
        refuted = any(verdict.status.startswith("UNSAFE") for verdict in found)
        if watch.patient and watch.limit is not None and not refuted:
            for number, (_, member) in enumerate(members):
                if found[number].status == "UNKNOWN" and watch.left > _LONGER * shares[number]:
                    again = _asked(member, watch, 1.0, decided)
                    found[number] = min(found[number], again, key=lambda verdict: verdict.log10_delta)
    return _worst(problem, found)


def _asked(member: Problem, watch: Watch, share: float, decided: Callable[[Problem], Verdict]) -> Verdict:
    """The verdict on one member within a share of the time that is left."""
    watch.log10_delta, watch.log10_lower = 0.0, None  # what is told is about this member
    with watch.share(share):
        return decided(member)
    raise OutOfTime


def _members(problem: Problem) -> Iterator[tuple[float, Problem]]:
    """Every member as a problem of its own, and the share of the remaining time that it has."""
    count = len(problem.starts)
    for number, start in enumerate(problem.starts):
        yield 1 / (count - number), problem.replace(initial=start)


def _worst(problem: Problem, found: Sequence[Verdict]) -> Verdict:
    worst = replace(found[0], members=tuple(found)).worst
    lower = [verdict.log10_lower for verdict in found if verdict.log10_lower is not None]
    return replace(
        worst,
        problem=problem,
        members=tuple(found),
        log10_delta=max(verdict.log10_delta for verdict in found),
        log10_lower=max(lower, default=None),
        reason=f"The worst of {len(problem.starts)} starts is number {found.index(worst) + 1}: {worst.reason}",
    )
