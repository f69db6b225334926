"""The whole picture: the plane of the obstacles, where there is one, and every constraint over time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from certbound.plotting.panels import draw_panel, panels_of
from certbound.plotting.plane import draw_plane, plane_of
from certbound.plotting.scene import BLUE, GREY, INK, INNER, OUTER, RIM, VERMILION, YELLOW, Scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PANELS = 6


def draw_scene(scene: Scene) -> Figure:
    """Draw a scene in a figure that is not attached to pyplot; ``savefig`` works on it."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    plane = plane_of(scene.problem)
    every = panels_of(scene.problem)
    shown = every[:PANELS]
    style: Any = {
        "font.size": 8,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "hatch.linewidth": 0.6,
    }
    with mpl.rc_context(style):
        if plane is None:
            columns = min(2, len(shown))
            rows = -(-len(shown) // columns)
            figure = Figure(figsize=(4.2 * columns, 2.2 * rows + 0.9), layout="constrained")
            grid = figure.subplots(rows, columns, squeeze=False, sharex=True)
        else:
            figure = Figure(figsize=(9.6, max(4.8, 1.5 * len(shown) + 0.6)), layout="constrained")
            halves: Any = figure.subfigures(1, 2, width_ratios=[1.15, 1])
            left, right = halves
            draw_plane(left.subplots(), scene, plane)
            grid = right.subplots(len(shown), 1, squeeze=False, sharex=True)
        for axes, panel in zip(grid.flat, shown):
            draw_panel(axes, scene, panel)
        for axes in grid.flat[len(shown) :]:
            axes.set_visible(False)
        for axes in grid[-1]:
            axes.set_xlabel("time (s)" if scene.problem.system.time == "continuous" else "time (steps)")
        rest = len(every) - len(shown)
        figure.suptitle(scene.title + (f"  (and {rest} more constraints)" if rest else ""), fontsize=9)
        figure.legend(handles=_legend(scene), loc="outside lower center", ncols=8, fontsize=7, frameon=False)
    return figure


def _legend(scene: Scene) -> list[Any]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    obstacles = any(constraint.outside for constraint in scene.problem.safe)
    handles: list[Any] = [Line2D([], [], color=INK, linewidth=1.2, label="nominal")]
    handles.append(Patch(facecolor=INNER, label="noise-free"))
    if scene.tube is not None:
        handles.append(Patch(facecolor=OUTER, label="with noise"))
    if scene.tube is not None and obstacles:
        handles.append(Line2D([], [], color=BLUE, linewidth=1.2, label="certified least distance"))
    if scene.paths is not None:
        handles.append(Line2D([], [], color=GREY, linewidth=0.8, label=f"{len(scene.paths)} sample paths"))
    handles.append(Line2D([], [], color=VERMILION, linestyle=(0, (5, 2)), linewidth=1.2, label="limit"))
    if obstacles:
        handles.append(Patch(facecolor=VERMILION, hatch="////", edgecolor=RIM, label="obstacle"))
        handles.append(Patch(facecolor=YELLOW, alpha=0.6, label="eroded"))
    return handles
