"""Vectorised floating-point evaluation of a tape."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.problem.model.network_data import Part
from certbound.problem.model.operations import ROWS
from certbound.problem.model.tape import Tape


@lru_cache(maxsize=256)
def compile_numpy(tape: Tape) -> Callable[..., Array]:
    """A function that evaluates ``tape`` on arrays, in plain floating point (nothing is certified).

    ``evaluate(*inputs)`` takes one number or array per input slot, broadcast against each other to a shape ``batch``,
    and returns an array of shape ``(*batch, *tape.shape)``. Undefined operations give nan or inf.

    Examples
    --------
    >>> from certbound.problem.model import trace
    >>> evaluate = compile_numpy(trace(lambda x: [x[0] * x[1], 1.0], {"x": ["a", "b"]}))
    >>> evaluate([1.0, 2.0], 3.0)
    array([[3., 1.],
           [6., 1.]])
    """
    run = _runner(tape)
    count, entries, shape = len(tape.inputs), len(tape.outputs), tape.shape

    def evaluate(*inputs: ArrayLike) -> Array:
        if len(inputs) != count:
            raise ValueError(
                f"`inputs` must hold {count} values ({', '.join(tape.inputs)}), got {len(inputs)}."
            )
        arrays = [np.asarray(value, dtype=float)[()] for value in inputs]
        batch = np.broadcast_shapes(*(np.shape(array) for array in arrays))
        result = np.empty((*batch, entries))
        with np.errstate(all="ignore"):
            for position, value in enumerate(run(arrays)):
                result[..., position] = value
        return result.reshape((*batch, *shape))

    return evaluate


@lru_cache(maxsize=256)
def compile_scalar(tape: Tape) -> Callable[..., list[float]]:
    """The same on one point: a function of numbers that returns the list of outputs, without the care for shapes.

    It costs a few microseconds, and warns of undefined operations unless called under ``np.errstate``.
    """
    run = _runner(tape)
    return lambda *inputs: run(inputs)


def _runner(tape: Tape) -> Callable[[Sequence[Any]], list[Any]]:
    program, live, slots = _program(tape)
    outputs = [slots[output] for output in tape.outputs]

    def run(inputs: Sequence[Any]) -> list[Any]:
        values: list[Any] = [None] * live
        for target, function, args, number in program:
            if function is None:
                values[target] = number if not args else inputs[args[0]]
            elif number is None:
                values[target] = function(*[values[arg] for arg in args])
            else:  # an exponent, or the part of a network
                values[target] = function(*[values[arg] for arg in args], number)
        return [values[output] for output in outputs]

    return run


_Step = tuple[int, Callable[..., Any] | None, tuple[int, ...], float | Part | None]


def _program(tape: Tape) -> tuple[list[_Step], int, dict[int, int]]:
    """The steps that the outputs need, with registers reused as soon as their value is dead."""
    needed = set(tape.outputs)
    last = {output: len(tape.nodes) for output in tape.outputs}
    for index in range(len(tape.nodes) - 1, -1, -1):
        node = tape.nodes[index]
        if index in needed and node.op != "input":
            for arg in node.args:
                needed.add(arg)
                last.setdefault(arg, index)
    register: dict[int, int] = {}
    free: list[int] = []
    program: list[_Step] = []
    for index, node in enumerate(tape.nodes):
        if index not in needed:
            continue
        leaf = node.op in ("input", "const")
        args = node.args if leaf else tuple(register[arg] for arg in node.args)
        if not leaf:
            free += [register[arg] for arg in set(node.args) if last[arg] == index]
        register[index] = free.pop() if free else len(set(register.values()))
        number = node.value if node.op in ("const", "pow") else node.part
        program.append((register[index], None if leaf else ROWS[node.op].numpy, args, number))
    return program, len(set(register.values())), register
