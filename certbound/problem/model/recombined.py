"""A tape in other coordinates, over the reals: sums are put together anew, so that what cancels is gone.

Every value is a sum of operations with exact coefficients for as long as these are floats; where they are not, its
parts are added as they stand. Interval arithmetic would not see that p2 - (p2 - a) is a.

In logarithms of states, x_i = exp(y_i), what a state divides is divided as far as it goes: dx_i = f_i dt
+ sum_k g_ik dW_k becomes dy_i = (f_i/x_i - 1/2 sum_k (g_ik/x_i)^2) dt + sum_k (g_ik/x_i) dW_k (Ito, x_i > 0).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.problem.model.graph import Graph
from certbound.problem.model.tape import Tape

_ONE = Fraction(1)
_MOST = 64  # terms of a sum


@dataclass(frozen=True, eq=False)
class Sum:
    """``constant`` plus coefficients times nodes of a graph; all of them are floats."""

    terms: dict[int, Fraction]
    constant: Fraction = Fraction(0)


def turned_tape(
    tape: Tape, inverse: Array, matrix: Array | None = None
) -> tuple[Tape, list[dict[int, float] | None], Array]:
    """matrix . f(t, inverse y, ...) of a tape f over (t, states, ...), which outputs are linear in y, and what bends.

    Parameters
    ----------
    tape : Tape
        Of shape (k,), or (n,) or (n, m) where there is a ``matrix``.
    inverse, matrix : ndarray, shape (n, n)
        Exact numbers; without a matrix the outputs are left as they are.

    Returns
    -------
    tape : Tape
        Over the same inputs.
    rows : list
        Per output the coefficients by state, None of an output that is not linear in the states alone.
    bent : ndarray, shape (count, n)
        The sums of states y that go into operations other than sums: but for what is linear, f sees no others.
    """
    sums, n = _Sums(tape.inputs), len(inverse)
    given = [Sum({sums.graph.input(slot): _ONE}) for slot in range(len(tape.inputs))]
    state = {node: place - 1 for place in range(1, n + 1) for node in given[place].terms}
    given[1 : n + 1] = [sums.combined(zip(row, given[1 : n + 1])) for row in inverse.tolist()]
    found: list[Sum] = tape.evaluate(sums.arithmetic(), given)
    seen = {tuple(float(one.terms.get(node, 0)) for node in state) for one in sums.seen}
    bent = np.array(sorted(row for row in seen if any(row)), dtype=float).reshape(-1, n)
    if matrix is not None:
        m = len(found) // n
        found = [sums.combined(zip(row, found[k::m])) for row in matrix.tolist() for k in range(m)]
    rows = [
        {state[node]: float(c) for node, c in one.terms.items()}
        if one.constant == 0 and one.terms.keys() <= state.keys() else None
        for one in found
    ]  # fmt: skip
    return sums.graph.tape([sums.node(one) for one in found], tape.shape), rows, bent


def without_own(tape: Tape, states: int) -> tuple[Tape, list[float]]:
    """f - c x of a tape f over (t, states, ...) of shape (states,), and c: what f_i adds of x_i by itself."""
    sums = _Sums(tape.inputs)
    own = [sums.graph.input(slot) for slot in range(len(tape.inputs))]
    found: list[Sum] = tape.evaluate(sums.arithmetic(), [Sum({node: _ONE}) for node in own])
    slopes = [float(one.terms.get(own[1 + place], 0)) for place, one in enumerate(found)]
    rest = [
        Sum({node: c for node, c in one.terms.items() if node != own[1 + place]}, one.constant)
        for place, one in enumerate(found)
    ]  # fmt: skip
    return sums.graph.tape([sums.node(one) for one in rest], tape.shape), slopes


class _Sums:
    """The arithmetic of sums over a graph; ``seen`` are those that went into other operations."""

    def __init__(self, inputs: Sequence[str]) -> None:
        self.graph = Graph(inputs)
        self.seen: list[Sum] = []

    def combined(self, parts: Iterable[tuple[Any, Sum]]) -> Sum:
        """A sum of sums by factors that are floats."""
        terms: dict[int, Fraction] = {}
        constant = Fraction(0)
        kept = [(Fraction(factor), one) for factor, one in parts if factor]
        for factor, one in kept:
            constant += factor * one.constant
            for node, c in one.terms.items():
                terms[node] = terms.get(node, Fraction(0)) + factor * c
        terms = {node: c for node, c in terms.items() if c}
        if len(terms) <= _MOST and all(_is_float(c) for c in (constant, *terms.values())):
            return Sum(terms, constant)
        self.seen += [one for _, one in kept]
        total = self.graph.const(0.0)
        for factor, one in kept:
            total = self._plus(total, factor, self.node(one))
        return self._of(total)

    def node(self, one: Sum) -> int:
        """The node of a sum."""
        total = self.graph.const(0.0)
        for node, c in sorted(one.terms.items()):
            total = self._plus(total, c, node)
        return self._plus(total, _ONE, self.graph.const(float(one.constant)))

    def _plus(self, total: int, factor: Fraction, node: int) -> int:
        return self.graph.apply("add", total, self.graph.apply("mul", self.graph.const(float(factor)), node))

    def _of(self, node: int) -> Sum:
        value = self.graph.number(node)
        return Sum({node: _ONE}) if value is None else Sum({}, Fraction(value))

    def arithmetic(self) -> dict[str, Callable[..., Any]]:
        """What ``Tape.evaluate`` asks for."""
        plain = self.graph.arithmetic()

        def nonlinear(apply: Callable[..., int]) -> Callable[..., Sum]:
            def applied(*given: Any) -> Sum:
                self.seen += [x for x in given if isinstance(x, Sum)]
                return self._of(apply(*(self.node(x) if isinstance(x, Sum) else x for x in given)))

            return applied

        def product(a: Sum, b: Sum) -> Sum:
            for one, other in ((a, b), (b, a)):
                if not one.terms and one.constant:
                    return self.combined([(one.constant, other)])
            found: Sum = times(a, b)
            return found

        def ratio(a: Sum, b: Sum) -> Sum:
            exact = not b.terms and b.constant != 0 and _is_float(1 / b.constant)
            return self.combined([(1 / b.constant, a)]) if exact else over(a, b)

        table: dict[str, Callable[..., Any]] = {op: nonlinear(apply) for op, apply in plain.items()}
        times, over = table["mul"], table["div"]
        return table | {
            "const": lambda value: Sum({}, Fraction(value)),
            "add": lambda a, b: self.combined([(1, a), (1, b)]),
            "sub": lambda a, b: self.combined([(1, a), (-1, b)]),
            "neg": lambda a: self.combined([(-1, a)]),
            "mul": product,
            "div": ratio,
        }


def _is_float(value: Fraction) -> bool:
    try:
        return Fraction(float(value)) == value
    except OverflowError:
        return False


class _Quotients:
    """What values of a graph are once one of its inputs has divided them."""

    def __init__(self, graph: Graph, x: int) -> None:
        self.graph, self.x = graph, x
        self._factors: dict[int, int | None] = {x: graph.const(1.0)}
        self._found: dict[int, int] = {}

    def factor(self, node: int) -> int | None:
        """node / x without a division; None where x is no factor of it."""
        for part in _first_to_last(node, self._factors, self._factored_parts):
            self._factors[part] = self._factor(part)
        return self._factors[node]

    def _factored_parts(self, node: int) -> tuple[int, ...]:
        """What decides whether x is a factor of a node."""
        op, args, *_ = self.graph.nodes[node]
        return args if op in ("mul", "add", "sub") else args[:1] if op in ("div", "neg", "sq") else ()

    def _factor(self, node: int) -> int | None:
        graph, (op, args, value, _) = self.graph, self.graph.nodes[node]
        if op == "const" and value == 0:
            return node
        if op == "mul":
            for a, b in (args, args[::-1]):
                found = self.factor(a)
                if found is not None:
                    return graph.apply("mul", found, b)
        elif op in ("div", "neg"):
            found = self.factor(args[0])
            return None if found is None else graph.apply(op, found, *args[1:])
        elif op in ("add", "sub"):
            found, other = self.factor(args[0]), self.factor(args[1])
            return None if found is None or other is None else graph.apply(op, found, other)
        elif op == "sq":
            found = self.factor(args[0])
            return None if found is None else graph.apply("mul", found, args[0])
        elif op == "pow" and args[0] == self.x and value > 1:
            return graph.pow(self.x, value - 1) if value - 1 == int(value) - 1 else None
        return None

    def of(self, node: int) -> int:
        """node / x: of a sum term by term."""
        for part in _first_to_last(node, self._found, self._divided_parts):
            self._found[part] = self._of(part)
        return self._found[node]

    def _divided_parts(self, node: int) -> tuple[int, ...]:
        """What of a node is divided in its place."""
        op, args, *_ = self.graph.nodes[node]
        if self.factor(node) is not None or op not in ("add", "sub", "neg", "mul"):
            return ()
        if op != "mul":
            return args
        return next(((b,) for a, b in (args, args[::-1]) if self.graph.number(a) is not None), ())

    def _of(self, node: int) -> int:
        graph, (op, args, *_) = self.graph, self.graph.nodes[node]
        found = self.factor(node)
        if found is not None:
            return found
        if op in ("add", "sub"):
            return graph.apply(op, self.of(args[0]), self.of(args[1]))
        if op == "neg":
            return graph.apply("neg", self.of(args[0]))
        for a, b in (args, args[::-1]) if op == "mul" else ():
            if graph.number(a) is not None:
                return graph.apply("mul", a, self.of(b))
        return graph.apply("div", node, self.x)


def _first_to_last(node: int, known: Collection[int], parts: Callable[[int], tuple[int, ...]]) -> list[int]:
    """A node and its parts, and theirs, but for what is known: each after its own parts, which are earlier nodes.

    An expression may be deeper than calls can be.
    """
    found, left = set[int](), [node]
    while left:
        last = left.pop()
        if last not in found and last not in known:
            found.add(last)
            left += parts(last)
    return sorted(found)


def in_logarithms(
    dynamics: Tape, diffusion: Tape, allowed: Collection[int]
) -> tuple[tuple[int, ...], Tape, Tape] | None:
    """A model in the logarithms of those of the ``allowed`` states whose noise has the state as a factor.

    Parameters
    ----------
    dynamics, diffusion : Tape
        Over (t, states, ...), shape (n,), and over (t, states), shape (n, m).
    allowed : collection of int
        States that are positive.

    Returns
    -------
    tuple or None
        The states that are stated so, and dynamics and diffusion over the same inputs; None without such states.
    """
    graph, (n, m) = Graph(dynamics.inputs), diffusion.shape
    given = [graph.input(slot) for slot in range(len(dynamics.inputs))]
    rates = dynamics.evaluate(graph.arithmetic(), given)
    gains = diffusion.evaluate(graph.arithmetic(), given[: n + 1])
    places = []
    for i in sorted(allowed):
        quotients, row = _Quotients(graph, given[i + 1]), gains[i * m : (i + 1) * m]
        own = [factor for entry in row if (factor := quotients.factor(entry)) is not None]
        if len(own) < m or all(graph.number(entry) == 0 for entry in row):
            continue
        places.append(i)
        gains[i * m : (i + 1) * m] = own
        total = graph.const(0.0)
        for entry in own:
            total = graph.apply("add", total, graph.apply("sq", entry))
        rates[i] = graph.apply("sub", quotients.of(rates[i]), graph.apply("mul", graph.const(0.5), total))
    if not places:
        return None
    stated = graph.tape(rates, (n,)), graph.tape(gains, (n, m))
    return tuple(places), _exponentials(stated[0], places), _exponentials(stated[1], places, n + 1)


def _exponentials(tape: Tape, places: Sequence[int], count: int | None = None) -> Tape:
    """The tape with exp(x_i) for x_i, over the first ``count`` inputs."""
    graph = Graph(tape.inputs[:count])
    given = [graph.input(slot) for slot in range(len(graph.inputs))]
    given += [graph.const(0.0)] * (len(tape.inputs) - len(given))  # the noise knows no signals
    for i in places:
        given[i + 1] = graph.apply("exp", given[i + 1])
    return graph.tape(tape.evaluate(graph.arithmetic(), given), tape.shape)
