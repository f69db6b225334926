"""Two coordinates, noise in one: supersolutions and subsolutions of the equation itself, for drifts with kinks.

From the bottom: ``spline_axes``, ``drift_cells`` (the drift, enclosed), ``residuals`` (compiled), ``ground`` (the
grid and the equation), ``marching`` (back from the horizon), ``sourced_exits`` (the door).
"""

from certbound.values.semilagrangian.sources.sourced_exits import bound_sourced_exits, kinked

__all__ = ["bound_sourced_exits", "kinked"]
