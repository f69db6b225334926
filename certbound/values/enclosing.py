"""Ranges of a tape over boxes, with the kinks and jumps that are undecided there, and the tape of g g'."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence

import numpy as np

from certbound.arrays import Array, Mask
from certbound.errors import EnclosureError
from certbound.problem.model import Graph, Tape, enclosed, jumps_where, kinks_where, undefined_where
from certbound.rigor.intervals import Interval


def enclose(tape: Tape, inputs: Sequence[Interval]) -> tuple[list[Interval], Mask]:
    """Ranges of a tape's outputs over boxes, and where some node has an undecided kink or jump.

    Proves: each output contains the function's values for all inputs in the boxes, jumps included.

    Raises
    ------
    EnclosureError
        An operation is undefined somewhere on a box.
    """
    batch = np.broadcast_shapes(*(value.shape for value in inputs))
    edge = np.zeros(batch, dtype=bool)
    values: list[Interval] = []
    for index, node in enumerate(tape.nodes):
        args = [] if node.op == "input" else [values[arg] for arg in node.args]
        if node.op == "input":
            values.append(inputs[node.args[0]])
            continue
        if np.any(undefined_where(node, args)):
            raise EnclosureError(
                f"`{tape.describe(index)}` is undefined somewhere in the safe set; a value function needs the "
                "model on all of it: add constraints (or a `domain`) that keep away from there."
            )
        values.append(enclosed(node, args))
        own = kinks_where(node, args)
        own = jumps_where(node, values[-1], args) if own is None else own
        edge = edge if own is None else edge | own
    return [values[output] for output in tape.outputs], np.broadcast_to(edge, batch)


def squared_diffusion(diffusion: Array | Tape, states: Sequence[str]) -> Tape:
    """The tape of a = g g', shape (n, n), over ``("t", *states)``; sqrt(u)^2 is u where the root is defined.

    The roots stay among the nodes, so that the tape is undefined wherever g is.
    """
    graph = Graph(("t", *states))
    rows, columns = diffusion.shape
    if isinstance(diffusion, Tape):
        flat = diffusion.evaluate(graph.arithmetic(), [graph.input(slot) for slot in range(len(states) + 1)])
    else:
        flat = [graph.const(float(entry)) for entry in np.asarray(diffusion).reshape(-1)]
    outputs = []
    for i, j in itertools.product(range(rows), repeat=2):
        terms = [_product(graph, flat[i * columns + k], flat[j * columns + k]) for k in range(columns)]
        total = terms[0]
        for term in terms[1:]:
            total = graph.apply("add", total, term)
        outputs.append(total)
    return graph.tape(outputs, (rows, rows), also=[k for k, node in enumerate(graph.nodes) if node.op == "sqrt"])


def _product(graph: Graph, first: int, second: int) -> int:
    """The node of a product, in which roots that occur twice have gone."""
    above: Counter[int] = Counter()
    below: Counter[int] = Counter()
    sign = _factors(graph, first, above, below) * _factors(graph, second, above, below)
    if not any(graph.nodes[leaf].op == "sqrt" and count > 1 for leaf, count in [*above.items(), *below.items()]):
        return graph.apply("mul", first, second)
    top, bottom = (_powers(graph, counted) for counted in (above, below))
    whole = graph.apply("div", top, bottom) if below else top
    return whole if sign > 0 else graph.apply("neg", whole)


def _factors(graph: Graph, index: int, above: Counter[int], below: Counter[int]) -> int:
    """Count the factors of a node over and under its line; its sign."""
    node = graph.nodes[index]
    if node.op == "neg":
        return -_factors(graph, node.args[0], above, below)
    if node.op == "sq":
        return _factors(graph, node.args[0], above, below) * _factors(graph, node.args[0], above, below)
    if node.op in ("mul", "div"):
        sides = (above, below) if node.op == "mul" else (below, above)
        return _factors(graph, node.args[0], above, below) * _factors(graph, node.args[1], *sides)
    above[index] += 1
    return 1


def _powers(graph: Graph, counted: Counter[int]) -> int:
    total = graph.const(1.0)
    for leaf, count in counted.items():
        if graph.nodes[leaf].op == "sqrt":
            total = graph.apply("mul", total, graph.pow(graph.nodes[leaf].args[0], count // 2))
            count %= 2
        total = graph.apply("mul", total, graph.pow(leaf, count))
    return total
