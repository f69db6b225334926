"""Polynomials on the unit interval: Bernstein form, Hermite data, and the matrices that lead from one to the other.

Every matrix is computed in exact rational arithmetic at nodes that are floats, and rounded once, so that each entry
is off by at most half a unit in the last place. A polynomial of degree n lies between the smallest and the largest
of its n + 1 Bernstein coefficients on [0, 1]; that is what every bound of this folder rests on.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from functools import lru_cache
from math import comb, cos, pi

import numpy as np

from certbound.arrays import Array

Rows = list[list[Fraction]]

HERMITE = np.array([
    [1, 0, 0, 0, 0, 0],
    [1, 1 / 5, 0, 0, 0, 0],
    [1, 2 / 5, 1 / 20, 0, 0, 0],
    [0, 0, 0, 1, -2 / 5, 1 / 20],
    [0, 0, 0, 1, -1 / 5, 0],
    [0, 0, 0, 1, 0, 0],
])  # fmt: skip
"""Bernstein coefficients of degree 5 from (v, h v', h^2 v'') at the left and at the right end."""
CUBIC_HERMITE = np.array([[1, 0, 0, 0], [1, 1 / 3, 0, 0], [0, 0, 1, -1 / 3], [0, 0, 1, 0]])
"""Bernstein coefficients of degree 3 from (v, h v') at the left and at the right end."""
_LEFT = np.array([[comb(i, k) / 2**i if k <= i else 0.0 for k in range(6)] for i in range(6)])
_HALVES = (_LEFT, _LEFT[::-1, ::-1])
QUARTERS = np.array([second @ first for first in _HALVES for second in _HALVES])
"""De Casteljau: Bernstein coefficients of degree 5 on each quarter of [0, 1], from those on all of it; exact."""


@lru_cache(maxsize=32)
def nodes_of(count: int) -> tuple[float, ...]:
    """``count`` nodes in [0, 1], close to Chebyshev's extremal points, multiples of 2^-12; 0.5 alone for one."""
    if count == 1:
        return (0.5,)
    return tuple(round((0.5 - 0.5 * cos(pi * k / (count - 1))) * 4096) / 4096 for k in range(count))


def _bernstein_rows(points: tuple[float, ...], degree: int) -> Rows:
    return _rows_at([Fraction(point) for point in points], degree)


def _rows_at(exact: Sequence[Fraction], degree: int) -> Rows:
    return [[comb(degree, j) * s**j * (1 - s) ** (degree - j) for j in range(degree + 1)] for s in exact]


@lru_cache(maxsize=128)
def basis_at(points: tuple[float, ...], degree: int) -> Array:
    """Values of the Bernstein polynomials of one degree at points, shape (points, degree + 1)."""
    return _rounded(_bernstein_rows(points, degree))


@lru_cache(maxsize=32)
def to_bernstein(count: int) -> Array:
    """From values at ``nodes_of(count)`` to the Bernstein coefficients of the polynomial through them."""
    return _rounded(_inverse(_bernstein_rows(nodes_of(count), count - 1)))


@lru_cache(maxsize=64)
def to_parts(count: int, parts: int) -> Array:
    """`to_bernstein` for each of ``parts`` equal parts of [0, 1], a power of 2, alone: shape (parts, count, count).

    The coefficients on a part are averages of those on the whole, so that no matrix is larger than `to_bernstein`.
    """
    nodes = [Fraction(node) for node in nodes_of(count)]
    inverse = _inverse(_bernstein_rows(nodes_of(count), count - 1))
    there = [_rows_at([(part + node) / parts for node in nodes], count - 1) for part in range(parts)]
    return np.array([_rounded(_product(inverse, _product(rows, inverse))) for rows in there])


@lru_cache(maxsize=128)
def interpolation(count: int, points: tuple[float, ...]) -> Array:
    """From values at ``nodes_of(count)`` to the values at ``points`` of the polynomial through them."""
    inverse = _inverse(_bernstein_rows(nodes_of(count), count - 1))
    return _rounded(_product(_bernstein_rows(points, count - 1), inverse))


@lru_cache(maxsize=32)
def node_product(count: int) -> float:
    """An upper bound of max |(s - s_1) ... (s - s_count)| over [0, 1] for the nodes ``nodes_of(count)``."""
    nodes = [Fraction(node) for node in nodes_of(count)]
    finer = [k / 1024 for k in range(1025)]
    values = [_absolute_product(Fraction(point), nodes) for point in finer]
    # |derivative| <= count on [0, 1], each factor being at most 1 in size: half a spacing to the nearest point
    return float(max(values)) + count / 2048


@lru_cache(maxsize=32)
def lebesgue(count: int) -> float:
    """An upper bound of sup |p| over [0, 1] where a polynomial is at most 1 in size at ``nodes_of(count)``."""
    if count == 1:
        return 1.0
    parts = max(256, 2 ** (2 * (count - 1) ** 2 - 1).bit_length())
    finer = tuple(k / parts for k in range(parts + 1))
    # between the points it changes by at most 2 degree^2 per unit (Markov) times its norm
    return float(norm(interpolation(count, finer)) / (1 - (count - 1) ** 2 / parts))


def norm(matrix: Array) -> float:
    """An upper bound of the largest absolute row sum."""
    return float(np.abs(matrix).sum(axis=1).max()) * (1 + 1e-12)


def _absolute_product(point: Fraction, nodes: list[Fraction]) -> Fraction:
    value = Fraction(1)
    for node in nodes:
        value *= abs(point - node)
    return value


def _rounded(rows: Rows) -> Array:
    matrix = np.array([[float(entry) for entry in row] for row in rows])
    matrix.flags.writeable = False
    return matrix


def _product(a: Rows, b: Rows) -> Rows:
    columns = list(zip(*b))
    return [[sum((x * y for x, y in zip(row, column)), Fraction(0)) for column in columns] for row in a]


def _inverse(rows: Rows) -> Rows:
    """Gauss-Jordan elimination over the rationals."""
    size = len(rows)
    work = [[*row, *(Fraction(int(k == j)) for j in range(size))] for k, row in enumerate(rows)]
    for column in range(size):
        pivot = next(k for k in range(column, size) if work[k][column] != 0)
        work[column], work[pivot] = work[pivot], work[column]
        scale = work[column][column]
        work[column] = [entry / scale for entry in work[column]]
        for k in range(size):
            factor = work[k][column]
            if k != column and factor != 0:
                work[k] = [x - factor * y for x, y in zip(work[k], work[column])]
    return [row[size:] for row in work]
