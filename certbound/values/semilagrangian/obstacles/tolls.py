"""What the grid's cells pay for paths that meet an obstacle along the coordinates within a step and end beside it.

From below they are paid: of who meets it and ends at a height Z_h > z_k above it L counts at most M_k, the most in all
places of such ends, and u counts 1. With M_0 = 1 and M_k falling, sum_k (M_{k-1} - M_k) 1{Z_h > z_k} <= 1 - L there, so
that u >= E L + sum_k (M_{k-1} - M_k) P(meets it, Z_h > z_k).

Tolls fall by a part over a cell. They are asked of parts of cells, nodes pay what the parts around them ask, which is
bilinear in between, and a cell pays besides what that lacks on one of its parts, where it is least at a corner.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

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


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Way:
    """Past one end along q of an obstacle, whose ``ends`` in p these are.

    ``paid`` says from which blocks, shape (blocks of y, blocks of q), and ``place`` where these are in ``found``.
    """

    ends: Ends
    found: Passing
    place: Index
    paid: Mask


_PARTS = (2, 4)  # of a cell, along y and q, from which tolls are asked
_SIDES = ((0, 0), (0, 1), (1, 0), (1, 1))
_ABOVE = np.array([0.12, 0.35, 0.8])  # heights, in deviations of a step's noise


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Catch:
    """Who is caught within a step and ends beside an obstacle, at one of its ends along q.

    ``chance`` has lower bounds for K heights, shape (K, ny - 1, nq - 1), and ``places`` the cells in which who ends
    above them may be.
    """

    chance: Array
    places: Mask

    def owed(self, nodal: Array, bend: Array, dq: Array) -> Array:
        """What -L may be lowered by, shape (ny - 1, nq - 1); ``nodal`` and ``bend`` are those of -L."""
        most = -over_corners(np.minimum, nodal)
        most += np.maximum(-np.minimum(bend[1:], bend[:-1]), 0.0) * dq**2 / 8 * (1 + 1e-9) + 1e-12
        total, before = np.zeros(most.shape), 1.0
        for chance, places in zip(self.chance, self.places):
            now = min(before, max(float(np.max(most[places], initial=0.0)), 0.0))
            total += (before - now) * chance
            before = now
        return total * (1 - 1e-9)


def catches_of(
    setting: Setting, clock: Clock, frame: Frame, blocks: Blocks, starts: tuple[Index, Index], every: list[list[Way]]
) -> list[Catch]:
    """What cells are paid from below, obstacle by obstacle and end by end; as `tolls_of`."""
    s, (p_tube, q_tube) = setting.noise * (1 + setting.spread), blocks.strays.tube
    above, faces, catches = _ABOVE * setting.noise * math.sqrt(clock.step), setting.faces[1], []
    y, q = Interval(frame.y[:-1], frame.y[1:]), Interval(frame.q[:-1], frame.q[1:])
    for way in (way for ways in every for way in ways):
        kept = way.paid & (q_tube.lo > faces[0]) & (q_tube.hi < faces[1])
        kept[kept] = way.found.stays[way.place[kept]]
        if not kept.any():
            continue
        chance = np.zeros((len(above), *frame.live.shape))
        for i, j in np.argwhere(kept):
            rows, columns = _cells(frame, starts, i, j)
            if not len(rows):
                continue
            p, here, rates = _starts_in(setting, clock, frame, rows, columns)
            far = np.nextafter(p.hi - way.ends[1], np.inf), np.nextafter(way.ends[0] - p.lo, np.inf)
            chance[:, rows, columns] = caught(
                way.found, int(way.place[i, j]), (here - way.found.end) * way.found.sign,
                _drift(setting, way.found, p), far, rates, above, s, clock.step, clock.omega,
            )  # fmt: skip
        tall = float(q_tube.lo[kept].min()), float(q_tube.hi[kept].max())
        ends = max(float(p_tube.lo[kept].min()), way.ends[0]), min(float(p_tube.hi[kept].max()), way.ends[1])
        slant = sorted((clock.shear * tall[0], clock.shear * tall[1]))
        if frame.y[0] + slant[1] > ends[0] or frame.y[-1] + slant[0] < ends[1]:
            continue
        p = y[:, None] + (q * clock.shear)[None]
        high = ((q - way.found.end) * way.found.sign).hi
        near = (p.hi >= ends[0]) & (p.lo <= ends[1]) & (q.hi >= tall[0]) & (q.lo <= tall[1])
        catches.append(Catch(chance=chance, places=near & (high >= above[:, None])[:, None]))
    return catches


def _cells(frame: Frame, starts: tuple[Index, Index], i: int, j: int) -> tuple[Index, Index]:
    """Live cells of a block."""
    rows, columns = np.nonzero(frame.live[starts[0][i] : starts[0][i + 1], starts[1][j] : starts[1][j + 1]])
    return rows + starts[0][i], columns + starts[1][j]


def _starts_in(
    setting: Setting, clock: Clock, frame: Frame, rows: Index, columns: Index, part: tuple[int, ...] | None = None
) -> tuple[Interval, Interval, Interval]:
    """p, q and F on cells, or on one of their parts."""
    y, q = Interval(frame.y[rows], frame.y[rows + 1]), Interval(frame.q[columns], frame.q[columns + 1])
    if part is not None:
        y, q = (_part(ends, place, count) for ends, place, count in zip((y, q), part, _PARTS))
    p = y + q * clock.shear
    f, bad, _ = evaluate(setting.tape, [Interval.point(np.zeros(len(rows))), p, q])
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
    found = []
    for side in (0, 1):
        if math.isfinite(ends[1][side]):
            here = passing(
                ends, setting.tape, (tube[0][hit], tube[1][hit]), y + q * clock.shear, blocks.strays.bow[hit] > 0, side
            )
            place, paid = np.zeros(usable.shape, dtype=int), np.zeros(usable.shape, dtype=bool)
            place[hit], paid[hit] = np.arange(len(hit[0])), here.known
            found.append(Way(ends=ends[0], found=here, place=place, paid=paid))
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
            each = [_starts_in(setting, clock, frame, rows, columns, part) for part in every_part]
            p, q, rates = (concatenate(list(values)) for values in zip(*each))
            corners = np.stack([
                np.concatenate([_between(frame.image[1], rows, columns, part, side) for part in every_part])
                for side in _SIDES
            ])  # fmt: skip
            image = Interval(corners.min(axis=0) - most, corners.max(axis=0) + most)
            due = np.ones(len(p))
            ends = ways[0].ends
            away = np.nextafter(p.lo - ends[1], -np.inf), np.nextafter(ends[0] - p.hi, -np.inf)
            for way in ways:
                if way.paid[i, j]:
                    sign, end = way.found.sign, way.found.end
                    due = np.minimum(due, passed(
                        way.found, int(way.place[i, j]), ((q - end) * sign).lo,
                        _drift(setting, way.found, p).lo, away, rates, (image - end) * sign,
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
    nodal = np.zeros((due.shape[2] + 1, due.shape[3] + 1))
    for a, b in _SIDES:
        place = slice(a, due.shape[2] + a), slice(b, due.shape[3] + b)
        nodal[place] = np.maximum(nodal[place], due[-a, -b])
    lacks = np.zeros(due.shape[2:])
    rows, columns = np.nonzero(due.max(axis=(0, 1)) > 0)
    for part in np.ndindex(*_PARTS):
        least = np.min([_between(nodal, rows, columns, part, side) for side in _SIDES], axis=0)
        lacks[rows, columns] = np.maximum(lacks[rows, columns], due[(*part, rows, columns)] - least * (1 - 1e-12))
    return nodal, lacks
