"""The prover's table of operations: one row an operation, in which every reader of a tape has its column.

Names, numbers of arguments and which operations jump are the tape's own (``tape.ARITY``, ``tape.JUMPS``). The checker
believes nothing of this table; it has one of its own, ``checker/expressions/operations.py``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from certbound.problem.model.tape import Node
from certbound.rigor import arithmetic as ia
from certbound.rigor import elementary as iv
from certbound.rigor import series as ts
from certbound.rigor.arithmetic import Interval

__all__ = ["OPERATIONS", "Operation", "arithmetic", "enclosed", "undefined_where"]

Mask = NDArray[np.bool_]


class Builder(Protocol):
    """What derivatives are made with: ``graph.Graph``."""

    def apply(self, op: str, *args: int) -> int: ...
    def const(self, value: float) -> int: ...
    def pow(self, base: int, exponent: float) -> int: ...


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Operation:
    """What one operation means to each reader (``pow`` has its exponent as a further argument everywhere).

    Parameters
    ----------
    numpy : callable
        Its values on floats and arrays; as a NumPy function (a ufunc) it is what users write.
    kernel : str
        Its text in compiled kernels, which know ``math``, ``np.floor``, and sincos, atan2 and tanh of
        ``simulation/compiled/elementary.py``.
    interval : callable
        Encloses its range; of an undecided jump all values that it may take.
    series : callable
        Taylor coefficients: its arguments' series and the highest order.
    slopes : tuple of callable
        For each argument the derivative by it, as a node: ``slope(graph, *arguments, node itself)``. Empty where all
        derivatives are 0 beside the jumps.
    undefined : callable, optional
        Where it is undefined somewhere on its arguments.
    jump : callable, optional
        Where it may jump: ``jump(its range, *arguments)``.
    kink : callable, optional
        Where its slope may jump.
    at_zero : float, optional
        Its exact value at 0, if that is a float and is to be folded.
    in_files : bool
        Whether problem files may call it by its name.
    """

    numpy: Callable[..., Any]
    kernel: str
    interval: Callable[..., Interval]
    series: Callable[..., ts.Series]
    slopes: tuple[Callable[..., int], ...] = ()
    undefined: Callable[..., Mask] | None = None
    jump: Callable[..., Mask] | None = None
    kink: Callable[..., Mask] | None = None
    at_zero: float | None = None
    in_files: bool = False


def arithmetic(column: Literal["numpy", "interval"]) -> dict[str, Callable[..., Any]]:
    """One column as the arithmetic that ``Tape.evaluate`` takes."""
    const: Callable[..., Any] = float if column == "numpy" else Interval.point
    return {"const": const} | {op: getattr(row, column) for op, row in OPERATIONS.items()}


def enclosed(node: Node, args: Sequence[Interval]) -> Interval:
    """The range of a node that is no input, given its arguments' ranges; x*x and x - x know that they are one x."""
    if node.op == "const":
        return Interval.point(node.value)
    if len(node.args) == 2 and node.args[0] == node.args[1]:
        if node.op == "mul":
            return iv.sq(args[0])
        if node.op == "sub":
            return Interval.point(np.zeros(args[0].shape))
    return OPERATIONS[node.op].interval(*operands(node, args))


def undefined_where(node: Node, args: Sequence[Interval]) -> Mask | None:
    """The members of a batch on which a node is undefined somewhere; None where it never is."""
    row = OPERATIONS.get(node.op)
    return None if row is None or row.undefined is None else np.asarray(row.undefined(*operands(node, args)))


def operands(node: Node, args: Sequence[Any]) -> tuple[Any, ...]:
    """The arguments that the table's functions take."""
    return (*args, node.value) if node.op == "pow" else tuple(args)


def _truth(comparison: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    return lambda a, b: np.asarray(comparison(a, b), dtype=float)[()]


def _holds_zero(x: Interval) -> Mask:
    return np.asarray((x.lo <= 0) & (x.hi >= 0))


def _overlap(x: Interval, y: Interval) -> Mask:
    return np.asarray((x.lo <= y.hi) & (y.lo <= x.hi))


def _split(value: Interval, *_: Interval) -> Mask:
    return np.asarray(value.lo != value.hi)


def _arc_slope(g: Builder, numerator: float, a: int) -> int:
    root = g.apply("sqrt", g.apply("sub", g.const(1.0), g.apply("sq", a)))
    return g.apply("div", g.const(numerator), root)


def _angle_slope(g: Builder, numerator: Callable[[], int], a: int, b: int) -> int:
    squares = g.apply("add", g.apply("sq", a), g.apply("sq", b))
    return g.apply("div", numerator(), squares)


def _above(g: Builder, a: int, b: int) -> int:
    """(1 + sign(a - b))/2, the derivative of max(a, b) by a."""
    return g.apply("mul", g.const(0.5), g.apply("add", g.const(1.0), g.apply("kink", g.apply("sub", a, b))))


def _below(g: Builder, a: int, b: int) -> int:
    above = _above(g, a, b)
    return g.apply("sub", g.const(1.0), above)


def _power_slope(g: Builder, a: int, exponent: float, node: int) -> int:
    if abs(exponent) < 2.0**52 and exponent * 2 == int(exponent * 2):  # the lower exponent is a float
        return g.apply("mul", g.const(exponent), g.pow(a, exponent - 1.0))
    return g.apply("mul", g.const(exponent), g.apply("div", node, a))


def _step(numpy: Callable[..., Any], kernel: str, interval: Callable[..., Interval]) -> Operation:
    """An operation that jumps and is constant beside that."""
    return Operation(numpy=numpy, kernel=kernel, interval=interval, series=ts.jump(interval), jump=_split)


_SIGN = "(1.0 if {0} > 0.0 else -1.0 if {0} < 0.0 else {0})"

OPERATIONS: dict[str, Operation] = {
    "neg": Operation(
        numpy=np.negative, kernel="-{0}", interval=Interval.__neg__, series=lambda x, order: [-value for value in x],
        slopes=(lambda g, a, y: g.const(-1.0),),
    ),
    "sq": Operation(
        numpy=np.square, kernel="{0} * {0}", interval=iv.sq, series=ts.sq,
        slopes=(lambda g, a, y: g.apply("mul", g.const(2.0), a),),
    ),
    "sqrt": Operation(
        numpy=np.sqrt, kernel="math.sqrt({0})", interval=iv.sqrt, series=ts.sqrt, in_files=True,
        undefined=lambda x: x.lo < 0, slopes=(lambda g, a, y: g.apply("div", g.const(0.5), y),),
    ),
    "exp": Operation(
        numpy=np.exp, kernel="math.exp({0})", interval=iv.exp, series=ts.exp, in_files=True, at_zero=1.0,
        slopes=(lambda g, a, y: y,),
    ),
    "log": Operation(
        numpy=np.log, kernel="math.log({0})", interval=iv.log, series=ts.log, in_files=True,
        undefined=lambda x: x.lo <= 0, slopes=(lambda g, a, y: g.apply("div", g.const(1.0), a),),
    ),
    "sin": Operation(
        numpy=np.sin, kernel="math.sin({0})", interval=iv.sin, series=ts.sin, in_files=True, at_zero=0.0,
        slopes=(lambda g, a, y: g.apply("cos", a),),
    ),
    "cos": Operation(
        numpy=np.cos, kernel="math.cos({0})", interval=iv.cos, series=ts.cos, in_files=True, at_zero=1.0,
        slopes=(lambda g, a, y: g.apply("neg", g.apply("sin", a)),),
    ),
    "tan": Operation(
        numpy=np.tan, kernel="math.tan({0})", interval=iv.tan, series=ts.tan, in_files=True, at_zero=0.0,
        undefined=iv.tan_undefined, slopes=(lambda g, a, y: g.apply("add", g.const(1.0), g.apply("sq", y)),),
    ),
    "asin": Operation(
        numpy=np.arcsin, kernel="math.asin({0})", interval=iv.asin, series=ts.asin, in_files=True, at_zero=0.0,
        undefined=iv.beyond_one, slopes=(lambda g, a, y: _arc_slope(g, 1.0, a),),
    ),
    "acos": Operation(
        numpy=np.arccos, kernel="math.acos({0})", interval=iv.acos, series=ts.acos, in_files=True,
        undefined=iv.beyond_one, slopes=(lambda g, a, y: _arc_slope(g, -1.0, a),),
    ),
    "atan": Operation(
        numpy=np.arctan, kernel="math.atan({0})", interval=iv.atan, series=ts.atan, in_files=True, at_zero=0.0,
        slopes=(lambda g, a, y: g.apply("div", g.const(1.0), g.apply("add", g.const(1.0), g.apply("sq", a))),),
    ),
    "sinh": Operation(
        numpy=np.sinh, kernel="math.sinh({0})", interval=iv.sinh, series=ts.sinh, in_files=True, at_zero=0.0,
        slopes=(lambda g, a, y: g.apply("cosh", a),),
    ),
    "cosh": Operation(
        numpy=np.cosh, kernel="math.cosh({0})", interval=iv.cosh, series=ts.cosh, in_files=True, at_zero=1.0,
        slopes=(lambda g, a, y: g.apply("sinh", a),),
    ),
    "tanh": Operation(
        numpy=np.tanh, kernel="tanh({0})", interval=iv.tanh, series=ts.tanh, in_files=True, at_zero=0.0,
        slopes=(lambda g, a, y: g.apply("sub", g.const(1.0), g.apply("sq", y)),),
    ),
    "abs": Operation(
        numpy=np.abs, kernel="abs({0})", interval=iv.abs_, series=ts.abs_, in_files=True, kink=_holds_zero,
        slopes=(lambda g, a, y: g.apply("kink", a),),
    ),
    "kink": Operation(numpy=np.sign, kernel=_SIGN, interval=iv.kink, series=ts.kink, kink=_holds_zero),
    "sign": _step(np.sign, _SIGN, iv.sign),
    "floor": _step(np.floor, "np.floor({0})", iv.floor),
    "not": _step(
        lambda a: np.asarray(np.equal(a, 0), dtype=float)[()], "(1.0 if {0} == 0.0 else 0.0)", iv.not_
    ),
    "pow": Operation(
        numpy=lambda base, exponent: np.power(np.asarray(base, dtype=float), exponent), kernel="{0} ** {1}",
        interval=iv.pow_, series=ts.power, undefined=iv.power_undefined, slopes=(_power_slope,),
    ),
    "add": Operation(
        numpy=np.add, kernel="{0} + {1}", interval=ia.add, series=ts.add,
        slopes=(lambda g, a, b, y: g.const(1.0), lambda g, a, b, y: g.const(1.0)),
    ),
    "sub": Operation(
        numpy=np.subtract, kernel="{0} - {1}", interval=ia.subtract, series=ts.subtract,
        slopes=(lambda g, a, b, y: g.const(1.0), lambda g, a, b, y: g.const(-1.0)),
    ),
    "mul": Operation(
        numpy=np.multiply, kernel="{0} * {1}", interval=ia.multiply, series=ts.product,
        slopes=(lambda g, a, b, y: b, lambda g, a, b, y: a),
    ),
    "div": Operation(
        numpy=np.divide, kernel="{0} / {1}", interval=ia.divide, series=ts.divide,
        undefined=lambda x, y: np.broadcast_arrays(_holds_zero(y), x.lo)[0],
        slopes=(
            lambda g, a, b, y: g.apply("div", g.const(1.0), b),
            lambda g, a, b, y: g.apply("neg", g.apply("div", y, b)),
        ),
    ),
    "atan2": Operation(
        numpy=np.arctan2, kernel="atan2({0}, {1})", interval=iv.atan2, series=ts.atan2, in_files=True,
        undefined=iv.across_cut, jump=lambda _, y, x: iv.across_cut(y, x),
        slopes=(
            lambda g, a, b, y: _angle_slope(g, lambda: b, a, b),
            lambda g, a, b, y: _angle_slope(g, lambda: g.apply("neg", a), a, b),
        ),
    ),
    "hypot": Operation(
        numpy=np.hypot, kernel="math.hypot({0}, {1})", interval=iv.hypot, series=ts.hypot, in_files=True,
        slopes=(lambda g, a, b, y: g.apply("div", a, y), lambda g, a, b, y: g.apply("div", b, y)),
    ),
    "min": Operation(
        numpy=np.minimum, kernel="({0} if {0} < {1} or {0} != {0} else {1})", interval=iv.minimum, series=ts.minimum,
        in_files=True, kink=_overlap,
        slopes=(lambda g, a, b, y: _below(g, a, b), lambda g, a, b, y: _above(g, a, b)),
    ),
    "max": Operation(
        numpy=np.maximum, kernel="({0} if {0} > {1} or {0} != {0} else {1})", interval=iv.maximum, series=ts.maximum,
        in_files=True, kink=_overlap,
        slopes=(lambda g, a, b, y: _above(g, a, b), lambda g, a, b, y: _below(g, a, b)),
    ),
    "lt": _step(_truth(np.less), "(1.0 if {0} < {1} else 0.0)", iv.less),
    "le": _step(_truth(np.less_equal), "(1.0 if {0} <= {1} else 0.0)", iv.less_equal),
    "eq": _step(_truth(np.equal), "(1.0 if {0} == {1} else 0.0)", iv.equal),
    "ne": _step(_truth(np.not_equal), "(1.0 if {0} != {1} else 0.0)", lambda x, y: iv.not_(iv.equal(x, y))),
    "and": _step(_truth(np.logical_and), "(1.0 if {0} != 0.0 and {1} != 0.0 else 0.0)", iv.and_),
    "or": _step(_truth(np.logical_or), "(1.0 if {0} != 0.0 or {1} != 0.0 else 0.0)", iv.or_),
    "if_else_zero": Operation(
        numpy=lambda c, y: np.where(np.not_equal(c, 0), y, 0.0)[()], kernel="({1} if {0} != 0.0 else 0.0)",
        interval=iv.if_else_zero, series=ts.if_else_zero, jump=lambda _, c, y: _holds_zero(c) & (c.lo != c.hi),
    ),
}  # fmt: skip
"""Operation name to its row (``const`` and ``input``, which compute nothing, have none)."""
