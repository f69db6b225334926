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
        self.pick = pick
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
        self.blocks = blocks.ravel()

    def over(self, places: Integers) -> Array:
        """Over the boxes whose `places` are given, shape (4, K) to (K,)."""
        first, second, third, fourth = (self.blocks.take(row) for row in places)
        return np.asarray(self.pick(self.pick(self.pick(first, second), third), fourth))


def places(shape: tuple[int, ...], first: Integers, last: Integers) -> Integers:
    """Where the four blocks that cover the boxes from ``first`` to ``last``, both included, shapes (2, K), are kept.

    They serve all tables of one shape; shape (4, K).
    """
    level = np.frexp(last - first + 1)[1] - 1  # the largest power of 2 that fits
    ends = last - (1 << level) + 1
    base = (level[0] * int(shape[1]).bit_length() + level[1]) * shape[0]
    lines = [(base + rows) * shape[1] for rows in (first[0], ends[0])]
    return np.stack([line + columns for line in lines for columns in (first[1], ends[1])])
