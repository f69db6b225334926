"""Uniform noise: means over boxes, whose slopes jump, so that slopes are bounded instead of second derivatives.

For w_i uniform on [-r_i, r_i] the mean h(m) = E U(m + w) is Lipschitz along every axis, with
    d_i h(m) = (V_i(m_i + r_i) - V_i(m_i - r_i))/(2 r_i),  V_i(y) the mean over the other axes of U at y on axis i.
V_i is bounded over cells of the mesh by means of U's largest and smallest value on every cell of the grid, over the
union and the intersection of the windows [m - r, m + r] that occur. A function whose slope along axis i ranges over
an interval of width R lies within R D_i/4 of its interpolation along a cell's side; more precisely phi - I_i phi <=
(2 R/D_i) (x_i - a_i)(a_i + D_i - x_i)/2, which is a bend of -2 R/D_i in ``functions``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.rigor.intervals import Interval
from certbound.rigor.rounding import product_error
from certbound.values.discrete.fields import Mesh, Tables
from certbound.values.discrete.functions import ValueFunction
from certbound.values.discrete.kernels import AxisKernel, Block
from certbound.values.discrete.shocks import Inapplicable, Shocks
from certbound.values.discrete.steps import Step
from certbound.values.discrete.transitions import Places, Transition
from certbound.values.grids import Grid

_UNIT = 2.0**-53
_MOST_WEIGHTS = 8_000_000
"""Of a kernel along one axis, which holds every pair of a point and a node, a dozen times over: about a gigabyte."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class UniformField:
    """h at a mesh's nodes up to ``error``, and the range of d_i h over the mesh's cells."""

    mesh: Mesh
    table: Array
    error: float
    slopes: list[tuple[Array, Array]]


class UniformTables(Tables):
    """What turns value functions on one grid into fields on one mesh; see ``Tables``."""

    def __init__(self, grid: Grid, shocks: Shocks, low: Array, high: Array, *, fineness: float) -> None:
        n = grid.dimension
        self.grid, self.shocks, self.n = grid, shocks, n
        self.reach, self.sigma = shocks.sigma.mid, shocks.sigma.mid
        step = self.reach / fineness
        starts, counts = np.empty(n), []
        for i in range(n):
            floor, ceiling = (end + sign * 1.01 * self.reach[i] for end, sign in zip(grid.axes[i][[0, -1]], (-1, 1)))
            first, last = (min(max(float(end[i]), floor), ceiling) for end in (low, high))
            starts[i] = first - step[i]
            counts.append(max(2, math.ceil((last - first) / step[i]) + 1) + 2)
        self.mesh = Mesh(start=starts, step=step, count=tuple(counts))
        if max(count * len(axis) for count, axis in zip(counts, grid.axes)) > _MOST_WEIGHTS:
            raise Inapplicable(
                "value functions would need a grid of very many cells along one state: the safe set is very many "
                "halfwidths of the uniform noise wide. Use another engine, which is at its best there."
            )
        self.kernels = [self._uniform_kernel(i) for i in range(n)]
        self._beside = {}
        size = max(float(np.abs(self._windows(i)).max() / self.reach[i]) for i in range(n))
        spread = float((shocks.sigma.rad / self.reach).max())
        # ends of windows are off by a few units of their size; sums over the grid's nodes by gamma
        self.wrong = n * 2.0**n * (64 * (size + 1) * (_UNIT + spread) + product_error(4 * max(grid.node_shape))[0])

    def _windows(self, i: int) -> Array:
        """Ends of [m - r, m + r] along an axis, shape (2, M)."""
        points = self.mesh.points(i)
        return np.stack([points - self.reach[i], points + self.reach[i]])

    def _uniform_kernel(self, i: int) -> AxisKernel:
        nodes, points, r = self.grid.axes[i], self.mesh.points(i), float(self.reach[i])
        low, high = (end[:, None] for end in self._windows(i))
        first, last = np.clip(low, nodes[:-1], nodes[1:]), np.clip(high, nodes[:-1], nodes[1:])
        length, middle = last - first, (first + last) / 2
        widths = np.diff(nodes)
        shapes: dict[str, Array] = {name: np.zeros_like(length) for name in ("left", "right", "bubble")}
        for sign in (-1, 1):  # Gauss's rule with two points is exact for cubics
            tau = (middle + sign * length / (2 * math.sqrt(3)) - nodes[:-1]) / widths
            shapes["left"] += length * (1 - tau) / (4 * r)
            shapes["right"] += length * tau / (4 * r)
            shapes["bubble"] += length * widths**2 * tau * (1 - tau) / (8 * r)
        parts = {name: shape[None] for name, shape in shapes.items()} | {"whole": (length / (2 * r))[None]}
        hat = np.zeros((1, len(points), len(nodes)))
        hat[..., :-1] += parts["left"]
        hat[..., 1:] += parts["right"]
        parts["hat"] = hat
        beyond = np.maximum(high[:, 0] - nodes[-1], 0) + np.maximum(nodes[0] - low[:, 0], 0)
        outside = np.minimum(beyond / (2 * r), 1.0)[None]
        block = Block(first=0, last=len(points), left=0, right=len(widths), parts=parts, mass=parts["whole"][0])
        return AxisKernel(
            points=points, nodes=nodes, sigma=r, error=0.0, blocks=[block], outside=outside, outside_mass=outside[0]
        )

    def field(self, value: ValueFunction, *, order: int = 0) -> UniformField:  # type: ignore[override]
        """h and the ranges of its slopes; ``order`` is ignored."""
        table = self.means(value)
        low, high = value.range()
        slopes = [self._slopes(low, high, i, value.beyond) for i in range(self.n)]
        largest = max(1.0, float(value.size().max()))
        return UniformField(mesh=self.mesh, table=table, error=self.wrong * largest, slopes=slopes)

    def _slopes(self, low: Array, high: Array, i: int, beyond: float) -> tuple[Array, Array]:
        """Range of d_i h over the mesh's cells."""
        least, most = np.pad(low, 1, constant_values=beyond), np.pad(high, 1, constant_values=beyond)
        for axis in range(self.n):
            if axis != i:
                least = self._over_windows(least, axis, union=False)
                most = self._over_windows(most, axis, union=True)
        r, points = float(self.reach[i]), self.mesh.points(i)
        ends = []
        for sign in (1, -1):
            ends.append(
                (self._met(least, i, points + sign * r, np.minimum), self._met(most, i, points + sign * r, np.maximum))
            )
        (ahead_low, ahead_high), (behind_low, behind_high) = ends
        slack = self.wrong * max(1.0, float(np.abs(most).max()), float(np.abs(least).max())) / r
        return (ahead_low - behind_high) / (2 * r) - slack, (ahead_high - behind_low) / (2 * r) + slack

    def _over_windows(self, table: Array, axis: int, *, union: bool) -> Array:
        """Integral of a non-negative step function over the union (intersection) of a mesh cell's windows, over 2 r.

        Where the function is negative the roles change, so that the bound holds for every sign.
        """
        low, high = self._windows(axis)
        wide = (np.minimum(low[:-1], low[1:]), np.maximum(high[:-1], high[1:]))
        narrow = (np.maximum(low[:-1], low[1:]), np.minimum(high[:-1], high[1:]))
        inner = self.grid.axes[axis]
        far = 1 + max(float(inner[-1]), float(wide[1].max())), 1 + max(-float(inner[0]), -float(wide[0].min()))
        nodes = np.concatenate([[-far[1]], inner, [far[0]]])

        def overlap(ends: tuple[Array, Array]) -> Array:
            first = np.clip(ends[0][:, None], nodes[:-1], nodes[1:])
            last = np.clip(ends[1][:, None], nodes[:-1], nodes[1:])
            return np.maximum(last - first, 0.0) / (2 * float(self.reach[axis]))

        outer, core = (overlap(wide), overlap(narrow)) if union else (overlap(narrow), overlap(wide))
        moved = np.moveaxis(table, axis, 0)
        flat = moved.reshape(len(moved), -1)
        found = outer @ np.maximum(flat, 0.0) + core @ np.minimum(flat, 0.0)
        return np.moveaxis(found.reshape(len(found), *moved.shape[1:]), 0, axis)

    def _met(self, table: Array, axis: int, points: Array, pick: np.ufunc) -> Array:
        """Extreme over the cells of a padded grid that the interval between neighbouring points meets."""
        nodes = self.grid.axes[axis]
        slack = 1e-12 * (1 + np.abs(points).max())
        first = np.searchsorted(nodes, points[:-1] - slack, side="left")
        last = np.searchsorted(nodes, points[1:] + slack, side="right")
        moved = np.moveaxis(table, axis, 0)
        found = moved[first].copy()
        for hop in range(1, int((last - first).max()) + 1):
            pick(found, moved[np.minimum(first + hop, last)], out=found)
        return np.moveaxis(found, 0, axis)


class UniformTransition:
    """One step from a grid into the field of the next function; offers what ``Transition`` does."""

    def __init__(self, step: Step, tables: UniformTables) -> None:
        self.step, self.tables, self.n = step, tables, tables.n
        self._helper = Transition.windows_and_forms(step, tables)
        self.places = [Places(image, usable, tables, points=2) for image, usable in step.vertices]

    def at_nodes(self, field: UniformField) -> list[tuple[Array, Array]]:
        """Per vertex of the disturbances: phi at the nodes, and a bound of its error (inf where f is undefined)."""
        missing = sum(
            (high - low) * float(field.mesh.step[i]) / 4 * (1 + 1e-9) for i, (low, high) in enumerate(field.slopes)
        )
        steepest = [float(max(np.abs(low).max(), np.abs(high).max())) for low, high in field.slopes]
        cells = tuple(count - 1 for count in field.mesh.count)
        found = []
        for places in self.places:
            error = np.asarray(missing).ravel().take(places.flat(cells, (0,) * self.n)) + 2 * field.error
            for i in range(self.n):
                error = error + places.radius[:, i] * steepest[i]
            error = np.where(places.usable, error * (1 + 1e-9), np.inf)
            shape = self.step.grid.node_shape
            found.append((places.interpolate(field.table).reshape(shape), error.reshape(shape)))
        return found

    def bends(self, field: UniformField, variables: range, *, above: bool) -> list[list[Array]]:
        """Per box of disturbances and variable: -+2 (range of phi's slope)/width over every cell."""
        units = [tuple(int(k == i) for k in range(self.n)) for i in range(self.n)]
        found = []
        for k, (windows, forms) in enumerate(self._helper):
            over = {
                unit: Interval(windows.extreme(low, largest=False), windows.extreme(high, largest=True))
                for unit, (low, high) in zip(units, field.slopes)
            }
            steady = self.step.cells[k].steady
            row = []
            for i in variables:
                jump = forms.first(over, i).width * 2 / self.step.width(k, i) * (1 + 1e-12)
                row.append(np.where(steady, -jump if above else jump, -np.inf if above else np.inf))
            found.append(row)
        return found
