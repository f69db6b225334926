"""The largest or smallest value over many boxes of cells, by tables of blocks whose sides are powers of 2."""

from __future__ import annotations

import numpy as np

from certbound.arrays import Array, Integers


class Extremes:
    """Extremes over boxes of a table's entries.

    Parameters
    ----------
    table : ndarray, shape (N, M)
    pick : ufunc
        ``np.maximum`` or ``np.minimum``.
    """

    def __init__(self, table: Array, pick: np.ufunc) -> None:
        self.pick, self.shape = pick, table.shape
        levels = [int(size).bit_length() for size in table.shape]
        blocks = np.empty((*levels, *table.shape))
        blocks[0, 0] = table
        for b in range(1, levels[1]):
            half = 1 << (b - 1)
            blocks[0, b] = blocks[0, b - 1]
            pick(blocks[0, b - 1][:, :-half], blocks[0, b - 1][:, half:], out=blocks[0, b][:, :-half])
        for a in range(1, levels[0]):
            half = 1 << (a - 1)
            blocks[a] = blocks[a - 1]
            pick(blocks[a - 1][:, :-half], blocks[a - 1][:, half:], out=blocks[a][:, :-half])
        self.blocks, self.levels = blocks.ravel(), levels

    def over(self, first: Integers, last: Integers) -> Array:
        """Over the entries from ``first`` to ``last``, both included, shapes (2, K)."""
        level = np.frexp(last - first + 1)[1] - 1  # the largest power of 2 that fits
        ends = last - (1 << level) + 1
        base = (level[0] * self.levels[1] + level[1]) * self.shape[0]
        found: Array | None = None
        for rows in (first[0], ends[0]):
            line = (base + rows) * self.shape[1]
            for columns in (first[1], ends[1]):
                value = self.blocks.take(line + columns)
                found = value if found is None else self.pick(found, value)
        assert found is not None
        return found
