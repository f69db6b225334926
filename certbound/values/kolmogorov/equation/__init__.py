"""The backward equation, its grids and its sources in floats: nothing here is trusted."""

from __future__ import annotations

from certbound.values.kolmogorov.equation.changing import ChangingEquation
from certbound.values.kolmogorov.equation.knots import growing_steps, knots_of, time_steps
from certbound.values.kolmogorov.equation.mesh import DEEP, Mesh, mesh_of, ramp
from certbound.values.kolmogorov.equation.solve import ABOUT
from certbound.values.kolmogorov.equation.sources import BREADTHS, Breadth, at_knots, at_nodes

__all__ = [
    "ABOUT", "BREADTHS", "DEEP", "Breadth", "ChangingEquation", "Mesh", "at_knots", "at_nodes", "growing_steps",
    "knots_of", "mesh_of", "ramp", "time_steps",
]  # fmt: skip
