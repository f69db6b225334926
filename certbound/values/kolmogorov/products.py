"""A model as a sum of products, F(t, x, d) = sum_j c_j(t, d) F_j(x), exactly: grids need each F_j only once.

What sees neither states nor constants alone is a parameter p of the rest, ``x + cos(t) d`` being ``x + p``. Where the
rest is a polynomial in the parameters, of low degree in each, its coefficients are derivatives at p = 0:

    F = sum_k p^k / k! (d/dp)^k F |_{p = 0},      if (d/dp)^(K+1) F = 0 and nothing that bends or jumps sees p,

parameter by parameter. ``where(c, y, z)`` with a condition that sees no state is a product.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from certbound.problem.model import JUMPS, PARTS, ROWS, Graph, Node, Tape, is_zero, jacobian, reads, selected, sources

_DEGREE = 4  # largest power of a parameter
_MOST = 40  # products


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Product:
    """c(t, d) F(x).

    Attributes
    ----------
    coefficient : Tape or None
        c over ``("t", *disturbances)``, one output; None for 1.
    function : Tape
        F over ``("t", *states)``, flat outputs, without t.
    """

    coefficient: Tape | None
    function: Tape


def separated(tape: Tape, states: int) -> list[Product] | None:
    """The sum of products that a tape is, or None where it is not seen to be one.

    Parameters
    ----------
    tape : Tape
        Over ``("t", *states, *disturbances)``.
    states : int
        Number of states n.
    """
    own = range(1, states + 1)
    seen = [slots & set(own) for slots in reads(tape)]
    outer = [not one and bool(all_) for one, all_ in zip(seen, reads(tape))]
    if not any(outer):
        return [Product(coefficient=None, function=_flat(tape, tape.inputs[: states + 1]))]
    rest, parameters = _parametrised(tape, states, outer)
    names = rest.inputs[states + 1 :]
    found: list[tuple[tuple[int, ...], Tape]] = [((), rest)]
    for slot in range(states + 1, states + 1 + len(names)):
        powers: list[tuple[tuple[int, ...], Tape]] = []
        for exponents, function in found:
            expanded = _powers(function, slot)
            if expanded is None:
                return None
            powers += [((*exponents, k), one) for k, one in enumerate(expanded)]
        found = [(exponents, one) for exponents, one in powers if not all(is_zero(one, k) for k in range(_count(one)))]
        if len(found) > _MOST:
            return None
    products = []
    for exponents, function in found:
        coefficient = _monomial(tape, states, parameters, exponents) if any(exponents) else None
        products.append(Product(coefficient=coefficient, function=_flat(function, tape.inputs[: states + 1])))
    return products


def _count(tape: Tape) -> int:
    return len(tape.outputs)


def _flat(tape: Tape, inputs: Sequence[str]) -> Tape:
    """The same with fewer inputs, the last of which nothing reads, and flat outputs."""
    pruned = selected(tape, list(range(len(tape.outputs))), None)
    return Tape(inputs=tuple(inputs), nodes=pruned.nodes, outputs=pruned.outputs, shape=pruned.shape)


def _parametrised(tape: Tape, states: int, outer: Sequence[bool]) -> tuple[Tape, list[tuple[int, bool]]]:
    """The tape over t, states and parameters, and each parameter: a node of the tape, and whether it is 1 over that."""
    parameters: list[tuple[int, bool]] = []
    for index, node in enumerate(tape.nodes):
        if outer[index] or node.op == "input":
            continue
        for place, arg in enumerate(node.args):
            one = (arg, node.op == "div" and place == 1)
            if outer[arg] and one not in parameters:
                parameters.append(one)
    parameters += [(o, False) for o in dict.fromkeys(tape.outputs) if outer[o] and (o, False) not in parameters]
    first = states + 1
    graph = Graph((*tape.inputs[:first], *(f"p{k}" for k in range(len(parameters)))))
    copy = graph.arithmetic()
    slot = {one: graph.input(first + k) for k, one in enumerate(parameters)}
    made: list[int] = []
    for index, node in enumerate(tape.nodes):
        if outer[index]:
            made.append(slot.get((index, False), -1))
        elif node.op == "input":
            made.append(graph.input(node.args[0]))
        elif node.op == "const":
            made.append(graph.const(node.value))
        elif node.op == "div" and outer[node.args[1]]:
            made.append(graph.apply("mul", made[node.args[0]], slot[(node.args[1], True)]))
        elif node.op == "if_else_zero" and outer[node.args[0]] and tape.nodes[node.args[0]].op in JUMPS - {"floor"}:
            made.append(graph.apply("mul", made[node.args[0]], made[node.args[1]]))
        else:
            more = [node.part] if node.part is not None else [node.value] if node.op == "pow" else []
            made.append(copy[node.op](*(made[arg] for arg in node.args), *more))
    return graph.tape([made[output] for output in tape.outputs], (len(tape.outputs),)), parameters


def _powers(tape: Tape, slot: int) -> list[Tape] | None:
    """Coefficients of the powers of one input; None where the tape is no polynomial of it, as far as can be seen."""
    if any(slot in slots and _rough(node) for node, slots in zip(tape.nodes, reads(tape))):
        return None
    result, derivative, factorial = [_at_zero(tape, slot, 1)], tape, 1
    for order in range(1, _DEGREE + 1):
        flat = jacobian(derivative, [slot])
        derivative = selected(flat, list(range(len(flat.outputs))), None)
        if all(is_zero(derivative, k) for k in range(len(derivative.outputs))):
            return result
        factorial *= order
        result.append(_at_zero(derivative, slot, factorial))
        if not any(slot in one for one in sources(derivative)):
            return result
    return None


def _rough(node: Node) -> bool:
    return (
        node.op in JUMPS
        or node.op in PARTS
        or node.op == "kink"
        or (node.op in ROWS and (ROWS[node.op].kink is not None or ROWS[node.op].jump is not None))
    )


def _at_zero(tape: Tape, slot: int, divisor: int) -> Tape:
    graph = Graph(tape.inputs)
    inputs = [graph.const(0.0) if k == slot else graph.input(k) for k in range(len(tape.inputs))]
    outputs = tape.evaluate(graph.arithmetic(), inputs)
    if divisor > 1:
        outputs = [graph.apply("div", output, graph.const(float(divisor))) for output in outputs]
    return graph.tape(outputs, (len(outputs),))


def _monomial(tape: Tape, states: int, parameters: Sequence[tuple[int, bool]], exponents: Sequence[int]) -> Tape:
    """The product of powers of parameters, over t and the disturbances."""
    graph = Graph((tape.inputs[0], *tape.inputs[states + 1 :]))
    copy = graph.arithmetic()
    wanted = [node for (node, _), power in zip(parameters, exponents) if power]
    live, stack = set[int](), list(wanted)
    while stack:
        index = stack.pop()
        if index not in live:
            live.add(index)
            stack += [] if tape.nodes[index].op == "input" else tape.nodes[index].args
    made: dict[int, int] = {}
    for index in sorted(live):
        node = tape.nodes[index]
        if node.op == "input":
            made[index] = graph.input(max(node.args[0] - states, 0))
        elif node.op == "const":
            made[index] = graph.const(node.value)
        else:
            more = [node.part] if node.part is not None else [node.value] if node.op == "pow" else []
            made[index] = copy[node.op](*(made[arg] for arg in node.args), *more)
    total: int | None = None
    for (node_, inverse), power in zip(parameters, exponents):
        if power:
            one = graph.pow(made[node_], -power if inverse else power)
            total = one if total is None else graph.apply("mul", total, one)
    assert total is not None
    return graph.tape([total], (1,))
