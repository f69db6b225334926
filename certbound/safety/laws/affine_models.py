"""Affine models with additive noise first by their exact law, then by what has tubes and certificates."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import replace
from functools import wraps

from certbound.errors import CertificateError, EngineError
from certbound.problem.problem import Problem
from certbound.reach.affine import AffineAnswer, affine_answer
from certbound.safety.answers import AS_IT_IS, EngineAnswer, Proof, Request, is_at_most
from certbound.watch import held_back, limited_to

_TUBES = 2.0  # seconds for the tubes of a model whose law is known exactly
_SOON, _STATED = 3.0, 30.0  # seconds for what a certificate can state instead, before the law is stated and after

Prove = Callable[..., EngineAnswer]


def by_law(prove: Prove) -> Prove:
    """The engine, after what the exact law of an affine model says; the lesser bound counts.

    The engine has a few seconds then, for its tubes, and for a certificate that states its own bound; more where the
    start is random.
    """

    def proved(problem: Problem, asked: Request = AS_IT_IS) -> EngineAnswer:
        law = None
        if asked.cells is None:
            with contextlib.ExitStack() as stack:

                def first(plain: AffineAnswer) -> None:
                    asked.found(_answer(plain))
                    stack.enter_context(held_back())

                law = affine_answer(problem, first)
        if law is None:
            return prove(problem, asked)
        answer = _answer(law)
        asked.found(answer)
        if asked.quick:
            return answer
        tubes: EngineAnswer | None = None
        drawn = problem.initial.random  # the tubes may say more there
        with contextlib.nullcontext() if drawn else limited_to(_TUBES), contextlib.suppress(EngineError):
            tubes = prove(problem, replace(asked, found=lambda _: None))
        if tubes is None or not tubes.applicable:
            return answer
        if tubes.log10_delta <= law.log10_delta:
            return replace(tubes, conclusive=True)
        return _joined(problem, answer, tubes)

    return proved


def _answer(law: AffineAnswer) -> EngineAnswer:
    return EngineAnswer(
        log10_delta=law.log10_delta, method="linear", details=law, foresight=True, conclusive=True,
        by_limit=law.by_limit, reason=f"{law.reason}.",
    )  # fmt: skip


def _joined(problem: Problem, answer: EngineAnswer, tubes: EngineAnswer) -> EngineAnswer:
    """The law's bound, with the tubes and the numbers of another answer that proves less."""
    limits = answer.by_limit
    if limits is not None and tubes.by_limit is not None:
        limits = {limit: min(log, tubes.by_limit.get(limit, 0.0)) for limit, log in limits.items()}
    short = tubes.margin is not None and tubes.margin < 0 and is_at_most(answer.log10_delta, problem.delta)
    return replace(
        tubes, log10_delta=answer.log10_delta, by_limit=limits, conclusive=True, reason=answer.reason, method="linear",
        margin=None if short else tubes.margin, certified=True, foresight=True,
    )  # fmt: skip


Writer = Callable[..., Proof]


def of_laws(write: Writer, prove: Prove, write_law: Writer) -> Writer:
    """A writer for models whose law is known too: the engine's own proof where that is soon enough for delta.

    Else ``write_law(problem, attempt)`` states the law itself, and the proof that says more is written.
    """

    @wraps(write)
    def written(problem: Problem, answer: EngineAnswer, attempt: int = 0) -> Proof:
        lawful = isinstance(answer.details, AffineAnswer)
        best, why = _tried(lambda: _plain(problem, prove, write, attempt, _SOON, enough=True) if lawful
                           else write(problem, answer, attempt))  # fmt: skip
        if best is not None and is_at_most(min(best[1], 0.0), problem.delta):
            return best
        law, other = _tried(lambda: write_law(problem, attempt))
        found = [one for one in (best, law) if one is not None]
        if found:
            return min(found, key=lambda one: one[1])
        if not lawful:
            raise CertificateError(why)
        best, why = _tried(lambda: _plain(problem, prove, write, attempt, _STATED))
        if best is None:
            raise CertificateError(f"{other.rstrip('.')}; and the linear response does not serve it: {why}")
        return best

    return written


def _tried(ask: Callable[[], Proof]) -> tuple[Proof | None, str]:
    """A proof, or why there is none."""
    try:
        return ask(), ""
    except CertificateError as error:
        return None, str(error)


def _plain(
    problem: Problem, prove: Prove, write: Writer, attempt: int, seconds: float, *, enough: bool = False
) -> Proof:  # fmt: skip
    """What the engine without the law proves within some seconds; ``enough``: nothing unless that serves delta."""
    other, why = None, f"it proves nothing in {seconds:g} s"
    try:
        with limited_to(seconds):
            other = prove(problem)
            why = other.reason
    except EngineError as error:
        why = str(error)
    if other is None or not other.applicable:
        raise CertificateError(f"{why.rstrip('.')}.")
    if enough and not is_at_most(other.log10_delta, problem.delta):
        raise CertificateError("the linear response proves less than delta asks for.")
    return write(problem, other, attempt)
