"""Jumps and bends of the dynamics that time alone decides: on equal pieces of the horizon constants, or one side.

A proof names the number of pieces. That no such jump lies inside one is looked at piece by piece, in fractions; what
jumps at their ends is an input from then on, as the rows of a plan are. The one time of a jump has no weight. A time is
the decimal number that its float is written as.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise
from typing import Any

from certbound.checker.report import Budget, Unproved
from certbound.checker.statement import Model
from certbound.errors import CertificateError
from certbound.problem.model import JUMPS, Node, Tape

MOST_PIECES = 1000
_LARGEST, _LONGEST = 2**53, 4096  # a value of floor that is a float itself, and bits of a fraction
_PER_LINE, _ENTRY = 20_000, 60
"""Units of work of an operation on a piece in fractions (2 to 20 us), and bytes of what is kept of a jump on one."""
_CHOICE = "if_else_zero"
_OF_TRUTHS = frozenset(["and", "or", "not", _CHOICE])
_TRUTHS = JUMPS - {_CHOICE, "sign", "floor"}
_BENDS = frozenset(["min", "max", "abs"])

Ends = tuple[Fraction, Fraction]
"""The values of a straight line at the two ends of a piece."""


def with_time_pieces(model: Model, count: int, budget: Budget) -> Model:
    """The same problem on ``count`` equal pieces, with the jumps that time alone decides as rows of a plan.

    CertificateError where the problem has no such jumps, or no room for the pieces.
    """
    fixed = not model.continuous or model.plan is not None or model.hold is not None
    if fixed or math.isinf(model.horizon) or not 1 <= count <= MOST_PIECES:
        raise CertificateError("`proof.jumps` must be left out: time is discrete or endless, inputs are held, or many.")
    tape, horizon = model.dynamics, _decimal(model.horizon)
    timed = _timed(tape)
    ends = [horizon * k / count for k in range(count + 1)]
    found: dict[int, list[float | None]] = {index: [] for index in timed if tape.nodes[index].op in JUMPS | _BENDS}
    budget.spend(count * (len(timed) + 1) * _PER_LINE)
    budget.take(count * (len(found) + 1) * _ENTRY)
    for first, last in pairwise(ends):
        budget.check()
        lines: dict[int, Ends | None] = {}
        for index in timed:
            lines[index] = _short(_line(tape.nodes[index], lines, first, last))
            node = tape.nodes[index]
            if node.op in _BENDS:
                found[index].append(_side(node, [lines[arg] for arg in node.args]))
            elif index in found:
                value = lines[index]
                found[index].append(float(value[0]) if value is not None and value[0] == value[1] else None)
    values = {
        index: [value for value in row if value is not None]
        for index, row in found.items() if None not in row and tape.nodes[index].op != _CHOICE
    }  # fmt: skip
    return _replaced(model, values, count)


def _decimal(value: float) -> Fraction:
    return Fraction(repr(value))


def _timed(tape: Tape) -> list[int]:
    """Operations that no other input than t has a part in."""
    own: list[bool] = []
    for node in tape.nodes:
        own.append(node.args == (0,) if node.op == "input" else all(own[arg] for arg in node.args))
    return [index for index, timed in enumerate(own) if timed]


def _line(node: Node, lines: Mapping[int, Ends | None], first: Fraction, last: Fraction) -> Ends | None:
    """An operation inside a piece, where it is one straight line; None elsewhere."""
    if node.op == "const":
        return _decimal(node.value), _decimal(node.value)
    if node.op == "input":
        return first, last
    given = [line for line in (lines[arg] for arg in node.args) if line is not None]
    if len(given) < len(node.args) or node.part is not None:
        return None
    if node.op in _OF_TRUTHS:
        return _chosen(node.op, given)
    if node.op in JUMPS:
        return _step(node.op, given)
    if node.op in _BENDS:
        side = _side(node, given)
        other = given[1] if len(given) == 2 else (-given[0][0], -given[0][1])
        return None if side is None else given[0] if side else other
    a, b = given[0], given[-1]
    if node.op == "neg":
        return -a[0], -a[1]
    if node.op in ("add", "sub"):
        sign = 1 if node.op == "add" else -1
        return a[0] + sign * b[0], a[1] + sign * b[1]
    if node.op == "mul" and (_flat(a) or _flat(b)):
        return a[0] * b[0], a[1] * b[1]
    if node.op == "div" and _flat(b) and b[0] != 0:
        return a[0] / b[0], a[1] / b[0]
    return None


def _side(node: Node, given: Sequence[Ends | None]) -> float | None:
    """1 where a bend is its first side (of ``abs``: not the negative) on the piece, 0 where the other, or None."""
    known = [line for line in given if line is not None]
    if len(known) < len(given):
        return None
    over = [a - b for a, b in zip(*known)] if len(known) == 2 else list(known[0])
    if node.op == "min":
        over = [-value for value in over]
    return 1.0 if min(over) >= 0 else 0.0 if max(over) <= 0 else None


def _short(line: Ends | None) -> Ends | None:
    """None of fractions that grow beyond all use."""
    sizes = [part.bit_length() for end in line or () for part in (end.numerator, end.denominator)]
    return None if any(size > _LONGEST for size in sizes) else line


def _flat(line: Ends) -> bool:
    return line[0] == line[1]


def _chosen(op: str, given: Sequence[Ends]) -> Ends | None:
    """Truths, and what is chosen by one; conditions have to be constant."""
    if not all(_flat(line) for line in (given[:1] if op == _CHOICE else given)):
        return None
    holds = [line[0] != 0 for line in given]
    if op == _CHOICE:
        return given[1] if holds[0] else (Fraction(0), Fraction(0))
    truth = Fraction({"and": all(holds), "or": any(holds), "not": not holds[0]}[op])
    return truth, truth


def _step(op: str, given: Sequence[Ends]) -> Ends | None:
    """A jump between the ends of a piece; None where it may lie inside."""
    low, high = (a - b for a, b in zip(*given)) if len(given) == 2 else given[0]
    low, high = min(low, high), max(low, high)
    if op == "floor":
        value = Fraction(math.floor(low))
        return (value, value) if high <= value + 1 and abs(value) <= _LARGEST else None
    if low < 0 < high:
        return None
    sign = 0 if low == high == 0 else 1 if low >= 0 else -1
    if op == "sign":
        return Fraction(sign), Fraction(sign)
    truth = Fraction({"lt": sign < 0, "le": sign <= 0, "eq": sign == 0, "ne": sign != 0}[op])
    return truth, truth


def _replaced(model: Model, values: Mapping[int, Sequence[float]], count: int) -> Model:
    """The model with jumps as constants, or as inputs behind the states; a bend is one side, or each by its inputs."""
    tape, first = model.dynamics, 1 + model.dimension
    rows = list(dict.fromkeys(tuple(row) for row in values.values() if count == 1 or len(set(row)) > 1))
    if not rows:
        raise Unproved(f"time alone decides no jump of the dynamics at the ends of {count} pieces")
    model.budget.spend(len(rows) * len(values) * (100 + 10 * count))
    nodes: list[Node] = []
    place: list[int] = []

    def put(*parts: Any) -> int:
        nodes.append(Node(*parts))
        return len(nodes) - 1

    for index, node in enumerate(tape.nodes):
        row = tuple(values.get(index, ()))
        args = () if node.op == "input" else tuple(place[arg] for arg in node.args)
        if row and node.op in _BENDS:
            other = args[1] if len(args) == 2 else put("neg", args)
            if row in rows:
                side = put("input", (first + rows.index(row),))
                rest = put("mul", (put("sub", (put("const", (), 1.0), side)), other))
                place.append(put("add", (put("mul", (side, args[0])), rest)))
            else:
                place.append(args[0] if row[0] else other)
        elif row in rows:
            place.append(put("input", (first + rows.index(row),)))
        elif row:
            place.append(put("const", (), row[0]))
        elif node.op == _CHOICE and node.args[0] in values and tape.nodes[node.args[0]].op in _TRUTHS:
            place.append(put("mul", args))  # by 0 or 1
        elif node.op == "input":
            place.append(put("input", (node.args[0] + (len(rows) if node.args[0] >= first else 0),)))
        else:
            place.append(put(node.op, args, node.value, node.part))
    names = (*tape.inputs[:first], *(f"jump {k + 1}" for k in range(len(rows))), *tape.inputs[first:])
    outputs = tuple(place[output] for output in tape.outputs)
    new = Tape(inputs=names, nodes=tuple(nodes), outputs=outputs, shape=tape.shape)
    plan = [[row[k] for row in rows] for k in range(count)]
    return replace(model, dynamics=new, plan=plan)


def jumps_of(proof: object) -> tuple[int | None, object]:
    """The number of pieces that a proof names, and the proof without it."""
    if not isinstance(proof, Mapping) or "jumps" not in proof:
        return None, proof
    count = proof["jumps"]
    if not isinstance(count, int) or isinstance(count, bool):
        raise CertificateError("`proof.jumps` must be a whole number.")
    return count, {name: value for name, value in proof.items() if name != "jumps"}
