"""SymPy expressions to tapes (SymPy is imported on use; certbound does not depend on it)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any

from certbound.problem.model import ARITY, Graph, Tape

_RENAMED = {"Abs": "abs", "Not": "not"}
_FOLDED = {"Max": "max", "Min": "min", "And": "and", "Or": "or"}
_COMPARISONS = {
    "StrictLessThan": ("lt", False), "LessThan": ("le", False), "StrictGreaterThan": ("lt", True),
    "GreaterThan": ("le", True), "Equality": ("eq", False), "Unequality": ("ne", False),
}  # fmt: skip


def from_sympy(expression: Any, names: Sequence[str], *, matrix: bool = False) -> Tape:
    """The tape of a SymPy expression, matrix, or list of expressions.

    Rational numbers stay exact quotients; pi and E become the nearest floats, as in problem files. A function of time
    such as ``angle(t)`` counts as the symbol of its name. Column vectors give shape (n,) unless ``matrix``, other
    matrices (rows, columns). A symbol that is none of ``names``, or a function without a counterpart on a tape, is a
    ValueError.
    """
    import sympy

    entries = sympy.Matrix(expression if hasattr(expression, "shape") else _rows(expression))
    rows, columns = entries.shape
    reader = _Reader(names)
    outputs = [reader.read(sympy.sympify(entries[i, j])) for i in range(rows) for j in range(columns)]
    shape = (rows,) if columns == 1 and not matrix else (rows, columns)
    return reader.graph.tape(outputs, shape)


def _rows(expression: Any) -> list[Any]:
    return list(expression) if isinstance(expression, (list, tuple)) else [expression]


class _Reader:
    """One pass over expressions; equal subexpressions are read once."""

    def __init__(self, names: Sequence[str]) -> None:
        self.graph = Graph(names)
        self.slots = {name: slot for slot, name in enumerate(names)}
        self.known: dict[Any, int] = {}

    def read(self, expr: Any) -> int:
        """The node of an expression."""
        if expr not in self.known:
            self.known[expr] = self._node(expr)
        return self.known[expr]

    def _node(self, expr: Any) -> int:
        kind = type(expr).__name__
        if expr.is_Symbol or (not expr.args and expr.is_symbol):
            return self._symbol(str(expr))
        if expr.is_Function and _undefined(expr):
            return self._symbol(str(expr.func))
        if expr.is_number and not expr.args:
            return self._number(expr)
        graph, args = self.graph, expr.args
        if expr.is_Add or expr.is_Mul:
            return self._fold("add" if expr.is_Add else "mul", args)
        if expr.is_Pow:
            return self._power(*args)
        if kind in _FOLDED:
            return self._fold(_FOLDED[kind], args)
        name = _RENAMED.get(kind, kind)
        if ARITY.get(name) == len(args):
            return graph.apply(name, *map(self.read, args))
        if kind in _COMPARISONS:
            op, swapped = _COMPARISONS[kind]
            pair = [self.read(arg) for arg in (reversed(args) if swapped else args)]
            return graph.apply(op, *pair)
        if kind == "Piecewise":
            return self._piecewise(args)
        raise ValueError(f"`f` uses {kind}, which a model cannot hold; write it with elementary functions.")

    def _symbol(self, name: str) -> int:
        if name not in self.slots:
            raise ValueError(
                f"`f` contains the symbol {name}, which is none of {', '.join(self.slots)}; substitute its number "
                "first (f.subs), or name it among the states, inputs or disturbances."
            )
        return self.graph.input(self.slots[name])

    def _number(self, expr: Any) -> int:
        if expr.is_Rational:
            top, bottom = float(expr.p), float(expr.q)
            if int(top) == int(expr.p) and int(bottom) == int(expr.q):
                const = self.graph.const
                return const(top) if bottom == 1 else self.graph.apply("div", const(top), const(bottom))
        if not expr.is_finite or expr.is_real is False:
            raise ValueError(f"`f` must be real and finite, got {expr}; mend the expression.")
        return self.graph.const(float(expr))

    def _fold(self, op: str, args: Sequence[Any]) -> int:
        first, *rest = (self.read(arg) for arg in args)
        for node in rest:
            first = self.graph.apply(op, first, node)
        return first

    def _power(self, base: Any, exponent: Any) -> int:
        graph = self.graph
        if str(base) == "E":
            return graph.apply("exp", self.read(exponent))
        exact = exponent.is_Rational and Fraction(float(exponent)) == Fraction(int(exponent.p), int(exponent.q))
        if exact or exponent.is_Float:
            return graph.pow(self.read(base), float(exponent))
        return graph.apply("exp", graph.apply("mul", self.read(exponent), graph.apply("log", self.read(base))))

    def _piecewise(self, args: Sequence[Any]) -> int:
        graph = self.graph
        if args[-1][1] != True:  # noqa: E712  (SymPy's own true)
            raise ValueError("`f` must define Piecewise everywhere; end it with (value, True).")
        result = self.read(args[-1][0])
        choose: Callable[..., int] = graph.apply
        for value, condition in reversed(args[:-1]):
            holds = self.read(condition)
            chosen = choose("if_else_zero", holds, self.read(value))
            result = graph.apply("add", chosen, choose("if_else_zero", graph.apply("not", holds), result))
        return result


def _undefined(expr: Any) -> bool:
    from sympy.core.function import AppliedUndef

    return isinstance(expr, AppliedUndef)
