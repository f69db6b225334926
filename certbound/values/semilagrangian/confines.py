"""What bounds the states: a box along the coordinates, and walls (curved sets, oblique faces, obstacles) within it.

A wall is a set {g_j <= 0 for all j}, to stay in or to keep out of: g_j = n_j x - c_j for the faces of a polytope, one
g = (x - c)' M^-1 (x - c) - 1 for balls and ellipsoids. A path that meets a wall within a step is counted twice at the
step's end, near the wall (`Wall.margins`): after it has met the wall at the time tau,

- *stay in a convex set*: the half-plane beyond a tangent at X_tau is unsafe. With probability at least 1/2 the noise of
  the rest of the step points into it or along it, and X_h is at most gamma h inside, gamma the largest inward drift.
- *an obstacle along the coordinates* is not counted twice: what leaves it within the step is paid (``obstacles``).
- *any other obstacle O*: Y_t = X_t - (0, s (W_t - W_tau)) has the derivative f(X_t), so that its distance from O (from
  each of its half-planes) grows at most at the rate of the outward drift. The noise of the rest has either sign with
  probability 1/2 and exceeds `_FAR` standard deviations with probability 2 Phi(-`_FAR`): the sign that leads towards
  the middle of O keeps Y_h + (0, s (W_h - W_tau)) within what `Wall.margins` says.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Mask
from certbound.problem.sets import Faces, HalfSpace, Quadratic, Region
from certbound.rigor.intervals import Interval, stack
from certbound.values.sets import inverse_of

Ends = tuple[float, float]

_FAR = 4.0
TWICE = 2 / (1 - 2 * 3.17e-5) * (1 + 1e-9)
"""What a point near a wall counts: 1 over 1/2 - Phi(-`_FAR`)."""
_UP = 1 + 1e-9


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Wall:
    """A region in the states' own order, of which ``order`` names p and q."""

    region: Region
    outside: bool
    order: tuple[int, int]

    def ends(self) -> tuple[Ends, Ends] | None:
        """Exact ends of an obstacle along the coordinates, in (p, q); None for anything else."""
        form = self.region.form
        if not self.outside or not isinstance(form, Faces) or np.any(self.region.center_at()):
            return None
        if np.any(np.count_nonzero(form.normals, axis=1) != 1) or np.any(np.abs(form.normals).sum(axis=1) != 1):
            return None
        found = [[-math.inf, math.inf], [-math.inf, math.inf]]
        for row, bound in zip(self.region.lifted(form.normals, 2)[:, list(self.order)], form.bounds):
            place, sign = int(np.argmax(np.abs(row))), float(row.sum())
            side = int(sign > 0)
            found[place][side] = (max, min)[side](found[place][side], sign * float(bound))
        return (found[0][0], found[0][1]), (found[1][0], found[1][1])

    def sizes(self, p: Interval, q: Interval) -> Interval:
        """g_j over boxes: shapes (N,) to (N, m)."""
        form = self.region.form
        y = self.region.relative(self._boxes(p, q), 0.0)
        if isinstance(form, Faces):
            return form.values(y) - form.bounds
        return (y * self._weighed(y)).sum(axis=-1)[:, None] - 1.0

    def hull(self) -> Interval:
        """Ends of a box around the region in (p, q), shape (2,)."""
        places = self.region.places(2)
        found, own = Interval(np.full(2, -np.inf), np.full(2, np.inf)), self.region.hull(0.0)
        found.lo[places], found.hi[places] = own.lo, own.hi
        return found[list(self.order)]

    def _boxes(self, p: Interval, q: Interval) -> Interval:
        both = (p, q) if self.order == (0, 1) else (q, p)
        return stack(both, axis=-1)[:, self.region.places(2)]

    def _weighed(self, y: Interval) -> Interval:
        """M^-1 y for M = radius^2 shape."""
        return (self._inverse()[None] * y[:, None, :]).sum(axis=-1)

    def _inverse(self) -> Interval:
        form = self._quadratic()
        return inverse_of(form.shape) / (Interval.point(form.radius) * form.radius)

    def _quadratic(self) -> Quadratic:
        form = self.region.form
        assert isinstance(form, Quadratic)
        return form

    def safe(self, sizes: Interval, margins: Array) -> Mask:
        """Boxes all of whose points are on the safe side, by more than ``margins`` (m, N)."""
        if self.outside:
            return np.asarray((sizes.lo > margins.T).any(axis=1))
        return np.asarray((sizes.hi <= -margins.T).all(axis=1))

    def broken(self, sizes: Interval) -> Mask:
        """Boxes none of whose points is safe, but for points of the wall itself."""
        if self.outside:
            return np.asarray((sizes.hi <= 0).all(axis=1))
        return np.asarray((sizes.lo > 0).any(axis=1))

    def margins(
        self, tube: tuple[Interval, Interval], rates: tuple[Interval, Interval], step: float, s: float
    ) -> Array:
        """How far beyond the wall (on the safe side) a step may end after it has met the wall, in units of g_j.

        Parameters
        ----------
        tube : (Interval, Interval), shape (N,)
            Where the path stays, in (p, q).
        rates : (Interval, Interval), shape (N,)
            Of (F, g) over the tube.
        step, s : float
            h, and the noise.

        Returns
        -------
        ndarray, shape (m, N)
        """
        span = np.maximum(rates[0].mag, rates[1].mag) * step * _UP
        swing = _FAR * s * math.sqrt(step) * _UP
        if isinstance(self.region.form, Faces):
            return self._beside_faces(rates, step, swing)
        more = span if self.outside else np.zeros(span.shape)
        grown = [Interval(part.lo - more, part.hi + more) for part in tube]
        w = self._weighed(self.region.relative(self._boxes(*grown), 0.0))
        f = self._boxes(*rates)
        outward = (w * f).sum(axis=-1)
        axes = np.linalg.eigvalsh(self._quadratic().matrix)
        least, most = math.sqrt(float(axes[0])) / _UP, math.sqrt(float(axes[-1])) * _UP
        rate = np.maximum(outward.hi if self.outside else -outward.lo, 0.0) * most  # the gauge asks for no most / least
        share = rate * step / least * _UP
        if not self.outside:
            return np.asarray((1 - (1 - np.minimum(share, 1.0)) ** 2) * _UP)[None]
        return np.asarray(((1 + share) ** 2 - 1 + self._beyond_the_middle(rates, span, step, swing)) * _UP)[None]

    def _beyond_the_middle(
        self, rates: tuple[Interval, Interval], span: Array, step: float, swing: float
    ) -> Array | float:
        """What noise towards the middle of the chord along q adds to the squared gauge once it is past the middle.

        The middle lies at -(M^-1)_qp / (M^-1)_qq times p: the drift moves the path past it by that much too.
        """
        (p, q), places = self.order, list(self.region.places(2))
        if q not in places:
            return 0.0
        row = self._inverse()[places.index(q)]
        across = row[places.index(q)]
        tilt = float(row[places.index(p)].mag) / float(across.lo) if p in places else 0.0
        drifted = np.maximum((rates[1].mag + tilt * rates[0].mag) * step * _UP, span)
        return np.asarray(float(across.hi) * (swing + drifted) ** 2 * _UP)

    def _beside_faces(self, rates: tuple[Interval, Interval], step: float, swing: float) -> Array:
        form = self.region.form
        assert isinstance(form, Faces)
        normals = self.region.lifted(form.normals, 2)[:, list(self.order)]
        found = []
        for n_p, n_q in normals:
            outward = rates[0] * float(n_p) + rates[1] * float(n_q)
            found.append(np.maximum(outward.hi if self.outside else -outward.lo, 0.0) * step * _UP)
        if self.outside and not self._one_way(normals, swing):
            found = [margin + abs(n_q) * swing * _UP for margin, (_, n_q) in zip(found, normals)]
        return np.asarray(found)

    def _one_way(self, normals: Array, swing: float) -> bool:
        """Whether noise of one sign or the other surely does not lead out of a polytope within its `swing`."""
        tilts = normals[:, 1]
        if np.all(tilts >= 0) or np.all(tilts <= 0):
            return True
        form = self.region.form
        assert isinstance(form, Faces)
        upright = np.all((normals[:, 0] == 0) | (tilts == 0))
        height = sum(float(bound / abs(tilt)) for bound, tilt in zip(form.bounds, tilts) if tilt)
        return bool(upright) and np.count_nonzero(tilts) == 2 and height > 2 * swing * _UP


def parts_of(region: Region, *, outside: bool, states: int = 2) -> Iterator[tuple[Region, bool]]:
    """A constraint as parts (region, outside): a half-space to keep out of is one to stay in, faces stand alone."""
    form = region.form
    if not isinstance(form, Faces) or np.any(region.center_at()) or (outside and len(form.bounds) != 1):
        yield region, outside
        return
    sign = -1.0 if outside else 1.0
    for normal, bound in zip(region.lifted(form.normals, states), form.bounds):
        yield HalfSpace(sign * normal, sign * float(bound)), False
