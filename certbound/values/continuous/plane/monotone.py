"""Proposals that never break down, for drifts that are strong against the noise: a monotone scheme, then mollified.

The equation of V = log u, V_tau = f.grad V + tr(a V'') / 2 + |g' grad V|^2 / 2 + s, is the Bellman equation of the
largest V over drifts f + a p at the price p'a p / 2. Along each axis Godunov's differences take the better of both
sides, so that the implicit step is an M-matrix for the best p (Newton's method improves it as Howard's does): V stays
below its largest value on the faces, however thin layers are, and nothing oscillates. The values at the Greville
points are then the coefficients of a cubic spline, as they are, not interpolated: a mean of V over some cells. As R is
convex in grad V, means only lower it, but for what the drift varies over them; and where a kink or a layer is thinner
than a cell, V'' is what the cell holds. What upwind differences add to a counts where V'' < 0; where V'' > 0, a is
raised (``raised``), since layers that are about as thick as a cell would keep R > 0 otherwise.

It is less accurate than `solver` wherever that one works. Nothing here is certified.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from certbound.arrays import Array, Index
from certbound.values.continuous.plane.plane_grids import Plan, Plane, Source
from certbound.values.continuous.plane.solver import Solver, integrated
from certbound.values.continuous.surface import Surface

if TYPE_CHECKING:
    from scipy.sparse import csc_array

_STEPS = 4  # a slab
_NEWTON = 4
_CLOSE = 1e-3  # a change of V by less is the last one of Newton's
_DEEPEST = -200.0
_FIRST = 10  # steps within the lead, each some times as long as the one before
_SHORTEST = 1e-3  # of the lead

Weights = tuple[Array, Array, Array, Array]


def propose_monotone(plane: Plane, plan: Plan, source: Source | None, raised: float) -> Surface | None:
    """V on a tensor grid, 0 on the faces, a ``raised`` by that factor at kinks; None where numbers overflow."""
    return integrated(Monotone(plane, plan, source, raised))


class Monotone(Solver):
    """V at the Greville points of cubic splines along both axes."""

    degree = 3

    def __init__(self, plane: Plane, plan: Plan, source: Source | None, raised: float) -> None:
        super().__init__(plane, plan, source)
        self.raised = raised
        inner = self.x[1:-1, 1:-1]
        gaps = [np.diff(one.points) for one in self.splines]
        self.before = [gaps[0][:-1, None] + 0 * inner, gaps[1][None, :-1] + 0 * inner]
        self.after = [gaps[0][1:, None] + 0 * inner, gaps[1][None, 1:] + 0 * inner]
        self.places = np.full(self.x.shape, -1)
        self.places[1:-1, 1:-1] = np.arange(inner.size).reshape(inner.shape)

    def fitted(self, dense: Array) -> Array:
        return np.eye(len(dense))

    def start(self) -> Array:
        """The layers of `Solver`, after a time of ``lead``: then they are layers of this scheme."""
        value, source, self.source = np.maximum(super().start(), _DEEPEST), self.source, None
        ends = self.plan.lead * np.concatenate([[0.0], np.geomspace(_SHORTEST, 1.0, _FIRST)])
        for span in np.diff(ends):
            value = self.step(-span, value, float(span))
        self.source = source
        return value

    def _forces(self, tau: float, slopes: list[Array]) -> tuple[list[Array], Array]:
        """The drift that makes V largest, and a, at the inner points."""
        drift, a = self.fixed or self._model(self.plane.horizon - tau)
        inner = (..., slice(1, -1), slice(1, -1))
        drift = (drift * np.ones(self.x.shape))[inner]
        best = np.argmax(drift[:, 0] * slopes[0] + drift[:, 1] * slopes[1], axis=0)
        force = np.take_along_axis(drift, best[None, None], axis=0)[0]
        return [force[0], force[1]], (a * np.ones(self.x.shape))[inner]

    def balance(self, tau: float, value: Array) -> tuple[Array, Weights]:
        """The right-hand side at the inner points, and its derivatives by V at the points before and after them."""
        here = value[1:-1, 1:-1]
        down = [(here - value[:-2, 1:-1]) / self.before[0], (here - value[1:-1, :-2]) / self.before[1]]
        up = [(value[2:, 1:-1] - here) / self.after[0], (value[1:-1, 2:] - here) / self.after[1]]
        spans = [before + after for before, after in zip(self.before, self.after)]
        slopes = [(h * d + g * u) / s for g, h, d, u, s in zip(self.before, self.after, down, up, spans)]
        force, a = self._forces(tau, slopes)
        total = np.zeros(here.shape)
        if np.any(a[0, 1]):  # seen as a drift and a source, from the last value
            force = [one + 0.5 * a[0, 1] * other for one, other in zip(force, slopes[::-1])]
            corners = value[2:, 2:] - value[2:, :-2] - value[:-2, 2:] + value[:-2, :-2]
            total = total + a[0, 1] * corners / (spans[0] * spans[1])
        weights: list[Array] = []
        for axis in (0, 1):
            own, pair = self._along(axis, force[axis], a[axis, axis], down[axis], up[axis])
            total = total + own
            weights += pair
        return total, (weights[0], weights[1], weights[2], weights[3])

    def _along(self, axis: int, force: Array, a: Array, down: Array, up: Array) -> tuple[Array, list[Array]]:
        """max over p of (f + a p) V' - a p^2 / 2 + a V'' / 2 along an axis, and its derivatives; Godunov's flux."""
        before, after = self.before[axis], self.after[axis]
        a = np.maximum(a, 1e-300)
        still = -force / a  # the slope at which f V' + a V'^2 / 2 is least
        ahead, behind = np.maximum(up, still), np.minimum(down, still)
        gains = [force * slope + 0.5 * a * slope * slope for slope in (ahead, behind)]
        forward = gains[0] >= gains[1]
        speed = force + a * np.where(forward, ahead, behind)
        upwind = np.abs(speed) * np.where(forward, after, before)
        least = np.where(up > down, self.raised * a, 0.0)
        left = np.maximum(a - upwind, least) / (before + after)
        pair = [
            left / before + np.where(forward, 0.0, -speed / before),
            left / after + np.where(forward, speed / after, 0.0),
        ]
        return np.maximum(*gains) + left * (up - down), pair

    def rate(self, tau: float, value: Array) -> Array:
        found = self._fed(tau, value)
        found[1:-1, 1:-1] += self.balance(tau, value)[0]
        found[self.edge] = 0.0
        return found

    def steps(self, tau: float, value: Array, span: float) -> int:
        return _STEPS

    def step(self, tau: float, value: Array, h: float) -> Array:
        new, inner = value.copy(), np.s_[1:-1, 1:-1]
        new[self.edge] = 0.0
        for _ in range(_NEWTON):
            total, weights = self.balance(tau + h, new)
            missing = (new - value)[inner] / h - total - self._fed(tau + h, new)[inner]
            change = self._solved(1 / h + self._falls(tau + h, new)[inner], weights, -missing)
            new[inner] += change
            if np.abs(change).max() < _CLOSE:
                break
        return new

    def _solved(self, diagonal: Array, weights: Weights, right: Array) -> Array:
        """The M-matrix with these weights of neighbours, divided into the right-hand side; nan where they overflow."""
        from scipy.sparse.linalg import splu

        entries = diagonal + sum(weights)
        if not np.isfinite(entries).all() or not np.isfinite(right).all():
            return np.full(right.shape, np.nan)
        matrix = self._matrix(entries, weights)
        return np.asarray(splu(matrix, permc_spec="MMD_AT_PLUS_A").solve(right.ravel()).reshape(right.shape))

    def _matrix(self, diagonal: Array, weights: Weights) -> csc_array:
        from scipy.sparse import csc_array

        count, places = diagonal.size, self.places
        around = (places[:-2, 1:-1], places[2:, 1:-1], places[1:-1, :-2], places[1:-1, 2:])
        rows, columns, entries = [np.arange(count)], [np.arange(count)], [diagonal.ravel()]
        for place, weight in zip(around, weights):
            kept: Index = np.flatnonzero(place.ravel() >= 0)
            rows.append(kept)
            columns.append(place.ravel()[kept])
            entries.append(-weight.ravel()[kept])
        parts = np.concatenate(entries), (np.concatenate(rows), np.concatenate(columns))
        return csc_array(parts, shape=(count, count))
