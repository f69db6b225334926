"""Two states: V on a tensor grid, proposed for both sides and proved by `hypotheses`.

From the bottom: ``plane_grids``, ``solver``, ``plane_proposal``, ``monotone``, ``plane_below``, ``two_sides``; then
``target_proposal``, ``plane_targets`` for targets, ``stages``, ``later``, ``plane_windows``
for windows, and ``frames`` for limits that move.
"""

from certbound.values.continuous.plane.frames import bound_moving, moving
from certbound.values.continuous.plane.plane_grids import Pair, Plan, Plane, Source, slab_times, spread_nodes
from certbound.values.continuous.plane.plane_reach import Floats, floats_of, led, plane_of, reach_of
from certbound.values.continuous.plane.plane_targets import bound_failing
from certbound.values.continuous.plane.plane_windows import bound_windows
from certbound.values.continuous.plane.solver import Solver, integrated, solve_lines
from certbound.values.continuous.plane.stages import windowed
from certbound.values.continuous.plane.target_proposal import bent, sides_of
from certbound.values.continuous.plane.two_sides import (
    RATE,
    Found,
    Sketch,
    bound_box,
    bound_plane_above,
    chart_plane,
    confined,
    held_plane,
    plan_above,
    released,
    rough_level,
    two_states,
)

__all__ = [
    "Floats", "Found", "Pair", "Plan", "Plane", "RATE", "Sketch", "Solver", "Source", "bent", "bound_box",
    "bound_failing", "bound_moving", "bound_plane_above", "bound_windows", "chart_plane", "confined",
    "floats_of", "held_plane", "integrated", "led", "moving", "plan_above", "plane_of", "reach_of", "released",
    "rough_level", "sides_of", "slab_times", "solve_lines", "spread_nodes", "two_states", "windowed",
]
