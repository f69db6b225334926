"""Sets of states, the constraints made of them, random starts, and distances to them."""

from __future__ import annotations

from certbound.problem.sets.constraints import GaussianStart, Inside, Outside, Reach
from certbound.problem.sets.distances import clearance
from certbound.problem.sets.forms import Faces, Quadratic, Region
from certbound.problem.sets.initial import check_start, check_target
from certbound.problem.sets.moving import check_over_time, entries_of, shifted, stacked
from certbound.problem.sets.polytopes import intersection, polygon
from certbound.problem.sets.regions import Ball, Box, Ellipsoid, HalfSpace, Polytope
from certbound.problem.sets.unions import StartUnion

__all__ = [
    "Ball",
    "Box",
    "check_over_time",
    "check_start",
    "check_target",
    "clearance",
    "Ellipsoid",
    "entries_of",
    "Faces",
    "GaussianStart",
    "HalfSpace",
    "Inside",
    "intersection",
    "Outside",
    "polygon",
    "Polytope",
    "Quadratic",
    "Reach",
    "Region",
    "shifted",
    "stacked",
    "StartUnion",
]
