"""The problem in full: what was asked, so that a verdict can be read without its file.

The content is that of the problem file (``Problem.to_dict``), typeset.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from certbound.html_report import typeset
from certbound.html_report.markup import Markup, math, table, text
from certbound.plotting.plane import ends_of
from certbound.problem.sets import Faces, Inside, Region

if TYPE_CHECKING:
    from certbound.problem.problem import Problem

LARGEST = 6  # rows and columns up to which a matrix is printed
MOST = 14  # equations before the rest are folded away


def problem_section(problem: Problem) -> str:
    """Dynamics, noise, start, disturbance, sets and parameters of a problem."""
    content = _content(problem)
    unit, states = problem.time_unit, problem.system.states
    rows: list[tuple[object, object]] = []
    rows += [("parameters", _list(content["parameters"]))] if content.get("parameters") else []
    units = [f"{name} ({problem.units[name]})" for name in problem.units if name != "time"]
    rows += [("units", ", ".join(units))] if units else []
    for key, word in (("inputs", "inputs"), ("disturbances", "disturbances"), ("uncertain", "unknown constants")):
        rows += [(word, _signals(content[key]))] if content.get(key) else []
    rows += [("drawn constants", ", ".join(f"{name} = {law.describe()}" for name, law in problem.random.items()))] \
        if problem.random else []
    rows.append(("noise", Markup("<br>".join(_noise(content.get("noise", {}), unit)))))
    starts = content.get("initial", {})
    for start in starts if isinstance(starts, list) else [starts]:
        rows.append(("start", Markup(_start(start, states))))
    rows += [("stays out of" if c.outside else "stays in", _asked(c, unit, states)) for c in problem.safe]
    rows += [] if problem.reach is None else [("has to reach", _asked(problem.reach, unit, states))]
    if problem.domain is not None:
        rows.append(("domain", problem.domain.describe(states, "inside")))
    rows.append(("horizon", problem.span.removeprefix("within ")))
    rows.append(("allowed probability", f"delta = {problem.delta!r}"))
    return (
        '<section id="problem"><h2>The problem</h2><div class="halves"><div>'
        f"{_equations(content, problem)}</div><div>{table(None, rows)}</div></div></section>"
    )


def _content(problem: Problem) -> dict[str, Any]:
    try:
        return problem.to_dict()
    except ValueError as error:  # a model with what problem files do not have
        system = problem.system
        boxes = [np.stack(ends_of(start), axis=1).tolist() for start in problem.starts]
        bounded = {} if system.disturbance is None else dict(zip(system.disturbance_names, _sides(system.disturbance)))
        level = getattr(system, "diffusion", None)
        noise = {"diffusion": level.tolist()} if isinstance(level, np.ndarray) else {}
        starts = [{"box": box} for box in boxes]
        return {"unwritten": str(error), "initial": starts, "disturbances": bounded, "noise": noise}


def _sides(box: Any) -> list[list[float]]:
    return np.stack([box.low, box.high], axis=1).tolist()  # type: ignore[no-any-return]  # of an array of floats


def _equations(content: Mapping[str, Any], problem: Problem) -> str:
    continuous = problem.system.time == "continuous"
    if "unwritten" in content:
        return f"<p>{text(content['unwritten'])}</p>"
    dynamics = content["dynamics"]
    rows = [(typeset.name(key), typeset.formula(value)) for key, value in content.get("definitions", {}).items()]
    kind, mark = ("mover", "˙") if continuous else ("msup", "+")
    for key, value in _rows_of(dynamics, problem.system.states):
        rows.append((f"<{kind}>{typeset.name(key)}<mo>{mark}</mo></{kind}>", typeset.formula(value)))
    shown = typeset.block(rows[:MOST])
    if len(rows) > MOST:
        shown += f"<details><summary>{len(rows) - MOST} more</summary>{typeset.block(rows[MOST:])}</details>"
    plan = content.get("plan") or {}
    plan = [(typeset.name(key), typeset.formula(str(value))) for key, value in plan.items() if key != "file"]
    words = "Drift of the stochastic equation" if continuous else "The next state, before the noise"
    given = content.get("plan", {}).get("file") if isinstance(content.get("plan"), Mapping) else None
    follows = "<p>The plan is a table of inputs, step by step.</p>" if given else ""
    follows += f"<p>The plan:</p>{typeset.block(plan)}" if plan else ""
    return f'<p>{words}:</p><div class="wide" tabindex="0">{shown}</div>{follows}'


def _rows_of(dynamics: Mapping[str, Any], states: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    if "A" not in dynamics:
        yield from ((key, str(value)) for key, value in dynamics.items())
        return
    offsets = dynamics.get("b", [0] * len(states))
    for state, row, b in zip(states, dynamics["A"], offsets):
        linear = _sum(row, states)
        yield state, f"{linear} + {b!r}" if b else linear


def _list(values: Mapping[str, Any]) -> Markup:
    return Markup(", ".join(math(f"{typeset.name(key)}<mo>=</mo>{_entry(value)}") for key, value in values.items()))


def _signals(values: Mapping[str, Any]) -> Markup:
    lines = (math(f"{typeset.name(key)}<mo>∈</mo>{_interval(value)}") for key, value in values.items())
    return Markup("<br>".join(lines))


def _interval(value: Any) -> str:
    if isinstance(value, (list, tuple)) and len(value) == 2:
        return f"<mrow><mo>[</mo><mn>{_short(value[0])}</mn><mo>,</mo><mn>{_short(value[1])}</mn><mo>]</mo></mrow>"
    return f"<mtext>{text(value)}</mtext>"


def _noise(noise: Mapping[str, Any], unit: str) -> Iterator[str]:
    filters, noise = noise.get("filter", []), {key: value for key, value in noise.items() if key != "filter"}
    for one in filters:
        rest = {key: value for key, value in one.items() if key not in ("state", "kind")}
        begins = "0" if one["kind"] == "actuator" else "its stationary law"
        words = f"which starts from {begins}, unless the start gives its states"
        yield f"{math(typeset.name(one['state']))}: filter {text(one['kind'])}, {_matrix(rest)}, {words}"
    if filters and not noise:
        return
    if "diffusion" in noise:
        yield f"Wiener, in the sense of Ito; diffusion {_matrix(noise['diffusion'])}"
        return
    law = str(noise.get("law", "as the model in Python has it"))
    levels = {key: value for key, value in noise.items() if key not in ("law", "matrix")}
    yield " ".join([text(law), *(f"{text(key.replace('_', ' '))} {_matrix(value)}" for key, value in levels.items())])
    if "matrix" in noise:
        yield f"through the matrix {_matrix(noise['matrix'])}"


def _start(start: Mapping[str, Any], states: tuple[str, ...]) -> str:
    if "point" in start:
        return _list(dict(zip(states, start["point"])))
    if isinstance(start.get("box"), list):
        return _signals(dict(zip(states, start["box"])))
    kind, data = next(iter(start.items()))
    inside = data.items() if isinstance(data, Mapping) else [("", data)]
    return " ".join([text(kind), *(f"{text(key)} {_matrix(value)}" for key, value in inside)])


def _asked(constraint: Inside, unit: str, states: tuple[str, ...]) -> Markup:
    label = str(constraint.label).removeprefix("outside ").removeprefix("inside ")
    region = constraint.region
    when = "" if constraint.during is None else f", from {constraint.during[0]:g} to {constraint.during[1]:g} {unit}"
    moves = " (moves with time)" if region.moving and "moving" not in label else ""
    return Markup(text(f"{label}{when}{moves}") + _faces(region, states))


def _faces(region: Region, states: tuple[str, ...]) -> str:
    """The inequalities of a polytope, which its label only counts, and all sides of a box that has many."""
    form = None if region.moving else region.form
    if not isinstance(form, Faces) or len(form.bounds) < 3 or (form.axial and len(states) <= 4):
        return ""
    rows = region.lifted(form.normals, len(states))
    bounds = form.bounds + form.normals @ region.center_at()
    pairs = zip(rows, bounds)
    lines = [
        math(f"{typeset.formula(_sum(row, states))}<mo>≤</mo>{_entry(float(bound))}") for row, bound in pairs
    ]
    return f"<details><summary>its {len(lines)} sides</summary>{'<br>'.join(lines)}</details>"


def _sum(row: Any, states: tuple[str, ...]) -> str:
    """A linear function of the states, as an expression."""
    factors = {1: "", -1: "-"}
    parts = [f"{factors.get(value, f'{value:.6g}*')}{name}" for value, name in zip(row, states) if value]
    return " + ".join(parts).replace("+ -", "- ") or "0"


def _matrix(value: Any) -> str:
    """A number, expression, vector or matrix."""
    if isinstance(value, Mapping):
        return ", ".join(f"{text(key)} {_matrix(entry)}" for key, entry in value.items())
    if not isinstance(value, (list, tuple)):
        return math(_entry(value))
    rows = [list(row) if isinstance(row, (list, tuple)) else [row] for row in value]
    if max(len(rows), *(len(row) for row in rows)) > LARGEST:
        return text(_in_words(rows))
    cells = "".join("<mtr>" + "".join(f"<mtd>{_entry(entry)}</mtd>" for entry in row) + "</mtr>" for row in rows)
    return math(f"<mrow><mo>[</mo><mtable>{cells}</mtable><mo>]</mo></mrow>")


def _in_words(rows: list[list[Any]]) -> str:
    """What can be said of a matrix that is too large to print."""
    size = f"{len(rows)} x {len(rows[0])}"
    diagonal = {str(row[k]) for k, row in enumerate(rows) if k < len(row)}
    off = any(entry not in (0, "0") for i, row in enumerate(rows) for j, entry in enumerate(row) if i != j)
    even = len(rows) == len(rows[0]) and len(diagonal) == 1 and not off
    return f"{size}, {diagonal.pop()} on the diagonal" if even else f"a matrix of {size}"


def _entry(value: Any) -> str:
    return typeset.formula(value) if isinstance(value, str) else f"<mn>{_short(value)}</mn>"


def _short(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, (int, float)) else text(value)
