"""One HTML page about a verdict: words, interactive pictures, numbers, how to get them again.

The page holds everything that it needs (plotly's script included) and asks the network for nothing. Every picture
has its content in words or in a table beside it, so that the page can be read by keyboard and without a script.
"""

from __future__ import annotations

import hashlib
import html
import importlib.metadata
import json
import platform
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from certbound._version import __version__
from certbound.arrays import Array
from certbound.display import name_text, rounded
from certbound.plotting.panels import Panel, least_distance, panels_of, stairs
from certbound.plotting.plane import outlines, plane_of, supports
from certbound.plotting.scene import BLUE, GREY, INK, VERMILION, Scene
from certbound.plotting.value_traces import Trace, broken, circles, numbers, stroke, value_figures
from certbound.safety.starts import SafeStarts

if TYPE_CHECKING:
    from certbound.problem.problem import Problem
    from certbound.reach.sets import ReachTube
    from certbound.safety.verification import Verdict

SENTENCES = {
    "SAFE": "Safe: with the constraints as stated, the probability of leaving the safe set at any time up to the "
    "horizon is proved to be at most the number below.",
    "UNKNOWN": "Not decided: the probability that could be certified is not small enough, or nothing could be.",
    "UNSAFE": "Not safe: the probability exceeds what was asked from some start, proved.",
    "UNSAFE_NOMINAL": "Not safe: already without noise some trajectory leaves the safe set, by a rigorous enclosure.",
}
PACKAGES = ("numpy", "scipy", "casadi", "cvxpy", "clarabel", "python-flint", "numba", "plotly")


def report_page(
    shown: Scene | SafeStarts, verdict: Verdict, *, command: str = "", probability: str = "", certificate: str = ""
) -> str:
    """The page as one string: what was proved (``verdict``), and pictures of what is ``shown``.

    These are tubes with sample paths (a scene), or a value function with its safe starts.

    ``command`` gives the verdict again; ``probability`` is the certified bound in words, such as ``3.7e-4``; of the
    text of a ``certificate`` that was written the page shows the hash, as ``sha256sum`` prints it.
    """
    from plotly.offline import get_plotlyjs

    figures = list(value_figures(shown) if isinstance(shown, SafeStarts) else _figures(shown))
    problem = shown.problem
    parts = [
        _head(f"{name_text(problem.name)}: {verdict.status}", get_plotlyjs()),
        _verdict_section(problem, verdict, probability),
        *(_figure_section(*figure) for figure in figures),
        _starts_section(shown) if isinstance(shown, SafeStarts) else "",
        _engine_section(verdict),
        _constants_section(verdict),
        _origin_section(command, certificate),
        f"</main><script>{SCRIPT}</script></body></html>\n",
    ]
    return "".join(parts)


# ---- text ----------------------------------------------------------------------------------------------------


def _head(title: str, script: str) -> str:
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{_text(title)}</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{STYLE}</style><script>{script}</script></head>"
        f'<body><a class="skip" href="#verdict">Skip to the verdict</a><main><h1>{_text(title)}</h1>'
    )


def _verdict_section(problem: Problem, verdict: Verdict, probability: str) -> str:
    unit = "s" if problem.system.time == "continuous" else "steps"
    bound = probability or f"10^{rounded(verdict.log10_delta, up=True, digits=4)}"
    rows = [
        ("certified bound on the probability of leaving", bound),
        ("asked for", f"{problem.delta!r}"),
        ("horizon", f"{problem.horizon:g} {unit}"),
        ("states", ", ".join(problem.system.states)),
        ("margin at the tightest place", _least(verdict.margin)),
        ("where", "" if verdict.time is None else f"{verdict.constraint}, at {verdict.time:.4g} {unit}"),
        ("method", verdict.method),
        ("why", verdict.reason),
    ]
    return (
        f'<section id="verdict" class="{verdict.status}"><h2>Verdict</h2><p class="status">{verdict.status}</p>'
        f"<p>{_text(SENTENCES[verdict.status])}</p>{_table(None, rows)}</section>"
    )


def _starts_section(starts: SafeStarts) -> str:
    words = f"From each of these starts the probability of leaving is proved to be at most {starts.delta!r}."
    rows = [("size", starts.summary().split(",")[0]), *starts.rows()]
    return f"<section><h2>Safe starts</h2><p>{_text(words)}</p>{_table(None, rows)}</section>"


def _engine_section(verdict: Verdict) -> str:
    rows = [
        (
            name,
            answer.method,
            rounded(answer.log10_delta, up=True, digits=4) if answer.applicable else "does not apply",
            _least(answer.margin),
            answer.reason,
        )
        for name, answer in verdict.answers.items()
    ]
    if not rows:
        return ""
    heading = ("engine", "method", "log10 of its bound", "margin", "in words")
    return f"<section><h2>Methods side by side</h2>{_table(heading, rows)}</section>"


def _constants_section(verdict: Verdict) -> str:
    found = verdict.constants
    if found is None:
        return ""
    name, unit = ("rate", "1/s") if found.continuous else ("gain", "per step")
    rows = [
        (f"{name} ({unit})", _range(getattr(found, name))),
        ("noise level sigma", _range(found.sigma)),
        ("effective dimension", f"{found.nu:.4g} of {found.dimension}"),
        ("metric", "identity" if found.metric is None else f"{found.dimension} x {found.dimension} matrix"),
        ("certified", "yes" if found.certified else "no: stated by the user"),
        ("above what sampling found", _number(found.gap)),
    ]
    return f"<section><h2>Constants</h2>{_table(None, rows)}</section>"


def _origin_section(command: str, certificate: str) -> str:
    rows = [("certbound", __version__), ("Python", platform.python_version())]
    rows += [(name, importlib.metadata.version(name)) for name in PACKAGES]
    digest = hashlib.sha256(certificate.encode()).hexdigest() if certificate else "none was written (--certificate)"
    again = f"<p>To get it again:</p><pre><code>{_text(command)}</code></pre>" if command else ""
    return (
        f"<section><h2>Where this comes from</h2>{again}<p>SHA-256 of the certificate: <code>{digest}</code></p>"
        f"{_table(('package', 'version'), rows)}</section>"
    )


def _table(heading: Sequence[str] | None, rows: Iterable[Sequence[str]]) -> str:
    head = ""
    if heading is not None:
        head = "<thead><tr>" + "".join(f'<th scope="col">{_text(cell)}</th>' for cell in heading) + "</tr></thead>"
    lines = []
    for first, *rest in rows:
        cells = "".join(f"<td>{_text(cell)}</td>" for cell in rest)
        lines.append(f'<tr><th scope="row">{_text(first)}</th>{cells}</tr>')
    return f'<div class="wide" tabindex="0"><table>{head}<tbody>{"".join(lines)}</tbody></table></div>'


def _text(value: object) -> str:
    return html.escape(str(value))


def _least(value: float | None) -> str:
    return "" if value is None else rounded(value, up=False, digits=4)


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


def _range(value: Any) -> str:
    low, high = float(np.min(value)), float(np.max(value))
    return f"{high:.6g}" if low == high else f"{low:.4g} to {high:.4g}"


# ---- pictures ------------------------------------------------------------------------------------------------


def _figures(scene: Scene) -> Iterable[tuple[str, str, list[Trace], Trace]]:
    """Title, words, traces and layout of every picture."""
    plane = plane_of(scene.problem)
    if plane is not None:
        yield _plane_figure(scene, plane)
    panels = panels_of(scene.problem)
    margins = _margins_figure(scene, panels)
    if margins is not None:
        yield margins
    for panel in panels:
        yield _panel_figure(scene, panel)


def _figure_section(title: str, words: str, traces: list[Trace], layout: Trace) -> str:
    key = "plot-" + hashlib.sha256(title.encode()).hexdigest()[:10]
    layout = {**LAYOUT, **layout}
    data = json.dumps([traces, layout, {"responsive": True, "displaylogo": False}], allow_nan=False)
    data = data.replace("</", "<\\/")
    return (
        f'<section><h2>{_text(title)}</h2><figure><div id="{key}" class="plot" role="img" aria-label="{_text(words)}">'
        f"</div><figcaption>{_text(words)}</figcaption></figure><script>Plotly.newPlot('{key}', ...{data});</script>"
        "</section>"
    )


def _plane_figure(scene: Scene, plane: tuple[int, int]) -> tuple[str, str, list[Trace], Trace]:
    names = scene.problem.system.states
    traces: list[Trace] = []
    for tube, color in scene.tubes:
        shape = outlines(tube, plane)[:: max(1, len(outlines(tube, plane)) // 60)]
        x, y = (broken(np.concatenate([shape[..., i], shape[:, :1, i]], axis=1)) for i in (0, 1))
        label = "with noise" if tube.noise else "noise-free"
        style = {"mode": "lines", "fill": "toself", "fillcolor": color, "line": {"width": 0}, "hoverinfo": "skip"}
        traces.append({"x": x, "y": y, "name": label, **style})
    if scene.paths is not None:
        shown = scene.paths[:25, :: max(1, scene.paths.shape[1] // 200)]
        x, y = broken(shown[..., plane[0]]), broken(shown[..., plane[1]])
        traces.append({"x": x, "y": y, "name": "sample paths", **stroke(GREY, 0.7), "opacity": 0.6})
    _, centre = scene.nominal(200)
    nominal = {"x": numbers(centre[:, plane[0]]), "y": numbers(centre[:, plane[1]])}
    traces.append({**nominal, "name": "nominal", **stroke(INK, 2)})
    shapes = circles(scene.problem, plane)
    layout: Trace = {"xaxis": {"title": {"text": names[plane[0]]}}, "yaxis": {"title": {"text": names[plane[1]]}}}
    if shapes:
        layout["shapes"] = shapes
        layout["yaxis"] |= {"scaleanchor": "x", "scaleratio": 1}
    words = f"The plane of {names[plane[0]]} and {names[plane[1]]}: nominal, reachable sets, sample paths, obstacles."
    return f"Phase plane {names[plane[0]]}, {names[plane[1]]}", words, traces, layout


def _panel_figure(scene: Scene, panel: Panel) -> tuple[str, str, list[Trace], Trace]:
    t, centre = scene.nominal(200)
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
    else:
        bound = None if scene.tube is None else least_distance(scene.tube, panel.constraint)
        if bound is not None and scene.tube is not None:
            x, y = stairs(scene.tube, bound)
            traces.append({"x": numbers(x), "y": numbers(y), "name": "certified least distance", **stroke(BLUE, 2)})
    if scene.paths is not None and scene.times is not None:
        every = max(1, len(scene.times) // 200)
        times = scene.times[::every]
        values = panel.values(scene.paths[:25, ::every], times)
        repeated = broken(np.broadcast_to(times, values.shape))
        traces.append({"x": repeated, "y": broken(values), "name": "sample paths", **stroke(GREY, 0.7), "opacity": 0.6})
    nominal, limits = panel.values(centre, t), panel.limits
    traces.append({"x": numbers(t), "y": numbers(nominal), "name": "nominal", **stroke(INK, 2)})
    start, end = panel.during or (0.0, float(scene.problem.horizon))
    for limit in limits:
        line = {"color": VERMILION, "width": 2, "dash": "dash"}
        traces.append({"x": [start, end], "y": [limit, limit], "name": "limit", "mode": "lines", "line": line})
    unit = "s" if scene.problem.system.time == "continuous" else "steps"
    least = f"Nominal between {nominal.min():.4g} and {nominal.max():.4g}"
    words = f"{least}; limit {', '.join(f'{limit:.4g}' for limit in limits)}."
    return f"{panel.label} over time", words, traces, {"xaxis": {"title": {"text": f"time ({unit})"}}}


def _margins_figure(scene: Scene, panels: list[Panel]) -> tuple[str, str, list[Trace], Trace] | None:
    """What the tube leaves of every constraint over time: certified, in the units of the constraint."""
    traces: list[Trace] = []
    smallest = []
    tube = scene.tube
    for panel in panels:
        room = None if tube is None else _room(tube, panel)
        if tube is None or room is None:
            continue
        x, y = stairs(tube, room)
        start, end = panel.during or (0.0, float(scene.problem.horizon))
        asked = (x >= start) & (x <= end)
        if np.any(asked):
            name = panel.label if len(panel.label) < 30 else f"{panel.label[:27]}..."
            traces.append({"x": numbers(x[asked]), "y": numbers(y[asked]), "name": name, "mode": "lines"})
            smallest.append(f"{panel.label}: at least {np.min(y[asked]):.4g}")
    if not traces:
        return None
    unit = "s" if scene.problem.system.time == "continuous" else "steps"
    words = f"Room that the tube with noise leaves. {'; '.join(smallest)}."
    return "Margin over time", words, traces, {"xaxis": {"title": {"text": f"time ({unit})"}}}


def _room(tube: ReachTube, panel: Panel) -> Array | None:
    if panel.direction is None:
        return least_distance(tube, panel.constraint)
    above = panel.high - supports(tube, panel.direction)
    return np.minimum(above, -panel.low - supports(tube, -panel.direction))


LAYOUT: Trace = {
    "margin": {"l": 55, "r": 15, "t": 30, "b": 45},
    "legend": {"orientation": "h", "y": -0.25},
    "paper_bgcolor": "white",
    "plot_bgcolor": "white",
    "font": {"size": 13},
    "hovermode": "closest",
}
SCRIPT = """
const follow = new ResizeObserver(entries => entries.forEach(entry => Plotly.Plots.resize(entry.target)));
document.querySelectorAll(".plot").forEach(plot => follow.observe(plot));
"""
STYLE = f"""
:root {{ color-scheme: light; }}
body {{ font: 16px/1.5 system-ui, sans-serif; margin: 0; color: #1a1a1a; background: #f4f5f7; }}
main {{ max-width: 1180px; margin: 0 auto; padding: 0 1rem 3rem; display: grid; gap: 1rem;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 520px), 1fr)); }}
h1, #verdict {{ grid-column: 1 / -1; margin-bottom: 0; }}
section {{ background: white; border-radius: 8px; padding: 0.5rem 1rem 1rem; min-width: 0;
  border-top: 4px solid #c7ccd3; }}
section.SAFE {{ border-top-color: #009E73; }} section.UNKNOWN {{ border-top-color: #E69F00; }}
section.UNSAFE, section.UNSAFE_NOMINAL {{ border-top-color: #D55E00; }}
h2 {{ font-size: 1.1rem; }} .status {{ font-size: 1.8rem; font-weight: 700; margin: 0; }}
figure {{ margin: 0; }} .plot {{ width: 100%; height: 360px; overflow: hidden; }}
figcaption {{ color: #444; font-size: 0.9rem; }}
.wide {{ overflow-x: auto; }} table {{ border-collapse: collapse; }} code {{ word-break: break-all; }}
th, td {{ text-align: left; vertical-align: top; padding: 0.25rem 0.75rem 0.25rem 0;
  border-bottom: 1px solid #e3e5e8; }}
pre {{ overflow-x: auto; background: #f4f5f7; padding: 0.5rem; }}
.skip {{ position: absolute; left: -9999px; }} .skip:focus {{ left: 1rem; top: 0.5rem; }}
:focus-visible {{ outline: 3px solid {BLUE}; }}
"""
