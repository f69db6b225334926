"""Loops over the cells of a grid and over the finer nodes in them, compiled."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from certbound.arrays import Array, Integers
from certbound.lazy import compiled

Spatial = tuple[Array, Array, Array]


class Stencils:
    """Where points lie in a mesh, and with which weights its nodes count there.

    Parameters
    ----------
    base : sequence of ndarray
        Per axis the first node of every point's stencil.
    weights : sequence of sequences of ndarray
        Per axis and node of the stencil the weight at every point; along the last axis six nodes.
    """

    def __init__(self, base: Sequence[Integers], weights: Sequence[Sequence[Array]]) -> None:
        missing, points = 3 - len(base), len(base[0])
        self._base = np.stack([*[np.zeros(points, dtype=np.int64)] * missing, *base], axis=1)
        self._weights = [np.ones((points, 1))] * missing + [np.stack(list(one), axis=1) for one in weights]
        self._missing = (1,) * missing

    def read_off(self, tables: Sequence[Array]) -> Array:
        """Interpolated tables of one shape, shape (tables, points)."""
        stacked = np.stack(tables).reshape(len(tables), *self._missing, *tables[0].shape)
        found = np.empty((len(tables), len(self._base)))
        first, second, third = self._weights
        _read_off(stacked, self._base, first, second, third, found)
        return found


@compiled
def _read_off(tables: Array, base: Integers, first: Array, second: Array, third: Array, out: Array) -> None:
    """The six nodes along the last axis are written out: it is what takes most of the time."""
    for c in range(len(base)):
        x, y, z = base[c, 0], base[c, 1], base[c, 2]
        s, t, u = third[c, 0], third[c, 1], third[c, 2]
        v, w, r = third[c, 3], third[c, 4], third[c, 5]
        for a in range(len(tables)):
            total = 0.0
            for i in range(first.shape[1]):
                plane = tables[a, x + i]
                for j in range(second.shape[1]):
                    row = plane[y + j]
                    part = s * row[z] + t * row[z + 1] + u * row[z + 2]
                    part += v * row[z + 3] + w * row[z + 4] + r * row[z + 5]
                    total += first[c, i] * second[c, j] * part
            out[a, c] = total


def lacking(low: Array, high: Array, axes: Sequence[Array], parts: int) -> Array:
    """How far a function g may be below the multilinear function of ``low`` at its corners, cell by cell.

    But for higher derivatives: of g - (that function) the least at finer nodes, where g lies between ``low`` and
    ``high``, and for every axis j delta^2/8 times the largest second divided difference there, delta the distance of
    finer nodes.

    Parameters
    ----------
    low, high : ndarray
        On the finer nodes.
    axes : sequence of ndarray
        These nodes.
    parts : int
        Distances of finer nodes along each side of a cell, at least 2.
    """
    n = low.ndim
    missing = (1,) * (3 - n)
    shape = (*missing, *((size - 1) // parts for size in low.shape))
    rules = [np.zeros((1, 3))] * (3 - n) + [_rule(axis, parts) for axis in axes]
    steps = (parts if n > 2 else 0, parts if n > 1 else 0, parts)
    out = np.empty(shape)
    whole = (*missing, *low.shape)
    _lacking(low.reshape(whole), high.reshape(whole), (rules[0], rules[1], rules[2]), steps, out)
    return out.reshape(shape[3 - n :])


def _rule(axis: Array, parts: int) -> Array:
    """Weights of a node's neighbours and of the node in delta^2/8 g'', shape (nodes, 3); of inner nodes only."""
    left, right = np.diff(axis)[:-1], np.diff(axis)[1:]
    step = np.maximum(left, right)  # of the cells on both sides the larger one
    found = np.zeros((len(axis), 3))
    apart = np.stack([1 / left, 1 / left + 1 / right, 1 / right], axis=1)
    found[1:-1] = (step**2 / 4 / (left + right))[:, None] * apart
    return found


@compiled
def _lacking(low: Array, high: Array, rules: Spatial, parts: tuple[int, int, int], out: Array) -> None:
    corner, turns, weight = np.empty(8), np.zeros(3), np.zeros((3, 2 * max(parts) + 2))
    for axis in range(3):
        for i in range(parts[axis] + 1):
            weight[axis, i] = i / max(parts[axis], 1)
    for a in range(out.shape[0]):
        for b in range(out.shape[1]):
            for c in range(out.shape[2]):
                p, q, r = a * parts[0], b * parts[1], c * parts[2]
                for x in range(2):
                    for y in range(2):
                        for z in range(2):
                            corner[4 * x + 2 * y + z] = low[p + x * parts[0], q + y * parts[1], r + z * parts[2]]
                worst = 0.0
                turns[:] = 0.0
                for i in range(parts[0] + 1):
                    u = weight[0, i]
                    s = min(max(p + i, 1), low.shape[0] - 2)
                    for j in range(parts[1] + 1):
                        v = weight[1, j]
                        t = min(max(q + j, 1), low.shape[1] - 2)
                        first = (1 - u) * ((1 - v) * corner[0] + v * corner[2])
                        first += u * ((1 - v) * corner[4] + v * corner[6])
                        last = (1 - u) * ((1 - v) * corner[1] + v * corner[3])
                        last += u * ((1 - v) * corner[5] + v * corner[7])
                        for k in range(parts[2] + 1):
                            w, m = weight[2, k], r + k
                            worst = max(worst, (1 - w) * first + w * last - low[p + i, q + j, m])
                            if parts[0] > 0:
                                rule = rules[0][s]
                                found = rule[0] * high[s - 1, q + j, m] + rule[2] * high[s + 1, q + j, m]
                                turns[0] = max(turns[0], found - rule[1] * low[s, q + j, m])
                            if parts[1] > 0:
                                rule = rules[1][t]
                                found = rule[0] * high[p + i, t - 1, m] + rule[2] * high[p + i, t + 1, m]
                                turns[1] = max(turns[1], found - rule[1] * low[p + i, t, m])
                            m = min(max(m, 1), low.shape[2] - 2)
                            rule = rules[2][m]
                            found = rule[0] * high[p + i, q + j, m - 1] + rule[2] * high[p + i, q + j, m + 1]
                            turns[2] = max(turns[2], found - rule[1] * low[p + i, q + j, m])
                out[a, b, c] = (worst + turns[0] + turns[1] + turns[2]) * (1 + 1e-9)
