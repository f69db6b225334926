"""One step back: values at nodes by a sparse matrix, and what cells ask of their corners.

Above, U_k >= V_k on a cell if U_k is bilinear there and its corners are at least W(f_I) at them and what ``overshoots``
says; or if they are all 1. So a cell whose corners are all asked to be at least 1 asks for 1, and no node is cut down
otherwise; a node takes the most that a cell around it asks. Below the same is done with -U, whose cells ask for 0 where
all of their corners are asked to be at least 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from certbound.arrays import Array, Mask
from certbound.values.directed.cell_landings import Landing, landing_of
from certbound.values.directed.hats import REACH, Ranges, hat_error, hat_means, tail
from certbound.values.directed.noise_directions import Directed
from certbound.values.directed.overshoots import Lines, overshoots
from certbound.values.grids import Grid, corners

if TYPE_CHECKING:
    from scipy.sparse import csr_array

_MOST_ENTRIES = 40_000_000  # half a gigabyte
_ROWS = 16384
_UNIT = 2.0**-53


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Means:
    """The step from a grid to functions on lines."""

    grid: Grid
    after: Grid
    s: float
    landing: Landing
    ranges: Ranges
    matrix: csr_array
    below: Array
    above: Array
    error: float
    """Of a node's value, in units of the function's size."""

    def back(self, value: Lines, fixed: Array, cap: float) -> Array:
        """The corners' values, from what is asked of cells: ``fixed``, where that is a number; shape of the nodes."""
        y, q = self.after.axes
        phi = self.matrix @ value.nodal.ravel() + value.below * self.below + value.above * self.above
        phi = phi.reshape(self.grid.node_shape)
        more = np.zeros(self.landing.live.size)
        more[self.landing.live] = overshoots(value, y, q, self.ranges, self.landing, self.s)
        more = (more + self.error * value.size).reshape(self.grid.shape)
        asked = fixed.reshape(self.grid.shape)
        assert not np.any(np.isnan(asked.ravel()) & ~self.landing.live)
        least = np.minimum.reduce(corners(phi)) + more
        asked = np.where(np.isnan(asked) & (least >= cap), cap, asked)
        found = np.full(self.grid.node_shape, -np.inf)
        for part, mean in zip(corners(found), corners(phi)):
            np.copyto(part, np.maximum(part, np.where(np.isnan(asked), mean + more, asked)))
        return found

    def leaves(self, side: int, *, wholly: bool = False, edge: bool = False) -> Mask:
        """Of the live cells: whether some of f (or all of it) may lie below the lines (side 0), or above them (1).

        With ``edge`` what lies on the outermost line counts too.
        """
        y, (low, high) = self.after.axes[0], self.landing.ends
        if side == 0:
            end, last = (high if wholly else low), y[0]
            return np.asarray(end <= last if edge else end < last)
        end, last = (low if wholly else high), y[-1]
        return np.asarray(end >= last if edge else end > last)


def means_of(work: Directed, t: int, grid: Grid, after: Grid, ranges: Ranges) -> Means | None:
    """The step from time t; None if it takes too much memory."""
    from scipy.sparse import csr_array

    (y, q), s = after.axes, work.noise
    landing = landing_of(work, t, grid, y, ranges.mesh)
    if landing is None:
        return None
    place = np.clip(landing.y, y[0], y[-1])
    m = landing.m
    line = np.clip(np.searchsorted(y, place, side="right") - 1, 0, len(y) - 2)
    share = np.clip((place - y[line]) / (y[line + 1] - y[line]), 0.0, 1.0)
    first, stop = np.searchsorted(q, m - REACH * s) - 1, np.searchsorted(q, m + REACH * s) + 1
    width = min(max(int((stop - first).max()), 3), len(q))
    if 2 * width * len(place) > _MOST_ENTRIES:
        return None
    first = np.clip(first, 0, len(q) - width)
    data, entries = np.empty((len(place), 2 * width)), np.empty((len(place), 2 * width), dtype=np.int32)
    for start in range(0, len(place), _ROWS):
        part = slice(start, start + _ROWS)
        hats, upper = hat_means(q, m[part], s, first[part], width), share[part, None]
        column = (line * len(q) + first)[part, None] + np.arange(width)
        data[part, :width], data[part, width:] = hats * (1 - upper), hats * upper
        entries[part, :width], entries[part, width:] = column, column + len(q)
    index = (np.arange(len(place) + 1) * (2 * width)).astype(np.int32)
    shape = (len(place), len(y) * len(q))
    return Means(
        grid=grid, after=after, s=s, landing=landing, ranges=ranges,
        matrix=csr_array((data.ravel(), entries.ravel(), index), shape=shape), below=tail((m - q[0]) / s),
        above=tail((q[-1] - m) / s), error=hat_error(q, s) + (4 * width + 64) * _UNIT,
    )  # fmt: skip
