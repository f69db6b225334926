"""Values at nodes beyond a curved limit that continue a solution which is 0 on it.

Along every line of the grid the limit lies somewhere between a live node and one that is not. A distance s beyond it a
solution is continued by its mirror image, -v(s), and by what its curvature there adds to that up to about
two cells; a quadratic would grow where cells do not resolve a layer. Where several lines reach a node, by their mean,
near ones counting more. Nothing here is trusted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import scipy.sparse as sp

from certbound.arrays import Array, Mask

_DEPTH = 5  # nodes beyond a limit that the splines of the cells which it cuts depend on
_HALVINGS = 40
_NEAR = 0.4  # of a cell: a live node nearer than that to the limit tells no more than the limit
_REACH = 8  # live nodes that a continuation may take values from
_BENT = 3.0  # cells up to which curvature counts: with 2 and with 8 a disc's lower bound is a fifth less
_FADING = 4  # power of the distance in nodes by which a line counts less


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Ghosts:
    """Nodes beyond limits on which a solution is 0: their values there are ``matrix`` values.

    Attributes
    ----------
    matrix : sparse array, shape (size, size)
        Rows of zeros but for the nodes that are continued.
    nodes : ndarray of bool, shape (N_1, ...)
        All that are not live, continued or not.
    """

    matrix: sp.csr_array
    nodes: Mask

    def fill(self, values: Array) -> Array:
        """The values, continued beyond the limits."""
        return np.where(self.nodes, (self.matrix @ values.ravel()).reshape(values.shape), values)


def ghosts_of(lines: Sequence[Array], holds: Callable[[Array], Mask]) -> Ghosts:
    """Those of a grid of which ``holds`` says, of points of shape (..., n), whether they are within the limits."""
    points = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1)
    live = holds(points)
    size, n = live.size, live.ndim
    number = np.arange(size).reshape(live.shape)
    rows: list[Array] = []
    columns: list[Array] = []
    weights: list[Array] = []
    total = np.zeros(size)
    for axis, sign in product(range(n), (-1, 1)):
        line = lines[axis][::sign]
        own, ids = (np.moveaxis(rows_, axis, 0)[::sign].reshape(len(line), -1) for rows_ in (live, number))
        for k in range(len(line) - 1):  # from a live node k to a node k + 1 that is not
            crossing = own[k] & ~own[k + 1]
            if k < 2 or not crossing.any():
                continue
            crossing &= own[k - 1] & own[k - 2]
            where = np.flatnonzero(crossing)
            if not len(where):
                continue
            tables = ids[:, where]
            place = _limit(points.reshape(-1, n), tables[k], tables[k + 1], holds, axis)
            near = np.abs(place - line[k]) < _NEAR * abs(line[k + 1] - line[k])
            for j in range(k + 1, min(k + 1 + _DEPTH, len(line))):
                beyond = ~own[k + 1 : j + 1, where].any(axis=0)
                if not beyond.any():
                    break
                share = 1.0 / (j - k) ** _FADING
                for first in (k, k - 1):
                    some = np.flatnonzero(beyond & (near == (first < k)))
                    run = next((i for i in range(first + 1) if not own[first - i, where[some]].all()), first + 1)
                    if not len(some) or run < 2:
                        continue
                    nodes = np.arange(first, first - min(run, _REACH), -1)
                    target, columns_, limit = tables[j, some], tables[nodes][:, some], place[some]
                    factors = _continued(limit, line[nodes], float(line[j]))
                    np.add.at(total, target, share)
                    rows += [target] * len(nodes)
                    columns += list(columns_)
                    weights += list(share * factors)
    scale = 1 / np.where(total > 0, total, 1.0)
    if rows:
        place, other, weight = (np.concatenate(parts) for parts in (rows, columns, weights))
        matrix = sp.csr_array((weight * scale[place], (place, other)), shape=(size, size))
    else:
        matrix = sp.csr_array((size, size))
    return Ghosts(matrix=matrix, nodes=~live)


def _continued(limit: Array, nodes: Array, place: float) -> Array:
    """Weights of values at live nodes, shape (nodes, limits), for one beyond each limit."""
    x = np.concatenate([np.zeros((1, len(limit))), np.abs(limit - nodes[:, None])])  # distances from the limit
    far = np.abs(place - limit)
    cell = np.abs(nodes[0] - nodes[1])
    result = -_lagrange(x, np.minimum(far, x[-1]))
    one, two = x[1], x[2]
    bend = np.zeros_like(result)  # of the quadratic through the limit and the first two nodes
    bend[1], bend[2] = 1 / (one * (one - two)), 1 / (two * (two - one))
    reach = np.minimum(far, _BENT * cell)
    return np.asarray(result + 2 * reach**2 * bend)[1:]


def _lagrange(x: Array, at: Array) -> Array:
    """Weights of interpolation at places, shape (R,), from the nearest four of nodes, shape (M, R); shape (M, R)."""
    result = np.zeros_like(x)
    count = min(4, len(x))
    first = np.clip((x < at).sum(axis=0) - count // 2, 0, len(x) - count)
    rows, place = first + np.arange(count)[:, None], np.arange(x.shape[1])
    own = x[rows, place]
    for i in range(count):
        others = [j for j in range(count) if j != i]
        result[rows[i], place] = np.prod([(at - own[j]) / (own[i] - own[j]) for j in others], axis=0)
    return result


def _limit(points: Array, live: Array, beyond: Array, holds: Callable[[Array], Mask], axis: int) -> Array:
    """Where along the axis the limit lies between pairs of nodes."""
    inner, outer = points[live].copy(), points[beyond].copy()
    for _ in range(_HALVINGS):
        middle = inner.copy()
        middle[:, axis] = (inner[:, axis] + outer[:, axis]) / 2
        within = holds(middle)[:, None]
        inner, outer = np.where(within, middle, inner), np.where(within, outer, middle)
    return np.asarray(inner[:, axis] + outer[:, axis]) / 2
