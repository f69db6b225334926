"""Extremes over windows and over corners of a mesh, compiled: what costs most where the mesh is finer than the grid.

The same numbers as by sliding extremes in NumPy; what is no number stays so.
"""

from __future__ import annotations

import numpy as np

from certbound.arrays import Array, Integers
from certbound.lazy import compiled


def in_space(table: Array) -> Array:
    """The table with three axes, the first ones of length 1 where it has fewer."""
    return np.ascontiguousarray(table).reshape((1,) * (3 - table.ndim) + table.shape)


@compiled
def window_extremes(table: Array, start: Integers, size: tuple[int, int, int], largest: bool, out: Array) -> None:
    """The largest (least) entry of a window from every flat index in ``start`` on, written to ``out``."""
    plane, row = table.shape[1] * table.shape[2], table.shape[2]
    flat = table.ravel()
    for c in range(len(start)):
        best, unknown = (-np.inf if largest else np.inf), False
        for i in range(size[0]):
            for j in range(size[1]):
                first = start[c] + i * plane + j * row
                for k in range(first, first + size[2]):
                    value = flat[k]
                    unknown = unknown or value != value
                    if (value > best) if largest else (value < best):
                        best = value
        out[c] = np.nan if unknown else best


@compiled
def second_differences(table: Array) -> Array:
    """Sum over the axes of |g_{j-1} - 2 g_j + g_{j+1}|, without an axis' part at its ends."""
    p, q, r = table.shape
    total = np.zeros((p, q, r))
    for i in range(p):
        for j in range(q):
            for k in range(r):
                twice, found = 2 * table[i, j, k], 0.0
                if 0 < i < p - 1:
                    found += abs(table[i + 1, j, k] + table[i - 1, j, k] - twice)
                if 0 < j < q - 1:
                    found += abs(table[i, j + 1, k] + table[i, j - 1, k] - twice)
                if 0 < k < r - 1:
                    found += abs(table[i, j, k + 1] + table[i, j, k - 1] - twice)
                total[i, j, k] = found
    return total


def cell_ranges(table: Array, close: Array, near: float, beyond: float) -> tuple[Array, Array]:
    """The least and the largest corner of every cell of a mesh, widened.

    By an eighth of the largest sum of second differences at a corner, and by ``near`` times ``close`` (over cells)
    plus ``beyond``.
    """
    shape = tuple(size - 1 for size in table.shape)
    cells = (1,) * (3 - table.ndim) + shape
    low, high = np.empty(cells), np.empty(cells)
    bent, own = second_differences(in_space(table)), np.ascontiguousarray(close).reshape(cells)
    corners = 2 if table.ndim > 2 else 1, 2 if table.ndim > 1 else 1
    _cell_ranges(in_space(table), bent, own, near, beyond, corners, low, high)
    return low.reshape(shape), high.reshape(shape)


@compiled
def _cell_ranges(
    table: Array, bent: Array, close: Array, near: float, beyond: float, corners: tuple[int, int],
    low: Array, high: Array,
) -> None:  # fmt: skip
    """``cell_ranges`` with so many corners along the first two axes and two along the last."""
    p, q, r = low.shape
    for i in range(p):
        for j in range(q):
            for k in range(r):
                least, most, turn, total = np.inf, -np.inf, 0.0, 0.0
                for x in range(corners[0]):
                    for y in range(corners[1]):
                        for z in range(2):
                            value, other = table[i + x, j + y, k + z], bent[i + x, j + y, k + z]
                            least, most, turn = min(least, value), max(most, value), max(turn, other)
                            total += 0.0 * (value + other)  # no number as soon as one of them is none
                wide = (turn * 0.125 + close[i, j, k] * near + beyond) * (1 + 1e-9) + total
                low[i, j, k], high[i, j, k] = least - wide, most + wide
