"""Proofs in other coordinates as data: T, its inverse, what was proved for y = T x, and limits that add up."""

from __future__ import annotations

from functools import wraps

from certbound.errors import CertificateError
from certbound.problem.problem import Problem
from certbound.safety.answers import EngineAnswer, Proof, exact
from certbound.safety.certificates.parts import Writer
from certbound.safety.engines import Apart, Logarithmic, Turned, log10_sum


def of_coordinates(write: Writer, *, beside: Writer | None = None, below: bool = False) -> Writer:
    """A writer for answers that were proved in other coordinates too; their lower bounds are of the plain problem.

    ``beside`` writes what was proved of limits by themselves.
    """

    @wraps(write)
    def written(problem: Problem, answer: EngineAnswer, attempt: int = 0) -> Proof:
        found = answer.details
        if isinstance(found, Logarithmic):
            if below:
                return written(problem, found.plain, attempt)
            if isinstance(found.answer.details, Apart):
                raise CertificateError("limits that were taken apart in logarithms have no certificate.")
            proof, log10, assumptions = written(found.problem, found.answer, attempt)
            return {"engine": "logarithms", "states": list(found.places), "proof": proof}, log10, assumptions
        if not isinstance(found, Turned | Apart):
            return write(problem, answer, attempt)
        if below:
            return write(problem, found.plain, attempt)
        if isinstance(found, Apart):
            writers: tuple[Writer, Writer] = (written, beside or write)
            proofs = [one(asked, own, attempt) for one, (_, asked, own) in zip(writers, found.parts)]
            parts = [{"limits": list(part[0]), "proof": proof[0]} for part, proof in zip(found.parts, proofs)]
            assumed = list(dict.fromkeys(item for *_, own in proofs for item in own))
            return {"engine": "limits", "parts": parts}, log10_sum([log10 for _, log10, _ in proofs]), assumed
        proof, log10, assumptions = write(found.problem, found.answer, attempt)
        turn = {"matrix": exact(found.matrix), "inverse": exact(found.inverse)}
        return {"engine": "coordinates", **turn, "proof": proof}, log10, assumptions

    return written
