"""Lower bounds of the probability of failing, for any number of states."""

from __future__ import annotations

from certbound.reach.below.bound import LeastFailing, least_failing

__all__ = ["LeastFailing", "least_failing"]
