"""The residual's extreme Bernstein coefficients on patches of three states, compiled.

The operations of `residual`, a block of patches side by side in the last axis, one sample of time after the other so
that they stay in the processor's cache. Nothing is reordered by the compiler (no fast-math); the bound of the rounding
errors is that of `residual`.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from certbound.arrays import Array, Index

BLOCK = 8
"""Patches that are worked on together."""


@njit(cache=True)
def _contract(matrix: Array, table: Array, before: int, after: int, out: Array) -> None:
    """A matrix along the middle one of three axes, of lengths ``before``, its columns and ``after``; flat arrays."""
    rows, columns = matrix.shape
    for b in range(before):
        base = b * columns * after
        for c in range(rows):
            start = (b * rows + c) * after
            place, k = base, 1
            weight = matrix[c, 0]
            for s in range(after):
                out[start + s] = weight * table[place + s]
            while k + 2 < columns:
                first, second, third = matrix[c, k], matrix[c, k + 1], matrix[c, k + 2]
                p, q, r = base + k * after, base + (k + 1) * after, base + (k + 2) * after
                for s in range(after):
                    out[start + s] += first * table[p + s] + second * table[q + s] + third * table[r + s]
                k += 3
            while k < columns:
                weight, place = matrix[c, k], base + k * after
                for s in range(after):
                    out[start + s] += weight * table[place + s]
                k += 1


@njit(cache=True)
def _cube(
    table: Array, size: int, first: Array, second: Array, third: Array, one: Array, two: Array, out: Array
) -> None:
    """A matrix along each axis of a cube of ``size`` per axis; lanes last."""
    _contract(third, table, size * size, BLOCK, one)
    _contract(second, one, size, third.shape[0] * BLOCK, two)
    _contract(first, two, 1, second.shape[0] * third.shape[0] * BLOCK, out)


@njit(cache=True)
def _extreme(table: Array, count: int, low: Array, high: Array) -> None:
    """Least and largest of ``count`` entries for each patch of the block."""
    for s in range(BLOCK):
        low[s] = high[s] = table[s]
    for i in range(1, count):
        for s in range(BLOCK):
            low[s] = min(low[s], table[i * BLOCK + s])
            high[s] = max(high[s], table[i * BLOCK + s])


@njit(cache=True)
def _extreme_parts(
    table: Array, parts: tuple[Array, Array, Array, Array], work: tuple[Array, Array, Array, Array], low: Array,
    high: Array,
) -> None:
    """Least and largest Bernstein coefficient of a table of samples over all parts of a patch."""
    time, x, y, z = parts
    one, two, slices, last = work
    nt, size = time.shape[1], x.shape[1] * y.shape[1] * z.shape[1]
    least, most = np.empty(BLOCK), np.empty(BLOCK)
    low[:], high[:] = np.inf, -np.inf
    for i in range(x.shape[0]):
        for j in range(y.shape[0]):
            for k in range(z.shape[0]):
                for sample in range(nt):
                    own = slice(sample * size * BLOCK, (sample + 1) * size * BLOCK)
                    _contract(z[k], table[own], x.shape[1] * y.shape[1], BLOCK, one)
                    _contract(y[j], one, x.shape[1], z.shape[1] * BLOCK, two)
                    _contract(x[i], two, 1, y.shape[1] * z.shape[1] * BLOCK, slices[own])
                for part in range(time.shape[0]):
                    _contract(time[part], slices, 1, size * BLOCK, last)
                    _extreme(last, nt * size, least, most)
                    for s in range(BLOCK):
                        low[s], high[s] = min(low[s], least[s]), max(high[s], most[s])


@njit(cache=True)
def _derivatives(
    c: Array, rate: Array, axes: tuple[Array, ...], mixed: bool, work: tuple[Array, ...], out: Array
) -> None:
    """V_t, V_x, V_y, V_z, V_xx, V_yy, V_zz (and V_xy, V_xz, V_yz) at the samples of space, in the cell's units."""
    x0, x1, x2, y0, y1, y2, z0, z1, z2 = axes
    za, zb, zc, yy = work
    nx, ny, nz = x0.shape[0], y0.shape[0], z0.shape[0]
    deep, wide = nz * BLOCK, ny * nz * BLOCK
    _contract(z0, rate, 16, BLOCK, za)
    _contract(y0, za, 4, deep, yy)
    _contract(x0, yy, 1, wide, out[0])
    _contract(z0, c, 16, BLOCK, za)
    _contract(z1, c, 16, BLOCK, zb)
    _contract(z2, c, 16, BLOCK, zc)
    _contract(y0, za, 4, deep, yy)
    _contract(x1, yy, 1, wide, out[1])
    _contract(x2, yy, 1, wide, out[4])
    _contract(y1, za, 4, deep, yy)
    _contract(x0, yy, 1, wide, out[2])
    if mixed:
        _contract(x1, yy, 1, wide, out[7])
    _contract(y2, za, 4, deep, yy)
    _contract(x0, yy, 1, wide, out[5])
    _contract(y0, zb, 4, deep, yy)
    _contract(x0, yy, 1, wide, out[3])
    if mixed:
        _contract(x1, yy, 1, wide, out[8])
        _contract(y1, zb, 4, deep, yy)
        _contract(x0, yy, 1, wide, out[9])
    _contract(y0, zc, 4, deep, yy)
    _contract(x0, yy, 1, wide, out[6])


@njit(cache=True)
def _residual(
    v: Array, patch: int, lane: int, cell: int, sample: int, inverse: Array, drift: Array, square: Array, mixed: bool,
    tables: Array, energy: Array,
) -> None:
    """R for every branch and Q2 at the samples of space and one of time, for one lane."""
    size = square.shape[3]
    own = min(sample, square.shape[2] - 1)
    now = min(sample, drift.shape[3] - 1)
    h, wx, wy, wz = inverse[0, patch], inverse[1, patch], inverse[2, patch], inverse[3, patch]
    for p in range(size):
        at = p * BLOCK + lane
        gx, gy, gz = v[1, at] * wx, v[2, at] * wy, v[3, at] * wz
        a, b, c = 0.5 * square[0, cell, own, p], 0.5 * square[4, cell, own, p], 0.5 * square[8, cell, own, p]
        e = a * gx * gx + b * gy * gy + c * gz * gz
        rest = v[0, at] * h + a * v[4, at] * wx * wx + b * v[5, at] * wy * wy + c * v[6, at] * wz * wz
        if mixed:
            d, f, g = square[1, cell, own, p], square[2, cell, own, p], square[5, cell, own, p]
            e += d * gx * gy + f * gx * gz + g * gy * gz
            rest += d * v[7, at] * wx * wy + f * v[8, at] * wx * wz + g * v[9, at] * wy * wz
        place = sample * size * BLOCK + at
        energy[place] = e
        for branch in range(drift.shape[0]):
            force = drift[branch, 0, cell, now, p] * gx + drift[branch, 1, cell, now, p] * gy
            tables[branch, place] = rest + e + (force + drift[branch, 2, cell, now, p] * gz)


@njit(cache=True, nogil=True)
def extremes_in_space(
    coefficients: Array, inverse: Array, place: Index, drift: Array, square: Array, mixed: bool,
    bases: tuple[Array, ...], parts: tuple[Array, Array, Array, Array], wanted: float, out: Array,
) -> None:
    """Write to ``out`` (B, branches, 6): extreme coefficients of R, the least of Q2, extreme samples of R, Q2's size.

    ``coefficients`` has shape (B, 4, 64); ``inverse`` (4, B) holds 1 / the sides, time first; ``drift`` has shape
    (branches, 3, cells, 1 or t, x y z), ``square`` (9, cells, 1 or t, x y z); ``place`` says which cell a patch is.
    ``bases`` are the values of the basis and of its derivatives at the samples: time 0, 1; then 0, 1, 2 of each
    state. ``parts`` (parts, samples, samples) lead from samples to Bernstein coefficients on equal parts of each axis.
    """
    t0, t1 = bases[0], bases[1]
    axes = bases[2:]
    nt, nx, ny, nz = t0.shape[0], bases[2].shape[0], bases[5].shape[0], bases[8].shape[0]
    size = nx * ny * nz
    c, now, rate = np.empty((4, 64, BLOCK)), np.empty(64 * BLOCK), np.empty(64 * BLOCK)
    stages = (np.empty(16 * nz * BLOCK), np.empty(16 * nz * BLOCK), np.empty(16 * nz * BLOCK),
              np.empty(4 * ny * nz * BLOCK))  # fmt: skip
    v = np.zeros((10, size * BLOCK))
    tables, energy = np.empty((drift.shape[0], nt * size * BLOCK)), np.empty(nt * size * BLOCK)
    work = (np.empty(size * BLOCK), np.empty(size * BLOCK), np.empty(nt * size * BLOCK), np.empty(nt * size * BLOCK))
    low, high, look = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    least, most = np.empty(BLOCK), np.empty(BLOCK)
    count = coefficients.shape[0]
    for begin in range(0, count, BLOCK):
        for s in range(BLOCK):  # the last patch is repeated where the block is not full
            c[:, :, s] = coefficients[min(begin + s, count - 1)]
            look[s] = 0.0
        for sample in range(nt):
            _contract(t0[sample : sample + 1], c.reshape(-1), 1, 64 * BLOCK, now)
            _contract(t1[sample : sample + 1], c.reshape(-1), 1, 64 * BLOCK, rate)
            _derivatives(now, rate, axes, mixed, stages, v)
            for s in range(BLOCK):
                patch = min(begin + s, count - 1)
                _residual(v, patch, s, place[patch], sample, inverse, drift, square, mixed, tables, energy)
        for branch in range(drift.shape[0]):
            _extreme_parts(tables[branch], parts, work, low, high)
            _extreme(tables[branch], nt * size, least, most)
            for s in range(min(BLOCK, count - begin)):
                out[begin + s, branch, 0], out[begin + s, branch, 1] = low[s], high[s]
                out[begin + s, branch, 3], out[begin + s, branch, 4] = least[s], most[s]
                look[s] = max(look[s], max(-low[s], high[s]))
        if look.max() > wanted:
            _extreme_parts(energy, parts, work, low, high)
        else:
            low[:] = 0.0
        _extreme(energy, nt * size, least, most)
        for s in range(min(BLOCK, count - begin)):
            out[begin + s, :, 2], out[begin + s, :, 5] = low[s], max(-least[s], most[s])
