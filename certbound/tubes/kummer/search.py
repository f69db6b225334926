"""Floating-point search for the Kummer parameters (a, v_0): it proposes, ball arithmetic certifies.

The unknowns are 2/(1 + a) and log(v_0/(1 + a)) (Bessel form: log a alone): a large a wants a large v_0, and an
infinite one is an edge of the box. A coarse grid gives the start, the simplex method of Nelder and Mead the end.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from certbound.arrays import Array, Index
from certbound.tubes.excess import log_excess_value, log_excess_values, log_phi, log_phi_one, solve_excess
from certbound.tubes.kummer.profile import log_initial, log_target
from certbound.tubes.objective import mean_over_time
from certbound.tubes.question import Question, Start
from certbound.tubes.schedule import Schedule

Point = tuple[float, ...]

_POWERS = np.array([0.1, 1.5, 20.0])
_SPREADS = np.log(10.0) * np.array([-2.0, -0.9, -0.2, 0.6])
_MODERATE = (0.4, 5.0, 50.0)
_SPAN = 2.0  # of the first unknown
_LARGEST = 1e4  # power a
_FEW = 16
_DIGITS = 1e-8
_OVERFLOWING = 1e300  # variance beyond which nothing is looked for


@dataclass(frozen=True, eq=False, kw_only=True)
class Search:
    """One tuning problem on the nodes of a (graded) schedule."""

    schedule: Schedule  # data; its piece ends are the nodes
    kind: str  # ``"scale"`` (least s with r_t <= s clearance_t), ``"final"``, ``"mean"``, or ``"probability"`` (Thm K2)
    weights: Array  # (K + 1,): clearance at the nodes (infinite where nothing is asked); ones for the largest radius
    log_delta: float = 0.0  # level of the tube (unused for ``"probability"``)
    bessel: bool = False  # search the Bessel form
    start: Start = field(default_factory=Start)  # deviation at time 0

    @classmethod
    def of(
        cls, question: Question, schedule: Schedule, *, bessel: bool = False, log_delta: float | None = None
    ) -> Search:
        """The search on a graded schedule of the question's data; for the least probability without ``log_delta``."""
        return cls(
            schedule=schedule, kind="probability" if log_delta is None else question.goal.kind, bessel=bessel,
            weights=question.goal.weights(schedule), log_delta=log_delta or 0.0, start=question.start,
        )  # fmt: skip

    @cached_property
    def reference(self) -> float:
        """Scale of v_0: the largest variance, in the moving coordinates where it grows; I_0 = 1 in the Bessel form."""
        if self.bessel:
            whole = float(self.schedule.path(np.asarray(1.0), bessel=True)[1][0])
            return min(max(whole, 1e-290), 1e300)
        gain, variance = self.schedule.nodes
        finite = np.isfinite(variance) & np.isfinite(gain)
        top = float(np.max(variance[finite] / np.maximum(gain[finite], 1.0)))
        return max(top + self._spread, 1e-290)

    @property
    def _spread(self) -> float:
        """Variance of a random start, which v_0 must exceed, in the schedule's unit."""
        return min((self.start.sigma / self.schedule.unit) ** 2, _OVERFLOWING)

    @cached_property
    def _least(self) -> float:
        """First unknown at the largest a that Thm K1 allows; a probability hardly gains from the last decade."""
        largest = 1 + self.schedule.nu / 2 * (1 - 1e-9)
        if self.schedule.any_power:
            largest = _LARGEST / 10 if self.kind == "probability" else _LARGEST
        return _SPAN / largest

    @cached_property
    def half(self) -> float:
        """nu/2."""
        return self.schedule.nu / 2

    @cached_property
    def _norm(self) -> float:
        """Least clearance in the schedule's unit: scales are measured by it, lest their squares overflow."""
        least = float(np.min(self.weights))
        return least / self.schedule.unit if least < math.inf else 1.0

    @cached_property
    def _squares(self) -> Array:
        return (self.weights / self.schedule.unit / self._norm) ** 2

    def solve(self) -> tuple[float, float]:
        """The best (a, v_0) found."""
        if self.kind == "probability":
            return self._parameters(self._minimise(self._starts, self._at(1.0), 0.5, 1e-3))
        if self.kind == "mean":
            return self._parameters(self._minimise(self._starts, self.scale, 0.5, 1e-9))
        # the best parameters for a scale s are those that make P least there: alternate, s falls
        points, step, scale = self._starts, 0.5, self._typical()
        for tolerance in (1e-2, 1e-6 if self._constant else 1e-3):
            scale = self.scale(*self._parameters(points[0]), guess=scale)
            if not math.isfinite(scale):
                return self._parameters(points[0])
            points = [self._minimise(points, self._at(scale), step, tolerance)]
            step = 0.05
        if not self._constant:  # where several nodes decide, s falls too slowly
            fine = 1e-6 if len(self._pieces) <= _FEW else 1e-4
            points = [self._minimise(points, lambda a, v0: self.scale(a, v0, guess=scale) / scale, 0.1, fine)]
        return self._snapped(*self._parameters(points[0]), scale)

    def _snapped(self, a: float, v0: float, scale: float) -> tuple[float, float]:
        """The corners where the objective has kinks are tried as well: a = 0 and the constant v."""
        rate, noise = float(self.schedule.rates[0]), float(self.schedule.noise[0])
        pairs = [(a, v0)]
        if not self.bessel:
            pairs.insert(0, (0.0, v0))
            if rate < 0 and noise > 0 and np.all(self.schedule.rates == rate) and np.all(self.schedule.noise == noise):
                pairs = [(0.0, noise / (-2 * rate)), (a, noise / (-2 * rate)), *pairs]
        scale = self.scale(a, v0, guess=scale)
        if not math.isfinite(scale):
            return a, v0
        # between nodes a falling v costs more than the nodes show: a corner wins a near tie, of 1e-5 in the scale
        values = [self.log_probability(*pair, scale) for pair in pairs]
        tie = min(values) + 2e-5 * max(1.0, -self.log_delta)
        return next(pair for pair, value in zip(pairs, values) if value <= tie)

    def worse_than(self, value: float) -> bool:
        """Whether the best point of the grid exceeds an objective."""
        a, v0 = self._parameters(self._starts[0])
        if self.kind == "mean":
            return self.scale(a, v0) > value
        return self.log_probability(a, v0, value) > self.log_delta

    def _at(self, scale: float) -> Callable[[float, float], float]:
        return lambda a, v0: self.log_probability(a, v0, scale)

    def _minimise(
        self, starts: list[Point], function: Callable[[float, float], float], step: float, tolerance: float
    ) -> Point:
        return min(
            simplex(
                lambda p: function(*self._parameters(p)), start, step, tolerance=tolerance,
                width=0.2 if tolerance >= 1e-3 else 0.05, low=(-650.0 if self.bessel else self._least, -650.0),
                high=(math.log(_LARGEST) if self.bessel else _SPAN, 650.0),
            ) for start in starts
        )[1]  # fmt: skip

    def _parameters(self, point: Point) -> tuple[float, float]:
        """(a, v_0) of a point of the search: the Bessel form has one free parameter."""
        if self.bessel:
            return math.exp(point[0]), self.reference
        over = _SPAN / point[0]
        return over - 1, over * math.exp(point[1])

    def log_probability(self, a: float, v0: float, scale: float) -> float:
        """Logarithm of Thm K2's bound for the clearance ``scale`` times ``weights``."""
        scale *= self._norm
        if len(self._pieces) <= _FEW:
            return self._short(a, v0, scale)
        v, info = self.schedule.path(np.asarray(v0), bessel=self.bessel)
        if not np.max(v) < _OVERFLOWING:
            return math.inf
        log_x = log_initial(self.schedule, a, v0, float(info[0]), self.start, self.bessel)
        if not math.isfinite(log_x):
            return math.inf
        if scale * scale == math.inf:
            return -math.inf
        active = self._active(v)
        z, left = scale**2 * self._squares[active] / (2 * v[active]), info[active]
        if len(active) <= _FEW:
            return log_x - min(self._log_gain(a, i, x) for i, x in zip(left.tolist(), z.tolist()))
        with np.errstate(divide="ignore"):
            base = np.log(left) + log_phi(a * left)
        excess = log_excess_values(a, self.half, z, bessel=self.bessel) + a * left
        return log_x - float(np.min(np.logaddexp(base, excess)))

    def _log_gain(self, a: float, info: float, z: float) -> float:
        return log_gain(a, self.half, info, z, self.bessel)

    @cached_property
    def _pieces(self) -> list[tuple[float, float, float, float, float]]:
        """(gain, variance, square at the end; backward, drift) per piece, the last one first."""
        gain, variance = self.schedule.nodes
        backward, drift = self.schedule.backward
        weights = self._squares[1:].copy()
        if self.kind == "final":
            weights[:-1] = np.inf
        columns = (gain[1:], variance[1:], weights, backward, drift)
        return list(zip(*(column[::-1].tolist() for column in columns)))

    def _short(self, a: float, v0: float, scale: float) -> float:
        """The same for few pieces: plain numbers are quicker than short arrays."""
        info, record, least = 0.0, 0.0, math.inf
        moving = 0.0 if self.bessel else 1.0
        pieces = self._pieces
        last = len(pieces) - 1
        for j, (gain, variance, square, backward, drift) in enumerate(pieces):
            v = gain * v0 + moving * variance
            if v > record * square:
                record = v / square
                least = min(least, self._log_gain(a, info, scale * scale / (2 * record)))
            before = v0 if j == last else pieces[j + 1][0] * v0 + moving * pieces[j + 1][1]
            if not (before > 0 and v < math.inf):
                return math.inf
            part = backward / before
            info += part if self.bessel else (math.log1p(part) if part < 1 else math.log(v / before) - drift)
        first = self._squares[0]
        if (self.schedule.continuous or self.start.sigma > 0) and self.kind != "final" and v0 > record * first:
            least = min(least, self._log_gain(a, info, scale * scale * float(first) / (2 * v0)))
        log_x = log_initial(self.schedule, a, v0, info, self.start, self.bessel)
        return log_x - least if math.isfinite(log_x) else math.inf

    def scale(self, a: float, v0: float, guess: float | None = None) -> float:
        """Least scale (or mean radius) of Thm K1's tube for stated parameters."""
        if self.kind == "mean":
            return self._mean(a, v0)
        # Thm K2 gives delta there: secants inside a bracket, on a value that does not explode
        guess = guess or self._typical()
        x, low, high, reach = (math.log(guess) if guess > 0 else 0.0), -math.inf, math.inf, 1.0
        slope, before = 2 * min(self.log_delta, -1.0), (math.nan, math.nan)
        for _ in range(80):
            if not -650 < x < 650:
                return math.inf
            excess = self.log_probability(a, v0, math.exp(x)) - self.log_delta
            if not math.isfinite(excess):
                return math.inf
            low, high = (x, high) if excess > 0 else (low, x)
            value = math.asinh(excess)
            change = (value - before[1]) / (x - before[0])
            before = x, value
            if change > -0.01:  # flat
                reach *= 4
                step = math.copysign(reach, value)
            else:
                slope = slope if math.isnan(change) else change
                step = min(max(-value / slope, -reach), reach)
            if abs(step) < 1e-7 and abs(excess) < 1e-2:
                return math.exp(x + step)
            x = x + step if low < x + step < high else (low + high) / 2
            if x == before[0]:  # no floats are left between the ends
                return math.exp(x)
        return math.inf

    def _mean(self, a: float, v0: float) -> float:
        """Mean radius of Thm K1's tube."""
        v, info = self.schedule.path(np.asarray(v0), bessel=self.bessel)
        log_x = log_initial(self.schedule, a, v0, float(info[0]), self.start, self.bessel)
        if not math.isfinite(log_x):
            return math.inf
        with np.errstate(over="ignore", invalid="ignore"):
            z = solve_excess(np.asarray(a), self.half, log_target(a, info, log_x, self.log_delta), bessel=self.bessel)
            return mean_over_time(self.schedule, np.sqrt(2 * v * z) * self.schedule.unit)

    def _active(self, v: Array) -> Index:
        """Nodes that no later node dominates: z_t rises in t, so only records of v/clearance^2 from the end count."""
        if self.kind == "final":
            return np.array([len(v) - 1])
        first = 0 if self.schedule.continuous or self.start.sigma > 0 else 1
        ratio = (v / self._squares)[first:]
        later = np.maximum.accumulate(ratio[::-1])[::-1]
        keep = np.append(ratio[:-1] > later[1:], True)
        return np.flatnonzero(keep & (ratio > 0)) + first

    @cached_property
    def _starts(self) -> list[Point]:
        """Best points of a coarse grid, judged by Thm K2 at a typical scale: one per power, the best first.

        Constant data has one valley, and one start is enough.
        """
        if self.bessel:
            lines: list[list[Point]] = [[(x,) for x in np.linspace(-3.0, 7.0, 9).tolist()]]
        else:
            powers = np.unique(np.maximum(_SPAN / (1 + _POWERS), self._least * 1.001)).tolist()
            logs = (math.log(self.reference) + _SPREADS).tolist()
            lines = [[(x, y - min(math.log(_SPAN / x), math.log(2.0))) for y in logs] for x in powers]
        judge = self._at(1.0 if self.kind == "probability" else self._typical())
        best = [min((judge(*self._parameters(point)), point) for point in line) for line in lines]
        best = sorted((value if value == value else math.inf, point) for value, point in best)
        return [point for _, point in best[: 1 if self._constant else None]]

    @cached_property
    def _constant(self) -> bool:
        """Constant data and clearance."""
        data, squares = self.schedule, self._squares
        return all(bool(np.all(column == column[0])) for column in (data.rates, data.noise, squares))

    def _typical(self) -> float:
        """A scale of the right size: Gaussian tail at the node of the largest variance."""
        gain, variance = self.schedule.nodes
        with np.errstate(over="ignore", invalid="ignore"):
            variance = variance + gain * self._spread if self._spread > 0 else variance
        variance = np.where(np.isfinite(variance), variance, 0.0)
        roots = np.sqrt(variance) * (self.schedule.unit / self.weights)
        size = roots[-1] if self.kind == "final" else np.max(roots)
        tail = max(1e-3, -self.log_delta)
        return float(size * math.sqrt(2 * self.half + 2 * math.sqrt(2 * self.half * tail) + 2 * tail))


def moderate_parameters(schedule: Schedule) -> Iterator[tuple[float, float]]:
    """A coarse grid of (a, v_0), for when a search has lost its way."""
    limit = math.inf if schedule.any_power else schedule.nu / 2 * (1 - 1e-9)
    variance = schedule.nodes[1]
    scale = float(np.max(np.where(np.isfinite(variance), variance, 0.0))) or 1.0
    for a in sorted({min(power, limit) for power in _MODERATE}):
        for ratio in 10.0 ** np.arange(-3.0, 3.1, 0.5):
            yield a, float(ratio * scale)


def log_gain(a: float, half: float, info: float, z: float, bessel: bool) -> float:
    """log of phi(I) + e^{a I} E_a(z), to 7 digits."""
    if not z > 0:
        return -math.inf if info <= 0 else math.log(info) + log_phi_one(a * info)
    excess = log_excess_value(a, half, z, bessel=bessel, digits=_DIGITS) + a * info
    return excess if info <= 0 else _log_add(math.log(info) + log_phi_one(a * info), excess)


def _log_add(x: float, y: float) -> float:
    top, low = (x, y) if x > y else (y, x)
    return top + math.log1p(math.exp(low - top)) if top > -math.inf else top


def simplex(
    function: Callable[[Point], float],
    start: Sequence[float],
    step: float,
    *,
    tolerance: float,
    low: Sequence[float],
    high: Sequence[float],
    width: float = 0.05,
    budget: int = 160,
) -> tuple[float, Point]:
    """Least value found in a box, and its place (Nelder-Mead; points beyond the box are moved to its edge).

    Ends when the values agree within ``tolerance`` and the points within ``width``.

    The objectives are smooth near their minimum. Plain numbers: for one or two unknowns they are quicker than arrays.
    """
    size = len(start)

    def inside(point: Iterable[float]) -> Point:
        return tuple(min(max(x, a), b) for x, a, b in zip(point, low, high))

    def beyond(factor: float) -> tuple[float, Point]:
        point = inside(x + factor * (x - y) for x, y in zip(centre, worst))
        return function(point), point

    points = [inside(start)]
    for i, x in enumerate(points[0]):
        moved = x + step if x + step <= high[i] else x - step
        points.append((*points[0][:i], moved, *points[0][i + 1 :]))
    pairs = sorted((function(p), p) for p in points)
    used = size + 1
    while used < budget:
        (least, best), (most, worst) = pairs[0], pairs[-1]
        if not math.isfinite(least):
            break
        spread = max(abs(x - y) for _, p in pairs[1:] for x, y in zip(p, best))
        if (most - least <= tolerance and spread < width) or spread < 1e-7:
            break
        centre = [sum(column) / size for column in zip(*(p for _, p in pairs[:-1]))]
        pair = beyond(1.0)
        used += 1
        if pair[0] < least:
            pairs[-1] = min(pair, beyond(2.0))
            used += 1
        elif pair[0] < pairs[-2][0]:
            pairs[-1] = pair
        else:
            nearer = beyond(0.5 if pair[0] < most else -0.5)
            used += 1
            if nearer[0] < min(pair[0], most):
                pairs[-1] = nearer
            else:
                halved = [tuple((x + y) / 2 for x, y in zip(p, best)) for _, p in pairs[1:]]
                pairs[1:] = [(function(p), p) for p in halved]
                used += size
        pairs.sort()
    return pairs[0]
