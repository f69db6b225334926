"""Reach tubes, and what constraints leave of room around them."""

from __future__ import annotations

from certbound.reach.sets.clearance import constraint_clearance
from certbound.reach.sets.directions import NominalPieces, Requirement, limit_names, requirements
from certbound.reach.sets.reach_tube import ReachTube
from certbound.reach.sets.separation import polyhedral_weights, round_directions

__all__ = [
    "constraint_clearance",
    "limit_names",
    "NominalPieces",
    "polyhedral_weights",
    "ReachTube",
    "Requirement",
    "requirements",
    "round_directions",
]
