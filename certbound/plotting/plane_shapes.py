"""Sets in a plane as shapes of an interactive picture: obstacles with their bands, borders, targets, starts."""

from __future__ import annotations

from typing import Any

import numpy as np

from certbound.plotting.plane import Plane, corners_of, ends_of, grown_by, lives_in, order_in
from certbound.plotting.scene import EDGE, GREEN, INK, RIM, VERMILION, YELLOW
from certbound.problem.problem import Problem
from certbound.problem.sets import Inside, Quadratic, Region

Shape = dict[str, Any]

SOLID: Shape = {"fillcolor": VERMILION, "line": {"color": RIM, "width": 1}}
BAND: Shape = {"fillcolor": YELLOW, "opacity": 0.6, "line": {"width": 0}, "layer": "below"}
BORDER: Shape = {"line": {"color": VERMILION, "width": 2, "dash": "dash"}}
INSET: Shape = {"line": {"color": EDGE, "width": 1, "dash": "dot"}}
TARGET: Shape = {"fillcolor": GREEN, "opacity": 0.3, "line": {"color": GREEN, "width": 1}, "layer": "below"}


def shapes_of(
    problem: Problem, plane: Plane, limits: tuple[float, ...], bands: dict[int, float] | None = None
) -> list[Shape]:
    """Every set that can be drawn in the plane, with bands of the given widths by the constraints' numbers."""
    shapes: list[Shape] = []
    for number, constraint in enumerate(problem.safe):
        if not lives_in(constraint.at_first().region, plane):
            continue
        band = (bands or {}).get(number, 0.0)
        wider = grown_by(constraint.region, band if constraint.outside else -band) if band > 0 else None
        if wider is not None:
            shapes += _shape(constraint, wider, plane, limits, BAND if constraint.outside else INSET)
        shapes += _shape(constraint, constraint.region, plane, limits, SOLID if constraint.outside else BORDER)
    if problem.reach is not None and lives_in(problem.reach.at_first().region, plane):
        shapes += _shape(problem.reach, problem.reach.region, plane, limits, TARGET)
    return [*shapes, *_starts(problem, plane)]


def _shape(
    constraint: Inside, region: Region, plane: Plane, limits: tuple[float, ...], style: Shape
) -> list[Shape]:
    region = region.at(constraint.during[0] if constraint.during else 0.0)
    centre = region.center_at()
    if isinstance(region.form, Quadratic) and region.form.even:
        (x, y), r = centre[order_in(region, plane)].tolist(), region.form.radius
        return [{"type": "circle", "x0": x - r, "x1": x + r, "y0": y - r, "y1": y + r, **style}]
    corners = corners_of(region, centre, plane, limits)
    path = "L".join(f"{x:.5g},{y:.5g}" for x, y in corners)
    return [{"type": "path", "path": f"M{path}Z", **style}] if len(corners) else []


def _starts(problem: Problem, plane: Plane) -> list[Shape]:
    """Boxes around the stated starts as frames; of points and random ones nothing."""
    shapes = []
    for start in problem.starts:
        low, high = (end[list(plane)] for end in ends_of(start))
        if np.any(high > low):
            (x0, y0), (x1, y1) = low.tolist(), high.tolist()
            shapes.append({"type": "rect", "x0": x0, "x1": x1, "y0": y0, "y1": y1, "line": {"color": INK, "width": 2}})
    return shapes
