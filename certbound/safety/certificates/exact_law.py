"""The proof by the exact law of an affine model as data: pieces of time, of which the checker makes its own bound."""

from __future__ import annotations

from certbound.errors import CertificateError
from certbound.problem.problem import Problem
from certbound.reach.affine import affine_pieces
from certbound.safety.answers import Proof, exact

_NEAR = (0.02, 0.004, 0.1)
"""What enclosures over pieces may add to the bound, as a part of it, at each attempt; the last one is quick."""
_ROUNDING = 1e-6
"""By which the checker's log10 may exceed what was found in floats, relative to 1 + its size."""
_WINDOWED = 0.004
"""The same where there are windows: the checker's joint probabilities of two normals lie above the exact ones."""
_MOST_BITS = 3000
"""What the checker takes."""


def law_proof(problem: Problem, attempt: int = 0) -> Proof:
    """The exact law of an affine model as data, and about log10 of what the checker proves of it.

    CertificateError where the problem is no affine model in continuous time with additive noise and fixed half-spaces,
    or where nothing is left for the noise.
    """
    found = affine_pieces(problem, _NEAR[min(attempt, len(_NEAR) - 1)])
    if found is None:
        raise CertificateError(
            "no certificate states the exact law of this problem: it takes a linear model in continuous time with "
            "constant coefficients, additive noise, a finite horizon, no target, and limits that are fixed half-spaces."
        )
    log10 = found.log10_delta
    if log10 >= 0:
        raise CertificateError("no certificate states the exact law of this problem: failing is too likely for a sum.")
    stated, n = found.stated, problem.system.dimension
    proof = {
        "engine": "affine",
        "bits": min(found.bits << attempt, _MOST_BITS),
        "grids": [list(levels) for levels in stated.grids],
        "limits": [
            {"grid": limit.direction, "windows": None if counts is None else list(counts)}
            for limit, counts in zip(found.model.limits, stated.windows)
        ],
        **({} if stated.loss is None else {"loss": exact(stated.loss[:n])}),
    }
    room = _ROUNDING * (1 - log10) + _WINDOWED * any(counts is not None for counts in stated.windows)
    return proof, min(log10 + room, 0.0), []
