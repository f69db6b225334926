"""The proof by a barrier: exp(V) of a polynomial V, which grows slowly and is large where a constraint breaks.

With D the set on which no constraint is broken, proved here by branch and bound over boxes that cover it:

- grad V . f + 1/2 tr(g g^T Hess V) + 1/2 |g^T grad V|^2 <= growth on [0, T] x D, for every value of the disturbance;
- the initial set lies in D, and V <= start on it;
- V >= boundary on the points of D where some constraint is about to be broken.

Then P(leaving within T) <= exp(start - boundary + max(growth, 0) T) for every disturbance that does not see coming
noise. With an inflow the first inequality is that the same expression, times exp(V - boundary), is at most the inflow,
and P(leaving within T) <= exp(start - boundary) + inflow T. Source: docs/theory.md, Section 10.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from flint import arb

from certbound.checker.balls import upper
from certbound.checker.expressions import Ceiling, Graph, Side
from certbound.checker.reading import Record, wholes
from certbound.checker.report import Budget, Unproved
from certbound.checker.statement import Model, SafeSet
from certbound.errors import CertificateError
from certbound.problem.model import Tape

MOST_STATES = 6
MOST_TERMS = 500
MOST_POWER = 12
Test = Callable[[Sequence[arb], Sequence[arb]], bool]
_PROOF = ("engine", "center", "scale", "exponents", "coefficients", "growth", "start", "boundary")


def check_barrier(model: Model, value: object, budget: Budget) -> arb:
    """Upper bound of the probability that a constraint is broken.

    It holds for every start and every disturbance that does not see coming noise (it makes exp(V) a supermartingale).
    CertificateError where the proof's data are malformed, Unproved where an inequality could not be proved.
    """
    record = Record(value, "proof", _PROOF, ("inflow",))
    _refuse(model)
    growth, start, boundary = (arb(record.number(name)) for name in ("growth", "start", "boundary"))
    inflow = None if record["inflow"] is None else arb(record.number("inflow", least=0.0))
    if inflow is not None and not growth.is_zero():
        raise CertificateError("`proof.growth` must be 0 beside an inflow.")
    expressions = _Expressions(model, record, budget)
    safe = SafeSet(model)
    initial = [(low.lower(), high.upper()) for low, high in zip(model.initial.low, model.initial.high)]
    if not safe.contains(initial, budget):
        raise Unproved("the initial set was not shown to lie in the safe set")
    graph, n, count = expressions.graph, model.dimension, expressions.count
    polynomial = Ceiling(graph, expressions.value, [], count=count, budget=budget)
    nothing = (arb(0), arb(0))
    rest = [nothing] * (count - 1 - n)
    if not polynomial.prove([nothing, *initial, *rest], start):
        raise Unproved("the barrier was not shown to stay below its level on the initial set")
    negative = Ceiling(graph, graph.neg(expressions.value), [], count=count, budget=budget)
    excluded, held = _on_states(safe.excludes, n), _on_states(safe.holds, n)
    for part in safe.boundary():
        member = held if part.exact else lambda *_: False
        if not negative.prove([nothing, *part.box, *rest], -boundary, _on_states(part.skip, n), member):
            raise Unproved("the barrier was not shown to reach its level where a constraint breaks")
    drift, settled = Ceiling(graph, expressions.generator, expressions.defined, count=count, budget=budget), excluded
    if inflow is not None:  # of exp(V - boundary): nothing to prove where the generator is not positive
        slower = drift
        above = graph.sub(expressions.value, graph.const(record.number("boundary")))
        generator = graph.mul(graph.apply("exp", above), expressions.generator)
        drift = Ceiling(graph, generator, expressions.defined, count=count, budget=budget)

        def settled(centre: Sequence[arb], radius: Sequence[arb]) -> bool:
            return excluded(centre, radius) or slower.holds(centre, radius, arb(0))

    box: list[Side] = [(arb(0), arb(model.horizon)), *safe.hull]
    box += [(arb(low), arb(high)) for low, high in model.disturbance]
    if not drift.prove(box, growth if inflow is None else inflow, settled, held):
        raise Unproved("the barrier was not shown to grow as slowly as stated")
    if inflow is not None:
        return upper((start - boundary).exp() + inflow * arb(model.horizon))
    return upper((start - boundary + arb.max(growth, arb(0)) * arb(model.horizon)).exp())


def _on_states(test: Test, n: int) -> Test:
    """A test of boxes of states for boxes of (t, states, disturbances)."""
    return lambda centre, radius: test(centre[1 : n + 1], radius[1 : n + 1])


def _refuse(model: Model) -> None:
    if not model.continuous:
        raise Unproved("a barrier proves nothing in discrete time")
    if model.dimension > MOST_STATES:
        raise Unproved(f"{model.dimension} states are too many for this proof")
    if model.plan is not None:
        raise Unproved("this proof does not treat a plan with steps in time")
    if model.initial.covariance is not None:
        raise Unproved("this proof needs a bounded initial set")


class _Expressions:
    """V and the expression that bounds its growth, over (t, states, disturbances).

    ``value`` and ``generator`` are nodes of the graph; ``defined`` are the dynamics and the diffusion themselves, which
    must exist wherever the generator is bounded.
    """

    def __init__(self, model: Model, record: Record, budget: Budget) -> None:
        self.graph = graph = Graph(budget)
        n = model.dimension
        self.count = len(model.dynamics.inputs)
        slots = [graph.input(slot) for slot in range(self.count)]
        self.value = self._polynomial(record, slots[1 : n + 1])
        nodes = graph.include(model.dynamics, slots)
        flow = [nodes[output] for output in model.dynamics.outputs]
        slope = [graph.derivative(self.value, 1 + i) for i in range(n)]
        terms = [graph.mul(a, b) for a, b in zip(slope, flow)]
        columns, entries = self._diffusion(model, slots[: n + 1])
        half = graph.const(0.5)
        for j in range(columns):
            budget.check()
            column = [entries[i * columns + j] for i in range(n)]
            along = graph.sum(graph.mul(a, b) for a, b in zip(column, slope))
            if not graph.is_const(along, 0.0):
                terms.append(graph.mul(half, graph.apply("sq", along)))
            for i in range(n):
                for k in range(n):
                    product = graph.mul(column[i], column[k])
                    terms.append(graph.mul(half, graph.mul(product, graph.derivative(slope[i], 1 + k))))
        self.generator = graph.sum(terms)
        self.defined = [*flow, *entries]

    def _polynomial(self, record: Record, states: Sequence[int]) -> int:
        """V(x) = sum_k coefficients[k] prod_i ((x_i - center_i)/scale_i)^exponents[k][i]."""
        graph, n = self.graph, len(states)
        center, scale = record.array("center", n), record.array("scale", n)
        if not all(x > 0 for x in scale):
            raise CertificateError("`proof.scale` must be positive.")
        powers = [wholes(item, "proof.exponents", 0, MOST_POWER) for item in record.items("exponents", 1, MOST_TERMS)]
        if any(len(power) != n for power in powers) or len({tuple(power) for power in powers}) != len(powers):
            raise CertificateError("`proof.exponents` must hold different exponents, one a state.")
        coefficients = record.array("coefficients", len(powers))
        unit = [
            graph.apply("div", graph.sub(x, graph.const(c)), graph.const(s)) for x, c, s in zip(states, center, scale)
        ]
        terms = []
        for coefficient, power in zip(coefficients, powers):
            term = graph.const(coefficient)
            for y, exponent in zip(unit, power):
                if exponent:
                    term = graph.mul(term, y if exponent == 1 else graph.apply("pow", y, value=float(exponent)))
            terms.append(term)
        return graph.sum(terms)

    def _diffusion(self, model: Model, slots: Sequence[int]) -> tuple[int, list[int]]:
        """Number of columns of g, and its entries row by row."""
        given = model.noise.diffusion
        if isinstance(given, Tape):
            nodes = self.graph.include(given, slots)
            return given.shape[1], [nodes[output] for output in given.outputs]
        return given.ncols(), [self.graph.const(float(x)) for x in given.entries()]
