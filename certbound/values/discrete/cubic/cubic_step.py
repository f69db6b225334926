"""One step back where f is smooth on every cell, every cell is safe and nothing changes from step to step.

Between values c_i at the nodes of a cell let I c_i be multilinear. If I c_i <= d_ii phi on the cell for every i and
u >= phi at its corners, then
    U = I u - sum_i int G_i (I c_i) >= phi,   G_i Green's function of the axis,
as phi - I phi = - sum_i I_1 ... I_{i-1} int G_i d_ii phi, and these I leave int G_i (I c_i) alone: it is multilinear
along all axes but i, where it is the cubic D^2/6 tau (1 - tau) ((2 - tau) c_left + (1 + tau) c_right). Below: all signs
turned. With g = d_ii phi known at finer nodes, ``parts`` to a side,
    I c - g <= max over these nodes of (I c - g) + sum_j delta_j^2/8 sup (g_jj)^+   on the cell,
since g - (its multilinear function of finer nodes) >= - sum_j delta_j^2/8 sup (g_jj)^+. On the finer cells g_jj is at
most its largest corner plus sum_l delta_l^2/8 sup |g_jjll|; at a finer node it is the second divided difference but for
|delta_+ - delta_-|/3 sup |g_jjj| + (delta_+^2 - delta_+ delta_- + delta_-^2)/12 sup |g_jjjj| (mean and second moment of
the triangular kernel), and at an end of the grid that of the next node but for delta sup |g_jjj|. ``majorants`` has
these derivatives, also of the cells beside, which such differences reach into. The c of a node is what every cell
around it can pay.

H between the mesh's nodes: int A(y) prod phi_{kappa s}(y - m) dy times exp(|m|_s^2 / (2 kappa^2)) is a sum of
exponentials of m, so convex; on a mesh cell H is at most exp(sum_i (delta_i / s_i)^2 / (8 kappa^2)) times its largest
corner.
"""

from __future__ import annotations

import math

import numpy as np

from certbound.arrays import Array
from certbound.problem.model import edged
from certbound.rigor.intervals import Interval
from certbound.values.discrete.cubic.cell_scans import Stencils, lacking
from certbound.values.discrete.cubic.majorants import HIGHEST, Majorants, derivatives, majorants
from certbound.values.discrete.dominance import KAPPA, dominance
from certbound.values.discrete.fields import Field, Tables
from certbound.values.discrete.functions import ValueFunction
from certbound.values.discrete.kernels import REACH
from certbound.values.discrete.shocks import Shocks
from certbound.values.discrete.steps import CellImages, Dynamics, Step
from certbound.values.discrete.transitions import Forms, Places, Transition, rule_constants, sliding
from certbound.values.grids import Grid, around_nodes, over_corners

Alpha = tuple[int, ...]

_PARTS = {1: 4, 2: 2, 3: 2}
_POINTS = 6  # of the interpolation of second derivatives


def all_alike(dynamics: Dynamics, shocks: Shocks) -> bool:
    """Whether all steps are, smooth, with normal noise that is everywhere the same, and without disturbances."""
    if dynamics.problem.system.disturbance_names or shocks.uniform or shocks.sizes is not None:
        return False
    return dynamics.steady and not edged(dynamics.tape) and derivatives(dynamics) is not None


def cubic_transition(dynamics: Dynamics, t: int, grid: Grid, shocks: Shocks) -> CubicTransition | None:
    """The step to functions on the same grid; None where f is not smooth on every cell, or leads far off the grid."""
    step = dynamics.step(t, grid)
    if len(step.cells) > 1 or step.pieces.size or not step.cells[0].smooth.all() or min(grid.shape) < 2:
        return None
    low, high = step.hull()
    reach = REACH * (shocks.sigma.mid + np.abs(shocks.factor.mid)) * (1 - 1e-9)  # meshes end there
    if any(a < axis[0] - r or b > axis[-1] + r for a, b, axis, r in zip(low, high, grid.axes, reach)):
        return None
    tables = Tables(grid, shocks, low, high, cubic=True)
    sizes = majorants(dynamics, t, grid, tables)
    if sizes is None:
        return None
    fine = finer(grid, _PARTS[grid.dimension])
    images = dynamics.over(t, Interval.point(fine.nodes()), Interval.point(np.empty(0)))
    found = CubicTransition(step, tables, fine, images, sizes)
    return found if images.smooth.all() and found.reading.usable.all() else None


def finer(grid: Grid, parts: int) -> Grid:
    """The grid with cells cut in equal parts; its nodes stay nodes."""
    axes = []
    for axis in grid.axes:
        cuts = axis[:-1, None] + np.diff(axis)[:, None] * (np.arange(parts) / parts)
        axes.append(np.append(cuts.ravel(), axis[-1]))
    return Grid(axes=tuple(axes))


class CubicTransition(Transition):
    """One step between functions with node values and, at the nodes, second derivatives."""

    def __init__(self, step: Step, tables: Tables, fine: Grid, images: CellImages, sizes: Majorants) -> None:
        super().__init__(step, tables)
        self.fine, self.sizes, self.parts = fine, sizes, _PARTS[self.n]
        self.reading = Places(images.image, images.smooth, tables, points=_POINTS)
        self.start = self.reading.flat(tables.mesh.count, (0,) * self.n)
        forms = Forms(images, self.n)
        self.factors = [forms.every(i) for i in range(self.n)]
        self.stencils = Stencils(self.reading.base, self.reading.weights)
        self.convexity = math.exp(float(np.sum(self._ratio**2)) / (8 * KAPPA**2)) * (1 + 1e-9)
        used = sorted({alpha for row in self.factors for alpha, _ in row})
        errors = {alpha: self._reading_error(alpha) for alpha in used}
        self.errors = [_summed_up(row, errors) for row in self.factors]
        self.single = all(factor.ndim == 0 for row in self.factors for _, factor in row)
        self.middles = [[(alpha, factor.mid) for alpha, factor in row] for row in self.factors]
        self.fifth, self.sixth = self._shares()

    def _reading_error(self, alpha: Alpha) -> tuple[float, float, float]:
        """Of d^alpha h read off at a point, relative to H nearby and to sup |U|; and its size, relative to H."""
        norm, omega = rule_constants(_POINTS)
        scale = math.prod(float(self.tables.sigma[i]) ** -a for i, a in enumerate(alpha))
        size = math.prod(dominance(a) for a in alpha)
        near, far = norm**self.n * (self.tables.error[alpha] / scale + 1e-12 * size), 0.0
        for i, ratio in enumerate(self._ratio):
            share = norm**i * omega * float(ratio) ** _POINTS
            raised = tuple(a + _POINTS * (k == i) for k, a in enumerate(alpha))
            near += share * math.prod(dominance(a) for a in raised)
            far += share * self.tables.beyond(raised)
            moved = tuple(a + (k == i) for k, a in enumerate(alpha))
            off = float(self.reading.radius[:, i].max() / self.tables.sigma[i])
            near += off * math.prod(dominance(a) for a in moved)
            far += off * self.tables.beyond(moved)
        floor = 6 * norm**self.n * self.tables.tail[alpha]
        return near * scale * (1 + 1e-9), (far * scale + floor) * (1 + 1e-9), size * scale * (1 + 1e-9)

    def _shares(self) -> tuple[Array, Array]:
        """With which weight fifth and sixth derivatives count, times D^beta over D_i^2, on every cell."""
        grid, r = self.step.grid, self.parts
        first, second = np.zeros(grid.shape), np.zeros(grid.shape)
        narrow = np.ones(grid.shape)
        for i in range(self.n):
            width = np.diff(grid.axes[i])
            sides = np.pad(width, 1, mode="edge")
            least, most = (pick(sides[:-2], sides[2:]) / width for pick in (np.minimum, np.maximum))
            change = np.maximum(most - 1, 1 - least) / (3 * r)
            change[[0, -1]] = np.maximum(change[[0, -1]], 1 / r)
            line = [-1 if k == i else 1 for k in range(self.n)]
            first = first + (change / (8 * r**2)).reshape(line)
            second = second + (np.maximum(most, 1.0) ** 2 / (96 * r**4) + self.n / (64 * r**4)).reshape(line)
            narrow = np.minimum(narrow, np.minimum(least, 1.0).reshape(line))
        return first * narrow**-5 * (1 + 1e-9), second * narrow**-6 * (1 + 1e-9)

    def back(self, value: ValueFunction, *, above: bool) -> ValueFunction:
        """A function at least (at most) phi everywhere on the grid, given one for the next step."""
        field = self.tables.field(value)
        ((at, error),) = self.at_nodes(field)
        nodal = at + error if above else at - error
        bend = np.stack(self._nodal_bends(field, above))
        grid = self.step.grid
        return ValueFunction(
            grid=grid, nodal=nodal, bend=bend, fixed=None, level=np.zeros(grid.shape), beyond=value.beyond
        )

    def _nodal_bends(self, field: Field, above: bool) -> list[Array]:
        grid, sign = self.step.grid, 1.0 if above else -1.0
        higher = self._higher(field)
        close = self._close(field)
        found = []
        for i, (value, (near, far)) in enumerate(zip(self._second(field), self.errors, strict=True)):
            error = (near * close + far * field.largest) * (1 + 1e-9)
            low = (sign * value - error).reshape(self.fine.node_shape)
            high = (sign * value + error).reshape(self.fine.node_shape)
            lack = lacking(low, high, self.fine.axes, self.parts)
            lack += higher / (np.diff(grid.axes[i]) ** 2).reshape([-1 if k == i else 1 for k in range(self.n)])
            owed = around_nodes(lack * (1 + 1e-9), largest=True)
            corner = low[(slice(None, None, self.parts),) * self.n]
            found.append(sign * (corner - owed - 1e-15 * (np.abs(corner) + owed)))
        return found

    def _higher(self, field: Field) -> Array:
        """What fifth and sixth derivatives cost, times D_i^2, on every cell."""
        grid = self.step.grid
        corner = over_corners(np.maximum, field.dominant) * self.convexity
        heavy = self.windows[0].extreme(corner, largest=True).reshape(grid.shape)
        total = np.zeros(grid.shape)
        for order, share in ((HIGHEST - 1, self.fifth), (HIGHEST, self.sixth)):
            size = heavy * self.sizes.near[order] + field.largest * self.sizes.beyond[order]
            total += share * over_corners(np.maximum, around_nodes(size, largest=True))
        return total

    def _close(self, field: Field) -> Array:
        """The largest H on the stencil of every finer node."""
        wide = field.dominant
        for axis in range(self.n):
            wide = sliding(np.maximum, wide, _POINTS, axis)
        return np.asarray(wide.ravel().take(self.start) * self.convexity)

    def _second(self, field: Field) -> list[Array]:
        """Per axis d_ii phi at the finer nodes."""
        if self.single:  # the sums first
            nothing = np.zeros(field.mesh.count)
            return list(self.stencils.read_off([
                sum((float(factor) * field.tables[alpha] for alpha, factor in row), nothing) for row in self.middles
            ]))  # fmt: skip
        used = sorted({alpha for row in self.middles for alpha, _ in row})
        read = dict(zip(used, self.stencils.read_off([field.tables[alpha] for alpha in used]), strict=True))
        nothing = np.zeros(len(self.start))
        return [sum((factor * read[alpha] for alpha, factor in row), nothing) for row in self.middles]


def _summed_up(
    row: list[tuple[Alpha, Interval]], errors: dict[Alpha, tuple[float, float, float]]
) -> tuple[Array | float, Array | float]:
    """The error of a sum of derivatives of h with factors, relative to H and to sup |U|."""
    near: Array | float = 0.0
    far: Array | float = 0.0
    for alpha, factor in row:
        wrong, floor, size = errors[alpha]
        near = near + factor.mag * wrong + factor.rad * size
        far = far + (factor.mag + factor.rad) * floor
    return near, far
