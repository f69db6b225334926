"""Expressions as a shared graph, and their derivatives: the checker's own symbolic differentiation.

Nodes are stored once (structurally equal ones are the same node). Derivatives are simplified where a factor or a
summand is exactly 0 or 1, so that "does not depend on" is a fact about the graph; the function itself is stored as
the tape has it, lest a simplification hide where it is undefined.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from certbound.checker.expressions import networks
from certbound.checker.expressions.operations import OPERATIONS
from certbound.checker.report import STEP, Budget, Unproved, unlimited
from certbound.problem.model import Node, Part, Tape

MOST_NODES = 400_000
_NODE = 6
"""Memory of a node, in balls."""
_MANY = 1000
"""Edges between two looks at the budget."""
_NODE_WORK, _EDGE = 5 * STEP, 600
"""Units of work of a node that is made, 3 to 6 us, and of an edge on the way through a graph."""
_PRODUCTS = frozenset(["mul", "sq", "div", "hypot", "atan2"])
_SUMS = frozenset(["add", "sub", "neg", "abs", "min", "max", "kink", "if_else_zero", "sqrt"])
_BITS, _FLOAT, _POWER = 512, 12, 14
"""Bits of the exponent of a function's value, at most, of a float, and of those that a power adds."""


class Graph:
    """A growing set of expressions over numbered inputs; ``budget`` limits what is built and what runs over it.

    ``nodes`` are operations, arguments before their users; bit i of ``masks`` is set where a node depends on input i.
    ``bits`` bound the length of the exponents of a node's values: products of products have long ones.

    Examples
    --------
    >>> graph = Graph()
    >>> x = graph.input(0)
    >>> graph.node(graph.derivative(graph.apply("sq", x), 0)).op
    'mul'
    >>> graph.derivative(graph.apply("add", x, graph.const(3.0)), 0) == graph.const(1.0)
    True
    """

    def __init__(self, budget: Budget | None = None) -> None:
        self.budget = unlimited() if budget is None else budget
        self.nodes: list[Node] = []
        self.masks: list[int] = []
        self.bits: list[int] = []
        self._numbers: dict[tuple[str, tuple[int, ...], str | Part], int] = {}
        self._derivatives: dict[tuple[int, int], int] = {}

    # ---- building ----------------------------------------------------------------------------------------

    def apply(self, op: str, *args: int, value: float = 0.0, part: Part | None = None) -> int:
        """The node of an operation, as it stands."""
        key = (op, args, part or value.hex())
        found = self._numbers.get(key)
        if found is not None:
            return found
        if len(self.nodes) >= MOST_NODES:
            raise Unproved(f"the model and its derivatives have more than {MOST_NODES} operations")
        self.nodes.append(Node(op, args, value, part))
        mask, bits = 1 << args[0] if op == "input" else 0, 0
        if op != "input":
            for arg in args:
                mask |= self.masks[arg]
                bits = max(bits, self.bits[arg])
        self.budget.spend(_NODE_WORK + mask.bit_length() // 8 + _EDGE * len(args))
        self.budget.hold(_NODE + mask.bit_length() // 512)
        self.masks.append(mask)
        self.bits.append(longer(op, bits))
        self._numbers[key] = len(self.nodes) - 1
        return len(self.nodes) - 1

    def const(self, value: float) -> int:
        """A constant."""
        return self.apply("const", value=float(value))

    def part(self, part: Part, args: tuple[int, ...]) -> int:
        """A part of a network."""
        return self.apply(part.op, *args, part=part)

    def input(self, slot: int) -> int:
        """An input."""
        return self.apply("input", slot)

    def node(self, index: int) -> Node:
        """The operation of a node."""
        return self.nodes[index]

    def is_const(self, index: int, value: float) -> bool:
        """Whether a node is the constant ``value`` (0 and -0 are the same)."""
        node = self.nodes[index]
        return node.op == "const" and node.value == value

    def neg(self, a: int) -> int:
        """-a."""
        if self.is_const(a, 0.0):
            return self.const(0.0)
        return self.nodes[a].args[0] if self.nodes[a].op == "neg" else self.apply("neg", a)

    def add(self, a: int, b: int) -> int:
        """a + b."""
        if self.is_const(a, 0.0):
            return b
        return a if self.is_const(b, 0.0) else self.apply("add", a, b)

    def sub(self, a: int, b: int) -> int:
        """a - b."""
        if a == b:
            return self.const(0.0)
        if self.is_const(b, 0.0):
            return a
        return self.neg(b) if self.is_const(a, 0.0) else self.apply("sub", a, b)

    def mul(self, a: int, b: int) -> int:
        """a b."""
        if self.is_const(a, 0.0) or self.is_const(b, 0.0):
            return self.const(0.0)
        if self.is_const(a, 1.0):
            return b
        return a if self.is_const(b, 1.0) else self.apply("mul", a, b)

    def div(self, a: int, b: int) -> int:
        """a / b."""
        return self.const(0.0) if self.is_const(a, 0.0) else self.apply("div", a, b)

    def sum(self, terms: Iterable[int]) -> int:
        """The sum of some nodes."""
        total = self.const(0.0)
        for term in terms:
            total = self.add(total, term)
        return total

    def include(self, tape: Tape, inputs: Sequence[int]) -> list[int]:
        """Copy a tape, its inputs replaced by nodes; the nodes of all its operations."""
        numbers: list[int] = []
        for node in tape.nodes:
            if node.op == "input":
                numbers.append(inputs[node.args[0]])
            elif node.op == "const":
                numbers.append(self.const(node.value))
            else:
                args = [numbers[arg] for arg in node.args]
                numbers.append(self.apply(node.op, *args, value=node.value, part=node.part))
        return numbers

    def reachable(self, outputs: Iterable[int]) -> list[int]:
        """All nodes that some nodes depend on, in topological order."""
        seen: set[int] = set()
        stack, paid = list(outputs), 0
        while stack:
            index = stack.pop()
            if index in seen:
                continue
            seen.add(index)
            node = self.nodes[index]
            paid -= 1 + len(node.args)
            if paid < 0:
                self.budget.spend(_EDGE * (_MANY - paid))
                paid = _MANY
            if node.op != "input":
                stack.extend(node.args)
        return sorted(seen)

    # ---- differentiating ---------------------------------------------------------------------------------

    def derivative(self, index: int, slot: int) -> int:
        """The derivative of a node with respect to an input (beside jumps: readers must decide those)."""
        bit = 1 << slot
        if not self.masks[index] & bit:
            return self.const(0.0)
        known = self._derivatives
        stack = [index]
        while stack:  # what is known already is not looked at again
            place = stack[-1]
            node = self.nodes[place]
            due = [arg for arg in node.args if self.masks[arg] & bit and (arg, slot) not in known] if (
                node.op != "input" and (place, slot) not in known) else []
            self.budget.spend(3 * STEP + _EDGE * len(node.args))
            stack.extend(due)
            if not due:
                stack.pop()
                if (place, slot) not in known:
                    self.budget.hold(2)
                    known[place, slot] = self._rule(place, slot)
        return known[index, slot]

    def _known(self, index: int, slot: int) -> int:
        return self._derivatives.get((index, slot), -1) if self.masks[index] >> slot & 1 else self.const(0.0)

    def _rule(self, index: int, slot: int) -> int:
        op, args, value, part = self.nodes[index]
        if op == "input":
            return self.const(1.0)
        if part is not None:
            return networks.slope(self, part, args, [self._known(arg, slot) for arg in args])
        slope = OPERATIONS[op].slope
        if slope is None:
            return self.const(0.0)
        slopes = [self._known(arg, slot) for arg in args]
        return slope(self, index, *args, *slopes, *([value] if op == "pow" else []))


def longer(op: str, bits: int) -> int:
    """Bits of the exponent of an operation's value from those of its arguments."""
    if op in _PRODUCTS:
        return bits + 1
    if op == "pow":
        return bits + _POWER
    return _FLOAT if op in ("const", "input") else bits if op in _SUMS else _BITS
