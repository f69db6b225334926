"""Engines asked in other coordinates too: where a limit is oblique, and what was proved does not do.

A limit n . x <= b becomes a limit of one state y = n . x, and where y has no noise of its own and its rate is a sum of
states, that sum becomes a state too: of vehicles that must keep their order the distances and their rates. What noise
and drift have in common cancels then, and windows and boxes, which are entrywise, lose less. Where the dynamics bends
along fewer sums of states than states (of generators the differences of angles), these sums become states, too, and the
other coordinates come first: what all have in common wanders, and boxes of it cost most of what is bounded.

States of very different sizes (metres of an atom's motion, and its speed) become multiples of powers of two: norms over
all states, and grids that rest on them, are wide otherwise.

Where the noise of a state is in proportion to it, and limits keep it positive, logarithms come first: noise is constant
there, and what falls off as a power of a state does so exponentially. Ito's formula, which they rest on, asks for a
disturbance that does not see coming noise.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.display import rounded
from certbound.errors import EnclosureError, InfeasibleError
from certbound.problem.model import Tape, turned_tape
from certbound.problem.problem import Problem
from certbound.problem.sets import Faces, HalfSpace
from certbound.problem.systems import ContinuousSystem
from certbound.safety.answers import AS_IT_IS, EngineAnswer, Request, is_at_most
from certbound.safety.engines.rooms import log10_sum
from certbound.safety.engines.turning import exact_product, logarithmic, plainly, scales_of, turned_problem
from certbound.watch import OutOfTime, seconds_left, share_of_time

Prove = Callable[[Problem, Request], EngineAnswer]
Turn = tuple[Array, Array]
"""T and its inverse."""

_UNASKED = EngineAnswer(applicable=False, reason="not asked in the states, as other coordinates did.")

_MOST = 20  # states
_LONGEST = 4000  # operations of a model that is looked through for sums
_UNLIKE = 5  # the logarithm to the base 2 of states' ratio from which they are asked in other units, too
_FAR = 12  # and first
_MORE, _NEAR = 0.05, 0.5  # log10: of a lower bound; between both, where the states need not be asked
_HALF = 0.5  # of the time that is left, for logarithms, and for limits along the axes
_SHARES = (0.0, *(sign * 2.0**k for k in range(-4, 3) for sign in (1, -1)))  # of another state, which a shear takes


@dataclass(frozen=True, eq=False, kw_only=True)
class Turned:
    """What was proved in coordinates y = ``matrix`` x: the answer to the problem stated in y, and the plain one."""

    matrix: Array
    inverse: Array
    problem: Problem
    answer: EngineAnswer
    plain: EngineAnswer


@dataclass(frozen=True, eq=False, kw_only=True)
class Apart:
    """Numbers of limits, what was asked of these alone, and the answer: the probabilities add up. And the plain answer.

    The first part may be answered in other coordinates.
    """

    parts: tuple[tuple[tuple[int, ...], Problem, EngineAnswer], ...]
    plain: EngineAnswer


def in_coordinates(prove: Prove, *, beside: Prove | None = None) -> Prove:
    """The engine, asked once more in other coordinates where its answer is weaker than delta and a limit is oblique.

    ``beside`` is asked of limits that are oblique in these other coordinates, by themselves and in the states.
    """

    def proved(problem: Problem, asked: Request = AS_IT_IS) -> EngineAnswer:
        before = asked.before if isinstance(asked.before, Turned | Apart) else None
        inner = replace(asked, before=before.answer.details if isinstance(before, Turned) else None)
        hasty = asked.quick or asked.first
        if beside is not None:
            turn = straight(problem)
        else:
            turn = in_units(problem, _FAR) or (None if hasty else eased(problem))
        first: EngineAnswer | None = None
        if turn is not None:
            share = share_of_time(_HALF) if beside is not None else contextlib.nullcontext()
            with share, contextlib.suppress(InfeasibleError, EnclosureError):
                first = _asked_in(prove, problem, turn, inner, _UNASKED)
            enough = first is not None and first.applicable and is_at_most(first.log10_delta, problem.delta)
            if first is not None and (enough or (hasty and beside is not None)):
                return first
        plain = prove(problem, replace(asked, before=before.plain.details) if before else asked)
        enough = plain.applicable and is_at_most(min(plain.log10_delta, 0.0), problem.delta)
        if enough or (hasty and not plain.conclusive):
            known = first is not None and first.applicable and first.log10_delta < min(plain.log10_delta, 0.0)
            return first if known and first is not None and not enough else plain
        best = plain
        others = turns_of(problem, oblique=not plain.conclusive)
        for other in [turn] if turn is not None and first is not None else others:
            if best is plain and plain.applicable and plain.log10_delta < 0:
                asked.found(plain)
            with contextlib.suppress(InfeasibleError, EnclosureError):
                rest = () if beside is None else _still_oblique(problem, other)
                if rest and beside is not None:
                    answer = _by_parts((prove, beside), problem, other, rest, asked, plain)
                elif first is not None:
                    answer = _instead(plain, first, reason=first.reason, details=replace(first.details, plain=plain))
                else:
                    answer = _asked_in(prove, problem, other, inner, plain)
                if answer.applicable and answer.log10_delta < min(best.log10_delta, 0.0):
                    best = answer
            if is_at_most(min(best.log10_delta, 0.0), problem.delta):
                break
        return replace(best, conclusive=plain.conclusive)

    return proved


def _asked_in(prove: Prove, problem: Problem, turn: Turn, asked: Request, plain: EngineAnswer) -> EngineAnswer:
    """What an engine answers in other coordinates; it does not apply where it proves nothing."""
    other = turned_problem(problem, *turn)

    def stated(answer: EngineAnswer) -> EngineAnswer:
        reason = f"{answer.reason.rstrip('.')}; {_words(problem.system.states, turn[0])}."
        details = Turned(matrix=turn[0], inverse=turn[1], problem=other, answer=answer, plain=plain)
        return _instead(plain, answer, reason=reason, details=details)

    return stated(prove(other, replace(asked, found=lambda answer: asked.found(stated(answer)))))


def _instead(plain: EngineAnswer, answer: EngineAnswer, **changes: Any) -> EngineAnswer:
    """The plain answer with another bound; what it says of rooms at delta is no longer told."""
    return replace(
        plain, applicable=answer.applicable and answer.certified, log10_delta=answer.log10_delta, margin=None,
        time=None, constraint=None, method=answer.method, foresight=answer.foresight, conclusive=False, **changes,
    )  # fmt: skip


def _still_oblique(problem: Problem, turn: Turn) -> tuple[int, ...]:
    """The numbers of limits that are no limits of single states of y."""
    n, found = problem.system.dimension, []
    for number, region in enumerate(one.region for one in problem.safe):
        form = region.form
        flat = isinstance(form, Faces) and exact_product(region.lifted(form.normals, n), turn[1])
        if flat is False or np.any(np.count_nonzero(flat, axis=1) > 1):
            found.append(number)
    return tuple(found)


def _by_parts(
    engines: tuple[Prove, Prove], problem: Problem, turn: Turn, rest: tuple[int, ...], asked: Request,
    plain: EngineAnswer,
) -> EngineAnswer:
    """P(failing) <= P(some limit of one state of y is broken) + P(some other one is): the sum of two answers."""
    asked = replace(asked, before=None, found=lambda answer: None)
    along = tuple(k for k in range(len(problem.safe)) if k not in rest)
    if not along or problem.domain is not None:
        raise InfeasibleError("no limits are left to take apart.")
    first, second = (problem.replace(safe=[problem.safe[k] for k in numbers]) for numbers in (along, rest))
    other = engines[1](second, asked)
    if not (other.applicable and other.certified and other.log10_delta < 0):
        raise InfeasibleError("nothing is proved of some limits by themselves.")
    answers = _asked_in(engines[0], first, turn, asked, plain), other
    if not answers[0].applicable:
        raise InfeasibleError("nothing is proved in other coordinates.")
    total = log10_sum([one.log10_delta for one in answers])
    shares = [rounded(10.0 ** min(one.log10_delta, 0.0), up=True) for one in answers]
    names = ", ".join(f"'{problem.safe[k].label}'" for k in rest)
    reason = f"{answers[0].reason.rstrip('.')}: {shares[0]} at most; {shares[1]} at most for {names} by itself."
    return _instead(
        plain, replace(answers[0], log10_delta=total), reason=reason,
        details=Apart(parts=((along, first, answers[0]), (rest, second, answers[1])), plain=plain),
    )  # fmt: skip


def axes(problem: Problem) -> Turn | None:
    """T and its inverse, such that oblique limits are limits of one state of y = T x; None where nothing is gained.

    Sums along which the dynamics bends come first, where they are fewer than the states that they are made of.

    InfeasibleError where that is not exact in floats.
    """
    system, n = problem.system, problem.system.dimension
    if not isinstance(system, ContinuousSystem) or not 1 < n <= _MOST or problem.hold is not None:
        return None
    rows = [region.lifted(region.form.normals, n) for region in (one.region for one in problem.constraints)
            if isinstance(region.form, Faces)]  # fmt: skip
    limits = np.vstack([np.zeros((0, n)), *rows])
    bent = _bent(problem)
    pivots = list[int]()
    turn = _sheared((np.eye(n), np.eye(n)), [row for row in bent if np.count_nonzero(row) > 1], limits, pivots)
    if not _fewer(bent, turn):
        pivots.clear()
        turn = np.eye(n), np.eye(n)
    turn = _sheared(turn, [row for row in limits if np.count_nonzero(row) > 1], limits, pivots)
    if not pivots:
        return None
    rates = turned_tape(problem.closed_loop, turn[1], turn[0])[1]
    smooth = [rate for place in pivots if (rate := rates[place]) and not _noisy(problem, turn, place)]
    if not smooth:
        return turn
    sums = exact_product(np.array([[rate.get(j, 0.0) for j in range(n)] for rate in smooth]), turn[0])
    return _sheared(turn, list(sums), sums, pivots)


def straight(problem: Problem) -> Turn | None:
    """In the plane, coordinates in which all limits are limits of one of them, and noises are hardly correlated.

    None where limits are so already, or never, or noise is not constant.
    """
    system = problem.system
    if system.dimension != 2 or not isinstance(system, ContinuousSystem) or isinstance(system.diffusion, Tape):
        return None
    with contextlib.suppress(InfeasibleError):
        turn = axes(problem)
        if turn is None or _still_oblique(problem, turn):
            return None
        size = turn[0] @ system.diffusion @ system.diffusion.T @ turn[0].T
        oblique = np.count_nonzero(turn[0], axis=1) > 1
        if oblique.sum() == 1 and not _asked_along(problem, turn, int(np.argmin(oblique))):
            k = int(np.argmax(oblique))
            hoped = -size[0, 1] / size[k, k] if size[k, k] > 0 else 0.0
            for factor in sorted(_SHARES, key=lambda share: abs(share - hoped)):
                shear, back = np.eye(2), np.eye(2)
                shear[1 - k, k], back[1 - k, k] = factor, -factor
                with contextlib.suppress(InfeasibleError):
                    other = exact_product(shear, turn[0]), exact_product(turn[1], back)
                    exact_product(other[0], system.diffusion)
                    return other
        return turn
    return None


def _asked_along(problem: Problem, turn: Turn, place: int) -> bool:
    """Whether some limit is one of this state of y."""
    regions = (one.region for one in problem.constraints)
    faces = [region.lifted(region.form.normals, 2) for region in regions if isinstance(region.form, Faces)]
    return any(np.any(exact_product(rows, turn[1])[:, place]) for rows in faces)


def turns_of(problem: Problem, *, oblique: bool) -> Iterator[Turn]:
    """Other coordinates that are worth a try: of oblique limits, and of states of different sizes."""
    with contextlib.suppress(InfeasibleError):
        turn = axes(problem) if oblique else None
        if turn is not None:
            yield turn
    units = in_units(problem, _UNLIKE)
    if units is not None:
        yield units


def in_units(problem: Problem, least: int) -> Turn | None:
    """States in units of powers of two near their sizes, where these differ by more than 2^least; None elsewhere."""
    exponents = scales_of(problem)
    if exponents is None or np.ptp(exponents) <= least:
        return None
    return np.diag(np.ldexp(1.0, -exponents)), np.diag(np.ldexp(1.0, exponents))


def eased(problem: Problem) -> Turn | None:
    """Those coordinates, where the dynamics bends along fewer states of y than of x; None where it does not."""
    try:
        turn = axes(problem)
        return turn if turn is not None and _fewer(_bent(problem), turn) else None
    except InfeasibleError:
        return None


def _bent(problem: Problem) -> Array:
    """The sums of states along which the dynamics bends; none of a model that is too long to be looked through."""
    tape, n = problem.closed_loop, problem.system.dimension
    return turned_tape(tape, np.eye(n))[2] if len(tape.nodes) <= _LONGEST else np.zeros((0, n))


def _fewer(bent: Array, turn: Turn) -> bool:
    """Whether fewer states of y than of x have a part in these sums."""
    return bool(np.count_nonzero(exact_product(bent, turn[1]).any(axis=0)) < np.count_nonzero(bent.any(axis=0)))


def _sheared(turn: Turn, rows: Sequence[Array], others: Array, pivots: list[int]) -> Turn:
    """T and its inverse with rows . x, or a multiple of it, in place of one state each, which enter ``pivots``.

    The state is one that few of ``others`` ask for, whose factor is a power of two: then shears are exact.
    """
    matrix, inverse = turn
    for row in rows:
        own = exact_product(row[None], inverse)[0]
        places = [j for j in np.flatnonzero(own).tolist() if abs(math.frexp(own[j])[0]) == 0.5 and j not in pivots]
        if np.count_nonzero(own) < 2 or not places:
            continue
        place = min(places, key=lambda j: (np.count_nonzero(others[:, j]), j))
        shear, back = np.eye(len(own)), np.eye(len(own))
        shear[place] = own / own[place]
        back[place] = -shear[place]
        back[place, place] = 1.0
        matrix, inverse = exact_product(shear, matrix), exact_product(inverse, back)
        pivots.append(place)
    return matrix, inverse


def _noisy(problem: Problem, turn: Turn, place: int) -> bool:
    """Whether a state of y = T x has noise of its own."""
    assert isinstance(problem.system, ContinuousSystem)
    diffusion = problem.system.diffusion
    if not isinstance(diffusion, Tape):
        return bool(np.any(exact_product(turn[0][place : place + 1], diffusion)))
    m = diffusion.shape[1]
    return any(row != {} for row in turned_tape(diffusion, turn[1], turn[0])[1][place * m : (place + 1) * m])


def _words(states: tuple[str, ...], matrix: Array) -> str:
    """The states of y that are none of x, or in which units they are."""
    rows = [row for row in matrix if np.count_nonzero(row) > 1]
    if rows:
        sums = (HalfSpace(row, 0).describe(states, "inside").partition(" <= ")[0] for row in rows)
        return f"in the coordinates {', '.join(sums)}"
    return "with " + ", ".join(f"{x} in units of about {1 / a:.1g}" for x, a in zip(states, np.diag(matrix)))


@dataclass(frozen=True, eq=False, kw_only=True)
class Logarithmic:
    """What was proved in logarithms of the states ``places``: the answer in these, and the plain one."""

    places: tuple[int, ...]
    problem: Problem
    answer: EngineAnswer
    plain: EngineAnswer


def by_logarithms(prove: Prove, *, again: bool = False) -> Prove:
    """The engine, asked in logarithms first where there are states of that kind, and as it is where that is too weak.

    ``again``: that comes only once it is asked thoroughly.
    """

    def proved(problem: Problem, asked: Request = AS_IT_IS) -> EngineAnswer:
        before = asked.before if isinstance(asked.before, Logarithmic) else None
        other = None
        if not asked.quick and problem.system.dimension > 1:
            with contextlib.suppress(InfeasibleError):
                other = logarithmic(problem)
        if other is None:
            return prove(problem, asked)
        (places, turned), ended, left = other, True, seconds_left()
        names = ", ".join(f"log {problem.system.states[i]}" for i in places)

        def stated(answer: EngineAnswer, plain: EngineAnswer = _UNASKED) -> EngineAnswer:
            details = Logarithmic(places=places, problem=turned, answer=answer, plain=plain)
            return replace(
                plain, applicable=answer.applicable and answer.certified, log10_delta=answer.log10_delta, margin=None,
                time=None, constraint=None, method=answer.method, foresight=False, conclusive=plain.conclusive,
                reason=f"{plainly(answer.reason).rstrip('.')}; in the coordinates {names}.", details=details,
            )  # fmt: skip

        earlier, old = (before.answer.details, before.plain.details) if before else (None, asked.before)
        inner = replace(asked, before=earlier, above=True, found=lambda one: asked.found(stated(one)))
        found: EngineAnswer | None = None
        with share_of_time(_HALF):
            with contextlib.suppress(InfeasibleError, EnclosureError):
                found = prove(turned, inner)
            ended = False
        if ended and seconds_left() > (1 - _HALF) * left:
            raise OutOfTime  # another engine has answered meanwhile
        useful = found is not None and found.applicable and found.certified and found.log10_delta < 0
        if found is not None and useful:
            if is_at_most(found.log10_delta, problem.delta):
                return stated(found)
            asked.found(stated(found))
        if found is not None and again and not asked.thorough:
            return stated(found)
        hoped = None if found is None else found.hoped if found.log10_lower is None else found.log10_lower
        near = found is not None and useful and hoped is not None and hoped > found.log10_delta - _NEAR
        plain = _UNASKED if near else prove(problem, replace(asked, before=old))
        if found is not None and useful and not (plain.applicable and plain.log10_delta <= found.log10_delta):
            return _raised(prove, problem, asked, stated(found, plain), hoped)
        return plain

    return proved


def _raised(prove: Prove, problem: Problem, asked: Request, answer: EngineAnswer, hoped: float | None) -> EngineAnswer:
    """The answer with a lower bound in logarithms where about ``hoped`` is more than it has; no certificate states it.

    What was proved in logarithms has more starts and narrower limits, by a rounding: it is proved again for others.
    """
    if hoped is None or (answer.log10_lower is not None and hoped < answer.log10_lower + _MORE):
        return answer
    asked.found(answer)
    with contextlib.suppress(InfeasibleError, EnclosureError):
        other = logarithmic(problem, below=True)
        again = other and prove(other[1], replace(asked, before=None, below=True, found=lambda _: None))
        if again is not None and again.applicable and again.log10_lower is not None:
            return replace(answer, log10_lower=max(again.log10_lower, answer.log10_lower or again.log10_lower))
    return answer
