"""What the grid's cells pay for paths that meet an obstacle along the coordinates within a step and end beside it.

From below they are paid: of who meets it and ends at a height Z_h > z_k above it L counts at most M_k, the most in all
places of such ends, and u counts 1. With M_0 = 1 and M_k falling, sum_k (M_{k-1} - M_k) 1{Z_h > z_k} <= 1 - L there, so
that u >= E L + sum_k (M_{k-1} - M_k) P(meets it, Z_h > z_k).

Tolls fall by a part over a cell. They are asked of parts of cells, nodes pay what the parts around them ask, which is
bilinear in between, and a cell pays besides what that lacks on one of its parts, where it is least at a corner.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from certbound.arrays import Array, Index, Mask
from certbound.rigor.intervals import Interval, concatenate
from certbound.values.discrete import evaluate
from certbound.values.grids import over_corners
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

    ``paid`` says from which blocks, shape (blocks of y, blocks of q), and ``place`` where these are in ``found``, and in
    ``close``: the same on narrower tubes.
    """

    ends: Ends
    found: Passing
    close: Passing
    place: Index
    paid: Mask


_PARTS = (2, 4)  # of a cell, along y and q, from which tolls are asked
_SIDES = ((0, 0), (0, 1), (1, 0), (1, 1))
_CLOSE = 4.2  # omega of narrower tubes, whose rareness is paid where they are used
_ABOVE = np.array([0.12, 0.35, 0.8])  # heights, in deviations of a step's noise


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Catch:
    """Who is caught within a step and ends beside an obstacle, at one of its ends along q.

    ``nodal``, shape (K, ny, nq), bilinear in between, less ``lacks``, shape (K, ny - 1, nq - 1), on cells, are lower bounds
    for K heights, and ``places`` the cells in which who ends above them may be.
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


def catches_of(
    setting: Setting, clock: Clock, frame: Frame, blocks: Blocks, starts: tuple[Index, Index], every: list[list[Way]]
) -> list[Catch]:
    """What cells are paid from below, end by end of the first obstacle with any; as `tolls_of`."""
    s, (p_tube, q_tube) = setting.noise * (1 + setting.spread), blocks.strays.tube
    above, faces, catches = _ABOVE * setting.noise * math.sqrt(clock.step), setting.faces[1], []
    y, q = Interval(frame.y[:-1], frame.y[1:]), Interval(frame.q[:-1], frame.q[1:])
    for way in (way for ways in every for way in ways):
        kept = way.paid & (q_tube.lo > faces[0]) & (q_tube.hi < faces[1])
        kept[kept] = way.close.stays[way.place[kept]]
        if not kept.any():
            continue
        less = np.zeros((*_PARTS, len(above), *frame.live.shape))
        for i, j in np.argwhere(kept):
            rows, columns = _cells(frame, starts, i, j)
            if not len(rows):
                continue
            p, here, rates = _on_parts(setting, clock, frame, rows, columns)
            far = np.nextafter(p.hi - way.ends[1], np.inf), np.nextafter(way.ends[0] - p.lo, np.inf)
            chance = caught(
                way.close, int(way.place[i, j]), (here - way.found.end) * way.found.sign,
                _drift(setting, way.found, p), far, rates, above, s, clock.step,
            )  # fmt: skip
            chance = np.moveaxis(chance.reshape(len(above), *_PARTS, len(rows)), 0, 2)
            less[..., rows, columns] = -chance
        tall = float(q_tube.lo[kept].min()), float(q_tube.hi[kept].max())
        ends = max(float(p_tube.lo[kept].min()), way.ends[0]), min(float(p_tube.hi[kept].max()), way.ends[1])
        slant = sorted((clock.shear * tall[0], clock.shear * tall[1]))
        if frame.y[0] + slant[1] > ends[0] or frame.y[-1] + slant[0] < ends[1]:
            continue
        p = y[:, None] + (q * clock.shear)[None]
        high = ((q - way.found.end) * way.found.sign).hi
        near = (p.hi >= ends[0]) & (p.lo <= ends[1]) & (q.hi >= tall[0]) & (q.lo <= tall[1])
        nodal, lacks = (np.stack(part) for part in zip(*(_shared(less[:, :, k]) for k in range(len(above)))))
        catches.append(Catch(nodal=-nodal, lacks=lacks, places=near & (high >= above[:, None])[:, None]))
    return catches


def _cells(frame: Frame, starts: tuple[Index, Index], i: int, j: int) -> tuple[Index, Index]:
    """Live cells of a block."""
    rows, columns = np.nonzero(frame.live[starts[0][i] : starts[0][i + 1], starts[1][j] : starts[1][j + 1]])
    return rows + starts[0][i], columns + starts[1][j]


def _on_parts(
    setting: Setting, clock: Clock, frame: Frame, rows: Index, columns: Index
) -> tuple[Interval, Interval, Interval]:
    """p, q and F on all parts of cells, part by part."""
    y, q = Interval(frame.y[rows], frame.y[rows + 1]), Interval(frame.q[columns], frame.q[columns + 1])
    y, q = (
        concatenate([_part(ends, part[axis], _PARTS[axis]) for part in np.ndindex(*_PARTS)])
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
) -> tuple[Array, Array]:
    """What nodes pay (bilinear in between), shape (ny, nq), and cells besides, shape (ny - 1, nq - 1).

    ``starts``: the blocks' first cells, and the number of cells.
    """
    total = np.zeros((*_PARTS, *frame.live.shape))
    s = setting.noise * (1 + setting.spread)
    bent = frame.bends[1] * np.diff(frame.y)[:, None] ** 2 + frame.bends[3] * np.diff(frame.q) ** 2
    bent = bent / 8 * (1 + 1e-9) + 1e-14
    bent = bent + over_corners(np.maximum, frame.radius[1]) + 1e-13 * over_corners(np.maximum, np.abs(frame.image[1]))
    for ways in every:
        for i, j in np.argwhere(np.any([way.paid for way in ways], axis=0)) if ways else ():
            rows, columns = _cells(frame, starts, i, j)
            if not len(rows):
                continue
            most = np.tile(float(blocks.strays.most[1][i, j]) + bent[rows, columns], math.prod(_PARTS))
            every_part = list(np.ndindex(*_PARTS))
            p, q, rates = _on_parts(setting, clock, frame, rows, columns)
            corners = np.stack([
                np.concatenate([_between(frame.image[1], rows, columns, part, side) for part in every_part])
                for side in _SIDES
            ])  # fmt: skip
            image = Interval(corners.min(axis=0) - most, corners.max(axis=0) + most)
            due = np.ones(len(p))
            ends = ways[0].ends
            away = np.nextafter(p.lo - ends[1], -np.inf), np.nextafter(ends[0] - p.hi, -np.inf)
            for way in ways:
                if not way.paid[i, j]:
                    continue
                sign, end, k = way.found.sign, way.found.end, int(way.place[i, j])
                for found in (way.found, way.close):
                    if found.known[k]:
                        due = np.minimum(due, passed(
                            found, k, (q - end) * sign, _drift(setting, found, p), away, rates, (image - end) * sign,
                            blocks.covariance[2][i, j], s, clock.step,
                        ))  # fmt: skip
            total[:, :, rows, columns] += due.reshape(*_PARTS, len(rows))
    return _shared(total)


def _between(table: Array, rows: Index, columns: Index, part: tuple[int, ...], side: tuple[int, int]) -> Array:
    """A bilinear function, given at nodes, at a corner of one of the parts of cells."""
    t, r = ((part[k] + side[k]) / _PARTS[k] for k in (0, 1))
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
        least = np.min([_between(nodal, rows, columns, part, side) for side in _SIDES], axis=0)
        lacks[rows, columns] = np.maximum(lacks[rows, columns], due[(*part, rows, columns)] - least + 1e-12 * np.abs(least))
    return nodal, lacks
