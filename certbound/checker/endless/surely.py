"""The proof that every path leaves: any number of states, an infinite horizon.

The safe set lies in a bounded box; on the part of it that no constraint rules out s f_i >= -drift and |g_i|^2 >= noise
> 0 for every disturbance, f_i and g_i being the drift and the row of the diffusion of one state, s = -1 where
``mirrored``. With w the width of the box along it, k = 2 drift/noise + 1/w and u = exp(k s x_i), L u is at least
k noise/(2 w) u: u is bounded on the safe set and its mean grows at no less than a fixed rate until a path leaves, so
that the mean time of leaving is finite, and leaving certain. In discrete time |g_i|^2 is the variance of normal noise
that adds to the state: the next step leads out with a probability that has a positive lower bound.
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


def check_surely(model: Model, value: object, budget: Budget) -> arb:
    """No upper bound below 1."""
    raise Unproved("this proof bounds from below only")


def check_surely_below(model: Model, value: object, budget: Budget) -> arb:
    """Lower bound of the probability that a constraint is broken at any time, from every start: 1."""
    record = Record(value, "proof", ("engine", "state", "mirrored", "noise", "drift", "side"))
    if model.plan is not None or model.target is not None or model.horizon != float("inf"):
        raise Unproved("this proof serves a feedback law, an infinite horizon and no target")
    state, noise, drift = record.whole("state", 0, model.dimension - 1), record.number("noise"), record.number("drift")
    if not (noise > 0 and (drift >= 0 or not model.continuous)):
        raise CertificateError("`proof.noise` must be positive, and `proof.drift` must not be negative.")
    sign = -1.0 if record.flag("mirrored") else 1.0
    given: Any = model.noise.diffusion
    tapes = [model.dynamics, *([given] if isinstance(given, Tape) else [])]
    if any(node.op == "input" and node.args[0] == 0 for tape in tapes for node in tape.nodes):
        raise Unproved("this proof needs a model that does not depend on time")
    safe = SafeSet(model)
    graph, count = Graph(budget), len(model.dynamics.inputs)
    slots = [graph.input(slot) for slot in range(count)]
    flow = graph.include(model.dynamics, slots)[model.dynamics.outputs[state]]
    if not model.continuous:
        if isinstance(given, Tape) or not model.noise.gaussian:
            raise Unproved("in discrete time this proof serves normal noise that adds to the state")
        row = [graph.const(0.0)]
        if not model.noise.covariance()[state, state] >= noise:
            raise Unproved("the noise of the state was not shown to be at least what is stated")
    elif isinstance(given, Tape):
        inner = graph.include(given, slots[: model.dimension + 1])
        columns = len(given.outputs) // model.dimension
        row = [inner[output] for output in given.outputs[state * columns : (state + 1) * columns]]
    else:
        row = [graph.const(float(given[state, column])) for column in range(given.ncols())]
    square = graph.sum([graph.apply("sq", entry) for entry in row])
    box: list[Side] = [(arb(0), arb(0)), *safe.hull, *((arb(low), arb(high)) for low, high in model.disturbance)]
    n = model.dimension

    def off(centre: Any, radius: Any) -> bool:
        return safe.excludes(centre[1 : n + 1], radius[1 : n + 1])

    shaken = Ceiling(graph, graph.neg(square), row, count=count, budget=budget)
    if model.continuous and not shaken.prove(box, -arb(noise), off):
        raise Unproved("the noise of the state was not shown to be at least what is stated on the safe set")
    driven = Ceiling(graph, graph.mul(graph.const(-sign), flow), [flow], count=count, budget=budget)
    if not driven.prove(box, arb(drift), off):
        raise Unproved("the drift of the state was not shown to be at least what is stated on the safe set")
    return arb(1)
