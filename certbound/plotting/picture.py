"""The whole picture: the plane of the obstacles, where there is one, and every constraint over time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from certbound.plotting.asked import Panel, panels_of
from certbound.plotting.certified import room_of
from certbound.plotting.panels import draw_panel
from certbound.plotting.plane import Plane, draw_plane, plane_of
from certbound.plotting.scene import BLUE, GREEN, GREY, INK, INNER, OUTER, RIM, VERMILION, YELLOW, Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PANELS = 12  # of a picture without a plane
BESIDE = 6  # with one
WIDE = 0.65  # height to width of a plan below which the panels are put under it


def draw_scene(scene: Scene) -> Figure:
    """Draw a scene in a figure that is not attached to pyplot; ``savefig`` works on it.

    Where there are more constraints than fit, those with the least certified room are shown.
    """
    import matplotlib as mpl

    plane = plane_of(scene.problem)
    every = panels_of(scene.problem)
    shown = tightest(scene, every, PANELS if plane is None else BESIDE)
    style: Any = {
        "font.size": 8,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "hatch.linewidth": 0.6,
    }
    with mpl.rc_context(style):
        if plane is None:
            figure, grid = _multiples(len(shown))
        else:
            figure, grid = _with_plan(scene, plane, len(shown))
        for axes, panel in zip(grid.flat, shown):
            draw_panel(axes, scene, panel)
        for axes in grid.flat[len(shown) :]:
            axes.set_visible(False)
        for column in range(grid.shape[1]):
            lowest = grid.flat[column + grid.shape[1] * ((len(shown) - 1 - column) // grid.shape[1])]
            lowest.tick_params(labelbottom=True)
            lowest.set_xlabel(scene.problem.time_axis)
        rest = len(every) - len(shown)
        words = f"  (the {len(shown)} constraints with the least room, of {len(every)})" if rest else ""
        figure.suptitle(scene.title + words, fontsize=9)
        figure.legend(handles=_legend(scene), loc="outside lower center", ncols=8, fontsize=7, frameon=False)
    return figure


def _multiples(count: int) -> tuple[Figure, Any]:
    """A figure and the axes of so many small multiples on one axis of time."""
    from matplotlib.figure import Figure

    columns = 1 if count == 1 else 2 if count <= 4 else 3 if count <= 9 else 4
    rows = -(-count // columns)
    width, height = {1: (6.4, 2.9), 2: (4.2, 2.2)}.get(columns, (3.1, 1.9))
    figure = Figure(figsize=(width * columns, height * rows + 0.9), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, sharex=True)


def _with_plan(scene: Scene, plane: Plane, count: int) -> tuple[Figure, Any]:
    """A figure with the plan drawn, and the axes of so many panels: beside it, or below where the plan is wide."""
    from matplotlib.figure import Figure

    trial = Figure().subplots()
    draw_plane(trial, scene, plane)
    share = float(np.diff(trial.get_ylim())[0] / np.diff(trial.get_xlim())[0]) if trial.get_aspect() == 1.0 else 1.0
    figure = Figure(layout="constrained")
    parts: Any
    plan: Axes
    if share < WIDE:
        columns = 2 if count in (2, 4) else min(count, 3)
        rows = -(-count // columns)
        heights = [8.8 * share + 0.5, 1.75 * rows]
        parts = figure.subfigures(2, 1, height_ratios=heights)
        figure.set_size_inches(9.6, sum(heights) + 0.6)
        plan = parts[0].subplots()
        grid = parts[1].subplots(rows, columns, squeeze=False, sharex=True)
    else:
        parts = figure.subfigures(1, 2, width_ratios=[1.15, 1])
        tall = 4.6 * share if trial.get_aspect() == 1.0 else 0.0
        figure.set_size_inches(9.6, float(np.clip(tall + 1.0, max(4.0, 1.3 * count + 0.6), 9.0)))
        plan = parts[0].subplots()
        grid = parts[1].subplots(count, 1, squeeze=False, sharex=True)
    draw_plane(plan, scene, plane)
    return figure, grid


def tightest(scene: Scene, panels: list[Panel], count: int) -> list[Panel]:
    """Of more panels than ``count`` those with the least certified room, in their order."""
    if len(panels) <= count:
        return panels
    rooms = [room_of(scene, panel) for panel in panels]
    least = np.array([0.0 if room is None else np.min(room) for room in rooms])
    return [panels[k] for k in sorted(np.argsort(least, kind="stable")[:count])]


def _legend(scene: Scene) -> list[Any]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    obstacles = any(constraint.outside for constraint in scene.problem.safe)
    handles: list[Any] = []
    if scene.reach is not None:
        handles.append(Line2D([], [], color=INK, linewidth=1.2, label="nominal"))
        handles.append(Patch(facecolor=INNER, label="noise-free"))
    if scene.tube is not None:
        handles.append(Patch(facecolor=OUTER, label="with noise"))
        handles.append(Line2D([], [], color=BLUE, linewidth=1.2, label="certified bound"))
    if scene.paths is not None:
        handles.append(Line2D([], [], color=GREY, linewidth=0.8, label=f"{len(scene.paths)} sample paths"))
    handles.append(Line2D([], [], color=VERMILION, linestyle=(0, (5, 2)), linewidth=1.2, label="limit"))
    if obstacles:
        handles.append(Patch(facecolor=VERMILION, hatch="////", edgecolor=RIM, label="obstacle"))
    if obstacles and scene.tube is not None:
        handles.append(Patch(facecolor=YELLOW, alpha=0.6, label="eroded"))
    if scene.problem.reach is not None:
        handles.append(Patch(facecolor=GREEN, alpha=0.3, label="target"))
    return handles
