"""A tape on batches of Taylor models: what the dynamics does on many boxes at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from flint import arb

from certbound.checker.expressions import OPERATIONS, Undecided
from certbound.checker.report import FUNCTION, STEP
from certbound.checker.values import batches as tm
from certbound.checker.values.batches import Batch
from certbound.problem.model import JUMPS, Tape

_HALF = 0.5
_UP = 1 + 2.0**-40


def run(
    tape: Tape, inputs: Sequence[Batch], *, known: Mapping[int, Batch] | None = None, jumps: bool = False
) -> list[Batch]:
    """The outputs of a tape on N boxes; unknown where an operation is undefined or jumps somewhere on a box.

    Parameters
    ----------
    known : mapping, optional
        Operations whose values are given: those of time alone.
    jumps : bool
        Whether what jumps on a box is known up to an error that covers both sides; else just choices that time makes.
    """
    values: list[Batch] = []
    like = inputs[0]
    ended, most = tape.lives()
    like.terms.budget.spend(STEP * len(tape.nodes))
    like.terms.budget.fits(8 * (most + 8) * like.coefficients.size)
    nothing = tm.fixed(like.terms, np.zeros(0))
    known = {} if known is None else known
    for index, node in enumerate(tape.nodes):
        args = [] if node.op == "input" else [values[arg] for arg in node.args]
        if index in known:
            values.append(known[index])
        elif node.op == "input":
            values.append(inputs[node.args[0]])
        elif node.op == "const":
            values.append(tm.fixed(like.terms, np.full(like.error.shape, node.value)))
        elif node.op == "pow":
            values.append(_power(args[0], node.value))
        elif node.op in _DIRECT:
            values.append(_DIRECT[node.op](*args))
        elif len(args) == 1 and node.part is None:
            values.append(tm.composed(args[0], OPERATIONS[node.op].series))
        else:
            values.append(tm.unknown(like))  # atan2, parts of networks
        by_time = node.op == "if_else_zero" and node.args[0] in known
        if node.op in JUMPS and index not in known and (jumps or by_time):
            values[index] = _on_both_sides(node.op, args, values[index])
        for place in ended[index]:
            values[place] = nothing
    return [values[output] for output in tape.outputs]


def _on_both_sides(op: str, args: Sequence[Batch], found: Batch) -> Batch:
    """What jumps, up to an error where it does: a choice lies between 0 and what is chosen, a truth between 0 and 1."""
    x = args[-1]
    if op == "if_else_zero":
        part = tm.scaled(x, _HALF)
        across = Batch(x.terms, part.coefficients, (part.error * 2 + np.abs(part.coefficients).sum(axis=0)) * _UP)
    elif op in ("sign", "floor"):
        low, high = _ends(x)
        first, last = (np.sign(low), np.sign(high)) if op == "sign" else (np.floor(low), np.floor(high))
        off = (np.abs(first) + np.abs(last)) * 2.0**-52
        across = tm.fixed(x.terms, first / 2 + last / 2, ((last - first) * _HALF + off) * _UP)
    else:
        half = np.full(x.error.shape, _HALF)
        across = tm.fixed(x.terms, half, half)
    sure = np.isfinite(found.error) | ~np.logical_and.reduce([np.isfinite(arg.error) for arg in args])
    return tm.known(tm.chosen(sure, found, across))


def _ends(x: Batch) -> tuple[tm.Array, tm.Array]:
    """Bounds of all values; of one variable sharp ones."""
    return x.sharp_ends() if x.terms.variables == 1 else x.ends()


def _power(x: Batch, exponent: float) -> Batch:
    if exponent == int(exponent) and 1 <= exponent <= 16:
        result = x
        for _ in range(int(exponent) - 1):
            result = tm.mul(result, x)
        return result
    return tm.composed(x, lambda series: OPERATIONS["pow"].series(series, exponent))


def _quotient(x: Batch, y: Batch) -> Batch:
    one = arb(1)
    return tm.mul(
        x, tm.composed(y, lambda series: OPERATIONS["div"].series([one, *[arb(0)] * (len(series) - 1)], series))
    )


def _absolute(x: Batch) -> Batch:
    """|x|; across the kink a constant with an error."""
    low, high = _ends(x)
    most = np.maximum(np.abs(low), np.abs(high)) / 2
    across = tm.fixed(x.terms, most, most * (1 + 1e-15))
    return tm.chosen(low >= 0, x, tm.chosen(high <= 0, tm.neg(x), tm.known(across)))


def _largest(x: Batch, y: Batch) -> Batch:
    return tm.scaled(tm.add(tm.add(x, y), _absolute(tm.sub(x, y))), _HALF)


def _least(x: Batch, y: Batch) -> Batch:
    return tm.neg(_largest(tm.neg(x), tm.neg(y)))


def _truth(like: Batch, holds: tm.Mask, fails: tm.Mask) -> Batch:
    """1 where something surely holds, 0 where it surely does not, else unknown."""
    sure = tm.fixed(like.terms, holds.astype(float), np.where(holds | fails, 0.0, np.inf))
    return tm.known(sure)


def _less(x: Batch, y: Batch) -> Batch:
    low, high = _ends(tm.sub(x, y))
    return _truth(x, high < 0, low >= 0)


def _at_most(x: Batch, y: Batch) -> Batch:
    low, high = _ends(tm.sub(x, y))
    return _truth(x, high <= 0, low > 0)


def _equal(x: Batch, y: Batch) -> Batch:
    low, high = _ends(tm.sub(x, y))
    return _truth(x, np.zeros(low.shape, dtype=bool), (high < 0) | (low > 0))


def _decided(x: Batch) -> tuple[tm.Mask, tm.Mask]:
    """Where a condition surely is not 0, and where it surely is."""
    low, high = _ends(x)
    zero = (x.coefficients == 0).all(axis=0) & (x.error == 0)
    return (low > 0) | (high < 0), zero


def _both(x: Batch, y: Batch) -> Batch:
    (one, not_one), (two, not_two) = _decided(x), _decided(y)
    return _truth(x, one & two, (not_one | one) & (not_two | two) & (not_one | not_two))


def _either(x: Batch, y: Batch) -> Batch:
    (one, not_one), (two, not_two) = _decided(x), _decided(y)
    return _truth(x, (not_one | one) & (not_two | two) & (one | two), not_one & not_two)


def _opposite(x: Batch) -> Batch:
    holds, fails = _decided(x)
    return _truth(x, fails, holds)


def _gated(condition: Batch, x: Batch) -> Batch:
    holds, fails = _decided(condition)
    nothing = tm.fixed(x.terms, np.zeros(x.error.shape))
    return tm.chosen(holds, x, tm.chosen(fails, nothing, tm.unknown(x)))


def _step(op: str) -> Callable[[Batch], Batch]:
    """A piecewise constant function that rises, where it is the same number at both ends of a box."""

    def apply(x: Batch) -> Batch:
        value, sure = np.zeros(x.error.shape), np.zeros(x.error.shape, dtype=bool)
        low, high = _ends(x)
        x.terms.budget.balls(len(low), FUNCTION)
        for k in np.flatnonzero(np.isfinite(low) & np.isfinite(high)):
            try:
                first, last = (OPERATIONS[op].ball(arb(float(end))) for end in (low[k], high[k]))
            except Undecided:
                continue
            value[k], sure[k] = float(first.mid()), bool(first == last)
        return tm.known(tm.fixed(x.terms, value, np.where(sure, 0.0, np.inf)))

    return apply


_DIRECT: dict[str, Callable[..., Batch]] = {
    "neg": tm.neg,
    "add": tm.add,
    "sub": tm.sub,
    "mul": tm.mul,
    "sq": lambda x: tm.mul(x, x),
    "div": _quotient,
    "abs": _absolute,
    "min": _least,
    "max": _largest,
    "hypot": lambda x, y: tm.composed(tm.add(tm.mul(x, x), tm.mul(y, y)), OPERATIONS["sqrt"].series),
    "lt": _less,
    "le": _at_most,
    "eq": _equal,
    "ne": lambda x, y: _opposite(_equal(x, y)),
    "and": _both,
    "or": _either,
    "not": _opposite,
    "if_else_zero": _gated,
    "sign": _step("sign"),
    "floor": _step("floor"),
}
