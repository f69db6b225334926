"""Noise-free trajectories: the closed loop as it is read, Taylor series, curves, cells of the start."""

from __future__ import annotations

from certbound.reach.nominal.cells import Cells, initial_cells
from certbound.reach.nominal.curve import Curve
from certbound.reach.nominal.flow import Flow
from certbound.reach.nominal.integration import bound_defect, bound_disturbance_slope, nominal_curve
from certbound.reach.nominal.series import expand, polynomial_range, taylor_bounds
from certbound.rigor.series import Series

__all__ = [
    "bound_defect",
    "bound_disturbance_slope",
    "Cells",
    "Curve",
    "expand",
    "Flow",
    "initial_cells",
    "nominal_curve",
    "polynomial_range",
    "Series",
    "taylor_bounds",
]
