"""The proof by how fast paths leave an interval: one state in continuous time, every horizon at once.

A polynomial v on [low, high], by Chebyshev coefficients in y = (2 x - low - high)/(high - low), and L its generator:

- from above: [low, high] lies in the safe set, v <= 0 at both ends, L v >= -rate v for every disturbance, v <= extreme,
  and v >= start > 0 on the starts. Then exp(rate t) v is a submartingale until a path leaves, and
  P(leaving before T) <= 1 - exp(-rate T) start/extreme;
- from below: the safe set lies in [low, high], v >= extreme > 0 there, L v <= -rate v for every disturbance, and
  v <= start on the starts. Then P(leaving before T) >= 1 - exp(-rate T) start/extreme.
"""

from __future__ import annotations

from typing import Any

from flint import arb

from certbound.checker.expressions import Ceiling, Graph, Side
from certbound.checker.reading import Record
from certbound.checker.report import Budget, Unproved
from certbound.checker.statement import Model, SafeSet
from certbound.errors import CertificateError
from certbound.problem.model import Tape

MOST_TERMS = 60
_PROOF = ("engine", "low", "high", "coefficients", "rate", "start", "extreme")


def check_leaving(model: Model, value: object, budget: Budget) -> arb:
    """Upper bound of the probability that a constraint is broken."""
    proof = _Leaving(model, Record(value, "proof", _PROOF), budget, above=True)
    return arb.min(1 - proof.still(), arb(1)).upper()


def check_leaving_below(model: Model, value: object, budget: Budget) -> arb:
    """Lower bound of the probability that a constraint is broken, from every start."""
    proof = _Leaving(model, Record(value, "proof", (*_PROOF, "side")), budget, above=False)
    return arb.max(1 - proof.still(), arb(0)).lower()


class _Leaving:
    """The file's numbers, and what is shown of them."""

    def __init__(self, model: Model, record: Record, budget: Budget, *, above: bool) -> None:
        if not model.continuous or model.dimension != 1:
            raise Unproved("this proof serves one state in continuous time")
        if model.plan is not None or model.target is not None or model.initial.covariance is not None:
            raise Unproved("this proof needs a feedback law, a set of starts and no target")
        self.model, self.budget, self.above = model, budget, above
        self.low, self.high = record.number("low"), record.number("high")
        if not self.low < self.high:
            raise CertificateError("`proof.low` must be below `proof.high`.")
        self.rate, self.start, self.extreme = (record.number(name) for name in ("rate", "start", "extreme"))
        if not (self.rate > 0 and self.start > 0 and self.extreme > 0):
            raise CertificateError("`proof.rate`, `proof.start` and `proof.extreme` must be positive.")
        coefficients = record.array("coefficients", None)
        if not 1 <= len(coefficients) <= MOST_TERMS:
            raise CertificateError(f"`proof.coefficients` must have 1 to {MOST_TERMS} entries.")
        self.graph = Graph(budget)
        self.count = len(model.dynamics.inputs)
        self.slots = [self.graph.input(slot) for slot in range(self.count)]
        self.node = self._polynomial(coefficients)
        self.whole: Side = (arb(self.low), arb(self.high))
        self._check_interval()
        self._check_values()
        self._check_generator()

    def still(self) -> arb:
        """exp(-rate T) start/extreme."""
        return (-arb(self.rate) * arb(self.model.horizon)).exp() * arb(self.start) / arb(self.extreme)

    def _polynomial(self, coefficients: list[float]) -> int:
        """Clenshaw's recurrence."""
        graph = self.graph
        low, high = graph.const(self.low), graph.const(self.high)
        place = graph.sub(graph.sub(graph.mul(graph.const(2.0), self.slots[1]), low), high)
        y = graph.apply("div", place, graph.sub(high, low))
        twice = graph.mul(graph.const(2.0), y)
        first, second = graph.const(0.0), graph.const(0.0)
        for coefficient in reversed(coefficients[1:]):
            step = graph.sub(graph.mul(twice, first), second)
            first, second = graph.sum([graph.const(coefficient), step]), first
        return graph.sum([graph.const(coefficients[0]), graph.sub(graph.mul(y, first), second)])

    def _box(self, side: Side) -> list[Side]:
        """A box of inputs with a side of states; the model does not depend on time."""
        return [(arb(0), arb(0)), side, *((arb(low), arb(high)) for low, high in self.model.disturbance)]

    def _check_interval(self) -> None:
        safe = SafeSet(self.model, bounded=not self.above)
        low, high = self.whole
        if self.above:
            if not safe.holds([(low + high) / 2], [(high - low) / 2]):
                raise Unproved("the interval was not shown to lie in the safe set")
            return
        (a, b), = safe.hull
        if not (a >= low and b <= high):
            raise Unproved("the safe set was not shown to lie in the interval")

    def _check_values(self) -> None:
        """v at the ends, over the interval, and over the starts."""
        graph, initial = self.graph, self.model.initial
        negative = graph.neg(self.node)
        most, least = (
            Ceiling(graph, node, [], count=self.count, budget=self.budget) for node in (self.node, negative)
        )
        low, high = self.whole
        starts = initial.low[0].lower(), initial.high[0].upper()
        if not (low <= starts[0] and starts[1] <= high):
            raise Unproved("the starts were not shown to lie in the interval")
        start, extreme = arb(self.start), arb(self.extreme)
        if self.above:
            if not all(most.prove(self._box((end, end)), arb(0)) for end in self.whole):
                raise Unproved("v was not shown to be at most 0 at the ends")
            shown = most.prove(self._box(self.whole), extreme) and least.prove(self._box(starts), -start)
        else:
            shown = least.prove(self._box(self.whole), -extreme) and most.prove(self._box(starts), start)
        if not shown:
            raise Unproved("v was not shown to be what is stated on the interval and the starts")

    def _check_generator(self) -> None:
        graph, model = self.graph, self.model
        given: Any = model.noise.diffusion
        tapes = [model.dynamics, *([given] if isinstance(given, Tape) else [])]
        if any(node.op == "input" and node.args[0] == 0 for tape in tapes for node in tape.nodes):
            raise Unproved("this proof needs a model that does not depend on time")
        nodes = graph.include(model.dynamics, self.slots)
        flow = nodes[model.dynamics.outputs[0]]
        if isinstance(given, Tape):
            inner = graph.include(given, self.slots[:2])
            entries = [inner[output] for output in given.outputs]
        else:
            entries = [graph.const(float(x)) for x in given.entries()]
        slope = graph.derivative(self.node, 1)
        bend = graph.mul(graph.const(0.5), graph.derivative(slope, 1))
        terms = [graph.mul(flow, slope), graph.mul(graph.const(self.rate), self.node)]
        terms += [graph.mul(graph.apply("sq", entry), bend) for entry in entries]
        total = graph.sum(terms)
        node = graph.neg(total) if self.above else total
        balance = Ceiling(graph, node, [flow, *entries], count=self.count, budget=self.budget)
        if not balance.prove(self._box(self.whole), arb(0)):
            raise Unproved("v was not shown to change at the stated rate")
