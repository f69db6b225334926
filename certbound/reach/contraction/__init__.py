"""Reach tubes by contraction: one constant everywhere, or constants along the tube."""

from __future__ import annotations

from certbound.reach.contraction.local import (
    local_constants,
    local_contraction_tube,
    local_tube,
    needed_radius,
    radius_over_pieces,
    random_start,
)
from certbound.reach.contraction.uniform import (
    bound_forcing,
    contraction_tube,
    integrate_radius,
    jump_sizes,
    values_on_pieces,
)

__all__ = [
    "bound_forcing",
    "contraction_tube",
    "integrate_radius",
    "jump_sizes",
    "local_constants",
    "local_contraction_tube",
    "local_tube",
    "needed_radius",
    "radius_over_pieces",
    "random_start",
    "values_on_pieces",
]
