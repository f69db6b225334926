"""Where the cells of one grid come to among the lines of the next one, without noise.

On a cell f_I is the bilinear interpolation of the images of its corners, in floats; f differs from it by at most
``away``: what the images are off by, and for every axis a quarter of the cell's width times what the slope along it
ranges over (``docs/theory.md`` 13), which holds across kinks. Images are counted in cells of the lines' mesh: the
strips between lines y_i that f_I meets, the lines at their sides, and cells of m.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Index, Mask
from certbound.rigor.intervals import Interval
from certbound.values.directed.noise_directions import Directed
from certbound.values.grids import Grid, corners

_ROUND = 1 + 1e-12
_MOST_PAIRS = 40_000_000
TINY = 1e-10
"""Of the least distance of lines: how far f may be from f_I along y by rounding alone."""
_SLACK = 1e-9  # of a side, by which places where it crosses a line are known


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Pairs:
    """Entries of a table of lines (or strips) times cells of m, ``start`` the first one of every group."""

    entries: Index
    start: Index

    def largest(self, table: Array) -> Array:
        """The largest entry of every group."""
        if not len(self.start):
            return np.zeros(0)
        return np.asarray(np.maximum.reduceat(table.ravel()[self.entries], self.start))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Landing:
    """The images of nodes, and of the cells that are ``live``: those on which f is defined and continuous.

    Parameters
    ----------
    y, m : ndarray, shape (nodes,)
        Images of nodes, 0 where there is none.
    live : ndarray of bool, shape (cells,)
        Everything below holds one entry for each of these.
    away : (Array, Array)
        Along y and m, how far f is from f_I at most.
    ends : (Array, Array)
        Least and largest y of f.
    moves : ((Array, Array), (Array, Array))
        Along the sides of the grid's first axis, then of its second: by how much y and m change at most under f_I.
    lines, strips : Pairs
        Lines beside the strips that f_I meets, and these strips, each with the cells of m that it meets.
    crossed : Pairs
        Lines between the least and largest y of f_I, with cells of m; in groups of one line and cell of the grid,
    cell, weight : ndarray
        for each of which: the cell, and |change of y| tau (1 - tau) at most, tau the share of a side at which it is
        crossed, for both axes together.
    rough, steep : ndarray, Pairs
        The cells whose ``away`` along y is more than a matter of rounding, and the strips that f meets from there.
    narrow : ndarray
        The least distance of lines that f_I meets.
    slip : float
        What ``away`` along y holds that moves with the noise.
    """

    y: Array
    m: Array
    live: Mask
    away: tuple[Array, Array]
    ends: tuple[Array, Array]
    moves: tuple[tuple[Array, Array], tuple[Array, Array]]
    lines: Pairs
    strips: Pairs
    crossed: Pairs
    cell: Index
    weight: Array
    rough: Index
    steep: Pairs
    narrow: Array
    slip: float


def landing_of(work: Directed, t: int, grid: Grid, lines: Array, mesh: Array) -> Landing | None:
    """The step from time t on a grid of (y, q), to lines and a mesh of m; None if it takes too much memory."""
    y, m, away, live = _images(work, t, grid, mesh)
    ys, ms = corners(y.reshape(grid.node_shape)), corners(m.reshape(grid.node_shape))
    (low, high), (first, last) = (
        (np.minimum.reduce(part).ravel(), np.maximum.reduce(part).ravel()) for part in (ys, ms)
    )
    away = [part[live] for part in away]
    low, high, first, last = low[live], high[live], first[live], last[live]
    ys, ms = [part.ravel()[live] for part in ys], [part.ravel()[live] for part in ms]
    strip = _between(lines, low, high)
    across = _between(mesh, first - away[1], last + away[1])
    if (strip[1] - strip[0] + 2.0) @ (across[1] - across[0] + 1.0) > _MOST_PAIRS:
        return None
    count = len(mesh) - 1
    moves = [(_largest(ys, axis), _largest(ms, axis)) for axis in (0, 1)]
    cell, line = _counted(np.searchsorted(lines, low, side="left"), np.searchsorted(lines, high, side="right"))
    shares = [_weights(ys, axis, cell, lines[line]) for axis in (0, 1)]
    weight = shares[0] * moves[0][0][cell] + shares[1] * moves[1][0][cell]
    kept = weight > 0
    cell, line, weight = cell[kept], line[kept], weight[kept] * _ROUND
    widths = np.diff(lines)
    rough = np.flatnonzero(away[0] > TINY * widths.min())
    far = _between(lines, (low - away[0])[rough], (high + away[0])[rough])
    narrow = np.minimum.reduceat(np.append(widths, np.inf), _even(strip))[::2] if len(low) else np.zeros(0)
    return Landing(
        y=y, m=m, live=live, away=(away[0], away[1]), ends=_around(low, high, away[0]),
        moves=(moves[0], moves[1]), lines=_rectangles(strip[0], strip[1] + 1, across, count),
        strips=_rectangles(*strip, across, count),
        crossed=_rectangles(line, line, (across[0][cell], across[1][cell]), count),
        cell=cell, weight=weight, rough=rough,
        steep=_rectangles(*far, (across[0][rough], across[1][rough]), count), narrow=narrow,
        slip=work.slip,
    )  # fmt: skip


def _images(work: Directed, t: int, grid: Grid, mesh: Array) -> tuple[Array, Array, list[Array], Mask]:
    """Images of nodes (y, m); how far f strays from f_I on every cell along both, and whether that is known.

    f is cut off at the ends of the mesh, as if its last operation were a clip: noise hardly leads back from there.
    """
    image, bad = work.over(work.tape, t, Interval.point(grid.nodes()))
    cells, lost = grid.cells(), bad.astype(float)
    ranges, undefined = work.over(work.tape, t, cells)
    slopes, rough = work.over(work.slopes, t, cells)
    known = (np.maximum.reduce(corners(lost.reshape(grid.node_shape))).ravel() == 0) & ~undefined & ~rough
    middle = np.where(bad[:, None], 0.0, image.mid)
    wrong = np.where(bad[:, None], 0.0, image.rad)
    beyond = ((ranges.lo[:, 1] < mesh[0]) | (ranges.hi[:, 1] > mesh[-1]))[:, None]
    low, high = slopes.lo.reshape(-1, 2, 2), slopes.hi.reshape(-1, 2, 2)
    clipped = np.stack([np.zeros_like(beyond), beyond], axis=1)
    width = np.where(clipped, np.maximum(high, 0.0) - np.minimum(low, 0.0), high - low)
    sides = [np.broadcast_to(grid.widths(axis), grid.shape).ravel() for axis in (0, 1)]
    away = []
    for row in (0, 1):
        near = np.maximum.reduce(corners(wrong[:, row].reshape(grid.node_shape))).ravel()
        with np.errstate(all="ignore"):
            strays = near + (width[:, row, 0] * sides[0] + width[:, row, 1] * sides[1]) / 4
        away.append(np.where(known, strays, 0.0) * _ROUND + (work.slip * _ROUND if row == 0 else 0.0))
    return middle[:, 0], np.clip(middle[:, 1], mesh[0], mesh[-1]), away, known & np.isfinite(away[0] + away[1])


def _around(low: Array, high: Array, away: Array) -> tuple[Array, Array]:
    """Ends of y, rounded outward where they are not exact: a place beside a limit is safe or has failed."""
    first, last = np.nextafter(low - away, -np.inf), np.nextafter(high + away, np.inf)
    return np.where(away == 0, low, first), np.where(away == 0, high, last)


def _between(places: Array, low: Array, high: Array) -> tuple[Index, Index]:
    """First and last interval of rising places whose interior (low, high) meets; one at least."""
    first = np.clip(np.searchsorted(places, low, side="right") - 1, 0, len(places) - 2)
    last = np.clip(np.searchsorted(places, high, side="left") - 1, 0, len(places) - 2)
    return first, np.maximum(first, last)


def _even(ends: tuple[Index, Index]) -> Index:
    """The places that make `reduceat` take every range, ends included, by turns with something else."""
    return np.stack([ends[0], ends[1] + 1], axis=1).ravel()


def _counted(first: Index, stop: Index) -> tuple[Index, Index]:
    """All pairs (k, i) with first_k <= i < stop_k."""
    count = np.maximum(stop - first, 0)
    owner = np.repeat(np.arange(len(first)), count)
    place = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    return owner, first[owner] + place


def _rectangles(first: Index, last: Index, across: tuple[Index, Index], count: int) -> Pairs:
    """Groups of entries: rows ``first`` to ``last``, and columns ``across`` of a table with ``count`` of these."""
    owner, row = _counted(first, last + 1)
    pair, column = _counted(across[0][owner], across[1][owner] + 1)
    group = owner[pair]
    start = np.searchsorted(group, np.arange(len(first)))
    return Pairs(entries=row[pair] * count + column, start=start)


def _sides(axis: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """The two sides of a cell along an axis, as places of their ends among its corners."""
    return ((0, 2), (1, 3)) if axis == 0 else ((0, 1), (2, 3))


def _largest(values: list[Array], axis: int) -> Array:
    one, two = (np.abs(values[b] - values[a]) for a, b in _sides(axis))
    return np.asarray(np.maximum(one, two) * _ROUND)


def _weights(ys: list[Array], axis: int, cell: Index, place: Array) -> Array:
    """tau (1 - tau) at most, over all lines along the axis of a cell, where f_I takes y to a place.

    Between the two sides tau is a Moebius function of where the line is, hence monotone, if y changes the same way
    along both; outside of [0, 1] nothing is crossed.
    """
    shares, ways = [], []
    for a, b in _sides(axis):
        begin, change = ys[a][cell], ys[b][cell] - ys[a][cell]
        with np.errstate(all="ignore"):
            share = (place - begin) / change
        shares.append(share)
        ways.append(np.sign(change))
    with np.errstate(all="ignore"):
        low, high = np.minimum(*shares) - _SLACK, np.maximum(*shares) + _SLACK
        best = np.clip(0.5, low, high)
        found = np.where((best > 0) & (best < 1), best * (1 - best), 0.0)
    return np.where((ways[0] == ways[1]) & (ways[0] != 0), found * _ROUND, 0.25)
