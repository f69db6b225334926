"""Uniform noise: means over boxes, whose slopes jump, so that slopes are bounded instead of second derivatives.

For w_i uniform on [-r_i, r_i] the mean h(m) = E U(m + w) is Lipschitz along every axis, with
    d_i h(m) = (V_i(m_i + r_i) - V_i(m_i - r_i))/(2 r_i),  V_i(y) the mean over the other axes of U at y on axis i.
V_i is bounded over cells of the mesh by means of U's largest and smallest value on every cell of the grid, over the
union and the intersection of the windows [m - r, m + r] that occur. A function whose slope along axis i ranges over
an interval of width R lies within R D_i/4 of its interpolation along a cell's side; more precisely phi - I_i phi <=
(2 R/D_i) (x_i - a_i)(a_i + D_i - x_i)/2, which is a bend of -2 R/D_i in ``functions``.

In one state the same of two other laws. Where w is uniform on intervals [a_j, b_j] with probabilities p_j (a table),

    h(m) = sum_j p_j (A(m + b_j) - A(m + a_j))/(b_j - a_j),   A' = U,   and h' is the same of U in place of A.

For Laplace's law h = L + R, L what lies below m, and with the scale s

    s L' = U/2 - L,   s R' = R - U/2,   h' = (R - L)/s,   h'' = (h - U)/s^2,

so that L and R are carried from point to point with factors below 1, and h' is Lipschitz with |h - U|/s^2. Where U
is at least -c, h + c changes by a factor of at most exp(|v|/s) over a way v.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.lazy import compiled
from certbound.rigor.intervals import Interval
from certbound.rigor.rounding import product_error
from certbound.values.discrete.fields import Mesh, Tables
from certbound.values.discrete.functions import ValueFunction
from certbound.values.discrete.kernels import AxisKernel, Block
from certbound.values.discrete.shocks import Inapplicable, Shocks
from certbound.values.discrete.steps import Step
from certbound.values.discrete.transitions import Places, Transition
from certbound.values.grids import Grid, over_corners

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

    blur = 0.0  # up to which ends of windows are known, beside rounding

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
        slack = 1e-12 * (1 + np.abs(points).max()) + self.blur
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
        missing = self._missing(field)
        steepest = [float(max(np.abs(low).max(), np.abs(high).max())) for low, high in field.slopes]
        cells = tuple(count - 1 for count in field.mesh.count)
        found = []
        for places in self.places:
            error = missing.ravel().take(places.flat(cells, (0,) * self.n)) + 2 * field.error
            for i in range(self.n):
                error = error + places.radius[:, i] * steepest[i]
            error = np.where(places.usable, error * (1 + 1e-9), np.inf)
            shape = self.step.grid.node_shape
            found.append((places.interpolate(field.table).reshape(shape), error.reshape(shape)))
        return found

    @staticmethod
    def _missing(field: UniformField) -> Array:
        """Over the mesh's cells, how far h may be from its interpolation."""
        ranges = enumerate(field.slopes)
        return np.asarray(sum((high - low) * float(field.mesh.step[i]) / 4 * (1 + 1e-9) for i, (low, high) in ranges))

    def ranges(self, field: UniformField) -> tuple[Array, Array]:
        """The least and the largest h over the mesh's cells."""
        slack = (self._missing(field) + 2 * field.error) * (1 + 1e-9)
        return over_corners(np.minimum, field.table) - slack, over_corners(np.maximum, field.table) + slack

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


class LineTables(UniformTables):
    """In one state: tables of intervals on each of which the noise is uniform."""

    def __init__(self, grid: Grid, shocks: Shocks, low: Array, high: Array, *, fineness: float) -> None:
        self.grid, self.shocks, self.n = grid, shocks, 1
        self.sigma = shocks.sigma.mid
        self.reach = self.sigma * shocks.reach
        step = self.sigma / fineness
        floor, ceiling = grid.axes[0][0] - 1.01 * self.reach[0], grid.axes[0][-1] + 1.01 * self.reach[0]
        first, last = (min(max(float(end[0]), floor), ceiling) for end in (low, high))
        count = max(2, math.ceil((last - first) / step[0]) + 1) + 2
        self.mesh = Mesh(start=np.array([first]) - step, step=step, count=(count,))
        size = (max(float(np.abs(grid.axes[0]).max()), abs(first), abs(last)) + 3 * self.reach[0]) / self.sigma[0]
        self.blur = 0.0 if shocks.laplace else 1e-11 * (1 + shocks.reach) * float(self.sigma[0])
        self.off = 64 * (size + 1) * (_UNIT + float((shocks.sigma.rad / self.sigma).max()))

    def field(self, value: ValueFunction, *, order: int = 0) -> UniformField:  # type: ignore[override]
        """h and the ranges of its slope; ``order`` is ignored."""
        largest = max(1.0, float(value.size().max()))
        return (self._exponential if self.shocks.laplace else self._stepped)(value, largest)

    def _stepped(self, value: ValueFunction, largest: float) -> UniformField:
        """A table: differences of an antiderivative of U, and of U itself."""
        assert self.shocks.steps is not None
        nodes, points = self.grid.axes[0], self.mesh.points(0)
        start, slope, bend = _pieces(value)
        widths = np.diff(nodes)
        heads = np.concatenate([[0.0], np.cumsum(widths * (start + widths * (slope / 2 + widths * bend / 3)))])

        def integral(y: Array) -> Array:
            cell = np.clip(np.searchsorted(nodes, y, side="right") - 1, 0, len(widths) - 1)
            s = np.clip(y - nodes[cell], 0.0, widths[cell])
            inside = heads[cell] + s * (start[cell] + s * (slope[cell] / 2 + s * bend[cell] / 3))
            return np.asarray(inside + value.beyond * (np.minimum(y - nodes[0], 0) + np.maximum(y - nodes[-1], 0)))

        low, high = value.range()
        least, most = np.pad(low, 1, constant_values=value.beyond), np.pad(high, 1, constant_values=value.beyond)
        table = np.zeros(len(points))
        ends = np.zeros((2, len(points) - 1))
        thinnest = np.inf
        for a, b, share in zip(*self.shocks.steps):
            if share > 0:
                rate, thinnest = share / (b - a), min(thinnest, b - a)
                table += rate * (integral(points + b) - integral(points + a))
                for end, sign in ((b, 1), (a, -1)):
                    found = [self._met(one, 0, points + end, pick) for one, pick in
                             ((least, np.minimum), (most, np.maximum))]  # fmt: skip
                    ends += sign * rate * np.array(found if sign > 0 else found[::-1])
        total = float((widths * value.size()).sum())
        # sums over cells, and positions
        off = 4 * (self.off * float(self.sigma[0]) + self.blur) / min(thinnest, float(self.sigma[0]))
        wrong = (len(nodes) + 64) * 16 * _UNIT * total / thinnest + largest * off
        slack = 4 * off * largest / thinnest
        return UniformField(mesh=self.mesh, table=table, error=wrong, slopes=[(ends[0] - slack, ends[1] + slack)])

    def _exponential(self, value: ValueFunction, largest: float) -> UniformField:
        """Laplace's law."""
        nodes, points, s = self.grid.axes[0], self.mesh.points(0), float(self.sigma[0])
        start, slope, bend = _pieces(value)
        places = np.union1d(points, nodes)
        if np.diff(places).max() > s / 4:
            places = np.union1d(places, np.arange(nodes[0], nodes[-1], s / 4))
        cell = np.searchsorted(nodes, places[:-1], side="right") - 1
        inside = (cell >= 0) & (cell < len(nodes) - 1)
        own = np.clip(cell, 0, len(nodes) - 2)
        lengths = np.diff(places)
        at, weight = np.polynomial.legendre.leggauss(_RULE)
        share = (1 + at) / 2
        y = (places[:-1] - nodes[own])[:, None] + lengths[:, None] * share
        u = np.where(inside[:, None], start[own, None] + y * (slope[own, None] + y * bend[own, None]), value.beyond)
        near = np.exp(-lengths[:, None] * share / s) * weight * lengths[:, None] / (4 * s)
        far = np.exp(-lengths[:, None] * (1 - share) / s) * weight * lengths[:, None] / (4 * s)
        fade = np.exp(-lengths / s)
        left, right, count = np.zeros((3, len(places)))
        left[0] = right[-1] = value.beyond / 2
        carry(fade, (u * far).sum(axis=1), (u * near).sum(axis=1), left, right, count)
        index = np.searchsorted(places, points)
        table, tilt = (left + right)[index], (right - left)[index] / s
        placed = float(np.abs(nodes).max() / np.diff(nodes).min())  # of how far into a cell a place is
        wrong = largest * (2 * self.off + (200 + 8 * float(count.max()) + 8 * placed) * _UNIT)
        low, high = value.range()
        least, most = np.pad(low, 1, constant_values=value.beyond), np.pad(high, 1, constant_values=value.beyond)
        under, over = (self._met(one, 0, points, pick) for one, pick in ((least, np.minimum), (most, np.maximum)))
        step = float(self.mesh.step[0])
        grown, lift = math.exp(step / s) * (1 + 1e-12), max(0.0, -float(least.min())) + 2 * wrong
        top = grown * (np.minimum(table[:-1], table[1:]) + lift) - lift + wrong
        bottom = (np.maximum(table[:-1], table[1:]) + lift) / grown - lift - wrong
        curved = np.maximum(top - under, over - bottom) / s**2 * (1 + 1e-9)
        middle, width = (tilt[:-1] + tilt[1:]) / 2, curved * step / 2 + 4 * wrong / s
        return UniformField(mesh=self.mesh, table=table, error=wrong, slopes=[(middle - width, middle + width)])


_RULE = 6
"""Gauss's points on a piece of at most a quarter of the scale: exact to 1e-18 of the largest |U|."""


def _pieces(value: ValueFunction) -> tuple[Array, Array, Array]:
    """U on every cell of one axis as a polynomial of the distance from its lower end."""
    widths, bend = value.grid.widths(0), value.bend[0]
    start, slope = value.nodal[:-1], np.diff(value.nodal) / widths - bend * widths / 2
    if value.fixed is None:
        return start, slope, bend / 2
    keep = ~value.fixed
    return np.where(keep, start, value.level), slope * keep, bend / 2 * keep


@compiled
def carry(fade: Array, rise: Array, fall: Array, left: Array, right: Array, count: Array) -> None:
    """What lies below and above every place, from its neighbours, and how many roundings that adds up, in place."""
    for k in range(len(fade)):
        left[k + 1] = fade[k] * left[k] + rise[k]
        count[k + 1] = fade[k] * count[k] + 1.0
    most = 0.0
    for k in range(len(fade) - 1, -1, -1):
        right[k] = fade[k] * right[k + 1] + fall[k]
        most = fade[k] * most + 1.0
        count[k] = max(count[k], most)
