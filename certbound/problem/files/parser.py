"""Expressions in problem files: a small language with a parser of its own, safe on a stranger's file.

Numbers, names, ``+ - * / **``, comparisons with ``and or not``, parentheses, functions and the outputs
``policy(x, v)[0]`` of the file's networks; nothing else exists, so nothing else can be reached. All bind as in Python,
where ``**`` is tighter than a sign on its left; a truth is 0 or 1.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

from certbound.checks import nearest
from certbound.problem.model import ARITY, OPERATIONS, Graph, Network, Part, arithmetic

CONSTANTS: Mapping[str, float] = {"pi": math.pi}

_LONGEST, _DEEPEST = 20_000, 60
_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)|(?P<name>[^\W\d]\w*)"
    r"|(?P<symbol>\*\*|[<>=!]=|[-+*/(),<>]))"
)
_CURES = {
    ".": "attribute access does not exist here; write functions without a module's name, as in sin(x)",
    "[": "indexing does not exist here; use the states' names",
    "{": "braces do not exist here",
    "^": "write ** for powers",
    "%": "percent signs do not exist here; write 0.01 for 1 %",
    "=": "an expression has no assignment; use [definitions]",
    "'": "text does not exist here",
    '"': "text does not exist here",
}
_COMPARISONS = {
    "<": ("lt", False), "<=": ("le", False), ">": ("lt", True), ">=": ("le", True), "==": ("eq", False),
    "!=": ("ne", False),
}  # fmt: skip
"""The tape's operation of each, and whether it takes the sides in the other order."""
_BINDING = {
    "or": 1, "and": 2, **dict.fromkeys(_COMPARISONS, 4), "+": 5, "-": 5, "*": 6, "/": 6, "**": 8,
}  # fmt: skip
_NOT, _SIGN = 3, 7
_LOGIC = ("and", "or", "not")
_COMPOSED = ("where", "clip")  # of three arguments each, written by operations


class _Token(NamedTuple):
    kind: str
    text: str
    place: int


def parse(
    text: str, graph: Graph, names: Mapping[str, int | Callable[[], int]], where: str,
    networks: Mapping[str, Network] = MappingProxyType({}),
) -> int:
    """Read an expression into a graph; the node of its value.

    ``names`` maps a name to a node of the graph, or to a function that makes the node when the name is first used;
    ``networks`` are those that may be called. ``where`` is what the expression belongs to, for messages. A text that is
    no expression, or uses an unknown name or function, is a ValueError that names the nearest known one.

    Examples
    --------
    >>> graph = Graph(["x"])
    >>> node = parse("2*sin(x)**2", graph, {"x": graph.input(0)}, "dynamics.x")
    >>> graph.tape([node], (1,)).describe(-1)
    '(2 * sin(x)**2)'
    """
    if len(text) > _LONGEST:
        size = f"at most {_LONGEST} characters, got {len(text)}"
        raise ValueError(f"`{where}` must have {size}; use [definitions].")
    return _Parser(text, graph, names, where, networks).result()


class _Parser:
    def __init__(
        self, text: str, graph: Graph, names: Mapping[str, int | Callable[[], int]], where: str,
        networks: Mapping[str, Network],
    ) -> None:
        self.text, self.graph, self.names, self.where, self.networks = text, graph, names, where, networks
        self.tokens = self._split()
        self.next = 0
        self.depth = 0

    def fail(self, message: str, place: int | None = None) -> ValueError:
        at = "" if place is None else f" (position {place + 1})"
        shown = self.text if len(self.text) <= 80 else self.text[:77] + "..."
        return ValueError(f"`{self.where}` must be an expression, got {shown!r}{at}: {message}")

    def result(self) -> int:
        node = self.expression(0)
        token = self.peek()
        if token.kind != "end":
            raise self.fail(f"unexpected {token.text!r}{self._separator(token)}", token.place)
        return node

    def _separator(self, token: _Token) -> str:
        """What was meant by two values side by side."""
        before = self.tokens[self.next - 1]
        if token.text == ",":
            return "; write decimals with a point" if before.kind == "number" else ""
        if before.kind == "number" and token.kind == "name" and self.next == 1 and token.text not in self.names:
            return f"; write {before.text} without a unit, which [units] can name"
        return f"; write {before.text}*{token.text}" if before.kind == "number" else "; write * to multiply"

    def _split(self) -> list[_Token]:
        tokens: list[_Token] = []
        place, end = 0, len(self.text.rstrip())
        while place < end:
            match = _TOKEN.match(self.text, place)
            if match is None:
                blank = len(self.text[place:]) - len(self.text[place:].lstrip())
                character = self.text[place + blank]
                before = ["", "", *(token.text for token in tokens[-2:])]
                if (character, before[-1]) == ("[", ")") or (character, before[-2]) == ("]", "["):  # of a network
                    tokens.append(_Token("symbol", character, place + blank))
                    place += blank + 1
                    continue
                cure = _CURES.get(character, "such a character does not exist here")
                what, separator, rest = cure.partition(";")
                raise self.fail(f"{what} ({character!r}){separator}{rest}", place + blank)
            kind = match.lastgroup or "symbol"
            word = match.group(kind)
            tokens.append(_Token("symbol" if word in _LOGIC else kind, word, match.start(kind)))
            place = match.end()
        return [*tokens, _Token("end", "the end", end)]

    def peek(self) -> _Token:
        return self.tokens[self.next]

    def take(self) -> _Token:
        self.next += 1
        return self.tokens[self.next - 1]

    def expect(self, symbol: str) -> None:
        token = self.take()
        if token.text != symbol or token.kind != "symbol":
            raise self.fail(f"expected {symbol!r}, got {token.text!r}", token.place)

    def expression(self, least: int) -> int:
        self.depth += 1
        if self.depth > _DEEPEST:
            raise self.fail(f"nested deeper than {_DEEPEST} levels; use [definitions]", self.peek().place)
        node = self.prefix()
        while True:
            token = self.peek()
            strength = _BINDING.get(token.text, 0) if token.kind == "symbol" else 0
            if strength <= least:
                break
            self.next += 1
            node = self.combine(token, node, strength)
        self.depth -= 1
        return node

    def combine(self, token: _Token, left: int, strength: int) -> int:
        if token.text == "**":
            return self.power(left, self.expression(_SIGN - 1))
        right = self.expression(strength)
        if token.text in _COMPARISONS:
            if self.peek().text in _COMPARISONS:
                raise self.fail("a chain of comparisons does not exist here; write a < b and b < c", self.peek().place)
            op, turned = _COMPARISONS[token.text]
            return self.graph.apply(op, *((right, left) if turned else (left, right)))
        if token.text in _LOGIC:
            return self.graph.apply(token.text, left, right)
        if token.text == "/" and self.graph.number(right) == 0:
            raise self.fail("division by 0", token.place)
        op = {"+": "add", "-": "sub", "*": "mul", "/": "div"}[token.text]
        return self.graph.apply(op, left, right)

    def power(self, base: int, exponent: int) -> int:
        value = constant(self.graph, exponent)
        if value is not None:
            return self.graph.pow(base, value)
        return self.graph.apply("exp", self.graph.apply("mul", exponent, self.graph.apply("log", base)))

    def prefix(self) -> int:
        token = self.take()
        if token.kind == "number":
            value = float(token.text)
            if math.isinf(value):
                raise self.fail(f"{token.text} is too large", token.place)
            return self.graph.const(value)
        if token.kind == "name":
            return self.call(token) if self.peek().text == "(" else self.variable(token)
        if token.text == "(" and token.kind == "symbol":
            node = self.expression(0)
            self.expect(")")
            return node
        if token.text in ("-", "+"):
            node = self.expression(_SIGN)
            return self.graph.apply("neg", node) if token.text == "-" else node
        if token.text == "not" and token.kind == "symbol":
            return self.graph.apply("not", self.expression(_NOT))
        raise self.fail(f"expected a value, got {token.text!r}", token.place)

    def variable(self, token: _Token) -> int:
        name = token.text
        if name in self.names:
            value = self.names[name]
            return value if isinstance(value, int) else value()
        if name in CONSTANTS:
            return self.graph.const(CONSTANTS[name])
        if is_function(name):
            raise self.fail(f"{name} is a function; write {name}(...)", token.place)
        raise self.fail(f"unknown name {name!r}{nearest(name, [*self.names, *CONSTANTS])}", token.place)

    def call(self, token: _Token) -> int:
        name = token.text
        if name in self.networks:
            return self.output(self.networks[name], token)
        if not is_function(name):
            if name in self.names or name in CONSTANTS:
                raise self.fail(f"{name!r} is not a function; write * to multiply", token.place)
            known = [*filter(is_function, [*OPERATIONS, *_COMPOSED]), *self.networks]
            raise self.fail(f"unknown function {name!r}{nearest(name, known)}", token.place)
        arguments = self.arguments()
        count = 3 if name in _COMPOSED else ARITY[name]
        if len(arguments) != count and not (name in ("min", "max") and len(arguments) > 2):
            wanted = f"{count} argument{'s' * (count > 1)}"
            raise self.fail(f"{name} takes {wanted}, got {len(arguments)}", token.place)
        if name == "where":
            return self.choice(*arguments)
        if name == "clip":
            return self.graph.apply("min", self.graph.apply("max", *arguments[:2]), arguments[2])
        node = self.graph.apply(name, *arguments[:count])
        for argument in arguments[count:]:
            node = self.graph.apply(name, node, argument)
        return node

    def arguments(self) -> list[int]:
        self.expect("(")
        found = [self.expression(0)]
        while self.peek().text == ",":
            self.next += 1
            found.append(self.expression(0))
        self.expect(")")
        return found

    def output(self, network: Network, token: _Token) -> int:
        """An output of a network: its number in brackets may be left out where there is one."""
        arguments = self.arguments()
        if len(arguments) != network.inputs:
            raise self.fail(f"{token.text} takes {network.inputs} arguments, got {len(arguments)}", token.place)
        number = "0" if network.outputs == 1 else ""
        if self.peek().text == "[":
            self.next += 1
            number = self.take().text
            self.expect("]")
        if not number.isdigit() or int(number) >= network.outputs:
            last = network.outputs - 1
            raise self.fail(f"write {token.text}(...)[k] with k from 0 to {last} for one of its outputs", token.place)
        return self.graph.part(Part(network, int(number)), tuple(arguments))


    def choice(self, condition: int, x: int, y: int) -> int:
        """``where``: x where the condition holds, else y."""
        first, opposite = self.graph.apply("if_else_zero", condition, x), self.graph.apply("not", condition)
        return self.graph.apply("add", first, self.graph.apply("if_else_zero", opposite, y))


def is_function(name: str) -> bool:
    """Whether expressions may call it: min and max take two arguments or more, every other as many as on a tape."""
    return name in _COMPOSED or (name in OPERATIONS and OPERATIONS[name].in_files)


RESERVED = frozenset({"t", *filter(is_function, [*OPERATIONS, *_COMPOSED]), *CONSTANTS, *_LOGIC})
"""Names that no state, input, disturbance, parameter or definition may have."""


def constant(graph: Graph, node: int) -> float | None:
    """Value of a node that depends on no input, rounded; None for any other."""
    tape = graph.tape([node], (1,))
    if any(entry.op == "input" for entry in tape.nodes):
        return None
    return float(tape.evaluate(arithmetic("numpy"), [0.0] * len(tape.inputs))[0])
