"""Backward induction over the steps: a function above the probability of failing from every state."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from certbound.arrays import Array, Mask
from certbound.values.grids import around_nodes, corners, over_corners
from certbound.values.scouting import Reached
from certbound.values.semilagrangian.bands import NOWHERE, Band, Frame, narrowed, through
from certbound.values.semilagrangian.confines import TWICE
from certbound.values.semilagrangian.local_steps import Clock
from certbound.values.semilagrangian.mirrors import Mirror
from certbound.values.semilagrangian.noisy_axis import Setting
from certbound.values.semilagrangian.obstacles import Catch, Toll
from certbound.values.semilagrangian.smoothing import Lines

_SLICES = 16  # of a column of cells, over which starts are gone through: a ball is a box over each


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Bounds:
    """What the function must be at least where steps do not say it.

    An upper bound U is stepped as it is, and a lower bound L as -L: both must lie above something.

    Attributes
    ----------
    level : ndarray, shape (ny, nq)
        At nodes; -inf where nothing is asked.
    fixed : ndarray of bool, shape (ny, nq)
        Nodes around which the function must lie above its chords as well.
    free : ndarray of bool, shape (ny, nq)
        Nodes that mirrors may set.
    reach : (int, int)
        How far remainders reach, in cells.
    mirrors : sequence of Mirror
    below : bool
        Whether this is about -L.
    paid : ndarray, shape (ny - 1, nq - 1), or 0
        What every cell pays besides in a step.
    tolls : sequence of Toll
        What is paid for obstacles.
    catches : sequence of Catch
        What cells are paid (-L).
    """

    level: Array
    fixed: Mask
    free: Mask
    reach: tuple[int, int]
    mirrors: Sequence[Mirror] = ()
    below: bool = False
    paid: Array | float = 0.0
    tolls: Sequence[Toll] = ()
    catches: Sequence[Catch] = ()


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Layout:
    """All that an induction needs."""

    clock: Clock
    frame: Frame
    bands: list[Band]
    above: Bounds
    below: Bounds

    def on(self, k: int, seen: Reached) -> Layout:
        """What steps from the k-th time only those cells that paths come to by then."""
        return self.only(seen.cells(self.frame.y, self.frame.q, self.clock.shear, slice(k, k + 1)))

    def only(self, cells: Mask) -> Layout:
        """The same, but no cell is stepped save these: the others count as failing above, as not failing below."""
        left = around_nodes((self.frame.live & ~cells).astype(float), largest=True) > 0
        level = np.where(left, np.maximum(self.above.level, 1.0), self.above.level)
        frame = replace(self.frame, live=self.frame.live & cells)
        return replace(
            self, frame=frame, bands=[part for part in (narrowed(band, frame) for band in self.bands) if part],
            above=replace(self.above, level=level, fixed=self.above.fixed | left),
            below=replace(self.below, level=np.where(left, 0.0, self.below.level), fixed=self.below.fixed | left),
        )  # fmt: skip


def back(frame: Frame, bands: list[Band], bounds: Bounds, value: Lines) -> Lines:
    """One step back.

    Proves: if value >= u_{t+1} in the sense of the module ``semilagrangian``, the returned function is >= u_t.
    """
    slopes = _slopes(frame, value, bounds.reach)
    nodal = np.full_like(value.nodal, NOWHERE)
    bend = np.full_like(value.bend, -np.inf)
    payment = np.zeros(frame.live.shape)
    for band in bands:
        at, curve, paid = through(band, frame, value, slopes)
        nodes = slice(band.first, band.last + 1)
        nodal[nodes] = np.maximum(nodal[nodes], at)
        bend[nodes] = np.maximum(bend[nodes], curve)
        payment[band.first : band.last] = paid
    bend = np.where(np.isfinite(bend), bend, 0.0)
    payment = payment + bounds.paid
    dq = np.diff(frame.q)
    for catch in bounds.catches:
        less, lacks = catch.owed(value.nodal, value.bend, dq)
        nodal, payment = nodal - less, payment + lacks
    for toll in bounds.tolls:
        more, lacks = toll.due(value.nodal, value.bend, dq)
        nodal, payment = nodal + more, payment + lacks
    return limited(frame, bounds, nodal + around_nodes(payment, largest=True), bend)


def limited(frame: Frame, bounds: Bounds, nodal: Array, bend: Array) -> Lines:
    """Raise a function to its levels, and lower it to 1 (-L: to 0) where it is at least that all around.

    In the cells around a node that is lowered no line lies below its chords any more: else between lines the function
    would be less than 1 there, and less than what was stepped.
    """
    cap = 0.0 if bounds.below else 1.0
    raised = np.maximum(nodal, bounds.level)
    fixed = bounds.fixed | (raised > nodal) if bounds.below else bounds.fixed.copy()
    full = np.minimum.reduce(corners(raised)) >= cap
    capped = (around_nodes((~full).astype(float), largest=True) <= 0) & (bounds.level <= cap)
    nodal = np.where(capped, cap, raised)
    sides, beside = fixed[:, :-1] | fixed[:, 1:], over_corners(np.maximum, capped.astype(float)) > 0
    sides[:-1] |= beside
    sides[1:] |= beside
    bend = np.where(sides, np.maximum(bend, 0.0), bend)
    for mirror in bounds.mirrors:
        nodal = _mirrored(mirror, bounds, nodal, bend, np.diff(frame.q))
    return Lines(nodal=nodal, bend=bend)


def _mirrored(mirror: Mirror, bounds: Bounds, nodal: Array, bend: Array, dq: Array) -> Array:
    """Put what lies beyond a face, from what lies inside."""
    found = -mirror.below(-nodal, -bend, dq) if bounds.below else mirror.above(nodal, bend, dq)
    free = bounds.free[:, mirror.places]
    nodal = nodal.copy()
    before = nodal[:, mirror.places]
    found = found if bounds.below else np.maximum(found, before)
    nodal[:, mirror.places] = np.where(free, found, before)
    return nodal


def _slopes(frame: Frame, value: Lines, reach: tuple[int, int]) -> tuple[Array, Array]:
    """Bounds of |d_y U| and |d_q U| on all cells that a remainder may reach from a cell."""
    from scipy.ndimage import maximum_filter

    dy, dq = np.diff(frame.y)[:, None], np.diff(frame.q)
    along_y = np.abs(np.diff(value.nodal, axis=0)) / dy
    first = np.maximum(along_y[:, 1:], along_y[:, :-1]) + np.abs(np.diff(value.bend, axis=0)) / dy * dq**2 / 8
    across = np.abs(np.diff(value.nodal, axis=1)) / dq + np.abs(value.bend) * dq / 2
    second = np.maximum(across[1:], across[:-1])
    size = (2 * reach[0] + 1, 2 * reach[1] + 1)
    one, two = (np.asarray(maximum_filter(part, size, mode="nearest")) for part in (first, second))
    return one * (1 + 1e-9), two * (1 + 1e-9)


def highest(frame: Frame, value: Lines, setting: Setting, shear: float) -> float:
    """Upper bound of the function over the starts."""
    low, high = setting.starts[1]
    best = 0.0
    first = max(int(np.searchsorted(frame.q, low, side="right")) - 1, 0)
    last = min(int(np.searchsorted(frame.q, high)), len(frame.q) - 1)
    for j in range(first, max(last, first + 1)):
        ends = np.linspace(max(low, frame.q[j]), min(high, frame.q[j + 1]), _SLICES + 1)
        for q in itertools.pairwise(ends.tolist()):
            p = setting.starts_between(*q)
            away = sorted((shear * q[0], shear * q[1]))
            slack = 1e-14 * (1 + abs(p[0]) + abs(p[1]))
            y = (p[0] - away[1] - slack, p[1] - away[0] + slack)
            if y[0] < frame.y[0] or y[1] > frame.y[-1]:
                return 1.0
            best = max(best, _over_strip(frame, value, j, q, y))
    return best


def lowest(frame: Frame, value: Lines, points: Array, shear: float) -> float:
    """Least of the function (that is, -L) over a few points of (p, q), shape (N, 2), rounded up."""
    y, q = points[:, 0] - shear * points[:, 1], points[:, 1]
    i = np.clip(np.searchsorted(frame.y, y, side="right") - 1, 0, len(frame.y) - 2)
    j = np.clip(np.searchsorted(frame.q, q, side="right") - 1, 0, len(frame.q) - 2)
    t = np.clip((y - frame.y[i]) / np.diff(frame.y)[i], 0.0, 1.0)
    d = np.diff(frame.q)[j]
    share = np.clip((q - frame.q[j]) / d, 0.0, 1.0)
    arch = d**2 * share * (1 - share) / 2
    low, high = (
        (1 - share) * value.nodal[k, j] + share * value.nodal[k, j + 1] + arch * value.bend[k, j] for k in (i, i + 1)
    )
    found = (1 - t) * low + t * high
    sizes = [np.abs(value.nodal[i + a, j + b]) for a in (0, 1) for b in (0, 1)]
    error = 1e-12 * (np.maximum.reduce(sizes) + arch * np.abs(value.bend[i, j])) * (1 + 1 / np.diff(frame.y)[i] + 1 / d)
    inside = (y > frame.y[0]) & (y < frame.y[-1]) & (q > frame.q[0]) & (q < frame.q[-1])
    return float(np.where(inside, found + error, 0.0).min())


def _over_strip(frame: Frame, value: Lines, j: int, q: tuple[float, float], y: tuple[float, float]) -> float:
    """Largest value over part of a column of cells: bilinear parts at corners, parabolas at their tops."""
    d = frame.q[j + 1] - frame.q[j]
    share = [min(max((end - frame.q[j]) / d, 0.0), 1.0) for end in q]
    lines = np.stack([(1 - s) * value.nodal[:, j] + s * value.nodal[:, j + 1] for s in share])
    arch = np.maximum(value.bend[:, j], 0.0) * d**2 / 8
    inside = (frame.y >= y[0]) & (frame.y <= y[1])
    ends = [np.interp(end, frame.y, line + arch) for end in y for line in lines]
    return float(max(*ends, (lines + arch)[:, inside].max(initial=0.0))) * (1 + 1e-12)


def levels_above(safe: Mask, crossed: Mask) -> Array:
    """Least values at nodes: 1 at corners of cells not surely safe, more where a wall may have been crossed.

    ``safe`` and ``crossed``, shape (ny - 1, nq - 1): cells that lie in the safe set, and cells near walls.
    """
    outside = around_nodes((~safe).astype(float), largest=True)
    beyond = around_nodes(crossed.astype(float), largest=True)
    return np.where(beyond > 0, TWICE, np.where(outside > 0, 1.0, 0.0))


def bounds_below(
    live: Mask, broken: Mask, reach: tuple[int, int], mirrors: Sequence[Mirror], catches: Sequence[Catch]
) -> Bounds:
    """What -L must be at least: -1 where all around is surely broken or stepped, 0 where nothing is known."""
    unknown = around_nodes((~live & ~broken).astype(float), largest=True) > 0
    stepped = around_nodes(live.astype(float), largest=True) > 0
    return Bounds(
        level=np.where(unknown, 0.0, -1.0), fixed=unknown, free=~unknown & ~stepped, reach=reach, mirrors=mirrors,
        below=True, catches=catches,
    )  # fmt: skip
