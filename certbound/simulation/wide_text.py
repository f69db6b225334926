"""Kernels of models with many states: arrays and loops, where one line a number would take minutes to compile.

The nodes of a tape that do the same thing and need nothing of each other are one loop, over the places of their
arguments in an array of all values.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from certbound.arrays import Array
from certbound.problem.model import OPERATIONS, Node, Tape, needed
from certbound.simulation.tape_text import Parameters, indent, power

NARROW = 16
"""States of a model whose kernel has a variable for each."""

_MOST_LOOPS = 400
_NAME = re.compile(r"\b([xyabfh])_(\d+|i)\b")

_Kind = tuple[int, str, float]


def fits(tape: Tape, dimension: int) -> bool:
    """Whether a drift is written as loops: many states, and many nodes that do the same thing."""
    if dimension <= NARROW or any(node.part is not None for node in tape.nodes):
        return False
    return len(_groups(tape)) <= _MOST_LOOPS


def in_arrays(lines: Sequence[str]) -> list[str]:
    """Lines whose states x_0, x_1, ... (also y, f, and the noise-free a, b, h) are entries of arrays."""
    return [_NAME.sub(r"\1[\2]", line) for line in lines]


def array_function(name: str, tape: Tape, dimension: int, others: Sequence[str], p: Parameters) -> list[str]:
    """Source of ``name(p, t, x, *others, values, out)``, which writes a tape's outputs to the array ``out``.

    ``others`` name the inputs after the states; `values_count` is the length that ``values`` must have.
    """
    groups = _groups(tape)
    constants = groups.pop((0, "const", 0.0), [])
    place = {index: tape.nodes[index].args[0] for index in groups.pop((0, "input", 0.0), [])}
    count = len(tape.inputs)
    lines = ["values[0] = t", f"values[1:{1 + dimension}] = x"]
    lines += [f"values[{1 + dimension + i}] = {other}" for i, other in enumerate(others)]
    if constants:
        first = p.extend([tape.nodes[index].value for index in constants])
        lines += [f"values[{count}:{count + len(constants)}] = p[{first}:{first + len(constants)}]"]
        place |= {index: count + i for i, index in enumerate(constants)}
        count += len(constants)
    for (_, op, exponent), members in sorted(groups.items()):
        members.sort(key=lambda index: [place[arg] for arg in tape.nodes[index].args])
        arity = len(tape.nodes[members[0]].args)
        rows = [[place[tape.nodes[index].args[slot]] for index in members] for slot in range(arity)]
        operands = [f"values[{p.place(row, 'q')}]" for row in rows]
        text = power(operands[0], exponent, p) if op == "pow" else OPERATIONS[op].kernel.format(*operands)
        lines += [f"for q in range({len(members)}):", f"    values[{count} + q] = {text}"]
        place |= {index: count + i for i, index in enumerate(members)}
        count += len(members)
    results = p.place([place[output] for output in tape.outputs], "q")
    lines += [f"for q in range({len(tape.outputs)}):", f"    out[q] = values[{results}]"]
    arguments = ", ".join(["p", "t", "x", *others, "values", "out"])
    return [f"def {name}({arguments}):", *indent(lines)]


def values_count(tape: Tape) -> int:
    """Length of the array of values that a tape's function works in."""
    return len(tape.inputs) + sum(needed(tape.nodes, tape.outputs))


def product(matrix: Array, source: str, target: str, p: Parameters) -> list[str]:
    """Lines that add ``matrix . source`` to the array ``target``."""
    rows, columns = matrix.shape
    entries: tuple[NDArray[np.intp], ...] = np.nonzero(matrix.T)
    count = len(entries[0])
    if 4 * count > rows * columns:  # column by column: no sum across lanes
        first = p.extend(matrix.T.ravel().tolist())
        inner = [f"for i in range({rows}):", f"    {target}[i] += p[{first} + j * {rows} + i] * factor"]
        return [f"for j in range({columns}):", f"    factor = {source}[j]", *indent(inner)]
    if count == 0:
        return []
    first = p.extend(matrix.T[entries].tolist())
    to, of = p.place(entries[1].tolist(), "q"), p.place(entries[0].tolist(), "q")
    return [f"for q in range({count}):", f"    {target}[{to}] += p[{first} + q] * {source}[{of}]"]


def _groups(tape: Tape) -> dict[_Kind, list[int]]:
    """Nodes by (how many operations deep, operation, exponent)."""
    depth: dict[int, int] = {}
    groups: dict[_Kind, list[int]] = {}
    for index, live in enumerate(needed(tape.nodes, tape.outputs)):
        if live:
            node: Node = tape.nodes[index]
            args = () if node.op == "input" else node.args
            depth[index] = 1 + max((depth[arg] for arg in args), default=-1)
            groups.setdefault((depth[index], node.op, node.value if node.op == "pow" else 0.0), []).append(index)
    return groups
