"""Two states in their plane: obstacles with their eroded bands, tubes, nominal, sample paths."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from certbound.arrays import Array
from certbound.plotting.certified import supports
from certbound.plotting.scene import EDGE, GREEN, GREY, INK, RIM, VERMILION, YELLOW, Scene
from certbound.problem.sets import Faces, Inside, Quadratic, Region

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from certbound.problem.problem import Problem
    from certbound.reach.sets import ReachTube

Plane = tuple[int, int]

DIRECTIONS = 32
OUTLINES = 160


def plane_of(problem: Problem) -> Plane | None:
    """The two states that a constraint asks about, or the only two states of a planar system.

    A single half-space asks for a panel over time, not for a plane.
    """
    for constraint in sorted(problem.safe, key=lambda one: not one.outside):  # obstacles first
        region = constraint.at_first().region
        asked, form = asked_of(region), region.form
        if len(asked) == 2 and not (isinstance(form, Faces) and len(form.bounds) == 1):
            return asked[0], asked[1]
    return (0, 1) if problem.system.dimension == 2 else None


def asked_of(region: Region) -> list[int]:
    """The states that a region asks about: those of its faces' normals, or that a quadratic form lives in."""
    places = region.places(region.dimension)
    if isinstance(region.form, Faces):
        return [places[k] for k in np.flatnonzero(np.any(region.form.normals != 0, axis=0))]
    return places


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
    _draw_starts(axes, scene.problem, plane)
    axes.autoscale_view()
    limits = frame_of(scene.problem, plane, (*axes.get_xlim(), *axes.get_ylim()))
    for constraint in scene.problem.safe:
        if lives_in(constraint.at_first().region, plane):
            band = band_of(scene, constraint, plane)
            draw_set(axes, constraint, plane, limits, band, horizon=float(scene.problem.horizon))
    target = scene.problem.reach
    if target is not None and lives_in(target.at_first().region, plane):
        draw_set(axes, target, plane, limits, style=TARGET)
    names = [scene.problem.axis(name) for name in scene.problem.system.states]
    axes.set(xlim=limits[:2], ylim=limits[2:], xlabel=names[plane[0]], ylabel=names[plane[1]])
    if any(c.region.form.even and lives_in(c.region, plane) for c in (one.at_first() for one in scene.problem.safe)):
        axes.set_aspect("equal", adjustable="box")


def _draw_starts(axes: Axes, problem: Problem, plane: Plane) -> None:
    """A frame around where the state starts; a cross where that is a point or random."""
    from matplotlib.patches import Rectangle

    for start in problem.starts:
        low, high = ends_of(start)
        corner, size = low[list(plane)], (high - low)[list(plane)]
        if np.any(size > 0):
            axes.add_patch(Rectangle(tuple(corner), *size, fill=False, edgecolor=INK, linewidth=0.8, zorder=6))
        else:
            axes.plot(*corner, marker="x", color=INK, markersize=4, markeredgewidth=1.0, zorder=6)


def ends_of(start: Any) -> tuple[Array, Array]:
    """Lowest and highest states of a start; of a random one its mean."""
    around = None if start.random else start.hull()
    return (start.mean, start.mean) if around is None else (around.lo, around.hi)


def outlines(tube: ReachTube, plane: Plane, pieces: Array | None = None) -> Array:
    """Polygons around the tube's projections on a plane, shape (pieces, corners, 2); of some pieces, where given."""
    angles = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    heights = np.stack([supports(tube, _row(tube, plane, angle)) for angle in angles])
    chosen = np.unique(np.linspace(0, tube.curve.pieces - 1, OUTLINES).astype(int)) if pieces is None else pieces
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
    """Whether a region can be drawn in a plane: it asks about both of its states, or is a box with sides in it."""
    asked = set(asked_of(region))
    return asked == set(plane) or (region.form.axial and bool(asked & set(plane)))


def frame_of(problem: Problem, plane: Plane, limits: tuple[float, ...]) -> tuple[float, ...]:
    """The picture's frame, grown so that every bounded set that lives in the plane alone is in it."""
    low, high = np.array(limits[::2]), np.array(limits[1::2])
    goal = () if problem.reach is None else (problem.reach,)
    for constraint in (*problem.safe, *goal):
        region = constraint.region
        if set(asked_of(constraint.at_first().region)) != set(plane):
            continue
        for t in constraint.during or (0.0, float(problem.horizon)):
            hull = region.at(t).hull()[np.array(order_in(region, plane))]
            size = hull.hi - hull.lo
            room = np.where(np.isfinite(size), np.minimum(0.12 * size, 0.5), 0.0)
            low = np.where(np.isfinite(hull.lo), np.minimum(low, hull.lo - room), low)
            high = np.where(np.isfinite(hull.hi), np.maximum(high, hull.hi + room), high)
    return low[0], high[0], low[1], high[1]


SOLID: dict[str, Any] = {"facecolor": VERMILION, "edgecolor": RIM, "hatch": "////", "linewidth": 0.6, "zorder": 0.5}
BORDER: dict[str, Any] = {
    "fill": False, "edgecolor": VERMILION, "linestyle": (0, (5, 2)), "linewidth": 1.2, "zorder": 6,
}  # fmt: skip
BAND: dict[str, Any] = {"facecolor": YELLOW, "alpha": 0.6, "zorder": 0.2}
INSET: dict[str, Any] = {"fill": False, "edgecolor": EDGE, "linestyle": (0, (1, 1.5)), "linewidth": 0.9, "zorder": 6}
TARGET: dict[str, Any] = {"facecolor": GREEN, "edgecolor": GREEN, "alpha": 0.3, "linewidth": 1.0, "zorder": 0.4}
GHOSTS = 4  # places at which a moving set is drawn again, faintly


def draw_set(
    axes: Axes, constraint: Inside, plane: Plane, limits: tuple[float, ...], band: float = 0.0, *,
    horizon: float = 0.0, style: dict[str, Any] | None = None,
) -> None:  # fmt: skip
    """An obstacle with the band that the noise adds to it, or the border of where the state must stay.

    What moves is drawn where it is when it is first asked, and faintly where it goes until the horizon.
    """
    region, obstacle = constraint.region, constraint.outside
    first, last = constraint.during or (0.0, horizon)
    style = style or (SOLID if obstacle else BORDER)
    if band > 0 and (grown := grown_by(region, band if obstacle else -band)) is not None:
        _outline(axes, grown, plane, first, limits, {**(BAND if obstacle else INSET)})
    _outline(axes, region, plane, first, limits, style)
    for t in np.linspace(first, last, GHOSTS + 1)[1:] if region.moving and last > first else ():
        _outline(axes, region, plane, float(t), limits, {**style, "alpha": 0.25})


def grown_by(region: Region, distance: float) -> Region | None:
    """The region moved outward; None for shapes that do not know how, or of which nothing is left."""
    try:
        return region.grown(distance)
    except ValueError:
        return None


def _outline(
    axes: Axes, region: Region, plane: Plane, t: float, limits: tuple[float, ...], style: dict[str, Any]
) -> None:
    from matplotlib.patches import Circle, Polygon

    region = region.at(t)
    centre = region.center_at()
    if isinstance(region.form, Quadratic) and region.form.even:
        axes.add_patch(Circle(tuple(centre[order_in(region, plane)]), region.form.radius, **style))
        return
    corners = corners_of(region, centre, plane, limits)
    if len(corners):
        axes.add_patch(Polygon(corners, closed=True, **style))


def order_in(region: Region, plane: Plane) -> list[int]:
    """Where the plane's two states are among the coordinates of a region that has both."""
    places = region.places(region.dimension)
    return [places.index(state) for state in plane]


def corners_of(region: Region, centre: Array, plane: Plane, limits: tuple[float, ...]) -> Array:
    """Outline of a set about its centre, cut to a little more than the picture; empty where it is not in it."""
    if isinstance(region.form, Quadratic):
        angles = np.linspace(0, 2 * np.pi, 90)
        circle = region.form.radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        return np.asarray((centre + circle @ np.linalg.cholesky(region.form.shape).T)[:, order_in(region, plane)])
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


def band_of(scene: Scene, constraint: Inside, plane: Plane) -> float:
    """The largest stochastic deviation in the plane: how far a set that lives in it is grown in the picture."""
    region = constraint.at_first().region
    if scene.tube is None or set(asked_of(region)) != set(plane):
        return 0.0
    assert scene.reach is not None
    rows = [_row(scene.reach, plane, angle) for angle in np.linspace(0, 2 * np.pi, 16, endpoint=False)]
    width = max(float(np.max(supports(scene.tube, row) - supports(scene.reach, row))) for row in rows)
    return max(width, 0.0)
