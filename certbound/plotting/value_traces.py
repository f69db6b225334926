"""Maps and curves of value functions as traces of an interactive picture, and how such traces are written."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.plotting.plane import Plane
from certbound.plotting.plane_shapes import shapes_of
from certbound.plotting.scene import BLUE, VERMILION
from certbound.plotting.value_maps import DEEPEST, TIMES, coarser, outline_of, slices_of, steps_of
from certbound.safety.starts import SafeStarts
from certbound.values.charts import Chart

Trace = dict[str, Any]

DIGITS = 5
FINEST = 160  # cells a side of a map


def value_figures(starts: SafeStarts) -> Iterator[tuple[str, str, list[Trace], Trace]]:
    """Title, words, traces and layout: curves over one state, a map of two, three slices of three."""
    slices = list(slices_of(starts))
    if not slices:
        yield _curves_figure(starts)
    for plane, where, chart in slices:
        yield _map_figure(starts, plane, where, coarser(chart, FINEST))


def _map_figure(starts: SafeStarts, plane: Plane, where: str, chart: Chart) -> tuple[str, str, list[Trace], Trace]:
    first, second = (starts.problem.axis(starts.problem.system.states[k]) for k in plane)
    lowest = max(float(np.floor(chart.log10.min())), DEEPEST)
    heat = {
        "type": "heatmap", "x": numbers(chart.axes[0]), "y": numbers(chart.axes[1]),
        "z": [numbers(row) for row in np.maximum(chart.log10, lowest).T],
        "colorscale": "Cividis", "zmin": lowest, "zmax": 0, "name": "log10 P",
        "colorbar": {"title": {"text": "log10 P"}},
    }  # fmt: skip
    edges = outline_of(chart.axes, starts.safe(chart))
    x, y = (broken(edges[..., k]) for k in (0, 1))
    rim = {"x": x, "y": y, "showlegend": False, "hoverinfo": "skip", **stroke("#ffffff", 5)}
    safe = {"x": x, "y": y, "name": f"safe starts: P <= {starts.delta:g}", **stroke(BLUE, 3)}
    layout: Trace = {"xaxis": {"title": {"text": first}}, "yaxis": {"title": {"text": second}}}
    ends = tuple(float(end) for axis in chart.axes for end in (axis[0], axis[-1]))
    layout["shapes"] = shapes_of(starts.problem, plane, ends)
    words = "Certified upper bound of the probability of leaving from every start, cell by cell. Black: the stated one."
    title = f"Where it is safe to start: {first}, {second}{' at ' if where else ''}{where}"
    return title, words, [heat, rim, safe], layout


def _curves_figure(starts: SafeStarts) -> tuple[str, str, list[Trace], Trace]:
    unit = starts.problem.time_unit
    traces: list[Trace] = []
    for colour, chart in zip(TIMES, starts.charts.upper):
        x, y = steps_of(chart, DEEPEST)
        name = f"at most, from {chart.time:.4g} {unit} on"
        traces.append({"x": numbers(x), "y": numbers(y), "name": name, **stroke(colour, 2)})
    for chart in starts.charts.lower[:1]:
        x, y = steps_of(chart, -np.inf)
        kept = np.isfinite(y) & (y > 0)
        style = {"mode": "lines", "line": {"color": TIMES[0], "width": 1.5, "dash": "dash"}}
        traces.append({"x": numbers(x[kept]), "y": numbers(y[kept]), "name": "at least, from the start on", **style})
    ends = starts.chart.axes[0][[0, -1]]
    dashes = {"color": VERMILION, "width": 2, "dash": "dash"}
    level = {"x": numbers(ends), "y": [starts.delta, starts.delta], "mode": "lines", "line": dashes}
    traces.append({**level, "name": f"delta = {starts.delta:g}"})
    name = starts.problem.system.states[0]
    across = {"title": {"text": starts.problem.axis(name)}}
    layout = {"xaxis": across, "yaxis": {"type": "log", "title": {"text": "P(leaving)"}}}
    words = "Certified bounds of the probability of leaving by the horizon, over the state, from several times on."
    return f"Probability of leaving over {name}", words, traces, layout


def stroke(color: str, width: float) -> Trace:
    """How a curve is drawn."""
    return {"mode": "lines", "line": {"color": color, "width": width}}


def numbers(values: Array) -> list[float]:
    """The digits that a picture needs."""
    return [float(f"{value:.{DIGITS}g}") for value in np.asarray(values, dtype=float)]


def broken(rows: Array) -> list[float | None]:
    """Several polylines as one trace, separated by gaps."""
    result: list[float | None] = []
    for row in rows:
        result += [*numbers(row), None]
    return result
