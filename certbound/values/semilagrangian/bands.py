"""A band of cells between two lines of the grid, and the normal laws of one step on it.

All cells share the variance of y. That of q differs: with T_v the function smoothed by the variance v, the derivative
d/dv T is d_ww T/2, and that of it d_wwww T/4, so that T_v exceeds its interpolation between T_a and T_b, a <= v <= b,
by at most (b - a)^2/32 sup |d_wwww T|. Each cell interpolates in its place; what the covariance has beyond is priced.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from certbound.arrays import Array, Mask
from certbound.rigor.intervals import Interval
from certbound.values.semilagrangian.landings import along_q, at_nodes, over_cells
from certbound.values.semilagrangian.local_steps import Base
from certbound.values.semilagrangian.smoothers import REACH, WIDER, Across, Along, across, along
from certbound.values.semilagrangian.smoothing import Lines, Rows, smoothed

_UP = 1 + 1e-9
NOWHERE = -1e300
_NEGLECTED = 5e-23  # what smoothing does not see of a function of size 1, beyond `REACH` standard deviations


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Frame:
    """The grid of (y, q), and what one noise-free step does to its nodes and cells.

    Attributes
    ----------
    y, q : ndarray, shapes (ny,), (nq,)
        Nodes.
    image, radius : ndarray, shape (2, ny, nq)
        Where nodes land, and how well that is known.
    slopes, bends : ndarray, shape (4, ny - 1, nq - 1)
        See ``Blocks``, on cells.
    drift : ndarray, shape (2, ny - 1, nq - 1)
        Mean sizes of the remainder in y and q, ``Remainders.mean`` in these coordinates.
    live : ndarray of bool, shape (ny - 1, nq - 1)
        Cells that lie in the safe set, for which all of this is known.
    """

    y: Array
    q: Array
    image: Array
    radius: Array
    slopes: Array
    bends: Array
    drift: Array
    live: Mask


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Band:
    """Cells ``first:last`` along y; see the module.

    Rows (a mesh along y) and ``nodes`` of q are what its images fall on, ``lines`` and ``sources`` what is within reach
    of them. ``two`` holds the kernels along q of the least and the largest variance, ``share`` (cells, nq - 1) where
    between them a cell's variance is.
    """

    first: int
    last: int
    rows: slice
    lines: slice
    nodes: slice
    sources: slice
    sigmas: tuple[float, float]
    one: Along
    two: tuple[Across, Across]
    share: Array
    reach: Array
    prices: Array
    live: Mask
    beyond: float
    apart: float


def band_of(
    frame: Frame, first: int, last: int, base: Base, excess: Array, height: Interval, live: Mask, follow: float
) -> Band:
    """Prepare a band.

    Parameters
    ----------
    first, last : int
        Its cells along y.
    base, excess : Base, ndarray of shape (3, last - first, nq - 1)
        The shared law of y, and what ``base.excess`` holds on the band's cells.
    height : Interval
        S_qq on the band's cells.
    live : ndarray of bool, shape (last - first, nq - 1)
    follow : float
        Standard deviations up to which D's effect is followed.
    """
    # the variance of a cell: below S_qq by the tilt, and by what makes up for rounding in what follows
    held = (height.lo - excess[2]) * (1 - 1e-12)
    live = live & (held > 0.5 * height.hi)
    ends = (float(held[live].min()), float(held[live].max())) if live.any() else (1.0, 1.0)
    share = np.zeros(held.shape)  # of one variance there is nothing between
    if ends[1] > ends[0]:
        share = np.clip((held - ends[0]) / (ends[1] - ends[0]), 0.0, 1.0)
    sigmas = [math.sqrt(end) for end in ends]
    sigma = base.sigma, sigmas[0]
    more = np.where(live, (height.hi - held) * _UP + 1e-14 * height.hi, 0.0)
    reach = follow * np.sqrt(excess[0]) * _UP
    rows = _touched_places(frame, 0, first, last, live, reach)
    mesh = frame.y[rows]
    margin = (REACH + 0.1) * sigma[0]
    lines = _around(frame.y, rows, margin)
    live = live & _far_from_ends(
        frame, first, last, (sigma[0], sigmas[1]), (float(mesh[0]) - margin, float(mesh[-1]) + margin)
    )
    one = along(frame.y, sigma[0], 1e-15, rows, lines)
    wider = (float(more.max(initial=0.0)) + ends[1]) / ends[0]
    two = across(frame.q, sigmas[0], 1e-15, math.sqrt(wider) * _UP), across(frame.q, sigmas[1], 1e-15, _UP)
    away = np.where(live, height.hi - ends[0], 0.0)
    spread = float(np.where(live, excess[0] / sigma[0] ** 2 + away / ends[0], 0.0).max(initial=0.0)) * _UP
    c = 0.5 * (1 - (1 + spread) / WIDER**2)
    factor = WIDER**2 * math.exp(c - 1) / c * _UP if c > 0.02 else math.inf
    if not math.isfinite(factor):
        live = np.zeros_like(live)
        factor = 0.0
    drift = frame.drift[:, first:last] * factor
    error = one.error + max(part.error for part in two) + 1e-13 + 8e-16 * (len(frame.y[lines]) + 2 * len(frame.q))
    amplified = [_amplified(frame, slice(first, last), frame.y[lines], mesh, (sigma[0], s), reach) for s in sigmas]
    rounding = error * np.maximum(*amplified)
    prices = np.stack([more / 2, excess[1], excess[0] / 2, drift[0], drift[1], rounding]) * _UP
    every = slice(0, len(frame.q))
    return Band(
        first=first, last=last, rows=rows, lines=lines, nodes=every, sources=every, sigmas=(sigma[0], sigmas[1]),
        one=one, two=two, share=share, reach=reach, prices=prices, live=live, beyond=_NEGLECTED / error,
        apart=(ends[1] - ends[0]) ** 2 / 32 * _UP,
    )  # fmt: skip


def _amplified(
    frame: Frame, cells: slice, lines: Array, mesh: Array, sigma: tuple[float, float], reach: Array
) -> Array:
    """Lambda of "Rounding" (docs/values.md), K8-SL: by how much errors of the kernels' entries grow, cell by cell."""
    fine, widest = float(np.diff(frame.q).min()), float(np.diff(frame.q).max())
    nodes = slice(cells.start, cells.stop + 1)
    d, e = np.diff(frame.y)[cells, None], np.diff(frame.q)
    slopes, bends = np.abs(frame.slopes[:, cells]), frame.bends[:, cells]
    image, radius = frame.image[:, nodes], frame.radius[:, nodes]
    around = np.abs(np.diff(image, axis=2)) + radius[..., 1:] + radius[..., :-1]
    sides = np.maximum(around[:, 1:], around[:, :-1]) + bends[2:] * e**2
    step = [np.maximum(np.maximum(slopes[2 * k], slopes[2 * k + 1]) * d, sides[k]) for k in (0, 1)]
    turn = [np.maximum(bends[k] * d**2, bends[2 + k] * e**2) for k in (0, 1)]
    least, ratio = _nearby(image[0], step[0] + turn[0] + reach, lines, mesh, (REACH + 0.1) * sigma[0])
    loose = radius[0].max() / least + radius[1].max() / fine
    up, across = step[0] / least, step[1] / sigma[1]
    bow = turn[0] / least
    found = 60 + 120 * loose + 8 * across**2 + 30 * up * across + 440 * ratio * up * (1 + 2 * up + bow)
    found = found + 23 * bow * (1 + widest / sigma[1]) + 90 * ratio * turn[1] * widest / fine**2 + 110 * ratio**2
    found = found + 60 * ratio * (sigma[1] / fine) ** 2 + (sigma[0] / least + sigma[1] / fine) ** 2
    return np.asarray(2 * found * _UP)


def _nearby(image: Array, more: Array, lines: Array, mesh: Array, reach: float) -> tuple[Array, Array]:
    """d and r of "Rounding" for every cell: of lines and mesh cells that smoothing near its image meets."""
    corners = [image[a, b] for a in (slice(None, -1), slice(1, None)) for b in (slice(None, -1), slice(1, None))]
    low, high = np.minimum.reduce(corners) - more - reach, np.maximum.reduce(corners) + more + reach
    found = []
    for axis, pick in ((lines, np.minimum), (mesh, np.maximum)):
        widths = np.diff(axis)
        tables = [widths]  # extremes of 1, 2, 4, ... cells from each on
        while 2 ** len(tables) <= len(widths):
            half = 2 ** (len(tables) - 1)
            tables.append(pick(tables[-1][:-half], tables[-1][half:]))
        first = np.clip(np.searchsorted(axis, low) - 2, 0, len(widths) - 1)
        last = np.clip(np.searchsorted(axis, high) + 2, first + 1, len(widths))
        level = np.log2(last - first).astype(int)
        best = np.zeros(low.shape)
        for k, table in enumerate(tables):
            here = level == k
            best[here] = pick(table[first[here]], table[last[here] - 2**k])
        found.append(best)
    return found[0], np.maximum(1.0, found[1] / found[0])


def _far_from_ends(
    frame: Frame, first: int, last: int, sigma: tuple[float, float], needed: tuple[float, float]
) -> Mask:
    """Cells from whose images the smoothing does not look beyond the grid."""
    fine = frame.y[0] <= needed[0] and needed[1] <= frame.y[-1]
    d = np.diff(frame.y)[first:last, None]
    sag = frame.bends[1, first:last] * d**2 / 8 + frame.bends[3, first:last] * np.diff(frame.q) ** 2 / 8
    found = np.full(sag.shape, fine)
    image, radius = frame.image[1, first : last + 1], frame.radius[1, first : last + 1]
    for a in (slice(None, -1), slice(1, None)):
        for b in (slice(None, -1), slice(1, None)):
            away = radius[a, b] + sag + REACH * sigma[1]
            found &= (image[a, b] - away >= frame.q[0]) & (image[a, b] + away <= frame.q[-1])
    return found


def narrowed(band: Band, frame: Frame) -> Band | None:
    """A band without what its cells that are live in a frame do not need; None where none is."""
    live = band.live & frame.live[band.first : band.last]
    kept = np.flatnonzero(live.any(axis=1))
    if not len(kept):
        return None
    part = slice(int(kept[0]), int(kept[-1]) + 1)
    first, last, reach = band.first + part.start, band.first + part.stop, band.reach[part]
    rows = _touched_places(frame, 0, first, last, live[part], reach)
    nodes = _touched_places(frame, 1, first, last, live[part], 0.0)
    lines, sources = (
        _around(axis, near, (REACH + more) * sigma)
        for axis, near, more, sigma in zip((frame.y, frame.q), (rows, nodes), (0.1, 1.0), band.sigmas)
    )
    lines = slice(max(lines.start, band.lines.start), min(lines.stop, band.lines.stop))
    return replace(
        band, first=first, last=last, rows=rows, lines=lines, nodes=nodes, sources=sources,
        one=band.one.cut(_less(rows, band.rows), _less(lines, band.lines)),
        two=(band.two[0].cut(nodes, sources), band.two[1].cut(nodes, sources)), share=band.share[part], reach=reach,
        prices=band.prices[:, part], live=live[part],
    )  # fmt: skip


def _less(part: slice, whole: slice) -> slice:
    return slice(part.start - whole.start, part.stop - whole.start)


def _around(axis: Array, near: slice, margin: float) -> slice:
    """The nodes within a margin of these, and one more on either side."""
    start = int(np.searchsorted(axis, axis[near.start] - margin, side="right")) - 1
    stop = int(np.searchsorted(axis, axis[near.stop - 1] + margin)) + 1
    return slice(max(start, 0), min(stop, len(axis)))


def _touched_places(frame: Frame, axis: int, first: int, last: int, live: Mask, reach: Array | float) -> slice:
    """The rows (along y, axis 0; not the outermost) or nodes (along q, axis 1) that the windows of cells ``first:last``
    touch, and one more on either side.
    """
    d = np.diff(frame.y)[first:last, None]
    sag = frame.bends[axis, first:last] * d**2 / 8 + frame.bends[2 + axis, first:last] * np.diff(frame.q) ** 2 / 8
    low, high = np.inf, -np.inf
    image, radius = frame.image[axis, first : last + 1], frame.radius[axis, first : last + 1]
    for a in (slice(None, -1), slice(1, None)):
        for b in (slice(None, -1), slice(1, None)):
            away = radius[a, b] + sag + reach
            low = min(low, float(np.where(live, image[a, b] - away, np.inf).min()))
            high = max(high, float(np.where(live, image[a, b] + away, -np.inf).max()))
    places, least = (frame.y, 1) if axis == 0 else (frame.q, 0)
    start = int(np.searchsorted(places, low)) - 2
    stop = int(np.searchsorted(places, high)) + 2
    return slice(max(start, least), min(stop + 1, len(places) - least))


def through(band: Band, frame: Frame, value: Lines, slopes: tuple[Array, Array]) -> tuple[Array, Array, Array]:
    """One step back on the band: node values, parabolas of its lines, and what its cells pay.

    Returns
    -------
    nodal, bend : ndarray, shapes (cells + 1, nq), (cells + 1, nq - 1)
        `NOWHERE` at nodes of no live cell.
    payment : ndarray, shape (cells, nq - 1)
    """
    lines, sources = band.lines, band.sources
    mesh, places = (frame.y[band.rows], frame.q[band.nodes]), (frame.y[lines], frame.q[sources])
    inner = slice(lines.start, lines.stop - 1), slice(sources.start, sources.stop - 1)
    part = Lines(nodal=value.nodal[lines, sources], bend=value.bend[lines, inner[1]])
    near = slopes[0][inner], slopes[1][inner]
    least = smoothed(part, near, places, mesh, band.one, band.two[0])
    tables = [least]
    if band.apart > 0:
        tables.append(smoothed(part, near, places, mesh, band.one, band.two[1], least))
    unseen = float(np.abs(value.nodal).max() + (np.abs(value.bend) * np.diff(frame.q) ** 2).max() / 8) * band.beyond
    between = band.apart * least.fourth  # whatever share of either a cell takes
    at, curve, paid = _landed(band, frame, mesh, tables, between, unseen)
    share, live = band.share, band.live
    nodal = np.full((live.shape[0] + 1, live.shape[1] + 1), NOWHERE)
    bend = np.full((live.shape[0] + 1, live.shape[1]), -np.inf)

    def raised(table: Array, place: tuple[slice, slice], low: Array, high: Array, nothing: float) -> None:
        mixed = (1 - share) * low[place] + share * high[place]
        table[place] = np.maximum(table[place], np.where(live, mixed, nothing))

    for a in (slice(None, -1), slice(1, None)):
        raised(bend, (a, slice(None)), curve[0], curve[-1], -np.inf)
        for b in (slice(None, -1), slice(1, None)):
            raised(nodal, (a, b), at[0], at[-1], NOWHERE)
    bend = np.where(np.isfinite(bend), bend, 0.0)
    return nodal, bend, ((1 - share) * paid[0] + share * paid[-1]) * _UP


def _landed(
    band: Band, frame: Frame, mesh: tuple[Array, Array], laws: list[Rows], between: Array, unseen: float
) -> tuple[Array, Array, Array]:
    """The smoothed functions at the images of the band's nodes and cells, as ``through`` returns them, law by law."""
    nodes, cells = slice(band.first, band.last + 1), slice(band.first, band.last)
    live, dq = band.live, np.diff(frame.q)
    image, radius, slopes, bends, prices = (  # in one piece: else kernels are compiled once more
        np.ascontiguousarray(part) for part in (
            frame.image[:, nodes], frame.radius[:, nodes], frame.slopes[:, cells], frame.bends[:, cells], band.prices
        )
    )  # fmt: skip
    tables = np.stack([[one.cross_low, one.cross_high, one.steep_y, one.steep_w] for one in laws])
    bend, kinks = np.stack([one.bend for one in laws]), np.stack([one.kinks for one in laws])
    values, arch = np.stack([one.values for one in laws]), np.stack([one.arch for one in laws])
    nodal = at_nodes(image, radius, _touched(live), *mesh, values, arch, tables)
    sagging, sway = np.stack([one.sagging for one in laws]), np.stack([one.sway for one in laws])
    curve, extra = along_q(image, radius, live, bends[2:], dq, *mesh, tables, bend, kinks, sagging, sway)
    least = laws[0]
    wide = np.stack([least.bent, least.mixed, least.bowed, least.lean_y, least.lean_q])
    close = np.stack([table for one in laws for table in (one.lift + between, one.near + unseen)])
    payment = over_cells(
        image, radius, live, slopes, bends, (np.diff(frame.y)[cells], dq), *mesh, tables, bend, kinks, band.reach,
        prices, wide, close,
    )  # fmt: skip
    return nodal, curve, payment + np.maximum(extra[:, :-1], extra[:, 1:])


def _touched(live: Mask) -> Mask:
    found = np.zeros((live.shape[0] + 1, live.shape[1] + 1), dtype=bool)
    for a in (slice(None, -1), slice(1, None)):
        for b in (slice(None, -1), slice(1, None)):
            found[a, b] |= live
    return found
