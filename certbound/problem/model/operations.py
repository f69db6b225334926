"""The prover's table of operations: one row an operation, in which every reader of a tape has its column.

Names, numbers of arguments and which operations jump are the tape's own (``tape.ARITY``, ``tape.JUMPS``). The checker
believes nothing of this table; it has one of its own, ``checker/expressions/operations.py``.
"""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, Protocol

import numpy as np

from certbound.arrays import Mask
from certbound.problem.model import network_rows as nets
from certbound.problem.model.tape import Node
from certbound.rigor import arithmetic as ia
from certbound.rigor import elementary as iv
from certbound.rigor import series as ts
from certbound.rigor.arithmetic import Interval


class Builder(Protocol):
    """What derivatives are made with: ``graph.Graph``."""

    def apply(self, op: str, *args: int) -> int: ...
    def const(self, value: float) -> int: ...
    def pow(self, base: int, exponent: float) -> int: ...


@dataclass(frozen=True, eq=False, slots=True)
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
    return {"const": const} | {op: getattr(row, column) for op, row in ROWS.items()}


def enclosed(node: Node, args: Sequence[Interval]) -> Interval:
    """The range of a node that is no input, given its arguments' ranges; x*x and x - x know that they are one x."""
    if node.op == "const":
        return Interval.point(node.value)
    if len(node.args) == 2 and node.args[0] == node.args[1]:
        if node.op == "mul":
            return iv.sq(args[0])
        if node.op == "sub":
            return Interval.point(np.zeros(args[0].shape))
    return ROWS[node.op].interval(*operands(node, args))


def undefined_where(node: Node, args: Sequence[Interval]) -> Mask | None:
    """The members of a batch on which a node is undefined somewhere; None where it never is."""
    row = ROWS.get(node.op)
    return None if row is None or row.undefined is None else np.asarray(row.undefined(*operands(node, args)))


def operands(node: Node, args: Sequence[Any]) -> tuple[Any, ...]:
    """The arguments that the table's functions take."""
    if node.part is not None:
        return (*args, node.part)
    return (*args, node.value) if node.op == "pow" else tuple(args)


def jumps_where(node: Node, value: Interval, args: Sequence[Interval]) -> Mask | None:
    """The members of a batch on which a node of range ``value`` may jump; None where it never does."""
    row = ROWS.get(node.op)
    return None if row is None or row.jump is None else np.asarray(row.jump(value, *operands(node, args)))


def kinks_where(node: Node, args: Sequence[Interval]) -> Mask | None:
    """The members of a batch on which the slope of a node may jump; None where it never does."""
    row = ROWS.get(node.op)
    return None if row is None or row.kink is None else np.asarray(row.kink(*operands(node, args)))


def slope_by(node: Node, position: int) -> Callable[..., int] | None:
    """How the derivative of a node by one of its arguments is made; None where all are 0."""
    if node.part is not None:
        return partial(nets.slope, position)
    slopes = ROWS[node.op].slopes
    return slopes[position] if slopes else None


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
    if a == b:  # the two slopes cancel: atan2(a, a) is constant on either side of 0
        return g.const(0.0)
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


def _step(
    numpy: Callable[..., Any], kernel: str, interval: Callable[..., Interval], *, in_files: bool = False
) -> Operation:
    """An operation that jumps and is constant beside that."""
    return Operation(numpy, kernel, interval, ts.jump(interval), jump=_split, in_files=in_files)


def _function(
    numpy: Callable[..., Any], kernel: str, interval: Callable[..., Interval], series: Callable[..., ts.Series],
    slope: Callable[..., int], *, undefined: Callable[..., Mask] | None = None, kink: Callable[..., Mask] | None = None,
    at_zero: float | None = None,
) -> Operation:
    """An elementary function of one argument, which problem files may call."""
    return Operation(
        numpy, kernel, interval, series, (slope,), undefined=undefined, kink=kink, at_zero=at_zero, in_files=True
    )


_SIGN = "(1.0 if {0} > 0.0 else -1.0 if {0} < 0.0 else {0})"

OPERATIONS: dict[str, Operation] = {
    "neg": Operation(
        np.negative, "-{0}", Interval.__neg__, lambda x, order: [-value for value in x],
        (lambda g, a, y: g.const(-1.0),),
    ),
    "sq": Operation(np.square, "{0} * {0}", iv.sq, ts.sq, (lambda g, a, y: g.apply("mul", g.const(2.0), a),)),
    "sqrt": _function(
        np.sqrt, "math.sqrt({0})", iv.sqrt, ts.sqrt,
        lambda g, a, y: g.apply("div", g.const(0.5), y), undefined=lambda x: x.lo < 0,
    ),
    "exp": _function(np.exp, "math.exp({0})", iv.exp, ts.exp, lambda g, a, y: y, at_zero=1.0),
    "log": _function(
        np.log, "math.log({0})", iv.log, ts.log,
        lambda g, a, y: g.apply("div", g.const(1.0), a), undefined=lambda x: x.lo <= 0,
    ),
    "sin": _function(
        np.sin, "math.sin({0})", iv.sin, lambda x, order: ts.circular(x, order)[0],
        lambda g, a, y: g.apply("cos", a), at_zero=0.0,
    ),
    "cos": _function(
        np.cos, "math.cos({0})", iv.cos, lambda x, order: ts.circular(x, order)[1],
        lambda g, a, y: g.apply("neg", g.apply("sin", a)), at_zero=1.0,
    ),
    "tan": _function(
        np.tan, "math.tan({0})", iv.tan, ts.tan,
        lambda g, a, y: g.apply("add", g.const(1.0), g.apply("sq", y)), at_zero=0.0, undefined=iv.tan_undefined,
    ),
    "asin": _function(
        np.arcsin, "math.asin({0})", iv.asin, ts.asin,
        lambda g, a, y: _arc_slope(g, 1.0, a), at_zero=0.0, undefined=iv.beyond_one,
    ),
    "acos": _function(
        np.arccos, "math.acos({0})", iv.acos, ts.acos, lambda g, a, y: _arc_slope(g, -1.0, a), undefined=iv.beyond_one,
    ),
    "atan": _function(
        np.arctan, "math.atan({0})", iv.atan, ts.atan,
        lambda g, a, y: g.apply("div", g.const(1.0), g.apply("add", g.const(1.0), g.apply("sq", a))), at_zero=0.0,
    ),
    "sinh": _function(
        np.sinh, "math.sinh({0})", iv.sinh, lambda x, order: ts.hyperbolic(x, order)[0],
        lambda g, a, y: g.apply("cosh", a), at_zero=0.0,
    ),
    "cosh": _function(
        np.cosh, "math.cosh({0})", iv.cosh, lambda x, order: ts.hyperbolic(x, order)[1],
        lambda g, a, y: g.apply("sinh", a), at_zero=1.0,
    ),
    "tanh": _function(
        np.tanh, "tanh({0})", iv.tanh, ts.tanh,
        lambda g, a, y: g.apply("sub", g.const(1.0), g.apply("sq", y)), at_zero=0.0,
    ),
    "abs": _function(np.abs, "abs({0})", iv.abs_, ts.abs_, lambda g, a, y: g.apply("kink", a), kink=_holds_zero),
    "kink": Operation(np.sign, _SIGN, iv.kink, ts.kink, kink=_holds_zero),
    "sign": _step(np.sign, _SIGN, iv.sign, in_files=True),
    "floor": _step(np.floor, "np.floor({0})", iv.floor, in_files=True),
    "not": _step(lambda a: np.asarray(np.equal(a, 0), dtype=float)[()], "(1.0 if {0} == 0.0 else 0.0)", iv.not_),
    "pow": Operation(
        lambda base, exponent: np.power(np.asarray(base, dtype=float), exponent), "{0} ** {1}", iv.pow_, ts.power,
        (_power_slope,), undefined=iv.power_undefined,
    ),
    "add": Operation(
        np.add, "{0} + {1}", ia.add, ts.add, (lambda g, a, b, y: g.const(1.0), lambda g, a, b, y: g.const(1.0)),
    ),
    "sub": Operation(
        np.subtract, "{0} - {1}", ia.subtract, ts.subtract,
        (lambda g, a, b, y: g.const(1.0), lambda g, a, b, y: g.const(-1.0)),
    ),
    "mul": Operation(np.multiply, "{0} * {1}", ia.multiply, ts.product, (lambda g, a, b, y: b, lambda g, a, b, y: a)),
    "div": Operation(
        np.divide, "{0} / {1}", ia.divide, ts.divide,
        (lambda g, a, b, y: g.apply("div", g.const(1.0), b), lambda g, a, b, y: g.apply("neg", g.apply("div", y, b))),
        undefined=lambda x, y: np.broadcast_arrays(_holds_zero(y), x.lo)[0],
    ),
    "atan2": Operation(
        np.arctan2, "atan2({0}, {1})", iv.atan2, ts.atan2,
        (
            lambda g, a, b, y: _angle_slope(g, lambda: b, a, b),
            lambda g, a, b, y: _angle_slope(g, lambda: g.apply("neg", a), a, b),
        ), in_files=True, undefined=iv.across_cut, jump=lambda _, y, x: iv.across_cut(y, x),
    ),
    "hypot": Operation(
        np.hypot, "math.hypot({0}, {1})", iv.hypot, ts.hypot,
        (lambda g, a, b, y: g.apply("div", a, y), lambda g, a, b, y: g.apply("div", b, y)), in_files=True,
    ),
    "min": Operation(
        np.minimum, "({0} if {0} < {1} or {0} != {0} else {1})", iv.minimum, ts.minimum,
        (lambda g, a, b, y: _below(g, a, b), lambda g, a, b, y: _above(g, a, b)), in_files=True, kink=_overlap,
    ),
    "max": Operation(
        np.maximum, "({0} if {0} > {1} or {0} != {0} else {1})", iv.maximum, ts.maximum,
        (lambda g, a, b, y: _above(g, a, b), lambda g, a, b, y: _below(g, a, b)), in_files=True, kink=_overlap,
    ),
    "lt": _step(_truth(np.less), "(1.0 if {0} < {1} else 0.0)", iv.less),
    "le": _step(_truth(np.less_equal), "(1.0 if {0} <= {1} else 0.0)", iv.less_equal),
    "eq": _step(_truth(np.equal), "(1.0 if {0} == {1} else 0.0)", iv.equal),
    "ne": _step(_truth(np.not_equal), "(1.0 if {0} != {1} else 0.0)", lambda x, y: iv.not_(iv.equal(x, y))),
    "and": _step(_truth(np.logical_and), "(1.0 if {0} != 0.0 and {1} != 0.0 else 0.0)", iv.and_),
    "or": _step(_truth(np.logical_or), "(1.0 if {0} != 0.0 or {1} != 0.0 else 0.0)", iv.or_),
    "if_else_zero": Operation(
        lambda c, y: np.where(np.not_equal(c, 0), y, 0.0)[()], "({1} if {0} != 0.0 else 0.0)", iv.if_else_zero,
        ts.if_else_zero, jump=lambda _, c, y: _holds_zero(c) & (c.lo != c.hi),
    ),
}  # fmt: skip
"""Operation name to its row (``const`` and ``input``, which compute nothing, have none)."""

_PARTS: dict[str, Operation] = {
    "network": Operation(nets.numpy, "", nets.interval, nets.series),
    "bent": Operation(nets.numpy, "", nets.interval, nets.series, kink=nets.kinked),
    "jumping": Operation(nets.numpy, "", nets.interval, nets.series, jump=nets.jumps),
}
ROWS: Mapping[str, Operation] = ChainMap(OPERATIONS, _PARTS)
"""The same with the parts of networks, which have as many arguments as their network and the part as a last one."""
