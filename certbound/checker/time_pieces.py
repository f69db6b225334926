"""Jumps and bends of the dynamics that time alone decides: on equal pieces of the horizon constants, or one side.

A proof names the number of pieces. That no such jump lies inside one is looked at piece by piece, in fractions; what
jumps at their ends is an input from then on, as the rows of a plan are. The one time of a jump has no weight. A number
is its float, exactly. A jump may miss the end of its piece by rounding, at most by the share `NEAR` of the horizon:
about every end the model's `changes` say from when to when, and which values inputs have there, for proofs to pay for.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Any, NamedTuple

from certbound.checker.report import Budget, Unproved
from certbound.checker.statement import Change, Model
from certbound.errors import CertificateError
from certbound.problem.model import JUMPS, Node, Tape

MOST_PIECES = 1000
NEAR = Fraction(1, 2**48)
"""Share of the horizon by which a jump may miss the end of its piece."""
_MOST_BREAKS = 40  # about one end
_LARGEST, _LONGEST = 2**53, 4096  # a value of floor that is a float itself, and bits of a fraction
_PER_LINE, _PER_BIT, _ENTRY = 20_000, 40, 150
"""Units of work of an operation on a piece in fractions (2 to 20 us) and of every bit of its result, and bytes of what
is kept of a jump on one."""
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
    tape, horizon = model.dynamics, Fraction(model.horizon)
    timed = _timed(tape)
    jumps = [index for index in timed if tape.nodes[index].op in JUMPS | _BENDS]
    ends, near = [horizon * k / count for k in range(count + 1)], horizon * NEAR
    budget.expect((2 * count + 1) * (len(timed) + 1) * _PER_LINE)
    inside, about = [], []
    for k, end in enumerate(ends):
        about.append(_about(tape, timed, max(end - near, Fraction(0)), min(end + near, horizon), budget))
        if k < count:
            inside.append(_values(tape, timed, end + near, ends[k + 1] - near, budget)[0])
    courses = {}
    for index in jumps:
        rows = tuple(tuple(row[index] for row in own) for _, own in about)
        course = _Course(tuple(row[index] for row in inside), rows)
        if course.known and tape.nodes[index].op != _CHOICE:
            courses[index] = course
    return _replaced(model, courses, ends, [breaks for breaks, _ in about])


class _Course(NamedTuple):
    """The values of a jump: inside of every piece, and from break to break about every end of one; None: unknown."""

    inside: tuple[float | None, ...]
    about: tuple[tuple[float | None, ...], ...]

    @property
    def known(self) -> bool:
        """Whether all are."""
        return None not in self.inside and not any(None in row for row in self.about)

    @property
    def changes(self) -> bool:
        """Whether they differ."""
        return len({*self.inside, *(value for row in self.about for value in row)}) > 1


def _about(
    tape: Tape, timed: Sequence[int], first: Fraction, last: Fraction, budget: Budget
) -> tuple[list[Fraction], list[dict[int, float | None]]]:
    """Times about the end of a piece at which something jumps or bends, and the values from one to the next."""
    breaks, place = [first, last], 0
    rows: list[dict[int, float | None]] = []
    while place + 1 < len(breaks):
        values, jump = _values(tape, timed, breaks[place], breaks[place + 1], budget)
        if jump is None or len(breaks) > _MOST_BREAKS:
            rows.append(values)
            place += 1
        else:
            breaks.insert(place + 1, jump)
    return breaks[1:-1], rows


def _values(
    tape: Tape, timed: Sequence[int], first: Fraction, last: Fraction, budget: Budget
) -> tuple[dict[int, float | None], Fraction | None]:
    """What jumps and sides of bends are between two times, None where unknown; and a time inside at which one jumps."""
    budget.spend((len(timed) + 1) * _PER_LINE)
    budget.take(sum(tape.nodes[index].op in JUMPS | _BENDS for index in timed) * _ENTRY)
    lines: dict[int, Ends | None] = {}
    values: dict[int, float | None] = {}
    jump = None
    for index in timed:
        node = tape.nodes[index]
        line = lines[index] = _short(_line(node, lines, first, last), budget)
        if node.op in _BENDS:
            values[index] = _side(node, [lines[arg] for arg in node.args])
        elif node.op in JUMPS:
            values[index] = float(line[0]) if line is not None and line[0] == line[1] else None
        given = [lines[arg] for arg in node.args] if node.op in JUMPS | _BENDS else [None]
        if jump is None and values.get(index) is None and node.op not in _OF_TRUTHS and None not in given:
            jump = _crossing(node.op, [line for line in given if line is not None], first, last)
    return values, jump


def _crossing(op: str, given: Sequence[Ends], first: Fraction, last: Fraction) -> Fraction | None:
    """A time inside at which what jumps or bends crosses 0 (``floor``: a whole number)."""
    start, end = (a - b for a, b in zip(*given)) if len(given) == 2 else given[0]
    level = Fraction(math.floor(min(start, end)) + 1) if op == "floor" else Fraction(0)
    crossed = min(start, end) < level < max(start, end)
    return first + (last - first) * (level - start) / (end - start) if crossed else None


def _timed(tape: Tape) -> list[int]:
    """Operations that no other input than t has a part in."""
    own: list[bool] = []
    for node in tape.nodes:
        own.append(node.args == (0,) if node.op == "input" else all(own[arg] for arg in node.args))
    return [index for index, timed in enumerate(own) if timed]


def _line(node: Node, lines: Mapping[int, Ends | None], first: Fraction, last: Fraction) -> Ends | None:
    """An operation inside a piece, where it is one straight line; None elsewhere."""
    if node.op == "const":
        return Fraction(node.value), Fraction(node.value)
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


def _short(line: Ends | None, budget: Budget) -> Ends | None:
    """None of fractions that grow beyond all use; their length counts as work."""
    sizes = [part.bit_length() for end in line or () for part in (end.numerator, end.denominator)]
    budget.spend(sum(sizes) * _PER_BIT)
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


def _replaced(
    model: Model, values: Mapping[int, _Course], ends: Sequence[Fraction], breaks: Sequence[Sequence[Fraction]]
) -> Model:
    """The model with jumps as constants, or as inputs behind the states; a bend is one side, or each by its inputs."""
    tape, first, count = model.dynamics, 1 + model.dimension, len(ends) - 1
    rows = list(dict.fromkeys(course for course in values.values() if count == 1 or course.changes))
    if not rows:
        raise Unproved(f"time alone decides no jump of the dynamics at the ends of {count} pieces")
    kept = sum(map(len, breaks)) + 3 * count + 1  # numbers of a course
    model.budget.spend(len(rows) * len(values) * (100 + 10 * kept))
    model.budget.take(len(rows) * kept * _ENTRY // 2)
    nodes: list[Node] = []
    place: list[int] = []

    def put(*parts: Any) -> int:
        nodes.append(Node(*parts))
        return len(nodes) - 1

    for index, node in enumerate(tape.nodes):
        row = values.get(index)
        args = () if node.op == "input" else tuple(place[arg] for arg in node.args)
        if row is not None and node.op in _BENDS:
            other = args[1] if len(args) == 2 else put("neg", args)
            if row in rows:
                side = put("input", (first + rows.index(row),))
                rest = put("mul", (put("sub", (put("const", (), 1.0), side)), other))
                place.append(put("add", (put("mul", (side, args[0])), rest)))
            else:
                place.append(args[0] if row.inside[0] else other)
        elif row is not None and row in rows:
            place.append(put("input", (first + rows.index(row),)))
        elif row is not None:
            place.append(put("const", (), row.inside[0]))
        elif node.op == _CHOICE and node.args[0] in values and tape.nodes[node.args[0]].op in _TRUTHS:
            place.append(put("mul", args))  # by 0 or 1
        elif node.op == "input":
            place.append(put("input", (node.args[0] + (len(rows) if node.args[0] >= first else 0),)))
        else:
            place.append(put(node.op, args, node.value, node.part))
    names = (*tape.inputs[:first], *(f"jump {k + 1}" for k in range(len(rows))), *tape.inputs[first:])
    outputs = tuple(place[output] for output in tape.outputs)
    new = Tape(inputs=names, nodes=tuple(nodes), outputs=outputs, shape=tape.shape)
    plan = [[_known(row.inside[k]) for row in rows] for k in range(count)]
    changes = [_change(k, ends, breaks[k], rows) for k in range(count + 1)]
    return replace(model, dynamics=new, plan=plan, changes=changes)


def _change(k: int, ends: Sequence[Fraction], breaks: Sequence[Fraction], rows: Sequence[_Course]) -> Change:
    """What happens about the end ``k`` of a piece; before 0 and after the horizon there is nothing."""
    times = list(breaks) or [ends[k]]
    if breaks and k in (0, len(ends) - 1):
        times = [ends[0], *times] if k == 0 else [*times, ends[-1]]
    columns = [[_known(value) for value in row.about[k]] for row in rows]
    return Change(times[0], times[-1], [min(column) for column in columns], [max(column) for column in columns])


def _known(value: float | None) -> float:
    assert value is not None
    return value


def jumps_of(proof: object) -> tuple[int | None, object]:
    """The number of pieces that a proof names, and the proof without it."""
    if not isinstance(proof, Mapping) or "jumps" not in proof:
        return None, proof
    count = proof["jumps"]
    if not isinstance(count, int) or isinstance(count, bool):
        raise CertificateError("`proof.jumps` must be a whole number.")
    return count, {name: value for name, value in proof.items() if name != "jumps"}
