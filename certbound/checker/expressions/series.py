"""Taylor series in time over balls: the defect of a nominal curve, enclosed over a whole piece.

A series is a list of coefficients; operations follow from the differential equations that the functions obey. Expanded
at the middle of a piece and, for the last coefficient, over all of it, a function lies in its Taylor polynomial plus
that coefficient times the last power (Lagrange's remainder). At a kink there are series up to the first power only,
whose coefficient encloses the slopes on both sides (a Lipschitz function is the integral of its derivative).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from flint import arb

from certbound.checker.expressions.arithmetic import BALLS, Undecided, kink, power
from certbound.checker.report import Budget
from certbound.problem.model import JUMPS, Tape

__all__ = ["expand"]

Series = list[arb]


def expand(tape: Tape, inputs: Sequence[Series], order: int, budget: Budget) -> list[Series]:
    """Coefficients 0 .. ``order`` of a tape's outputs along series of its inputs.

    Raises
    ------
    Undecided
        If something jumps or is undefined there.
    Unproved
        If the time is used up.
    """
    values: list[Series] = []
    for node in tape.nodes:
        budget.check()
        if node.op == "input":
            given = list(inputs[node.args[0]])[: order + 1]
            values.append(given + [arb(0)] * (order + 1 - len(given)))
        elif node.op == "const":
            values.append(_constant(arb(node.value), order))
        elif node.op == "pow":
            values.append(_power(values[node.args[0]], node.value))
        else:
            values.append(_apply(node.op, [values[arg] for arg in node.args]))
    result = [values[output] for output in tape.outputs]
    if not all(c.is_finite() for series in result for c in series):
        raise Undecided
    return result


def _constant(value: arb, order: int) -> Series:
    return [value] + [arb(0)] * order


def _apply(op: str, args: list[Series]) -> Series:
    x = args[0]
    if op in _UNARY:
        return _UNARY[op](x)
    if op in JUMPS and op != "if_else_zero":
        return _constant(BALLS[op](*(series[0] for series in args)), len(x) - 1)
    y = args[1]
    if op == "if_else_zero":
        return y if BALLS["if_else_zero"](x[0], arb(1)) == 1 else _constant(arb(0), len(x) - 1)
    return _BINARY[op](x, y)


def _add(x: Series, y: Series) -> Series:
    return [a + b for a, b in zip(x, y)]


def _sub(x: Series, y: Series) -> Series:
    return [a - b for a, b in zip(x, y)]


def _scale(x: Series, factor: arb) -> Series:
    return [a * factor for a in x]


def _mul(x: Series, y: Series) -> Series:
    return [sum((x[i] * y[k - i] for i in range(k + 1)), arb(0)) for k in range(len(x))]


def _sq(x: Series) -> Series:
    return [BALLS["sq"](x[0]), *_mul(x, x)[1:]]


def _div(x: Series, y: Series) -> Series:
    result: Series = []
    for k in range(len(x)):
        rest = x[k] - sum((result[i] * y[k - i] for i in range(k)), arb(0))
        result.append(rest / y[0])
    return result


def _slope(x: Series) -> Series:
    """Coefficients of x', one fewer."""
    return [(k + 1) * x[k + 1] for k in range(len(x) - 1)]


def _integrated(first: arb, slope: Callable[[Series], Series], x: Series) -> Series:
    """y with y_0 = first and y' = slope(y so far) x'."""
    result, rate = [first], _slope(x)
    for k in range(1, len(x)):
        outer = slope(result)
        result.append(sum((outer[i] * rate[k - 1 - i] for i in range(k)), arb(0)) / k)
    return result


def _known(outer: Series) -> Callable[[Series], Series]:
    return lambda _: outer


def _exp(x: Series) -> Series:
    return _integrated(BALLS["exp"](x[0]), lambda y: y, x)


def _log(x: Series) -> Series:
    return _integrated(BALLS["log"](x[0]), _known(_div(_constant(arb(1), len(x) - 1), x)), x)


def _sqrt(x: Series) -> Series:
    result = [BALLS["sqrt"](x[0])]
    for k in range(1, len(x)):
        rest = x[k] - sum((result[i] * result[k - i] for i in range(1, k)), arb(0))
        result.append(rest / (2 * result[0]))
    return result


def _pair(x: Series, names: tuple[str, str], sign: int) -> tuple[Series, Series]:
    """sin and cos (sign -1), or sinh and cosh (sign 1)."""
    s, c, rate = [BALLS[names[0]](x[0])], [BALLS[names[1]](x[0])], _slope(x)
    for k in range(1, len(x)):
        first = sum((c[i] * rate[k - 1 - i] for i in range(k)), arb(0)) / k
        second = sum((s[i] * rate[k - 1 - i] for i in range(k)), arb(0)) * sign / k
        s.append(first)
        c.append(second)
    return s, c


def _tanh(x: Series) -> Series:
    def outer(y: Series) -> Series:
        return _sub(_constant(arb(1), len(y) - 1), _sq(y))

    return _integrated(BALLS["tanh"](x[0]), outer, x)


def _tan(x: Series) -> Series:
    return _integrated(BALLS["tan"](x[0]), lambda y: _add(_constant(arb(1), len(y) - 1), _sq(y)), x)


def _arc(name: str) -> Callable[[Series], Series]:
    def evaluate(x: Series) -> Series:
        one = _constant(arb(1), len(x) - 1)
        inner = _add(one, _sq(x)) if name == "atan" else _sqrt(_sub(one, _sq(x)))
        outer = _div(one, inner)
        return _integrated(BALLS[name](x[0]), _known(_scale(outer, arb(-1)) if name == "acos" else outer), x)

    return evaluate


def _abs(x: Series) -> Series:
    return _larger(x, _scale(x, arb(-1)))


def _power(x: Series, exponent: float) -> Series:
    order = len(x) - 1
    if exponent == 0.0:
        return _constant(x[0] if x[0].is_nan() else arb(1), order)
    if exponent == int(exponent) and 1 <= exponent <= 64:
        result = x
        for _ in range(int(exponent) - 1):
            result = _mul(result, x)
        return [power(x[0], exponent), *result[1:]]
    result, p = [power(x[0], exponent)], arb(exponent)
    for k in range(1, order + 1):
        total = sum(((p * i - (k - i)) * x[i] * result[k - i] for i in range(1, k + 1)), arb(0))
        result.append(total / (k * x[0]))
    return result


def _atan2(y: Series, x: Series) -> Series:
    first = BALLS["atan2"](y[0], x[0])
    squares = _add(_sq(x), _sq(y))
    rate = _sub(_mul(x[:-1], _slope(y)), _mul(y[:-1], _slope(x)))
    quotient = _div(rate, squares[:-1]) if len(x) > 1 else []
    return [first, *(value / (k + 1) for k, value in enumerate(quotient))]


def _hypot(x: Series, y: Series) -> Series:
    return _sqrt(_add(_sq(x), _sq(y)))


def _larger(x: Series, y: Series) -> Series:
    try:
        return x if kink(x[0] - y[0]) == 1 else y
    except Undecided:
        if len(x) > 2:
            raise
        return [arb.max(x[0], y[0]), *(a.union(b) for a, b in zip(x[1:], y[1:]))]


def _smaller(x: Series, y: Series) -> Series:
    return _scale(_larger(_scale(x, arb(-1)), _scale(y, arb(-1))), arb(-1))


_UNARY: dict[str, Callable[[Series], Series]] = {
    "neg": lambda x: [-a for a in x],
    "sq": _sq,
    "sqrt": _sqrt,
    "exp": _exp,
    "log": _log,
    "sin": lambda x: _pair(x, ("sin", "cos"), -1)[0],
    "cos": lambda x: _pair(x, ("sin", "cos"), -1)[1],
    "tan": _tan,
    "asin": _arc("asin"),
    "acos": _arc("acos"),
    "atan": _arc("atan"),
    "sinh": lambda x: _pair(x, ("sinh", "cosh"), 1)[0],
    "cosh": lambda x: _pair(x, ("sinh", "cosh"), 1)[1],
    "tanh": _tanh,
    "abs": _abs,
    "kink": lambda x: _constant(kink(x[0]), len(x) - 1),
}
_BINARY: dict[str, Callable[[Series, Series], Series]] = {
    "add": _add, "sub": _sub, "mul": _mul, "div": _div, "atan2": _atan2, "hypot": _hypot, "min": _smaller,
    "max": _larger,
}  # fmt: skip
