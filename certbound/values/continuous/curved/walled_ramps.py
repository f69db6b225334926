"""Floating-point proposals of the probability U itself in a region with curved walls; nothing here is certified.

The solver is that of a box (`straight`), its equation being asked for by least squares: at nine points of a cell as far
as they lie in the region, beside U = 1 on the walls, and that the splines which hardly any point sees are smooth.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csc_matrix, csr_matrix, diags, kron, vstack
from scipy.sparse.linalg import splu

from certbound.arrays import Array, Mask
from certbound.values.continuous.curved.boundaries import Deep, Walls
from certbound.values.continuous.curved.continuation import crowded_nodes, wall_points
from certbound.values.continuous.curved.cuts import Cuts
from certbound.values.continuous.curved.proof import least_on_walls
from certbound.values.continuous.plane import Plan, Plane, Source
from certbound.values.continuous.straight import Ramps, Solve, left_at, ramp_of, stage_rates
from certbound.values.continuous.surface import Surface

_CROWD = 0.7  # how much denser the grid is around walls than it would be
_PLACES = (0.1127, 0.5, 0.8873)  # in a cell, along each state: Gauss's
_ON_WALL = 3.0  # the weight of U = 1 on the walls, that of the equation being about 1 for U itself
_AGE = 0.8  # of a ramp, in units of a cell's width squared over the noise's variance
_LAYER, _ZONE = 1.5, 2.0  # widths of layers at faces, and of where the drift is weakened, in cells
_SMOOTH = 1e-3  # of third differences of coefficients outside
_SYMMETRIC = {"SymmetricMode": True}  # normal equations need no pivots, so that their order may keep them sparse


class WalledRamps(Ramps):
    """U = 1 on the walls, but for the ramp at T."""

    def __init__(self, plane: Plane, walls: Deep, cells: int) -> None:
        self.walls, self.curve = walls, wall_points(walls, plane, 4 * cells)
        super().__init__(plane, cells, _lead(plane, cells))
        self.points = [(nodes[:-1, None] + np.diff(nodes)[:, None] * _PLACES).ravel() for nodes in self.nodes]
        x, y = np.meshgrid(*self.points, indexing="ij")
        self.asked = self.due(x, y).ravel()
        own = [[csr_matrix(one.spline(at, order)) for order in range(3)] for one, at in zip(self.splines, self.points)]
        (force,), a = plane.drift(0.0, x, y), plane.square(0.0, x, y) * np.ones((2, 2, *x.shape))
        force = self._weakened(force, a, (x, y))

        def part(weight: Array | float, i: int, j: int) -> csr_matrix:
            chosen = kron(own[0][i], own[1][j], format="csr")[self.asked]
            return csr_matrix(diags((weight * np.ones(x.shape)).ravel()[self.asked]) @ chosen)

        self.values = part(1.0, 0, 0)
        self.rates = part(force[0], 1, 0) + part(force[1], 0, 1) + part(a[0, 1], 1, 1)
        self.rates += part(a[0, 0] / 2, 2, 0) + part(a[1, 1] / 2, 0, 2)
        across = [a[k, k].ravel()[self.asked] / np.median(np.diff(self.nodes[k])) ** 2 for k in (0, 1)]
        self.speed = across[0] + across[1]
        rows = [one.spline(self.curve[:, axis]) for axis, one in enumerate(self.splines)]
        self.at_walls = csr_matrix(np.einsum("pi,pj->pij", *rows).reshape(len(self.curve), -1))
        self.smooth = _differences(np.asarray(walls.depth(*self.places)) < 0)

    def grid(self, axis: int, plan: Plan) -> Array:
        return crowded_nodes(self.plane, plan, axis, self.curve, _CROWD)

    def due(self, x: Array, y: Array) -> Mask:
        """Where the equation is asked for."""
        return np.asarray(self.walls.depth(x, y) > 0)

    def least(self, whole: Surface) -> float:
        assert isinstance(self.walls, Walls)
        return min(super().least(whole), least_on_walls(whole, Cuts.of(whole.axes, self.walls)))

    def _weakened(self, force: Array, a: Array, places: Sequence[Array]) -> Array:
        """The drift, less of it leading inside near faces, whose layers then fit the cells: U only grows by that."""
        found = force.copy()
        for axis, (nodes, place) in enumerate(zip(self.nodes, places)):
            for sign, end, width in ((1, nodes[0], nodes[1] - nodes[0]), (-1, nodes[-1], nodes[-1] - nodes[-2])):
                away = np.abs(place - end) / width
                most = a[axis, axis] / (_LAYER * width) * np.maximum(1.0, away / _ZONE) ** 4
                found[axis] = np.where(sign * found[axis] > most, sign * most, found[axis])
        return found

    def fed(self, source: Source) -> Array:
        rows = [super().fed(source), source.at(self.points)]
        flat = [row.reshape(len(row), -1) for row in rows]
        return np.concatenate([flat[0], flat[1][:, self.asked]], axis=1)

    def _step(self, value: Array, step: float, fed: Array, ages: Array) -> Array:
        fed = fed * np.ones(len(value) + self.values.shape[0])
        edges = self.edges(value, step, fed[:, : len(value)], ages)
        asked = np.outer(stage_rates(step), np.asarray(self.values @ value)) + fed[:, len(value) :]
        walls = np.outer(1 - left_at(ages / self.lead), np.ones(len(self.curve)))
        return self.solved(step, np.concatenate([edges, asked, walls], axis=1))

    def factor(self, root: complex) -> Solve:
        weights = 1 / (abs(root) + self.speed)
        parts = [diags(weights) @ (root * self.values - self.rates), _ON_WALL * self.at_walls, _SMOOTH * self.smooth]
        whole = csc_matrix(vstack(parts))
        free = np.setdiff1d(np.arange(whole.shape[1]), self.edge)
        own, given = whole[:, free], whole[:, self.edge]
        back = csr_matrix(own.conj().T)
        normal = splu(csc_matrix(back @ own), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=_SYMMETRIC)
        count = len(self.edge)

        def solve(right: Array) -> Array:
            asked = right[count : count + len(weights)] * weights
            walls = _ON_WALL * right[count + len(weights) :]
            wanted = np.concatenate([asked, walls, np.zeros(self.smooth.shape[0])]) - given @ right[:count]
            found = np.zeros(whole.shape[1], dtype=right.dtype)
            found[self.edge], found[free] = right[:count], normal.solve(back @ wanted)
            return found

        return solve


def _lead(plane: Plane, cells: int) -> float:
    """How long a ramp takes, so that layers at walls are about a cell wide."""
    widths = [(high - low) / cells for low, high in zip(plane.low, plane.high)]
    x, y = np.meshgrid(*(np.linspace(low, high, 9) for low, high in zip(plane.low, plane.high)))
    square = plane.square(0.0, x, y)
    ages = [_AGE * width**2 / max(float(np.median(square[k, k])), 1e-300) for k, width in enumerate(widths)]
    return max(ramp_of(cells) * plane.horizon, min(*ages, 0.1 * plane.horizon))


def _differences(outside: Mask) -> csr_matrix:
    """Third differences of coefficients along both axes, where one of them stands outside."""
    count = outside.size
    numbers, rows = np.arange(count).reshape(outside.shape), []
    for own, away in ((numbers, outside), (numbers.T, outside.T)):
        places = np.stack([own[k : len(own) - 3 + k] for k in range(4)], axis=-1)
        met = np.any([away[k : len(own) - 3 + k] for k in range(4)], axis=0)
        rows.append(places[met])
    places = np.concatenate(rows)
    entries = np.tile([-1.0, 3.0, -3.0, 1.0], len(places))
    lines = np.repeat(np.arange(len(places)), 4)
    return csr_matrix((entries, (lines, places.ravel())), shape=(len(places), count))
