"""What is put beside a plant to close its loop: an observer by its gain, or a python-control system, as tapes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.checks import matrix, names
from certbound.problem.adapters import import_block, is_symbolic, read_model
from certbound.problem.model import Graph, Tape, jacobian, sources, substitute
from certbound.problem.signals import diffusion_of
from certbound.problem.systems import System


@dataclass(frozen=True, eq=False, kw_only=True)
class Part:
    """States beside the plant's, and tapes over named signals.

    ``moves``: their rate or next value, over t, these states, the measurements and the plant's inputs. ``law``: the
    plant's inputs, over t, these states and the measurements (None where the plant has none). ``slope``: the derivative
    of ``moves`` by the measurements, over t and these states; None where it depends on more.
    """

    states: tuple[str, ...]
    moves: Tape
    law: Tape | None
    slope: Tape | None


class Wires:
    """A graph over named signals, and the nodes of other tapes in it."""

    def __init__(self, inputs: Sequence[str]) -> None:
        self.graph = Graph(inputs)
        self.known = {name: self.graph.input(slot) for slot, name in enumerate(inputs)}

    def run(self, tape: Tape, given: Mapping[str, int] | None = None) -> list[int]:
        """The nodes of a tape's outputs; its inputs are ``given``, or signals by their names."""
        values = {**self.known, **(given or {})}
        found: list[int] = tape.evaluate(self.graph.arithmetic(), [values[name] for name in tape.inputs])
        return found

    def numbers(self, values: Array) -> list[int]:
        """Constants, row by row."""
        return [self.graph.const(value) for value in np.ravel(values)]

    def dot(self, left: Sequence[int], right: Sequence[int]) -> int:
        """The sum of products."""
        total = self.graph.const(0.0)
        for a, b in zip(left, right):
            total = self.graph.apply("add", total, self.graph.apply("mul", int(a), int(b)))
        return total


def measurements(measured: Tape) -> tuple[str, ...]:
    """Names of the measurements, which no signal can have."""
    return tuple(f"measurement {k}" for k in range(len(measured.outputs)))


def as_tape(value: Array | Tape) -> Tape:
    """Numbers as a tape."""
    if isinstance(value, Tape):
        return value
    wires = Wires(())
    return wires.graph.tape(wires.numbers(value), value.shape)


def function_of(name: str, value: Any, states: Sequence[str]) -> Tape:
    """h(t, x), given as a function, as expressions or as the matrix of one, over t and the states."""
    if callable(value) or isinstance(value, Tape) or is_symbolic(value):
        return value if isinstance(value, Tape) else read_model(value, {"t": ["t"], "x": states})
    rows = matrix(name, value, columns=len(states))
    return read_model(lambda x: rows @ x, {"t": ["t"], "x": states})


def observer_of(system: System, gain: Any, measured: Tape, feedback: Any, model: Any) -> Part:
    """An observer of the plant's own states, by its gain."""
    own, inputs = system.states, system.input_names
    seen = names("observer", [f"{name}_hat" for name in own], (*own, *inputs, *system.disturbance_names))
    given = measurements(measured)
    slope = as_tape(diffusion_of(gain, own, "observer"))
    if slope.shape[1] != len(given):
        raise ValueError(f"`observer` must have {len(given)} columns, one per measurement, got shape {slope.shape}.")
    rename = dict(zip(own, seen))
    slope, believed, expected = (_renamed(tape, rename) for tape in (slope, _believed(system, model), measured))
    wires = Wires(("t", *seen, *given, *inputs))
    apply = wires.graph.apply
    misses = [apply("sub", wires.known[name], guess) for name, guess in zip(given, wires.run(expected))]
    rows = np.reshape(wires.run(slope), slope.shape)
    moved = [apply("add", step, wires.dot(row, misses)) for step, row in zip(wires.run(believed), rows)]
    law = _fed_back(system, feedback, own)
    return Part(
        states=seen, moves=wires.graph.tape(moved, (len(own),)), slope=slope,
        law=None if law is None else _renamed(law, rename),
    )  # fmt: skip


def controller(system: System, block: Any, count: int, feedback: Any) -> Part:
    """A python-control system behind ``count`` measurements and, where it has more inputs, the plant's inputs."""
    found = import_block(block, system.time)
    inputs = system.input_names
    if len(found.inputs) not in (count, count + len(inputs)):
        raise ValueError(
            f"`observer` must have {count} inputs (the measurements), or {count + len(inputs)} with the plant's inputs "
            f"behind them, got {len(found.inputs)}."
        )
    taken = {*system.states, *inputs, *system.disturbance_names}
    states = tuple(name if name not in taken else f"{name}_hat" for name in found.states)
    names("observer", states, taken)
    given = tuple(f"measurement {k}" for k in range(count))
    arguments = {"t": ["t"], "x": states, "u": (*given, *(inputs if len(found.inputs) > count else ()))}
    moves, shown = (read_model(lambda t, x, u, f=f: f(t, x, u), arguments) for f in (found.moves, found.shows))
    if any(slot > len(states) + count for slot in set[int]().union(*sources(shown))):
        raise ValueError("`observer` must not pass the plant's inputs on to its outputs at once.")
    first, last = 1 + len(states), 1 + len(states) + count
    shown = Tape(inputs=shown.inputs[:last], nodes=shown.nodes, outputs=shown.outputs, shape=shown.shape)
    slope = _slope(moves, first, last)
    return Part(states=states, moves=moves, slope=slope, law=_shown_to(system, shown, feedback))


def _slope(moves: Tape, first: int, last: int) -> Tape | None:
    """The derivative by the inputs ``first`` to ``last``; None where the function is not affine in them.

    That the derivative does not depend on them does not say so alone: that of a jump is 0.
    """
    depends: list[bool] = []
    for node in moves.nodes:
        depends.append(first <= node.args[0] < last if node.op == "input" else any(depends[arg] for arg in node.args))
        plain = node.op in ("input", "add", "sub", "neg", "mul") or (node.op == "div" and not depends[node.args[1]])
        if depends[-1] and not plain:
            return None
    slope = jacobian(moves, range(first, last))
    if any(slot >= first for slot in set[int]().union(*sources(slope))):
        return None
    return substitute(slope, slope.inputs[:first], dict.fromkeys(slope.inputs[first:], 0.0))


def _renamed(tape: Tape, names_of: Mapping[str, str]) -> Tape:
    inputs = tuple(names_of.get(name, name) for name in tape.inputs)
    return Tape(inputs=inputs, nodes=tape.nodes, outputs=tape.outputs, shape=tape.shape)


def _believed(system: System, model: Any) -> Tape:
    """m(t, x, u): the given model, or the plant with its disturbances in the middle."""
    inputs = ("t", *system.states, *system.input_names)
    if model is None:
        box = system.disturbance
        middle = {} if box is None else dict(zip(system.disturbance_names, (0.5 * (box.low + box.high)).tolist()))
        return substitute(system.dynamics, inputs, middle)
    arguments: dict[str, Sequence[str]] = {"t": ["t"], "x": system.states}
    tape = read_model(model, arguments | ({"u": system.input_names} if system.input_names else {}))
    if len(tape.outputs) != system.dimension:
        raise ValueError(f"`model` must return {system.dimension} values, one per state, got {len(tape.outputs)}.")
    return tape


def _fed_back(system: System, feedback: Any, entries: Sequence[str]) -> Tape | None:
    """k(t, x) over t and ``entries``; None for a plant without inputs."""
    wanted = len(system.input_names)
    if not wanted:
        if feedback is not None:
            raise ValueError("`feedback` must be omitted for a plant without inputs.")
        return None
    if feedback is None:
        named = ", ".join(system.input_names)
        raise ValueError(f"`feedback` must give the plant's inputs ({named}) from the estimate.")
    if not (callable(feedback) or isinstance(feedback, Tape) or is_symbolic(feedback)):
        raise TypeError(f"`feedback` must be a function, got {feedback!r}; write its sign: lambda x: -K @ x.")
    tape = function_of("feedback", feedback, entries)
    if len(tape.outputs) != wanted:
        raise ValueError(f"`feedback` must return {wanted} values, one per input, got {len(tape.outputs)}.")
    return tape


def _shown_to(system: System, shown: Tape, feedback: Any) -> Tape | None:
    """The plant's inputs from a block's outputs, directly or by the feedback."""
    count, wanted = len(shown.outputs), len(system.input_names)
    if feedback is None and wanted:
        if count != wanted:
            raise ValueError(
                f"`observer` must have {wanted} outputs (the plant's inputs), got {count}; give `feedback` where they "
                "are estimates."
            )
        return shown
    entries = system.states if count == system.dimension else tuple(f"e{k + 1}" for k in range(count))
    law = _fed_back(system, feedback, entries)
    if law is None:
        return None
    return substitute(law, shown.inputs, {name: (shown, place) for place, name in enumerate(entries)})
