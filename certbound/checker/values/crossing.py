"""Continuous time, from below: V of the file is proved to be, but for what is paid, below log of the probability.

On a box of states, some of whose sides break a constraint, with R and Q2 as in `passage`:

- V <= 0 on the box at all times (what it exceeds is taken off everywhere);
- R >= -lam_k - eps_k exp(v0 - V) - m(V) Q2 in slab k, for one value of the disturbance on every patch where
  exp(V) > W somewhere, v0 being at most V(0, .) at one of the stated starts;
- m is a step function of the level, q is continuous and linear on every step, q = 0 below the lowest one, q >= 0, and
  q' >= (1 + q)(m - q).

Then w = exp(theta(V)), theta(V) = V - int_V^0 q, has w_t + L w >= -M (lam_k w + eps_k exp(v0)) with M = 1 + max q,
since theta' = 1 + q is in [1, M], theta'' + theta'^2 - theta' >= m theta' and theta(V) <= V <= 0. With L the integral
of lam,

    P + (1 - P) W >= exp(theta(v0) - M L) - M exp(v0) sum_k eps_k h_k

for the probability P of reaching such a side within T, W being at least exp(V) at T, and on the other sides: the
process is stopped there, and where exp(V) <= W. The disturbance is a feedback, piecewise constant in time and state:
where it takes more than one value the noise is shown to have full rank, so that the equation with it has a (weak)
solution.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from flint import arb

from certbound.checker.report import FUNCTION, Unproved
from certbound.checker.statement import SafeSet, starts_of
from certbound.checker.values import batches as tm
from certbound.checker.values.batches import Array, Batch, Mask, Terms, above, below, terms
from certbound.checker.values.hermite import Patches
from certbound.checker.values.passage import Passage


class Crossing(Passage):
    """The proof's numbers, and what follows from them for the lower bound."""

    upper_side = False
    stopped = -np.inf

    def lower(self) -> arb:
        """At most the probability of leaving from one of the stated starts, or from a random one."""
        if self.model.ends:
            self._check_domain()
        self.lowered(self._highest())
        return self.crossed([self])

    def lowered(self, highest: float) -> None:
        """Take off what V exceeds."""
        self.lift = -float(np.nextafter(highest, np.inf)) if not highest <= 0 else 0.0

    def crossed(self, stages: Sequence[Crossing]) -> arb:
        """The same over stages that follow each other, this one being the first; all are lowered."""
        for stage in stages:
            stage._expect()
        ceiling = max(stage.ceiling() for stage in stages)
        for stage in stages:
            stage.stopped = ceiling
        start = self._level()
        slabs = [paid for stage in stages for paid in stage.paid(start)]
        lam, rest = (sum(parts, arb(0)) for parts in zip(*slabs))
        most = 1 + arb(max(self.levels.q))
        if self.random:
            growth = self.levels.above(arb(self.levels.edges[0]))
            found = self._mean(lambda low, _: (arb(low) - growth - most * lam).exp(), self._certain)
        else:
            found = (arb(start) - self.levels.above(arb(start)) - most * lam).exp()
        if not ceiling < 0:
            return arb(0)
        kept = arb(ceiling).exp()
        left = found - most * arb(start).exp() * rest
        return arb.max((left - kept) / (1 - kept), arb(0)).lower()

    def _expect(self) -> None:
        """Refuse more patches than can be looked at, each of them once by the dynamics."""
        if self.due is None:
            which = terms(self._variables(), self.degrees[0], self.budget)
            patches = (len(self.surface.times) - 1) * math.prod(self.surface.cells)
            self.budget.expect(which.numbers(patches) * len(self.model.dynamics.nodes))

    def ceiling(self) -> float:
        """At least V where a path ends that has not failed."""
        return max([self._at_end(), *(self._on(*side) for side in self._harmless_sides())])

    def _level(self) -> float:
        """At most V(0, .) at the best of the stated starts; of a random one, about what its mean comes to."""
        if self.random:
            return self._middle()
        sides = [(arb(float(axis[0])), arb(float(axis[-1]))) for axis in self.surface.axes]
        found = -np.inf
        for point in starts_of(self.model, self.record):
            if not all(a < x < b for (a, b), x in zip(sides, point)):
                raise Unproved("a start was not shown to lie in the grid")
            low, _ = self._over([below(x) for x in point], [above(x) for x in point])
            found = max(found, float(low.max()))
        return float(np.nextafter(found + self.lift, -np.inf))

    def _harmless_sides(self) -> list[tuple[int, int]]:
        """(state, end) of the sides of the grid that were not shown to break a constraint everywhere."""
        broken = self.excluded(self.limits())
        return [side for side in itertools.product(range(self.model.dimension), (0, 1)) if side not in broken]

    def _check_domain(self) -> None:
        """Where a path ends as it leaves the domain, the grid lies in it."""
        ends = [(arb(float(axis[0])), arb(float(axis[-1]))) for axis in self.surface.axes]
        domain = SafeSet(replace(self.model, constraints=self.model.constraints[-1:]), bounded=False)
        if not domain.holds([(a + b) / 2 for a, b in ends], [(b - a) / 2 for a, b in ends]):
            raise Unproved("the grid was not shown to lie in the domain, where a path ends as it leaves that")

    def _certain(self, end: float, far: float) -> bool:
        """Whether all starts between a side of the grid and far beyond it break a constraint."""
        low, high = arb(min(end, far)), arb(max(end, far))
        return SafeSet(self.model, bounded=False).excludes([(low + high) / 2], [(high - low) / 2])

    def _highest(self) -> float:
        """At least V, everywhere."""
        n, highest = self.model.dimension, -np.inf
        which = terms(1 + n, 3 + 5 * n, self.budget)
        for first, last, cells in self.surface.blocks():
            patches = self.surface.patches(first, last, cells)
            if self.due is not None:
                patches = patches.take(np.flatnonzero(np.tile(self.due[cells].ravel(), last - first)))
                if not patches.low.shape[1]:
                    continue
            _, high = patches.derivative(which, (0,) * (n + 1)).sharp_ends()
            highest = max(highest, _most(high))
        if not highest < np.inf:
            raise Unproved("V was not shown to be bounded")
        return highest

    def _at_end(self) -> float:
        """At least V at the horizon."""
        return float(np.nextafter(_most(self.last_ends()[1]) + self.lift, np.inf))

    def _on(self, axis: int, end: int) -> float:
        """At least V on a side of the grid."""
        return float(np.nextafter(self.across(axis, -end)[1].max() + self.lift, np.inf))

    def _variables(self) -> int:
        """The disturbance takes fixed values."""
        return 1 + self.model.dimension

    def _need(self, patches: Patches, eps: Array, start: float, which: Terms) -> Array:
        low, high = patches.derivative(which, (0,) * (self.model.dimension + 1)).sharp_ends()
        low, high = np.nextafter(low + self.lift, -np.inf), np.nextafter(high + self.lift, np.inf)
        m = self.levels.least(low, high)
        inputs = self._inputs(patches, which)
        squares = self._squares(inputs)
        ends = [sorted({a, b}) for a, b in self.model.disturbance]
        many = math.prod(map(len, ends))
        self.budget.floats(many * len(eps), many)
        best = np.full(len(eps), -np.inf)
        for corner in itertools.product(*ends):
            pushed = [tm.fixed(which, np.full(len(eps), value)) for value in corner]
            found = self._balance(patches, inputs + pushed, squares, 1 + m, (1 + m) * 2.0**-52).sharp_ends()[0]
            best = np.where(np.isfinite(found), np.maximum(best, found), best)
        if many > 1:
            best = np.where(has_full_rank(squares), best, -np.inf)
        self.budget.balls(len(eps), FUNCTION)
        reach = np.array([below(arb(x).exp()) for x in np.minimum(start - high, 600.0)])
        need = (-best - eps * reach * (1 - 1e-12)) * (1 + 1e-12)
        need = np.where(np.isfinite(best), np.maximum(need, 0.0), np.inf)
        return np.where(high <= self.stopped, 0.0, need)


def _most(values: Array) -> float:
    """The largest of some numbers; infinity where one is none."""
    return float(np.where(np.isnan(values), np.inf, values).max())


def has_full_rank(squares: list[list[Batch]]) -> Mask:
    """Where g g^T is positive definite."""
    good = np.asarray(squares[0][0].ends()[0] > 0)
    if len(squares) == 2:
        product = tm.mul(squares[0][0], squares[1][1])
        good = good & (tm.sub(product, tm.mul(squares[0][1], squares[0][1])).ends()[0] > 0)
    return good
