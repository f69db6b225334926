"""The structure of a Jacobian, found on its tape: which numbers vary, how they enter, and how far they range.

Every entry of the Jacobian is expanded, in exact rational arithmetic, as an affine function of *parameters*:
nodes of the tape that are no affine function of anything else (tanh(v)^2, a product of states). Entries that
share a parameter stay correlated. The ranges are interval enclosures refined by bisection. What rounding
remains (a rational coefficient that is no float, a constant such as sin(0.3)) goes into the set's ``slack``.
Result: an ``AffineSet`` that contains D_x f on the domain (docs/theory.md, Sec. 6).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import lru_cache

import numpy as np

from certbound.constants.enclosures import bound_ranges, enclose
from certbound.constants.jacobians.affine import AffineSet
from certbound.errors import EnclosureError
from certbound.problem.model import Node, Tape
from certbound.rigor.intervals import Interval

_NARROW = 1e-13
"""A parameter narrower than this share of its size is a constant with slack."""


@dataclass(frozen=True, eq=False)
class _Form:
    """constant + sum of coefficient times node."""

    constant: Fraction = Fraction(0)
    terms: dict[int, Fraction] = field(default_factory=dict)

    def plus(self, other: _Form, factor: Fraction) -> _Form:
        terms = dict(self.terms)
        for node, value in other.terms.items():
            total = terms.get(node, Fraction(0)) + factor * value
            if total:
                terms[node] = total
            else:
                terms.pop(node, None)
        return _Form(self.constant + factor * other.constant, terms)

    def times(self, factor: Fraction) -> _Form:
        return _Form().plus(self, factor) if factor else _Form()


def affine_set(tape: Tape, inputs: Sequence[Interval], *, tolerance: float = 1e-3) -> AffineSet:
    """The values of a square matrix-valued tape over a box, as J0 + sum theta_k M_k with theta in a box.

    Proves: the set contains the matrix at every point of the box, of one scalar interval per slot (infinite ends are
    allowed). ``tolerance`` is the wanted distance between a range and its sampled part, relative to the range's size. A
    parameter without a finite range is an EnclosureError.
    """
    if len(tape.shape) != 2 or tape.shape[0] != tape.shape[1]:
        raise ValueError(f"`tape` must be square, got shape {tape.shape}.")
    return _affine_set(tape, tuple((float(x.lo), float(x.hi)) for x in inputs), float(tolerance))


@lru_cache(maxsize=32)
def _affine_set(tape: Tape, box: tuple[tuple[float, float], ...], tolerance: float) -> AffineSet:
    inputs = [Interval(np.array(low), np.array(high)) for low, high in box]
    enclose(tape, inputs)  # refuses undecided jumps and undefined operations, with the box
    forms = _expand(tape, inputs)
    entries = [forms[output] for output in tape.outputs]
    entries, parameters = _parametrise(entries, tape.outputs)
    ranges = bound_ranges(tape, parameters, inputs, tolerance=tolerance)
    for node, (low, high) in zip(parameters, ranges):
        if not (math.isfinite(low) and math.isfinite(high)):
            raise EnclosureError(
                f"`{tape.describe(node)}` in the Jacobian is unbounded on the domain: it ranges over "
                f"[{low:.6g}, {high:.6g}]; give a smaller `domain`, or use constants along the reach tube."
            )
    return _assembled(entries, parameters, ranges, tape.shape[0])


def _expand(tape: Tape, inputs: Sequence[Interval]) -> list[_Form]:
    """Every node as an exact affine function of nodes that are none."""
    forms: list[_Form] = []
    for index, node in enumerate(tape.nodes):
        args = [] if node.op == "input" else [forms[arg] for arg in node.args]
        forms.append(_affine(node, args, inputs) or _Form(terms={index: Fraction(1)}))
    return forms


def _affine(node: Node, args: list[_Form], inputs: Sequence[Interval]) -> _Form | None:
    match node.op:
        case "input":
            low, high = float(inputs[node.args[0]].lo), float(inputs[node.args[0]].hi)
            return _Form(Fraction(low)) if low == high else None
        case "const":
            return _Form(Fraction(node.value)) if math.isfinite(node.value) else None
        case "add":
            return args[0].plus(args[1], Fraction(1))
        case "sub":
            return args[0].plus(args[1], Fraction(-1))
        case "neg":
            return args[0].times(Fraction(-1))
        case "mul" if not args[0].terms:
            return args[1].times(args[0].constant)
        case "mul" if not args[1].terms:
            return args[0].times(args[1].constant)
        case "div" if not args[1].terms and args[1].constant:
            return args[0].times(1 / args[1].constant)
        case "sq" if not args[0].terms:
            return _Form(args[0].constant ** 2)
    return None


def _parametrise(entries: list[_Form], outputs: Sequence[int]) -> tuple[list[_Form], list[int]]:
    """Entries over as few parameters as possible: an entry itself serves where it replaces several nodes."""
    nodes = sorted({node for entry in entries for node in entry.terms})
    group = {node: {node} for node in nodes}
    for entry in entries:
        joined = set().union(*(group[node] for node in entry.terms)) if entry.terms else set()
        for node in joined:
            group[node] = joined
    result = list(entries)
    for component in {id(g): g for g in group.values()}.values():
        members = [i for i, entry in enumerate(entries) if component & entry.terms.keys()]
        shapes: dict[tuple[tuple[int, Fraction], ...], int] = {}
        for i in members:
            shapes.setdefault(_direction(entries[i]), i)
        if len(shapes) < len(component):
            for i in members:
                chosen = shapes[_direction(entries[i])]
                base = entries[chosen]
                node = next(iter(base.terms))
                factor = entries[i].terms[node] / base.terms[node]
                constant = entries[i].constant - factor * base.constant
                result[i] = _Form(constant, {outputs[chosen]: factor})
    return result, sorted({node for entry in result for node in entry.terms})


def _direction(form: _Form) -> tuple[tuple[int, Fraction], ...]:
    """The linear part up to a factor."""
    terms = sorted(form.terms.items())
    return tuple((node, value / terms[0][1]) for node, value in terms)


def _assembled(entries: list[_Form], parameters: list[int], ranges: list[tuple[float, float]], n: int) -> AffineSet:
    """Floats for the rationals, their rounding in the slack; parameters that hardly vary become constants."""
    size = {node: max(abs(low), abs(high)) for node, (low, high) in zip(parameters, ranges)}
    wide = [k for k, (low, high) in enumerate(ranges) if high - low > _NARROW * max(size[parameters[k]], 1e-300)]
    place = {parameters[k]: position for position, k in enumerate(wide)}
    narrow = {
        parameters[k]: ((Fraction(low) + Fraction(high)) / 2, (Fraction(high) - Fraction(low)) / 2)
        for k, (low, high) in enumerate(ranges)
        if k not in wide
    }
    center, slack = np.zeros(n * n), np.zeros(n * n)
    terms = np.zeros((len(wide), n * n))
    for i, entry in enumerate(entries):
        constant, error = entry.constant, Fraction(0)
        for node, value in entry.terms.items():
            if node in narrow:
                constant += value * narrow[node][0]
                error += abs(value) * narrow[node][1]
            else:
                terms[place[node], i] = float(value)
                error += abs(value - Fraction(float(value))) * Fraction(size[node])
        center[i] = float(constant)
        error += abs(constant - Fraction(center[i]))
        slack[i] = math.nextafter(float(error), math.inf) if error else 0.0
    return AffineSet(
        center=center.reshape(n, n),
        terms=terms.reshape(-1, n, n),
        low=[ranges[k][0] for k in wide],
        high=[ranges[k][1] for k in wide],
        slack=slack.reshape(n, n),
    )
