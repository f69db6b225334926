"""Functions on a grid: multilinear plus a parabola per axis on every cell, constant on some cells, 1 outside.

On a cell with node values u and widths D,
    U(x) = (I u)(x) - sum_i b_i (x_i - a_i)(a_i + D_i - x_i)/2,
I the multilinear interpolation. For phi that is twice differentiable along the axes,
    phi - I_i phi = int G (-d_ii phi) <= -inf d_ii phi * (x_i - a_i)(a_i + D_i - x_i)/2   (G >= 0, Green's function of
the axis), and phi - I phi = sum_i I_1 ... I_{i-1} (phi - I_i phi) with positive I's: with u >= phi at the nodes and b_i
<= inf d_ii phi over the cell U lies above phi; with u <= phi and b_i >= sup d_ii phi below it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Mask
from certbound.values.grids import Grid, over_corners


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ValueFunction:
    """A function on a grid; 1 outside it.

    Parameters
    ----------
    grid : Grid
    nodal : ndarray, shape grid.node_shape
        u.
    bend : ndarray, shape (n, *grid.shape)
        b_i per cell; 0 where ``fixed``.
    fixed : ndarray of bool, shape grid.shape, or None
        Cells on which the function is a constant; None: there are none.
    level : ndarray, shape grid.shape
        That constant.
    """

    grid: Grid
    nodal: Array
    bend: Array
    fixed: Mask | None
    level: Array

    def size(self) -> Array:
        """Upper bound of the sum of the absolute parts of the function on every cell, shape grid.shape."""
        largest = over_corners(np.maximum, np.abs(self.nodal))
        parts = sum(np.abs(self.bend[i]) * self.grid.widths(i) ** 2 / 8 for i in range(self.grid.dimension))
        total = largest + parts
        if self.fixed is not None:
            total = np.where(self.fixed, 2 * largest + np.abs(self.level), total)
        return np.asarray(total * (1 + 1e-12))

    def range(self) -> tuple[Array, Array]:
        """Bounds of the function on every cell, shapes grid.shape."""
        low, high = over_corners(np.minimum, self.nodal), over_corners(np.maximum, self.nodal)
        for i in range(self.grid.dimension):
            share = self.grid.widths(i) ** 2 / 8 * (1 + 1e-12)
            low = low - np.maximum(self.bend[i], 0.0) * share
            high = high + np.maximum(-self.bend[i], 0.0) * share
        slack = 1e-12 * (np.abs(low) + np.abs(high))
        if self.fixed is not None:
            low, high = np.where(self.fixed, self.level, low), np.where(self.fixed, self.level, high)
        return low - slack, high + slack

    def values(self, points: Array) -> Array:
        """At points (P, n), in plain floats; 1 outside."""
        places, shares = [], []
        inside = np.ones(len(points), dtype=bool)
        for i, axis in enumerate(self.grid.axes):
            inside &= (points[:, i] >= axis[0]) & (points[:, i] <= axis[-1])
            place = np.clip(np.searchsorted(axis, points[:, i], side="right") - 1, 0, len(axis) - 2)
            places.append(place)
            shares.append((points[:, i] - axis[place]) / (axis[place + 1] - axis[place]))
        n = self.grid.dimension
        total = np.zeros(len(points))
        for corner in range(2**n):
            bits = [(corner >> i) & 1 for i in range(n)]
            weight = np.prod([share if bit else 1 - share for share, bit in zip(shares, bits)], axis=0)
            total += weight * self.nodal[tuple(place + bit for place, bit in zip(places, bits))]
        for i, axis in enumerate(self.grid.axes):
            width = axis[places[i] + 1] - axis[places[i]]
            total -= self.bend[(i, *places)] * width**2 * shares[i] * (1 - shares[i]) / 2
        if self.fixed is not None:
            total = np.where(self.fixed[tuple(places)], self.level[tuple(places)], total)
        return np.where(inside, total, 1.0)
