"""Which search finds the metric of least erosion: a barrier, semidefinite programs, or a mean of Riccati metrics.

What does not depend on the constraint (the metric of least c or L, a point in the middle of what is feasible) is found
once and shared by all constraints of a problem.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from certbound.arrays import Array
from certbound.constants.jacobians import AffineForm, AffineSet, JacobianSet
from certbound.constants.programs.centers import center_multipliers
from certbound.constants.programs.erosion_barrier import ErosionBarrier, Point
from certbound.constants.programs.least_erosion import (
    RadiusModel,
    Rooms,
    TightMetric,
    erosion_factors,
    noise_numbers,
    tighten,
)
from certbound.constants.programs.proposals import (
    MOST_STATES,
    Proposal,
    normalised,
    rate_proposals,
    spectral_bound,
)
from certbound.constants.programs.riccati import pencil
from certbound.constants.programs.sectors import Sector, lmi_blocks
from certbound.watch import poll

FEW_VERTICES = 4
"""Up to so many vertices each has an inequality of its own, in semidefinite programs."""
_SHIFT = -2.5
_SHIFTS = (-5.0, -4.0, -3.0, -2.25, -1.5, -0.75, 0.0, 0.75)
_SHARES = (1e-4, 1e-3, 1e-2, 0.05, 0.3)


class ErosionSearch:
    """Metrics of least erosion of one Jacobian set, for one constraint after the other.

    ``noise`` are the noise matrices (n, m) at unit proxy. SolverError where not even the metric of least c or L is
    found.
    """

    def __init__(self, members: JacobianSet, noise: Sequence[Array], radius: RadiusModel) -> None:
        self.members, self.noise, self.radius = members, noise, radius
        self.start: Proposal = rate_proposals(members, continuous=radius.continuous, share=2e-3)[0]
        structured = isinstance(members, AffineSet | AffineForm) and members.vertex_count > FEW_VERTICES
        self.block: Sector | None = None
        if structured:
            (block,) = lmi_blocks(members, form="sector")
            assert isinstance(block, Sector)
            self.block = block
        self._central: Point | None = None

    def proposals(self, targets: Rooms) -> list[Proposal]:
        """The tightened metric, and the one of least c or L that it was searched from."""
        result = self._tightened(targets)
        metric = None if result is None else normalised(result.metric)
        if result is None or metric is None:
            return [self.start]
        return [Proposal(metric=metric, status=f"tightening: {result.status}"), self.start]

    def _tightened(self, targets: Rooms) -> TightMetric | None:
        found = None
        if self.block is not None and self.members.dimension <= MOST_STATES:
            found = self._by_barrier(self.block, targets)
        elif self.block is not None:
            return self._by_means(self.block, targets)
        if found is None:
            form = "vertices" if self.block is None or self.members.vertex_count <= 16 else "sector"
            found = tighten(self.members, targets, self.noise, self.radius, self.start.metric, form=form)
        return found

    @cached_property
    def _least(self) -> float:
        return spectral_bound(self.members, continuous=self.radius.continuous)

    def _by_barrier(self, block: Sector, targets: Rooms) -> TightMetric | None:
        """Newton's method from the middle of what is feasible; None where there is no place to start."""
        barrier = ErosionBarrier(block, targets, self.noise, self.radius, self._least)
        if self._central is None:
            center = center_multipliers(self.start.metric, block, continuous=self.radius.continuous)
            point = barrier.start(center.metric, center.multipliers[0], _SHIFT)
            if point is None:
                return None
            self._central = barrier.search(point, (64.0,))
        barrier.search(self._central)
        return barrier.best

    def _by_means(self, block: Sector, targets: Rooms) -> TightMetric | None:
        """The best mean of the two extreme Riccati metrics, over some values and some weights."""
        rooms, multipliers = targets.coarse(), np.ones(block.B.shape[1])
        scale = abs(self._least if self.radius.continuous else 1 - self._least) + 1 / self.radius.horizon
        best: TightMetric | None = None
        for shift in _SHIFTS:
            poll()
            value = self._least + scale * float(np.exp(shift))
            found = pencil(block, multipliers, value, continuous=self.radius.continuous)
            if found is None:
                continue
            for share in _SHARES:
                metric = found.mean(share)
                ratio = self._ratio(metric, value, rooms)
                if best is None or ratio < best.ratio:
                    best = TightMetric(metric=metric, value=value, ratio=ratio, status="mean of Riccati metrics")
        return best

    def _ratio(self, metric: Array, value: float, rooms: Rooms) -> float:
        """Erosion over room of the real tube of a metric with the given c or L^2, in floating point."""
        sigma2, nu = noise_numbers(metric, self.noise)
        factors = erosion_factors(metric, rooms.directions) * np.sqrt(sigma2)
        room = (rooms.rooms / factors[:, None]).min(axis=0)
        return float(np.sqrt(self.radius.fit(value, nu, rooms.times, room).square))
