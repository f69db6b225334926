"""Jumps and bends that the clock alone decides: ``where(t < 5, a, b)`` is a constant on either side of t = 5, and
``min(t, 5)`` one of its arguments.

In continuous time such a jump is no hindrance: what the model says at the one time of the jump has no weight. The
horizon is cut into equal pieces that have the jumps at their ends, and what jumps becomes an input with a value a
piece, as the rows of an array plan are.

A number is the float that it is read as, exactly: everything here is computed in fractions. The ends of equal pieces
may miss a jump by rounding (0.3 is no tenth of a second): a `Change` says when the function really jumps, and to what.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import NamedTuple

from certbound.problem.model.analysis import reads
from certbound.problem.model.graph import Graph
from certbound.problem.model.tape import JUMPS, Node, Tape

_MOST_JUMPS = 500
_MOST_PIECES = 1000
_MOST_BENT = 100  # pieces for the sake of bends, which engines can do without
_NEAR = Fraction(1, 2**48)  # share of the horizon by which a jump may miss the end of its piece; engines pay for it
_CHOICE = "if_else_zero"
_TRUTHS = JUMPS - {_CHOICE, "sign", "floor"}  # 0 or 1
_BENDS = frozenset({"min", "max", "abs"})
_CUT = JUMPS | _BENDS

Line = tuple[Fraction, Fraction]
"""Slope and offset of a function of t that is a straight line on a piece."""
_NOTHING: Line = (Fraction(0), Fraction(0))


class Change(NamedTuple):
    """What happens about the end of an equal piece: rows change from ``first`` to ``last``, exact times.

    In between and beside them every input lies in ``low`` to ``high``.
    """

    first: Fraction
    last: Fraction
    low: tuple[float, ...]
    high: tuple[float, ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class TimeJumps:
    """A function whose jumps at known times are inputs.

    ``tape`` has the inputs ``names`` behind the first ``1 + states`` of the function; ``rows`` holds their values on
    equal pieces of the horizon, a row a piece, up to what the ``changes`` at 0, between two pieces and at the horizon
    miss their ends by.
    """

    tape: Tape
    names: tuple[str, ...]
    rows: tuple[tuple[float, ...], ...]
    changes: tuple[Change, ...] = ()


def cut_at_jumps(tape: Tape, states: int, horizon: float) -> TimeJumps | None:
    """The function without the jumps that t alone decides; None where it has none, or they fit into no equal pieces.

    So too without its bends, where these fit into a hundred pieces. Each counts where its argument is, piece by piece,
    a straight line in t: ``t < 5``, ``sign(t - 3)``, ``floor(t/2)``, ``t - 2*floor(t/2) < 1``, ``min(t, 5)``.

    Parameters
    ----------
    tape : Tape
        Over t, the states, and whatever else.
    states : int
        Number of states.
    horizon : float
        The length of time, finite.
    """
    found, own = reads(tape), _timed(tape)
    straight = [index for index in own if tape.nodes[index].op not in _BENDS]
    for kept, ops, most in ((own, _CUT, _MOST_BENT), (straight, JUMPS, _MOST_PIECES)):
        if any(tape.nodes[index].op in ops and found[index] for index in kept):
            cut = _cut(tape, states, Fraction(horizon), kept, most)
            if cut is not None:
                return cut
    return None


def between_jumps(tape: Tape, states: int, horizon: float) -> list[tuple[float, Tape]]:
    """The function from one of its jumps that t alone decides to the next: the end of each piece, and its tape.

    One piece where it has none, or too many, or jumps at a time that is no float. The arguments are those of
    `cut_at_jumps`.
    """
    straight = [index for index in _timed(tape) if tape.nodes[index].op not in _BENDS]
    if not any(tape.nodes[index].op in JUMPS for index in straight) or math.isinf(horizon):
        return [(float(horizon), tape)]
    known = _known(tape, straight, Fraction(horizon))
    cut = None if known is None else _with_inputs(tape, states, known[1], every=True)
    if known is None or cut is None or any(Fraction(float(end)) != end for end in known[0]):
        return [(float(horizon), tape)]
    found = []
    for end, row in zip(known[0][1:], cut.rows):
        graph, first = Graph(tape.inputs), 1 + states
        slots = [graph.input(slot) for slot in range(len(tape.inputs))]
        slots[first:first] = [graph.const(value) for value in row]
        outputs = cut.tape.evaluate(graph.arithmetic(), slots)
        found.append((float(end), graph.tape(outputs, tape.shape)))
    return found


def _timed(tape: Tape) -> list[int]:
    """The nodes that see nothing but the clock."""
    return [index for index, seen in enumerate(reads(tape)) if seen <= {0}]


def _cut(tape: Tape, states: int, horizon: Fraction, own: Sequence[int], most: int) -> TimeJumps | None:
    """The function without what jumps or bends among the nodes ``own``, in at most so many pieces."""
    known = _known(tape, own, horizon)
    if known is None:
        return None
    breaks, values = known
    shares = [(end / horizon).limit_denominator(most) for end in breaks]
    if any(abs(share * horizon - end) > _NEAR * horizon for share, end in zip(shares, breaks)):
        return None
    count = math.lcm(*(share.denominator for share in shares))
    if count > most:
        return None
    found = _with_inputs(tape, states, values, every=count == 1 and _touches(tape, own, horizon))
    return None if found is None else _on_pieces(found, count, breaks, [int(share * count) for share in shares])


def _on_pieces(found: TimeJumps, count: int, breaks: Sequence[Fraction], nearest: Sequence[int]) -> TimeJumps:
    """Rows between breaks as rows on ``count`` equal pieces, and what happens about their ends, to which each break is
    ``nearest``."""
    rows, changes, horizon = [], [], breaks[-1]
    inner = range(1, len(breaks) - 1)
    for edge in range(count + 1):
        own = [place for place in inner if nearest[place] == edge]
        before = sum(nearest[place] < edge for place in inner)
        beside = [found.rows[place] for place in range(before, before + len(own) + 1)]
        times = [breaks[place] for place in own] or [horizon * edge / count]
        if own and edge in (0, count):  # what holds before, or after, lies in between
            times = [Fraction(0), *times] if edge == 0 else [*times, horizon]
        low, high = (tuple(pick(column) for column in zip(*beside)) for pick in (min, max))
        changes.append(Change(times[0], times[-1], low, high))
        rows.append(beside[-1])
    return replace(found, rows=tuple(rows[:-1]), changes=tuple(changes))


def _known(
    tape: Tape, own: Sequence[int], horizon: Fraction
) -> tuple[list[Fraction], dict[int, list[float]]] | None:
    """0, the times at which ``own`` jumps or bends and the horizon, and its values in between; None of too many."""
    breaks, found = _breaks(tape, own, horizon), reads(tape)
    if breaks is None:
        return None
    values = _values(tape, own, breaks)
    return breaks, {index: values[index] for index in _frontier(tape, values) if found[index]}


def _breaks(tape: Tape, own: Sequence[int], horizon: Fraction) -> list[Fraction] | None:
    """0, the times where something of ``own`` jumps, and the horizon; None where there are too many."""
    breaks = [Fraction(0), horizon]
    piece = 0
    while piece + 1 < len(breaks):
        new = next(_jumps_within(tape, own, breaks[piece], breaks[piece + 1]), None)
        if new is None:
            piece += 1
            continue
        breaks.insert(piece + 1, new)
        if len(breaks) > _MOST_JUMPS:
            return None
    return breaks


def _jumps_within(tape: Tape, own: Sequence[int], first: Fraction, last: Fraction) -> Iterator[Fraction]:
    """Times inside a piece at which a node of ``own`` jumps, as far as that can be said."""
    lines: dict[int, Line | None] = {}
    for index in own:
        node = tape.nodes[index]
        if node.op in _CUT and all(lines.get(arg) is not None for arg in node.args):
            yield from _crossings(node.op, _compared(node, lines), first, last)
        lines[index] = _line(node, lines, (first + last) / 2)


def _touches(tape: Tape, own: Sequence[int], horizon: Fraction) -> bool:
    """Whether something jumps next to time 0 or the end: inside of the closed piece rounded times decide nothing."""
    lines: dict[int, Line | None] = {}
    for index in own:
        node = tape.nodes[index]
        if node.op in _CUT and all(lines.get(arg) is not None for arg in node.args):
            around = _crossings(node.op, _compared(node, lines), Fraction(-1), horizon + 1)
            if any(abs(time - end) <= _NEAR * horizon for time in around for end in (0, horizon)):
                return True
        lines[index] = _line(node, lines, horizon / 2)
    return False


def _compared(node: Node, lines: Mapping[int, Line | None]) -> Line:
    """What a jump or a bend compares with 0 (``floor``: with whole numbers)."""
    given = [line for line in (lines.get(arg) for arg in node.args) if line is not None]
    if len(given) == 1 or node.op in ("and", "or", _CHOICE):
        return given[0]
    return given[0][0] - given[1][0], given[0][1] - given[1][1]


def _crossings(op: str, line: Line, first: Fraction, last: Fraction) -> Iterator[Fraction]:
    slope, offset = line
    if slope == 0:
        return
    levels = [Fraction(0)]
    if op == "floor":
        ends = sorted((slope * first + offset, slope * last + offset))
        low, high = math.floor(ends[0]), math.ceil(ends[1])
        levels = [Fraction(low + k) for k in range(min(high - low + 1, _MOST_JUMPS))]
    yield from (time for time in ((level - offset) / slope for level in levels) if first < time < last)


def _line(node: Node, lines: Mapping[int, Line | None], middle: Fraction) -> Line | None:
    """A node as a straight line on a piece with this middle, on which no node before it jumps; None where it is none.

    A jump has its value at the middle, a bend the argument that it has there.
    """
    if node.op == "const":
        return Fraction(0), Fraction(node.value)
    if node.op == "input":
        return Fraction(1), Fraction(0)
    given = [line for line in (lines.get(arg) for arg in node.args) if line is not None]
    if len(given) != len(node.args) or node.part is not None:
        return None
    if node.op in ("and", "or", "not"):
        holds = [line != _NOTHING for line in given]
        return Fraction(0), Fraction({"and": all(holds), "or": any(holds), "not": not holds[0]}[node.op])
    if node.op == _CHOICE:
        return given[1] if given[0] != _NOTHING else _NOTHING
    if node.op in _BENDS:
        other = given[1] if len(given) == 2 else (-given[0][0], -given[0][1])
        return given[0] if _first(node, lines, middle) else other
    if node.op in JUMPS:
        slope, offset = _compared(node, lines)
        return Fraction(0), _jumped(node.op, slope * middle + offset)
    return _sum(node.op, given)


def _first(node: Node, lines: Mapping[int, Line | None], middle: Fraction) -> bool:
    """Whether a bend is its first argument at a time; of ``abs``: its argument, and not the negative of that."""
    slope, offset = _compared(node, lines)
    value = slope * middle + offset
    return value <= 0 if node.op == "min" else value >= 0


def _jumped(op: str, value: Fraction) -> Fraction:
    if op == "floor":
        return Fraction(math.floor(value))
    if op == "sign":
        return Fraction((value > 0) - (value < 0))
    return Fraction({"lt": value < 0, "le": value <= 0, "eq": value == 0, "ne": value != 0}[op])


def _sum(op: str, given: Sequence[Line]) -> Line | None:
    (a, b), (c, d) = given[0], given[-1]
    match op:
        case "neg":
            return -a, -b
        case "add":
            return a + c, b + d
        case "sub":
            return a - c, b - d
        case "mul" if a == 0 or c == 0:
            return a * d + b * c, b * d
        case "div" if c == 0 and d != 0:
            return a / d, b / d
    return None


def _values(tape: Tape, own: Sequence[int], breaks: Sequence[Fraction]) -> dict[int, list[float]]:
    """The value of every jump of ``own`` on every piece, where it is known on all; of a bend 1 for its first side."""
    pieces: list[dict[int, Line | None]] = []
    sides: dict[int, list[float]] = {index: [] for index in own if tape.nodes[index].op in _BENDS}
    for first, last in itertools.pairwise(breaks):
        lines: dict[int, Line | None] = {}
        for index in own:
            lines[index] = _line(tape.nodes[index], lines, (first + last) / 2)
            if index in sides and lines[index] is not None:
                sides[index].append(float(_first(tape.nodes[index], lines, (first + last) / 2)))
        pieces.append(lines)
    jumps = [index for index in own if tape.nodes[index].op in JUMPS - {_CHOICE}]
    known = [index for index in jumps if all(lines[index] is not None for lines in pieces)]
    bent = {index: row for index, row in sides.items() if len(row) == len(pieces)}
    return {index: [float((lines[index] or _NOTHING)[1]) for lines in pieces] for index in known} | bent


def _frontier(tape: Tape, values: Mapping[int, Sequence[float]]) -> list[int]:
    """The known jumps that something else than a known jump needs."""
    needed = set(tape.outputs)
    for index, node in enumerate(tape.nodes):
        if (index not in values or node.op in _BENDS) and node.op != "input":
            needed |= set(node.args)
    return [index for index in values if index in needed]


def _with_inputs(
    tape: Tape, states: int, values: Mapping[int, Sequence[float]], *, every: bool
) -> TimeJumps | None:
    """The tape with inputs for those of the values that change (or ``every`` one), and constants for the others.

    What is chosen by 0 or 1 is a product from then on: nothing is left that jumps.
    """
    changing = {index: tuple(row) for index, row in values.items() if every or len(set(row)) > 1}
    columns = list(dict.fromkeys(changing.values()))
    if not columns:
        return None
    names = tuple(_fresh(tape.inputs, len(columns)))
    first = 1 + states
    graph = Graph((*tape.inputs[:first], *names, *tape.inputs[first:]))
    copy = graph.arithmetic()
    made: list[int] = []
    for index, node in enumerate(tape.nodes):
        if index in values and node.op in _BENDS:
            one = made[node.args[0]]
            other = made[node.args[1]] if len(node.args) == 2 else graph.apply("neg", one)
            if index in changing:
                side = graph.input(first + columns.index(changing[index]))
                rest = graph.apply("mul", graph.apply("sub", graph.const(1.0), side), other)
                made.append(graph.apply("add", graph.apply("mul", side, one), rest))
            else:
                made.append(one if values[index][0] else other)
        elif index in changing:
            made.append(graph.input(first + columns.index(changing[index])))
        elif index in values:
            made.append(graph.const(values[index][0]))
        elif node.op == "input":
            slot = node.args[0]
            made.append(graph.input(slot if slot < first else slot + len(names)))
        elif node.op == "const":
            made.append(graph.const(node.value))
        elif node.op == _CHOICE and node.args[0] in values and tape.nodes[node.args[0]].op in _TRUTHS:
            made.append(graph.apply("mul", made[node.args[0]], made[node.args[1]]))
        else:
            args = [made[arg] for arg in node.args]
            more = [node.part] if node.part is not None else [node.value] if node.op == "pow" else []
            made.append(copy[node.op](*args, *more))
    new = graph.tape([made[output] for output in tape.outputs], tape.shape)
    return TimeJumps(tape=new, names=names, rows=tuple(zip(*columns)))


def _fresh(taken: Sequence[str], count: int) -> list[str]:
    return [name for k in range(count + len(taken)) if (name := f"jump_{k + 1}") not in taken][:count]
