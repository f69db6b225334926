"""Activations of networks, read from the nodes by which models write them.

max(a, 0), ``where(a > 0, a, 0)`` and a (a > 0) are one function of a, as are 1/(1 + exp(-a)) and exp(a)/(1 + exp(a)).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from certbound.problem.model.tape import Node

Nodes = Sequence[Node]


class Read(NamedTuple):
    """``activation`` with its ``constants``, of the node ``argument``, or of what is minus that."""

    activation: str
    argument: int
    constants: tuple[float, ...] = ()
    negated: bool = False


def activation_of(nodes: Nodes, index: int) -> Read | None:
    """The activation that a node is over the reals; None where it is none."""
    reader = _READERS.get(nodes[index].op)
    return None if reader is None else reader(nodes, *nodes[index].args)


def _value(nodes: Nodes, index: int) -> float | None:
    return nodes[index].value if nodes[index].op == "const" else None


def _ends(nodes: Nodes, first: int, second: int) -> tuple[int, float] | None:
    """The argument and the constant of a max or min of the two."""
    for argument, end in ((first, second), (second, first)):
        value = _value(nodes, end)
        if value is not None:
            return argument, value
    return None


def _maximum(nodes: Nodes, first: int, second: int) -> Read | None:
    found = _ends(nodes, first, second)
    if found is None:
        for a, b in ((first, second), (second, first)):
            slope = _multiple(nodes, b, a)
            if slope is not None and 0 <= slope <= 1:
                return Read("leaky_relu", a, (slope,))
        return None
    return Read("relu", found[0]) if found[1] == 0 else _clipped(nodes, *found, "min")


def _minimum(nodes: Nodes, first: int, second: int) -> Read | None:
    found = _ends(nodes, first, second)
    return None if found is None else _clipped(nodes, *found, "max")


def _clipped(nodes: Nodes, inner: int, end: float, op: str) -> Read | None:
    """min(max(a, low), high), or the other way around."""
    if nodes[inner].op != op:
        return None
    found = _ends(nodes, *nodes[inner].args)
    if found is None:
        return None
    low, high = (found[1], end) if op == "max" else (end, found[1])
    return Read("clip", found[0], (low, high)) if low <= high else None


def _multiple(nodes: Nodes, index: int, of: int) -> float | None:
    """The constant factor by which a node is a multiple of another one."""
    if nodes[index].op == "mul":
        for a, b in (nodes[index].args, nodes[index].args[::-1]):
            if b == of:
                return _value(nodes, a)
    return None


def _sign(nodes: Nodes, condition: int) -> tuple[int, bool] | None:
    """The node a and True of a condition a > 0 or a >= 0, False of a < 0 or a <= 0."""
    node = nodes[condition]
    if node.op == "not":
        found = _sign(nodes, node.args[0])
        return None if found is None else (found[0], not found[1])
    if node.op in ("lt", "le"):
        if _value(nodes, node.args[0]) == 0:
            return node.args[1], True
        if _value(nodes, node.args[1]) == 0:
            return node.args[0], False
    return None


def _chosen(nodes: Nodes, condition: int, value: int) -> Read | None:
    """a where a > 0, else 0."""
    return Read("relu", value) if _sign(nodes, condition) == (value, True) else None


def _product(nodes: Nodes, first: int, second: int) -> Read | None:
    """a (a > 0)."""
    return _chosen(nodes, first, second) or _chosen(nodes, second, first)


def _either(nodes: Nodes, first: int, second: int) -> Read | None:
    """a where a > 0, else a multiple of it (leaky_relu), or exp(a) - 1 (elu)."""
    if nodes[first].op != "if_else_zero" or nodes[second].op != "if_else_zero":
        return None
    (one, left), (other, right) = nodes[first].args, nodes[second].args
    if (nodes[other].op, nodes[other].args) != ("not", (one,)):
        return None
    found = _sign(nodes, one)
    if found is None:
        return None
    argument, above = found
    value, below = (left, right) if above else (right, left)
    if value != argument:
        return None
    slope = _multiple(nodes, below, argument)
    if slope is not None:
        return Read("leaky_relu", argument, (slope,))
    node = nodes[below]
    grown = node.op == "sub" and _value(nodes, node.args[1]) == 1 and nodes[node.args[0]] == Node("exp", (argument,))
    return Read("elu", argument) if grown else None


def _one_and_exponential(nodes: Nodes, index: int) -> int | None:
    """The argument a of 1 + exp(a)."""
    if nodes[index].op == "add":
        for one, grown in (nodes[index].args, nodes[index].args[::-1]):
            if _value(nodes, one) == 1 and nodes[grown].op == "exp":
                return nodes[grown].args[0]
    return None


def _ratio(nodes: Nodes, above: int, below: int) -> Read | None:
    """1/(1 + exp(-a)), or exp(a)/(1 + exp(a))."""
    argument = _one_and_exponential(nodes, below)
    if argument is None:
        return None
    if _value(nodes, above) == 1:
        return Read("sigmoid", argument, negated=True)
    return Read("sigmoid", argument) if nodes[above] == Node("exp", (argument,)) else None


def _logarithm(nodes: Nodes, of: int) -> Read | None:
    """log(1 + exp(a))."""
    argument = _one_and_exponential(nodes, of)
    return None if argument is None else Read("softplus", argument)


_READERS: dict[str, Callable[..., Read | None]] = {
    "tanh": lambda nodes, a: Read("tanh", a),
    "sin": lambda nodes, a: Read("sin", a),
    "max": _maximum,
    "min": _minimum,
    "if_else_zero": _chosen,
    "mul": _product,
    "add": _either,
    "div": _ratio,
    "log": _logarithm,
}
