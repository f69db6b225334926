"""The proof for horizons without an end, one state in continuous time: a function of the state alone.

A path fails by the end a of an interval [a, b] and not by b, in y = x (or y = -x, ``mirrored``). With psi the step
function of the file, Psi its integral from a on,

    w(x) = int_x^b exp(-Psi) / int_a^b exp(-Psi)

is 1 at a and 0 at b, and L w = w' (f - psi g^2/2) with w' < 0 continuous.

- From above: psi g^2 <= 2 f on every cell for every disturbance; no constraint is broken on [a, b]; b is in the target,
  and g^2 > 0 on [a, b], so that every path leaves it; or b is infinite, psi = k or psi = k/y on the last piece, and all
  coefficients of 2 f - psi g^2 (times y) as a polynomial of y - M are not negative. Then P(failing) <= w.
- From below: psi g^2 >= 2 f, g^2 > 0, beyond a some constraint is broken, and [a, b) does not meet the target. Then
  P(failing) >= w(x): w is at most 1 on paths that are at a, at most 0 on those at b, and paths that stay for ever fail
  where there is a target, and have no part in an integral that falls where there is none (they leave with probability
  1).

Both hold for a finite horizon without a target from above too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from flint import arb, fmpq, fmpq_poly

from certbound.checker.expressions import Ceiling, Graph, Side
from certbound.checker.reading import Record
from certbound.checker.report import FUNCTION, Budget, Unproved
from certbound.checker.statement import Constraint, Model
from certbound.errors import CertificateError
from certbound.problem.model import Node, Tape

MOST_CELLS = 20_000
_MOST_DEGREE, _MOST_BITS = 100, 20_000
_TOO_LONG = "the model is a polynomial of too high a degree, or with too long coefficients"
_RATIONAL, _PER_BYTE = 40_000, 80
"""Units of work of an operation of rational polynomials, and of a byte of its result: up to 20 us, 3 to 80 ns."""
_PROOF = ("engine", "mirrored", "edges", "slopes", "tail")


def check_lasting(model: Model, value: object, budget: Budget) -> arb:
    """Upper bound of the probability of ever failing."""
    proof = _Proof(model, value, budget, above=True)
    proof.check()
    return arb.min(proof.share(), arb(1)).upper()


def check_lasting_below(model: Model, value: object, budget: Budget) -> arb:
    """Lower bound of the probability of ever failing, from the start that is nearest to the limit."""
    if model.initial.around:
        raise Unproved("the initial set is stated by a box around it, of which lower bounds say nothing")
    if not math.isinf(model.horizon):
        raise Unproved("this lower bound needs an infinite horizon")
    proof = _Proof(model, value, budget, above=False)
    proof.check()
    return arb.max(proof.share(), arb(0)).lower()


@dataclass(frozen=True)
class _Face:
    """One face of a constraint or of the target: y keeps it where slope * y <= bound."""

    slope: arb
    bound: arb

    def excess(self, y: arb) -> arb:
        return self.slope * y - self.bound


def _faces_of(constraint: Constraint, sign: int, horizon: float) -> list[_Face]:
    """Faces of a constraint as functions of y: for an obstacle that is one half-space of the closure of what it leaves.

    Who is on the face has failed then: proofs from above count him, and from below only who is beyond it has to fail.
    """
    region = constraint.region
    whole = constraint.during in (None, (0.0, horizon))
    single = constraint.inside or len(region.bounds) == 1
    if not single or region.round or isinstance(region.center, Tape) or not whole:
        raise Unproved(f"\"{constraint.label}\" is no interval that always holds and stands still")
    found = []
    for number, bound in enumerate(region.bounds):
        (slope,), side = region.face(number), 1 if constraint.inside else -1
        found.append(_Face(side * sign * slope, side * (arb(bound) + slope * arb(region.center[0]))))
    return found


class _Proof:
    """The file's numbers, and what is shown of them."""

    def __init__(self, model: Model, value: object, budget: Budget, *, above: bool) -> None:
        record = Record(value, "proof", _PROOF if above else (*_PROOF, "side"))
        self.model, self.budget, self.above = model, budget, above
        if not model.continuous or model.dimension != 1:
            raise Unproved("this proof serves one state in continuous time")
        if model.plan is not None or model.initial.covariance is not None:
            raise Unproved("this proof needs a feedback law and a set of starts")
        self.sign = -1 if record.flag("mirrored") else 1
        self.edges = record.array("edges", None)
        if not 2 <= len(self.edges) <= MOST_CELLS or not all(a < b for a, b in pairwise(self.edges)):
            raise CertificateError(f"`proof.edges` must be 2 to {MOST_CELLS} numbers that rise.")
        self.slopes = record.array("slopes", len(self.edges) - 1)
        self.tail: tuple[str, float] | None = None
        if record["tail"] is not None:
            last = Record(record["tail"], "proof.tail", ("kind", "rate"))
            if last["kind"] not in ("exponential", "power"):
                raise CertificateError("`proof.tail.kind` must be \"exponential\" or \"power\".")
            self.tail = last.text("kind"), last.number("rate")
        initial = model.initial
        ends = (initial.low[0].lower(), initial.high[0].upper())
        self.start = ends[0] if self.sign > 0 else -ends[1]
        if not above:  # a point that is surely a start
            inner = (initial.low[0].upper(), initial.high[0].lower())
            self.start = inner[0] if self.sign > 0 else -inner[1]
            if not inner[0] <= inner[1]:
                raise Unproved("no start was shown to be one")
        farthest = ends[1] if self.sign > 0 else -ends[0]
        within = farthest <= arb(self.edges[-1]) or self.tail is not None or not above
        if not (arb(self.edges[0]) <= self.start and within):
            raise Unproved("the starts were not shown to lie in the interval")

    def check(self) -> None:
        """All hypotheses but for the number."""
        self._check_clock()
        self._check_sets()
        target = self.model.target is not None
        if self.above and self.tail is None and not target:
            raise Unproved("there is no target, and the interval ends")
        if self.tail is not None and (target or not self.above):
            raise CertificateError("`proof.tail` must be null where there is a target, and in a lower bound.")
        if target and not math.isinf(self.model.horizon):
            raise Unproved("where there is a target this proof needs an infinite horizon")
        self._check_cells()
        if self.tail is not None:
            self._check_tail(*self.tail)

    def _check_clock(self) -> None:
        tapes = [self.model.dynamics, *([g] if isinstance(g := self.model.noise.diffusion, Tape) else [])]
        if any(node.op == "input" and node.args[0] == 0 for tape in tapes for node in tape.nodes):
            raise Unproved("this proof needs a model that does not depend on time")

    # ---- sets --------------------------------------------------------------------------------------------------

    def _check_sets(self) -> None:
        a, b = arb(self.edges[0]), arb(self.edges[-1])
        sign, horizon = self.sign, self.model.horizon
        faces = [face for constraint in self.model.constraints for face in _faces_of(constraint, sign, horizon)]
        target = [] if self.model.target is None else _faces_of(self.model.target, sign, horizon)
        if self.model.target is not None and not all(constraint.inside for constraint in self.model.constraints):
            raise Unproved("an obstacle may begin where the target does")
        if self.above:
            ends = [a] if self.tail is not None else [a, b]
            if not all(face.excess(end) <= 0 for face in faces for end in ends):
                raise Unproved("a constraint was not shown to be kept on the whole interval")
            if self.tail is not None and not all(face.slope <= 0 for face in faces):
                raise Unproved("a constraint ends the line on the side on which nothing is to be broken")
            if self.model.target is not None and not all(face.excess(b) <= 0 for face in target):
                raise Unproved("the end of the interval was not shown to lie in the target")
            return
        if not any(face.slope < 0 and face.excess(a) >= 0 for face in faces):
            raise Unproved("no constraint was shown to be broken beyond the interval")
        if self.model.target is not None and not any(face.excess(a) > 0 and face.excess(b) >= 0 for face in target):
            raise Unproved("the interval was not shown to keep off the target")

    # ---- the generator -----------------------------------------------------------------------------------------

    def _check_cells(self) -> None:
        """2 f - psi g^2 has the right sign on every cell, and g^2 > 0 where paths must leave."""
        graph, model = Graph(self.budget), self.model
        count = len(model.dynamics.inputs)
        slots = [graph.input(slot) for slot in range(count + 1)]  # psi is the last one
        nodes = graph.include(model.dynamics, slots[:count])
        flow = nodes[model.dynamics.outputs[0]]
        square = self._square(graph, slots[:2])
        pushed = graph.mul(graph.const(2.0 * self.sign), flow)
        room = graph.sub(graph.mul(slots[count], square), pushed)
        node = room if self.above else graph.neg(room)
        balance = Ceiling(graph, node, [flow, square], count=count + 1, budget=self.budget)
        noise = Ceiling(graph, graph.neg(square), [square], count=count + 1, budget=self.budget)
        self.budget.expect(len(self.slopes) * balance.work)
        zero = (arb(0), arb(0))
        pushes = [(arb(low), arb(high)) for low, high in model.disturbance]
        tiny = -arb(2) ** -900
        for (a, b), slope in zip(pairwise(self.edges), self.slopes):
            cell: Side = (arb(a), arb(b)) if self.sign > 0 else (arb(-b), arb(-a))
            box = [zero, cell, *pushes, (arb(slope), arb(slope))]
            if not balance.prove(box, arb(0)):
                raise Unproved(f"psi was not shown to be on its side of the drift between {a:g} and {b:g}")
            if self.tail is None and not noise.prove(box, tiny):
                raise Unproved(f"the noise was not shown to be positive between {a:g} and {b:g}")

    def _square(self, graph: Graph, slots: Sequence[int]) -> int:
        given = self.model.noise.diffusion
        if isinstance(given, Tape):
            nodes = graph.include(given, slots)
            entries = [nodes[output] for output in given.outputs]
        else:
            entries = [graph.const(float(x)) for x in given.entries()]
        return graph.sum(graph.apply("sq", entry) for entry in entries)

    def _check_tail(self, kind: str, rate: float) -> None:
        """All coefficients of 2 f - psi g^2, times y for a power, about the last edge."""
        if self.model.disturbance:
            raise Unproved("the last piece serves no disturbances")
        given = self.model.noise.diffusion
        moved = fmpq_poly([0, self.sign])
        drift = self.sign * _polynomial(self.model.dynamics, moved, self.budget)[0]
        if isinstance(given, Tape):
            entries = _polynomial(given, moved, self.budget)
        else:
            entries = [fmpq_poly([_exact(float(x))]) for x in given.entries()]
        sizes = [_size(entry) for entry in (drift, *entries)]
        self.budget.spend(sum(_RATIONAL + 6 * _PER_BYTE * _bytes(2 * degree, 2 * bits) for degree, bits in sizes))
        square = sum((entry * entry for entry in entries), fmpq_poly([0]))
        power = kind == "power"
        if not rate > (1.0 if power else 0.0) or (power and not self.edges[-1] > 0):
            raise Unproved("the last piece has no finite integral")
        left = 2 * drift * (fmpq_poly([0, 1]) if power else fmpq_poly([1])) - _exact(rate) * square
        degree, bits = _size(left)
        self.budget.spend(_RATIONAL + _PER_BYTE * _bytes(degree, bits + 1100 * (degree + 1)))
        about = left(fmpq_poly([_exact(self.edges[-1]), 1]))
        if not all(coefficient >= 0 for coefficient in about.coeffs()):
            raise Unproved("the last piece was not shown to be on its side of the drift")

    # ---- the number --------------------------------------------------------------------------------------------

    def share(self) -> arb:
        """w at the start that is nearest to the failing end."""
        self.budget.balls(len(self.slopes), 12 * FUNCTION)
        psi, whole, rest, start = arb(0), arb(0), arb(0), self.start
        last = arb(self.edges[-1])
        if not start <= last:
            raise Unproved("the starts were not shown to lie in the interval")
        for (a, b), slope in zip(pairwise(map(arb, self.edges)), map(arb, self.slopes)):
            whole += (-psi).exp() * _integral(b - a, slope)
            begin = arb.max(a, arb.min(start, b))
            rest += (-psi - slope * (begin - a)).exp() * _integral(b - begin, slope)
            psi += slope * (b - a)
        if self.tail is not None:
            rate = arb(self.tail[1])
            end = (-psi).exp() * (1 / rate if self.tail[0] == "exponential" else last / (rate - 1))
            whole, rest = whole + end, rest + end
        return rest / whole


def check_drift(model: Model, value: object, budget: Budget) -> arb:
    """Upper bound of the probability of ever leaving by the only limit, in discrete time.

    With y the distance from it and y+ = y + h(y) + w, exp(-rate y) is a supermartingale up to the first step beyond the
    limit where h >= rate S/2 on y >= 0 and E exp(-rate w) <= exp(rate^2 S/2).
    """
    record = Record(value, "proof", ("engine", "mirrored", "limit", "rate"))
    if model.continuous or model.dimension != 1 or model.plan is not None or model.disturbance:
        raise Unproved("this proof serves one state in discrete time, without disturbances and with a feedback law")
    if model.target is not None or model.initial.covariance is not None:
        raise Unproved("this proof needs a set of starts and no target")
    sign = -1 if record.flag("mirrored") else 1
    limit, rate = record.number("limit"), record.number("rate", least=0.0)
    if any(node.op == "input" and node.args[0] == 0 for node in model.dynamics.nodes):
        raise Unproved("this proof needs a model that does not depend on time")
    for constraint in model.constraints:
        for face in _faces_of(constraint, sign, model.horizon):
            if not (face.slope <= 0 and face.excess(arb(sign * limit)) <= 0):
                raise Unproved(f"\"{constraint.label}\" was not shown to be kept on the whole half-line")
    size = model.noise.covariance()[0, 0].upper()
    ahead = sign * _polynomial(model.dynamics, fmpq_poly([0, sign]), budget)[0] - fmpq_poly([0, 1])
    degree, bits = _size(ahead)
    budget.spend(_RATIONAL + _PER_BYTE * _bytes(degree, bits + 1100 * (degree + 1)))
    about = ahead(fmpq_poly([sign * _exact(limit), 1]))
    first = arb(about[0].p) / arb(about[0].q)
    if not (first >= arb(rate) * size / 2 and all(coefficient >= 0 for coefficient in about.coeffs()[1:])):
        raise Unproved("the drift was not shown to outweigh the noise everywhere")
    initial = model.initial
    away = initial.low[0].lower() - arb(limit) if sign > 0 else arb(limit) - initial.high[0].upper()
    if not away >= 0:
        raise Unproved("the starts were not shown to keep the limit")
    return (-arb(rate) * away).exp().upper()


def _integral(length: arb, slope: arb) -> arb:
    """int_0^length exp(-slope y) dy."""
    return length if slope.is_zero() else -(-slope * length).expm1() / slope


def _exact(value: float) -> fmpq:
    return fmpq(*value.as_integer_ratio())


def _polynomial(tape: Tape, state: fmpq_poly, budget: Budget) -> list[fmpq_poly]:
    """A tape's outputs as polynomials, exactly; Unproved where they are none."""
    values: list[Any] = []
    sizes: list[tuple[int, int]] = []
    ended, _ = tape.lives()
    for node, over in zip(tape.nodes, ended):
        args = [] if node.op == "input" else [values[arg] for arg in node.args]
        _count(node, [] if node.op == "input" else [sizes[arg] for arg in node.args], budget)
        if node.op == "input":
            values.append(state)
        elif node.op == "const":
            values.append(fmpq_poly([_exact(node.value)]))
        elif node.op == "pow" and node.value == int(node.value) and 0 <= node.value <= 20:
            values.append(args[0] ** int(node.value))
        elif node.op == "div" and args[1].degree() == 0:
            values.append(args[0] * (1 / args[1][0]))
        elif node.op in _RING:
            values.append(_RING[node.op](*args))
        else:
            raise Unproved(f"the last piece needs a polynomial model, and {node.op} is none")
        sizes.append(_size(values[-1]))
        if sizes[-1][0] > _MOST_DEGREE or sizes[-1][1] > _MOST_BITS:
            raise Unproved(_TOO_LONG)
        budget.take(_bytes(*sizes[-1]))
        for place in over:
            values[place] = None
            budget.give(_bytes(*sizes[place]))
    return [values[output] for output in tape.outputs]


def _size(value: fmpq_poly) -> tuple[int, int]:
    """Degree, and bits of the longest coefficient, of numerators over their common denominator."""
    return value.degree(), max((int(part).bit_length() for part in (value.denom(), *value.numer().coeffs())), default=0)


def _bytes(degree: int, bits: int) -> int:
    return 200 + (degree + 2) * (bits // 8 + 8)


def _count(node: Node, given: Sequence[tuple[int, int]], budget: Budget) -> None:
    """Count an operation by the longest polynomial that it may give."""
    degrees, bits = [max(degree, 0) for degree, _ in given] or [1], [own for _, own in given] or [1100]
    times = 2 if node.op == "sq" else int(min(max(node.value, 1.0), 20.0)) if node.op == "pow" else 1
    degree = sum(degrees) if node.op == "mul" else times * max(degrees)
    if degree > _MOST_DEGREE:
        raise Unproved(_TOO_LONG)
    size = _bytes(degree, times * sum(bits) + 2 * degree)
    budget.fits(3 * size)
    budget.spend(_RATIONAL + _PER_BYTE * size)


_RING: dict[str, Any] = {
    "add": lambda x, y: x + y, "sub": lambda x, y: x - y, "mul": lambda x, y: x * y, "neg": lambda x: -x,
    "sq": lambda x: x * x,
}  # fmt: skip
