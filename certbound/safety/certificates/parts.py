"""What every writer of a proof needs: its shape, exact numbers, and which constraints ask for a direction."""

from __future__ import annotations

from typing import Any

import numpy as np

from certbound.errors import CertificateError
from certbound.problem.sets import Inside

__all__ = ["Proof", "exact", "needs_direction"]

Proof = tuple[dict[str, Any], float, list[str]]
"""The proof's data, the claimed log10 of the probability, and what is assumed."""


def exact(value: Any) -> Any:
    """Floats as hexadecimal strings, arrays as nested lists of them."""
    if isinstance(value, (float, np.floating)):
        if not np.isfinite(value):
            raise CertificateError(f"the proof holds the number {value}, which no certificate can state.")
        return float(value).hex()
    if isinstance(value, np.ndarray):
        return exact(value.tolist())
    if isinstance(value, (list, tuple)):
        return [exact(item) for item in value]
    return value


def needs_direction(constraint: Inside) -> bool:
    """Whether the proof names a direction that keeps the obstacle off, piece by piece."""
    return constraint.outside and constraint.region.kind != "halfspace"
