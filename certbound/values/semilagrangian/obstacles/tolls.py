"""What the grid's cells pay for paths that meet an obstacle along the coordinates within a step and end beside it.

From above (`Toll`) such a path is to count 1, and U has been counted where it ends. So 1 - U is paid: with m_k at most
U wherever it may end at 0 < Z_h <= z_k (1 = m_0 >= m_1 >= ... >= m_{K+1} = 0), that is at most
sum_k (m_k - m_{k+1}) P(meets it, ends outside, not with 0 < Z_h <= z_k), z_0 = 0, by Abel's summation.

From below (`Catch`) they are paid: of who meets it and ends at a height Z_h > z_k above it L counts at most M_k, the
most in all places of such ends, and u counts 1. With M_0 = 1 and M_k falling, sum_k (M_{k-1} - M_k) 1{Z_h > z_k} <=
1 - L there, so that u >= E L + sum_k (M_{k-1} - M_k) P(meets it, Z_h > z_k), summed over both ends.

Tolls fall by a part over a cell. They are asked of parts of cells, nodes pay what the parts around them ask, which is
bilinear in between, and a cell pays besides what that lacks on one of its parts, where it is least at a corner.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from certbound.arrays import Array, Index, Mask
from certbound.rigor.intervals import Interval, concatenate
from certbound.values.discrete import evaluate
from certbound.values.grids import corners, over_corners
from certbound.values.semilagrangian.bands import Frame
from certbound.values.semilagrangian.confines import Ends, Wall
from certbound.values.semilagrangian.local_steps import Blocks, Clock
from certbound.values.semilagrangian.noisy_axis import Setting
from certbound.values.semilagrangian.obstacles.catches import caught
from certbound.values.semilagrangian.obstacles.passings import Passing, passed, passing
from certbound.values.semilagrangian.remainders import remainders


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Way:
    """Past one end along q of an obstacle, whose ``ends`` in p these are.

    ``paid`` says from which blocks, shape (blocks of y, blocks of q), and ``place`` where these are in ``found``, and
    in ``close``: the same on narrower tubes.
    """

    ends: Ends
    found: Passing
    close: Passing
    place: Index
    paid: Mask


_PARTS, _ROUGH = (6, 2), (2, 1)  # of a cell, along y and q, of which is asked, and where little is found
_WORTH, _LITTLE = 0.01, 1e-4
_SIDES = ((0, 0), (0, 1), (1, 0), (1, 1))
_CLOSE = 4.2  # omega of narrower tubes, whose rareness is paid where they are used
_ABOVE = np.array([0.03, 0.12, 0.35, 0.8])  # heights, in deviations of a step's noise
_UP_TO = np.array([0.06, 0.15, 0.3, 0.6])


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Toll:
    """What is paid for paths that meet an obstacle within a step and end beside it.

    ``nodal``, shape (1 + K, ny, nq), bilinear in between, and ``lacks``, shape (1 + K, ny - 1, nq - 1), on cells: who
    does, and who does and does not end up to K heights beyond its end. By end, ``rows``, shape (2, 2, *blocks): first
    and last (excluded) cell of y in which they end, ``columns``, shape (2, K, nq - 1): which cells of q those heights
    touch; ``side``, shape blocks: which end; ``spread``: the blocks of cells of y and q.
    """

    nodal: Array
    lacks: Array
    rows: Index
    side: Index
    columns: Mask
    spread: tuple[Index, Index]

    def due(self, nodal: Array, bend: Array, dq: Array) -> tuple[Array, Array]:
        """What is paid at nodes and on cells; ``nodal`` and ``bend`` are those of U."""
        least = over_corners(np.minimum, nodal)
        least -= np.maximum(-np.minimum(bend[1:], bend[:-1]), 0.0) * dq**2 / 8 * (1 + 1e-9) + 1e-12
        shares = np.zeros((2 + self.columns.shape[1], *self.side.shape))
        shares[0] = 1.0
        for side in (0, 1):
            here = self.side == side
            for k, columns in enumerate(self.columns[side]):
                if here.any() and columns.any():
                    lowest = np.append(least[:, columns].min(axis=1), np.inf)
                    found = np.minimum.reduceat(lowest, self.rows[side][:, here].T.ravel())[::2]
                    shares[1 + k, here] = np.minimum(np.clip(found, 0.0, 1.0), shares[k, here])
        shares = ((shares[:-1] - shares[1:]) * (1 + 1e-9))[:, self.spread[0][:, None], self.spread[1]]
        paid = np.zeros(nodal.shape)
        for one, part in zip(corners(paid), zip(*(corners(table) for table in self.nodal))):
            np.maximum(one, (shares * np.stack(part)).sum(axis=0), out=one)
        return paid, (shares * self.lacks).sum(axis=0)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Catch:
    """Who is caught within a step and ends beside an obstacle, at one of its ends along q.

    ``nodal``, shape (K, ny, nq), bilinear in between, less ``lacks``, shape (K, ny - 1, nq - 1), on cells, are lower
    bounds for K heights, and ``places`` the cells in which who ends above them may be.
    """

    nodal: Array
    lacks: Array
    places: Mask

    def owed(self, nodal: Array, bend: Array, dq: Array) -> tuple[Array, Array]:
        """What -L may be lowered by at nodes, and raised by on cells; ``nodal`` and ``bend`` are those of -L."""
        most = -over_corners(np.minimum, nodal)
        most += np.maximum(-np.minimum(bend[1:], bend[:-1]), 0.0) * dq**2 / 8 * (1 + 1e-9) + 1e-12
        shares, before = [], 1.0
        for places in self.places:
            now = min(before, max(float(np.max(most[places], initial=0.0)), 0.0))
            shares.append(before - now)
            before = now
        return (
            np.tensordot(np.array(shares) * (1 - 1e-9), self.nodal, axes=1), np.tensordot(shares, self.lacks, axes=1)
        )  # fmt: skip


def _caught_from(
    setting: Setting, clock: Clock, frame: Frame, way: Way, k: int, cells: tuple[Index, Index], above: Array,
    parts: tuple[int, int],
) -> Array:  # fmt: skip
    """`caught` on parts of cells of the ``k``-th block, shape (K, parts times cells)."""
    p, q, rates = _on_parts(setting, clock, frame, *cells, parts)
    far = np.nextafter(p.hi - way.ends[1], np.inf), np.nextafter(way.ends[0] - p.lo, np.inf)
    return caught(
        way.close, k, (q - way.found.end) * way.found.sign, _drift(setting, way.found, p), far, rates, above,
        setting.noise * (1 + setting.spread), clock.step,
    )  # fmt: skip


def catches_of(
    setting: Setting, clock: Clock, frame: Frame, blocks: Blocks, starts: tuple[Index, Index], every: list[list[Way]]
) -> list[Catch]:
    """What cells are paid from below, end by end of the one obstacle that pays most; as `tolls_of`."""
    (p_tube, q_tube), faces = blocks.strays.tube, setting.faces[1]
    above, found = _ABOVE * setting.noise * math.sqrt(clock.step), []
    sizes = np.zeros((len(every), *frame.live.shape))
    for number, way in ((number, way) for number, ways in enumerate(every) for way in ways):
        kept = way.paid & (q_tube.lo > faces[0]) & (q_tube.hi < faces[1])
        kept[kept] = way.close.stays[way.place[kept]]
        if not kept.any():
            continue
        tall = float(q_tube.lo[kept].min()), float(q_tube.hi[kept].max())
        ends = max(float(p_tube.lo[kept].min()), way.ends[0]), min(float(p_tube.hi[kept].max()), way.ends[1])
        slant = sorted((clock.shear * tall[0], clock.shear * tall[1]))
        if frame.y[0] + slant[1] > ends[0] or frame.y[-1] + slant[0] < ends[1]:
            continue
        less = np.zeros((len(above), *_PARTS, *frame.live.shape))
        for i, j in np.argwhere(kept):
            rows, columns = _cells(frame, starts, i, j)
            if len(rows):
                asked = partial(_caught_from, setting, clock, frame, way, int(way.place[i, j]), (rows, columns), above)
                less[..., rows, columns] = -_refined(asked, np.maximum, len(rows))
        sizes[number] -= less[0].mean(axis=(0, 1))
        found.append((number, less, _places(clock, frame, way, ends, tall, above)))
    catches = []
    for number, less, places in found:
        part = np.where(sizes.argmax(axis=0) == number, less, 0.0)
        nodal, lacks = (np.stack(tables) for tables in zip(*map(_shared, part)))
        catches.append(Catch(nodal=-nodal, lacks=lacks, places=places))
    return catches


def _places(clock: Clock, frame: Frame, way: Way, ends: Ends, tall: Ends, above: Array) -> Mask:
    """Cells with p and q between these ends that reach higher than ``above``, shape (K, ny - 1, nq - 1)."""
    y, q = Interval(frame.y[:-1], frame.y[1:]), Interval(frame.q[:-1], frame.q[1:])
    p = y[:, None] + (q * clock.shear)[None]
    near = (p.hi >= ends[0]) & (p.lo <= ends[1]) & (q.hi >= tall[0]) & (q.lo <= tall[1])
    high = ((q - way.found.end) * way.found.sign).hi
    return np.asarray(near & (high >= above[:, None])[:, None])


def _cells(frame: Frame, starts: tuple[Index, Index], i: int, j: int) -> tuple[Index, Index]:
    """Live cells of a block."""
    rows, columns = np.nonzero(frame.live[starts[0][i] : starts[0][i + 1], starts[1][j] : starts[1][j + 1]])
    return rows + starts[0][i], columns + starts[1][j]


def _refined(asked: Callable[[tuple[int, int]], Array], pick: np.ufunc, rows: int) -> Array:
    """What is found on parts of cells, shape (K, *_PARTS, rows): on rough ones, and on fine ones where it is much."""
    found = asked(_ROUGH).reshape(-1, *_ROUGH, rows)
    much = found[0].max() > _WORTH
    found = np.repeat(np.repeat(found, _PARTS[0] // _ROUGH[0], axis=1), _PARTS[1] // _ROUGH[1], axis=2)
    return np.asarray(pick(found, asked(_PARTS).reshape(found.shape))) if much else found


def _on_parts(
    setting: Setting, clock: Clock, frame: Frame, rows: Index, columns: Index, parts: tuple[int, int]
) -> tuple[Interval, Interval, Interval]:
    """p, q and F on all parts of cells, part by part."""
    y, q = Interval(frame.y[rows], frame.y[rows + 1]), Interval(frame.q[columns], frame.q[columns + 1])
    y, q = (
        concatenate([_part(ends, part[axis], parts[axis]) for part in np.ndindex(*parts)])
        for axis, ends in enumerate((y, q))
    )
    p = y + q * clock.shear
    f, bad, _ = evaluate(setting.tape, [Interval.point(np.zeros(len(p))), p, q])
    return p, q, Interval(np.where(bad, -np.inf, f.lo[:, 0]), np.where(bad, np.inf, f.hi[:, 0]))


def _part(ends: Interval, place: int, count: int) -> Interval:
    """One of ``count`` parts, which cover it."""
    width = ends.hi - ends.lo
    low, high = (np.clip(ends.lo + width * (k / count), ends.lo, ends.hi) for k in (place, place + 1))
    return Interval(low, ends.hi if place + 1 == count else high)


def _drift(setting: Setting, found: Passing, p: Interval) -> Interval:
    """Of Z at the obstacle's end, for these p."""
    at, _, _ = evaluate(setting.tape, [Interval.point(np.zeros(len(p))), p, Interval.point(np.full(len(p), found.end))])
    return at[:, 1] * found.sign


def ways_past(
    setting: Setting, clock: Clock, blocks: Blocks, usable: Mask, edges: tuple[Array, Array], wall: Wall
) -> list[Way]:
    """Both ends along q of an obstacle, and the blocks, of the ``usable`` ones, from which passing it is to be paid."""
    ends = wall.ends()
    tube = blocks.strays.tube
    hit = np.nonzero(usable)
    hit = tuple(part[~wall.safe(wall.sizes(tube[0][hit], tube[1][hit]), np.zeros((1, 1)))] for part in hit)
    if ends is None or not len(hit[0]):
        return []
    y, q = (Interval(edge[part], edge[part + 1]) for edge, part in zip(edges, hit))
    start, found = y + q * clock.shear, []
    s = setting.noise * (1 + setting.spread)
    narrow = remainders(setting.tape, s, start, q, step=clock.step, omega=_CLOSE)
    for side in (0, 1):
        if math.isfinite(ends[1][side]):
            here, close = (
                passing(ends, setting.tape, part, start, blocks.strays.bow[hit] > 0, side, omega)
                for part, omega in (((tube[0][hit], tube[1][hit]), clock.omega), (narrow.tube, _CLOSE))
            )
            close = replace(close, known=close.known & narrow.known, stays=close.stays & narrow.known)
            place, paid = np.zeros(usable.shape, dtype=int), np.zeros(usable.shape, dtype=bool)
            place[hit], paid[hit] = np.arange(len(hit[0])), here.known
            found.append(Way(ends=ends[0], found=here, close=close, place=place, paid=paid))
    return found


def tolls_of(
    setting: Setting, clock: Clock, frame: Frame, blocks: Blocks, starts: tuple[Index, Index], every: list[list[Way]]
) -> list[Toll]:
    """What is paid for obstacles; ``starts``: the blocks' first cells, and the number of cells."""
    found = []
    bent = frame.bends[1] * np.diff(frame.y)[:, None] ** 2 + frame.bends[3] * np.diff(frame.q) ** 2
    bent = bent / 8 * (1 + 1e-9) + 1e-14
    bent = bent + over_corners(np.maximum, frame.radius[1]) + 1e-13 * over_corners(np.maximum, np.abs(frame.image[1]))
    above = _UP_TO * setting.noise * math.sqrt(clock.step)
    spread_y, spread_q = (np.repeat(np.arange(len(part) - 1), np.diff(part)) for part in starts)
    for ways in (ways for ways in every if ways):
        total = np.zeros((1 + len(above), *_PARTS, *frame.live.shape))
        side = np.zeros(ways[0].paid.shape, dtype=int)
        for i, j in np.argwhere(np.any([way.paid for way in ways], axis=0)):
            rows, columns = _cells(frame, starts, i, j)
            if not len(rows):
                continue
            more = float(blocks.strays.most[1][i, j]) + bent[rows, columns]
            middle, open_ways = blocks.strays.tube[1].mid[i, j], [way for way in ways if way.paid[i, j]]
            way = max(open_ways, key=lambda way: way.found.sign * (middle - way.found.end))  # any will do
            asked = partial(
                _passed_from, setting, clock, frame, way, int(way.place[i, j]), (rows, columns), above, more,
                blocks.covariance[2][i, j],
            )  # fmt: skip
            side[i, j], due = int(way.found.sign > 0), _refined(asked, np.minimum, len(rows))
            total[..., rows, columns] = due
        nodal, lacks = (np.stack(part) for part in zip(*(_shared(part) for part in total)))
        found.append(Toll(
            nodal=nodal, lacks=lacks, rows=_landing(clock, frame, blocks, ways, above), side=side,
            spread=(spread_y, spread_q), columns=_beside(frame, ways, above),
        ))  # fmt: skip
    return found


def _passed_from(
    setting: Setting, clock: Clock, frame: Frame, way: Way, k: int, cells: tuple[Index, Index], above: Array,
    more: Array, variance: Interval, parts: tuple[int, int],
) -> Array:  # fmt: skip
    """`passed` on parts of cells of the ``k``-th block, shape (1 + K, parts times cells); ``more``: of the images."""
    p, q, rates = _on_parts(setting, clock, frame, *cells, parts)
    ends = np.stack([
        np.concatenate([_between(frame.image[1], *cells, part, parts, side) for part in np.ndindex(*parts)])
        for side in _SIDES
    ])  # fmt: skip
    most = np.tile(more, math.prod(parts))
    image = Interval(ends.min(axis=0) - most, ends.max(axis=0) + most)
    away = np.nextafter(p.lo - way.ends[1], -np.inf), np.nextafter(way.ends[0] - p.hi, -np.inf)
    sign, end = way.found.sign, way.found.end
    due = np.ones((1 + len(above), len(p)))
    for found in (way.found, way.close) if parts == _ROUGH or not way.close.known[k] else (way.close,):
        if found.known[k] and due[0].max() > _LITTLE:
            due = np.minimum(due, passed(
                found, k, (q - end) * sign, _drift(setting, found, p), away, rates, (image - end) * sign, variance,
                above, setting.noise * (1 + setting.spread), clock.step,
            ))  # fmt: skip
    return due


def _landing(clock: Clock, frame: Frame, blocks: Blocks, ways: list[Way], above: Array) -> Index:
    """First and last (excluded) cells of y in which who has met an obstacle may end, shape (2 ends, 2, *blocks)."""
    p, found = blocks.strays.tube[0], np.zeros((2, 2, *blocks.known.shape), dtype=int)
    for way in ways:
        tall = way.found.end, way.found.end + way.found.sign * 1.001 * float(above[-1])
        slant = sorted(clock.shear * end for end in tall)
        low, high = (
            np.maximum(p.lo, way.ends[0]) - slant[1] - 1e-9, np.minimum(p.hi, way.ends[1]) - slant[0] + 1e-9
        )  # fmt: skip
        first = np.clip(np.searchsorted(frame.y, low, side="right") - 1, 0, len(frame.y) - 2)
        last = np.clip(np.searchsorted(frame.y, high), first + 1, len(frame.y) - 1)
        found[int(way.found.sign > 0)] = first, last
    return found


def _beside(frame: Frame, ways: list[Way], above: Array) -> Mask:
    """Cells of q up to the heights beyond the lower and the upper end of an obstacle, shape (2, K, nq - 1)."""
    found = np.zeros((2, len(above), len(frame.q) - 1), dtype=bool)
    for way in ways:
        heights = (frame.q - way.found.end) * way.found.sign
        low, high = np.minimum(heights[:-1], heights[1:]), np.maximum(heights[:-1], heights[1:])
        found[int(way.found.sign > 0)] = (low <= above[:, None] * (1 + 1e-9)) & (high > 0)
    return found


def _between(
    table: Array, rows: Index, columns: Index, part: tuple[int, ...], parts: tuple[int, int], side: tuple[int, int]
) -> Array:
    """A bilinear function, given at nodes, at a corner of one of the parts of cells."""
    t, r = ((part[k] + side[k]) / parts[k] for k in (0, 1))
    low, high = ((1 - r) * table[rows + k, columns] + r * table[rows + k, columns + 1] for k in (0, 1))
    return np.asarray((1 - t) * low + t * high)


def _shared(due: Array) -> tuple[Array, Array]:
    """Payments at nodes, the most of the parts of cells there, and what cells lack with them; ``due`` by parts."""
    nodal = np.full((due.shape[2] + 1, due.shape[3] + 1), -np.inf)
    for a, b in _SIDES:
        place = slice(a, due.shape[2] + a), slice(b, due.shape[3] + b)
        nodal[place] = np.maximum(nodal[place], due[-a, -b])
    lacks = np.zeros(due.shape[2:])
    rows, columns = np.nonzero(due.any(axis=(0, 1)))
    for part in np.ndindex(*_PARTS):
        least = np.min([_between(nodal, rows, columns, part, _PARTS, side) for side in _SIDES], axis=0)
        missing = due[(*part, rows, columns)] - least + 1e-12 * np.abs(least)
        lacks[rows, columns] = np.maximum(lacks[rows, columns], missing)
    return nodal, lacks
