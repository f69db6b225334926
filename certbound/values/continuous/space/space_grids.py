"""What a proposal in three states is made from: the problem in floats, and where its nodes lie."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.values.continuous.plane import Plan
from certbound.values.continuous.proposal import through

Ends = tuple[float, ...]

_BETWEEN = 9  # places along each other axis at which a face is looked at
_RANK = 1e-9  # of the squared noise of all states: less along an axis is none


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Space:
    """The problem in floats: drift (branches, 3, ...) and a (3, 3, ...) at (t, x, y, z), on a box."""

    low: Ends
    high: Ends
    horizon: float
    drift: Callable[..., Array]
    square: Callable[..., Array]
    starts: list[tuple[float, float]]
    autonomous: bool

    def lattice(self, axis: int, places: Array, others: int = _BETWEEN) -> list[Array]:
        """Points with the given places along one axis, and evenly spread ones along the others."""
        ends = [np.linspace(low, high, others) for low, high in zip(self.low, self.high)]
        ends[axis] = places
        return list(np.meshgrid(*ends, indexing="ij"))

    def noise(self, points: list[Array]) -> Array:
        """a at the horizon."""
        return np.asarray(self.square(self.horizon, *points) * np.ones((3, 3, *points[0].shape)))

    def noisy(self, axis: int) -> bool:
        """Whether there is noise along an axis."""
        a = self.noise(self.lattice(axis, np.linspace(self.low[axis], self.high[axis], _BETWEEN)))
        width = [high - low for low, high in zip(self.low, self.high)]
        scaled = [float(a[k, k].max()) / width[k] ** 2 for k in range(3)]
        return scaled[axis] > _RANK * max(scaled)


def spread_nodes(space: Space, plan: Plan, axis: int) -> Array:
    """Nodes where the noise is small, and at the faces; bent to the starts."""
    low, high = space.low[axis], space.high[axis]
    fine = np.linspace(low, high, 2001)
    density = np.full(len(fine), 1 / (high - low))
    if space.noisy(axis):
        coarse = np.linspace(low, high, 41)
        others = tuple(k for k in range(3) if k != axis)
        root = np.sqrt(np.maximum(space.noise(space.lattice(axis, coarse))[axis, axis], 0.0)).mean(axis=others)
        density = 1 / np.interp(fine, coarse, np.maximum(root, 0.2 * root.max()))
        density = density / np.trapezoid(density, fine)
    for side, distance in ((0, fine - low), (1, high - fine)):
        weight = 1 / (distance + 1 / layer_rate(space, plan, axis, side))
        density += 0.5 * weight / np.trapezoid(weight, fine)
    total = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
    nodes = np.interp(np.linspace(0, total[-1], plan.cells + 1), total, fine)
    nodes[0], nodes[-1] = low, high
    return through(nodes, space.starts[axis])


def layer_rate(space: Space, plan: Plan, axis: int, side: int) -> float:
    """The rate of the start profile at a face: the largest that a layer of age ``lead`` has along it.

    Where a face has no noise, or where that would be steeper, what the cells can hold.
    """
    steepest = 2.0 * plan.cells / (space.high[axis] - space.low[axis])
    if not space.noisy(axis):
        return steepest
    points = space.lattice(axis, np.array([space.low[axis] if side == 0 else space.high[axis]]))
    a = np.maximum(space.noise(points)[axis, axis], 1e-300)
    inward = np.max(space.drift(space.horizon, *points)[:, axis] * (1 if side == 0 else -1), axis=0)
    rate = float(np.max(np.maximum(1.3 * np.sqrt(2 / (a * plan.lead)), inward / (1.5 * a))))
    return min(rate, 2 * steepest)
