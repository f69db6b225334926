"""A tape in other coordinates, over the reals: sums are put together anew, so that what cancels is gone.

Every value is a sum of operations with exact coefficients for as long as these are floats; where they are not, its
parts are added as they stand. Interval arithmetic would not see that p2 - (p2 - a) is a.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
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
