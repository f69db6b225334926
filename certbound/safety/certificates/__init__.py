"""Proofs as data: one writer for each engine."""

from __future__ import annotations

from certbound.safety.certificates.barrier import barrier_proof
from certbound.safety.certificates.carried_values import backward_proof, backward_proof_below
from certbound.safety.certificates.constants import constants_proof
from certbound.safety.certificates.diffusion import response_proof
from certbound.safety.certificates.exact_law import law_proof
from certbound.safety.certificates.quadratic import quadratic_proof
from certbound.safety.certificates.turned_proofs import of_coordinates
from certbound.safety.certificates.values import values_proof, values_proof_below

__all__ = [
    "backward_proof",
    "backward_proof_below",
    "barrier_proof",
    "constants_proof",
    "law_proof",
    "of_coordinates",
    "quadratic_proof",
    "response_proof",
    "values_proof",
    "values_proof_below",
]
