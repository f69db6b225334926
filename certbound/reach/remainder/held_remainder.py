"""What a linearisation of held inputs leaves over: that of the flow, and that of the law at sampling times.

Sampling times are pieces without any length. What the law adds there is divided by the step that all pieces are counted
with, as if it were a rate over one: see `certbound.reach.linear.held`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from certbound.arrays import Array, Index, Integers
from certbound.reach.remainder.bound import Remainder
from certbound.reach.remainder.frame import Frame
from certbound.rigor.intervals import Interval

_ROUNDING = 2e-15  # relative: of a division, and of a step that is a float near the exact one
Bounds = tuple[Array, Array, Array]
Parts = Iterator[tuple[Remainder, Frame, Integers, float]]


@dataclass(frozen=True, eq=False, kw_only=True)
class HeldFrame:
    """The frames of both kinds of pieces, with the places that they have among all."""

    flow: Frame
    flowing: Integers
    sample: Frame
    sampling: Integers
    step: float

    def __len__(self) -> int:
        return len(self.flowing) + len(self.sampling)


@dataclass(frozen=True, eq=False, kw_only=True)
class HeldRemainder:
    """`Remainder` of both kinds of pieces; deviations are bounded along the states in which one of them varies."""

    flow: Remainder
    sample: Remainder

    @cached_property
    def active(self) -> Index:
        """States in which the flow or the law is not affine."""
        return np.union1d(self.flow.active, self.sample.active)

    @property
    def blocks(self) -> list[list[list[int]]]:
        """None of its own: no further directions are looked for but those of kinks."""
        return []

    @property
    def kinked(self) -> bool:
        """Whether the flow or the law has kinks that boxes are cut at."""
        return any(model.kinked and not model.planar for model in (self.flow, self.sample))

    @property
    def planar(self) -> bool:
        """Whether nothing else bounds either of them but planes."""
        return not self.kinked

    @property
    def entries(self) -> list[tuple[int, int]]:
        """Entries of either Jacobian that vary."""
        return [*self.flow.entries, *self.sample.entries]

    @property
    def jumping(self) -> bool:
        """Whether the dynamics or the law may jump with the state."""
        return self.flow.jumping or self.sample.jumping

    @property
    def constant_slope(self) -> Interval:
        """The flow's constant entries, as uncertain as those of the law are too."""
        spread = max(float(model.constant_slope.rad.max(initial=0.0)) for model in (self.flow, self.sample))
        return Interval.around(self.flow.constant_slope.mid, np.full(self.flow.constant_slope.shape, spread))

    def reference_slope(self, time: Array, state: Array, inputs: Array, disturbance: Array) -> Array:
        """Float Jacobian of the flow; see `Derivatives.reference_slope`."""
        return self.flow.reference_slope(time, state, inputs, disturbance)

    def reference_gain(self, time: Array, state: Array, inputs: Array, disturbance: Array) -> Array:
        """Float derivative of the flow by the disturbance; see `Derivatives.reference_gain`."""
        return self.flow.reference_gain(time, state, inputs, disturbance)

    def kink_normals(self, frame: HeldFrame) -> Array:
        """Normals of the kinks of both, (M, K, active): on pieces of the other kind, as at the piece of the own before.

        On the pieces before the first of its own kind, as there.
        """
        found = [np.zeros((len(frame), 0, len(self.active)))]
        for model, part, places, _ in self._parts(frame):
            if model.kinked and not model.planar:
                last = np.searchsorted(places, np.arange(len(frame)), side="right") - 1
                normals = model.kink_normals(part)[np.maximum(last, 0)]
                full = np.zeros((*normals.shape[:2], len(self.active)))
                full[..., self._columns(model)] = normals
                found.append(full)
        return np.concatenate(found, axis=1)

    def _parts(self, frame: HeldFrame) -> Parts:
        yield self.flow, frame.flow, frame.flowing, 1.0
        yield self.sample, frame.sample, frame.sampling, frame.step

    def bound(
        self, frame: HeldFrame, low: Array, high: Array, rows: Array, effort: int = 2,
        target: tuple[Array, Array] | None = None, only: Index | None = None,
    ) -> tuple[Array, Array]:
        """Enclosure of beta over every piece; see `Remainder.bound`."""
        lower = np.zeros((len(frame), self.flow.problem.system.dimension))
        upper = lower.copy()
        for model, part, places, scale in self._parts(frame):
            asked = None if only is None else np.flatnonzero(np.isin(places, only))
            if asked is not None and not len(asked):
                continue
            hoped = None if target is None else (target[0][places] * scale, target[1][places] * scale)
            found = model.bound(part, *self._own(model, low, high, rows, places), effort, hoped, asked)
            slack = _ROUNDING * np.maximum(np.abs(found[0]), np.abs(found[1])) / scale
            lower[places], upper[places] = found[0] / scale - slack, found[1] / scale + slack
        return lower, upper

    def sampled(self, frame: HeldFrame, low: Array, high: Array, rows: Array) -> tuple[Array, Array]:
        """Range of beta over sample points, which proves nothing."""
        lower = np.zeros((len(frame), self.flow.problem.system.dimension))
        upper = lower.copy()
        for model, part, places, scale in self._parts(frame):
            found = model.sampled(part, *self._own(model, low, high, rows, places))
            lower[places], upper[places] = found[0] / scale, found[1] / scale
        return lower, upper

    def fitted(self, frame: HeldFrame, low: Array, high: Array, rows: Array) -> Array:
        """What to add to the slopes so that they fit beta, (M, n, n): see `fitted_slopes`."""
        n = self.flow.problem.system.dimension
        result = np.zeros((len(frame), n, n))
        for model, part, places, _ in self._parts(frame):
            result[places] = model.fitted(part, *self._own(model, low, high, rows, places))
        return result

    def defect(self, frame: HeldFrame) -> Array:
        """What no cutting of boxes takes off a bound of beta: see `Remainder.defect`."""
        result = np.zeros((len(frame), self.flow.problem.system.dimension))
        for model, part, places, scale in self._parts(frame):
            result[places] = model.defect(part) / scale
        return result

    def _columns(self, model: Remainder) -> Index:
        """Where a model's active states stand among all."""
        return np.searchsorted(self.active, model.active)

    def _own(self, model: Remainder, low: Array, high: Array, rows: Array, places: Integers) -> Bounds:
        """Bounds along the states that a model is not affine in, and along the rows over these alone."""
        columns, count, rows = self._columns(model), len(self.active), rows[places]
        own = np.flatnonzero(~np.delete(rows, columns, axis=2).any(axis=(0, 2)))
        chosen = np.concatenate([columns, count + own])
        return low[places][:, chosen], high[places][:, chosen], rows[:, own][..., columns]
