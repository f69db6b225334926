"""Taylor coefficients of a traced function along a curve, in interval arithmetic.

A series [x_0, x_1, ..., x_m] stands for x(s) = x_0 + x_1 s + x_2 s^2 + ...; coefficients left out are 0.
Evaluated at one point of time the coefficients are thin; evaluated with coefficients that hold at every
time of a piece they enclose x^(j)(s)/j! over the piece, which is what Lagrange's remainder asks for
(`taylor_bounds`).

What each operation makes of its arguments' series: ``certbound.rigor.series``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from certbound.problem.model import JUMPS, ROWS, Tape
from certbound.rigor.arithmetic import Interval
from certbound.rigor.series import ZERO, Series


def expand(tape: Tape, inputs: Sequence[Series], order: int) -> list[Series]:
    """Series of every output of ``tape``, padded to ``order + 1`` coefficients, from one series per input slot.

    Examples
    --------
    >>> from certbound.problem.model import Node
    >>> square = Tape(inputs=("t",), nodes=(Node("input", (0,)), Node("sq", (0,))), outputs=(1,), shape=(1,))
    >>> one = Interval.point(1.0)
    >>> [float(c.mid) for c in expand(square, [[one, one]], 3)[0]]
    [1.0, 2.0, 1.0, 0.0]
    """
    outputs = tape.evaluate(series_arithmetic(order), inputs)
    return [list(series) + [ZERO] * (order + 1 - len(series)) for series in outputs]


def polynomial_range(series: Series, span: Interval) -> Interval:
    """Enclosure of x_0 + x_1 s + ... for s in ``span``, best where ``span`` is centred at 0.

    Even powers of ``span`` are nonnegative; the coefficients may be intervals (a Taylor form with remainder).
    """
    total = series[0]
    for power, coefficient in enumerate(series[1:], start=1):
        total = total + coefficient * span**power
    return total


def taylor_bounds(centre: Series, piece: Series, span: Interval) -> list[Interval]:
    """Enclosures of a function over a piece, one for every order of Lagrange's remainder.

    Proves: x(s) lies in sum_{j < r} centre_j s^j + piece_r s^r for s in ``span``, for every r; a caller may
    intersect them.

    ``centre`` are the coefficients at s = 0, ``piece`` those valid at every s of the convex hull of 0 and ``span``.
    """
    powers = [span**power for power in range(1, len(piece))]
    bounds = [piece[0]]
    partial = centre[0]
    for r in range(1, len(piece)):
        bounds.append(partial + piece[r] * powers[r - 1])
        if r < len(centre):
            partial = partial + centre[r] * powers[r - 1]
    return bounds


def series_arithmetic(order: int) -> dict[str, Callable[..., Any]]:
    """Arithmetic for ``Tape.evaluate`` whose values are series cut after ``order``."""
    table: dict[str, Callable[..., Any]] = {op: partial(_applied, op, order) for op in ROWS}
    return table | {"const": lambda value: [Interval.point(value)]}


def _applied(op: str, order: int, *args: Any) -> Series:
    row = ROWS[op]
    jumps = op in JUMPS or op in ("kink", "pow")
    if not jumps and all(len(x) == 1 for x in args):
        return [row.interval(*(x[0] for x in args))]
    return row.series(*args, order)
