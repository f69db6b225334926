"""Maps of a certified probability of failing over the states, with the set of safe starts.

What is coloured and outlined holds on whole cells of a grid. Contour lines join the middles of cells: they help the
eye and prove nothing.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from certbound.arrays import Array, Mask
from certbound.display import log10_text
from certbound.plotting.plane import Plane, draw_set, ends_of, lives_in
from certbound.plotting.scene import BLUE, GREY, INK, RIM, VERMILION
from certbound.safety.starts import SafeStarts
from certbound.values.charts import Chart

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DEEPEST = -12.0
TIMES = ("#332288", "#117733", "#DDAA33", "#AA4466")  # Tol's muted colours: told apart by every eye, dark to light
BORDER: dict[str, Any] = {"color": VERMILION, "linestyle": (0, (5, 2)), "linewidth": 1.2}


def draw_values(starts: SafeStarts, title: str = "") -> Figure:
    """Draw the value function and its safe starts: curves for one state, a map for two, three slices for three."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    style: Any = {"font.size": 8, "hatch.linewidth": 0.6, "axes.spines.top": False, "axes.spines.right": False}
    slices = list(slices_of(starts))
    with mpl.rc_context(style):
        width = {0: 6.6, 1: 6.4}.get(len(slices), 3.9 * len(slices))
        figure = Figure(figsize=(width, 4.4 if len(slices) != 1 else 5.4), layout="constrained")
        grid = figure.subplots(1, max(len(slices), 1), squeeze=False)[0]
        if not slices:
            draw_curves(grid[0], starts)
            figure.legend(loc="outside lower center", ncols=4, fontsize=7, frameon=False)
        for axes, (plane, where, chart) in zip(grid, slices):
            mesh = draw_map(axes, starts, plane, chart)
            axes.set_title(where, loc="left", fontsize=8)
        if slices:
            bar = figure.colorbar(mesh, ax=list(grid), extend="min", fraction=0.05, aspect=30, pad=0.02)
            bar.set_label(f"P(leaving within {_horizon(starts)}), at most")
            handles = _legend(starts)
            figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=7, frameon=False)
        figure.suptitle(title or starts.summary(), fontsize=9)
    return figure


def _horizon(starts: SafeStarts) -> str:
    problem = starts.problem
    return f"{problem.horizon:g} {problem.time_unit}"


# ---- one state -----------------------------------------------------------------------------------------------


def draw_curves(axes: Axes, starts: SafeStarts) -> None:
    """Upper and lower bounds over the state at several times; delta, the safe starts and the stated ones."""
    problem, charts = starts.problem, starts.charts
    name, continuous = problem.axis(problem.system.states[0]), problem.system.time == "continuous"
    for colour, chart in zip(TIMES, charts.upper):
        label = f"from t = {chart.time:.4g} {problem.time_unit} on" if continuous else f"from step {chart.time:g} on"
        axes.plot(*steps_of(chart, DEEPEST), color=colour, linewidth=1.5, label=label)
    for number, (colour, chart) in enumerate(zip(_of_times(starts), charts.lower)):
        axes.plot(*steps_of(chart, -np.inf), color=colour, linewidth=1.0, linestyle=(0, (4, 1.5)),
                  label="lower bounds" if number == 0 else None)  # fmt: skip
    axes.axhline(starts.delta, label=f"delta = {starts.delta:g}", **BORDER)
    for number, start in enumerate(problem.starts):
        low, high = ends_of(start)
        axes.axvspan(low[0], high[0], facecolor=GREY, edgecolor=GREY, alpha=0.35, linewidth=1.0,
                     label="stated start" if number == 0 else None)  # fmt: skip
    for number, (box,) in enumerate(starts.boxes):
        axes.plot(box, [0.015, 0.015], transform=axes.get_xaxis_transform(), color=BLUE, linewidth=5,
                  solid_capstyle="butt", label="safe starts" if number == 0 else None)  # fmt: skip
    lowest = min(float(chart.log10.min()) for chart in charts.upper)
    axes.set_yscale("log")
    axes.set(xlabel=name, ylabel="P(leaving by the horizon)", ylim=(10 ** (max(lowest, DEEPEST) - 0.7), 2.0))
    axes.margins(x=0.01)
    axes.grid(color="#e6e6e6", linewidth=0.5)
    axes.set_axisbelow(True)


def _of_times(starts: SafeStarts) -> Iterator[str]:
    colours = {chart.time: colour for colour, chart in zip(TIMES, starts.charts.upper)}
    return (colours.get(chart.time, INK) for chart in starts.charts.lower)


def steps_of(chart: Chart, least: float) -> tuple[Array, Array]:
    """A chart in one state as a polyline of steps; what is below ``least`` lies on it."""
    values = np.where(np.isfinite(chart.log10), np.maximum(chart.log10, least), np.nan)
    return np.repeat(chart.axes[0], 2)[1:-1], np.repeat(10.0**values, 2)


# ---- two and three states ------------------------------------------------------------------------------------


def slices_of(starts: SafeStarts) -> Iterator[tuple[Plane, str, Chart]]:
    """Planes of two states, through the middle of the stated start: (plane, words, the chart in it); none for one."""
    chart, names = starts.chart, starts.problem.system.states
    low, high = ends_of(starts.problem.starts[0])
    middle = 0.5 * (low + high)
    for plane in itertools.combinations(range(len(chart.axes)), 2):
        index: list[Any] = [slice(None)] * len(chart.axes)
        words = []
        for k in set(range(len(chart.axes))) - set(plane):
            place = int(np.clip(np.searchsorted(chart.axes[k], middle[k]) - 1, 0, len(chart.axes[k]) - 2))
            index[k] = place
            words.append(f"{names[k]} = {middle[k]:.3g}")
        axes = tuple(chart.axes[k] for k in plane)
        yield (plane[0], plane[1]), ", ".join(words), Chart(time=0.0, axes=axes, log10=chart.log10[tuple(index)])


def draw_map(axes: Axes, starts: SafeStarts, plane: Plane, chart: Chart) -> Any:
    """The bound as colours with contours by decades, the safe starts outlined, sets drawn; the colours' mappable."""
    from matplotlib.colors import LogNorm
    from matplotlib.patches import Rectangle

    lowest = _lowest(starts)
    shown = 10.0 ** np.maximum(chart.log10, lowest)
    mesh = axes.pcolormesh(
        *chart.axes, shown.T, norm=LogNorm(10.0**lowest, 1.0), cmap="cividis", rasterized=True, zorder=0
    )
    decades = [level for level in np.arange(lowest + 1, 0.0) if abs(level - math.log10(starts.delta)) > 1e-9]
    x, y = chart.middles
    if min(chart.log10.shape) > 1 and len(decades):
        lines = axes.contour(x, y, np.maximum(chart.log10, lowest - 1).T, levels=decades, colors="white",
                             linewidths=0.7, linestyles="solid", zorder=2)  # fmt: skip
        axes.clabel(lines, fmt=lambda value: f"1e{value:.0f}", fontsize=6.5, inline_spacing=2)
    _draw_outline(axes, chart.axes, starts.safe(chart))
    for low, high in (ends_of(start) for start in starts.problem.starts):
        corner, size = low[list(plane)], (high - low)[list(plane)]
        if np.all(size > 0):
            for colour, width in (("white", 2.6), (INK, 1.4)):
                axes.add_patch(Rectangle(tuple(corner), *size, fill=False, edgecolor=colour, linewidth=width, zorder=7))
        else:
            for colour, width in (("white", 3.2), (INK, 1.6)):
                axes.plot(*(corner + size / 2), marker="x", color=colour, markersize=6, markeredgewidth=width, zorder=7)
    _frame(axes, starts, plane, chart)
    return mesh


def _lowest(starts: SafeStarts) -> float:
    """log10 at the lower end of the colours, a whole number."""
    return float(np.clip(np.floor(starts.chart.log10.min()), DEEPEST, -1.0))


def _frame(axes: Axes, starts: SafeStarts, plane: Plane, chart: Chart) -> None:
    ends = [(float(axis[0]), float(axis[-1])) for axis in chart.axes]
    room = [0.04 * (high - low) for low, high in ends]
    limits = tuple(end for (low, high), more in zip(ends, room) for end in (low - more, high + more))
    for constraint in starts.problem.safe:
        if lives_in(constraint.at_first().region, plane):
            draw_set(axes, constraint, plane, limits, 0.0)
    names = [starts.problem.axis(name) for name in starts.problem.system.states]
    axes.set(xlim=limits[:2], ylim=limits[2:], xlabel=names[plane[0]], ylabel=names[plane[1]])
    if any(c.region.form.even and lives_in(c.region, plane) for c in (one.at_first() for one in starts.problem.safe)):
        axes.set_aspect("equal", adjustable="box")


def _draw_outline(axes: Axes, ends: tuple[Array, ...], chosen: Mask) -> None:
    """The border of the set, dark on a light rim."""
    from matplotlib.collections import LineCollection

    edges = list(outline_of(ends, chosen))
    for colour, width in (("white", 3.2), (BLUE, 1.8)):
        axes.add_collection(LineCollection(edges, colors=colour, linewidths=width, capstyle="round", zorder=5))


def outline_of(ends: tuple[Array, ...], chosen: Mask) -> Array:
    """The edges between chosen cells of a plane and others, shape (edges, 2 ends, 2)."""
    x, y = ends
    padded = np.pad(chosen, 1)
    i, j = np.nonzero(padded[1:, 1:-1] != padded[:-1, 1:-1])
    upright = np.stack([np.stack([x[i], y[j]], -1), np.stack([x[i], y[j + 1]], -1)], axis=1)
    i, j = np.nonzero(padded[1:-1, 1:] != padded[1:-1, :-1])
    level = np.stack([np.stack([x[i], y[j]], -1), np.stack([x[i + 1], y[j]], -1)], axis=1)
    return np.concatenate([upright, level])


def coarser(chart: Chart, most: int) -> Chart:
    """An upper chart of at most so many cells along each state: neighbours joined, with the largest of their bounds."""
    axes, log10 = list(chart.axes), chart.log10
    for k, axis in enumerate(axes):
        parts = -(-(len(axis) - 1) // most)
        first = np.arange(0, len(axis) - 1, parts)
        log10, axes[k] = np.maximum.reduceat(log10, first, axis=k), axis[[*first, len(axis) - 1]]
    return Chart(time=chart.time, axes=tuple(axes), log10=log10)


def _legend(starts: SafeStarts) -> list[Any]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = [Line2D([], [], color=BLUE, linewidth=1.8, label=_safe_words(starts))]
    handles.append(Line2D([], [], color=INK, linewidth=1.4, label="stated start"))
    handles.append(Line2D([], [], label="limit", **BORDER))
    if any(constraint.outside for constraint in starts.problem.safe):
        handles.append(Patch(facecolor=VERMILION, hatch="////", edgecolor=RIM, label="obstacle"))
    return handles


def _safe_words(starts: SafeStarts) -> str:
    return f"safe starts: P <= {log10_text(float(np.log10(starts.delta)), ulps=2)}"
