"""Exit probabilities of the radial process itself, bounded rigorously, and the tubes that follow."""

from __future__ import annotations

from certbound.tubes.exact.almost_sure import AlmostSureProfile
from certbound.tubes.exact.first_passage import bound_exact_exit, bound_worst_exit, first_passage_tube

__all__ = ["AlmostSureProfile", "bound_exact_exit", "bound_worst_exit", "first_passage_tube"]
