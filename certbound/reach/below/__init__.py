"""Lower bounds of the probability of failing, for any number of states."""

from __future__ import annotations

from certbound.reach.below.failing import least_failing, least_failing_of

__all__ = ["least_failing", "least_failing_of"]
