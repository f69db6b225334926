"""The mean time of leaving an interval, from both sides, by a function of the state alone (Dynkin's formula).

Let L m = f m' + a m''/2 with a = g^2 >= 0, m continuously differentiable with a second derivative that is continuous
between nodes (Ito's formula holds for it: at a node the path spends no time, or there a = 0). Where m >= 0 at the ends
and L m <= -(1 - e) < 0 for every disturbance, E tau <= m/(1 - e): m has no minimum inside, as L m >= 0 there. Where
m <= 0 at the ends and L m >= -(1 + e), E tau >= m/(1 + e).

Without a limit on one side the line is cut there. To leave through the cut is to leave sooner, so that lower bounds
stand. Beyond it m goes on as a straight line of slope s with f s <= -1, which serves upper bounds where noise-free
paths come back.

m' is a continuous function, a quadratic between nodes, that nearly solves f m' + a m''/2 = -1 (collocation). From there
on its values at nodes and middles are numbers: L m is enclosed cell by cell, by its middle and its slope, and cells
that miss -1 by too much are halved. Kinks of the model end in small cells, and cost nothing elsewhere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate

import numpy as np

from certbound.arrays import Array, Mask
from certbound.errors import EnclosureError, InfeasibleError
from certbound.problem.model import Tape, compile_numpy, jacobian, sources
from certbound.problem.problem import Problem
from certbound.problem.systems import ContinuousSystem
from certbound.rigor.intervals import Interval
from certbound.values.enclosing import enclose, squared_diffusion
from certbound.values.exact import interval_of
from certbound.watch import poll

_FIRST, _MOST = 256, 100_000  # cells at first, and at most
_GOOD = 3e-4  # of L m, by which it may miss -1 in a cell that is not halved
_HALVINGS, _IDLE = 24, 3  # rounds at most, and those without a gain, as rounding is in the way
_WORST = 0.5  # of L m, by which it may miss -1 at all
_BAND = 3  # entries beside the diagonal, on either side
_STEEPER = 1 + 1e-6  # times the slope beyond a cut: that at the cut
_CUTS, _NEAR = 12, 2e-3  # places of a cut, each twice as far as the one before; upper over lower bound, to be done


def bound_mean_time(problem: Problem) -> tuple[float, float | None] | None:
    """Bounds of the mean time of leaving from every start, under every disturbance; None where nothing is proved.

    One state in continuous time, a model without t, and limits that stand still; the upper bound is None where only the
    lower one is proved. An EnclosureError where the model is undefined somewhere in the interval.
    """
    square, ends = squared_of(problem), limits_of(problem)
    if ends is None or square is None or not np.isfinite(ends).any():
        return None
    model = _Model(problem, square)
    around = problem.initial.hull()
    starts = float(around.lo[0]), float(around.hi[0])
    if not ends[0] <= starts[0] <= starts[1] <= ends[1]:
        return None
    low, high = 0.0, math.inf
    for cut in _cuts(ends, starts):
        try:
            least, most = _within(model, cut, ends, starts)
        except EnclosureError:
            if cut == ends:
                raise
            break
        low, high = max(low, least), min(high, most)
        if high <= (1 + _NEAR) * low:
            break
    return None if low <= 0 and high == math.inf else (low, high if high < math.inf else None)


def _within(
    model: _Model, cut: tuple[float, float], ends: tuple[float, float], starts: tuple[float, float]
) -> tuple[float, float]:
    """Bounds from both sides by what is known between two cuts; infinite where none is known."""
    held = _Mean.solved(model, cut, starts, free=(False, False))
    low = 0.0 if held is None else held.lower
    if cut == ends:
        return low, math.inf if held is None else held.upper
    slope = model.slope_beyond(cut, ends)
    above = None if slope is None else _Mean.solved(model, cut, starts, free=_free(cut, ends), slope=slope)
    return low, math.inf if above is None else above.upper


def squared_of(problem: Problem) -> Tape | None:
    """g^2, of a model in continuous time without t, and without a plan in steps; None elsewhere."""
    if not isinstance(problem.system, ContinuousSystem) or problem.input_sequence is not None:
        return None
    square = squared_diffusion(problem.system.diffusion, problem.system.states)
    clock = any(0 in slots for tape in (problem.closed_loop, square) for slots in sources(tape))
    return None if clock else square


def limits_of(problem: Problem) -> tuple[float, float] | None:
    """The ends of the safe interval, where it is one that is exactly known; infinite where there is no limit."""
    low, high = -np.inf, np.inf
    for constraint in problem.constraints:
        if constraint.outside:
            return None
        try:
            first, last = interval_of(constraint.region)
        except InfeasibleError:
            return None
        low, high = max(low, first), min(high, last)
    return (float(low), float(high)) if low < high else None


def _cuts(ends: tuple[float, float], starts: tuple[float, float]) -> list[tuple[float, float]]:
    """The interval itself, or intervals that are cut farther and farther where it has no end."""
    if np.isfinite(ends).all():
        return [ends]
    lower_end = math.isfinite(ends[0])
    span = starts[1] - ends[0] if lower_end else ends[1] - starts[0]
    span = span if span > 0 else max(abs(starts[0]), 1.0)
    reach = [span * 2.0**k for k in range(_CUTS)]
    return [(ends[0], starts[1] + r) if lower_end else (starts[0] - r, ends[1]) for r in reach]


def _free(cut: tuple[float, float], ends: tuple[float, float]) -> tuple[bool, bool]:
    """At which end the line goes on beyond the cut."""
    return cut[0] != ends[0], cut[1] != ends[1]


class _Model:
    """Enclosures of f, a and their slopes over cells."""

    def __init__(self, problem: Problem, square: Tape) -> None:
        self.problem, self.square = problem, square
        box = problem.system.disturbance
        self.sides = [] if box is None else list(zip(box.low, box.high))
        self.middle = [] if box is None else ((box.low + box.high) / 2).tolist()

    def values(self, x: Array) -> tuple[Array, Array]:
        """f and a at places, in floats; disturbances in their middle."""
        given = [np.full(x.shape, value) for value in self.middle]
        with np.errstate(all="ignore"):
            f = np.broadcast_to(compile_numpy(self.problem.closed_loop)(0 * x, x, *given)[..., 0], x.shape)
            a = np.broadcast_to(compile_numpy(self.square)(0 * x, x)[..., 0, 0], x.shape)
        return f, a

    def ranges(self, x: Interval) -> tuple[Interval, Interval]:
        """f and a over boxes, for every disturbance."""
        time, given = self._signals(x)
        f, a = enclose(self.problem.closed_loop, [time, x, *given])[0][0], enclose(self.square, [time, x])[0][0]
        whole = [Interval(np.broadcast_to(one.lo, x.shape), np.broadcast_to(one.hi, x.shape)) for one in (f, a)]
        return whole[0], whole[1]

    def slopes(self, x: Interval) -> tuple[Interval, Interval, Mask]:
        """f' and a' over boxes, and where they are no slopes, as something may jump or bend."""
        time, given = self._signals(x)
        f, bent = enclose(jacobian(self.problem.closed_loop, [1]), [time, x, *given])
        a, jumps = enclose(jacobian(self.square, [1]), [time, x])
        return f[0], a[0], bent | jumps

    def slope_beyond(self, cut: tuple[float, float], ends: tuple[float, float]) -> float | None:
        """s with f s <= -1 beyond the cut; None where the drift does not lead back everywhere there."""
        up = math.isinf(ends[1])
        start = cut[1] if up else cut[0]
        x = Interval(np.array([start if up else -np.inf]), np.array([np.inf if up else start]))
        try:
            f, _ = self.ranges(x)
            edge = self.ranges(Interval.point(np.array([start])))[0]
            back = float(np.min(-f.hi if up else f.lo))
            slope, _, bent = self.slopes(x)
            falls = bool(np.all(slope.hi <= 0) and not bent.any())  # the drift leads back ever more
            back = max(back, float(np.min(-edge.hi if up else edge.lo))) if falls else back
        except EnclosureError:
            return None
        if not 0 < back < math.inf:
            return None
        size = math.nextafter(1 / back, math.inf) * (1 + 1e-15)
        return size if up else -size

    def _signals(self, x: Interval) -> tuple[Interval, list[Interval]]:
        shape = x.shape
        given = [Interval(np.full(shape, low), np.full(shape, high)) for low, high in self.sides]
        return Interval.point(np.zeros(shape)), given


@dataclass(frozen=True, eq=False, kw_only=True)
class _Mean:
    """m' by its values at nodes (K + 1,) and at the middles between them (K,), and where L m was found to lie.

    ``free`` says beyond which end m goes on, with the ``slope``; there it is not held at 0.
    """

    nodes: Array
    at_nodes: Array
    at_middles: Array
    generated: Interval
    starts: tuple[float, float]
    free: tuple[bool, bool]
    slope: float

    @classmethod
    def solved(
        cls, model: _Model, ends: tuple[float, float], starts: tuple[float, float], *, free: tuple[bool, bool],
        slope: float = 0.0,
    ) -> _Mean | None:  # fmt: skip
        """m over an interval, on cells that are halved until it is good enough; None where it is not good at all."""
        nodes, found, worst = np.unique([*np.linspace(*ends, _FIRST + 1), *starts]), None, list[float]()
        nodes[0], nodes[-1] = ends
        for _ in range(_HALVINGS):
            poll("the mean time of leaving")
            solution = _collocated(model, nodes, free, _STEEPER * slope)
            if solution is None:
                return found
            found = cls(nodes=nodes, at_nodes=solution[0], at_middles=solution[1], starts=starts, free=free,
                        slope=slope, generated=_generated(model, nodes, *solution))  # fmt: skip
            off = (found.generated + Interval.point(1.0)).mag
            middles = nodes[:-1] + np.diff(nodes) / 2
            split = (off > _GOOD) & (nodes[:-1] < middles) & (middles < nodes[1:])
            worst.append(float(off.max()))
            idle = len(worst) > _IDLE and worst[-1] >= min(worst[:-_IDLE])
            if idle or not split.any() or len(nodes) + np.count_nonzero(split) > _MOST:
                break
            nodes = np.sort(np.concatenate([nodes, middles[split]]))
        return found

    @cached_property
    def values(self) -> Interval:
        """m at the nodes: the integral of m' from an end that holds it at 0."""
        steps = Interval.point(self.nodes[1:]) - Interval.point(self.nodes[:-1])
        simpson = Interval.point(self.at_nodes[:-1]) + Interval.point(self.at_nodes[1:])
        parts = steps * (simpson + Interval.point(4.0) * Interval.point(self.at_middles)) / Interval.point(6.0)
        low, high = (-parts.hi[::-1], -parts.lo[::-1]) if self.free[0] else (parts.lo, parts.hi)
        low, high = _sums(low, -math.inf), _sums(high, math.inf)
        return Interval(low[::-1], high[::-1]) if self.free[0] else Interval(low, high)

    @property
    def upper(self) -> float:
        """The largest mean time over the starts, at most; infinite where nothing is proved."""
        error = float(np.max(self.generated.hi)) + 1.0
        if not (error < _WORST and self._bends_down):
            return math.inf
        whole = self._over_starts()
        lift = max(-float(self.values.lo[k]) for k in (0, -1))
        share = Interval.point(1.0) - Interval.point(max(math.nextafter(error, math.inf), 0.0))
        found = (Interval.point(float(whole.hi.max())) + Interval.point(max(lift, 0.0))) / share
        return float(np.ravel(found.hi)[0])

    @property
    def lower(self) -> float:
        """The smallest mean time over the starts, at least."""
        error = -float(np.min(self.generated.lo)) - 1.0
        if not error < _WORST or any(self.free):
            return 0.0
        whole = self._over_starts()
        drop = max(float(self.values.hi[k]) for k in (0, -1))
        share = Interval.point(1.0) + Interval.point(max(math.nextafter(error, math.inf), 0.0))
        found = (Interval.point(float(whole.lo.min())) - Interval.point(max(drop, 0.0))) / share
        return max(float(np.ravel(found.lo)[0]), 0.0)

    @property
    def _bends_down(self) -> bool:
        """Whether the slope at a cut is no less than beyond it: then local time there only takes from m."""
        above = not self.free[1] or bool(self.at_nodes[-1] >= self.slope)
        return above and (not self.free[0] or bool(self.at_nodes[0] <= self.slope))

    def _over_starts(self) -> Interval:
        """m at the nodes among the starts, and over the cells between them."""
        first, last = np.searchsorted(self.nodes, self.starts)
        points = self.values[first : last + 1]
        if first == last:
            return points
        steps = Interval(np.zeros(last - first), np.nextafter(np.diff(self.nodes[first : last + 1]), np.inf))
        slopes = _quadratic(self.at_nodes, self.at_middles)[first:last]
        between = points[:-1] + steps * slopes
        return Interval(np.minimum(between.lo, points.lo[1:]), np.maximum(between.hi, points.hi[1:]))


def _sums(parts: Array, to: float) -> Array:
    """0 and the sums of the first parts, each of them rounded towards ``to``."""
    return np.array(list(accumulate(parts.tolist(), lambda a, b: math.nextafter(a + b, to), initial=0.0)))


def _quadratic(at_nodes: Array, at_middles: Array) -> Interval:
    """Ranges over the cells of quadratics by their values at both ends and the middle: those of the Bernstein form."""
    first, middle, last = Interval.point(at_nodes[:-1]), Interval.point(at_middles), Interval.point(at_nodes[1:])
    inner = middle * Interval.point(2.0) - (first + last) * Interval.point(0.5)
    rows = [inner.lo, at_nodes[:-1], at_nodes[1:]], [inner.hi, at_nodes[:-1], at_nodes[1:]]
    return Interval(np.min(rows[0], axis=0), np.max(rows[1], axis=0))


def _generated(model: _Model, nodes: Array, at_nodes: Array, at_middles: Array) -> Interval:
    """Ranges of L m = f m' + a m''/2 over the cells, both ends with them."""
    two, half = Interval.point(2.0), Interval.point(0.5)
    steps = Interval.point(nodes[1:]) - Interval.point(nodes[:-1])
    p, q, r = Interval.point(at_nodes[:-1]), Interval.point(at_middles), Interval.point(at_nodes[1:])
    slope = _quadratic(at_nodes, at_middles)
    bends = (two * two * q - (two + 1.0) * p - r) / steps, (p - two * two * q + (two + 1.0) * r) / steps
    bend = Interval(np.minimum(bends[0].lo, bends[1].lo), np.maximum(bends[0].hi, bends[1].hi))
    f, a = model.ranges(Interval(nodes[:-1], nodes[1:]))
    plain = f * slope + a * half * bend
    try:
        f_slope, a_slope, bent = model.slopes(Interval(nodes[:-1], nodes[1:]))
    except EnclosureError:
        return plain
    middles = nodes[:-1] + np.diff(nodes) / 2
    third = two * two * (p - two * q + r) / (steps * steps)
    change = f_slope * slope + f * bend + a_slope * half * bend + a * half * third
    # near the middle, where the quadratic is its value there and a little more
    off = Interval.point(middles) - (Interval.point(nodes[:-1]) + Interval.point(nodes[1:])) * half
    f_mid, a_mid = model.ranges(Interval.point(middles))
    middle_bend = (r - p) / steps + third * off
    centre = f_mid * (q + bend * off) + a_mid * half * middle_bend
    reach = np.nextafter(np.maximum(middles - nodes[:-1], nodes[1:] - middles), np.inf)
    around = centre + change * Interval(-reach, reach)
    known = np.isfinite(around.lo) & np.isfinite(around.hi) & ~bent
    low, high = np.where(known, np.maximum(around.lo, plain.lo), plain.lo), np.where(known, around.hi, plain.hi)
    return Interval(low, np.where(known, np.minimum(high, plain.hi), high))


def _collocated(model: _Model, nodes: Array, free: tuple[bool, bool], slope: float) -> tuple[Array, Array] | None:
    """m' at nodes and middles with L m = -1 at two points a cell, in floats; None where that has no solution.

    The integral of m' is 0, or m' is ``slope`` at the end beyond which m goes on. Unknown, too, is m at the nodes, so
    that the matrix has entries beside its diagonal only: three equations a cell, and one of each end.
    """
    from scipy.linalg import solve_banded

    count, steps = len(nodes) - 1, np.diff(nodes)
    first = 3 * np.arange(count)  # place of m at the cell's first node; m' there, and m' at the middle, come next
    entries = []
    for number, t in enumerate((0.5 - math.sqrt(1 / 12), 0.5 + math.sqrt(1 / 12))):
        f, a = model.values(nodes[:-1] + t * steps)
        shapes = (1 - t) * (1 - 2 * t), 4 * t * (1 - t), t * (2 * t - 1)
        slopes = 4 * t - 3, 4 - 8 * t, 4 * t - 1
        for place, shape, change in zip((1, 2, 4), shapes, slopes):
            entries.append((1 + number, place, f * shape + a / 2 * change / steps))
    entries += [(3, place, weight * steps) for place, weight in ((1, 1 / 6), (2, 4 / 6), (4, 1 / 6))]
    entries += [(3, 0, np.ones(count)), (3, 3, -np.ones(count))]
    matrix = np.zeros((2 * _BAND + 1, 3 * count + 2))
    for row, place, values in entries:
        matrix[_BAND + row - place, first + place] = values
    right = np.zeros(3 * count + 2)
    right[first + 1] = right[first + 2] = -1.0
    for row, place, is_free in ((0, 0, free[0]), (3 * count + 1, 3 * count, free[1])):
        matrix[_BAND + row - place - is_free, place + is_free] = 1.0
        right[row] = slope if is_free else 0.0
    if not np.isfinite(matrix).all():
        return None
    try:
        found = solve_banded((_BAND, _BAND), matrix, right, overwrite_ab=True, overwrite_b=True, check_finite=False)
    except np.linalg.LinAlgError:  # singular
        return None
    return (found[1::3], found[2::3]) if np.isfinite(found).all() else None
