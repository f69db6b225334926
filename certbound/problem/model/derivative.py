"""Exact derivatives of a tape, as a tape (forward mode)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

from certbound.problem.model.graph import Graph
from certbound.problem.model.operations import operands, slope_by
from certbound.problem.model.tape import Tape


def jacobian(tape: Tape, columns: Sequence[int] | None = None) -> Tape:
    """Derivative of every output with respect to the given inputs (``columns``: slots; all when omitted).

    The derivative is exact: where a constant of it is no floating-point number, the tape holds the operations that
    define it. Kinks (abs, min, max) get their generalised derivative, the operation ``kink``; jumps get the derivative
    that holds beside the jump. Differentiating a derivative turns its kinks into jumps (operation ``sign``), since the
    slope of |x| jumps at 0.

    The tape has shape ``(len(tape.outputs), len(columns))``, outputs of a matrix-valued function in row-major order,
    over the same inputs. **Its nodes begin with the nodes of the function itself, index for index**, whether the
    derivative needs them or not: a reader that refuses undecided jumps sees those of the function too (x' = sign(x) has
    derivative 0 beside its jump).
    """
    slots = tuple(range(len(tape.inputs))) if columns is None else tuple(int(column) for column in columns)
    if any(not 0 <= slot < len(tape.inputs) for slot in slots):
        raise ValueError(f"`columns` must lie in 0..{len(tape.inputs) - 1}, got {list(slots)}.")
    return _jacobian(tape, slots)


@lru_cache(maxsize=256)
def _jacobian(tape: Tape, columns: tuple[int, ...]) -> Tape:
    graph = Graph.starting_with(tape, rename={"kink": "sign"})
    one = graph.const(1.0)
    tangents: list[dict[int, int]] = []
    for index, node in enumerate(tape.nodes):
        if node.op == "input":
            tangents.append({place: one for place, slot in enumerate(columns) if slot == node.args[0]})
            continue
        if node.op == "if_else_zero":
            condition = node.args[0]
            branch = tangents[node.args[1]]
            tangents.append({c: graph.apply("if_else_zero", condition, value) for c, value in branch.items()})
            continue
        total: dict[int, int] = {}
        for position, arg in enumerate(node.args):
            slope = slope_by(node, position)
            if not tangents[arg] or slope is None:
                continue
            partial = slope(graph, *operands(node, node.args), index)
            for column, tangent in tangents[arg].items():
                term = graph.apply("mul", partial, tangent)
                total[column] = graph.apply("add", total[column], term) if column in total else term
        tangents.append(total)
    zero = graph.const(0.0)
    outputs = [tangents[output].get(place, zero) for output in tape.outputs for place in range(len(columns))]
    return graph.tape(outputs, (len(tape.outputs), len(columns)), keep=len(tape.nodes))
