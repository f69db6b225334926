"""The problem in logarithms of some states, derived from the stated one by Ito's formula.

Where x_i = exp(y_i) > 0, dY_i = (f_i/x_i - 1/2 sum_k (g_ik/x_i)^2) dt + sum_k (g_ik/x_i) dW_k. A limit that lasts keeps
x_i positive: until one is broken Y_i = log X_i is defined, and the same paths break a limit of x_i and its image.
Images are rounded such that less is safe, and starts outward, which proves upper bounds only.

What x_i divides is written without it wherever it is a factor, over the reals: what remains must be defined as before.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction

from flint import arb, arb_mat, fmpq

from certbound.checker.balls import matrix
from certbound.checker.reading import Record, wholes
from certbound.checker.report import FUNCTION, STEP, Budget
from certbound.checker.statement.problem import Initial, Model
from certbound.checker.statement.regions import Constraint
from certbound.errors import CertificateError
from certbound.problem.model import Node, Tape

_MOST = 40  # states
_LONGEST = 20_000  # operations
_WORK, _BYTES = 15_000, 700
"""Units of work and memory of an operation that is written, with its exact number where it has one."""


def logarithmic_model(model: Model, record: Record) -> Model:
    """The model in logarithms of the ``states`` that a proof names.

    CertificateError where no limit keeps one of these positive, a set asks for it and another state at once, or the
    problem is none that is stated so.
    """
    n = model.dimension
    random = model.initial.covariance is not None or bool(model.members or model.drawn)
    plain = model.continuous and model.hold is None and model.target is None and model.domain is None
    if not plain or model.ends or random or not isinstance(model.noise.diffusion, Tape) or n > _MOST:
        raise CertificateError(f"`{record.path}.engine` must not be \"logarithms\" for such a problem.")
    place = f"`{record.at('states')}`"
    chosen = sorted(set(wholes(record["states"], record.at("states"), 0, n - 1)))
    if not chosen or len(model.dynamics.nodes) + len(model.noise.diffusion.nodes) > _LONGEST:
        raise CertificateError(f"{place} must name states, of a model of at most {_LONGEST} operations.")
    for i in chosen:
        if not any(_keeps_positive(one, i) for one in model.constraints):
            raise CertificateError(f"{place} must name states that a limit for all time keeps positive.")
    given, budget = model.noise.diffusion, model.budget
    dynamics, noise = budget.once(  # for all members of a union
        model.dynamics, ("logarithms", given, *chosen), lambda: _derived(model.dynamics, given, chosen, budget)
    )
    budget.balls(len(chosen) * (1 + sum(1 + len(one.region.faces) for one in model.constraints)), FUNCTION)
    return replace(
        model, dynamics=dynamics, noise=replace(model.noise, diffusion=noise), by_ito=True,
        initial=_start(model.initial, chosen),
        constraints=tuple(_constraint(one, chosen) for one in model.constraints),
    )


def _keeps_positive(constraint: Constraint, i: int) -> bool:
    region = constraint.region
    if not constraint.inside or constraint.during is not None or region.round or isinstance(region.center, Tape):
        return False
    for face, bound in zip(region.faces, region.bounds):
        own = [(place, c) for place, c in zip(region.coordinates, face) if c]
        if len(own) == 1 and own[0][0] == i and own[0][1] < 0 and bound < 0 and not any(region.center):
            return True
    return False


def _start(initial: Initial, chosen: Sequence[int]) -> Initial:
    """A box around the image."""
    low, high = list(initial.low), list(initial.high)
    for i in chosen:
        if not low[i] > 0:
            raise CertificateError("`problem.initial` must be positive where logarithms are taken.")
        low[i], high[i] = low[i].log().lower(), high[i].log().upper()
    return Initial(kind="box", low=tuple(low), high=tuple(high), around=True)


def _constraint(constraint: Constraint, chosen: Sequence[int]) -> Constraint:
    region = constraint.region
    if not set(chosen) & set(region.coordinates):
        return constraint
    if not region.round:
        touched = [place for face in region.faces for place, c in zip(region.coordinates, face) if c]
        if not set(chosen) & set(touched):
            return constraint
    if region.round or isinstance(region.center, Tape) or any(region.center):
        raise CertificateError("`problem.constraints` has a set that is round or has a centre, in logarithms.")
    faces, bounds = [], []
    for face, bound in zip(region.faces, region.bounds):
        own = [k for k, c in enumerate(face) if c]
        if not {region.coordinates[k] for k in own} & set(chosen):
            faces.append(face)
            bounds.append(bound)
            continue
        end = arb(bound) / arb(face[own[0]])
        if len(own) > 1 or not end > 0:
            raise CertificateError("`problem.constraints` has a limit that is no positive one of a single state.")
        sign = 1.0 if face[own[0]] > 0 else -1.0
        faces.append([sign if k == own[0] else 0.0 for k in range(len(face))])
        image = end.log() * sign
        bounds.append(-_above(-image) if constraint.inside else _above(image))
    return replace(constraint, region=replace(region, faces=faces, bounds=bounds))


def _above(value: arb) -> float:
    """A float that is at least the ball."""
    found = float(value.upper())
    while arb(found) < value.upper():
        found = math.nextafter(found, math.inf)
    return found


def _derived(
    dynamics: Tape, diffusion: Tape, chosen: Sequence[int], budget: Budget
) -> tuple[Tape, arb_mat | Tape]:
    """The rates and what multiplies the noise; the latter is a matrix where no entry depends on anything."""
    n, m = diffusion.shape
    writer = _Writer(len(dynamics.inputs), budget)
    rates, gains = writer.copied(dynamics), writer.copied(diffusion)
    for i in chosen:
        entries = gains[i * m : (i + 1) * m]
        *own, rate = writer.quotients(i + 1, [*entries, rates[i]])
        gains[i * m : (i + 1) * m] = own
        total = writer.const(Fraction(0))
        for entry in own:
            total = writer.put("add", total, writer.put("sq", entry))
        rates[i] = writer.put("sub", rate, writer.put("mul", writer.const(Fraction(1, 2)), total))
    exact = [writer.numbers[entry] for entry in gains]
    stated = _exponentials(writer.nodes, rates, chosen, dynamics.inputs, (n,))
    if all(number is not None for number in exact):
        balls = [arb(fmpq(number.numerator, number.denominator)) for number in exact if number is not None]
        return stated, matrix([balls[k * m : (k + 1) * m] for k in range(n)])
    return stated, _exponentials(writer.nodes, gains, chosen, diffusion.inputs, (n, m))


def _exponentials(
    nodes: Sequence[Node], outputs: Sequence[int], chosen: Sequence[int], inputs: tuple[str, ...],
    shape: tuple[int, ...],
) -> Tape:
    """The operations that are needed, with exp(y_i) where x_i stands."""
    kept, places, found = _asked(nodes, outputs), dict[int, int](), list[Node]()
    for index, node in enumerate(nodes):
        if kept[index]:
            found.append(node if node.op == "input" else node._replace(args=tuple(places[arg] for arg in node.args)))
            if node.op == "input" and node.args[0] - 1 in chosen:
                found.append(Node("exp", (len(found) - 1,)))
            places[index] = len(found) - 1
    return Tape(inputs=inputs, nodes=tuple(found), outputs=tuple(places[k] for k in outputs), shape=shape)


def _asked(nodes: Sequence[Node], outputs: Sequence[int]) -> list[bool]:
    """Whether each operation is an output or what one depends on."""
    found = [False] * len(nodes)
    for output in outputs:
        found[output] = True
    for index in range(len(nodes) - 1, -1, -1):
        if found[index] and nodes[index].op != "input":
            for arg in nodes[index].args:
                found[arg] = True
    return found


class _Writer:
    """Operations written one after the other, none twice; ``numbers`` are their values where they are known exactly."""

    def __init__(self, count: int, budget: Budget) -> None:
        self.budget = budget
        self.nodes: list[Node] = []
        self.numbers: list[Fraction | None] = []
        self._places: dict[Node, int] = {}
        self.inputs = [self._write(Node("input", (slot,)), None) for slot in range(count)]

    def _write(self, node: Node, number: Fraction | None) -> int:
        self.budget.spend(_WORK + 50 * len(node.args))
        self.budget.take(_BYTES)
        place = self._places.setdefault(node, len(self.nodes))
        if place == len(self.nodes):
            self.nodes.append(node)
            self.numbers.append(number)
        return place

    def const(self, value: Fraction) -> int:
        """A constant, which is a float."""
        return self._write(Node("const", (), float(value)), value)

    def put(self, op: str, *args: int) -> int:
        """An operation; one of numbers is a number where that is a float, and a factor of 1 is left out."""
        self.budget.spend(_WORK)
        known = [self.numbers[arg] for arg in args]
        given = [number for number in known if number is not None]
        if len(given) == len(args):
            a, b = given[0], given[-1]
            found = {"add": a + b, "sub": a - b, "mul": a * b, "sq": a * a, "neg": -a}.get(op)
            if op == "div" and b:
                found = a / b
            if found is not None and _is_float(found):
                return self.const(found)
        if op == "mul" and 1 in known:
            return args[1 - known.index(Fraction(1))]
        if op == "div" and known[1] == 1:
            return args[0]
        if op in ("add", "sub") and known[1] == 0:
            return args[0]
        return args[1] if op == "add" and known[0] == 0 else self._write(Node(op, args), None)

    def copied(self, tape: Tape) -> list[int]:
        """The outputs of a tape over the first inputs."""
        found: list[int] = []
        for node in tape.nodes:
            if node.op == "input":
                found.append(self.inputs[node.args[0]])
            elif node.op == "const":
                found.append(self.const(Fraction(node.value)))
            else:
                args = tuple(found[arg] for arg in node.args)
                plain = node.part is None and node.op != "pow"
                found.append(self.put(node.op, *args) if plain else self._write(node._replace(args=args), None))
        return [found[output] for output in tape.outputs]

    def quotients(self, slot: int, wanted: Sequence[int]) -> list[int]:
        """The wanted operations divided by an input: without a division where it is a factor, of sums term by term."""
        self.budget.spend(len(self.nodes) * STEP)
        x, kept = self.inputs[slot], _asked(self.nodes, wanted)
        factors: dict[int, int] = {x: self.const(Fraction(1))}
        found: dict[int, int] = {}
        for index in [place for place, asked in enumerate(kept) if asked]:
            factor = factors.get(index, self._factor(index, factors, x))
            if factor is not None:
                factors[index] = factor
            found[index] = self._quotient(index, found, x) if factor is None else factor
        return [found[index] for index in wanted]

    def _factor(self, index: int, factors: dict[int, int], x: int) -> int | None:
        """What x leaves of a product that it is a factor of."""
        op, args, value, _ = self.nodes[index]
        own = [factors.get(arg) for arg in args] if op != "input" else []
        if self.numbers[index] == 0:
            return index
        if op == "mul" and own[0] is not None:
            return self.put("mul", own[0], args[1])
        if op == "mul" and own[1] is not None:
            return self.put("mul", own[1], args[0])
        if op == "sq" and own[0] is not None:
            return self.put("mul", own[0], args[0])
        if op == "neg" and own[0] is not None:
            return self.put("neg", own[0])
        if op == "div" and own[0] is not None:
            return self.put("div", own[0], args[1])
        if op in ("add", "sub") and own[0] is not None and own[1] is not None:
            return self.put(op, own[0], own[1])
        if op == "pow" and args[0] == x and value in (3.0, 4.0, 5.0):
            return self._write(Node("pow", (x,), value - 1), None)
        return None

    def _quotient(self, index: int, found: dict[int, int], x: int) -> int:
        op, args, *_ = self.nodes[index]
        if op in ("add", "sub", "neg"):
            return self.put(op, *(found[arg] for arg in args))
        if op == "mul":
            for a, b in (args, args[::-1]):
                if self.numbers[a] is not None:
                    return self.put("mul", a, found[b])
        return self.put("div", index, x)


def _is_float(value: Fraction) -> bool:
    try:
        return Fraction(float(value)) == value
    except OverflowError:
        return False
