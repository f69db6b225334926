"""The checker's table of operations: one row an operation, in which every kind of evaluation has its column.

It is written anew, with nothing of the prover's table. A tape with an operation that has no row here is refused.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from flint import arb

from certbound.checker.expressions import arithmetic as balls
from certbound.checker.expressions import series as ts
from certbound.checker.expressions import taylor as tm


class Builder(Protocol):
    """What derivatives are made with: ``graph.Graph``, which leaves out what is exactly 0."""

    def apply(self, op: str, *args: int, value: float = 0.0) -> int: ...
    def const(self, value: float) -> int: ...
    def neg(self, a: int) -> int: ...
    def add(self, a: int, b: int) -> int: ...
    def sub(self, a: int, b: int) -> int: ...
    def mul(self, a: int, b: int) -> int: ...
    def div(self, a: int, b: int) -> int: ...
    def is_const(self, index: int, value: float) -> bool: ...


@dataclass(frozen=True, eq=False, slots=True)
class Operation:
    """What one operation means to each evaluation (``pow`` has its exponent as a last argument everywhere).

    Parameters
    ----------
    ball : callable
        Encloses its range over balls; raises ``Undecided`` where it may jump, gives no number where it is undefined.
    series : callable
        Taylor coefficients in time from those of its arguments, all of one length.
    slope : callable, optional
        The derivative as a node: ``slope(graph, node itself, *arguments, *their derivatives)``; None where it is 0
        beside the jumps.
    model : callable, optional
        Its second-order model over a box, None where it is not defined; without it the operation is a step, constant
        where it is decided.
    partial : bool
        Whether it is undefined for some numbers.
    """

    ball: Callable[..., arb]
    series: Callable[..., ts.Series]
    slope: Callable[..., int] | None = None
    model: Callable[..., tm.Model | None] | None = None
    partial: bool = False


def is_partial(op: str) -> bool:
    """Whether an operation is undefined for some numbers."""
    return op in OPERATIONS and OPERATIONS[op].partial


def function(
    ball: Callable[[arb], arb], series: Callable[[ts.Series], ts.Series], outer: Callable[..., int],
    derivatives: Callable[[arb, arb], tuple[arb, arb, arb, arb]], *, partial: bool = False,
) -> Operation:
    """A smooth function of one variable; ``outer(graph, node itself, argument)`` is its derivative as a node."""
    return Operation(ball, series, _chain(outer), tm.smooth(derivatives), partial)


def _chain(outer: Callable[..., int]) -> Callable[..., int]:
    return lambda g, y, a, da: g.mul(outer(g, y, a), da)


def _step(ball: Callable[..., arb]) -> Operation:
    return Operation(ball, ts.step(ball))


def _arc_slope(g: Builder, numerator: float, a: int) -> int:
    return g.div(g.const(numerator), g.apply("sqrt", g.sub(g.const(1.0), g.apply("sq", a))))


def _angle_slope(g: Builder, y: int, a: int, b: int, da: int, db: int) -> int:
    squares = g.add(g.apply("sq", a), g.apply("sq", b))
    return g.div(g.sub(g.mul(b, da), g.mul(a, db)), squares)


def _larger_slope(g: Builder, y: int, a: int, b: int, da: int, db: int, *, smaller: bool = False) -> int:
    half, step = g.const(0.5), g.apply("kink", g.apply("sub", a, b))
    mean = g.mul(half, g.add(da, db))
    turn = g.mul(half, g.mul(step, g.sub(da, db)))
    return g.sub(mean, turn) if smaller else g.add(mean, turn)


def _power_slope(g: Builder, y: int, a: int, da: int, exponent: float) -> int:
    if exponent == 0.0:
        return g.mul(g.const(0.0), da)
    if exponent == 1.0:
        return g.mul(g.const(1.0), da)
    if exponent == int(exponent) and abs(exponent) <= 10_000:
        lower = a if exponent == 2.0 else g.apply("pow", a, value=exponent - 1.0)
        return g.mul(g.mul(g.const(exponent), lower), da)
    return g.mul(g.mul(g.const(exponent), g.div(y, a)), da)


OPERATIONS: dict[str, Operation] = {
    "neg": Operation(lambda x: -x, lambda x: [-a for a in x], lambda g, y, a, da: g.neg(da), tm.neg),
    "sq": Operation(
        balls.square, ts.sq, _chain(lambda g, y, a: g.mul(g.const(2.0), a)), lambda x: tm.mul(x, x)
    ),
    "sqrt": function(balls.sqrt, ts.sqrt, lambda g, y, a: g.div(g.const(0.5), y), tm.sqrt, partial=True),
    "exp": function(balls.exp, ts.exp, lambda g, y, a: y, tm.exp),
    "log": function(balls.log, ts.log, lambda g, y, a: g.div(g.const(1.0), a), tm.log, partial=True),
    "sin": function(balls.sin, lambda x: ts.circular(x)[0], lambda g, y, a: g.apply("cos", a), tm.sin),
    "cos": function(balls.cos, lambda x: ts.circular(x)[1], lambda g, y, a: g.neg(g.apply("sin", a)), tm.cos),
    "tan": function(
        balls.tan, ts.tan, lambda g, y, a: g.add(g.const(1.0), g.apply("sq", y)), tm.tan, partial=True
    ),
    "asin": function(balls.asin, ts.asin, lambda g, y, a: _arc_slope(g, 1.0, a), tm.asin, partial=True),
    "acos": function(balls.acos, ts.acos, lambda g, y, a: _arc_slope(g, -1.0, a), tm.acos, partial=True),
    "atan": function(
        balls.atan, ts.atan, lambda g, y, a: g.div(g.const(1.0), g.add(g.const(1.0), g.apply("sq", a))), tm.atan
    ),
    "sinh": function(balls.sinh, lambda x: ts.hyperbolic(x)[0], lambda g, y, a: g.apply("cosh", a), tm.sinh),
    "cosh": function(balls.cosh, lambda x: ts.hyperbolic(x)[1], lambda g, y, a: g.apply("sinh", a), tm.cosh),
    "tanh": function(balls.tanh, ts.tanh, lambda g, y, a: g.sub(g.const(1.0), g.apply("sq", y)), tm.tanh),
    "abs": Operation(abs, ts.abs_, _chain(lambda g, y, a: g.apply("kink", a)), tm.abs_),
    "pow": Operation(balls.power, ts.power, _power_slope, tm.power, partial=True),
    "add": Operation(lambda x, y: x + y, ts.add, lambda g, y, a, b, da, db: g.add(da, db), tm.add),
    "sub": Operation(
        lambda x, y: x - y, ts.sub, lambda g, y, a, b, da, db: g.sub(da, db), lambda x, y: tm.add(x, tm.neg(y))
    ),
    "mul": Operation(
        lambda x, y: x * y, ts.mul, lambda g, y, a, b, da, db: g.add(g.mul(da, b), g.mul(a, db)), tm.mul
    ),
    "div": Operation(
        lambda x, y: x / y, ts.div, lambda g, y, a, b, da, db: g.div(g.sub(da, g.mul(y, db)), b), tm.div, partial=True
    ),
    "atan2": Operation(balls.atan2, ts.atan2, _angle_slope, tm.atan2, partial=True),
    "hypot": Operation(
        balls.hypot, ts.hypot, lambda g, y, a, b, da, db: g.div(g.add(g.mul(a, da), g.mul(b, db)), y), tm.hypot
    ),
    "min": Operation(arb.min, ts.smaller, lambda *given: _larger_slope(*given, smaller=True), tm.minimum),
    "max": Operation(arb.max, ts.larger, _larger_slope, tm.maximum),
    "kink": _step(balls.kink),
    "sign": _step(balls.sign),
    "floor": _step(balls.floor),
    "not": _step(lambda x: arb(0 if balls.holds(x) else 1)),
    "lt": _step(balls.less),
    "le": _step(balls.at_most),
    "eq": _step(balls.equal),
    "ne": _step(lambda x, y: 1 - balls.equal(x, y)),
    "and": _step(lambda x, y: arb(1 if balls.holds(x) and balls.holds(y) else 0)),
    "or": _step(lambda x, y: arb(1 if balls.holds(x) or balls.holds(y) else 0)),
    "if_else_zero": Operation(
        lambda c, y: y if balls.holds(c) else arb(0), ts.if_else_zero,
        lambda g, y, c, b, dc, db: g.const(0.0) if g.is_const(db, 0.0) else g.apply("if_else_zero", c, db),
    ),
}  # fmt: skip
"""Operation name to its row (``const`` and ``input``, which compute nothing, have none)."""
