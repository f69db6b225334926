"""A plan for the whole horizon, the verdict on it, or why there is none."""

from __future__ import annotations

from certbound.synthesis.plans.mpc import synthesize_plan
from certbound.synthesis.plans.outcome import Synthesis

__all__ = ["Synthesis", "synthesize_plan"]
