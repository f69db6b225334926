"""Semidefinite programs that propose metrics; what they propose is certified elsewhere."""

from __future__ import annotations

from certbound.constants.programs.centers import center_multipliers
from certbound.constants.programs.erosion_search import ErosionSearch
from certbound.constants.programs.least_erosion import RadiusModel, Rooms, erosion_factors
from certbound.constants.programs.lmi import design_feedback, solve
from certbound.constants.programs.proposals import Proposal, rate_proposals, sampled_polytope
from certbound.constants.programs.sectors import centred, varying
from certbound.constants.programs.targets import constraint_targets, cut_rooms, rooms_of, stated_rooms

__all__ = [
    "center_multipliers",
    "centred",
    "constraint_targets",
    "cut_rooms",
    "design_feedback",
    "erosion_factors",
    "ErosionSearch",
    "Proposal",
    "RadiusModel",
    "rate_proposals",
    "Rooms",
    "rooms_of",
    "sampled_polytope",
    "solve",
    "stated_rooms",
    "varying",
]
