"""Two states: V on a tensor grid, proposed for both sides and proved by `hypotheses`.

From the bottom: ``plane_grids``, ``solver``, ``plane_proposal``, ``plane_below``, ``two_sides``.
"""

from certbound.values.continuous.plane.plane_grids import Plan, Plane, Source, slab_times, spread_nodes
from certbound.values.continuous.plane.solver import Solver, integrated, solve_lines
from certbound.values.continuous.plane.two_sides import bound_plane_above, chart_plane, rough_level, two_states

__all__ = [
    "Plan", "Plane", "Solver", "Source", "bound_plane_above", "chart_plane", "integrated", "rough_level", "slab_times",
    "solve_lines", "spread_nodes", "two_states",
]
