"""The interactive pictures of a report: title, words, traces, layout and frames of each, as plotly reads them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from certbound.arrays import Array
from certbound.display import rounded
from certbound.plotting.asked import Panel, panels_of
from certbound.plotting.certified import bounds_of, room_of, stairs, supports
from certbound.plotting.plane import Plane, asked_of, band_of, frame_of, outlines, plane_of
from certbound.plotting.plane_shapes import shapes_of
from certbound.plotting.scene import BLUE, GREEN, GREY, INK, VERMILION, YELLOW, Scene
from certbound.plotting.value_traces import Trace, broken, numbers, stroke, value_figures
from certbound.safety.starts import SafeStarts

PATHS = 25
POINTS = 200
STOPS = 40  # of the slider over time


Entry = tuple[str, str, str]


@dataclass(frozen=True, kw_only=True)
class Picture:
    """One picture; ``small`` ones share a section and its legend.

    Entries of a ``legend`` are words, a colour, and whether it is an area, a line or dashes.
    """

    title: str
    words: str
    traces: list[Trace]
    layout: Trace
    frames: list[Trace] = field(default_factory=list)
    legend: list[Entry] = field(default_factory=list)
    small: bool = False


def pictures_of(shown: Scene | SafeStarts, *, safe: bool) -> Iterator[Picture]:
    """Every picture of what is shown; ``safe`` is whether the verdict is SAFE."""
    if isinstance(shown, SafeStarts):
        for title, words, traces, layout in value_figures(shown):
            yield Picture(title=title, words=words, traces=traces, layout=layout)
        return
    plane = plane_of(shown.problem)
    if plane is not None:
        yield _plan(shown, plane)
    panels = panels_of(shown.problem)
    margins = _margins(shown, panels, safe)
    if margins is not None:
        yield margins
    for panel in panels:
        yield _small(shown, panel)


def legend_of(scene: Scene) -> list[Entry]:
    """The one legend of the small pictures."""
    entries = [("nominal", INK, "line")] if scene.tubes else []
    entries += [("with noise" if tube.noise else "noise-free", colour, "area") for tube, colour in scene.tubes]
    entries += [] if scene.tube is None else [("certified bound", BLUE, "line")]
    entries += [] if scene.paths is None else [("sample paths", GREY, "line")]
    return [*entries, ("limit", VERMILION, "dashes")]


def _plan_legend(scene: Scene) -> list[Entry]:
    entries = [entry for entry in legend_of(scene) if entry[0] != "certified bound"]
    if scene.tubes:
        entries.insert(-1, ("the tube at the slider's time", BLUE, "line"))
    if any(constraint.outside for constraint in scene.problem.safe):
        entries += [("obstacle", VERMILION, "area"), *([] if scene.tube is None else [("eroded", YELLOW, "area")])]
    return entries if scene.problem.reach is None else [*entries, ("target", GREEN, "area")]


def _unit(scene: Scene) -> str:
    return scene.problem.time_unit


# ---- the plane -----------------------------------------------------------------------------------------------


def _plan(scene: Scene, plane: Plane) -> Picture:
    names = [scene.problem.axis(name) for name in scene.problem.system.states]
    traces: list[Trace] = []
    for tube, color in scene.tubes:
        shape = outlines(tube, plane)
        shape = shape[:: max(1, len(shape) // 60)]
        x, y = (broken(np.concatenate([shape[..., i], shape[:, :1, i]], axis=1)) for i in (0, 1))
        label = "with noise" if tube.noise else "noise-free"
        style = {"mode": "lines", "fill": "toself", "fillcolor": color, "line": {"width": 0}, "hoverinfo": "skip"}
        traces.append({"x": x, "y": y, "name": label, **style})
    if scene.paths is not None:
        every = scene.paths[:PATHS, :: max(1, scene.paths.shape[1] // POINTS)]
        x, y = broken(every[..., plane[0]]), broken(every[..., plane[1]])
        traces.append({"x": x, "y": y, "name": "sample paths", **stroke(GREY, 0.7), "opacity": 0.6})
    _, centre = scene.nominal(POINTS)
    nominal = {"x": numbers(centre[:, plane[0]]), "y": numbers(centre[:, plane[1]])}
    traces.append({**nominal, "name": "nominal", **stroke(INK, 2)})
    now = list(_moments(scene, plane))
    first = len(traces)
    traces += now[0][1] if now else []
    layout: Trace = {"xaxis": {"title": {"text": names[plane[0]]}}, "yaxis": {"title": {"text": names[plane[1]]}}}
    layout |= _sets(scene, plane, layout) | {"showlegend": False}
    layout["sliders"] = [_slider(scene, [label for label, _ in now])] if now else []
    frames = [
        {"name": label, "data": data, "traces": list(range(first, first + len(data)))} for label, data in now
    ]
    sets = "nominal, reachable sets, " if scene.tubes else ""
    words = f"The plane of {names[plane[0]]} and {names[plane[1]]}: {sets}sample paths, obstacles."
    return Picture(
        title=f"Seen from above: {names[plane[0]]}, {names[plane[1]]}", words=words, traces=traces, layout=layout,
        frames=frames, legend=_plan_legend(scene),
    )  # fmt: skip


def _sets(scene: Scene, plane: Plane, layout: Trace) -> Trace:
    """The sets of the plane, and axes on which all of them and the tube can be seen."""
    places = scene.nominal()[1] if scene.paths is None else scene.paths.reshape(-1, scene.paths.shape[-1])
    wider = scene.tube or scene.reach
    ends = (places, places) if wider is None else (wider.hull.lo, wider.hull.hi)
    low, high = ends[0].min(axis=0)[list(plane)], ends[1].max(axis=0)[list(plane)]
    room = 0.04 * (high - low)
    tube = np.stack([low - room, high + room], axis=1).ravel()
    limits = frame_of(scene.problem, plane, tuple(tube.tolist()))
    safe = scene.problem.safe
    shapes = shapes_of(scene.problem, plane, limits, {k: band_of(scene, c, plane) for k, c in enumerate(safe)})
    ranges = [numbers(np.array(limits[:2])), numbers(np.array(limits[2:]))]
    axes = [layout[name] | {"range": end, "zeroline": False} for name, end in zip(("xaxis", "yaxis"), ranges)]
    if any(c.region.form.even and set(asked_of(c.region)) == set(plane) for c in (one.at_first() for one in safe)):
        axes[1] |= {"scaleanchor": "x", "scaleratio": 1}
    return {"shapes": shapes, "xaxis": axes[0], "yaxis": axes[1]}


def _moments(scene: Scene, plane: Plane) -> Iterator[tuple[str, list[Trace]]]:
    """At every stop of the slider: the tube's set then, and the places of the sample paths."""
    tube = scene.tube or scene.reach
    if tube is None:
        return
    pieces = np.unique(np.linspace(0, tube.curve.pieces - 1, STOPS).astype(int))
    shapes = outlines(tube, plane, pieces)
    for piece, shape in zip(pieces, shapes):
        t = float(tube.curve.starts[piece])
        closed = np.concatenate([shape, shape[:1]])
        data: list[Trace] = [
            {"x": numbers(closed[:, 0]), "y": numbers(closed[:, 1]), "name": "at this time", **stroke(BLUE, 2)}
        ]
        if scene.paths is not None and scene.times is not None:
            k = int(np.argmin(np.abs(scene.times - t)))
            places = scene.paths[:PATHS, k][:, list(plane)]
            dots = {"mode": "markers", "marker": {"color": INK, "size": 4}, "showlegend": False}
            data.append({"x": numbers(places[:, 0]), "y": numbers(places[:, 1]), "name": "paths then", **dots})
        yield f"{t:.3g}", data


def _slider(scene: Scene, labels: list[str]) -> Trace:
    still = {"mode": "immediate", "frame": {"duration": 0, "redraw": False}, "transition": {"duration": 0}}
    steps = [{"label": label, "method": "animate", "args": [[label], still]} for label in labels]
    value = {"prefix": "t = ", "suffix": f" {_unit(scene)}", "font": {"size": 12}}
    place = {"x": 0, "len": 1, "y": -0.14, "pad": {"t": 24}, "ticklen": 0, "minorticklen": 0, "font": {"size": 1}}
    return {"steps": steps, "currentvalue": value, **place}


# ---- over time -----------------------------------------------------------------------------------------------


def _small(scene: Scene, panel: Panel) -> Picture:
    t, centre = scene.nominal(POINTS)
    traces: list[Trace] = []
    row = panel.direction
    if row is not None:
        for tube, color in scene.tubes:
            x, high = stairs(tube, supports(tube, row))
            _, low = stairs(tube, -supports(tube, -row))
            ends = np.concatenate([low, high[::-1]])
            area = {"fill": "toself", "fillcolor": color, "hoverinfo": "skip", **stroke(color, 0)}
            label = "with noise" if tube.noise else "noise-free"
            traces.append({"x": numbers(np.concatenate([x, x[::-1]])), "y": numbers(ends), "name": label, **area})
    if scene.paths is not None and scene.times is not None:
        every = max(1, len(scene.times) // POINTS)
        times = scene.times[::every]
        values = panel.values(scene.paths[:PATHS, ::every], times)
        repeated = broken(np.broadcast_to(times, values.shape))
        traces.append({"x": repeated, "y": broken(values), "name": "sample paths", **stroke(GREY, 0.7), "opacity": 0.6})
    for bound, room in bounds_of(scene, panel):
        assert scene.tube is not None
        x, y = stairs(scene.tube, bound)
        asked = np.isfinite(stairs(scene.tube, room)[1])
        traces.append({"x": numbers(x[asked]), "y": numbers(y[asked]), "name": "certified bound", **stroke(BLUE, 1.5)})
    nominal = panel.values(centre, t)
    traces.append({"x": numbers(t), "y": numbers(nominal), "name": "nominal", **stroke(INK, 2)})
    start, end = panel.during or (0.0, float(scene.problem.horizon))
    for limit in panel.limits:
        line = {"color": VERMILION, "width": 2, "dash": "dash"}
        traces.append({"x": [start, end], "y": [limit, limit], "name": "limit", "mode": "lines", "line": line})
    layout: Trace = {"xaxis": {"title": {"text": f"time ({_unit(scene)})"}}, "showlegend": False}
    return Picture(title=panel.label, words=_words(scene, panel, nominal), traces=traces, layout=layout, small=True)


def _words(scene: Scene, panel: Panel, nominal: Array) -> str:
    room = room_of(scene, panel)
    limits = ", ".join(f"{limit:.4g}" for limit in panel.limits)
    size = max(float(np.ptp(nominal)), *map(abs, panel.limits))
    low, high = (0.0 if abs(end) < 1e-9 * size else end for end in (nominal.min(), nominal.max()))
    if not scene.tubes:
        return f"Limit {limits}; no tube was proved."
    certified = "" if room is None or not np.any(np.isfinite(room)) else f"; certified room {_least(room)}"
    return f"Nominal between {low:.4g} and {high:.4g}; limit {limits}{certified}."


def _least(room: Array) -> str:
    return rounded(float(np.min(room)), up=False, digits=4)


def _margins(scene: Scene, panels: list[Panel], safe: bool) -> Picture | None:
    """What is certified to be left of every constraint over time, in the units of the constraint."""
    traces: list[Trace] = []
    smallest, least = [], np.inf
    for panel in panels:
        room = room_of(scene, panel)
        if scene.tube is None or room is None or not np.any(np.isfinite(room)):
            continue
        x, y = stairs(scene.tube, room)
        asked = np.isfinite(y)
        name = panel.label if len(panel.label) < 30 else f"{panel.label[:27]}..."
        traces.append({"x": numbers(x[asked]), "y": numbers(y[asked]), "name": name, "mode": "lines"})
        least = min(least, float(np.min(room)))
        smallest.append(f"{panel.label}: at least {_least(room)}")
    if not traces:
        return None
    words = f"Room that is certified at the allowed probability, shared evenly. {'; '.join(smallest)}."
    if least < 0 and safe:
        words += " It is negative where an even share would not do: the proof shares the probability unevenly."
    layout: Trace = {"xaxis": {"title": {"text": f"time ({_unit(scene)})"}}, "yaxis": {"rangemode": "tozero"}}
    return Picture(title="Margin over time", words=words, traces=traces, layout=layout)
