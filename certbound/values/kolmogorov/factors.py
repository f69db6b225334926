"""Coefficients c(t, d) on slabs: polynomials of time with a proved error, for finitely many d that stand for all.

On a slab of length h with s = (t - t_{k+1}) / h, c = q(s) + E, q the interpolant of degree 2 through both ends and the
middle, with the constants C and c_2 of `splines.Sampling`:

    |E| <= c_2 h^3 sup |c_ttt|,     and where c has a kink or a jump on the slab     |E| <= (1 + C) rad c(slab).

Along a disturbance in which c is affine the two ends of its interval stand for all of it, since sup_d L^d v is taken at
a vertex then; along others points a distance w apart do, at a price of w^2 / 8 sup |c_dd|. Slabs about the times where
the clock makes c jump or bend are so short that what they lose is nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np

from certbound.arrays import Array
from certbound.errors import EnclosureError, InfeasibleError
from certbound.problem.model import JUMPS, ROWS, Tape, compile_numpy, is_zero, jacobian, reads, selected
from certbound.rigor.intervals import Interval
from certbound.values.enclosing import enclose
from certbound.values.kolmogorov.splines import Sampling
from certbound.values.polynomials import to_bernstein

DEGREE = 2  # of the interpolants in time
CLOCK = 2e-13  # share of the horizon by which knots may be off
HALF = 1e-11  # share of the horizon: half the length of a slab about a jump or a bend of the clock
_GRID = 4000  # points at which jumps and bends of the clock are looked for
_ROUNDING = 1e-15  # of a value: what its third difference may be by rounding alone
_MOST = 200  # of these
_PIECES = 4  # of a disturbance's interval where the model is not affine in it
_MOST_NODES = 16
_TAIL = Sampling(DEGREE)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Factor:
    """One coefficient on the slabs.

    Attributes
    ----------
    bernstein : ndarray, shape (V, K, degree + 1)
        Of the polynomial in s, for each of the V nodes of the disturbances: from the early end of a slab to the late.
    error : ndarray, shape (V, K)
        Bound of |E|.
    between : ndarray, shape (K,)
        What disturbances between the nodes may add, from above.
    """

    bernstein: Array
    error: Array
    between: Array

    @property
    def degree(self) -> int:
        """In time."""
        return int(self.bernstein.shape[2]) - 1

    @property
    def size(self) -> Array:
        """Bound of |c| on every slab, shape (K,)."""
        return np.asarray((np.abs(self.bernstein).max(axis=2) + self.error).max(axis=0))

    @property
    def spread(self) -> Array:
        """Bound of |E| on every slab, shape (K,)."""
        return np.asarray(self.error.max(axis=0))

    def on(self, slabs: slice) -> Factor:
        """The same on some of the slabs."""
        return Factor(bernstein=self.bernstein[:, slabs], error=self.error[:, slabs], between=self.between[slabs])


def _derivative(tape: Tape, slot: int, order: int) -> Tape:
    for _ in range(order):
        flat = jacobian(tape, [slot])
        tape = selected(flat, [0], None)
    return tape


def disturbance_nodes(coefficients: Sequence[Tape], low: Array, high: Array) -> tuple[Array, Array]:
    """Nodes of the disturbances' box, shape (V, m), and their distance along each, 0 where all is affine in it.

    Raises
    ------
    InfeasibleError
        There are too many.
    """
    lines, gaps = [], np.zeros(len(low))
    for k, (a, b) in enumerate(zip(low, high)):
        bent = not all(_affine(one, k + 1) for one in coefficients)
        line = np.linspace(a, b, _PIECES + 1 if bent else 2) if a < b else np.array([a])
        line[0], line[-1] = a, b
        gaps[k] = float(np.diff(line).max()) * (1 + 1e-12) if bent and a < b else 0.0
        lines.append(line)
    chosen = list(product(*lines))
    nodes = np.array(chosen).reshape(len(chosen), len(low))
    if len(nodes) > _MOST_NODES:
        raise InfeasibleError(
            f"values with a carried error serve at most {_MOST_NODES} combinations of extreme disturbances, "
            f"and there are {len(nodes)}."
        )
    return nodes, gaps


def _affine(tape: Tape, slot: int) -> bool:
    if any(slot in seen and (node.op in JUMPS or (node.op in ROWS and (ROWS[node.op].kink or ROWS[node.op].jump)))
           for node, seen in zip(tape.nodes, reads(tape))):  # fmt: skip
        return False
    return is_zero(_derivative(tape, slot, 2), 0)


def factor_of(tape: Tape, times: Array, within: tuple[float, float], nodes: Array, gaps: Array) -> Factor:
    """A coefficient on slabs.

    Parameters
    ----------
    tape : Tape
        c over ``("t", *disturbances)``, one output.
    times : ndarray, shape (K + 1,)
        Knots from the last one backward, each right up to `CLOCK` of the horizon.
    within : (float, float)
        Exact times of the first and the last knot.
    nodes, gaps : ndarray
        Of `disturbance_nodes`.
    """
    early, late, off = times[1:], times[:-1], CLOCK * within[1]
    timed = 0 in set().union(*reads(tape))
    degree = DEGREE if timed else 0
    slab = _clipped(early - off, late + off, within)
    rows, errors = [], []
    for node in nodes:
        fixed = [Interval.point(np.full(len(early), d)) for d in node]
        if not timed:
            value = enclose(tape, [slab, *fixed])[0][0].broadcast_to(early.shape)
            rows.append(np.asarray(value.mid)[:, None])
            errors.append(np.asarray(value.rad))
            continue
        points = [early + share * (late - early) for share in _TAIL.nodes]
        at = [enclose(tape, [_clipped(t - off, t + off, within), *fixed])[0][0] for t in points]
        middle = np.stack([np.broadcast_to(value.mid, early.shape) for value in at], axis=1)
        radius = np.max([np.broadcast_to(value.rad, early.shape) for value in at], axis=0)
        (range_,), edge = enclose(tape, [slab, *fixed])
        rough = (1 + _TAIL.lebesgue) * np.asarray(range_.broadcast_to(early.shape).rad)
        smooth = _TAIL.tail * (late - early) ** 3 * (1 + 1e-9) * _magnitude(_derivative(tape, 0, 3), [slab, *fixed])
        error = np.where(edge | ~np.isfinite(smooth), rough, np.minimum(smooth, rough)) + _TAIL.lebesgue * radius
        rows.append(middle @ to_bernstein(degree + 1).T)
        errors.append(error)
    bernstein = np.array(rows)
    error = np.array(errors) * (1 + 1e-12) + 1e-14 * np.abs(bernstein).max(axis=2)
    between = np.zeros(len(early))
    if gaps.any():
        box = [Interval(np.full(len(early), a), np.full(len(early), b)) for a, b in zip(nodes.min(0), nodes.max(0))]
        for k in map(int, np.flatnonzero(gaps)):
            (range_,), edge = enclose(tape, [slab, *box])
            bend = gaps[k] ** 2 / 8 * _magnitude(_derivative(tape, k + 1, 2), [slab, *box])
            between += np.where(edge | ~np.isfinite(bend), 2 * np.asarray(range_.rad), bend)
    if not (np.isfinite(bernstein).all() and np.isfinite(error).all() and np.isfinite(between).all()):
        raise EnclosureError("a part of the model that depends on time or disturbances alone has no finite range.")
    return Factor(bernstein=bernstein, error=error, between=between * (1 + 1e-12))


def _clipped(low: Array, high: Array, within: tuple[float, float]) -> Interval:
    return Interval(np.clip(low, *within), np.clip(high, *within))


def _magnitude(tape: Tape, inputs: list[Interval]) -> Array:
    try:
        (value,), _ = enclose(tape, inputs)
    except EnclosureError:
        return np.full(inputs[0].shape, np.inf)
    return np.broadcast_to(np.asarray(value.mag), inputs[0].shape)


def clock_breaks(tapes: Sequence[Tape], horizon: float) -> Array:
    """Times within the horizon at which the clock alone makes a function jump or bend, about; rising.

    Found in floats by changes of sign: one that is missed costs width alone.

    Raises
    ------
    InfeasibleError
        There are too many.
    """
    grid = np.linspace(0, horizon, _GRID + 1)
    found: list[float] = []
    for tape in tapes:
        for index, (node, seen) in enumerate(zip(tape.nodes, reads(tape))):
            if seen != {0} or not _breaks(node.op) or node.op in ("and", "or", "not", "if_else_zero"):
                continue
            decides = compile_numpy(
                Tape(inputs=tape.inputs, nodes=tape.nodes[:index], outputs=node.args, shape=(len(node.args),))
            )

            sides = partial(_sides, decides, node.op, [0.0] * (len(tape.inputs) - 1))
            signs = sides(grid)
            for k in np.flatnonzero(np.diff(signs) != 0):
                found.append(_bisected(sides, float(grid[k]), float(grid[k + 1])))
                if len(found) > 5 * _MOST:
                    break
    breaks: list[float] = []
    for time in sorted(found):
        if 4 * HALF * horizon < time < (1 - 4 * HALF) * horizon and (
            not breaks or time - breaks[-1] > 4 * HALF * horizon
        ):
            breaks.append(time)
    if len(breaks) > _MOST:
        raise InfeasibleError(
            f"values with a carried error serve at most {_MOST} jumps and bends of the model in time, and there are "
            f"at least {len(breaks)}."
        )
    return np.array(breaks)


def _breaks(op: str) -> bool:
    return op in JUMPS or (op in ROWS and (ROWS[op].kink is not None or ROWS[op].jump is not None))


def _sides(decides: Callable[..., Array], op: str, rest: list[float], t: Array) -> Array:
    """On which side of its jump or bend an operation is at times; of min and max, how its arguments compare."""
    value = decides(t, *rest)
    one = value[..., 0] - value[..., 1] if value.shape[-1] == 2 else value[..., 0]
    return np.broadcast_to(np.floor(one) if op == "floor" else np.sign(one), t.shape)


def _bisected(sides: Callable[[Array], Array], low: float, high: float) -> float:
    first = sides(np.array([low]))[0]
    for _ in range(80):
        middle = (low + high) / 2
        if sides(np.array([middle]))[0] == first:
            low = middle
        else:
            high = middle
    return high


def pace_of(tapes: Sequence[Tape], horizon: float, middle: Array) -> float:
    """The shortest time over which a coefficient changes, as a share of the horizon; in floats, infinity for none.

    The cube root of its range over the largest third difference: a sine with frequency w has 1.3 / w.
    """
    grid = np.linspace(0, horizon, _GRID + 1)
    shortest = np.inf
    for tape in tapes:
        value = np.broadcast_to(compile_numpy(tape)(grid, *middle)[..., 0], grid.shape)
        third = np.abs(np.diff(value, 3)) / (1.0 / _GRID) ** 3
        typical = float(np.quantile(third, 0.98)) if len(third) else 0.0  # jumps and bends have knots of their own
        if typical > _ROUNDING * _GRID**3 * float(np.abs(value).max()):
            shortest = min(shortest, (float(np.ptp(value)) / typical) ** (1 / 3))
    return shortest
