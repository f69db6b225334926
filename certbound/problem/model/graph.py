"""A tape under construction: nodes are shared, and only rewritings that are exact over the reals are made.

Constants are folded only where the floating-point result is the exact one: a tape that says ``0.1 * 0.3``
keeps both factors, so that a rigorous reader encloses the product that the user wrote, and a derivative taken
on the tape is the exact derivative of the tape.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from functools import partial
from typing import Any

from certbound.problem.model.network_data import PARTS, Part
from certbound.problem.model.operations import OPERATIONS
from certbound.problem.model.tape import ARITY, Node, Tape, needed

_COMPARE: dict[str, Callable[[float, float], bool]] = {
    "lt": lambda a, b: a < b,
    "le": lambda a, b: a <= b,
    "eq": lambda a, b: a == b,
    "ne": lambda a, b: a != b,
    "and": lambda a, b: bool(a and b),
    "or": lambda a, b: bool(a or b),
}
_COMMUTATIVE = frozenset(["add", "mul", "min", "max", "hypot", "eq", "ne", "and", "or"])


class Graph:
    """Nodes over named scalar inputs, in slot order; every method returns the index of a node."""

    def __init__(self, inputs: Sequence[str]) -> None:
        self.inputs = tuple(inputs)
        self.nodes: list[Node] = []
        self._index: dict[Node, int] = {}

    @classmethod
    def starting_with(cls, tape: Tape, rename: Mapping[str, str] | None = None) -> Graph:
        """A graph whose first nodes are those of ``tape``, index for index (``rename`` maps operations)."""
        graph = cls(tape.inputs)
        for index, node in enumerate(tape.nodes):
            node = node._replace(op=rename.get(node.op, node.op)) if rename else node
            graph.nodes.append(node)
            graph._index.setdefault(node, index)
        return graph

    def tape(self, outputs: Sequence[int], shape: tuple[int, ...], keep: int = 0, also: Sequence[int] = ()) -> Tape:
        """The finished tape, less the nodes that no output needs (the first ``keep`` nodes and ``also`` stay)."""
        live = needed(self.nodes, [*outputs, *also], keep)
        place: dict[int, int] = {}
        nodes: list[Node] = []
        for index, node in enumerate(self.nodes):
            if live[index]:
                place[index] = len(nodes)
                nodes.append(
                    node if node.op == "input" else node._replace(args=tuple(place[a] for a in node.args))
                )
        return Tape(
            inputs=self.inputs, nodes=tuple(nodes), outputs=tuple(place[o] for o in outputs), shape=shape
        )

    def input(self, slot: int) -> int:
        """The node of input ``slot``."""
        return self._intern(Node("input", (slot,)))

    def const(self, value: float) -> int:
        """The node of a finite number."""
        value = float(value)
        if not math.isfinite(value):
            raise ValueError(f"a model must not contain {value}; every constant must be finite.")
        return self._intern(Node("const", (), value + 0.0))

    def number(self, index: int) -> float | None:
        """Value of a constant node, None for any other."""
        node = self.nodes[index]
        return node.value if node.op == "const" else None

    def apply(self, op: str, *args: int) -> int:
        """The node of ``op`` (see ``tape.ARITY``) applied to earlier nodes, simplified."""
        if ARITY.get(op) != len(args) or op in ("const", "input", "pow"):
            raise ValueError(f"`op` must be a tape operation of {len(args)} arguments, got {op!r}.")
        simple = self._simple_unary(op, *args) if len(args) == 1 else self._simple_binary(op, *args)
        if simple is not None:
            return simple
        if op in _COMMUTATIVE and Node(op, args[::-1]) in self._index:
            return self._index[Node(op, args[::-1])]
        return self._intern(Node(op, args))

    def pow(self, base: int, exponent: float) -> int:
        """``base ** exponent``, exponent constant; squares, roots and reciprocals get their own nodes."""
        exponent = float(exponent)
        if not math.isfinite(exponent):
            raise ValueError(f"an exponent must be finite, got {exponent}.")
        if exponent == 0:
            return self.const(1.0)
        if exponent == 1:
            return base
        if exponent == 2:
            return self.apply("sq", base)
        if exponent == 0.5:
            return self.apply("sqrt", base)
        if exponent < 0 and exponent == int(exponent):
            return self.apply("div", self.const(1.0), self.pow(base, -exponent))
        value = self.number(base)
        if value is not None and exponent == int(exponent) and exponent <= 64:
            folded = _exact(Fraction(value) ** int(exponent))
            if folded is not None:
                return self.const(folded)
        return self._intern(Node("pow", (base,), exponent))

    def part(self, part: Part, args: tuple[int, ...]) -> int:
        """The node of a part of a network."""
        return self._intern(Node(part.op, args, 0.0, part))

    def arithmetic(self) -> dict[str, Callable[..., int]]:
        """The arithmetic with which ``Tape.evaluate`` copies a tape into this graph."""
        table: dict[str, Callable[..., int]] = {op: partial(self.apply, op) for op in OPERATIONS}
        table |= dict.fromkeys(PARTS, lambda *given: self.part(given[-1], given[:-1]))
        return table | {"const": self.const, "pow": self.pow}

    def _intern(self, node: Node) -> int:
        index = self._index.setdefault(node, len(self.nodes))
        if index == len(self.nodes):
            self.nodes.append(node)
        return index

    def _simple_unary(self, op: str, a: int) -> int | None:
        node, value = self.nodes[a], self.number(a)
        if value is None:
            if op == "neg" and node.op == "neg":
                return node.args[0]
            if op == "neg" and node.op == "sub":
                return self.apply("sub", node.args[1], node.args[0])
            if op in ("sq", "abs") and node.op in ("neg", "abs"):
                return self.apply(op, node.args[0])
            return None
        known = OPERATIONS[op].at_zero
        if known is not None and value == 0:
            return self.const(known)
        exact: dict[str, Callable[[float], float]] = {
            "neg": lambda v: -v,
            "abs": abs,
            "floor": math.floor,
            "sign": lambda v: (v > 0) - (v < 0),
            "not": lambda v: v == 0,
        }
        if op in exact:
            return self.const(exact[op](value))
        if op == "sq":
            square = _exact(Fraction(value) ** 2)
            return None if square is None else self.const(square)
        if op == "sqrt" and value >= 0 and Fraction(math.sqrt(value)) ** 2 == Fraction(value):
            return self.const(math.sqrt(value))
        return None

    def _simple_binary(self, op: str, a: int, b: int) -> int | None:
        x, y = self.number(a), self.number(b)
        if x is not None and y is not None:
            return self._folded(op, x, y)
        if op in ("add", "sub", "mul", "div"):
            return self._simple_arithmetic(op, a, b, x, y)
        if op in ("min", "max") and a == b:
            return a
        if op == "if_else_zero":
            if x is not None:
                return b if x else self.const(0.0)
            if y == 0:
                return b
        return None

    def _simple_arithmetic(self, op: str, a: int, b: int, x: float | None, y: float | None) -> int | None:
        first, second = self.nodes[a], self.nodes[b]
        if op == "add":
            if x == 0 or y == 0:
                return b if x == 0 else a
            if second.op == "neg":
                return self.apply("sub", a, second.args[0])
            if first.op == "neg":
                return self.apply("sub", b, first.args[0])
        elif op == "sub":
            if y == 0:
                return a
            if x == 0:
                return self.apply("neg", b)
            if a == b:
                return self.const(0.0)
            if second.op == "neg":
                return self.apply("add", a, second.args[0])
        elif op == "mul":
            if x == 0 or y == 0:
                return self.const(0.0)
            if abs(x or 0.0) == 1 or abs(y or 0.0) == 1:
                other, one = (b, x) if abs(x or 0.0) == 1 else (a, y)
                return other if one == 1 else self.apply("neg", other)
            if a == b:
                return self.apply("sq", a)
        elif abs(y or 0.0) == 1:
            return a if y == 1 else self.apply("neg", a)
        return None

    def _folded(self, op: str, x: float, y: float) -> int | None:
        if op in _COMPARE:
            return self.const(float(_COMPARE[op](x, y)))
        if op in ("min", "max"):
            return self.const(min(x, y) if op == "min" else max(x, y))
        if op == "if_else_zero":
            return self.const(y if x else 0.0)
        p, q = Fraction(x), Fraction(y)
        if op in ("add", "sub", "mul"):
            result = _exact(p + q if op == "add" else p - q if op == "sub" else p * q)
        elif op == "div" and y != 0:
            result = _exact(p / q)
        else:
            result = None
        return None if result is None else self.const(result)


def _exact(value: Fraction) -> float | None:
    """The float that equals ``value``, or None."""
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if Fraction(number) == value else None


def substitute(
    tape: Tape, inputs: Sequence[str], replacements: Mapping[str, Tape | tuple[Tape, int] | float]
) -> Tape:
    """The tape over new ``inputs`` in which some old inputs are replaced by functions or numbers.

    ``replacements`` maps an old input's name to a number, or to (tape, k): the k-th output of a tape over (a subset of)
    ``inputs``. Every old input that is not replaced must be among the new ones.
    """
    graph = Graph(inputs)
    arithmetic = graph.arithmetic()
    slots = {name: slot for slot, name in enumerate(graph.inputs)}
    done: dict[int, list[Any]] = {}
    values: list[int] = []
    for name in tape.inputs:
        new = replacements.get(name)
        if new is None:
            if name not in slots:
                raise ValueError(
                    f"`inputs` must contain {name!r}, which is not replaced; got {list(inputs)}."
                )
            values.append(graph.input(slots[name]))
        elif isinstance(new, (int, float)):
            values.append(graph.const(new))
        else:
            other, position = (new, 0) if isinstance(new, Tape) else new
            if id(other) not in done:
                arguments = [graph.input(slots[n]) for n in other.inputs]
                done[id(other)] = other.evaluate(arithmetic, arguments)
            values.append(done[id(other)][position])
    return graph.tape(tape.evaluate(arithmetic, values), tape.shape)
