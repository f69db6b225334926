"""The residual's extreme Bernstein coefficients on patches of two states, compiled.

The same operations as in `residual`, patch by patch so that they stay in the processor's cache; nothing is reordered
by the compiler (no fast-math), and the bound of the rounding errors is that of `residual`.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["extremes_in_plane"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@njit(cache=True)
def _change(table: Array, first: Array, second: Array, third: Array, one: Array, two: Array, out: Array) -> None:
    """A matrix along each axis of ``table``, written to ``out``."""
    p, q, r = table.shape
    for i in range(p):
        for j in range(q):
            for c in range(third.shape[0]):
                total = 0.0
                for k in range(r):
                    total += third[c, k] * table[i, j, k]
                one[i, j, c] = total
    r = third.shape[0]
    for i in range(p):
        for b in range(second.shape[0]):
            for c in range(r):
                two[i, b, c] = 0.0
            for j in range(q):
                weight = second[b, j]
                for c in range(r):
                    two[i, b, c] += weight * one[i, j, c]
    q = second.shape[0]
    for a in range(first.shape[0]):
        for b in range(q):
            for c in range(r):
                out[a, b, c] = 0.0
        for i in range(p):
            weight = first[a, i]
            for b in range(q):
                for c in range(r):
                    out[a, b, c] += weight * two[i, b, c]


@njit(cache=True)
def extremes_in_plane(
    coefficients: Array, step: Array, width_x: Array, width_y: Array, place: Index, drift: Array, square: Array,
    bases: tuple[Array, ...], inverses: tuple[Array, ...], wanted: float, out: Array,
) -> None:
    """Write least and largest coefficient of R for each branch, then the least of Q2, to ``out`` (B, branches, 3).

    ``drift`` has shape (branches, 2, cells, 1 or t, x, y), ``square`` (4, cells, 1 or t, x, y); ``place`` says which
    cell a patch is. ``bases`` are the values of the basis and of its derivatives at the samples: time 0, 1; x 0, 1, 2;
    y 0, 1, 2. ``inverses`` lead from samples to Bernstein coefficients in time, x and y.
    """
    t0, t1, x0, x1, x2, y0, y1, y2 = bases
    nt, nx, ny = t0.shape[0], x0.shape[0], y0.shape[0]
    one, two = np.empty((nt, max(nx, 6), ny)), np.empty((nt, nx, ny))
    vt, vx, vy = np.empty((nt, nx, ny)), np.empty((nt, nx, ny)), np.empty((nt, nx, ny))
    xx, yy, xy = np.empty((nt, nx, ny)), np.empty((nt, nx, ny)), np.empty((nt, nx, ny))
    rest, energy, result = np.empty((nt, nx, ny)), np.empty((nt, nx, ny)), np.empty((nt, nx, ny))
    for patch in range(coefficients.shape[0]):
        c, cell = coefficients[patch], place[patch]
        h, wx, wy = 1 / step[patch], 1 / width_x[patch], 1 / width_y[patch]
        _change(c, t1, x0, y0, one, two, vt)
        _change(c, t0, x1, y0, one, two, vx)
        _change(c, t0, x0, y1, one, two, vy)
        _change(c, t0, x2, y0, one, two, xx)
        _change(c, t0, x0, y2, one, two, yy)
        _change(c, t0, x1, y1, one, two, xy)
        for i in range(nt):
            ia = min(i, square.shape[2] - 1)
            for j in range(nx):
                for k in range(ny):
                    a, b = 0.5 * square[0, cell, ia, j, k], 0.5 * square[3, cell, ia, j, k]
                    m = square[1, cell, ia, j, k]
                    gx, gy = vx[i, j, k] * wx, vy[i, j, k] * wy
                    e = a * gx * gx + b * gy * gy + m * gx * gy
                    vx[i, j, k], vy[i, j, k], energy[i, j, k] = gx, gy, e
                    bends = a * xx[i, j, k] * wx * wx + b * yy[i, j, k] * wy * wy + m * xy[i, j, k] * wx * wy
                    rest[i, j, k] = vt[i, j, k] * h + bends + e
        look = False
        for branch in range(drift.shape[0]):
            for i in range(nt):
                ia = min(i, drift.shape[3] - 1)
                for j in range(nx):
                    for k in range(ny):
                        vt[i, j, k] = (rest[i, j, k] + drift[branch, 0, cell, ia, j, k] * vx[i, j, k]
                                       + drift[branch, 1, cell, ia, j, k] * vy[i, j, k])  # fmt: skip
            _change(vt, inverses[0], inverses[1], inverses[2], one, two, result)
            out[patch, branch, 0], out[patch, branch, 1] = result.min(), result.max()
            look = look or out[patch, branch, 0] < -wanted or out[patch, branch, 1] > wanted
        out[patch, :, 2] = 0.0
        if look:
            _change(energy, inverses[0], inverses[1], inverses[2], one, two, result)
            out[patch, :, 2] = result.min()
