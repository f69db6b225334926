"""Checking a certificate: read it, prove every inequality again, say what was proved."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from typing import Any

from flint import arb, ctx

from certbound.checker.barrier import check_barrier
from certbound.checker.comparison import first_difference
from certbound.checker.constants import check_constants
from certbound.checker.linear import check_linear
from certbound.checker.model import Model, read_model
from certbound.checker.reading import Record, read, text
from certbound.checker.report import Budget, Report, Unproved
from certbound.checker.stopped import ASSUMPTION
from certbound.errors import CertificateError
from certbound.problem.tape import Tape

__all__ = ["SECONDS", "VERSION", "check_data", "check_file"]

FORMAT = "certbound certificate"
VERSION = 1
SECONDS = 300.0
"""Time that a check may take."""
PRECISION = 128

_ENGINES = {"linear": check_linear, "constants": check_constants, "barrier": check_barrier}
_WORDS = {
    "linear": "linear response (Thm K7)",
    "constants": "contraction constants (Thms K2, K5)",
    "barrier": "a barrier that is the exponential of a polynomial",
}


def check_file(
    path: str | os.PathLike[str], problem: Mapping[str, Any] | None = None, *, seconds: float = SECONDS
) -> Report:
    """Check the certificate in a file; see `check_data`."""
    return check_data(read(path), problem, seconds=seconds)


def check_data(
    data: Mapping[str, Any], problem: Mapping[str, Any] | None = None, *, seconds: float = SECONDS
) -> Report:
    """Prove again, from a certificate's numbers alone, the probability that it claims.

    Parameters
    ----------
    data : mapping
        The certificate, as `certbound.checker.reading.parse` returns it.
    problem : mapping, optional
        The ``problem`` part that the certificate must speak of, up to names for humans and the order of operations.
    seconds : float
        Time limit.

    Returns
    -------
    Report
        ``valid`` is False where an inequality was not proved, or the certificate speaks of another problem.

    Raises
    ------
    CertificateError
        If the data are malformed.
    """
    budget = Budget(seconds)
    record = Record(data, "certificate", ("format", "version", "claim", "problem", "proof"), ("notes",))
    if record["format"] != FORMAT:
        raise CertificateError(f"`certificate.format` must be \"{FORMAT}\".")
    if record["version"] != VERSION:
        raise CertificateError(f"`certificate.version` must be {VERSION}; use the certbound that wrote the file.")
    claim = Record(record["claim"], "claim", ("log10_delta", "method", "assumptions"))
    claim.text("method", 100)
    level = claim.number("log10_delta")
    if not level <= 0:
        raise CertificateError(f"`claim.log10_delta` must not be positive, got {level:g}.")
    named = [text(item, "claim.assumptions", 1000) for item in claim.items("assumptions", 0, 20)]
    with ctx.workprec(PRECISION):
        try:
            model = read_model(record["problem"], budget)
        except Unproved as error:
            raise CertificateError(f"`problem` cannot be read: {error}.") from error
        proof = record["proof"]
        if isinstance(proof, dict) and proof.get("assumed") is True:
            named.append("the stated constants hold")
        if isinstance(proof, dict) and proof.get("engine") == "linear" and isinstance(model.noise.diffusion, Tape):
            named.append(ASSUMPTION)
        words = _claim(model, level, named)
        proved = None
        try:
            if problem is not None:
                difference = first_difference(record["problem"], problem)
                if difference:
                    raise Unproved(f"the certificate speaks of another problem: {difference}")
            proved = _proved(model, record, named, budget)
            _compare(proved, level)
        except Unproved as error:
            return Report(
                valid=False, claim=words, reason=f"{error}.", seconds=budget.elapsed, log10_delta=level,
                log10_proved=None if proved is None else _log10(proved),
            )  # fmt: skip
        return Report(
            valid=True, claim=words, reason=_reason(record, _log10(proved), problem is not None),
            seconds=budget.elapsed, log10_delta=level, log10_proved=_log10(proved),
        )  # fmt: skip


def _proved(model: Model, record: Record, named: list[str], budget: Budget) -> arb:
    """The probability that the engine's proof bounds."""
    proof = record["proof"]
    engine = proof.get("engine") if isinstance(proof, dict) else None
    if not isinstance(engine, str) or engine not in _ENGINES:
        raise CertificateError(f"`proof.engine` must be one of {', '.join(_ENGINES)}.")
    return _ENGINES[engine](model, proof, budget)


def _compare(proved: arb, level: float) -> None:
    if not (proved.is_zero() or proved.log() <= arb(level) * arb(10).log()):
        raise Unproved(
            f"the probability that follows is at most 10^{_log10(proved):.6g}, which is more than the claimed "
            f"10^{level:.6g}"
        )


def _log10(value: arb) -> float:
    """log10 rounded up; -1e12 stands for 0."""
    if value.is_zero():
        return -1e12
    top = (value.log() / arb(10).log()).upper()
    return math.nextafter(float(top), math.inf) if top.is_finite() else 0.0


def _claim(model: Model, level: float, assumptions: list[str]) -> str:
    unit = "s" if model.continuous else "steps"
    start = "a normal start" if model.initial.covariance is not None else "every start in the initial set"
    also = ", whatever the disturbance does," if model.disturbance else ""
    safe = "at most" if arb(level) <= arb(model.delta).log() / arb(10).log() else "more than"
    words = (
        f"from {start}{also} {model.name} breaks one of its {len(model.constraints)} constraints within "
        f"{model.horizon:g} {unit} with probability at most 10^{level:.6g} ({safe} delta = {model.delta:g})"
    )
    return words + "".join(f"; assuming that {item}" for item in assumptions)


def _reason(record: Record, proved: float, compared: bool) -> str:
    words = _WORDS[record["proof"]["engine"]]
    same = ", and the certificate speaks of the given problem" if compared else ""
    bound = "no noise can break them" if proved <= -1e12 else f"the probability is at most 10^{proved:.6g}"
    return f"every inequality was proved again in ball arithmetic, by {words}: {bound}{same}"
