"""Means of hat functions after normal noise along one axis, at places and over the cells of a mesh.

With nodes q_0 < ... < q_n and B_j(m) = E h_j(m + w), h_j the hat function of q_j (of q_0 and q_n the halves between the
nodes) and w normal with standard deviation s, everything follows from c(z) = E (w/s - z)^+ and its derivative -Q:
    B_j = [c(z_{j-1}) - c(z_j)]/d_{j-1} - [c(z_j) - c(z_{j+1})]/d_j,   z_j = (q_j - m)/s,  d_j = (q_{j+1} - q_j)/s,
the same with E (z - w/s)^+, which is taken where z_j < 0. Both are c(|z|) and a straight line, and c(|z|) comes from
Taylor's formula of degree 7 about the centres of cells of width 1/32, whose coefficients are rounded from balls: its
remainder is at most 15 phi(0) (1/64)^8/8! < 1e-18. With z known up to 11u |z| (the division, and s itself), c(|z|) is
off by at most 2e-15 phi(z) + 1e-18, since |z| Q <= phi and c <= phi. In the sum of all hats each of these counts four
times at most, divided by d, and sum_j phi(z_j) <= 1/d + phi(0): that is at most ``hat_error`` for the least d.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from certbound.arrays import Array, Integers
from certbound.rigor.balls import precision

REACH = 7.8
"""Standard deviations to which a hat's mean is kept; hats beyond hold at most 2 Q(7.8) < 7e-15 of the noise."""
_BEYOND = 8.5  # for which the mesh goes on beyond the nodes: all but Q(8.5) < 1e-17 of the noise stays there
_PER_UNIT, _FAR, _DEGREE = 32, 9, 7  # beyond 9 both c and Q are below 2e-19
_PEAK = 0.39894228040143276  # phi(0), up to 1e-16
_STEEPEST = 0.24197072451914337  # the largest z phi(z)
ROUND = 1e-9  # relative, of sums of terms of one sign
_BLOCK = 32
_WIDER, _ABSOLUTE = 1e-10, 1e-13  # what tables over a mesh are widened by, in units of their sizes, for rounding


@lru_cache(maxsize=1)
def _coefficients() -> Array:
    """Taylor coefficients of c, and of Q, about the centres of all cells, shape (2, degree + 1, cells)."""
    from flint import arb

    found = np.empty((2, _DEGREE + 1, _PER_UNIT * _FAR))
    with precision(128):
        for k in range(found.shape[2]):
            z = arb(2 * k + 1) / (2 * _PER_UNIT)
            density, tail = (-z * z / 2).exp() / (2 * arb.pi()).sqrt(), (z / arb(2).sqrt()).erfc() / 2
            series = [density - z * tail, -tail, density]
            before, last = arb(0), arb(1)  # He_{i-1}, He_i; c^(i + 2) = (-1)^i He_i phi
            for i in range(_DEGREE):
                before, last = last, z * last - i * before
                series.append((-1) ** (i + 1) * last * density)
            factor = arb(1)
            for i in range(_DEGREE + 1):
                factor *= max(i, 1)
                found[:, i, k] = float(series[i] / factor), float(-series[i + 1] / factor)
    return found


def _evaluated(which: int, z: Array) -> Array:
    """c (0) or Q (1) at places that are not negative."""
    near = np.minimum(z, _FAR * (1 - 1e-15))
    cell = (near * _PER_UNIT).astype(np.intp)
    away, table = near - (cell + 0.5) / _PER_UNIT, _coefficients()[which]
    value = table[_DEGREE].take(cell)
    for k in range(_DEGREE - 1, -1, -1):
        value *= away
        value += table[k].take(cell)
    return np.where(z < _FAR, np.maximum(value, 0.0), 0.0)


def tail(z: Array) -> Array:
    """Q(z) = P(w > z s), up to 1e-15."""
    far = _evaluated(1, np.abs(z))
    found: Array = np.where(z >= 0, far, 1 - far)
    return found


def hat_means(nodes: Array, places: Array, s: float, first: Integers, width: int) -> Array:
    """B_j at every place, for the nodes ``first`` to ``first + width - 1``, shape (places, width).

    A hat at either end of these that is none of the outermost nodes is left out: 0.
    """
    columns = first[:, None] + np.arange(width)
    z = (nodes[columns] - places[:, None]) / s
    d = (np.diff(nodes) / s)[columns[:, :-1]]
    c = _evaluated(0, np.abs(z))
    right, left = c - np.minimum(z, 0.0), c + np.maximum(z, 0.0)
    falls, rises = (right[:, :-1] - right[:, 1:]) / d, (left[:, 1:] - left[:, :-1]) / d
    found = np.zeros_like(z)
    found[:, 1:-1] = np.where(z[:, 1:-1] >= 0, falls[:, :-1] - falls[:, 1:], rises[:, 1:] - rises[:, :-1])
    ends = _evaluated(1, np.abs(z[:, [0, -1]]))
    low = np.where(z[:, 0] >= 0, ends[:, 0] - falls[:, 0], rises[:, 0] - ends[:, 0])
    high = np.where(z[:, -1] >= 0, falls[:, -1] - ends[:, 1], ends[:, 1] - rises[:, -1])
    found[:, 0] = np.where(columns[:, 0] == 0, low, 0.0)
    found[:, -1] = np.where(columns[:, -1] == len(nodes) - 1, high, 0.0)
    return np.asarray(np.maximum(found, 0.0))


def hat_error(nodes: Array, s: float) -> float:
    """What all B_j of one place that are kept are off by together, with what is left out of them; also what Q is."""
    close = s / float(np.diff(nodes).min())
    return 1e-14 * (close + 1) ** 2 + 2e-14


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Range:
    """Ends of functions of m over the cells of a mesh, shape (functions, cells), from 0 on.

    Cells are taken in blocks, and of the functions only those that are more than ``rest`` on one of these.
    """

    low: Array
    high: Array
    rest: float
    blocks: tuple[tuple[slice, slice], ...]

    def largest(self, values: Array) -> Array:
        """At least sum_j values_j x_j for every x in the ranges, shape (rows, cells)."""
        more, less = np.maximum(values, 0.0), np.maximum(-values, 0.0)
        found = np.empty((len(values), self.high.shape[1]))
        for rows, columns in self.blocks:
            part = more[:, rows] @ self.high[rows, columns] * (1 + ROUND)
            found[:, columns] = part - less[:, rows] @ self.low[rows, columns] * (1 - ROUND)
        return np.asarray(found + (more.sum(axis=1) * (self.rest * (1 + ROUND)))[:, None])

    def sizes(self, values: Array) -> Array:
        """At least |sum_j values_j x_j|, for values of any sign of which only the size counts."""
        return self.largest(np.abs(values))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Ranges:
    """Over every cell of a mesh of m: what the nodes' functions are at least and at most.

    Parameters
    ----------
    mesh : ndarray
        Holds all nodes, and goes on beyond them.
    hats, densities, masses : Range
        B_j; phi_s(q_j - m); P(q_j < m + w < q_{j+1}).
    edges : (Array, Array)
        Ends of (z/s) phi_s(q - m), z = (q - m)/s, of the first and of the last node q.
    """

    mesh: Array
    hats: Range
    densities: Range
    masses: Range
    edges: tuple[Array, Array]


def ranges_of(nodes: Array, s: float) -> Ranges:
    """The tables of an axis.

    Hats and intervals have logarithmically concave means (those of log-concave functions and densities), which rise
    and then fall: the least value over a cell is at an end, the largest as well, but where the largest of all may lie
    in the cell: at most 1/8 of the cell's width squared times the largest second derivative higher then. That is at
    most the hat's integral times sup |phi_s''| = phi(0)/s^3, for a hat less than its support times that.
    """
    step = float(np.median(np.diff(nodes)))
    more = step * np.arange(1, int(np.ceil(_BEYOND * s / step)) + 1)
    mesh = np.concatenate([nodes[0] - more[::-1], nodes, nodes[-1] + more])
    z = (nodes[:, None] - mesh) / s
    wide = np.diff(mesh)
    hats = hat_means(nodes, mesh, s, np.zeros(len(mesh), dtype=np.intp), len(nodes)).T
    before, after = np.concatenate([nodes[:1], nodes[:-1]]), np.concatenate([nodes[1:], nodes[-1:]])
    top = (mesh[1:] > before[:, None]) & (mesh[:-1] < after[:, None])
    bow = (after - before)[:, None] * (wide**2 * (_PEAK / (8 * s**3)))
    density = np.exp(-0.5 * z * z) * (_PEAK / s)
    beyond = tail(z)
    mass = np.where(z[:-1] >= 0, beyond[:-1] - beyond[1:], tail(-z[1:]) - tail(-z[:-1]))
    inner = (mesh[1:] > nodes[:-1, None]) & (mesh[:-1] < nodes[1:, None])
    swell = np.diff(nodes)[:, None] * (wide**2 * (_PEAK / (8 * s**3)))
    edge = z[[0, -1]] * density[[0, -1]] / s
    return Ranges(
        mesh=mesh, hats=_over(hats, np.where(top, bow, 0.0)), densities=_over(density, 0.0, s),
        masses=_over(mass, np.where(inner, swell, 0.0)), edges=_edges(edge, z[[0, -1]], s),
    )  # fmt: skip


def _over(values: Array, more: Array | float, s: float = 1.0) -> Range:
    low, high = np.minimum(values[:, :-1], values[:, 1:]), np.maximum(values[:, :-1], values[:, 1:]) + more
    low, high = np.maximum(low * (1 - _WIDER) - _ABSOLUTE / s, 0.0), high * (1 + _WIDER) + _ABSOLUTE / s
    rest = 2 * _ABSOLUTE / s
    blocks = []
    for start in range(0, high.shape[1], _BLOCK):
        rows = np.flatnonzero((high[:, start : start + _BLOCK] > rest).any(axis=1))
        first, stop = (int(rows[0]), int(rows[-1]) + 1) if len(rows) else (0, 0)
        blocks.append((slice(first, stop), slice(start, start + _BLOCK)))
    return Range(low=low, high=high, rest=rest, blocks=tuple(blocks))


def _edges(values: Array, z: Array, s: float) -> tuple[Array, Array]:
    """z phi(z) is largest at 1 and least at -1."""
    low, high = np.minimum(values[:, :-1], values[:, 1:]), np.maximum(values[:, :-1], values[:, 1:])
    first, last = np.minimum(z[:, :-1], z[:, 1:]), np.maximum(z[:, :-1], z[:, 1:])
    high = np.where((first <= 1) & (last >= 1), _STEEPEST / s**2, high)
    low = np.where((first <= -1) & (last >= -1), -_STEEPEST / s**2, low)
    slack = _WIDER * np.maximum(np.abs(low), np.abs(high)) + _ABSOLUTE / s**2
    return low - slack, high + slack
