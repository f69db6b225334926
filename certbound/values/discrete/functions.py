"""Functions on a grid: multilinear plus a parabola or a cubic per axis, constant on some cells, 1 or 0 outside.

On a cell with node values u and widths D,
    U(x) = (I u)(x) - sum_i b_i (x_i - a_i)(a_i + D_i - x_i)/2,
I the multilinear interpolation. For phi that is twice differentiable along the axes,
    phi - I_i phi = int G (-d_ii phi) <= -inf d_ii phi * (x_i - a_i)(a_i + D_i - x_i)/2   (G >= 0, Green's function of
the axis), and phi - I phi = sum_i I_1 ... I_{i-1} (phi - I_i phi) with positive I's: with u >= phi at the nodes and b_i
<= inf d_ii phi over the cell U lies above phi; with u <= phi and b_i >= sup d_ii phi below it. Instead of numbers b_i
there may be functions that are multilinear between values at the nodes (``cubic/cubic_step``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from certbound.arrays import Array, Mask
from certbound.values.grids import Grid, over_corners


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ValueFunction:
    """A function on a grid.

    Parameters
    ----------
    grid : Grid
    nodal : ndarray, shape grid.node_shape
        u.
    bend : ndarray, shape (n, *grid.shape) or (n, *grid.node_shape)
        b_i per cell; 0 where ``fixed``. Or at the nodes; then nothing is fixed.
    fixed : ndarray of bool, shape grid.shape, or None
        Cells on which the function is a constant; None: there are none.
    level : ndarray, shape grid.shape
        That constant.
    beyond : float
        Outside the grid: 1, or 0 where paths that get there have ended.
    """

    grid: Grid
    nodal: Array
    bend: Array
    fixed: Mask | None
    level: Array
    beyond: float = 1.0

    @property
    def curved(self) -> bool:
        """Whether the second derivatives are given at the nodes."""
        return self.bend.shape[1:] == self.nodal.shape

    def bend_ends(self, i: int) -> tuple[Array, Array]:
        """The least and the largest b_i on every cell."""
        bend = self.bend[i]
        return (over_corners(np.minimum, bend), over_corners(np.maximum, bend)) if self.curved else (bend, bend)

    def flat(self, *, above: bool) -> ValueFunction:
        """A function with one number b_i a cell, nowhere below this one (``above``), or nowhere above it."""
        if not self.curved:
            return self
        bend = np.stack([self.bend_ends(i)[0 if above else 1] for i in range(self.grid.dimension)])
        return replace(self, bend=bend)

    def size(self) -> Array:
        """Upper bound of the sum of the absolute parts of the function on every cell, shape grid.shape."""
        largest = over_corners(np.maximum, np.abs(self.nodal))
        parts: Array | float = 0.0
        for i in range(self.grid.dimension):
            least, most = self.bend_ends(i)
            parts = parts + np.maximum(-least, most) * self.grid.widths(i) ** 2 / 8
        total = largest + parts
        if self.fixed is not None:
            total = np.where(self.fixed, 2 * largest + np.abs(self.level), total)
        return np.asarray(total * (1 + 1e-12))

    def range(self) -> tuple[Array, Array]:
        """Bounds of the function on every cell, shapes grid.shape."""
        low, high = over_corners(np.minimum, self.nodal), over_corners(np.maximum, self.nodal)
        for i in range(self.grid.dimension):
            share = self.grid.widths(i) ** 2 / 8 * (1 + 1e-12)
            least, most = self.bend_ends(i)
            low = low - np.maximum(most, 0.0) * share
            high = high + np.maximum(-least, 0.0) * share
        slack = 1e-12 * (np.abs(low) + np.abs(high))
        if self.fixed is not None:
            low, high = np.where(self.fixed, self.level, low), np.where(self.fixed, self.level, high)
        return low - slack, high + slack

    def ranges_within(self, parts: int) -> tuple[tuple[Array, ...], Array, Array]:
        """Nodes of the cells cut in ``parts`` along each axis, and bounds of the function on them.

        On a part U is again the multilinear function of its corners less parabolas with the same bends. A node in
        floats lies within a roundoff of |x| of where the cell is cut, and |d_i U| is at most 6 size / D_i.
        """
        n, shares = self.grid.dimension, np.arange(parts + 1) / parts
        table = self.nodal
        for axis in range(n):  # every cell gets values of its own: bends differ across a face
            moved = np.moveaxis(table, axis, 0)
            cut = moved[:-1, ..., None] * (1 - shares) + moved[1:, ..., None] * shares
            table = np.moveaxis(cut, 0, axis)
        bulge = np.zeros((2, *self.grid.shape))
        off = np.zeros(self.grid.shape)
        for i, axis_nodes in enumerate(self.grid.axes):
            width, bend = self.grid.widths(i), self.bend[i]
            arch = np.reshape(shares * (1 - shares) / 2, [-1 if k == n + i else 1 for k in range(2 * n)])
            table = table - np.reshape(bend * width**2, (*self.grid.shape, *[1] * n)) * arch
            bulge += np.maximum([bend, -bend], 0.0) * (width / parts) ** 2 / 8 * (1 + 1e-12)
            off = off + 12 * np.abs(axis_nodes).max() / width
        low, high = table, table
        for i in range(n):
            low, high = (np.moveaxis(end, n + i, 0) for end in (low, high))
            low, high = np.minimum(low[:-1], low[1:]), np.maximum(high[:-1], high[1:])
            low, high = (np.moveaxis(end, 0, n + i) for end in (low, high))
        wide = (*self.grid.shape, *[1] * n)
        slack = self.size() * (1e-12 + 2.0**-53 * off)
        least, most = (np.reshape(end, wide) for end in self.range())
        low = np.maximum(low - np.reshape(bulge[0] + slack, wide), least)
        high = np.minimum(high + np.reshape(bulge[1] + slack, wide), most)
        if self.fixed is not None:
            fixed, level = np.reshape(self.fixed, wide), np.reshape(self.level, wide)
            low, high = np.where(fixed, level, low), np.where(fixed, level, high)
        order = [axis for i in range(n) for axis in (i, n + i)]
        shape = [size * parts for size in self.grid.shape]
        low, high = (end.transpose(order).reshape(shape) for end in (low, high))
        nodes = [(axis[:-1, None] + np.diff(axis)[:, None] * shares[:-1]).ravel() for axis in self.grid.axes]
        return tuple(np.append(node, axis[-1]) for node, axis in zip(nodes, self.grid.axes)), low, high

    def values(self, points: Array) -> Array:
        """At points (P, n), in plain floats."""
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
            node = tuple(place + bit for place, bit in zip(places, bits))
            total += weight * self.nodal[node]
            for i, axis in enumerate(self.grid.axes if self.curved else ()):
                width, share = np.diff(axis)[places[i]], shares[i]
                arch = share * (1 - share) * width**2 / 6 * (1 + (share if bits[i] else 1 - share))
                total -= arch * np.prod(
                    [s if bit else 1 - s for k, (s, bit) in enumerate(zip(shares, bits)) if k != i], axis=0
                ) * self.bend[(i, *node)]  # fmt: skip
        for i, axis in enumerate(() if self.curved else self.grid.axes):
            width = axis[places[i] + 1] - axis[places[i]]
            total -= self.bend[(i, *places)] * width**2 * shares[i] * (1 - shares[i]) / 2
        if self.fixed is not None:
            total = np.where(self.fixed[tuple(places)], self.level[tuple(places)], total)
        return np.where(inside, total, self.beyond)
