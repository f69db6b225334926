"""Comparisons that rounding decides: exact arithmetic and a program that rounds would take different sides.

A tape means what it says in exact arithmetic, every constant being its float. A program rounds every operation. Where
the sides of a comparison differ by a function of time that crosses 0 steeply, both jump at nearly the same time. Where
they differ by no more than what rounding adds, at all times or at a time that is a whole step, they take different
sides there: ``(t - 0.1) < 0.2 + (t - 0.3)`` is true at all times, and a program says so at some of them.

Every node is an affine form in the inputs and in whatever is not affine, in fractions, with a bound of its rounding.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property, lru_cache, partial
from typing import Any, Protocol

from certbound.problem.model.tape import Node, Tape, needed

_UNIT = Fraction(1, 2**53)
_LOOSE = Fraction(1, 2**40)  # relative error of constants that are no sums, products or quotients
_STEEP = 2**30  # a difference that changes by more than so many rounding errors crosses 0 where it should
_STEEP_IN_STATES = 2**10  # the same in what else it depends on, whose size is taken for 1
_LONGEST = 2**20  # seconds, or steps, after which nothing is looked at
_MOST_BITS, _MOST_ATOMS = 4096, 16
_MOST_BREAKS = 200  # pieces of time
_INSTANT = Fraction(1, _STEEP)  # share of the horizon in which two sides may differ
_POINTS, _MOST_NODES = 16, 2000  # at which, and of tapes of how many nodes, sides are computed
_MOST_WORK = 4_000_000  # numbers that are computed for the times of one tape
_PER_PLACE, _PER_NUMBER, _PER_BIT = 200, 8_000, 80
"""Nanoseconds or more of a look at a node; of a fraction of a form, and of each of its bits (up to 4 operations)."""
_MOST_LINE = 4_000  # bytes of a function of time in fractions of so many bits
_TIME, _ONLY_TIME = ("input", 0), 1  # the atom, and what `_reads` says of its functions
_TRUTHS = ("lt", "le", "eq", "ne")
_DECIDING = (*_TRUTHS, "sign", "floor")

Atom = tuple[object, ...]


class Counter(Protocol):
    """What counts nanoseconds of work and bytes of memory: the budget of a check."""

    def spend(self, units: int) -> None: ...
    def take(self, size: int) -> None: ...
    def give(self, size: int) -> None: ...


@dataclass(frozen=True, eq=False)
class _Form:
    """slopes . atoms + offset, computed with an error of at most ``error``.

    Of a constant ``value`` is what a program computes; ``loose``: the offset is that too, and no exact value.
    """

    slopes: dict[Atom, Fraction]
    offset: Fraction
    error: Fraction
    value: float | None = None
    loose: bool = False

    @cached_property
    def bits(self) -> list[int]:
        """The lengths of all numerators and denominators."""
        numbers = (self.offset, self.error, *self.slopes.values())
        return [part.bit_length() for number in numbers for part in (number.numerator, number.denominator)]

    @property
    def small(self) -> bool:
        """Whether it may be used further: what has no end of digits or parts is no line."""
        return len(self.slopes) <= _MOST_ATOMS and max(self.bits) < _MOST_BITS

    @property
    def work(self) -> int:
        """Nanoseconds of an operation that takes it."""
        return len(self.bits) // 2 * _PER_NUMBER + sum(self.bits) * _PER_BIT

    @property
    def memory(self) -> int:
        """Bytes of it, and of its part in a key."""
        return 300 * len(self.bits) + sum(self.bits) // 4

    def size(self, horizon: Fraction) -> Fraction:
        """Bound of the absolute value; atoms beside time are taken for at most 1."""
        return abs(self.offset) + self.change(horizon)

    def change(self, horizon: Fraction) -> Fraction:
        """By how much it may change."""
        return sum((abs(a) * (horizon if atom == _TIME else 1) for atom, a in self.slopes.items()), Fraction(0))


_NOTHING = _Form({}, Fraction(0), Fraction(0))


def rounded_comparison(
    tape: Tape, horizon: float, samples: int = 0, counter: Counter | None = None
) -> str | None:
    """The first comparison of the tape that rounding decides, in words; None where there is none.

    Parameters
    ----------
    tape : Tape
        Its first input is t.
    horizon : float
        The length of time.
    samples : int
        Where t is one of the ends of so many equal parts of the horizon only: the number of steps, or of holds.
    counter : Counter, optional
        Counts work and memory before they are done and taken, and raises where they are too much.
    """
    return _known(tape, horizon, samples) if counter is None else _found(tape, horizon, samples, counter)


@lru_cache(maxsize=128)
def _known(tape: Tape, horizon: float, samples: int) -> str | None:
    return _found(tape, horizon, samples, None)


def _found(tape: Tape, horizon: float, samples: int, counter: Counter | None) -> str | None:
    if not any(node.op in _DECIDING for node in tape.nodes):
        return None
    discrete = samples == horizon
    whole = min(Fraction(horizon), Fraction(_LONGEST)) if math.isfinite(horizon) else Fraction(_LONGEST)
    clock = _Clock(whole, min(samples, _LONGEST) if discrete else samples, counter)
    clock.count(len(tape.nodes) * _PER_PLACE, len(tape.nodes) * (len(tape.inputs) // 8 + 100))
    seen = _reads(tape)
    forms: list[_Form] = []
    names: dict[Atom, Atom] = {}
    deciding = [index for index, node in enumerate(tape.nodes) if node.op in _DECIDING]
    for index, (node, used) in enumerate(zip(tape.nodes, needed(tape.nodes, deciding))):
        if not used:
            forms.append(_NOTHING)
            continue
        clock.count(sum((forms[arg].work for arg in node.args), _PER_NUMBER) if node.op != "input" else _PER_NUMBER)
        if node.op in _DECIDING:
            given = [forms[arg] for arg in node.args]
            over = given[0] if len(given) == 1 else _sum(given[0], given[1], -1, clock.whole, rounds=False)
            if _unclear(tape, index, over, seen, clock):
                return tape.describe(index)
        forms.append(_form(node, index, forms, names, clock.whole, constant=not seen[index]))
        clock.count(0, forms[-1].memory)
    found = None if samples else _unclear_on_pieces(tape, seen, clock)
    found = _unclear_at_points(tape, deciding, clock) if found is None else found
    return None if found is None else tape.describe(found)


@dataclass(eq=False)
class _Clock:
    """Times that are looked at: all up to ``whole``, or the ends of ``samples`` equal parts; and the work left."""

    whole: Fraction
    samples: int
    counter: Counter | None
    work: int = _MOST_WORK

    def count(self, work: int, memory: int = 0) -> None:
        """Count work and memory, or give memory back, where anything counts."""
        if self.counter is not None:
            self.counter.spend(work)
            self.counter.take(max(memory, 0))
            self.counter.give(max(-memory, 0))

    def spend(self, work: int) -> bool:
        """Whether there is so much work left."""
        self.work -= work
        return self.work >= 0

    def exact(self, k: int) -> Fraction:
        """The end of part k."""
        return self.whole * k / self.samples

    def rounded(self, k: int) -> set[float]:
        """What programs take for it."""
        whole = float(self.whole)
        written = float(f"{whole / self.samples:.12g}")  # a hold that was rounded to its part of the horizon
        return {k * (whole / self.samples), k * whole / self.samples, float(self.exact(k)), k * written}


def _reads(tape: Tape) -> list[int]:
    """Input slots that each node depends on, as the bits of a number."""
    found: list[int] = []
    for node in tape.nodes:
        own = 1 << node.args[0] if node.op == "input" else 0
        for arg in node.args if node.op != "input" else ():
            own |= found[arg]
        found.append(own)
    return found


def _form(
    node: Node, index: int, forms: Sequence[_Form], names: dict[Atom, Atom], whole: Fraction, *, constant: bool
) -> _Form:
    if node.op == "const":
        return _Form({}, Fraction(node.value), Fraction(0), node.value)
    if node.op == "input":
        return _Form({("input", node.args[0]): Fraction(1)}, Fraction(0), Fraction(0))
    given = [forms[arg] for arg in node.args]
    made = _affine(node.op, given, whole)
    if made is not None and made.small:
        return made
    error = max((form.error for form in given), default=Fraction(0))
    if constant and (known := _constant(node, given)) is not None:
        return known
    key = (node.op, node.value, node.part, *((*form.slopes.items(), form.offset) for form in given))
    return _Form({names.setdefault(key, ("node", index)): Fraction(1)}, Fraction(0), error)


def _affine(op: str, given: Sequence[_Form], whole: Fraction) -> _Form | None:
    """Sums, and products and quotients by constants."""
    a, b = given[0], given[-1]
    if op == "neg":
        return _scaled(a, Fraction(-1), Fraction(0), None if a.value is None else -a.value, whole, loose=a.loose)
    if op in ("add", "sub"):
        return _sum(a, b, 1 if op == "add" else -1, whole)
    if op == "mul" and a.slopes and not b.slopes:
        a, b = b, a
    if op in ("mul", "sq") and not a.slopes:
        value = None if a.value is None or b.value is None else a.value * b.value
        return _scaled(b, a.offset, a.error, value, whole, loose=a.loose or b.loose)
    if op == "div" and not b.slopes and b.offset:
        factor, error = 1 / b.offset, b.error / b.offset**2 * 2
        value = None if a.value is None or not b.value else a.value / b.value
        return _scaled(a, factor, error, value, whole, loose=a.loose or b.loose)
    return None


def _sum(a: _Form, b: _Form, sign: int, whole: Fraction, *, rounds: bool = True) -> _Form:
    slopes = dict(a.slopes)
    for atom, x in b.slopes.items():
        slopes[atom] = slopes.get(atom, Fraction(0)) + sign * x
    slopes = {atom: x for atom, x in slopes.items() if x}
    value = None if a.value is None or b.value is None else a.value + sign * b.value
    found = _Form(slopes, a.offset + sign * b.offset, a.error + b.error, value, a.loose or b.loose)
    return _rounded(found, found.size(whole)) if rounds else found


def _scaled(
    a: _Form, factor: Fraction, error: Fraction, value: float | None, whole: Fraction, *, loose: bool
) -> _Form:
    own = abs(factor) * a.error + error * a.size(whole)
    found = _Form({atom: factor * x for atom, x in a.slopes.items() if factor}, factor * a.offset, own, value, loose)
    parts = (abs(factor.numerator), factor.denominator)
    power = all(part & (part - 1) == 0 for part in parts)  # of two: nothing is rounded
    return found if power else _rounded(found, found.size(whole))


def _rounded(found: _Form, size: Fraction) -> _Form:
    """With the error of one rounding more; a constant that is a float has none."""
    exact = not found.slopes and not found.error and _is_float(found.offset)
    return found if exact else replace(found, error=found.error + _UNIT * size)


def _is_float(value: Fraction) -> bool:
    try:
        return Fraction(float(value)) == value
    except OverflowError:
        return False


def _constant(node: Node, given: Sequence[_Form]) -> _Form | None:
    """A constant that is no sum, product or quotient, about what a program computes; None where it computes none."""
    values = [form.value for form in given if form.value is not None]
    if len(values) < len(given):
        return None
    value = _computed(node, values)
    if value is None or not math.isfinite(value):
        return None
    plain = node.op in (*_DECIDING, "and", "or", "not", "min", "max", "abs", "if_else_zero")
    error = max((form.error for form in given), default=Fraction(0))
    loose = not plain or error > 0
    return _Form({}, Fraction(value), error if plain else error + _LOOSE * abs(Fraction(value)), value, loose)


def _computed(node: Node, values: Sequence[float]) -> float | None:
    """What a program computes; None where it fails, or nothing is known of the operation."""
    rule = _RULES.get(node.op) or getattr(math, node.op, None)
    if node.part is not None or (rule is None and node.op != "pow"):
        return None
    try:
        if node.op == "pow":
            return float(values[0] ** node.value)
        assert rule is not None
        return float(rule(values[0], values[-1]) if node.op in _RULES else rule(*values))
    except (ArithmeticError, TypeError, ValueError):
        return None


def _unclear(tape: Tape, index: int, over: _Form, seen: Sequence[int], clock: _Clock) -> bool:
    """Whether rounding may decide what is compared with 0 (``floor``: with whole numbers)."""
    op, own = tape.nodes[index].op, seen[index]
    if not own and not over.slopes and over.value is not None:
        near = over.loose and _decides(op, over, Fraction(0))
        return near or _side(op, over.offset) != _side(op, Fraction(over.value))
    if clock.samples and own == _ONLY_TIME:
        return _unclear_at_samples(tape, index, over, clock)
    change = over.change(clock.whole)
    other = any(atom != _TIME for atom in over.slopes)
    steep = change > over.error * (_STEEP_IN_STATES if other else _STEEP)
    return bool(over.error) and not steep and _decides(op, over, change)


def _unclear_at_samples(tape: Tape, index: int, over: _Form, clock: _Clock) -> bool:
    """Whether a program takes another side at one of the times that there are."""
    op, line = tape.nodes[index].op, {*over.slopes} <= {_TIME} and tape.nodes[index].op != "floor"
    if line and not over.error and clock.whole == clock.samples:
        return False
    if line and _TIME in over.slopes:
        root = math.floor(-over.offset * clock.samples / (over.slopes[_TIME] * clock.whole))
        times = [k for k in (root, root + 1) if 0 <= k <= clock.samples]
    elif line:
        return bool(over.error) and _decides(op, over, Fraction(0))
    else:
        times = list(range(clock.samples + 1))
    clock.count(index * _PER_PLACE)
    part = _part(tape, index)
    if not clock.spend(len(times) * len(part)):
        return True
    return any(_differs(tape, part, k, clock) for k in times)


def _decides(op: str, over: _Form, change: Fraction) -> bool:
    """Whether the error meets what is compared with, somewhere."""
    low, high = over.offset - change - over.error, over.offset + change + over.error
    return math.floor(high) >= math.ceil(low) if op == "floor" else low <= 0 <= high


def _side(op: str, value: Fraction) -> int:
    """What the operation says of a difference."""
    if op in _TRUTHS:
        return {"lt": value < 0, "le": value <= 0, "eq": value == 0, "ne": value != 0}[op]
    return math.floor(value) if op == "floor" else (value > 0) - (value < 0)


def _part(tape: Tape, index: int) -> list[int]:
    """The nodes that a node needs, and itself."""
    return [place for place, used in enumerate(needed(tape.nodes[: index + 1], [index])) if used]


def _differs(tape: Tape, part: Sequence[int], k: int, clock: _Clock) -> bool:
    """Whether a program takes another side at a time than exact arithmetic does, for the last node of a part."""
    clock.count(len(part) * _PER_NUMBER)
    side = _side_at(tape, part, clock.exact(k), partial(_exact, clock))
    return side is not None and any(_side_at(tape, part, time, _computed) != side for time in clock.rounded(k))


def _side_at(tape: Tape, part: Sequence[int], time: Any, compute: Callable[[Node, Sequence[Any]], Any]) -> int | None:
    """The side that is taken at a time in some arithmetic; None where nothing is known."""
    values: dict[int, Any] = {}
    for place in part[:-1]:
        node = tape.nodes[place]
        given = [values[arg] for arg in node.args] if node.op != "input" else []
        if node.op in ("const", "input"):
            values[place] = type(time)(node.value) if node.op == "const" else time
        else:
            values[place] = None if None in given else compute(node, given)
    last = tape.nodes[part[-1]]
    found = [values[arg] for arg in last.args]
    if None in found or not all(map(math.isfinite, found)):
        return None
    return _side(last.op, Fraction(found[0]) - (Fraction(found[1]) if len(found) == 2 else 0))


def _exact(clock: _Clock, node: Node, values: Sequence[Fraction]) -> Fraction | None:
    """The same as `_computed` in fractions; None of what is no fraction, or has no end of digits."""
    a, b = values[0], values[-1]
    if node.part is not None or node.op not in _RULES or (node.op == "div" and not b):
        return None
    value = Fraction(_RULES[node.op](a, b))
    bits = max(value.numerator.bit_length(), value.denominator.bit_length())
    clock.count(bits * _PER_BIT)
    return value if bits < _MOST_BITS else None


def _unclear_at_points(tape: Tape, deciding: Sequence[int], clock: _Clock) -> int | None:
    """A comparison of which a program takes another side at one of a few points, as it does of none by chance."""
    part = [index for index, used in enumerate(needed(tape.nodes, deciding)) if used]
    if len(part) > _MOST_NODES:
        return None
    drawn = random.Random(0)
    for _ in range(_POINTS):
        clock.count(len(part) * _PER_NUMBER)
        point = [drawn.uniform(-1, 1) for _ in tape.inputs]
        point[0] = float(clock.whole) * drawn.random() if not clock.samples else min(
            clock.rounded(drawn.randrange(clock.samples + 1)))
        exact: dict[int, Any] = {}
        program: dict[int, Any] = {}
        for index in part:
            node = tape.nodes[index]
            for values, number, compute in ((exact, Fraction, partial(_exact, clock)), (program, float, _computed)):
                if node.op in ("const", "input"):
                    values[index] = number(node.value if node.op == "const" else point[node.args[0]])
                else:
                    given = [values[arg] for arg in node.args]
                    values[index] = None if None in given else compute(node, given)
            both = exact[index], program[index]
            if node.op in _DECIDING and None not in both and both[0] != both[1]:
                return index
    return None


def _unclear_on_pieces(tape: Tape, seen: Sequence[int], clock: _Clock) -> int | None:
    """A comparison of functions of time that rounding decides for a while, where all are straight lines there.

    Between two times at which something jumps or bends: ``min(t, 0.1) < 0.1 + 0.3 - 0.3`` is one after 0.1.
    """
    deciding = [index for index, node in enumerate(tape.nodes) if node.op in _DECIDING and seen[index] == _ONLY_TIME]
    part = [index for index, used in enumerate(needed(tape.nodes, deciding)) if used and seen[index] <= _ONLY_TIME]
    whole, held = clock.whole, len(part) * _MOST_LINE
    clock.count(0, held)
    breaks, place = [Fraction(0), whole], 0
    while deciding and place + 1 < len(breaks) and len(breaks) < _MOST_BREAKS:
        first, last = breaks[place : place + 2]
        clock.count(len(deciding) * _PER_PLACE)
        found, jump = _pieces(tape, part, first, last, clock)
        if jump is not None:
            breaks.insert(place + 1, jump)
            continue
        for index in deciding:
            over = found.get(index)
            if over is None or not over.error or last - first <= _INSTANT * whole:
                continue
            clock.count(over.work)
            slope = abs(over.slopes.get(_TIME, Fraction(0)))
            nearest = min(_from_level(tape.nodes[index].op, over, time) for time in (first, last))
            if nearest <= over.error and (not slope or 2 * over.error > _INSTANT * whole * slope):
                return index
        place += 1
    clock.count(0, -held)
    return None


def _from_level(op: str, over: _Form, time: Fraction) -> Fraction:
    """How far a difference is from 0 at a time (``floor``: from a whole number)."""
    value = over.offset + over.slopes.get(_TIME, Fraction(0)) * time
    return abs(value - (round(value) if op == "floor" else 0))


def _pieces(
    tape: Tape, part: Sequence[int], first: Fraction, last: Fraction, clock: _Clock
) -> tuple[dict[int, _Form], Fraction | None]:
    """What is compared on a piece of time, as lines; and a time inside at which something jumps or bends."""
    lines: dict[int, _Form | None] = {}
    compared: dict[int, _Form] = {}
    middle = (first + last) / 2
    for index in part:
        node = tape.nodes[index]
        given = [line for line in (lines.get(arg) for arg in node.args) if line is not None]
        clock.count(sum((line.work for line in given), _PER_NUMBER))
        lines[index] = None
        if node.op in ("const", "input"):
            lines[index] = _form(node, index, [], {}, last, constant=False)
        elif len(given) == len(node.args) and node.part is None:
            if node.op in (*_DECIDING, "min", "max", "abs"):
                over = given[0] if len(given) == 1 else _sum(given[0], given[1], -1, last, rounds=False)
                compared[index] = over
                if (jump := _crossing(node.op, over, first, last)) is not None:
                    return compared, jump
            made = _affine(node.op, given, last) or _chosen(node, given, middle)
            lines[index] = made if made is not None and made.small else None
    return compared, None


def _crossing(op: str, over: _Form, first: Fraction, last: Fraction) -> Fraction | None:
    slope = over.slopes.get(_TIME, Fraction(0))
    low, high = sorted((over.offset + slope * first, over.offset + slope * last))
    level = Fraction(math.floor(low) + 1) if op == "floor" else Fraction(0)
    return (level - over.offset) / slope if low < level < high else None


def _chosen(node: Node, given: Sequence[_Form], time: Fraction) -> _Form | None:
    """What a jump or a bend is on a piece, by its value at a time inside."""
    values = [form.offset + form.slopes.get(_TIME, Fraction(0)) * time for form in given]
    if node.op in ("min", "max"):
        first = (values[0] <= values[1]) == (node.op == "min")
        return replace(given[0 if first else 1], error=max(form.error for form in given))
    if node.op == "abs":
        sign = 1 if values[0] >= 0 else -1
        slopes = {atom: sign * x for atom, x in given[0].slopes.items()}
        return replace(given[0], slopes=slopes, offset=sign * given[0].offset)
    if node.op == "if_else_zero":
        return given[1] if values[0] else _NOTHING
    if node.op in (*_DECIDING, "and", "or", "not"):
        return _Form({}, Fraction(_RULES[node.op](values[0], values[-1])), Fraction(0))
    return _constant(node, given) if not any(form.slopes for form in given) else None


_RULES: dict[str, Callable[[Any, Any], Any]] = {
    "neg": lambda a, b: -a, "add": lambda a, b: a + b, "sub": lambda a, b: a - b, "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b, "sq": lambda a, b: a * a, "abs": lambda a, b: abs(a),
    "floor": lambda a, b: math.floor(a),
    "sign": lambda a, b: (a > 0) - (a < 0), "min": min, "max": max, "lt": lambda a, b: a < b, "le": lambda a, b: a <= b,
    "eq": lambda a, b: a == b, "ne": lambda a, b: a != b, "and": lambda a, b: bool(a) and bool(b),
    "or": lambda a, b: bool(a) or bool(b), "not": lambda a, b: not a, "if_else_zero": lambda a, b: b if a else 0,
}  # fmt: skip
