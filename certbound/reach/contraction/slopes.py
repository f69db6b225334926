"""Contraction rates of many boxes at once: branch and bound, vectorised over the pieces of a tube.

Every piece owns a few boxes; those that hold its bound up are halved together, a fixed number of rounds. The bounds
are rigorous at every stage (`certbound.constants.enclosures.coordinates`), so that stopping early costs tightness only.
"""

from __future__ import annotations

import numpy as np

from certbound.arrays import Array, Mask
from certbound.constants.enclosures import Metric, split_boxes
from certbound.constants.state_jacobian import StateJacobian
from certbound.reach.nominal import Curve, Flow
from certbound.rigor.intervals import Interval
from certbound.rigor.norms import Norm

ROUNDS = 5
TOLERANCE = 0.03
LARGEST_BATCH = 8_000


class LocalSlopes:
    """Bounds of mu_P(D_x f) (CT) or ||D_x f||_P (DT) around pieces of a curve, P the metric of ``norm``."""

    def __init__(self, flow: Flow, norm: Norm) -> None:
        self.flow, self.norm = flow, norm
        self.frame = Metric(norm.metric, flow.dimension)
        count = len(flow.tape.inputs)
        everywhere = Interval(np.full(count, -np.inf), np.full(count, np.inf))
        self.jacobian = StateJacobian(flow.tape, range(1, flow.dimension + 1), everywhere)
        self._dual = Interval.point(norm.dual(np.eye(flow.dimension)))

    def boxes(self, curve: Curve, radius: Array) -> Interval:
        """Boxes of all input slots that hold p + {||y||_P <= radius} over each piece, (B, K, slots)."""
        grown = Interval.point(radius)[..., None] * self._dual * Interval(-1.0, 1.0)
        return self.flow.slots(curve.times, curve.range() + grown, self.flow.plan_ranges(curve.starts))

    def bound(self, curve: Curve, radius: Array) -> Array:
        """Upper bounds over p + {||y||_P <= radius} and all of D, shape (B, K); +inf where nothing is proved.

        The ellipsoid is covered by boxes; the Jacobian is enclosed over each as it stands and by its mean-value
        form, and the better one counts.
        """
        finite = np.isfinite(radius)
        size = np.where(finite, radius, 0.0)
        slots = self.boxes(curve, size).reshape(radius.size, -1)
        centres = curve.range().reshape(radius.size, -1)
        values = self._branch(slots, centres, size.reshape(-1))
        return np.where(finite, values.reshape(radius.shape), np.inf)

    def _branch(self, slots: Interval, centres: Interval, radius: Array) -> Array:
        """One bound per row of ``slots`` (N, all), over what lies within ``radius`` of ``centres`` (N, n)."""
        active = list(self.jacobian.active)
        boxes, owners = slots[:, active], np.arange(len(slots))
        settled, floor = np.full(len(boxes), -np.inf), np.full(len(boxes), -np.inf)
        values, weights = self._evaluate(boxes)
        bounds = values
        for _ in range(ROUNDS if active else 0):
            np.maximum.at(floor, owners, self._sampled(boxes))
            least = np.where(np.isfinite(floor), floor, np.inf)[owners]  # undefined in the middle: so are halves
            open_ = values > least + TOLERANCE * (1e-2 + np.abs(least))
            open_ &= np.any(boxes.lo < boxes.hi, axis=1)
            np.maximum.at(settled, owners[~open_], values[~open_])
            if not open_.any() or np.count_nonzero(open_) > LARGEST_BATCH:
                np.maximum.at(settled, owners[open_], values[open_])
                return settled
            parents = np.concatenate([values[open_]] * 2)
            owners = np.concatenate([owners[open_]] * 2)
            boxes = split_boxes(boxes[open_], weights[open_])
            near = self._near(boxes, slots[owners], centres[owners], radius[owners])
            boxes, owners, parents = boxes[near], owners[near], parents[near]
            values, weights = self._evaluate(boxes)
            values = np.minimum(values, parents)
            before, bounds = bounds, settled.copy()
            np.maximum.at(bounds, owners, values)
            if not _worthwhile(before, bounds, floor):
                break
        np.maximum.at(settled, owners, values)
        return settled

    def _near(self, boxes: Interval, slots: Interval, centres: Interval, radius: Array) -> Mask:
        """False only where no point of the box is within ``radius`` of the centre: a . y <= ||a||_P* ||y||_P."""
        low, high = slots.lo.copy(), slots.hi.copy()
        low[:, list(self.jacobian.active)], high[:, list(self.jacobian.active)] = boxes.lo, boxes.hi
        states = slice(1, self.flow.dimension + 1)
        offset = Interval(low[:, states], high[:, states]) - centres
        middle = offset.mid
        direction = middle if self.norm.matrix is None else middle @ self.norm.matrix
        least = (Interval.point(direction) * offset).sum(axis=-1).lo
        reach = Interval.point(self.norm.dual(direction)) * Interval.point(radius)
        return np.asarray(least <= reach.hi)

    def _evaluate(self, boxes: Interval) -> tuple[Array, Array]:
        """Bounds (N,) and the weight of each slot (N, k)."""
        measure = self.frame.measure if self.flow.continuous else self.frame.norm
        values = measure(self.jacobian.enclose(boxes))
        form = self.jacobian.spread(boxes)
        if form is None:
            return values, boxes.width / np.maximum(boxes.width.max(axis=0, initial=0.0), 1e-300)
        values = np.minimum(values, measure(*form))
        slopes = np.where(np.isfinite(form[1].slopes.mag), form[1].slopes.mag, 1e100)
        with np.errstate(over="ignore"):  # the weights choose what is halved: an infinite one comes first
            return values, np.sum(slopes, axis=(-1, -2)) * form[1].reach

    def _sampled(self, boxes: Interval) -> Array:
        jacobians = self.jacobian.values(boxes.mid)
        usable = np.all(np.isfinite(jacobians), axis=(-1, -2))
        sample = self.frame.sample_measure if self.flow.continuous else self.frame.sample_norm
        return np.where(usable, sample(np.where(usable[:, None, None], jacobians, 0.0)), -np.inf)


def _worthwhile(before: Array, after: Array, floor: Array) -> bool:
    """Whether a round of halving closed a tenth of the gaps, on the whole."""
    gap, left = before - floor, after - floor
    usable = np.isfinite(gap) & np.isfinite(left)
    if not usable.all():
        return True
    return bool(np.sum(left) < 0.9 * np.sum(gap))
