"""Functions of t that limits are: numbers, or tapes over ``("t",)`` with one output; their ranges are proved.

Sums and quotients are tapes too, so that nothing is rounded but what is enclosed in the end.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from certbound.arrays import Array
from certbound.errors import EnclosureError
from certbound.problem.model import JUMPS, Graph, Tape, arithmetic, compile_numpy, jacobian, needed, turned_tape
from certbound.rigor.intervals import Interval

Formula = float | Tape

_CELLS = 2048  # parts of a window in which a function of t is enclosed
_MOST_STEPS = 200_000  # steps of discrete time that are looked at


def combined(op: str, first: Formula, *others: Formula) -> Formula:
    """The formula that an operation of two arguments makes of some others, from left to right."""
    graph = Graph(("t",))
    node, *rest = (node_of(graph, part, graph.input(0)) for part in (first, *others))
    for other in rest:
        node = graph.apply(op, node, other)
    return _finished(graph, node)


def scaled(part: Formula, factor: float, *, over: float = 1.0) -> Formula:
    """A formula times a number, over another one."""
    return combined("div", combined("mul", part, factor), over)


def composed(part: Formula, first: float, last: float) -> Formula:
    """A formula as it is between two times, and from there on as it is at these."""
    graph = Graph(("t",))
    time = graph.apply("min", graph.apply("max", graph.input(0), graph.const(first)), graph.const(last))
    return _finished(graph, node_of(graph, part, time))


def node_of(graph: Graph, part: Formula, time: int) -> int:
    """The node of a formula at a node of time."""
    if not isinstance(part, Tape):
        return graph.const(part)
    return int(part.evaluate(graph.arithmetic(), [time])[0])


def difference(a: Formula, b: Formula) -> Formula:
    """a - b; a number where the two move in the same way."""
    found = combined("sub", a, b)
    if not isinstance(found, Tape):
        return found
    plain = turned_tape(replace(found, inputs=("t", "unused")), np.eye(1))[0]  # it asks for a state
    node = plain.nodes[plain.outputs[0]]
    return node.value if node.op == "const" else found


def at_time(part: Formula, t: float) -> Interval:
    """Enclosure of the value at a time, which is one number where it is known exactly."""
    if not isinstance(part, Tape):
        return Interval.point(part)
    graph = Graph(("t",))
    found = _finished(graph, node_of(graph, part, graph.const(t)))
    if not isinstance(found, Tape):
        return Interval.point(found)
    value: Interval = found.evaluate(arithmetic("interval"), [Interval.point(t)])[0]
    return value


def at_start(part: Formula) -> Interval:
    """Enclosure of the value at time 0."""
    return at_time(part, 0.0)


def may_jump(part: Formula) -> bool:
    """Whether it uses operations that jump, although their slopes are bounded on both sides."""
    if not isinstance(part, Tape):
        return False
    used = needed(part.nodes, part.outputs)
    return any(kept and node.op in (*JUMPS, "atan2") for kept, node in zip(used, part.nodes))


def values(part: Formula, times: Array) -> Array:
    """The values at times, in plain floating point."""
    if not isinstance(part, Tape):
        return np.full(len(times), part)
    return np.asarray(compile_numpy(part)(times)[:, 0])


def range_over(part: Formula, window: tuple[float, float], *, discrete: bool) -> tuple[float, float]:
    """Bounds of all values over a window, in discrete time over its steps.

    Cell by cell the mean value theorem sharpens plain interval arithmetic: f(m) + f'(cell) (cell - m). It holds of
    functions with kinks; those that jump have to be refused before.

    Raises
    ------
    EnclosureError
        If the function is not defined, or not bounded, somewhere in the window; or the window has too many steps.
    """
    if not isinstance(part, Tape):
        return part, part
    first, last = window
    if discrete and last - first > _MOST_STEPS:
        raise EnclosureError(f"limits that move are looked at over {_MOST_STEPS} steps at most, got {last - first:g}.")
    if discrete or first == last:
        times = np.arange(first, last + 1.0) if discrete else np.array([first])
        found = _evaluated(part, Interval(times, times))[0]
    else:
        ends = np.linspace(first, last, _CELLS + 1)
        ends[-1] = last
        cells, middles = Interval(ends[:-1], ends[1:]), Interval.point((ends[:-1] + ends[1:]) / 2)
        plain, near = _evaluated(part, cells)[0], _evaluated(part, middles)[0]
        fine = plain if may_jump(part) else near + _evaluated(_slope(part), cells)[0] * (cells - middles)
        low, high = np.fmax(plain.lo, fine.lo), np.fmin(plain.hi, fine.hi)
        found = Interval(np.minimum(low, high), np.maximum(low, high))
    if not (np.all(np.isfinite(found.lo)) and np.all(np.isfinite(found.hi))):
        place = part.describe(part.outputs[0])
        raise EnclosureError(f"{place} is not defined, or not bounded, for some t in [{first:g}, {last:g}].")
    return float(np.min(found.lo)), float(np.max(found.hi))


def _evaluated(tape: Tape, t: Interval) -> list[Interval]:
    zero = Interval.point(np.zeros(np.shape(t.lo)))
    with np.errstate(all="ignore"):
        return [zero + value for value in tape.evaluate(arithmetic("interval"), [t])]


@lru_cache(maxsize=256)
def _slope(tape: Tape) -> Tape:
    return jacobian(tape, [0])


def _finished(graph: Graph, node: int) -> Formula:
    value = graph.number(node)
    return graph.tape([node], (1,)) if value is None else value
