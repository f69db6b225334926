"""What the grid's cells pay for paths that meet an obstacle along the coordinates within a step and end beside it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Index, Mask
from certbound.rigor.intervals import Interval
from certbound.values.discrete import evaluate
from certbound.values.grids import over_corners
from certbound.values.semilagrangian.bands import Frame
from certbound.values.semilagrangian.confines import Ends, Wall
from certbound.values.semilagrangian.local_steps import Blocks, Clock
from certbound.values.semilagrangian.noisy_axis import Setting
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
) -> Array:
    """What cells pay, shape (ny - 1, nq - 1). ``starts``: the blocks' first cells, and the number of cells."""
    total = np.zeros(frame.live.shape)
    s = setting.noise * (1 + setting.spread)
    bent = frame.bends[1] * np.diff(frame.y)[:, None] ** 2 + frame.bends[3] * np.diff(frame.q) ** 2
    bent = bent / 8 * (1 + 1e-9) + 1e-14
    low = over_corners(np.minimum, frame.image[1] - frame.radius[1]) - bent
    high = over_corners(np.maximum, frame.image[1] + frame.radius[1]) + bent
    for ways in every:
        for i, j in np.argwhere(np.any([way.paid for way in ways], axis=0)) if ways else ():
            part = slice(starts[0][i], starts[0][i + 1]), slice(starts[1][j], starts[1][j + 1])
            rows, columns = np.nonzero(frame.live[part])
            if not len(rows):
                continue
            rows, columns = rows + part[0].start, columns + part[1].start
            q = Interval(frame.q[columns], frame.q[columns + 1])
            p = Interval(frame.y[rows], frame.y[rows + 1]) + q * clock.shear
            f, bad, _ = evaluate(setting.tape, [Interval.point(np.zeros(len(rows))), p, q])
            rates = Interval(np.where(bad, -np.inf, f.lo[:, 0]), np.where(bad, np.inf, f.hi[:, 0]))
            most = float(blocks.strays.most[1][i, j])
            image = Interval(low[rows, columns] - most, high[rows, columns] + most)
            due = np.ones(len(rows))
            ends = ways[0].ends
            away = np.nextafter(p.lo - ends[1], -np.inf), np.nextafter(ends[0] - p.hi, -np.inf)
            for way in ways:
                if way.paid[i, j]:
                    sign, end = way.found.sign, way.found.end
                    due = np.minimum(due, passed(
                        way.found, int(way.place[i, j]), ((q - end) * sign).lo, away, rates, (image - end) * sign,
                        blocks.covariance[2][i, j], s, clock.step,
                    ))  # fmt: skip
            total[rows, columns] += due
    return total
