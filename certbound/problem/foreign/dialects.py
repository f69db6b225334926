"""Expressions of other tools, rewritten as this package's: token by token, and refused where two readings are possible.

Both tools know ``+ - * / ^`` and parentheses. LUCID writes its states x1, x2, ... and binds a sign before a power,
-x1^2 = (-x1)^2, which is refused here. Julia writes x[1], x[2], ... and multiplies by standing beside, 2x[1], which is
refused behind / and ^, where it binds first.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<state>x\[\s*\d+\s*\]|x\d+(?!\w))"
    r"|(?P<name>[A-Za-z]\w*)|(?P<symbol>\*\*|[-+*/^(),]))"
)


@dataclass(frozen=True)
class Dialect:
    """How a tool writes expressions."""

    tool: str
    functions: frozenset[str]
    brackets: bool  # x[1] instead of x1
    sign_first: bool  # a sign binds before a power
    beside: bool  # 2x is a product


LUCID = Dialect("LUCID", frozenset("sin cos exp log sqrt tanh".split()), False, True, False)  # noqa: SIM905  (shorter)
JULIA = Dialect("StochasticBarrier.jl", frozenset(), True, False, True)


def rewritten(text: object, where: str, states: int, dialect: Dialect) -> str:
    """The expression in the words of problem files; what it says otherwise, or not clearly, is a ValueError.

    Examples
    --------
    >>> rewritten("x1 + 0.1 * sin(x2)^2", "f", 2, LUCID), rewritten("4.3 + 0.7x[1]^2", "f", 1, JULIA)
    ('x1 + 0.1 * sin(x2) ** 2', '4.3 + 0.7 * x1 ** 2')
    """
    if isinstance(text, int | float) and not isinstance(text, bool):
        text = repr(text)
    if not isinstance(text, str) or not text.strip():
        raise ValueError(f"`{where}` must be an expression, got {text!r}.")
    tokens = _tokens(text, where, states, dialect)
    if dialect.sign_first:
        _check_signs(tokens, text, where)
    if dialect.beside:
        tokens = _multiplied(tokens, text, where)
    return _spaced([word for _, word in tokens])


def _tokens(text: str, where: str, states: int, dialect: Dialect) -> list[tuple[str, str]]:
    found, place, end = [], 0, len(text.rstrip())
    while place < end:
        match = _TOKEN.match(text, place)
        if match is None:
            rest = text[place:].strip()
            raise ValueError(f"`{where}` must be an expression that is understood, got {text!r}: {rest[:1]!r} is not.")
        kind = str(match.lastgroup)
        word = match.group(kind)
        place = match.end()
        if kind == "state":
            number = int(re.sub(r"\D", "", word))
            if ("[" in word) != dialect.brackets or not 1 <= number <= states:
                raise ValueError(f"`{where}` must be of the {states} states, got {text!r}: {word} is none.")
            word = f"x{number}"
        if kind == "name" and word not in dialect.functions:
            names = ", ".join(sorted(dialect.functions)) or "no functions"
            raise ValueError(f"`{where}` uses {word!r}, which {dialect.tool}'s expressions here cannot; {names}.")
        found.append((kind, "**" if word == "^" else word))
    return found


def _check_signs(tokens: list[tuple[str, str]], text: str, where: str) -> None:
    """Refuse a sign whose operand is raised to a power."""
    for index, (_, word) in enumerate(tokens):
        before = tokens[index - 1][1] if index else "("
        if word not in "+-" or before not in ("(", ",", "+", "-", "*", "/", "**"):
            continue
        last = index + 1
        while last < len(tokens) and (tokens[last][1] in "+-" or tokens[last][0] == "name"):
            last += 1
        last = _closing(tokens, last)
        if last + 1 < len(tokens) and tokens[last + 1][1] == "**":
            raise ValueError(
                f"`{where}` has a sign before a power in {text!r}, which LUCID reads as (-x)^2; write parentheses."
            )


def _closing(tokens: list[tuple[str, str]], first: int) -> int:
    """The last token of the operand that begins at ``first``."""
    if first >= len(tokens) or tokens[first][1] != "(":
        return first
    depth = 0
    for index in range(first, len(tokens)):
        depth += (tokens[index][1] == "(") - (tokens[index][1] == ")")
        if depth == 0:
            return index
    return len(tokens) - 1


def _multiplied(tokens: list[tuple[str, str]], text: str, where: str) -> list[tuple[str, str]]:
    """Products by standing beside, written out."""
    found: list[tuple[str, str]] = []
    for index, (kind, word) in enumerate(tokens):
        before = tokens[index - 1] if index else ("symbol", "(")
        ends = before[0] in ("number", "state") or before[1] == ")"
        if ends and (kind in ("number", "state") or word == "("):
            earlier = tokens[index - 2][1] if index > 1 else "("
            if before[0] != "number" or kind == "number" or earlier in ("/", "**"):
                raise ValueError(f"`{where}` has a product without a sign in {text!r}; write it out, with *.")
            found.append(("symbol", "*"))
        found.append((kind, word))
    return found


def _spaced(words: list[str]) -> str:
    text = " ".join(words)
    return re.sub(r"(?<=\() | (?=[),])|(?<=[a-z]) (?=\()", "", text)
