"""The page as one string: the verdict in words, the problem, the pictures, who proved what, and how to get it again.

The page holds everything that it needs (plotly's script included) and asks the network for nothing. Every picture
has its content in words or in a table beside it, so that the page can be read by keyboard and without a script.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import platform
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from certbound._version import __version__
from certbound.display import amount, at_least_text, log10_text, name_text, rounded
from certbound.html_report.figures import Entry, Picture, legend_of, pictures_of
from certbound.html_report.markup import table, text
from certbound.html_report.statement import problem_section
from certbound.html_report.style import LAYOUT, SCRIPT, SMALL, STYLE
from certbound.plotting.scene import Scene
from certbound.problem.problem import Problem
from certbound.safety.answers import SPARED
from certbound.safety.starts import SafeStarts

if TYPE_CHECKING:
    from certbound.safety.verification import Verdict

SENTENCES = {
    "SAFE": "Safe: with the constraints as stated, the probability of leaving the safe set at any time up to the "
    "horizon is proved to be at most the number below.",
    "UNKNOWN": "Not decided: the probability that could be certified is not small enough, or nothing could be.",
    "UNSAFE": "Not safe: the probability exceeds what was asked from some start, proved.",
    "UNSAFE_NOMINAL": "Not safe: already without noise some trajectory leaves the safe set, by a rigorous enclosure.",
}
_UNANSWERED = {SPARED: "not asked"}
PACKAGES = ("numpy", "scipy", "casadi", "cvxpy", "clarabel", "python-flint", "numba", "plotly")


def report_page(
    shown: Scene | SafeStarts | Problem, verdict: Verdict, *, command: str = "", probability: str = "",
    certificate: str = "",
) -> str:  # fmt: skip
    """The page as one string: what was proved (``verdict``), and pictures of what is ``shown``.

    These are tubes with sample paths (a scene), a value function with its safe starts, or nothing but the problem.

    ``command`` gives the verdict again; ``probability`` is the certified bound in words, such as ``3.7e-4``; of the
    text of a ``certificate`` that was written the page shows the hash, as ``sha256sum`` prints it.
    """
    from plotly.offline import get_plotlyjs

    problem = shown if isinstance(shown, Problem) else shown.problem
    pictures = [] if isinstance(shown, Problem) else list(pictures_of(shown, safe=verdict.status == "SAFE"))
    large = [picture for picture in pictures if not picture.small]
    parts = [
        _head(f"{name_text(problem.name)}: {verdict.status}", get_plotlyjs()),
        _verdict_section(problem, verdict, probability),
        problem_section(problem),
        *(_figure_section(picture, alone=len(large) == 1) for picture in large),
        _small_section(shown, [picture for picture in pictures if picture.small]),
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
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{text(title)}</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{STYLE}</style><script>{script}</script></head>"
        f'<body><a class="skip" href="#verdict">Skip to the verdict</a><main><h1>{text(title)}</h1>'
    )


def _verdict_section(problem: Problem, verdict: Verdict, probability: str) -> str:
    when = "" if verdict.time is None else f"at {amount(float(f'{verdict.time:.4g}'), problem.time_unit)}"
    where = [verdict.constraint or "", when]
    bound = probability or f"10^{rounded(verdict.log10_delta, up=True, digits=4)}"
    rows = [
        ("certified bound on the probability of leaving", bound),
        ("proved from below", at_least_text(verdict.log10_lower).removeprefix(", ")),
        ("asked for", f"{problem.delta!r}"),
        ("horizon", problem.span.removeprefix("within ")),
        ("states", ", ".join(problem.system.states)),
        ("margin at the tightest place", _least(verdict.margin)),
        ("where", ", ".join(filter(None, where))),
        ("method", verdict.method),
        ("why", verdict.reason),
    ]
    return (
        f'<section id="verdict" class="{verdict.status}"><h2>Verdict</h2><p class="status">{verdict.status}</p>'
        f"<p>{text(SENTENCES[verdict.status])}</p>{table(None, [row for row in rows if row[1]])}</section>"
    )


def _starts_section(starts: SafeStarts) -> str:
    words = f"From each of these starts the probability of leaving is proved to be at most {starts.delta!r}."
    rows = [("size", starts.summary().split(",")[0]), *starts.rows()]
    return f"<section><h2>Safe starts</h2><p>{text(words)}</p>{table(None, rows)}</section>"


def _engine_section(verdict: Verdict) -> str:
    rows = [
        (
            name,
            answer.method,
            log10_text(answer.log10_delta) if answer.applicable else _UNANSWERED.get(answer.reason, "does not apply"),
            _least(answer.margin),
            f"{spent:.1f} s" if (spent := verdict.seconds.get(name, 0.0)) > 0.05 or answer.applicable else "",
            answer.reason,
        )
        for name, answer in verdict.answers.items()
    ]
    if not rows:
        return ""
    heading = ("engine", "method", "P at most", "margin", "time", "in words")
    return f'<section class="whole" id="engines"><h2>Who proved what</h2>{table(heading, rows)}</section>'


def _constants_section(verdict: Verdict) -> str:
    found = verdict.constants
    if found is None:
        return ""
    time = "s" if verdict.problem is None else verdict.problem.time_unit
    name, unit = ("rate", f"1/{time}") if found.continuous else ("gain", "per step")
    rows = [
        (f"{name} ({unit})", _range(getattr(found, name))),
        ("noise level sigma", _range(found.sigma)),
        ("effective dimension", f"{found.nu:.4g} of {found.dimension}"),
        ("metric", "identity" if found.metric is None else f"{found.dimension} x {found.dimension} matrix"),
        ("certified", "yes" if found.certified else "no: stated by the user"),
        ("above what sampling found", _number(found.gap)),
    ]
    return f"<section><h2>Constants</h2>{table(None, rows)}</section>"


def _origin_section(command: str, certificate: str) -> str:
    rows = [("certbound", __version__), ("Python", platform.python_version())]
    rows += [(name, importlib.metadata.version(name)) for name in PACKAGES]
    digest = hashlib.sha256(certificate.encode()).hexdigest() if certificate else "none was written (--certificate)"
    again = f"<p>To get it again:</p><pre><code>{text(command)}</code></pre>" if command else ""
    return (
        f'<section class="whole"><h2>Where this comes from</h2>{again}'
        f"<p>SHA-256 of the certificate: <code>{digest}</code></p>"
        f"<details><summary>Versions</summary>{table(('package', 'version'), rows)}</details></section>"
    )


def _least(value: float | None) -> str:
    return "" if value is None else rounded(value, up=False, digits=4)


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


def _range(value: Any) -> str:
    low, high = float(np.min(value)), float(np.max(value))
    return f"{high:.6g}" if low == high else f"{low:.4g} to {high:.4g}"


# ---- pictures ------------------------------------------------------------------------------------------------


def _figure_section(picture: Picture, *, alone: bool) -> str:
    whole = ' class="whole"' if alone else ""
    return f"<section{whole}><h2>{text(picture.title)}</h2>{_legend(picture.legend)}{_figure(picture)}</section>"


def _legend(entries: Sequence[Entry]) -> str:
    keys = "".join(
        f'<span><i class="{kind}" style="--c:{colour}"></i>{text(words)}</span>' for words, colour, kind in entries
    )
    return f'<p class="legend">{keys}</p>' if entries else ""


def _small_section(shown: Scene | SafeStarts | Problem, pictures: Sequence[Picture]) -> str:
    """Every constraint over time, side by side under one legend."""
    if not pictures or not isinstance(shown, Scene):
        return ""
    multiples = "".join(f"<div><h3>{text(picture.title)}</h3>{_figure(picture)}</div>" for picture in pictures)
    return (
        f'<section class="whole"><h2>Constraints over time</h2>{_legend(legend_of(shown))}'
        f'<div class="multiples">{multiples}</div></section>'
    )


def _figure(picture: Picture) -> str:
    key = "plot-" + hashlib.sha256(picture.title.encode()).hexdigest()[:10]
    layout = {**LAYOUT, **(SMALL if picture.small else {}), **picture.layout}
    config = {"responsive": True, "displaylogo": False, "displayModeBar": False if picture.small else "hover"}
    content = {"data": picture.traces, "layout": layout, "frames": picture.frames}
    data = json.dumps(content | {"config": config}, allow_nan=False)
    data = data.replace("</", "<\\/")
    size = "plot small" if picture.small else "plot tall" if picture.frames else "plot"
    return (
        f'<figure><div id="{key}" class="{size}" role="img" aria-label="{text(picture.words)}">'
        f"</div><figcaption>{text(picture.words)}</figcaption></figure>"
        f"<script>Plotly.newPlot('{key}', {data});</script>"
    )
