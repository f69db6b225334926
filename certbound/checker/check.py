"""Checking a certificate: read it, prove every inequality again, say what was proved."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from flint import arb, ctx

from certbound.checker.claims import assumptions, check_side, claim, claim_below, engine_of, prove, words_of
from certbound.checker.reading import Record, read, text
from certbound.checker.report import Budget, Report, Unproved
from certbound.checker.statement import first_difference, read_model
from certbound.checker.words import plainly, rounded, shortened
from certbound.errors import CertificateError

FORMAT = "certbound certificate"
VERSION = 1
SECONDS = 300.0
"""Work and time that a check may take."""
PRECISION = 128
_UNREAD = "what the certificate claims was not read within the limits of the check"


def check_file(
    path: str | os.PathLike[str], problem: Mapping[str, Any] | None = None, *, seconds: float = SECONDS,
    allow_assumptions: bool = False,
) -> Report:  # fmt: skip
    """Check the certificate in a file; see `check_data`."""
    return check_data(read(path), problem, seconds=seconds, allow_assumptions=allow_assumptions)


def check_data(
    data: Mapping[str, Any], problem: Mapping[str, Any] | None = None, *, seconds: float = SECONDS,
    allow_assumptions: bool = False,
) -> Report:  # fmt: skip
    """Prove again, from a certificate's numbers alone, the probability that it claims.

    The claim names the disturbances that its engine covers, and every assumption that the proof rests on: these are
    derived from the proof, whatever the file's own list says.

    Parameters
    ----------
    data : mapping
        The certificate, as `certbound.checker.reading.parse` returns it.
    problem : mapping, optional
        The ``problem`` part that the certificate must speak of, up to names for humans and the order of operations.
    seconds : float
        Limit on the work, counted before it is done in seconds of a usual machine, and on the time.
    allow_assumptions : bool
        Whether ``valid`` is True also for what was proved under assumptions.

    Returns
    -------
    Report
        ``valid`` is False where an inequality was not proved, the certificate speaks of another problem, or the proof
        rests on assumptions that are not allowed; ``outcome`` tells these apart.

    Raises
    ------
    CertificateError
        If the data are malformed, or ``claim.method`` is not the proof's engine.
    """
    budget = Budget(seconds)
    record = Record(data, "certificate", ("format", "version", "claim", "problem", "proof"), ("notes",))
    if record["format"] != FORMAT:
        raise CertificateError(f"`certificate.format` must be \"{FORMAT}\".")
    if record["version"] != VERSION:
        raise CertificateError(f"`certificate.version` must be {VERSION}; use the certbound that wrote the file.")
    stated = Record(record["claim"], "claim", ("log10_delta", "method", "assumptions"), ("log10_lower",))
    method, level, least = stated.text("method", 100), *_levels(stated)
    named = [text(item, "claim.assumptions", 1000) for item in stated.items("assumptions", 0, 20)]
    with ctx.workprec(PRECISION):
        try:
            model = read_model(record["problem"], budget)
        except Unproved as error:
            raise CertificateError(f"`problem` cannot be read: {error}.") from error
        proof = record["proof"]
        engine_of(proof, method)
        answer, proved = partial(_report, claim=_UNREAD, level=level, least=least, assumed=()), None
        try:
            assumed = tuple(assumptions(model, proof, named))
            check_side(model, proof, least is not None)
            difference = "" if problem is None else first_difference(record["problem"], problem)
            if problem is not None and not difference:
                model = model.named_as(problem)
            words = claim(model, proof, level, assumed) if least is None else claim_below(model, least, assumed)
            answer = partial(_report, claim=words, level=level, least=least, assumed=assumed)
            if difference:
                raise Unproved(f"the certificate speaks of another problem: {shortened(difference, 200)}")
            proved = prove(model, proof, budget, lower=least is not None)
            (_compare if least is None else _compare_below)(proved, level if least is None else least)
        except Unproved as error:
            return answer(valid=False, reason=f"{error}.", seconds=budget.elapsed, found=proved)
        reason = _reason(words_of(model, proof), proved, least is not None, problem is not None, assumed)
        return answer(valid=allow_assumptions or not assumed, reason=reason, seconds=budget.elapsed, found=proved,
                      proved=True)  # fmt: skip


def find_difference(data: Mapping[str, Any], problem: Mapping[str, Any], *, seconds: float = SECONDS) -> str:
    """Where a certificate's problem differs first from another one, in words; empty where they are the same.

    Nothing is proved. Names for humans, the order of operations and ``delta``, which no bound depends on, do not count.

    Parameters
    ----------
    data : mapping
        The certificate, as `certbound.checker.reading.parse` returns it.
    problem : mapping
        The ``problem`` part of another certificate.
    seconds : float
        Limit on the work, as `check_data` has it.

    Raises
    ------
    CertificateError
        If the certificate states no problem, or one that is malformed.
    """
    if "problem" not in data:
        raise CertificateError("the certificate states no problem; give the file of verify --certificate.")
    mine = data["problem"]
    with ctx.workprec(PRECISION):
        try:
            read_model(mine, Budget(seconds))
        except Unproved as error:
            raise CertificateError(f"`problem` cannot be read: {error}.") from error
    return shortened(first_difference(mine, {**problem, "delta": mine["delta"]}), 200)


def _levels(stated: Record) -> tuple[float, float | None]:
    """The claimed upper bound, and the lower one of a certificate that claims one, and then nothing else."""
    level = stated.number("log10_delta")
    if not level <= 0:
        raise CertificateError(f"`claim.log10_delta` must not be positive, got {level:g}.")
    if stated["log10_lower"] is None:
        return level, None
    least = stated.number("log10_lower")
    if not least <= 0:
        raise CertificateError(f"`claim.log10_lower` must not be positive, got {least:g}.")
    if level != 0:
        raise CertificateError(f"`claim.log10_delta` must be 0 where a lower bound is claimed, got {level:g}.")
    return level, least


def _report(
    *, valid: bool, reason: str, seconds: float, found: arb | None, claim: str, level: float, least: float | None,
    assumed: tuple[str, ...], proved: bool = False,
) -> Report:  # fmt: skip
    """The answer, with what the checker arrived at."""
    most = None if found is None or least is not None else _log10(found)
    return Report(
        valid=valid, reason=reason, seconds=seconds, claim=claim, log10_delta=level, log10_lower=least,
        assumptions=assumed, proved=proved, log10_proved=most,
        log10_lower_proved=None if found is None or least is None else _log10_below(found),
    )  # fmt: skip


def _compare(proved: arb, level: float) -> None:
    if proved.is_zero() or proved.log() <= arb(level) * arb(10).log():
        return
    found, claimed = _log10(proved), f"which is more than the claimed 10^{plainly(level)}"
    if found >= 0:
        raise Unproved(f"what follows is no bound below 1, {claimed}")
    raise Unproved(f"the probability that follows is at most 10^{rounded(found, up=True)}, {claimed}")


def _compare_below(proved: arb, level: float) -> None:
    if proved > 0 and proved.log() >= arb(level) * arb(10).log():
        return
    found, claimed = _log10_below(proved), f"which is less than the claimed 10^{plainly(level)}"
    if found is None:
        raise Unproved(f"what follows is no bound above 0, {claimed}")
    raise Unproved(f"the probability that follows is at least 10^{rounded(found, up=False)}, {claimed}")


def _log10(value: arb) -> float:
    """log10 rounded up; -1e12 stands for 0."""
    if value.is_zero():
        return -1e12
    top = (value.log() / arb(10).log()).upper()
    return min(math.nextafter(float(top), math.inf), 0.0) if top.is_finite() else 0.0


def _log10_below(value: arb) -> float | None:
    """log10 rounded down; None of what may be 0."""
    if not value > 0:
        return None
    if value >= 1:
        return 0.0
    return min(math.nextafter(float((value.log() / arb(10).log()).lower()), -math.inf), 0.0)


def _reason(engines: str, proved: arb, lower: bool, compared: bool, assumed: Sequence[str]) -> str:
    same = ", and the certificate speaks of the given problem" if compared else ""
    least = _log10_below(proved) if lower else None
    if least is not None:
        bound = f"the probability is at least 10^{rounded(least, up=False)}"
    else:
        most = _log10(proved)
        found = f"the probability is at most 10^{rounded(most, up=True)}"
        bound = "no noise can break them" if most <= -1e12 else found
    but = "but what the claim assumes " if assumed else ""
    return f"every inequality {but}was proved again in ball arithmetic, by {engines}: {bound}{same}"
