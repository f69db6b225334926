"""The lower bound for a region with curved walls: what `hypotheses` shows for a box, where paths may still be.

Let O be the region of `walls` within the surface's box. A path is stopped when it reaches the boundary of O, where
V <= what is taken off, or at T; until then it is in O. So Theorem K8-CT needs V <= 0 on closure(O), the reversed
residual inequality there, and W >= e^V at T and on the faces at which the box is only cut, as far as they meet
closure(O). All others by which a path leaves O are limits or obstacles: it fails there (docs/values.md).

V <= 0 on closure(O) up to a wall beyond which V goes on to rise: of a set to stay in, g <= 0 on closure(O), so that
V <= V - mu g there for every mu >= 0; of an obstacle some g_j >= 0, so that V is at most the largest V + mu_j g_j.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from certbound.arrays import Array
from certbound.rigor.intervals import Interval
from certbound.values.continuous.curved.boundaries import Box, Wall, Walls
from certbound.values.continuous.curved.cuts import Cuts, Ends
from certbound.values.continuous.curved.proof import FINER, examine_within, leaning, quartered, tiled
from certbound.values.continuous.hypotheses import Model, Need, Proof, up
from certbound.values.continuous.residual import Patches, value_range
from certbound.values.continuous.surface import Surface

_POSITIVE = float(np.nextafter(0.0, 1.0))  # where V is as much or more no point is in closure(O)
Sides = Sequence[tuple[bool, bool]]


def highest_within(surface: Surface, cuts: Cuts, walls: Walls) -> float:
    """An upper bound of V over closure(O) in the surface's box, at all times; -inf where that is empty.

    Parts of cut cells are looked at closely where V may be above 0 and above what it is on whole cells.
    """
    highest, close = -np.inf, list[Array]()
    for first, last in surface.chunks():
        patches = surface.patches(first, last)
        whole = value_range(patches.take(tiled(cuts.whole, surface, last - first)))[1]
        highest = max(highest, float(whole.max(initial=-np.inf)))
        parts = cuts.parts(patches.take(tiled(cuts.cut, surface, last - first)), last - first)
        close.append(_highest_on_parts(parts, cuts, walls, last - first))
    return max(highest, *(float(one.max(initial=-np.inf)) for one in close))


def _highest_on_parts(parts: Patches, cuts: Cuts, walls: Walls, slabs: int) -> Array:
    """An upper bound of V over what closure(O) has of each part in some slabs."""
    high = value_range(parts)[1]
    due = np.unique(np.flatnonzero(high > 0) % max(len(cuts.cell), 1))  # in some slab
    if not len(due):
        return high
    place = (np.arange(slabs)[:, None] * len(cuts.cell) + due).ravel()
    ends = tuple((left[due], right[due]) for left, right in cuts.ends)
    finer, within = quartered(parts.take(place), ends)
    best = value_range(finer)[1]
    for group, outside in walls.groups:
        best = np.minimum(best, _within_group(finer, within, group, slabs, outside=outside))
    high[place] = best.reshape(-1, FINER).max(axis=1)
    return high


def _within_group(patches: Patches, ends: Ends, group: tuple[Wall, ...], slabs: int, *, outside: bool) -> Array:
    """An upper bound of V where all g <= 0, or where some g >= 0 if the set is to be kept out of."""
    plain = value_range(patches)[1]
    found = []
    for wall in group:
        factors = (0.0, np.inf) if outside else (-np.inf, 0.0)
        (_, most), (least_g, most_g) = leaning(patches, wall, ends, slabs, factors)
        missed = most_g < 0 if outside else least_g > 0
        found.append(np.where(missed, -np.inf, np.minimum(plain, most)))
    return np.asarray(np.max(found, axis=0) if outside else np.min(found, axis=0))


def sunk_within(surface: Surface, cuts: Cuts, walls: Walls) -> Surface:
    """The surface, lowered by what it exceeds V <= 0 by on closure(O).

    Proves: V <= 0 on closure(O) in the box, at all times.
    """
    more = 1e-12
    while (highest := highest_within(surface, cuts, walls)) > 0:
        surface, more = surface.raised(-up(highest) - more), 10 * more
    return surface


def end_within(surface: Surface, cuts: Cuts, cut: Sides) -> float:
    """An upper bound of V where a path in closure(O) ends without having failed: at T, or where the box is only cut."""
    alive = np.zeros(int(np.prod(surface.cells)), dtype=bool)
    alive[cuts.whole] = alive[cuts.cut[cuts.cell]] = True
    alive = alive.reshape(surface.cells)
    highest = float(surface.range_at(-1)[1].max(initial=-np.inf, where=alive))
    for axis, side in itertools.product((0, 1), (0, 1)):
        if cut[axis][side]:
            beside = np.take(alive, -side, axis=axis)
            highest = max(highest, float(surface.face_ranges(axis, side)[1].max(initial=-np.inf, where=beside)))
    return highest


def surely_in(walls: Walls, points: Array) -> Array:
    """Those of some points, shape (N, 2), that surely lie in O."""
    box: Box = (Interval.point(points[:, 0]), Interval.point(points[:, 1]))
    return np.asarray(points[walls.locate(box)[0]])


def seen_within(
    surface: Surface, cuts: Cuts, model: Model, points: Array, negligible: float, cut: Sides
) -> Proof:
    """What the reversed inequality says of V, which is at most 0 on closure(O), but for Q2 (`residual`).

    The ``points`` are starts in O. Where V is above 0 no point is in closure(O), and nothing is asked.
    """
    start, end = float(surface.floor_at(0, points).max(initial=-np.inf)), end_within(surface, cuts, cut)
    need = Need(spare=negligible / float(surface.times[-1]), start=-up(-start), top=_POSITIVE, bottom=end)
    return examine_within(surface, cuts, model, need, upper=False, straight=True)
