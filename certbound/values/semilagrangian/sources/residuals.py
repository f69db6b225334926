"""Bounds of U_t + F U_p + g U_q + a U_qq/2 over cells: products of polynomials in Bernstein form, compiled."""

from __future__ import annotations

from math import comb

import numpy as np

from certbound.arrays import Array, Index
from certbound.lazy import compiled

_ROUNDED = 1e-12
"""Nine thousand roundoffs, granted to every sample for each size of a term: far more than the few dozen of the way."""

_CHOICES = np.array([[comb(n, k) for k in range(5)] for n in range(5)], dtype=float)


def _raised(degree: int) -> Array:
    """Bernstein coefficients of one degree more, from those of a degree: a matrix."""
    found = np.zeros((degree + 2, degree + 1))
    for k in range(degree + 1):
        found[k, k], found[k + 1, k] = (degree + 1 - k) / (degree + 1), (k + 1) / (degree + 1)
    return found


def _product(degree: int) -> Array:
    """What a linear function's coefficient i and another's k of a degree add to coefficient i + k of their product."""
    return np.array([[_CHOICES[degree, k] / _CHOICES[degree + 1, i + k] for k in range(degree + 1)] for i in range(2)])


_TWO, _THREE = _raised(2), _raised(3)
_BY_ONE, _BY_TWO, _BY_THREE = _product(1), _product(2), _product(3)


@compiled
def residual_bounds(
    values: Array, rates: Array, source: Array, rows: Array, columns: Array, cell: Index, widths: tuple[Array, Array],
    corners: Array, remainder: Array, noise: float, step: float,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Bounds on parts of cells of p x q of R = V + F U_p + g U_q + noise U_qq/2, U and V the splines of coefficients.

    Parameters
    ----------
    values, rates, source : ndarray, shape (cells + 2, cells + 3)
        Coefficients of U, of V and of a source, quadratic along p and cubic along q.
    rows, columns : ndarray, shapes (parts, 3, 3) and (cells, 4, 4)
        `Axis.pieces`; along p of parts of the cells ``cell``, whose widths and drifts are given, too.
    step : float
        V may be off by some roundoffs of U over this.

    Returns
    -------
    upper bounds of R and of R + source, the least and the largest Bernstein coefficient of U
    """
    n, m = rows.shape[0], columns.shape[0]
    most, bare, low, high = np.empty((n, m)), np.empty((n, m)), np.empty((n, m)), np.empty((n, m))
    b, v, s, e = np.empty((3, 4)), np.empty((3, 4)), np.empty((3, 4)), np.empty((3, 4))
    out, extra, one, two = np.empty((4, 5)), np.empty((4, 5)), np.empty((3, 5)), np.empty((4, 4))
    for k in range(n):
        wide = widths[0][k]
        for r in range(m):
            tall = widths[1][r]
            size, speed = 0.0, 0.0
            for which in range(3):
                part = values if which == 0 else rates if which == 1 else source
                into = b if which == 0 else v if which == 1 else s
                for i in range(3):
                    for j in range(4):
                        e[i, j] = 0.0
                        for c in range(4):
                            e[i, j] += columns[r, j, c] * part[cell[k] + i, r + c]
                        if which == 0:
                            size = max(size, abs(part[cell[k] + i, r + j]))
                        else:
                            speed = max(speed, abs(part[cell[k] + i, r + j]))
                for i in range(3):
                    for j in range(4):
                        into[i, j] = rows[k, i, 0] * e[0, j] + rows[k, i, 1] * e[1, j] + rows[k, i, 2] * e[2, j]
            for i in range(4):
                for j in range(5):
                    out[i, j] = 0.0
                    extra[i, j] = 0.0
                    for a in range(max(0, i - 1), min(2, i) + 1):
                        for c in range(max(0, j - 1), min(3, j) + 1):
                            share = _TWO[i, a] * _THREE[j, c]
                            out[i, j] += share * v[a, c]
                            extra[i, j] += share * s[a, c]
            along, across = 0.0, 0.0  # the largest coefficients of U_p and U_q
            one[:] = 0.0
            for a in range(2):
                for c in range(4):
                    slope = 2 / wide * (b[a + 1, c] - b[a, c])
                    along = max(along, abs(slope))
                    for i in range(2):
                        for j in range(2):
                            share = _BY_ONE[i, a] * _BY_THREE[j, c]
                            one[i + a, j + c] += share * corners[0, k, r, i, j] * slope
            two[:] = 0.0
            for a in range(3):
                for c in range(3):
                    slope = 3 / tall * (b[a, c + 1] - b[a, c])
                    across = max(across, abs(slope))
                    for i in range(2):
                        for j in range(2):
                            share = _BY_TWO[i, a] * _BY_TWO[j, c]
                            two[i + a, j + c] += share * corners[1, k, r, i, j] * slope
            for i in range(4):
                for j in range(5):
                    for a in range(max(0, i - 1), min(2, i) + 1):  # one more degree along p
                        share = _TWO[i, a]
                        out[i, j] += share * one[a, j]
                        bend = 0.0
                        for c in range(2):
                            second = 6 / (tall * tall) * (b[a, c] - 2 * b[a, c + 1] + b[a, c + 2])
                            bend += (j / 4 if c == 1 else 1 - j / 4) * second
                        out[i, j] += share * 0.5 * noise * bend
                    if j < 4:
                        out[i, j] += two[i, j] * (4 - j) / 4
                    if j > 0:
                        out[i, j] += two[i, j - 1] * j / 4
            flow = max(abs(corners[0, k, r, 0, 0]), abs(corners[0, k, r, 1, 1]))
            flow = max(flow, max(abs(corners[0, k, r, 0, 1]), abs(corners[0, k, r, 1, 0])))
            push = max(abs(corners[1, k, r, 0, 0]), abs(corners[1, k, r, 1, 1]))
            push = max(push, max(abs(corners[1, k, r, 0, 1]), abs(corners[1, k, r, 1, 0])))
            sizes = flow * 4 / wide + push * 6 / tall + noise * 12 / (tall * tall) + 6 / step
            slack = _ROUNDED * (sizes * size + speed)
            slack += remainder[0, k, r] * (along + 4 / wide * _ROUNDED * size)
            slack += remainder[1, k, r] * (across + 6 / tall * _ROUNDED * size)
            top, more = -np.inf, -np.inf
            for i in range(4):
                for j in range(5):
                    top, more = max(top, out[i, j]), max(more, out[i, j] + extra[i, j])
            most[k, r], bare[k, r] = top + slack, more + slack
            low[k, r], high[k, r] = np.inf, -np.inf
            for i in range(3):
                for j in range(4):
                    low[k, r], high[k, r] = min(low[k, r], b[i, j]), max(high[k, r], b[i, j])
            low[k, r] -= _ROUNDED * size
            high[k, r] += _ROUNDED * size
    return most, bare, low, high
