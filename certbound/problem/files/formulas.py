"""From a tape back to expressions, for saving a model in a problem file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from types import MappingProxyType

from certbound.problem.files.parser import is_function
from certbound.problem.model import Network, Tape

_INFIX = {
    "or": ("or", 1), "and": ("and", 2), "lt": ("<", 4), "le": ("<=", 4), "eq": ("==", 4), "ne": ("!=", 4),
    "add": ("+", 5), "sub": ("-", 5), "mul": ("*", 6), "div": ("/", 6),
}  # fmt: skip
_NOT, _TIGHT, _SIGN, _POWER, _ATOM = 3, 6, 7, 8, 9
_DEEPEST = 12


def formulas(
    tape: Tape, names: Iterator[str], networks: Mapping[Network, str] = MappingProxyType({})
) -> tuple[dict[str, str], list[str]]:
    """Expressions that give the tape's outputs, with definitions for what is used twice or nested deeply.

    Returns the definitions in order, their fresh names taken from ``names``, and one expression per output: read again,
    they give the same operations on the same numbers. ``networks`` names those that the tape calls. An operation that
    problem files do not have (the kink of a derivative) is a ValueError.
    """
    uses = [0] * len(tape.nodes)
    for node in tape.nodes:
        if node.op != "input":
            for arg in node.args:
                uses[arg] += 1
    definitions: dict[str, str] = {}
    texts: list[tuple[str, int, int]] = []
    for index, node in enumerate(tape.nodes):
        text, strength = _text(tape, index, texts, networks)
        depth = 0 if node.op == "input" else 1 + max((texts[arg][2] for arg in node.args), default=-1)
        if node.op not in ("input", "const") and (uses[index] > 1 or depth >= _DEEPEST or len(text) > 400):
            name = next(names)
            definitions[name] = text
            text, strength, depth = name, _ATOM, 0
        texts.append((text, strength, depth))
    return definitions, [texts[output][0] for output in tape.outputs]


def _text(
    tape: Tape, index: int, texts: list[tuple[str, int, int]], networks: Mapping[Network, str]
) -> tuple[str, int]:
    """Text of a node, and how strongly it binds."""
    node = tape.nodes[index]
    if node.op == "input":
        return tape.inputs[node.args[0]], _ATOM
    if node.op == "const":
        return _number(node.value), _ATOM if node.value >= 0 else _SIGN
    if node.op in _INFIX:
        symbol, strength = _INFIX[node.op]
        left = _bracketed(texts[node.args[0]], strength + (strength == _INFIX["lt"][1]))
        right = _bracketed(texts[node.args[1]], strength + 1)
        space = "" if strength == _TIGHT else " "
        return f"{left}{space}{symbol}{space}{right}", strength
    if node.op == "neg":
        return f"-{_bracketed(texts[node.args[0]], _POWER)}", _SIGN
    if node.op == "not":
        return f"not {_bracketed(texts[node.args[0]], _NOT + 1)}", _NOT
    if node.op == "if_else_zero":
        return f"where({texts[node.args[0]][0]}, {texts[node.args[1]][0]}, 0)", _ATOM
    if node.op in ("sq", "pow"):
        exponent = 2.0 if node.op == "sq" else node.value
        power = _number(exponent) if exponent >= 0 else f"({_number(exponent)})"
        return f"{_bracketed(texts[node.args[0]], _ATOM)}**{power}", _POWER
    if node.part is not None and not node.part.by and node.part.network in networks:
        name = networks[node.part.network]
        return f"{name}({', '.join(texts[arg][0] for arg in node.args)})[{node.part.output}]", _ATOM
    if is_function(node.op):
        return f"{node.op}({', '.join(texts[arg][0] for arg in node.args)})", _ATOM
    raise ValueError(
        f"the model uses {tape.describe(index)}, and {node.op} does not exist in problem files; keep the "
        "model in Python and load it by module:name."
    )


def _bracketed(entry: tuple[str, int, int], least: int) -> str:
    return entry[0] if entry[1] >= least else f"({entry[0]})"


def _number(value: float) -> str:
    return str(int(value)) if value == int(value) and abs(value) < 1e15 else repr(float(value))
