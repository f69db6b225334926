"""Tape to Python source: straight-line code over scalars that numba compiles.

Numbers of the tape become entries of a parameter array, so that the source (and its compiled form on disk)
depends on the structure of a model alone: a sweep over a parameter compiles once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from certbound.problem.model import OPERATIONS, Network, Node, Tape, needed
from certbound.simulation.network_text import network_lines


@dataclass(eq=False, slots=True)
class Parameters:
    """The array ``p`` of numbers that a kernel reads, filled while its source is written."""

    values: list[float] = field(default_factory=list)
    places: list[int] = field(default_factory=list)  # the kernel's array INDEX
    wide: bool = False  # whether the states are arrays: see ``wide_text``

    def add(self, value: float) -> str:
        """Append a number; returns the expression that reads it."""
        self.values.append(float(value))
        return f"p[{len(self.values) - 1}]"

    def extend(self, values: Sequence[float]) -> int:
        """Append numbers; returns the place of the first."""
        self.values.extend(values)
        return len(self.values) - len(values)

    def place(self, places: Sequence[int], counter: str) -> str:
        """The expression that is the entry ``counter`` of some places."""
        if all(place == places[0] + i for i, place in enumerate(places)):
            return f"{places[0]} + {counter}"
        self.places.extend(places)
        return f"INDEX[{len(self.places) - len(places)} + {counter}]"

    def value_of(self, expression: str) -> float | None:
        """The number behind an expression, None unless it is one of these parameters or "0.0"."""
        if expression.startswith("p[") and expression[2:-1].isdigit():
            return self.values[int(expression[2:-1])]
        return 0.0 if expression == "0.0" else None

    def is_zero(self, expression: str) -> bool:
        """Whether an expression is known to be 0."""
        return self.value_of(expression) == 0.0


def vector(letter: str, count: int) -> list[str]:
    """Names letter_0, letter_1, ..."""
    return [f"{letter}_{i}" for i in range(count)]


def indent(lines: Sequence[str]) -> list[str]:
    """Lines moved to the right."""
    return ["    " + line for line in lines]


def each(line: str, count: int, p: Parameters) -> list[str]:
    """A line for every state, ``{0}`` standing for its number: a loop where the states are arrays."""
    if p.wide:
        return [f"for i in range({count}):", "    " + line.format("i")]
    return [line.format(i) for i in range(count)]


def live_nodes(tape: Tape) -> list[int]:
    """Indices of the nodes that the outputs need, in order."""
    return [index for index, live in enumerate(needed(tape.nodes, tape.outputs)) if live]


def function_source(name: str, tape: Tape, arguments: Sequence[str], parameters: Parameters) -> list[str]:
    """Source lines of ``name(p, *arguments)``, which returns the tape's outputs as a tuple.

    ``arguments`` name the input slots in the generated source; ``parameters`` receives the numbers of the tape.

    Examples
    --------
    >>> tape = Tape(inputs=("a",), nodes=(Node("input", (0,)), Node("sin", (0,))), outputs=(1,), shape=(1,))
    >>> print(*function_source("drift", tape, ["x_0"], Parameters()), sep="\\n")
    def drift(p, x_0):
        v1 = math.sin(x_0)
        return (v1,)
    """
    lines = [f"def {name}({', '.join(['p', *arguments])}):"]
    names: dict[int, str] = {}
    live = live_nodes(tape)
    pairs = _pairs(tape, live)
    called: dict[tuple[Network, tuple[int, ...]], str] = {}
    for index in live:
        node = tape.nodes[index]
        if node.op == "input":
            names[index] = arguments[node.args[0]]
        elif node.op == "const":
            names[index] = parameters.add(node.value)
        elif index in pairs:
            sine, cosine = pairs[index]
            if index == min(sine, cosine):
                lines.append(f"    v{sine}, v{cosine} = sincos({names[node.args[0]]})")
            names[index] = f"v{index}"
        elif node.part is not None:
            if node.part.by:
                raise ValueError("a derivative of a network has no kernel; simulate with scheme='euler'.")
            key = node.part.network, node.args
            if key not in called:
                called[key] = f"n{index}"
                operands = [names[arg] for arg in node.args]
                lines += indent(network_lines(node.part.network, f"n{index}", operands, parameters))
            names[index] = f"{called[key]}[{node.part.output}]"
        else:
            names[index] = f"v{index}"
            operands = [names[arg] for arg in node.args]
            lines.append(f"    v{index} = {_operation(node, operands, parameters)}")
    results = "".join(f"{names[output]}, " for output in tape.outputs).rstrip()
    lines.append(f"    return ({results[:-1] if len(tape.outputs) > 1 else results})")
    return lines


def _pairs(tape: Tape, live: Sequence[int]) -> dict[int, tuple[int, int]]:
    """Sines and cosines of the same argument, computed together: node to (sine, cosine)."""
    places: dict[tuple[str, int], int] = {}
    for index in live:
        node = tape.nodes[index]
        if node.op in ("sin", "cos"):
            places.setdefault((node.op, node.args[0]), index)
    pairs: dict[int, tuple[int, int]] = {}
    for (op, argument), index in places.items():
        if op == "sin" and ("cos", argument) in places:
            other = places["cos", argument]
            pairs[index] = pairs[other] = (index, other)
    return pairs


def _operation(node: Node, operands: list[str], parameters: Parameters) -> str:
    if node.op == "pow":
        return power(operands[0], node.value, parameters)
    return OPERATIONS[node.op].kernel.format(*operands)


def power(base: str, exponent: float, parameters: Parameters) -> str:
    """Small whole exponents become products, which are ten times faster than a call of pow."""
    if exponent == 0.5:
        return f"math.sqrt({base})"
    if exponent == int(exponent) and 1 <= abs(exponent) <= 12:
        product = _product(base, int(abs(exponent)))
        return product if exponent > 0 else f"1.0 / ({product})"
    return OPERATIONS["pow"].kernel.format(base, parameters.add(exponent))


def _product(base: str, count: int) -> str:
    if count == 1:
        return base
    half = _product(base, count // 2)
    squared = f"({half}) * ({half})" if count > 3 else " * ".join([base] * (count // 2 * 2))
    return f"{squared} * {base}" if count % 2 else squared


def linear_form(row: Sequence[float], names: Sequence[str], parameters: Parameters) -> str:
    """Expression of ``row . names``, with zero entries left out ("0.0" where all are).

    Examples
    --------
    >>> linear_form([2.0, 0.0, 1.0], ["a", "b", "c"], Parameters())
    'p[0] * a + c'
    """
    terms = []
    for weight, name in zip(row, names, strict=True):
        if weight == 1.0:
            terms.append(name)
        elif weight != 0.0:
            terms.append(f"{parameters.add(weight)} * {name}")
    return " + ".join(terms) if terms else "0.0"
