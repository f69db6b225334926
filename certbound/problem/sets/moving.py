"""Sides of sets that are functions of t: how they are read, and whether they describe a set at all times.

A side that moves is a tape over ``("t",)``, in place of the number or the vector that it is otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.checks import frozen, number, vector
from certbound.problem.model import Graph, Node, Tape, compile_numpy, selected, trace

_TIMES = 2001  # times of the horizon at which sides are looked at


def read_sides(name: str, value: Any, length: int | None = None, *, infinite: bool = False) -> Array | Tape:
    """A vector of numbers, or its tape where an entry is a function of t.

    ``value`` is a vector, a function of t that returns one, a tape over ``("t",)``, or a vector with functions of t and
    such tapes among its entries. ValueError or TypeError where it is none of these, or of another ``length``.
    """
    if not (isinstance(value, Tape) or callable(value)):
        entries = _entries(value)
        if not any(isinstance(entry, Tape) or callable(entry) for entry in entries):
            return vector(name, value, length, infinite=infinite)
        read = [_side(f"{name}[{k}]", entry, infinite) for k, entry in enumerate(entries)]
        tape = stacked(read)
    else:
        tape = _over_time(name, value)
    if len(tape.shape) != 1:
        raise ValueError(f"`{name}` must be a vector over ('t',), got shape {tape.shape}.")
    if length is not None and tape.shape != (length,):
        raise ValueError(f"`{name}` must have {length} entries, got {tape.shape[0]}.")
    return tape if moves(tape) else vector(name, compile_numpy(tape)(0.0), length, infinite=infinite)


def read_side(name: str, value: Any) -> float | Tape:
    """One finite number, or the tape of a function of t, of shape (1,)."""
    if not (isinstance(value, Tape) or callable(value)):
        return number(name, value)
    tape = _over_time(name, value)
    if tape.shape != (1,):
        raise ValueError(f"`{name}` must be one number at every t, got shape {tape.shape}.")
    return tape if moves(tape) else number(name, compile_numpy(tape)(0.0))


def moves(tape: Tape) -> bool:
    """Whether a tape reads its input."""
    return any(node.op == "input" for node in tape.nodes)


def stacked(entries: Sequence[float | Tape]) -> Tape:
    """The tape over ``("t",)`` of numbers, infinite ones too, and of tapes with one output."""
    nodes: list[Node] = []
    outputs: list[int] = []
    for entry in entries:
        first = len(nodes)
        if isinstance(entry, Tape):
            nodes += [node if node.op == "input" else node._replace(args=tuple(arg + first for arg in node.args))
                      for node in entry.nodes]  # fmt: skip
            outputs.append(first + entry.outputs[0])
        else:
            nodes.append(Node("const", (), float(entry)))
            outputs.append(first)
    return Tape(inputs=("t",), nodes=tuple(nodes), outputs=tuple(outputs), shape=(len(entries),))


def entries_of(value: Array | Tape | float) -> list[float | Tape]:
    """The entries of sides, as `stacked` takes them: numbers, and a tape of one output for each that moves."""
    if not isinstance(value, Tape):
        return [float(entry) for entry in np.atleast_1d(value)]
    found: list[float | Tape] = []
    for place, output in enumerate(value.outputs):
        if value.nodes[output].op == "const":
            found.append(value.nodes[output].value)
        else:
            one = selected(value, [place], None)
            found.append(one if moves(one) else float(compile_numpy(one)(0.0)[0]))
    return found


def shifted(sides: Array | Tape, center: Array | Tape | None) -> Array | Tape:
    """Sides plus the centre that they are about; an infinite one stays as it is."""
    if center is None:
        return sides
    both = zip(entries_of(sides), entries_of(center))
    found = [side if isinstance(side, float) and np.isinf(side) else _sum(side, place) for side, place in both]
    return stacked(found) if any(isinstance(one, Tape) for one in found) else frozen(found)


def times_of(window: tuple[float, float], discrete: bool) -> Array:
    """Times of a window at which sides are looked at: its steps, or some instants of it, both ends included."""
    first, last = window
    if discrete and last - first < 10 * _TIMES:
        return np.arange(first, last + 1.0)
    found = np.linspace(first, last, _TIMES)
    return np.unique(np.round(found)) if discrete else found


def check_over_time(name: str, region: Any, window: tuple[float, float], discrete: bool) -> None:
    """Refuse sides that are not defined, or describe no set, at some time of a window, with a ValueError.

    It looks at the steps, or at some instants: what happens in between is for proofs.
    """
    if not region.changing:
        return
    if np.isinf(window[1]):
        raise ValueError(f"`{name}` must have sides that rest where the horizon is infinite; give a finite horizon.")
    times = times_of(window, discrete)
    for field, tape in region.sides.items():
        value = compile_numpy(tape)(times)
        limits = [place for place, entry in enumerate(entries_of(tape)) if isinstance(entry, Tape)]
        bad = ~np.isfinite(value[:, limits])
        if bad.any():
            when, place = map(int, np.argwhere(bad)[0])
            raise ValueError(
                f"`{name}` must have sides that are defined whenever the set counts, but its `{field}` is "
                f"{value[when, limits[place]]:g} at t = {times[when]:.6g}; mend the expression, or give the set a "
                "window `during` in which it is defined."
            )
        if field == "radius" and np.any(value <= 0):
            when = int(np.argmax(value[:, 0] <= 0))
            raise ValueError(
                f"`{name}` must have a positive `radius` at all times, got {value[when, 0]:g} at "
                f"t = {times[when]:.6g}; mend the expression, or end the set's `during` before that."
            )
    if region.sides.keys() & {"low", "high"}:
        _check_order(name, region, times)


def _check_order(name: str, region: Any, times: Array) -> None:
    low, high = (
        compile_numpy(side)(times) if isinstance(side, Tape) else np.broadcast_to(side, (len(times), len(side)))
        for side in (region.low, region.high)
    )
    if np.any(low > high):
        when, place = map(int, np.argwhere(low > high)[0])
        raise ValueError(
            f"`{name}` must have `low` at most `high` at all times, got {low[when, place]:g} > {high[when, place]:g} "
            f"in entry {place} at t = {times[when]:.6g}; mend the sides, or end the set's `during` before that."
        )


def _sum(side: float | Tape, place: float | Tape) -> float | Tape:
    if isinstance(side, float) and isinstance(place, float):
        return side + place
    graph = Graph(("t",))
    ends = [
        one.evaluate(graph.arithmetic(), [graph.input(0)])[0] if isinstance(one, Tape) else graph.const(one)
        for one in (side, place)
    ]
    return graph.tape([graph.apply("add", *ends)], (1,))


def _entries(value: Any) -> list[Any]:
    listed = isinstance(value, (list, tuple)) or (isinstance(value, np.ndarray) and value.dtype.kind == "O")
    return list(value) if listed else []


def _side(name: str, entry: Any, infinite: bool) -> float | Tape:
    if isinstance(entry, Tape) or callable(entry):
        return read_side(name, entry)
    return number(name, entry, infinite=infinite)


def _over_time(name: str, value: Any) -> Tape:
    tape: Tape = value if isinstance(value, Tape) else trace(value, {"t": ["t"]})
    if tape.inputs != ("t",):
        raise ValueError(f"`{name}` must be a function of t alone, got one of {', '.join(tape.inputs) or 'nothing'}.")
    return tape
