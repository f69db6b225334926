"""Two states in their plane: obstacles with their eroded bands, tubes, nominal, sample paths."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from certbound.arrays import Array
from certbound.plotting.scene import GREY, INK, RIM, VERMILION, YELLOW, Scene
from certbound.problem.sets import Inside, Quadratic, Region

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from certbound.problem.problem import Problem
    from certbound.reach.sets import ReachTube

Plane = tuple[int, int]

DIRECTIONS = 32
OUTLINES = 160


def plane_of(problem: Problem) -> Plane | None:
    """The two states that a constraint lives in, or the only two states of a planar system."""
    for constraint in problem.safe:
        coordinates = constraint.region.coordinates
        if coordinates is not None and len(coordinates) == 2:
            return int(coordinates[0]), int(coordinates[1])
    return (0, 1) if problem.system.dimension == 2 else None


def draw_plane(axes: Axes, scene: Scene, plane: Plane) -> None:
    """Everything that shows in the plane of two states."""
    from matplotlib.collections import LineCollection, PolyCollection

    for order, (tube, color) in enumerate(scene.tubes):
        shapes = PolyCollection(list(outlines(tube, plane)), facecolors=color, edgecolors=color, linewidths=0.3)
        shapes.set_zorder(1 + order)
        axes.add_collection(shapes)
    if scene.paths is not None:
        segments = list(scene.paths[..., list(plane)])
        axes.add_collection(LineCollection(segments, colors=GREY, linewidths=0.4, alpha=0.5, zorder=3))
    axes.plot(*scene.nominal()[1][:, list(plane)].T, color=INK, linewidth=1.2, zorder=5)
    axes.autoscale_view()
    limits = _limits(scene.problem, plane, (*axes.get_xlim(), *axes.get_ylim()))
    for constraint in scene.problem.safe:
        if lives_in(constraint.region, plane):
            draw_set(axes, constraint, plane, limits, _band(scene, constraint, plane))
    names = scene.problem.system.states
    axes.set(xlim=limits[:2], ylim=limits[2:], xlabel=names[plane[0]], ylabel=names[plane[1]])
    if any(c.region.form.even and lives_in(c.region, plane) for c in scene.problem.safe):
        axes.set_aspect("equal", adjustable="box")


def supports(tube: ReachTube, direction: Array) -> Array:
    """max a.x over the tube on each piece, over all cells: shape (K,)."""
    from certbound.reach.nominal import polynomial_range
    from certbound.rigor.intervals import Interval

    coefficients = tube.curve.coefficients
    along = [Interval.point(coefficients[:, :, j] @ direction) for j in range(coefficients.shape[2])]
    centre = polynomial_range(along, tube.curve.span)
    return np.asarray(np.max(np.asarray(centre.hi) + tube.spread(direction), axis=0))


def outlines(tube: ReachTube, plane: Plane) -> Array:
    """Polygons around the tube's projections on a plane, shape (pieces, corners, 2)."""
    angles = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    heights = np.stack([supports(tube, _row(tube, plane, angle)) for angle in angles])
    chosen = np.unique(np.linspace(0, tube.curve.pieces - 1, OUTLINES).astype(int))
    here, following = heights[:, chosen], np.roll(heights, -1, axis=0)[:, chosen]
    turn = 2 * np.pi / DIRECTIONS
    along = (following - here * np.cos(turn)) / np.sin(turn)
    c, s = np.cos(angles)[:, None], np.sin(angles)[:, None]
    return np.swapaxes(np.stack([here * c - along * s, here * s + along * c], axis=-1), 0, 1)


def _row(tube: ReachTube, plane: Plane, angle: float) -> Array:
    row = np.zeros(tube.curve.dimension)
    row[plane[0]], row[plane[1]] = np.cos(angle), np.sin(angle)
    return row


def lives_in(region: Region, plane: Plane) -> bool:
    coordinates = set(region.places(region.dimension))
    return coordinates == set(plane) or (region.form.axial and bool(coordinates & set(plane)))


def _limits(problem: Problem, plane: Plane, limits: tuple[float, ...]) -> tuple[float, ...]:
    """The picture's frame, grown so that every round obstacle is in it."""
    left, right, bottom, top = limits
    for constraint in problem.safe:
        region = constraint.region
        if constraint.outside and isinstance(region.form, Quadratic) and region.form.even and lives_in(region, plane):
            x, y = region.center_at(0.0)
            grown = 1.25 * region.form.radius
            left, right = min(left, x - grown), max(right, x + grown)
            bottom, top = min(bottom, y - grown), max(top, y + grown)
    return left, right, bottom, top


def draw_set(axes: Axes, constraint: Inside, plane: Plane, limits: tuple[float, ...], band: float) -> None:
    """An obstacle with the band that the noise adds to it, or the border of where the state must stay."""
    from matplotlib.patches import Circle, Polygon

    region, obstacle = constraint.region, constraint.outside
    centre = region.center_at(constraint.during[0] if constraint.during else 0.0)
    solid = {"facecolor": VERMILION, "edgecolor": RIM, "hatch": "////", "linewidth": 0.6, "zorder": 0.5}
    border = {"fill": False, "edgecolor": VERMILION, "linestyle": (0, (5, 2)), "linewidth": 1.2, "zorder": 6}
    style: dict[str, Any] = solid if obstacle else border
    if isinstance(region.form, Quadratic) and region.form.even:
        axes.add_patch(Circle(tuple(centre), region.form.radius, **style))
        if band > 0:
            radius = region.form.radius + (band if obstacle else -band)
            axes.add_patch(Circle(tuple(centre), radius, facecolor=YELLOW, alpha=0.6, zorder=0.2, fill=obstacle))
        return
    corners = _corners(region, centre, plane, limits)
    if len(corners):
        axes.add_patch(Polygon(corners, closed=True, **style))


def _corners(region: Region, centre: Array, plane: Plane, limits: tuple[float, ...]) -> Array:
    """Outline of a set about its centre, cut to a little more than the picture; empty where it is not in it."""
    if isinstance(region.form, Quadratic):
        angles = np.linspace(0, 2 * np.pi, 90)
        circle = region.form.radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        return np.asarray(centre + circle @ np.linalg.cholesky(region.form.shape).T)
    left, right, bottom, top = limits
    width, height = right - left, top - bottom
    ends = [(left - width, right + width), (bottom - height, top + height)]
    corners = np.array([[ends[0][i], ends[1][j]] for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))])
    rows = region.lifted(region.form.normals, max(*plane, *region.places(region.dimension)) + 1)[:, list(plane)]
    for row, bound in zip(rows, region.form.bounds + region.form.normals @ centre):
        if np.any(row):
            corners = _cut(corners, row, float(bound))
    return corners


def _cut(corners: Array, row: Array, bound: float) -> Array:
    """The part of a convex polygon with row . x <= bound."""
    kept: list[Array] = []
    over = corners @ row - bound
    for k in range(len(corners)):
        here, following = k, (k + 1) % len(corners)
        if over[here] <= 0:
            kept.append(corners[here])
        if over[here] * over[following] < 0:
            share = over[here] / (over[here] - over[following])
            kept.append(corners[here] + share * (corners[following] - corners[here]))
    return np.array(kept).reshape(-1, 2)


def _band(scene: Scene, constraint: Inside, plane: Plane) -> float:
    """The largest stochastic deviation in the plane: how far a round obstacle is grown in the picture."""
    if scene.tube is None or not constraint.region.form.even:
        return 0.0
    rows = [_row(scene.reach, plane, angle) for angle in np.linspace(0, 2 * np.pi, 16, endpoint=False)]
    width = max(float(np.max(supports(scene.tube, row) - supports(scene.reach, row))) for row in rows)
    return max(width, 0.0)
