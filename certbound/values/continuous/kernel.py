"""The residual's extreme Bernstein coefficients on patches of two states, compiled.

The same operations as in `residual`, patch by patch so that they stay in the processor's cache; nothing is reordered
by the compiler (no fast-math), and the bound of the rounding errors is that of `residual`.
"""

from __future__ import annotations

import numpy as np

from certbound.arrays import Array, Index
from certbound.lazy import compiled, within

BLOCK = 16
"""Patches that are worked on together, side by side in the last axis: the processor's vectors run along it."""


@compiled
def bernstein_in_plane(
    data: Array, step: Array, width_x: Array, width_y: Array, coefficients: Array, reference: Array, size: Array
) -> None:
    """Bernstein coefficients (B, 4, 6, 6) less ``reference`` from Hermite data (S, 4, N + 1, 3, M + 1, 3), and Z.

    The coefficients near a corner of a patch are made of that corner's data alone, of at most 18 terms each, and the
    innermost of them of the largest shares of all: Z is the largest sum of the sizes of its terms.
    """
    rows, columns = data.shape[2] - 1, data.shape[4] - 1
    one, two = np.empty((2, 3, 3)), np.empty((2, 3, 3))
    shares = np.array([1.0, 2 / 5, 1 / 20])
    for k in range(data.shape[0]):
        for i in range(rows):
            for j in range(columns):
                patch, wx, wy = (k * rows + i) * columns + j, width_x[i], width_y[j]
                base, most = data[k, 0, i, 0, j, 0], 0.0
                for corner in range(8):
                    t, a, b = corner // 4, corner // 2 % 2, corner % 2
                    h, u, v = (1 - 2 * t) * step[k], (1 - 2 * a) * wx, (1 - 2 * b) * wy
                    total = 0.0
                    for s in range(2):
                        for d in range(3):
                            for e in range(3):
                                term = data[k, 2 * t + s, i + a, d, j + b, e]
                                if s + d + e == 0:
                                    term -= base
                                if s == 1:
                                    term *= h / 3
                                term *= (1.0 if d == 0 else u if d == 1 else u * u) * shares[d]
                                term *= (1.0 if e == 0 else v if e == 1 else v * v) * shares[e]
                                total += abs(term)
                                one[s, d, e] = term
                    if total > most or total != total:
                        most = total
                    for d in range(3):
                        for e in range(3):
                            one[1, d, e] += one[0, d, e]
                    for s in range(2):
                        for e in range(3):
                            two[s, 0, e] = one[s, 0, e]
                            two[s, 1, e] = one[s, 0, e] + one[s, 1, e] / 2
                            two[s, 2, e] = one[s, 0, e] + one[s, 1, e] + one[s, 2, e]
                        for d in range(3):
                            x, place = 3 * t + (1 - 2 * t) * s, 5 * a + (1 - 2 * a) * d
                            out = coefficients[patch, x, place]
                            out[5 * b] = two[s, d, 0]
                            out[3 * b + 1] = two[s, d, 0] + two[s, d, 1] / 2
                            out[b + 2] = two[s, d, 0] + two[s, d, 1] + two[s, d, 2]
                reference[patch], size[patch] = base, most


@within
def _along(table: Array, matrix: Array, out: Array) -> None:
    """A matrix along the second axis of ``table``, shape (p, k, q), written to ``out``, (p, rows, q).

    The processor's vectors run along q; two terms at a time, as to read and write takes longer than to multiply.
    """
    terms, wide = table.shape[1], table.shape[2]
    for i in range(table.shape[0]):
        for c in range(matrix.shape[0]):
            for q in range(wide):
                out[i, c, q] = matrix[c, 0] * table[i, 0, q]
            for k in range(1, terms - 1, 2):
                for q in range(wide):
                    out[i, c, q] += matrix[c, k] * table[i, k, q] + matrix[c, k + 1] * table[i, k + 1, q]
            if terms % 2 == 0:
                for q in range(wide):
                    out[i, c, q] += matrix[c, terms - 1] * table[i, terms - 1, q]


@within
def _change(table: Array, first: Array, second: Array, third: Array, one: Array, two: Array, out: Array) -> None:
    """A matrix along each of the first three axes of ``table``, written to ``out``; ``one`` and ``two`` are buffers."""
    p, q, r, a, b, c = table.shape[0], table.shape[1], table.shape[2], len(first), len(second), len(third)
    low, high = one[: p * q * c * BLOCK], two[: p * b * c * BLOCK]
    _along(table.reshape(p * q, r, BLOCK), third, low.reshape(p * q, c, BLOCK))
    _along(low.reshape(p, q, c * BLOCK), second, high.reshape(p, b, c * BLOCK))
    _along(high.reshape(1, p, b * c * BLOCK), first, out.reshape(1, a, b * c * BLOCK))


@within
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


@within
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
    wide, shape = nx * ny * BLOCK, (nt, nx, ny, BLOCK)
    one, two = np.empty(max(nt, 4) * max(nx, 6) * ny * BLOCK), np.empty(max(nt, 4) * nx * ny * BLOCK)
    vt, vx, vy, xx, yy, xy = (np.empty(shape), np.empty(shape), np.empty(shape), np.empty(shape), np.empty(shape),
                              np.empty(shape))  # fmt: skip
    rest, energy, result = np.empty(shape), np.empty(shape), np.empty(shape)
    own = np.empty((3, wide))
    c = np.empty((4, 6, 6, BLOCK))
    low, high, look = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    least, most, h, wx, wy = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    cells = np.empty(BLOCK, dtype=np.intp)
    count = coefficients.shape[0]
    for begin in range(0, count, BLOCK):
        for s in range(BLOCK):  # the last patch is repeated where the block is not full
            patch, look[s] = min(begin + s, count - 1), 0.0
            cells[s], h[s], wx[s], wy[s] = place[patch], 1 / step[patch], 1 / width_x[patch], 1 / width_y[patch]
            for i in range(4):
                for j in range(6):
                    for k in range(6):
                        c[i, j, k, s] = coefficients[patch, i, j, k]
        for order in range(3):  # along y first: V, V_y and V_yy serve others
            held = one[: 24 * ny * BLOCK]
            _along(c.reshape(24, 6, BLOCK), (y0, y1, y2)[order], held.reshape(24, ny, BLOCK))
            for turn in range(3 - order):
                goal = ((vt, vx, xx), (vy, xy, xy), (yy, yy, yy))[order][turn]
                half = two[: 4 * nx * ny * BLOCK]
                _along(held.reshape(4, 6, ny * BLOCK), (x0, x1, x2)[turn], half.reshape(4, nx, ny * BLOCK))
                time = t1 if order + turn == 0 else t0
                _along(half.reshape(1, 4, wide), time, goal.reshape(1, nt, wide))
        for i in range(nt):
            if i < square.shape[2]:  # a model that does not depend on time has one row
                _side_by_side(square[0, :, i], cells, 0.5 * wx * wx, own[0])
                _side_by_side(square[3, :, i], cells, 0.5 * wy * wy, own[1])
                _side_by_side(square[1, :, i], cells, wx * wy, own[2])
            _rest(
                (vt[i].reshape(wide), vx[i].reshape(wide), vy[i].reshape(wide)),
                (xx[i].reshape(wide), yy[i].reshape(wide), xy[i].reshape(wide)), own, h, straight,
                energy[i].reshape(wide), rest[i].reshape(wide),
            )  # fmt: skip
        for branch in range(drift.shape[0]):
            for i in range(nt):
                if i < drift.shape[3]:
                    _side_by_side(drift[branch, 0, :, i], cells, wx, own[0])
                    _side_by_side(drift[branch, 1, :, i], cells, wy, own[1])
                left, gx, gy = rest[i].reshape(wide), vx[i].reshape(wide), vy[i].reshape(wide)
                given = vt[i].reshape(wide)
                for q in range(wide):
                    given[q] = left[q] + own[0, q] * gx[q] + own[1, q] * gy[q]
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


@within
def _side_by_side(samples: Array, cells: Index, factors: Array, out: Array) -> None:
    """The samples (cells, x, y) of a block's patches, each times its factor, side by side in the last axis."""
    for s in range(BLOCK):
        q = s
        for j in range(samples.shape[1]):
            for k in range(samples.shape[2]):
                out[q] = factors[s] * samples[cells[s], j, k]
                q += BLOCK


@within
def _rest(
    slopes: tuple[Array, ...], bends: tuple[Array, ...], own: Array, rate: Array, straight: bool, energy: Array,
    rest: Array,
) -> None:
    """V_t + tr(a V'') / 2 + Q2, and Q2, which ``straight`` takes to be 0."""
    vt, vx, vy = slopes
    xx, yy, xy = bends
    for q in range(len(rest)):
        e = 0.0 if straight else own[0, q] * vx[q] * vx[q] + own[1, q] * vy[q] * vy[q] + own[2, q] * vx[q] * vy[q]
        energy[q] = e
        rest[q] = vt[q] * rate[q % BLOCK] + own[0, q] * xx[q] + own[1, q] * yy[q] + own[2, q] * xy[q] + e
