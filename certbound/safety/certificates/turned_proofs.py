"""Proofs in other coordinates as data: T, its inverse, and what was proved of the problem in y = T x."""

from __future__ import annotations

from functools import wraps

from certbound.problem.problem import Problem
from certbound.safety.answers import EngineAnswer, Proof, exact
from certbound.safety.certificates.parts import Writer
from certbound.safety.engines import Turned


def of_coordinates(write: Writer, *, below: bool = False) -> Writer:
    """A writer for answers that were proved in other coordinates too; their lower bounds are of the plain problem."""

    @wraps(write)
    def written(problem: Problem, answer: EngineAnswer, attempt: int = 0) -> Proof:
        found = answer.details
        if not isinstance(found, Turned):
            return write(problem, answer, attempt)
        if below:
            return write(problem, found.plain, attempt)
        proof, log10, assumptions = write(found.problem, found.answer, attempt)
        turn = {"matrix": exact(found.matrix), "inverse": exact(found.inverse)}
        return {"engine": "coordinates", **turn, "proof": proof}, log10, assumptions

    return written
