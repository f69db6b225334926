"""The problem in other coordinates y = T x, derived from the stated one: dY = T f(T^-1 Y) dt + T g(T^-1 Y) dW.

T and its inverse are floats whose product is the identity, in fractions. A limit n . x <= b is (n T^-1) . y <= b, and
is refused where a number of it is no float, and so is constant noise; the start is enclosed by a box, which proves
upper bounds only.

Operations are sums of others with exact coefficients for as long as these are floats. What is no input stays in a sum
with a factor of 0: it must be defined all the same.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction

from flint import arb

from certbound.checker.balls import matrix
from certbound.checker.reading import Record
from certbound.checker.report import Budget
from certbound.checker.statement.by_ito import logarithmic_model
from certbound.checker.statement.problem import Initial, Model, Noise
from certbound.checker.statement.regions import Constraint
from certbound.errors import CertificateError
from certbound.problem.model import Node, Tape

MOST_TURNED = 40
"""States of a problem in other coordinates."""
_TERMS = 64
_FRACTION, _NODE_WORK = 6_000, 4_000
"""Units of work of a sum and product of fractions (2,000 to 5,000 ns measured), and of an operation that is written."""
_TERM_BYTES, _NODE_BYTES = 300, 700
"""Memory of a term of a sum, and of an operation in lists and tables."""

Rows = list[list[Fraction]]
Sum = tuple[dict[int, Fraction], Fraction]
"""Coefficients of operations, and a constant: floats, all of them."""


def restated(model: Model, proof: object, path: str) -> tuple[Model, object, str]:
    """The model that a proof is about, that proof, and where it stands: in logarithms first, then in coordinates.

    CertificateError where it rests on constants that are assumed: what a user states is stated of the problem's own
    states, and says nothing of others.
    """
    given = path
    for engine, fields, derive in (
        ("logarithms", ("states",), logarithmic_model), ("coordinates", ("matrix", "inverse"), turned_model)
    ):  # fmt: skip
        if isinstance(proof, Mapping) and proof.get("engine") == engine:
            record = Record(proof, path, ("engine", *fields, "proof"))
            model, proof, path = derive(model, record), record["proof"], f"{path}.proof"
    if path != given and isinstance(proof, Mapping) and proof.get("assumed") not in (None, False):
        raise CertificateError(f"`{path}.assumed` must be false: constants are stated of the problem's own states.")
    return model, proof, path


def turned_model(model: Model, record: Record) -> Model:
    """The model in the coordinates that a proof states.

    CertificateError where ``matrix`` and ``inverse`` are not inverse to each other, or the problem is none that is
    stated in other coordinates, or not exactly.
    """
    n = model.dimension
    random = model.initial.covariance is not None or bool(model.members or model.drawn)
    if not model.continuous or model.hold is not None or model.target is not None or model.ends or random:
        raise CertificateError(f"`{record.path}.engine` must not be \"coordinates\" for such a problem.")
    if n > MOST_TURNED:
        raise CertificateError(f"`{record.at('matrix')}` must be of at most {MOST_TURNED} states.")
    model.budget.spend(n * n * (n + 2) * _FRACTION)
    turn, back = (
        [[Fraction(x) for x in row] for row in record.array(name, n, n)] for name in ("matrix", "inverse")
    )
    if any(sum((a * b[j] for a, b in zip(turn[i], back)), Fraction(0)) != (i == j) for i in range(n) for j in range(n)):
        raise CertificateError(f"`{record.at('inverse')}` must be the inverse of `matrix`, exactly.")
    moved = {i for i in range(n) if any(back[i][j] != (i == j) for j in range(n))}
    if model.domain is not None and any(model.domain[j] != (None, None) for j in moved):
        raise CertificateError("`problem.domain` bounds a state that the stated coordinates replace.")
    return replace(
        model, dynamics=_once(model.dynamics, turn, back, model.budget),
        noise=_noise(model.noise, turn, back, model.budget),
        initial=_start(model.initial, turn),
        constraints=tuple(_constraint(one, back, moved, model.budget) for one in model.constraints),
    )


def _once(tape: Tape, turn: Rows, back: Rows, budget: Budget) -> Tape:
    """The tape in other coordinates, made once where all members of a union take the same."""
    key = tuple(tuple(row) for rows in (turn, back) for row in rows)
    return budget.once(tape, ("coordinates", key), lambda: _composed(tape, turn, back, budget))


def _start(initial: Initial, turn: Rows) -> Initial:
    """A box around the image."""
    low, high = [], []
    for row in turn:
        ends = [(c * a, c * b) for c, a, b in zip(map(_ball, row), initial.low, initial.high) if not c.is_zero()]
        low.append(sum((arb.min(a.lower(), b.lower()) for a, b in ends), arb(0)).lower())
        high.append(sum((arb.max(a.upper(), b.upper()) for a, b in ends), arb(0)).upper())
    return Initial(kind="box", low=tuple(low), high=tuple(high), around=True)


def _ball(value: Fraction) -> arb:
    return arb(float(value))


def _noise(noise: Noise, turn: Rows, back: Rows, budget: Budget) -> Noise:
    if isinstance(noise.diffusion, Tape):
        return replace(noise, diffusion=_once(noise.diffusion, turn, back, budget))
    budget.spend(noise.diffusion.ncols() * len(turn) ** 2 * _FRACTION)
    given = [[Fraction(float(x)) for x in row] for row in noise.diffusion.tolist()]
    rows = [[sum((c * x for c, x in zip(row, column)), Fraction(0)) for column in zip(*given)] for row in turn]
    if not all(_is_float(x) for row in rows for x in row):  # proofs take them for floats
        raise CertificateError("`problem.noise` is not exact in the stated coordinates.")
    return replace(noise, diffusion=matrix([[float(x) for x in row] for row in rows]))


def _constraint(constraint: Constraint, back: Rows, moved: set[int], budget: Budget) -> Constraint:
    region, n = constraint.region, len(back)
    budget.spend((1 + len(region.faces)) * (1 + len(region.coordinates)) * n * _FRACTION)
    budget.take(40 * n * len(region.faces))
    if not moved & set(region.coordinates):
        return constraint
    if region.round or isinstance(region.center, Tape) or any(region.center):
        raise CertificateError("`problem.constraints` has a set that is round or has a centre, in other coordinates.")
    faces = []
    for face in region.faces:
        own = list(zip(region.coordinates, map(Fraction, face)))
        row = [sum((c * back[i][j] for i, c in own), Fraction(0)) for j in range(n)]
        if not all(map(_is_float, row)):
            raise CertificateError("`problem.constraints` has a limit that is not exact in the stated coordinates.")
        faces.append([float(c) for c in row])
    kind = "halfspace" if region.kind == "halfspace" else "polytope"
    turned = replace(region, kind=kind, coordinates=tuple(range(n)), center=[0.0] * n, faces=faces)
    return replace(constraint, region=turned)


def _is_float(value: Fraction) -> bool:
    try:
        return Fraction(float(value)) == value
    except OverflowError:
        return False


def _composed(tape: Tape, turn: Rows, back: Rows, budget: Budget) -> Tape:
    """T . f(t, T^-1 y, ...), entry by entry."""
    writer, n = _Writer(budget), len(back)
    given: list[Sum] = [({writer.put(Node("input", (slot,))): Fraction(1)}, Fraction(0))
                        for slot in range(len(tape.inputs))]  # fmt: skip
    given[1 : n + 1] = [writer.total(zip(row, given[1 : n + 1])) for row in back]
    found = writer.values(tape, given)
    columns = len(found) // n
    outputs = [writer.node(writer.total(zip(row, found[k::columns]))) for row in turn for k in range(columns)]
    return Tape(inputs=tape.inputs, nodes=tuple(writer.nodes), outputs=tuple(outputs), shape=tape.shape)


class _Writer:
    """Operations written one after the other, none twice."""

    def __init__(self, budget: Budget) -> None:
        self.budget = budget
        self.nodes: list[Node] = []
        self._places: dict[Node, int] = {}

    def put(self, node: Node) -> int:
        self.budget.spend(_NODE_WORK + 50 * len(node.args))
        self.budget.take(_NODE_BYTES)
        place = self._places.setdefault(node, len(self.nodes))
        if place == len(self.nodes):
            self.nodes.append(node)
        return place

    def total(self, parts: Iterable[tuple[Fraction, Sum]]) -> Sum:
        """The sum of sums by factors that are floats: merged, or where that is not exact, added as they stand."""
        kept = [(factor, part) for factor, part in parts if factor]
        self.budget.spend(sum(2 + len(own) for _, (own, _) in kept) * 2 * _FRACTION)
        terms: dict[int, Fraction] = {}
        for factor, (own, _) in kept:
            for place, c in own.items():
                terms[place] = terms.get(place, Fraction(0)) + factor * c
        terms = {place: c for place, c in terms.items() if c or self.nodes[place].op != "input"}
        constant = sum((factor * own for factor, (_, own) in kept), Fraction(0))
        if len(terms) <= _TERMS and _is_float(constant) and all(map(_is_float, terms.values())):
            self.budget.take(_TERM_BYTES * len(terms))
            return terms, constant
        return {self._added([(factor, self.node(part)) for factor, part in kept]): Fraction(1)}, Fraction(0)

    def node(self, value: Sum) -> int:
        """The operation that a sum is."""
        terms, constant = value
        parts = [(c, place) for place, c in sorted(terms.items())]
        if constant or not parts:
            parts.append((Fraction(1), self.put(Node("const", (), float(constant)))))
        return self._added(parts)

    def _added(self, parts: Sequence[tuple[Fraction, int]]) -> int:
        places = [
            place if c == 1 else self.put(Node("neg", (place,))) if c == -1
            else self.put(Node("mul", (self.put(Node("const", (), float(c))), place)))
            for c, place in parts
        ]  # fmt: skip
        found = places[0]
        for place in places[1:]:
            found = self.put(Node("add", (found, place)))
        return found

    def values(self, tape: Tape, given: Sequence[Sum]) -> list[Sum]:
        """The outputs of a tape over given sums."""
        found: list[Sum] = []
        for node in tape.nodes:
            own = given if node.op == "input" else found
            self.budget.take(_NODE_BYTES)
            self.budget.spend(2 * _FRACTION + _NODE_WORK)
            found.append(self._value(node, [own[arg] for arg in node.args]))
        return [found[output] for output in tape.outputs]

    def _value(self, node: Node, given: Sequence[Sum]) -> Sum:
        one, op = Fraction(1), node.op
        if op == "input":
            return given[0]
        if op == "const":
            return {}, Fraction(node.value)
        if op in ("add", "sub"):
            return self.total([(one, given[0]), (one if op == "add" else -one, given[1])])
        if op == "neg":
            return self.total([(-one, given[0])])
        for factor, other in (given, given[::-1]) if op == "mul" else ():
            if not factor[0] and factor[1]:
                return self.total([(factor[1], other)])
        if op == "div" and not given[1][0] and given[1][1] and _is_float(1 / given[1][1]):
            return self.total([(1 / given[1][1], given[0])])
        return {self.put(node._replace(args=tuple(map(self.node, given)))): one}, Fraction(0)
