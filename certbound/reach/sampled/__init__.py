"""Reach sets from samples: statistical statements, no proofs."""

from __future__ import annotations

from certbound.reach.sampled.boxes import estimate_reach
from certbound.reach.sampled.classifier import estimate_reach_by_classifier

__all__ = ["estimate_reach", "estimate_reach_by_classifier"]
