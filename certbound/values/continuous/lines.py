"""Banded systems along all lines of a plane grid, compiled (plain floats)."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["solve_lines"]

Array = NDArray[np.float64]


@njit(cache=True)
def solve_lines(mass: Array, slope: Array, bend: Array, speed: Array, half: Array, step: float, right: Array) -> None:
    """Solve (mass - step (speed slope + half bend)) k = right along the first axis, line by line, in place.

    The three matrices are given by the rows of their bands (entry (i, k) belongs to column i + k - band); the first and
    the last row are those of ``mass``. ``speed``, ``half`` and ``right`` have shape (rows, lines). No pivots.
    """
    size, wide = mass.shape
    band = (wide - 1) // 2
    work = np.empty((size, wide))
    for line in range(right.shape[1]):
        for i in range(size):
            inside = step if 0 < i < size - 1 else 0.0
            for k in range(wide):
                work[i, k] = mass[i, k] - inside * (speed[i, line] * slope[i, k] + half[i, line] * bend[i, k])
        for i in range(size):
            for j in range(i + 1, min(size, i + band + 1)):
                factor = work[j, i - j + band]
                if factor != 0.0:
                    factor /= work[i, band]
                    for k in range(1, band + 1):
                        if i + k < size:
                            work[j, i + k - j + band] -= factor * work[i, k + band]
                    right[j, line] -= factor * right[i, line]
        for i in range(size - 1, -1, -1):
            total = right[i, line]
            for k in range(1, band + 1):
                if i + k < size:
                    total -= work[i, k + band] * right[i + k, line]
            right[i, line] = total / work[i, band]
