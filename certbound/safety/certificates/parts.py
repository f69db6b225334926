"""What writers of a proof share: which constraints ask for a direction."""

from __future__ import annotations

from certbound.problem.sets import Inside

__all__ = ["needs_direction"]


def needs_direction(constraint: Inside) -> bool:
    """Whether the proof names a direction that keeps the obstacle off, piece by piece."""
    return constraint.outside and constraint.region.kind != "halfspace"
