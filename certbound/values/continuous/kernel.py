"""The residual's extreme Bernstein coefficients on patches of two states, compiled.

The same operations as in `residual`, patch by patch so that they stay in the processor's cache; nothing is reordered
by the compiler (no fast-math), and the bound of the rounding errors is that of `residual`.
"""

from __future__ import annotations

import numpy as np

from certbound.arrays import Array, Index
from certbound.lazy import compiled

BLOCK = 8
"""Patches that are worked on together, side by side in the last axis: the processor's vectors run along it."""


@compiled
def _change(table: Array, first: Array, second: Array, third: Array, one: Array, two: Array, out: Array) -> None:
    """A matrix along each of the first three axes of ``table``, written to ``out``."""
    p, q, r = table.shape[0], table.shape[1], table.shape[2]
    sums = np.empty(BLOCK)
    for i in range(p):
        for j in range(q):
            for c in range(third.shape[0]):
                for s in range(BLOCK):
                    sums[s] = 0.0
                for k in range(r):
                    weight = third[c, k]
                    for s in range(BLOCK):
                        sums[s] += weight * table[i, j, k, s]
                for s in range(BLOCK):
                    one[i, j, c, s] = sums[s]
        for b in range(second.shape[0]):
            for c in range(third.shape[0]):
                for s in range(BLOCK):
                    sums[s] = 0.0
                for j in range(q):
                    weight = second[b, j]
                    for s in range(BLOCK):
                        sums[s] += weight * one[i, j, c, s]
                for s in range(BLOCK):
                    two[i, b, c, s] = sums[s]
    for a in range(first.shape[0]):
        for b in range(second.shape[0]):
            for c in range(third.shape[0]):
                for s in range(BLOCK):
                    sums[s] = 0.0
                for i in range(p):
                    weight = first[a, i]
                    for s in range(BLOCK):
                        sums[s] += weight * two[i, b, c, s]
                for s in range(BLOCK):
                    out[a, b, c, s] = sums[s]


@compiled
def _extreme(table: Array, low: Array, high: Array) -> None:
    """Least and largest entry for each patch of the block."""
    for s in range(BLOCK):
        low[s] = high[s] = table[0, 0, 0, s]
    for i in range(table.shape[0]):
        for j in range(table.shape[1]):
            for k in range(table.shape[2]):
                for s in range(BLOCK):
                    low[s] = min(low[s], table[i, j, k, s])
                    high[s] = max(high[s], table[i, j, k, s])


@compiled
def _extreme_parts(
    table: Array, parts: tuple[Array, ...], one: Array, two: Array, result: Array, low: Array, high: Array
) -> None:
    """Least and largest coefficient of a table over all parts, which ``parts`` lead to from the samples."""
    least, most = np.empty(BLOCK), np.empty(BLOCK)
    for s in range(BLOCK):
        low[s], high[s] = np.inf, -np.inf
    for i in range(parts[0].shape[0]):
        for j in range(parts[1].shape[0]):
            for k in range(parts[2].shape[0]):
                _change(table, parts[0][i], parts[1][j], parts[2][k], one, two, result)
                _extreme(result, least, most)
                for s in range(BLOCK):
                    low[s], high[s] = min(low[s], least[s]), max(high[s], most[s])


@compiled
def extremes_in_plane(
    coefficients: Array, step: Array, width_x: Array, width_y: Array, place: Index, drift: Array, square: Array,
    bases: tuple[Array, ...], parts: tuple[Array, ...], wanted: float, straight: bool, out: Array,
) -> None:
    """Write to ``out`` (B, branches, 6): extreme coefficients of R, the least of Q2, extreme samples of R, Q2's size.

    ``straight`` takes 0 for Q2.

    ``drift`` has shape (branches, 2, cells, 1 or t, x, y), ``square`` (4, cells, 1 or t, x, y); ``place`` says which
    cell a patch is. ``bases`` are the values of the basis and of its derivatives at the samples: time 0, 1; x 0, 1, 2;
    y 0, 1, 2. ``parts`` (parts, samples, samples) lead from samples to Bernstein coefficients on
    equal parts of time, x and y.
    """
    t0, t1, x0, x1, x2, y0, y1, y2 = bases
    nt, nx, ny = t0.shape[0], x0.shape[0], y0.shape[0]
    shape = (nt, nx, ny, BLOCK)
    one, two = np.empty((max(nt, 4), max(nx, 6), max(ny, 6), BLOCK)), np.empty((max(nt, 4), nx, ny, BLOCK))
    vt, vx, vy, xx, yy, xy = (np.empty(shape), np.empty(shape), np.empty(shape), np.empty(shape), np.empty(shape),
                              np.empty(shape))  # fmt: skip
    rest, energy, result = np.empty(shape), np.empty(shape), np.empty(shape)
    c = np.empty((4, 6, 6, BLOCK))
    low, high, look = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    least, most = np.empty(BLOCK), np.empty(BLOCK)
    count = coefficients.shape[0]
    for begin in range(0, count, BLOCK):
        for s in range(BLOCK):  # the last patch is repeated where the block is not full
            patch, look[s] = min(begin + s, count - 1), 0.0
            for i in range(4):
                for j in range(6):
                    for k in range(6):
                        c[i, j, k, s] = coefficients[patch, i, j, k]
        _change(c, t1, x0, y0, one, two, vt)
        _change(c, t0, x1, y0, one, two, vx)
        _change(c, t0, x0, y1, one, two, vy)
        _change(c, t0, x2, y0, one, two, xx)
        _change(c, t0, x0, y2, one, two, yy)
        _change(c, t0, x1, y1, one, two, xy)
        for s in range(BLOCK):
            patch = min(begin + s, count - 1)
            cell, h, wx, wy = place[patch], 1 / step[patch], 1 / width_x[patch], 1 / width_y[patch]
            for i in range(nt):
                ia = min(i, square.shape[2] - 1)
                for j in range(nx):
                    for k in range(ny):
                        a, b = 0.5 * square[0, cell, ia, j, k], 0.5 * square[3, cell, ia, j, k]
                        m = square[1, cell, ia, j, k]
                        gx, gy = vx[i, j, k, s] * wx, vy[i, j, k, s] * wy
                        e = 0.0 if straight else a * gx * gx + b * gy * gy + m * gx * gy
                        vx[i, j, k, s], vy[i, j, k, s], energy[i, j, k, s] = gx, gy, e
                        bends = a * xx[i, j, k, s] * wx * wx + b * yy[i, j, k, s] * wy * wy
                        rest[i, j, k, s] = vt[i, j, k, s] * h + bends + m * xy[i, j, k, s] * wx * wy + e
        for branch in range(drift.shape[0]):
            for s in range(BLOCK):
                cell = place[min(begin + s, count - 1)]
                for i in range(nt):
                    ia = min(i, drift.shape[3] - 1)
                    for j in range(nx):
                        for k in range(ny):
                            vt[i, j, k, s] = (rest[i, j, k, s] + drift[branch, 0, cell, ia, j, k] * vx[i, j, k, s]
                                              + drift[branch, 1, cell, ia, j, k] * vy[i, j, k, s])  # fmt: skip
            _extreme_parts(vt, parts, one, two, result, low, high)
            _extreme(vt, least, most)
            for s in range(min(BLOCK, count - begin)):
                out[begin + s, branch, 0], out[begin + s, branch, 1] = low[s], high[s]
                out[begin + s, branch, 3], out[begin + s, branch, 4] = least[s], most[s]
                look[s] = max(look[s], max(-low[s], high[s]))
        top = 0.0
        for s in range(BLOCK):
            low[s], top = 0.0, max(top, look[s])
        if top > wanted and not straight:
            _extreme_parts(energy, parts, one, two, result, low, high)
        _extreme(energy, least, most)
        for s in range(min(BLOCK, count - begin)):
            for branch in range(drift.shape[0]):
                out[begin + s, branch, 2], out[begin + s, branch, 5] = low[s], max(-least[s], most[s])
