"""What the start makes of V(0, .): its extreme over a set, or the logarithm of the mean of e^V over a random start."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from flint import arb

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.problem import Problem
from certbound.rigor.balls import lower, precision, upper
from certbound.rigor.intervals import Interval
from certbound.values.continuous.hypotheses import extreme_over
from certbound.values.continuous.line.joins import Profile
from certbound.values.continuous.line.phases import Phase
from certbound.values.continuous.surface import Surface
from certbound.values.room import points_of

_PARTS = 24


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Start:
    """An interval of starts, or a normal one (``mean``, ``variance``).

    Its ends are rounded outward; where it may be larger than the set by that, ``points`` lie in the set.
    """

    low: float
    high: float
    points: Array | None = None
    mean: float = 0.0
    variance: float = 0.0

    @property
    def random(self) -> bool:
        """Whether the start is drawn."""
        return self.variance > 0

    def end(self, side: int) -> tuple[Start, Start]:
        """The lowest (-1) or highest (1) start, rounded outward; and an interval from it to one of the starts."""
        place = self.low if side < 0 else self.high
        near = place if self.points is None else side * float(np.max(side * self.points[:, 0]))
        return Start(low=place, high=place), Start(low=min(place, near), high=max(place, near))

    def highest(self, surface: Surface, phase: Phase) -> float:
        """An upper bound of V(0, .) over the set, or of log E e^V(0, .), starts off the grid counting 1."""
        if not self.random:
            if phase.origin is None and phase.width is None:
                return extreme_over(surface, [(self.low, self.high)], upper=True)
            return float(self._over(surface, phase).hi.max())
        edges, mass = self._masses(surface, phase, most=True)
        value = Profile(surface, 0).over(Interval(edges[:-1], edges[1:]))[0].hi
        total = float(np.sum(mass[1:-1] * np.exp(np.minimum(value, 700.0)))) + mass[0] + mass[-1]
        return math.log(total) + 1e-12 * (1 + abs(math.log(total)))

    def lowest(self, surface: Surface, phase: Phase) -> float:
        """A lower bound of V(0, .) at the best start, or of log E e^V(0, .), starts off a closed face counting 1."""
        if not self.random:
            if phase.origin is None and phase.width is None:
                return extreme_over(surface, [(self.low, self.high)], upper=False, points=self.points)
            return float(self._over(surface, phase).lo.max())
        edges, mass = self._masses(surface, phase, most=False)
        value = Profile(surface, 0).over(Interval(edges[:-1], edges[1:]))[0].lo
        total = float(np.sum(mass[1:-1] * np.exp(value)))
        total += sum(float(mass[end]) for end, closed in zip((0, -1), phase.closed) if closed)
        return math.log(total) - 1e-12 * (1 + abs(math.log(total))) if total > 0 else -math.inf

    def _over(self, surface: Surface, phase: Phase) -> Interval:
        """V(0, .) over parts of the set; all reals for those that stick out of the grid."""
        cuts = np.linspace(self.low, self.high, _PARTS + 1 if self.low < self.high else 2)
        cuts[0], cuts[-1] = self.low, self.high
        return Profile(surface, 0).over(phase.local(Interval(cuts[:-1], cuts[1:]), phase.start))[0]

    def _masses(self, surface: Surface, phase: Phase, *, most: bool) -> tuple[Array, Array]:
        """Edges of parts of the cells, and bounds of the start's mass below, on and above each of these parts."""
        nodes = surface.axes[0]
        cuts = (nodes[:-1, None] + np.diff(nodes)[:, None] * (np.arange(_PARTS) / _PARTS)).ravel()
        edges = np.unique(np.concatenate([cuts, nodes]))
        x = phase.place(Interval.point(edges), phase.start)
        with precision():
            root = (arb(self.variance) * 2).sqrt()

            def below(place: float) -> arb:
                return ((arb(self.mean) - arb(place)) / root).erfc() / 2

            low = [below(float(v)) for v in x.lo]
            high = low if np.array_equal(x.lo, x.hi) else [below(float(v)) for v in x.hi]
            if most:
                parts = [upper(b - a) for a, b in zip(low[:-1], high[1:])]
                ends = (upper(high[0]), upper(1 - low[-1]))
            else:
                parts = [max(lower(a - b), 0.0) for a, b in zip(low[1:], high[:-1])]
                ends = (max(lower(low[0]), 0.0), max(lower(1 - high[-1]), 0.0))
        return edges, np.array([ends[0], *parts, ends[1]])


def start_of(problem: Problem) -> Start:
    """The start of a problem in one state."""
    initial = problem.initial
    if initial.random:
        mean, variance = float(initial.mean[0]), float(initial.covariance[0, 0])
        return Start(low=mean, high=mean, mean=mean, variance=variance)
    around = initial.hull()
    if not np.isfinite([around.lo[0], around.hi[0]]).all():
        raise InfeasibleError("value functions need a bounded set of starts.")
    return Start(low=float(around.lo[0]), high=float(around.hi[0]), points=points_of(problem))
