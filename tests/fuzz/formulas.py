"""Formulas of a random model: one tree with two readers, NumPy (also traced) and the text of a problem file."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

__all__ = ["JUMPS", "KINKS", "Formula", "apply", "number", "symbol"]


def _where(a: Any, b: Any, c: Any) -> Any:
    return np.where(a > 0, b, c)


_OPERATIONS: dict[str, tuple[Callable[..., Any], str]] = {
    "add": (operator.add, "({} + {})"),
    "sub": (operator.sub, "({} - {})"),
    "mul": (operator.mul, "{}*{}"),
    "div": (operator.truediv, "{}/({})"),
    "pow": (operator.pow, "({})**{}"),
    "neg": (operator.neg, "(-{})"),
    "min": (np.minimum, "min({}, {})"),
    "max": (np.maximum, "max({}, {})"),
    "hypot": (np.hypot, "hypot({}, {})"),
    "atan2": (np.arctan2, "atan2({}, {})"),
    "abs": (np.abs, "abs({})"),
    "asin": (np.arcsin, "asin({})"),
    "acos": (np.arccos, "acos({})"),
    "atan": (np.arctan, "atan({})"),
    "where": (_where, "where({} > 0, {}, {})"),
    "sign": (np.sign, "sign({})"),
    "floor": (np.floor, "floor({})"),
}
for _name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "sqrt"):
    _OPERATIONS[_name] = (getattr(np, _name), _name + "({})")

JUMPS = frozenset({"where", "sign", "floor"})
"""Operations that jump."""
KINKS = frozenset({"abs", "min", "max", "hypot"})


@dataclass(frozen=True)
class Formula:
    """An operation on formulas; ``symbol`` and ``number`` are the leaves."""

    op: str
    args: tuple[Formula, ...] = ()
    leaf: str | float = 0.0

    def value(self, names: Mapping[str, Any]) -> Any:
        """Its value where the symbols have these values: arrays, or traced scalars."""
        if self.op == "number":
            return self.leaf
        if self.op == "symbol":
            return names[str(self.leaf)]
        return _OPERATIONS[self.op][0](*(argument.value(names) for argument in self.args))

    def text(self, names: Mapping[str, str]) -> str:
        """The expression of a problem file."""
        if self.op == "number":
            return f"({self.leaf!r})" if float(self.leaf) < 0 else repr(self.leaf)
        if self.op == "symbol":
            return names[str(self.leaf)]
        return _OPERATIONS[self.op][1].format(*(argument.text(names) for argument in self.args))

    def operations(self) -> set[str]:
        """Names of the operations used."""
        return {self.op}.union(*(argument.operations() for argument in self.args))

    def symbols(self) -> set[str]:
        """Names of the symbols used."""
        own = {str(self.leaf)} if self.op == "symbol" else set()
        return own.union(*(argument.symbols() for argument in self.args))

    def __add__(self, other: Any) -> Formula:
        return apply("add", self, other)

    def __radd__(self, other: Any) -> Formula:
        return apply("add", other, self)

    def __sub__(self, other: Any) -> Formula:
        return apply("sub", self, other)

    def __rsub__(self, other: Any) -> Formula:
        return apply("sub", other, self)

    def __mul__(self, other: Any) -> Formula:
        return apply("mul", self, other)

    def __rmul__(self, other: Any) -> Formula:
        return apply("mul", other, self)

    def __truediv__(self, other: Any) -> Formula:
        return apply("div", self, other)

    def __rtruediv__(self, other: Any) -> Formula:
        return apply("div", other, self)

    def __pow__(self, exponent: Any) -> Formula:
        return apply("pow", self, exponent)

    def __neg__(self) -> Formula:
        return apply("neg", self)


def number(value: float) -> Formula:
    """A constant."""
    return Formula("number", leaf=float(value))


def symbol(name: str) -> Formula:
    """``t``, a state ``x0``, an input ``u0`` or a disturbance ``d0``."""
    return Formula("symbol", leaf=name)


def apply(op: str, *args: Any) -> Formula:
    """An operation on formulas and numbers."""
    return Formula(op, tuple(a if isinstance(a, Formula) else number(float(a)) for a in args))
