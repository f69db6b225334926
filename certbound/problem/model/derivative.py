"""Exact derivatives of a tape, as a tape (forward mode)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

from certbound.problem.model.graph import Graph
from certbound.problem.model.tape import Tape

__all__ = ["jacobian"]


def jacobian(tape: Tape, columns: Sequence[int] | None = None) -> Tape:
    """Derivative of every output with respect to the given inputs.

    The derivative is exact: where a constant of it is no floating-point number, the tape holds the operations
    that define it. Kinks (abs, min, max) get their generalised derivative, the operation ``kink``; jumps get
    the derivative that holds beside the jump.

    Parameters
    ----------
    tape : Tape
        Any function; outputs of a matrix-valued one are taken in row-major order.
    columns : sequence of int, optional
        Input slots to differentiate with respect to; all of them when omitted.

    Returns
    -------
    Tape
        Shape ``(len(tape.outputs), len(columns))``, over the same inputs. **Its nodes begin with the nodes of
        the function itself, index for index**, whether the derivative needs them or not: a reader that
        refuses undecided jumps sees those of the function too (x' = sign(x) has derivative 0 beside its
        jump). Differentiating a derivative turns its kinks into jumps (operation ``sign``), since the slope
        of |x| jumps at 0.

    Raises
    ------
    ValueError
        If a column is not an input slot.
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
            if not tangents[arg]:
                continue
            partial = _partial(graph, node.op, position, node.args, index, node.value)
            if partial is None:
                continue
            for column, tangent in tangents[arg].items():
                term = graph.apply("mul", partial, tangent)
                total[column] = graph.apply("add", total[column], term) if column in total else term
        tangents.append(total)
    zero = graph.const(0.0)
    outputs = [tangents[output].get(place, zero) for output in tape.outputs for place in range(len(columns))]
    return graph.tape(outputs, (len(tape.outputs), len(columns)), keep=len(tape.nodes))


def _partial(
    graph: Graph, op: str, position: int, args: tuple[int, ...], self_: int, value: float
) -> int | None:
    """Derivative of node ``self_`` with respect to its argument at ``position``; None where it is 0."""
    apply, const = graph.apply, graph.const
    a = args[0]
    if len(args) == 2:
        return _partial_binary(graph, op, position, a, args[1], self_)
    match op:
        case "neg":
            return const(-1.0)
        case "sq":
            return apply("mul", const(2.0), a)
        case "sqrt":
            return apply("div", const(0.5), self_)
        case "exp":
            return self_
        case "log":
            return apply("div", const(1.0), a)
        case "sin":
            return apply("cos", a)
        case "cos":
            return apply("neg", apply("sin", a))
        case "tan":
            return apply("add", const(1.0), apply("sq", self_))
        case "asin" | "acos":
            root = apply("sqrt", apply("sub", const(1.0), apply("sq", a)))
            return apply("div", const(1.0 if op == "asin" else -1.0), root)
        case "atan":
            return apply("div", const(1.0), apply("add", const(1.0), apply("sq", a)))
        case "sinh" | "cosh":
            return apply("cosh" if op == "sinh" else "sinh", a)
        case "tanh":
            return apply("sub", const(1.0), apply("sq", self_))
        case "abs":
            return apply("kink", a)
        case "pow":
            lower = value - 1.0
            if abs(value) < 2.0**52 and value * 2 == int(value * 2):
                return apply("mul", const(value), graph.pow(a, lower))
            return apply("mul", const(value), apply("div", self_, a))
    return None


def _partial_binary(graph: Graph, op: str, position: int, a: int, b: int, self_: int) -> int | None:
    apply, const = graph.apply, graph.const
    first = position == 0
    match op:
        case "add":
            return const(1.0)
        case "sub":
            return const(1.0 if first else -1.0)
        case "mul":
            return b if first else a
        case "div":
            return apply("div", const(1.0), b) if first else apply("neg", apply("div", self_, b))
        case "atan2":
            squares = apply("add", apply("sq", a), apply("sq", b))
            return apply("div", b if first else apply("neg", a), squares)
        case "hypot":
            return apply("div", a if first else b, self_)
        case "min" | "max":
            step = apply("mul", const(0.5), apply("add", const(1.0), apply("kink", apply("sub", a, b))))
            return step if first == (op == "max") else apply("sub", const(1.0), step)
    return None
