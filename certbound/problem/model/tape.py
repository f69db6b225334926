"""A traced model as plain data: a straight-line program over scalars.

A tape is read by the interval enclosures, by the simulation kernels, by the optimal-control transcription and
by the certificate checker; each reader brings its own arithmetic. Reading a tape needs nothing but this
module.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

from certbound.problem.model.network_data import PARTS, Part

T = TypeVar("T")

_MOST_SHOWN = 4  # arguments of a network in a message

ARITY: dict[str, int] = {
    "const": 0, "input": 1, "pow": 1,
    "neg": 1, "sq": 1, "sqrt": 1, "exp": 1, "log": 1, "sin": 1, "cos": 1, "tan": 1, "asin": 1, "acos": 1, "atan": 1,
    "sinh": 1, "cosh": 1, "tanh": 1, "abs": 1, "kink": 1, "sign": 1, "floor": 1, "not": 1,
    "add": 2, "sub": 2, "mul": 2, "div": 2, "atan2": 2, "hypot": 2, "min": 2, "max": 2, "lt": 2, "le": 2, "eq": 2,
    "ne": 2, "and": 2, "or": 2, "if_else_zero": 2,
}  # fmt: skip
"""Operations and their numbers of arguments (``sq`` is the square; the exponent of ``pow`` is a constant beside them).

``kink`` is the generalised derivative of abs: -1 left of 0, 1 right of it, and **all of [-1, 1]** at 0 (so
that an interval reader encloses it by [-1, 1] on a box that contains 0, and refuses nothing). It occurs in
derivatives only. ``if_else_zero(c, y)`` is y where c holds, else 0; comparisons are 0 or 1.
"""

JUMPS = frozenset(
    "sign floor not lt le eq ne and or if_else_zero".split()  # noqa: SIM905  (shorter)
)
"""Operations that jump (``atan2`` too, across its cut): a reader that differentiates must decide them."""


class Node(NamedTuple):
    """One operation: ``args`` are indices of earlier nodes.

    ``value`` is the number of a ``const`` node and the exponent of a ``pow`` node; an ``input`` node has its
    slot as its only argument. A node of ``network_data.PARTS`` is the ``part`` of a network, with the inputs of that
    as arguments.
    """

    op: str
    args: tuple[int, ...] = ()
    value: float = 0.0
    part: Part | None = None

    @property
    def arity(self) -> int | None:
        """The number of arguments that the operation has; None for an unknown one."""
        if self.op in PARTS:
            return None if self.part is None or self.part.op != self.op else self.part.network.inputs
        return ARITY.get(self.op)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Tape:
    """A vector- or matrix-valued function of named scalars."""

    # names of the scalar inputs, in slot order; for a system's dynamics: ``t``, states, inputs, disturbances
    inputs: tuple[str, ...]
    nodes: tuple[Node, ...]  # operations in topological order
    outputs: tuple[int, ...]  # node of each output, in row-major order
    shape: tuple[int, ...]  # shape of the output, ``(n,)`` or ``(rows, columns)``

    def __post_init__(self) -> None:
        for index, node in enumerate(self.nodes):
            limit = len(self.inputs) if node.op == "input" else index
            if any(not 0 <= arg < limit for arg in node.args):
                raise ValueError(f"`nodes` must refer to earlier nodes only; node {index} is {node}.")
            if len(node.args) != node.arity:
                raise ValueError(f"`nodes` holds an unknown operation or arity: node {index} is {node}.")
        if any(not 0 <= output < len(self.nodes) for output in self.outputs):
            raise ValueError("`outputs` must be indices of nodes.")

    def evaluate(self, arithmetic: Mapping[str, Callable[..., Any]], inputs: Sequence[Any]) -> list[Any]:
        """Values of the outputs, computed in the given arithmetic.

        Parameters
        ----------
        arithmetic : mapping
            Operation name to function; ``const`` maps a float, ``pow`` maps (base, exponent as float), and the parts of
            networks have the part as a last argument.
        inputs : sequence
            One value per input slot, of whatever type the arithmetic works on.
        """
        if len(inputs) != len(self.inputs):
            raise ValueError(f"`inputs` must hold {len(self.inputs)} values, got {len(inputs)}.")
        values: list[Any] = []
        for node in self.nodes:
            if node.op == "input":
                values.append(inputs[node.args[0]])
            elif node.op == "const":
                values.append(arithmetic["const"](node.value))
            elif node.op == "pow":
                values.append(arithmetic["pow"](values[node.args[0]], node.value))
            elif node.part is not None:
                values.append(arithmetic[node.op](*(values[arg] for arg in node.args), node.part))
            else:
                values.append(arithmetic[node.op](*(values[arg] for arg in node.args)))
        return [values[output] for output in self.outputs]

    def lives(self) -> tuple[list[list[int]], int]:
        """The values that each operation is the last to need, and how many are there at once at most."""
        last = list(range(len(self.nodes)))
        for index, node in enumerate(self.nodes):
            for arg in () if node.op == "input" else node.args:
                last[arg] = index
        for output in self.outputs:
            last[output] = len(self.nodes)
        ended: list[list[int]] = [[] for _ in self.nodes]
        for place, index in enumerate(last):
            if index < len(self.nodes):
                ended[index].append(place)
        there = most = 0
        for places in ended:
            there += 1
            most = max(most, there)
            there -= len(places)
        return ended, most

    def describe(self, index: int) -> str:
        """The expression that node ``index`` stands for, for error messages (cut after 120 characters)."""
        text = self._expression(index, depth=6)
        return text if len(text) <= 120 else text[:117] + "..."

    def _expression(self, index: int, depth: int) -> str:
        node = self.nodes[index]
        if node.op == "input":
            return self.inputs[node.args[0]]
        if node.op == "const":
            return f"{node.value:g}"
        if depth == 0:
            return "..."
        parts = [self._expression(arg, depth - 1) for arg in node.args[:_MOST_SHOWN]]
        if len(node.args) > _MOST_SHOWN:
            parts.append("...")
        infix = dict(add="+", sub="-", mul="*", div="/", lt="<", le="<=", eq="==", ne="!=")  # noqa: C408  (shorter)
        if node.op in infix:
            return f"({parts[0]} {infix[node.op]} {parts[1]})"
        if node.op in ("pow", "sq"):
            return f"{parts[0]}**{2 if node.op == 'sq' else node.value:g}"
        if node.part is not None:
            slopes = "".join(f", d{place}" for place in node.part.by)
            return f"{node.part.network.name}({', '.join(parts)})[{node.part.output}{slopes}]"
        return f"-{parts[0]}" if node.op == "neg" else f"{node.op}({', '.join(parts)})"


def needed(nodes: Sequence[Node], outputs: Sequence[int], keep: int = 0) -> list[bool]:
    """Whether each node is an output, one of the first ``keep``, or what one of these depends on."""
    found = [index < keep for index in range(len(nodes))]
    for output in outputs:
        found[output] = True
    for index in range(len(nodes) - 1, -1, -1):
        if found[index] and nodes[index].op != "input":
            for arg in nodes[index].args:
                found[arg] = True
    return found
