"""Floating-point proposals of V in three states; nothing here is certified.

The equation and the steps are those of `plane.solver`, on cubic splines: ROS2 with an approximate factorisation along
the three axes, V = -k d beside each face at T, a raised at convex kinks and the inward drift weakened beside faces.

*No noise along an axis.* There V's equation only carries values along, and collocation would ring at their fronts.
So u_ii / u = V_ii + V_i^2 is added times half a cell's worth of drift, where it is positive: V's own residual falls
by as much. Where it is negative nothing is added, and nothing is due.
"""

from __future__ import annotations

import math

import numpy as np

from certbound.arrays import Array
from certbound.values.continuous.plane import Plan, Source, solve_lines
from certbound.values.continuous.proposal import Splines
from certbound.values.continuous.residual import along
from certbound.values.continuous.space.space_grids import Space, layer_rate, spread_nodes
from certbound.values.continuous.surface import Surface

_GAMMA = 0.5
_COURANT = 1.5
_GATE = 0.004  # a source weakens where V is above minus this, and ends at 0
_DEGREE = 3
_BENT = 1.5  # jump of V' over five points, times a cell, above which a is raised
_ZONE = 0.88  # of a cell's mean width: how far from a face the inward drift is weakened
_CARRIED = 0.5  # of |f_i| times a cell: what is added to a_ii
_AMPLE = 4.0  # times a_ii, which is enough in place of that
_FLAT = 6.0  # depth within which the layer at a face without noise is flat
_ANYWAY = 0.1  # of it, where u_ii < 0: else fronts ring


class SpaceSolver:
    """V at Greville's points of the three axes."""

    def __init__(self, plane: Space, plan: Plan, source: Source | None) -> None:
        self.plane, self.plan = plane, plan
        self.nodes = [spread_nodes(plane, plan, axis) for axis in range(3)]
        self.splines = [Splines(nodes, _DEGREE) for nodes in self.nodes]
        self.inverse = [np.linalg.inv(one.dense[0]) for one in self.splines]
        self.slope = [one.dense[1] @ inverse for one, inverse in zip(self.splines, self.inverse)]
        self.bend = [one.dense[2] @ inverse for one, inverse in zip(self.splines, self.inverse)]
        points = [one.points for one in self.splines]
        self.places = list(np.meshgrid(*points, indexing="ij"))
        self.gaps = [self._along(np.gradient(one), axis) for axis, one in enumerate(points)]
        widths = [np.interp(one, nodes, np.gradient(nodes)) for one, nodes in zip(points, self.nodes)]
        self.widths = [self._along(width, axis) for axis, width in enumerate(widths)]
        self.edge = np.ones(self.places[0].shape, dtype=bool)
        self.edge[1:-1, 1:-1, 1:-1] = False
        self.fixed = self._model(0.0) if plane.autonomous else None
        self.source = None if source is None else (source.times, source.at(points))

    @staticmethod
    def _along(line: Array, axis: int) -> Array:
        return line.reshape([-1 if k == axis else 1 for k in range(3)])

    def _model(self, t: float) -> tuple[Array, Array]:
        shape = self.places[0].shape
        drift = self.plane.drift(t, *self.places)
        return drift * np.ones(shape), self.plane.square(t, *self.places) * np.ones(shape)

    def start(self) -> Array:
        """log(1 - prod (1 - e^side)) of the layers at all faces, at T."""
        sides = []
        for axis, place in enumerate(self.places):
            for side in (0, 1):
                rate = layer_rate(self.plane, self.plan, axis, side)
                depth = rate * (place - self.plane.low[axis] if side == 0 else self.plane.high[axis] - place)
                if not self.plane.noisy(axis):  # flat at the face: what is carried inward has no concave kink
                    sides.append(-(depth**2) / (depth + _FLAT))
                    continue
                bend, curve = self._layer(axis, side, rate)
                sides.append(np.log1p(bend * depth) + 0.5 * curve * depth**2 * np.exp(-depth) - depth)
        far = np.logaddexp.reduce(sides)
        with np.errstate(divide="ignore"):  # far from the faces it is the sum
            near = np.log(-np.expm1(np.sum([np.log1p(-np.exp(np.minimum(side, 0.0))) for side in sides], axis=0)))
        value = np.where(far < -15, far, near)
        value = np.logaddexp(value, self.plan.floor)
        value[self.edge] = 0.0
        return np.asarray(value)

    def _layer(self, axis: int, side: int, rate: float) -> tuple[Array, Array]:
        """c and b of the layer (1 + c k d) exp(b (k d)^2 exp(-k d) / 2 - k d); a u'' / 2 + f u' = 0 on the face."""
        points = list(self.places)
        points[axis] = np.full(points[axis].shape, self.plane.low[axis] if side == 0 else self.plane.high[axis])
        a = np.maximum(self.plane.square(self.plane.horizon, *points)[axis, axis], 1e-300)
        inward = self.plane.drift(self.plane.horizon, *points)[0, axis] * (1 if side == 0 else -1)
        share = inward / (rate * a)
        bend = np.clip((0.5 - share) / np.maximum(1 - share, 0.1), 0.0, 0.9)
        return bend, np.clip(2 * share - 1, 0.0, 2.0)

    def _right(self, tau: float, value: Array) -> tuple[Array, list[Array], list[Array]]:
        """V's rate, and the speeds and the a_ii with which its changes move and spread along each axis."""
        drift, a = self.fixed or self._model(self.plane.horizon - tau)
        slopes = [along(self.slope[axis], value, axis) for axis in range(3)]
        bends = [along(self.bend[axis], value, axis) for axis in range(3)]
        moved = sum(drift[:, axis] * slopes[axis] for axis in range(3))
        best = np.argmax(moved, axis=0) if len(drift) > 1 else np.zeros(value.shape, dtype=int)
        force = self._eased(np.take_along_axis(drift, best[None, None], axis=0)[0], a, slopes, value)
        rate = self._fed(tau, value)
        speeds, spreads = [], []
        for i in range(3):
            carried = self._carried(force[i], a[i, i], slopes[i], bends[i], i)
            steep = sum(a[i, j] * slopes[j] for j in range(3)) + carried * slopes[i]
            spread = a[i, i] + carried + self._kinked(a[i, i], slopes[i], bends[i], i)
            rate = rate + (force[i] + 0.5 * steep) * slopes[i] + 0.5 * spread * bends[i]
            speeds.append(force[i] + steep)
            spreads.append(spread)
            for j in range(i):
                if np.any(a[i, j]):
                    rate = rate + a[i, j] * along(self.slope[j], slopes[i], j)
        rate[self.edge] = 0.0
        return rate, speeds, spreads

    def _carried(self, force: Array, a: Array, slope: Array, bend: Array, axis: int) -> Array:
        """What is added to a_ii, with V_ii and V_i^2 alike, where u_ii > 0 and there is too little noise."""
        lacking = np.maximum(_CARRIED * np.abs(force) * self.widths[axis] - _AMPLE * a, 0.0)
        if not lacking.any():
            return lacking
        share = np.clip((bend + slope**2) * self.widths[axis] ** 2 / 0.05, _ANYWAY, 1.0)
        return np.asarray(lacking * share)

    def _kinked(self, a: Array, slope: Array, bend: Array, axis: int) -> Array:
        """What is added to a_ii, with V_ii alone, at convex kinks that the cells cannot hold."""
        from scipy.ndimage import maximum_filter1d, minimum_filter1d

        jump = maximum_filter1d(slope, 5, axis=axis) - minimum_filter1d(slope, 5, axis=axis)
        more = a * np.maximum(self.gaps[axis] * jump / _BENT - 1, 0.0)
        return np.where(bend > 0, more, 0.0)

    def _eased(self, force: Array, a: Array, slopes: list[Array], value: Array) -> Array:
        """The drift with its inward part cut near the faces where that makes V rise, so that layers fit the cells."""
        result = []
        for axis, place in enumerate(self.places):
            zone = _ZONE * (self.plane.high[axis] - self.plane.low[axis]) / self.plan.cells
            weak = force[axis]
            for distance, sign in ((place - self.plane.low[axis], 1.0), (self.plane.high[axis] - place, -1.0)):
                share = np.clip(2 - distance / zone, 0.0, 1.0)
                line = np.moveaxis(distance, axis, 0)[:, 0, 0]
                beyond = np.take(value, [np.argmin(np.abs(line - 1.5 * zone))], axis=axis)
                steepest = 0.5 / (3 * np.partition(line, 1)[1])  # Greville's first point is a third of the cell away
                most = a[axis, axis] * np.minimum((2 + np.maximum(-beyond, 0.0)) / zone, steepest)
                weak = weak - sign * share * np.maximum(sign * weak - most, 0.0)
            result.append(np.where((weak - force[axis]) * slopes[axis] > 0, weak, force[axis]))
        return np.stack(result)

    def _fed(self, tau: float, value: Array) -> Array:
        return self._source(tau) * np.clip(-value / _GATE, 0.0, 1.0)

    def _source(self, tau: float) -> Array:
        if self.source is None:
            return np.zeros(self.edge.shape)
        times, values = self.source
        t = self.plane.horizon - tau
        left = min(max(int(np.searchsorted(times, t)) - 1, 0), len(times) - 2)
        share = (t - times[left]) / (times[left + 1] - times[left])
        return np.asarray((1 - share) * values[left] + share * values[left + 1])

    def rate(self, tau: float, value: Array) -> Array:
        return self._right(tau, value)[0]

    def steps(self, tau: float, value: Array, span: float) -> int:
        """How many steps a slab needs, so that nothing moves by more than a few cells in one."""
        speeds = self._right(tau, value)[1]
        fastest = max(float(np.max(np.abs(v) / w)) for v, w in zip(speeds, self.widths))
        return max(2, math.ceil(min(span * fastest / _COURANT, 1e6)) if math.isfinite(fastest) else 2)

    def _divided(self, right: Array, speeds: list[Array], spreads: list[Array], step: float, fed: Array) -> Array:
        """(I - g h J_z)^-1 ... applied, axis by axis, and the part of the source."""
        right = right / (1 + _GAMMA * step * fed)
        for axis in (2, 1, 0):
            own = self.splines[axis]
            line, speed, half = (
                np.ascontiguousarray(np.moveaxis(table, axis, 0)).reshape(len(own.points), -1)
                for table in (right, speeds[axis], 0.5 * spreads[axis])
            )
            line = line.copy()
            solve_lines(own.at[0], own.at[1], own.at[2], speed, half, _GAMMA * step, line, False, False)
            shape = [right.shape[axis], *(size for k, size in enumerate(right.shape) if k != axis)]
            right = np.moveaxis((own.dense[0] @ line).reshape(shape), 0, axis)
        return right

    def step(self, tau: float, value: Array, h: float) -> Array:
        rate, speeds, spreads = self._right(tau, value)
        fed = np.where((value < 0) & (value > -_GATE), self._source(tau) / _GATE, 0.0)
        k1 = self._divided(rate, speeds, spreads, h, fed)
        again = self._right(tau + h, value + h * k1)[0]
        k2 = self._divided(again - 2 * k1, speeds, spreads, h, fed)
        value = value + 1.5 * h * k1 + 0.5 * h * k2
        value[self.edge] = 0.0
        return np.asarray(value)

    def surface(self, times: Array, values: list[Array], first: list[Array], last: list[Array]) -> Surface:
        maps = [np.stack([m @ inverse for m in one.at_nodes[:2]], axis=1)
                for one, inverse in zip(self.splines, self.inverse)]  # fmt: skip

        def data(tables: list[Array]) -> Array:
            found = np.empty((len(tables), *(size for m in maps for size in m.shape[:2])))
            for table, out in zip(reversed(tables), found):
                np.copyto(out, np.einsum("iap,jbq,kcr,pqr->iajbkc", *maps, table, optimize=True))
            for axis in range(3):  # V = 0 on the faces, exactly
                np.moveaxis(found, (1 + 2 * axis, 2 + 2 * axis), (0, 1))[[0, -1], 0] = 0.0
            return found

        forward = self.plane.horizon - times[::-1]
        forward[0], forward[-1] = 0.0, self.plane.horizon
        return Surface(
            axes=tuple(self.nodes), times=forward, values=data(values), start_rates=-data(last),
            end_rates=-data(first),
        )  # fmt: skip
