"""The backward equation and its sources in floats: nothing here is trusted."""

from __future__ import annotations

from certbound.values.kolmogorov.equation.changing import ChangingEquation
from certbound.values.kolmogorov.equation.ghost_nodes import Ghosts, ghosts_of
from certbound.values.kolmogorov.equation.solve import ABOUT, SOLVED, Discretised, discretised
from certbound.values.kolmogorov.equation.sources import BREADTHS, Breadth, at_knots, at_nodes

__all__ = [
    "ABOUT", "BREADTHS", "SOLVED", "Breadth", "ChangingEquation", "Discretised", "Ghosts", "at_knots", "at_nodes",
    "discretised", "ghosts_of",
]  # fmt: skip
