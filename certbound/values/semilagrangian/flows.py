"""The noise-free flow over one step, its derivatives and the covariance of its linearisation, enclosed.

For x' = f(x) with noise along b the augmented system is (first and second derivatives by the start's coordinates)
    x' = f,  J' = Df J,  (H^i)' = Df H^i + D^2 f[J_i, J_i],  S' = Df S + S Df' + b b',  and (S^i)' = d_i of that,
from J = 1, H = 0, S = 0: m = x(h) is the flow, J and H^i = d_ii m its derivatives, S(h) the covariance of the
linearised noise, S^i its derivatives by the start. Taylor's formula in time with Lagrange's remainder over an a-priori
box (Picard) encloses x(h).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from typing import Any

import numpy as np

from certbound.arrays import Mask
from certbound.problem.model import JUMPS, ROWS, Graph, Tape, jacobian
from certbound.rigor.intervals import Interval
from certbound.rigor.series import ZERO, Series, circular, power, product
from certbound.values.discrete import evaluate
from certbound.watch import poll

Box = list[Interval]

_ROUNDS = 40
_ONE = Interval.point(1.0)


def series_along(tape: Tape, inputs: Sequence[Series], order: int, known: list[Series]) -> list[Series]:
    """Taylor coefficients of a tape's outputs, from those of its inputs.

    ``known`` holds those of all products, sines and cosines in turn, as a lower order left them; it is brought to this
    order. Of order 0 everything is computed as numbers, not as series, and may be closer by a rounding.
    """
    table: dict[str, Callable[..., Any]] = {op: partial(_applied, op, order) for op in ROWS}
    table["const"] = lambda value: [Interval.point(value)]
    turn, pairs = itertools.count(), dict[int, tuple[Series, Series]]()

    def before() -> tuple[int, Series]:
        k = next(turn)
        return k, known[k] if k < len(known) and len(known[k]) > 1 else []

    def times(x: Series, y: Series, highest: int = order) -> Series:
        k, found = before()
        found = product(x, y, highest, found) if found else _applied("mul", highest, x, y)
        known[k : k + 1] = [found]
        return found

    def circle(op: str, x: Series) -> Series:
        if len(x) == 1:
            return _applied(op, order, x)
        if id(x) not in pairs:
            (j, one), (k, two) = before(), before()
            pairs[id(x)] = circular(x, order, (one, two) if one else None)
            known[j : j + 1], known[k : k + 1] = ([part] for part in pairs[id(x)])
        return pairs[id(x)][op == "cos"]

    table |= {"mul": times, "pow": lambda x, exponent: power(x, exponent, order, times)}
    table |= {op: partial(circle, op) for op in ("sin", "cos")}
    return tape.evaluate(table, inputs)


def _applied(op: str, order: int, *args: Any) -> Series:
    row = ROWS[op]
    if op not in JUMPS and op not in ("kink", "pow") and all(len(x) == 1 for x in args):
        return [row.interval(*(x[0] for x in args))]
    return row.series(*args, order)


def sheared(tape: Tape, shear: float) -> Tape:
    """f in the coordinates (y, q) with p = y + shear q: (f_p - shear f_q, f_q), over ("t", "y", "q")."""
    graph = Graph(("t", "y", "q"))
    arithmetic = graph.arithmetic()
    t, y, q = (graph.input(slot) for slot in range(3))
    slope = graph.const(shear)
    first, second = tape.evaluate(arithmetic, [t, graph.apply("add", y, graph.apply("mul", slope, q)), q])
    return graph.tape([graph.apply("sub", first, graph.apply("mul", slope, second)), second], (2,))


EQUATIONS = 19
"""Of the augmented system: x, J by columns, H by columns, S and its derivatives as (11, 12, 22)."""


class _Sums:
    """Sums and products of a graph's nodes."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph

    def plus(self, *terms: int) -> int:
        return reduce(partial(self.graph.apply, "add"), terms)

    def times(self, *factors: int) -> int:
        return reduce(partial(self.graph.apply, "mul"), factors)

    def lyapunov(self, a: Sequence[int], s: Sequence[int]) -> list[int]:
        """The entries 11, 12, 22 of A S + S A' for a symmetric S."""
        plus, times = self.plus, self.times
        two = self.graph.const(2.0)
        return [
            times(two, plus(times(a[0], s[0]), times(a[1], s[1]))),
            plus(times(a[0], s[1]), times(a[1], s[2]), times(a[2], s[0]), times(a[3], s[1])),
            times(two, plus(times(a[2], s[1]), times(a[3], s[2]))),
        ]


def augmented(tape: Tape, noise: float, shear: float) -> Tape:
    """The equations of the module for two states, over t and the `EQUATIONS` unknowns.

    Parameters
    ----------
    tape : Tape
        f over (t, x_1, x_2).
    noise, shear : float
        b = noise (-shear, 1).
    """
    graph = Graph(("t", *(f"z{k}" for k in range(EQUATIONS))))
    z = [graph.input(slot) for slot in range(EQUATIONS + 1)]
    sums = _Sums(graph)
    plus, times = sums.plus, sums.times
    first = jacobian(tape, (1, 2))
    outputs, a, second = (
        list(part.evaluate(graph.arithmetic(), z[:3])) for part in (tape, first, jacobian(first, (1, 2)))
    )
    columns = [(z[3], z[4]), (z[5], z[6])]
    turned = [[plus(times(second[2 * k], u[0]), times(second[2 * k + 1], u[1])) for k in range(4)] for u in columns]
    for u in columns:
        outputs += [plus(times(a[2 * k], u[0]), times(a[2 * k + 1], u[1])) for k in range(2)]
    for u, bent, v in zip(columns, turned, [(z[7], z[8]), (z[9], z[10])]):
        for k in range(2):
            pairs = [times(m[2 * k + i], w[i]) for m, w in ((a, v), (bent, u)) for i in range(2)]
            outputs.append(plus(*pairs))
    b = [times(graph.const(-shear), graph.const(noise)), graph.const(noise)]
    drive = [times(b[0], b[0]), times(b[0], b[1]), times(b[1], b[1])]
    outputs += [plus(*pair) for pair in zip(sums.lyapunov(a, z[11:14]), drive)]
    for bent, start in zip(turned, (14, 17)):
        parts = zip(sums.lyapunov(a, z[start : start + 3]), sums.lyapunov(bent, z[11:14]))
        outputs += [plus(*pair) for pair in parts]
    return graph.tape(outputs, (EQUATIONS,))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Flown:
    """Where boxes are after a step, a box they do not leave on the way, and for which boxes that was shown."""

    end: Box
    way: Box
    known: Mask


def during(begin: Interval, step: float) -> Interval:
    """All times of a step that begins then."""
    return begin + Interval(0.0, step)


def flow(
    tape: Tape, start: Sequence[Interval], step: float, order: int, begin: Interval = ZERO
) -> Flown:
    """Enclose x(step) for x' = tape(t, x) from every box of a batch.

    Parameters
    ----------
    start : sequence of Interval, shape (N,)
        One a state.
    order : int
        Of the Taylor polynomial.
    begin : Interval
        Times at which the step begins.
    """
    way, known = reachable(tape, start, step, begin)
    inner = _coefficients(tape, list(start), order, begin)
    outer = _coefficients(tape, way, order + 1, during(begin, step))
    h = Interval.point(step)
    end = []
    for k in range(len(start)):
        total = outer[k][order + 1]
        for degree in range(order, -1, -1):
            total = inner[k][degree] + h * total
        low = np.where(known, np.maximum(total.lo, way[k].lo), way[k].lo)
        high = np.where(known, np.minimum(total.hi, way[k].hi), way[k].hi)
        fine = np.isfinite(low) & np.isfinite(high) & (low <= high)
        known = known & fine
        end.append(Interval(np.where(fine, low, 0.0), np.where(fine, high, 0.0)))
    return Flown(end=end, way=way, known=known)


def _coefficients(tape: Tape, start: Sequence[Interval], order: int, time: Interval) -> list[Series]:
    """x_0 ... x_order of the solution, from x_{k+1} = [f(t, x)]_k / (k + 1)."""
    found: list[Series] = [[value] for value in start]
    products: list[Series] = []
    for k in range(order):
        poll("the flow over a step")
        rates = series_along(tape, [[time, _ONE][: k + 1], *found], k, products)
        for series, rate in zip(found, rates):
            coefficient = rate[k] if k < len(rate) else ZERO
            series.append((coefficient / float(k + 1)).broadcast_to(series[0].shape))
    return found


def reachable(tape: Tape, start: Sequence[Interval], step: float, begin: Interval = ZERO) -> tuple[Box, Mask]:
    """Boxes that solutions from the starts do not leave up to the step, and where that was shown.

    A box B with start + [0, step] f([begin, begin + step], B) inside B holds them (Picard).
    """
    span, time = Interval(0.0, step), during(begin, step)
    first = [value.broadcast_to(start[0].shape) for value in start]
    known = np.zeros(start[0].shape, dtype=bool)
    result = [Interval(value.lo.copy(), value.hi.copy()) for value in first]
    box, rest = first, np.arange(len(known))
    for _ in range(_ROUNDS):
        poll("the flow over a step")
        rates, undefined, jumps = evaluate(tape, [time, *box])
        good = np.isfinite(rates.mag).all(axis=1) & ~undefined & ~jumps
        new = []
        for k, value in enumerate(first):
            rate = Interval(np.where(good, rates.lo[:, k], 0.0), np.where(good, rates.hi[:, k], 0.0))
            new.append(value[rest] + span * rate)
        inside = good & np.all([(n.lo >= b.lo) & (n.hi <= b.hi) for n, b in zip(new, box)], axis=0)
        done, left = rest[inside], ~inside
        for k, value in enumerate(new):
            result[k].lo[done], result[k].hi[done] = value.lo[inside], value.hi[inside]
        known[done] = True
        rest = rest[left]
        if not len(rest):
            break
        box = [_widened(value[left], good[left]) for value in new]
    return result, known


def _widened(value: Interval, good: Mask) -> Interval:
    with np.errstate(over="ignore", invalid="ignore"):  # of boxes that run away
        more = np.where(good, 0.08 * (value.hi - value.lo) + 1e-12 * (1 + value.mag), 0.0)
        return Interval(value.lo - more, value.hi + more)
