"""What a kernel counts: source lines that watch a path.

Every function returns four lists of lines: before the first step, within a step (old state x_i, new state
y_i), at the end of a step, and after the last one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from certbound.arrays import Array
from certbound.simulation.gap_tests import EXPONENT, Barrier, Bridge, barrier_source
from certbound.simulation.tape_text import Parameters, each, indent, linear_form

Lines = tuple[list[str], list[str], list[str], list[str]]

LOWEST = -40
"""Deviations below 2**LOWEST fall into the histograms' first bin."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Task:
    """What a kernel does with the paths."""

    # ``exits`` (stop at the first exit, count it by constraint and time), ``deviation`` (histograms of the
    # largest distance to the associated noise-free path) or ``record`` (store states)
    kind: Literal["exits", "deviation", "record"]
    barriers: Sequence[Barrier] = ()  # constraints of an ``exits`` task
    goal: Barrier | None = None  # its target, where it has one: a path that never enters it counts in a last row
    keep: Barrier | None = None  # the target again, where it is to be stayed in
    norm: Array | None = None  # (rows, n): the deviation s is measured by ‖norm s‖ ...
    directions: Array | None = None  # (rows, n): ... or by the value of each directions . s (with one histogram each)
    # whether each path has a noise-free path of its own (which shares its start and disturbance); otherwise all
    # share one. In a ``record`` task: whether to store the deviation instead of the state.
    own_nominal: bool = True
    smallest_scale: float = 0.0  # smallest value of the profile that deviations are divided by; 0: no profile
    marked: bool = False  # whether histograms are also taken at marked steps
    # bins per factor of two of the histograms of suprema, and of those at the marked times
    densities: tuple[float, float] = (1.0, 1.0)


def task_source(task: Task, dimension: int, bridge: Bridge | None, nominal_step: list[str], p: Parameters) -> Lines:
    """Lines of a task; ``nominal_step`` advances the noise-free path from a_i to b_i."""
    if task.kind == "exits":
        return _exits(task, bridge, p)
    begin: list[str] = []
    within: list[str] = []
    end: list[str] = []
    if task.own_nominal:
        begin, within, end = (
            each("a_{0} = x_{0}", dimension, p),
            nominal_step,
            each("a_{0} = b_{0}", dimension, p),
        )
    elif task.kind == "deviation":
        within = each("b_{0} = nominal[k + 1, {0}]", dimension, p)
    watch = _record if task.kind == "record" else _deviation
    lines = watch(task, dimension, bridge, p)
    return begin + lines[0], within + lines[1], end + lines[2], lines[3]


def _exits(task: Task, bridge: Bridge | None, p: Parameters) -> Lines:
    begin, within, end, column = ["left = -1"], list[str](), list[str](), 0
    for number, barrier in enumerate(task.barriers):
        before, during, after = barrier_source(number, barrier, bridge, p, column)
        begin, within, end = begin + before, within + during, end + after
        column += barrier.columns
    if task.goal is not None:
        number = len(task.barriers)
        goal = barrier_source(number, task.goal, bridge, p, column)
        if task.keep is None:
            return _until_goal(number, goal, (begin, within, end))
        column += task.goal.columns
        keep = barrier_source(number + 1, task.keep, bridge, p, column)
        return _kept_goal(number, goal, keep, (begin, within, end))
    begin += ["if left >= 0:", *indent([*_count("left", "0"), "continue"])]
    within += ["if left >= 0:", *indent([*_count("left", _BIN), "break"])]
    return begin, within, end, []


_BIN = "1 + k * (counts.shape[1] - 1) // steps"


def _count(row: str, column: str) -> list[str]:
    """Lines that count a path that fails, and write the row, from 1 on, to where its outcome is asked."""
    return [f"counts[{row}, {column}] += 1", "if out.shape[0] > 0:", f"    out[path, 0, 0] = {row} + 1.0"]


def _until_goal(
    number: int, watch: tuple[list[str], list[str], list[str]], lines: tuple[list[str], list[str], list[str]]
) -> Lines:
    """A path ends without failing when it runs into the goal; one that never does fails as its window ends."""
    begin, within, end = lines[0], lines[1], lines[2] + watch[2]
    begin += ["if left >= 0:", *indent([*_count("left", "0"), "continue"])]
    begin += [*watch[0], "if left >= 0:", "    continue"]
    within += ["if left >= 0:", *indent([*_count("left", _BIN), "break"])]
    within += [*watch[1], "if left >= 0:", "    break", f"if k + 1 >= windows[{number}, 1]:", "    break"]
    return begin, within, end, ["if left < 0:", *indent(_count(str(number), "counts.shape[1] - 1"))]


def _kept_goal(
    number: int, watch: tuple[list[str], list[str], list[str]], keep: tuple[list[str], list[str], list[str]],
    lines: tuple[list[str], list[str], list[str]],
) -> Lines:  # fmt: skip
    """A path fails that leaves the goal once it has run into it, or never does (in discrete time: no bridges)."""
    leaves = ["if left >= 0:", *indent([*_count("left", _BIN), "break"])]
    arrives = ["if left >= 0:", "    left = -1", "    arrived = True"]
    begin = [*lines[0], "if left >= 0:", *indent([*_count("left", "0"), "continue"])]
    begin += [*keep[0], "left = -1", *watch[0], "arrived = False", *arrives]
    within = [*lines[1], *leaves, "if arrived:", *indent([*keep[1], *leaves]), "else:", *indent([*watch[1], *arrives])]
    within += [f"if not arrived and k + 1 >= windows[{number}, 1]:", "    break"]
    finish = ["if left < 0 and not arrived:", *indent(_count(str(number), "counts.shape[1] - 1"))]
    return begin, within, [*lines[2], *keep[2], *watch[2]], finish


def _record(task: Task, dimension: int, bridge: Bridge | None, p: Parameters) -> Lines:
    def store(place: str, value: str) -> list[str]:
        return indent(each(f"out[path, {place}, {{0}}] = {value}", dimension, p))

    begin = [
        "mark = 0",
        "if marks[0] == 0:",
        *store("0", "0.0" if task.own_nominal else "x_{0}"),
        "    mark = 1",
    ]
    value = "y_{0} - b_{0}" if task.own_nominal else "y_{0}"
    within = ["if mark < marks.shape[0] and marks[mark] == k + 1:", *store("mark", value), "    mark += 1"]
    return begin, within, [], []


def _deviation(task: Task, dimension: int, bridge: Bridge | None, p: Parameters) -> Lines:
    within = [f"s_{i} = y_{i} - b_{i}" for i in range(dimension)]
    if task.smallest_scale > 0.0:
        within += ["scale = profile[k + 1]", *[f"s_{i} = s_{i} / scale" for i in range(dimension)]]
    rows = task.norm if task.norm is not None else task.directions
    rows = np.eye(dimension) if rows is None else rows
    radial = task.norm is not None and len(rows) > 1
    count = 1 if radial else len(rows)
    watch = _norm_supremum if radial else _scalar_suprema
    within += watch(task, rows, dimension, bridge, p)
    begin = [f"old_{j} = top_{j} = limit_{j} = 0.0" for j in range(count)]
    end = [f"old_{j} = new_{j}" for j in range(count)]
    sup, marginal = (p.add(density) for density in task.densities)
    value, top, finish = "new_{0}", "top_{0}", []
    if radial:
        value = "math.sqrt(new_{0})"
        if bridge is None:
            finish, top = ["top_0 = math.sqrt(limit_0)"], "math.sqrt(limit_{0})"
    if bridge is not None and _late(task, bridge) and not radial:
        spreads = [bridge.variance(row.tolist(), p) for row in rows]
        asked = [
            f"top_{j} = raise_top(stream, track_{j}, at, top_{j}, {spread}, {EXPONENT})"
            for j, spread in enumerate(spreads)
        ] + ["at = 0"]
        for j in range(count):
            begin += [f"track_{j} = np.empty(STRETCH + 1)", f"track_{j}[0] = 0.0"]
        begin += ["at = 0"]
        within += ["at += 1", *[f"track_{j}[at] = new_{j}" for j in range(count)]]
        due = "at == STRETCH or (mark < marks.shape[0] and marks[mark] == k + 1)" if task.marked else "at == STRETCH"
        within += [f"if {due}:", *indent(asked)]
        finish += asked
    begin = ["mark = 0", *begin] if task.marked else begin
    within += ["if mark < marks.shape[0] and marks[mark] == k + 1:"] if task.marked else []
    for j in range(count if task.marked else 0):
        for kind, text in enumerate((value, top)):
            bin_of = f"bin_of({text.format(j)}, {LOWEST}.0, {marginal}, marginals.shape[3])"
            within += [f"    marginals[{kind}, mark, {j}, {bin_of}] += 1"]
    within += ["    mark += 1"] if task.marked else []
    finish += [f"counts[{j}, bin_of(top_{j}, {LOWEST}.0, {sup}, counts.shape[1])] += 1" for j in range(count)]
    return begin, within, end, finish


def _norm_supremum(task: Task, norm: Array, n: int, bridge: Bridge | None, p: Parameters) -> list[str]:
    """The largest ‖norm s‖: squares are compared, and roots and bridges evaluated near the record only."""
    legs = [f"e_{i}" for i in range(len(norm))]
    deviation = [f"s_{i}" for i in range(n)]
    lines = [f"{leg} = {linear_form(row.tolist(), deviation, p)}" for leg, row in zip(legs, norm)]
    lines += [f"new_0 = {' + '.join(f'{leg} * {leg}' for leg in legs)}"]
    if bridge is None:
        return [*lines, "if new_0 > limit_0:", "    limit_0 = new_0"]
    near = ["before = math.sqrt(old_0)", "after = math.sqrt(new_0)", "top_0 = max(top_0, after)"]
    shrink = " / (scale * scale)" if task.smallest_scale > 0.0 else ""
    even = bridge.even_variance(norm)
    if even > 0.0 and not shrink:
        spread = p.add(even)
    else:
        near += [f"w_{i} = {linear_form(norm[:, i].tolist(), legs, p)}" for i in range(n)]
        variance = bridge.moving_variance([f"w_{i}" for i in range(n)], p)
        near += [f"spread = ({variance}) / new_0{shrink} if new_0 > 0.0 else 0.0"]
        spread = "spread"
    near += _bridge_top("0", "before", "after", spread, p)
    if bridge.spread is not None:
        band = _band(norm @ bridge.spread, task)
        near += [f"limit_0 = max(top_0 - {p.add(band)}, 0.0) ** 2"]
    return [*lines, "if new_0 > limit_0 or old_0 > limit_0:", *indent(near)]


def _scalar_suprema(task: Task, rows: Array, n: int, bridge: Bridge | None, p: Parameters) -> list[str]:
    """The largest value of each row . s, or of |row . s| in a norm of one row."""
    lines = []
    shrink = " / (scale * scale)" if task.smallest_scale > 0.0 else ""
    for j, row in enumerate(rows):
        value = linear_form(row.tolist(), [f"s_{i}" for i in range(n)], p)
        lines += [f"new_{j} = {value}" if task.norm is None else f"new_{j} = abs({value})"]
        if bridge is None or _late(task, bridge):
            lines += [f"top_{j} = max(top_{j}, new_{j})"]
            continue
        spread = bridge.variance(row.tolist(), p)
        lines += [f"spread = ({spread}){shrink}"]
        half = f"{0.5 * EXPONENT} * spread"
        top = _bridge_top(str(j), f"old_{j}", f"new_{j}", "spread", p, tested=True)
        near = [f"top_{j} = max(top_{j}, new_{j})", *top]
        lines += [f"if (top_{j} - old_{j}) * (top_{j} - new_{j}) < {half}:", *indent(near)]
    return lines


def _late(task: Task, bridge: Bridge) -> bool:
    """Whether the bridges of scalar values are alike, and are looked at when a stretch of steps is over."""
    return bridge.spread is not None and task.smallest_scale <= 0.0


def _bridge_top(j: str, before: str, after: str, spread: str, p: Parameters, tested: bool = False) -> list[str]:
    """Draw the largest value of the bridge between two values where it can exceed the record."""
    product = f"2.0 * (top_{j} - {before}) * (top_{j} - {after})"
    variance = p.value_of(spread)
    if variance is None:
        exponent = f"{product} / {spread} if {spread} > 0.0 else math.inf"
    else:
        exponent = f"{product} * {p.add(1.0 / variance if variance > 0.0 else np.inf)}"
    draw = [f"top_{j} = rise_between(stream, {before}, {after}, exponent, {spread}, top_{j})"]
    if tested:
        return [f"exponent = {exponent}", *draw]
    return [f"exponent = {exponent}", f"if exponent < {EXPONENT}:", *indent(draw)]


def _band(spread: Array, task: Task) -> float:
    """Distance from the record beyond which no bridge matters (2 u^2 > EXPONENT v)."""
    largest = float(np.linalg.norm(spread, 2)) / (task.smallest_scale or 1.0)
    return float(np.sqrt(0.5 * EXPONENT)) * largest
