"""The remainder of Thm K7 of paths that have not failed yet: they are in the safe set, which bounds it at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from certbound.arrays import Array
from certbound.constants.enclosures import enclose
from certbound.gaussian.response import WindowEvents
from certbound.problem.model import Tape
from certbound.problem.problem import Problem
from certbound.problem.sets import Region
from certbound.reach.linear import Events, Linearisation, LinearRun, Share
from certbound.rigor.intervals import Interval

_BEYOND = 1e4  # times the widest side of the safe set


class Survival(LinearRun):
    """`LinearRun` for paths that keep every constraint: the polytope of deviations is cut by the safe set.

    On such a path s = X - p lies within ``clip`` while the constraints hold, so that bounds of beta over the cut
    polytope imply bounds of R up to the first failure, whatever the noise, where the safe set bounds all coordinates
    that enter nonlinearly (``enclosed``), and on the event that the noise keeps its levels elsewhere.

    Parameters
    ----------
    rows : sequence of ndarray
        What R is bounded along beside the inner rows, one row a piece (a node in discrete time).
    """

    def __init__(self, engine: Linearisation, rows: Sequence[Array] = ()) -> None:
        super().__init__(engine)
        self.asked = list(rows)
        low, high = survivors(engine)
        active = engine.model.active
        self.clip = low[:, active], high[:, active]

    def outer(self, cell: int) -> list[Array]:
        """The rows of what is asked."""
        return self.asked

    def events(self, cell: int, shared: Share) -> Events:
        """See `LinearRun.events`; windows alone, whose levels are a little larger, and take a tenth of the time."""
        if not self.engine.continuous:
            return super().events(cell, shared)
        kept = self.memory.setdefault(cell, {})
        return WindowEvents(self.engine.response, cell, self.engine.window, shared.log, kept)

    @property
    def enclosed(self) -> bool:
        """Whether the safe set bounds all coordinates that enter nonlinearly, at all times."""
        return bool(np.all(np.isfinite(self.clip[0]) & np.isfinite(self.clip[1])))

    @property
    def unbounded_levels(self) -> Array:
        """Levels of |Z| beyond everything in the safe set: they cost nothing where it is ``enclosed``."""
        widest = float(np.max(self.clip[1] - self.clip[0], initial=1e-300))
        return np.full(self.rows.shape[:3], _BEYOND * widest)

    def polytope(self, levels: Array, remainder: list[tuple[Array, Array]]) -> tuple[Array, Array]:
        """See `Inclusion.polytope`; cut by the safe set, which is all there is without levels."""
        low, high = super().polytope(levels, remainder)
        count = len(self.engine.model.active)
        if self.enclosed and np.all(levels >= self.unbounded_levels):
            low[:], high[:] = -np.inf, np.inf
        cut = np.maximum(low[:, :count], self.clip[0]), np.minimum(high[:, :count], self.clip[1])
        met = np.all(cut[0] <= cut[1], axis=1)[:, None]  # elsewhere no path survives: any bounds will do
        low[:, :count], high[:, :count] = (np.where(met, own, old[:, :count]) for own, old in zip(cut, (low, high)))
        for d in range(count, self.inner):  # the other rows see these coordinates alone
            row = self.flat_extra[:, d - count]
            ends = row * low[:, :count], row * high[:, :count]
            slack = 1e-15 * (np.abs(ends[0]) + np.abs(ends[1])).sum(axis=1)
            least, most = np.minimum(*ends).sum(axis=1) - slack, np.maximum(*ends).sum(axis=1) + slack
            met = np.maximum(low[:, d], least) <= np.minimum(high[:, d], most)
            low[:, d] = np.where(met, np.maximum(low[:, d], least), least)
            high[:, d] = np.where(met, np.minimum(high[:, d], most), most)
        return low, high


def survivors(engine: Linearisation) -> tuple[Array, Array]:
    """Bounds of X - p while no constraint is broken, (N, n) each: infinite where none bounds a state.

    Proves: over piece k (at step k in discrete time) they hold wherever the constraints hold that are asked on all of
    that piece; p is the nominal curve of the only cell.
    """
    problem: Problem = engine.problem
    curve = engine.nominal(0)
    n, count = engine.n, engine.pieces
    low, high = np.full((count, n), -np.inf), np.full((count, n), np.inf)
    span = curve.span()
    for constraint in problem.kept:
        if constraint.outside:
            continue
        kept = np.ones(count, dtype=bool)
        if constraint.during is not None:
            kept = ((span.lo >= constraint.during[0]) & (span.hi <= constraint.during[1]))[:count]
        region = constraint.region
        hull, places = centre_over(region, span) + region.extent(), region.places(n)
        own = np.where(kept[:, None], [hull.lo[:count], -hull.hi[:count]], -np.inf)
        low[:, places], high[:, places] = np.maximum(low[:, places], own[0]), np.minimum(high[:, places], -own[1])
    least, most = engine.controls[0].min(axis=1)[:count], engine.controls[0].max(axis=1)[:count]
    with np.errstate(invalid="ignore"):
        return np.nextafter(low - most, -np.inf), np.nextafter(high - least, np.inf)


def centre_over(region: Region, span: Interval) -> Interval:
    """Where the centre of a set is over intervals of time (K,): (K, k)."""
    count = len(span.lo)
    if not isinstance(region.center, Tape):
        return Interval.point(np.broadcast_to(region.center_at(), (count, region.dimension)))
    return enclose(region.center, [span]).broadcast_to((count, region.dimension))
