"""The residual's extreme Bernstein coefficients on patches of three states, compiled.

The operations of `residual`, a block of patches side by side in the last axis, one sample of time after the other so
that they stay in the processor's cache. Nothing is reordered by the compiler (no fast-math); the bound of the rounding
errors is that of `residual`.
"""

from __future__ import annotations

import numpy as np

from certbound.arrays import Array, Index
from certbound.lazy import compiled, within

BLOCK = 8
"""Patches that are worked on together."""


@within
def _contract(matrix: Array, table: Array, before: int | np.intp, after: int | np.intp, out: Array) -> None:
    """A matrix along the middle one of three axes, of lengths ``before``, its columns (4 or more) and ``after``.

    The arrays are flat; slices let the compiler see that rows do not overlap. Numbers that are written out are given
    as ``np.intp``: numba compiles a function anew for every literal.
    """
    rows, columns = matrix.shape
    for b in range(before):
        own = table[b * columns * after : (b + 1) * columns * after]
        t0, t1, t2, t3 = own[:after], own[after : 2 * after], own[2 * after : 3 * after], own[3 * after : 4 * after]
        for c in range(rows):
            row = out[(b * rows + c) * after : (b * rows + c + 1) * after]
            m0, m1, m2, m3 = matrix[c, 0], matrix[c, 1], matrix[c, 2], matrix[c, 3]
            for s in range(after):
                row[s] = m0 * t0[s] + m1 * t1[s] + m2 * t2[s] + m3 * t3[s]
        k = 4
        while k + 2 < columns:
            t0, t1, t2 = (own[k * after : (k + 1) * after], own[(k + 1) * after : (k + 2) * after],
                          own[(k + 2) * after : (k + 3) * after])  # fmt: skip
            for c in range(rows):
                row = out[(b * rows + c) * after : (b * rows + c + 1) * after]
                m0, m1, m2 = matrix[c, k], matrix[c, k + 1], matrix[c, k + 2]
                for s in range(after):
                    row[s] += m0 * t0[s] + m1 * t1[s] + m2 * t2[s]
            k += 3
        while k < columns:
            t0 = own[k * after : (k + 1) * after]
            for c in range(rows):
                row, m0 = out[(b * rows + c) * after : (b * rows + c + 1) * after], matrix[c, k]
                for s in range(after):
                    row[s] += m0 * t0[s]
            k += 1


@within
def _extreme(table: Array, count: int, low: Array, high: Array) -> None:
    """Least and largest of ``count`` entries for each patch of the block."""
    for s in range(BLOCK):
        low[s] = high[s] = table[s]
    for i in range(1, count):
        for s in range(BLOCK):
            low[s] = min(low[s], table[i * BLOCK + s])
            high[s] = max(high[s], table[i * BLOCK + s])


@within
def _extreme_parts(
    table: Array, parts: tuple[Array, Array, Array, Array], work: tuple[Array, Array, Array, Array], low: Array,
    high: Array,
) -> None:
    """Least and largest Bernstein coefficient of a table of samples over all parts of a patch."""
    time, x, y, z = parts
    one, two, slices, last = work
    nt, size = time.shape[1], x.shape[1] * y.shape[1] * z.shape[1]
    least, most = np.empty(BLOCK), np.empty(BLOCK)
    for s in range(BLOCK):
        low[s], high[s] = np.inf, -np.inf
    for i in range(x.shape[0]):
        for j in range(y.shape[0]):
            for k in range(z.shape[0]):
                for sample in range(nt):
                    own = slice(sample * size * BLOCK, (sample + 1) * size * BLOCK)
                    _contract(z[k], table[own], x.shape[1] * y.shape[1], np.intp(BLOCK), one)
                    _contract(y[j], one, x.shape[1], z.shape[1] * BLOCK, two)
                    _contract(x[i], two, np.intp(1), y.shape[1] * z.shape[1] * BLOCK, slices[own])
                for part in range(time.shape[0]):
                    _contract(time[part], slices, np.intp(1), size * BLOCK, last)
                    _extreme(last, nt * size, least, most)
                    for s in range(BLOCK):
                        low[s], high[s] = min(low[s], least[s]), max(high[s], most[s])


@within
def _derivatives(
    c: Array, rate: Array, axes: tuple[Array, ...], mixed: bool, work: tuple[Array, ...], out: Array
) -> None:
    """V_t, V_x, V_y, V_z, V_xx, V_yy, V_zz (and V_xy, V_xz, V_yz) at the samples of space, in the cell's units."""
    x0, x1, x2, y0, y1, y2, z0, z1, z2 = axes
    four, one, eight = np.intp(4), np.intp(1), np.intp(BLOCK)
    za, zb, zc, yy = work
    ny, nz = y0.shape[0], z0.shape[0]
    deep, wide = nz * BLOCK, ny * nz * BLOCK
    _contract(z0, rate, four * four, eight, za)
    _contract(y0, za, four, deep, yy)
    _contract(x0, yy, one, wide, out[0])
    _contract(z0, c, four * four, eight, za)
    _contract(z1, c, four * four, eight, zb)
    _contract(z2, c, four * four, eight, zc)
    _contract(y0, za, four, deep, yy)
    _contract(x1, yy, one, wide, out[1])
    _contract(x2, yy, one, wide, out[4])
    _contract(y1, za, four, deep, yy)
    _contract(x0, yy, one, wide, out[2])
    if mixed:
        _contract(x1, yy, one, wide, out[7])
    _contract(y2, za, four, deep, yy)
    _contract(x0, yy, one, wide, out[5])
    _contract(y0, zb, four, deep, yy)
    _contract(x0, yy, one, wide, out[3])
    if mixed:
        _contract(x1, yy, one, wide, out[8])
        _contract(y1, zb, four, deep, yy)
        _contract(x0, yy, one, wide, out[9])
    _contract(y0, zc, four, deep, yy)
    _contract(x0, yy, one, wide, out[6])


@within
def _gathered(
    table: Array, output: int, cells: Index, sample: int, factor: float, one: Array, two: Array, out: Array
) -> None:
    """An output of a table (outputs, cells, 1 or t, samples) for a block's cells times factor one two, lanes last."""
    own = min(sample, table.shape[2] - 1)
    if sample > own:
        return
    for s in range(BLOCK):
        scale = factor * one[s] * two[s]
        for p in range(table.shape[3]):
            out[p * BLOCK + s] = table[output, cells[s], own, p] * scale


@within
def _residual(v: Array, drift: Array, square: Array, mixed: bool, out: Array, energy: Array) -> None:
    """R for every branch (a row of ``out``; ``drift`` has three for each) and Q2 at the samples of space, flat."""
    vt, vx, vy, vz, xx, yy, zz = v[0], v[1], v[2], v[3], v[4], v[5], v[6]
    a, b, c = square[0], square[1], square[2]
    for p in range(len(vt)):
        energy[p] = a[p] * vx[p] * vx[p] + b[p] * vy[p] * vy[p] + c[p] * vz[p] * vz[p]
        vt[p] += a[p] * xx[p] + b[p] * yy[p] + c[p] * zz[p]
    if mixed:
        d, f, g, xy, xz, yz = square[3], square[4], square[5], v[7], v[8], v[9]
        for p in range(len(vt)):
            energy[p] += d[p] * vx[p] * vy[p] + f[p] * vx[p] * vz[p] + g[p] * vy[p] * vz[p]
            vt[p] += d[p] * xy[p] + f[p] * xz[p] + g[p] * yz[p]
    for branch in range(len(out)):
        own, fx, fy, fz = out[branch], drift[3 * branch], drift[3 * branch + 1], drift[3 * branch + 2]
        for p in range(len(vt)):
            own[p] = vt[p] + energy[p] + (fx[p] * vx[p] + fy[p] * vy[p] + fz[p] * vz[p])


@within
def _model(
    drift: Array, square: Array, cells: Index, sample: int, sides: Array, mixed: bool, force: Array, spread: Array
) -> None:
    """f_i / h_i, a_ii / (2 h_i^2) and a_ij / (h_i h_j) at the samples, so that V's derivatives are those on [0, 1].

    ``sides`` holds the four inverse sides of each patch, and ones.
    """
    for output in range(len(drift)):
        _gathered(drift, output, cells, sample, 1.0, sides[1 + output % 3], sides[4], force[output])
    for k in range(6 if mixed else 3):
        i, j = (k, k) if k < 3 else (0, k - 2) if k < 5 else (1, 2)
        _gathered(square, 3 * i + j, cells, sample, 0.5 if k < 3 else 1.0, sides[1 + i], sides[1 + j], spread[k])


@compiled
def extremes_in_space(
    coefficients: Array, inverse: Array, place: Index, drift: Array, square: Array, mixed: bool,
    bases: tuple[Array, ...], parts: tuple[Array, Array, Array, Array], wanted: float, out: Array,
) -> None:
    """Write to ``out`` (B, branches, 6): extreme coefficients of R, the least of Q2, extreme samples of R, Q2's size.

    ``coefficients`` has shape (B, 4, 64); ``inverse`` (4, B) holds 1 / the sides, time first; ``drift`` has shape
    (3 branches, cells, 1 or t, x y z), ``square`` (9, cells, 1 or t, x y z); ``place`` says which cell a patch is.
    ``bases`` are the values of the basis and of its derivatives at the samples: time 0, 1; then 0, 1, 2 of each
    state. ``parts`` (parts, samples, samples) lead from samples to Bernstein coefficients on equal parts of each axis.
    """
    t0, t1 = bases[0], bases[1]
    axes = bases[2:]
    nt, nx, ny, nz = t0.shape[0], bases[2].shape[0], bases[5].shape[0], bases[8].shape[0]
    size = nx * ny * nz
    c, now, rate = np.empty(256 * BLOCK), np.empty(64 * BLOCK), np.empty(64 * BLOCK)
    stages = (np.empty(16 * nz * BLOCK), np.empty(16 * nz * BLOCK), np.empty(16 * nz * BLOCK),
              np.empty(4 * ny * nz * BLOCK))  # fmt: skip
    v = np.zeros((10, size * BLOCK))
    force, spread = np.empty((drift.shape[0], size * BLOCK)), np.empty((6, size * BLOCK))
    tables, energy = np.empty((drift.shape[0] // 3, nt * size * BLOCK)), np.empty(nt * size * BLOCK)
    work = (np.empty(size * BLOCK), np.empty(size * BLOCK), np.empty(nt * size * BLOCK), np.empty(nt * size * BLOCK))
    low, high, look = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    least, most, cells, sides = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK, dtype=np.intp), np.ones((5, BLOCK))
    count = coefficients.shape[0]
    for begin in range(0, count, BLOCK):
        for s in range(BLOCK):  # the last patch is repeated where the block is not full
            patch = min(begin + s, count - 1)
            cells[s], look[s] = place[patch], 0.0
            for i in range(4):
                sides[i, s] = inverse[i, patch]
                for k in range(64):
                    c[(i * 64 + k) * BLOCK + s] = coefficients[patch, i, k]
        for sample in range(nt):
            _contract(t0[sample : sample + 1], c, np.intp(1), 64 * BLOCK, now)
            _contract(t1[sample : sample + 1], c, np.intp(1), 64 * BLOCK, rate)
            for k in range(64):
                for s in range(BLOCK):
                    rate[k * BLOCK + s] *= sides[0, s]
            _derivatives(now, rate, axes, mixed, stages, v)
            _model(drift, square, cells, sample, sides, mixed, force, spread)
            own = slice(sample * size * BLOCK, (sample + 1) * size * BLOCK)
            _residual(v, force, spread, mixed, tables[:, own], energy[own])
        for branch in range(len(tables)):
            _extreme_parts(tables[branch], parts, work, low, high)
            _extreme(tables[branch], nt * size, least, most)
            for s in range(min(BLOCK, count - begin)):
                out[begin + s, branch, 0], out[begin + s, branch, 1] = low[s], high[s]
                out[begin + s, branch, 3], out[begin + s, branch, 4] = least[s], most[s]
                look[s] = max(look[s], max(-low[s], high[s]))
        top = 0.0
        for s in range(BLOCK):
            low[s], top = 0.0, max(top, look[s])
        if top > wanted:
            _extreme_parts(energy, parts, work, low, high)
        _extreme(energy, nt * size, least, most)
        for s in range(min(BLOCK, count - begin)):
            for branch in range(len(tables)):
                out[begin + s, branch, 2], out[begin + s, branch, 5] = low[s], max(-least[s], most[s])
