"""The grid, the bands and the levels for one length of the steps."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from certbound.arrays import Array, Index, Mask
from certbound.errors import InfeasibleError
from certbound.problem.model import compile_numpy
from certbound.rigor.intervals import Interval
from certbound.rigor.series import ZERO
from certbound.values.discrete import evaluate
from certbound.values.grids import Grid
from certbound.values.scouting import Reached, Scouted
from certbound.values.semilagrangian.backward import Bounds, Layout, bounds_below, levels_above
from certbound.values.semilagrangian.bands import Band, Frame, band_of
from certbound.values.semilagrangian.confines import Wall
from certbound.values.semilagrangian.flows import flow, sheared
from certbound.values.semilagrangian.local_steps import (
    SHORT,
    Blocks,
    Clock,
    Plan,
    axes_of,
    base_of,
    blocks_of,
    height_on,
)
from certbound.values.semilagrangian.mirrors import mirrors_of
from certbound.values.semilagrangian.noisy_axis import Setting
from certbound.values.semilagrangian.obstacles import Way, catches_of, tolls_of, ways_past
from certbound.values.semilagrangian.remainders import bowed, level_of
from certbound.watch import poll

_BLOCKS = (90, 40)
_ORDERS = (4, 8, 7)  # of Taylor's polynomials in time: for a first look, on blocks, at nodes
_MOST_BANDS = 12
_APART = 0.02  # how far apart the variances of a band's cells may be
_MOST_REACH = 6
_TOGETHER, _ALIKE = 8, 0.45
"""Steps that share all but the images of nodes, at most, and how far apart, in deviations of their noise, these are."""

Images = tuple[Array, Array, Mask]


def layouts_of(
    setting: Setting, plan: Plan, scout: Scouted | None = None, seen: Reached | None = None
) -> Iterator[Layout]:
    """Prepare the steps, the last one first; of models that change with time a few at once.

    Blocks in which paths are not ``seen`` are not stepped.

    Raises
    ------
    InfeasibleError
        The noise hardly reaches the other coordinate, so that steps along the flow have nothing to smooth with.
    """
    clock = _clock(setting, plan)
    axes = axes_of(setting, clock, plan, _rough(setting, clock), scout)
    if not setting.timed:
        yield from _prepared(setting, clock, axes, [clock.begin], seen, slice(None)) * plan.count
        return
    begins = [Interval.point(clock.step) * float(k) for k in range(plan.count)]
    size = together(setting, plan.count)
    for last in range(plan.count, 0, -size):
        first = max(last - size, 0)
        part, when = begins[first:last], slice(first, last + 1)  # with the end: all that is not stepped counts there
        yield from reversed(_prepared(setting, replace(clock, begin=_hull(part)), axes, part, seen, when))


def together(setting: Setting, count: int) -> int:
    """How many of so many steps of a model that changes with time are prepared at once."""
    step, model = setting.horizon / count, compile_numpy(setting.tape)
    grid = [part.ravel() for part in np.meshgrid(*(np.linspace(*ends, 9) for ends in setting.faces))]
    with np.errstate(all="ignore"):
        rates = [np.broadcast_to(model(k * step, *grid), (grid[0].size, 2))[:, 1] for k in range(count)]
    limit = _ALIKE * setting.noise / math.sqrt(step)
    for size in range(min(_TOGETHER, count), 1, -1):
        swings = np.ptp(sliding_window_view(np.array(rates), size, axis=0), axis=-1)
        if np.nan_to_num(swings).max() <= limit:
            return size
    return 1


def _hull(times: list[Interval]) -> Interval:
    return Interval(float(times[0].lo), float(times[-1].hi))


def _prepared(
    setting: Setting, clock: Clock, axes: tuple[Array, Array], begins: list[Interval], seen: Reached | None, when: slice
) -> list[Layout]:
    """One layout for each of the steps' begins; ``clock.begin`` holds them all, ``when`` their places and the end."""
    p, q = setting.faces
    index, edges = zip(*(_chunks(axis, count) for axis, count in zip(axes, _BLOCKS)))
    within = _inside(clock.shear, edges[0], edges[1], p, q, whole=False)
    if seen is not None:
        within &= _any_of(seen.cells(*axes, clock.shear, when), (index[0], index[1]))
    blocks = blocks_of(setting, clock, edges[0], edges[1], order=_ORDERS[1], wanted=within)
    usable = blocks.known & _gentle(blocks, clock, axes)
    marked = _marked(setting, clock, axes, blocks, usable, (index[0], index[1]), (edges[0], edges[1]))
    live = ~marked.broken & marked.boxed & usable[np.ix_(*index)]
    images = [_images(setting, replace(clock, begin=begin), *axes, live) for begin in begins]
    frame = _frame(_around(images), clock, axes, blocks, usable, (index[0], index[1]), live)
    bands, live = _bands(frame, blocks, usable, (index[0], index[1]), (edges[0], edges[1]), clock)
    frame = replace(frame, live=live)
    reach = _reach(blocks, clock, usable, axes)
    above, below, beyond = mirrors_of(setting, clock, axes, blocks, usable)
    level = np.maximum(levels_above(marked.safe & live, marked.crossed), beyond)
    everywhere = np.ones(level.shape, dtype=bool)
    known = setting, clock, frame, blocks, (_starts(index[0]), _starts(index[1])), marked.ways
    layout = Layout(
        clock=clock, frame=frame, bands=bands,
        above=Bounds(
            level=level, fixed=level > 0, free=everywhere, reach=reach, mirrors=above, paid=marked.bent,
            tolls=tolls_of(*known),
        ),
        below=bounds_below(live, marked.broken, reach, below, catches_of(*known)),
    )  # fmt: skip
    return [replace(layout, frame=replace(frame, image=image, radius=radius)) for image, radius, _ in images]


def nodes_of(setting: Setting, plan: Plan, scout: Scouted | None = None) -> int:
    """How many nodes the grid of a plan has, found at a fraction of the cost of `layouts_of`.

    Raises
    ------
    InfeasibleError
        As for `layouts_of`.
    """
    clock = _clock(setting, plan)
    y, q = axes_of(setting, clock, plan, _rough(setting, clock), scout)
    return len(y) * len(q)


def _clock(setting: Setting, plan: Plan) -> Clock:
    omega = level_of(plan.spare)
    step = setting.horizon / plan.count
    whole = Interval(0.0, setting.horizon) if setting.timed else ZERO
    first = Clock(step=step * (1 + 1e-15), count=plan.count, shear=step / 2, omega=omega, begin=whole)
    blocks = _rough(setting, replace(first, shear=0.0))
    known = blocks.known
    ratio = blocks.covariance[1].mid[known] / blocks.covariance[2].mid[known]
    return replace(first, shear=float(np.median(ratio)))


def _rough(setting: Setting, clock: Clock) -> Blocks:
    """Blocks over the safe set's bounding box in (y, q); InfeasibleError where none is known."""
    (p0, p1), (q0, q1) = setting.faces
    away = sorted((clock.shear * q0, clock.shear * q1))
    ends = np.linspace(p0 - away[1], p1 - away[0], 21), np.linspace(q0, q1, 15)
    blocks = blocks_of(setting, clock, *ends, order=_ORDERS[0])
    if not blocks.known.any():
        raise InfeasibleError(
            "the model is undefined, or steps of this length cannot be enclosed; value functions prove nothing here."
        )
    return blocks


def _chunks(axis: Array, count: int) -> tuple[Index, Array]:
    """Block of every cell, and the blocks' edges."""
    cells = len(axis) - 1
    share = (np.arange(cells) / cells + (axis[:-1] - axis[0]) / (axis[-1] - axis[0])) / 2
    index = np.unique(np.floor(share * count), return_inverse=True)[1].reshape(-1)
    edges = axis[np.append(np.flatnonzero(np.diff(index, prepend=-1)), cells)]
    return index, edges


def _inside(
    shear: float, y: Array, q: Array, p_ends: tuple[float, float], q_ends: tuple[float, float], *, whole: bool
) -> Mask:
    """Boxes of y x q all of which (or some of which) lie in p_ends x q_ends."""
    ends = Interval(q[:-1], q[1:])
    p = Interval(y[:-1], y[1:])[:, None] + (ends * shear)[None]
    if whole:
        fine = (ends.lo >= q_ends[0]) & (ends.hi <= q_ends[1])
        return np.asarray((p.lo >= p_ends[0]) & (p.hi <= p_ends[1]) & fine[None])
    fine = (ends.hi > q_ends[0]) & (ends.lo < q_ends[1])
    return np.asarray((p.hi >= p_ends[0]) & (p.lo <= p_ends[1]) & fine[None])


def _gentle(blocks: Blocks, clock: Clock, axes: tuple[Array, Array]) -> Mask:
    """Blocks whose remainder reaches a few cells at most."""
    most = blocks.strays.most
    reach = (most[0] + abs(clock.shear) * most[1], most[1])
    fine = [r <= _MOST_REACH * np.diff(axis).min() for r, axis in zip(reach, axes)]
    return np.asarray(fine[0] & fine[1])


def _reach(blocks: Blocks, clock: Clock, usable: Mask, axes: tuple[Array, Array]) -> tuple[int, int]:
    most = blocks.strays.most
    reach = (most[0] + abs(clock.shear) * most[1], most[1])
    farthest = [float(np.where(usable, r, 0.0).max()) / float(np.diff(axis).min()) for r, axis in zip(reach, axes)]
    return math.ceil(farthest[0] * 1.000001), math.ceil(farthest[1] * 1.000001)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class _Marks:
    """What is known of the cells, shape (ny - 1, nq - 1) each.

    ``safe``: they lie in the safe set, far enough from p's faces; ``broken``: no point of theirs is safe; ``boxed``:
    within the box, or across its end where that is a limit; ``crossed``: a path may end there that has met a wall;
    ``bent`` bounds the probability that a path leaves through a face of p within the step and ends far enough inside;
    ``ways`` tell of the blocks from which an obstacle may be passed like that, wall by wall.
    """

    safe: Mask
    broken: Mask
    boxed: Mask
    crossed: Mask
    bent: Array
    ways: list[list[Way]]


def _marked(
    setting: Setting, clock: Clock, axes: tuple[Array, Array], blocks: Blocks, usable: Mask, index: tuple[Index, Index],
    edges: tuple[Array, Array],
) -> _Marks:  # fmt: skip
    y, q = axes
    p, faces = setting.faces
    strays, bows = _strays(blocks, usable, p)
    dip = [stray + SHORT * bow for stray, bow in zip(strays, bows)]
    ends = Interval(q[:-1], q[1:])
    places = Interval(y[:-1], y[1:])[:, None] + (ends * clock.shear)[None]
    heights = ends[None].broadcast_to(places.shape)
    safe = (places.lo >= p[0] + dip[0]) & (places.hi <= p[1] - dip[1]) & (ends.lo >= faces[0]) & (ends.hi <= faces[1])
    past, over = setting.beyond
    broken = (places.hi <= past[0]) | (places.lo >= past[1]) | (heights.hi <= over[0]) | (heights.lo >= over[1])
    boxed = (ends.lo >= faces[0]) & (ends.hi <= faces[1])
    boxed = boxed & ((places.lo >= p[0]) | math.isfinite(past[0])) & ((places.hi <= p[1]) | math.isfinite(past[1]))
    crossed = np.zeros(safe.shape, dtype=bool)
    nowhere = np.zeros((1, 1))
    every, measured = [], [wall.sizes(places.reshape(-1), heights.reshape(-1)) for wall in setting.walls]
    for wall, sizes in zip(setting.walls, measured):
        safe &= wall.safe(sizes, nowhere).reshape(safe.shape)
        broken |= wall.broken(sizes).reshape(safe.shape)
    asked = usable & _any_of(safe, index)
    for wall, sizes in zip(setting.walls, measured):
        ways = ways_past(setting, clock, blocks, asked, edges, wall)
        paid = np.any([way.paid for way in ways], axis=0) if ways else np.zeros_like(usable)
        every.append(ways)
        margins = _near_wall(setting, clock, axes, blocks, asked & ~paid, wall)
        near = np.isfinite(margins[0])
        kept = wall.safe(sizes, np.where(near, margins, 0.0).reshape(len(margins), -1)).reshape(safe.shape)
        crossed |= near & ~kept
    bent = np.zeros(safe.shape)
    for away, stray, bow in zip((places.lo - p[0], p[1] - places.hi), strays, bows):
        bent += _bent((away - stray) / bow) if bow > 0 else 0.0
    return _Marks(safe=safe, broken=broken, boxed=np.asarray(boxed), crossed=crossed, bent=bent, ways=every)


def _bent(near: Array) -> Array:
    """`bowed` of the largest number of a table that is not above ``near``, from `SHORT` on."""
    table = np.geomspace(SHORT, 80 * SHORT, 150)
    return np.asarray(bowed(table, SHORT)[np.clip(np.searchsorted(table, near, side="right") - 1, 0, None)])


def _starts(index: Index) -> Index:
    """The first cell of every block, and the number of cells."""
    return np.append(np.flatnonzero(np.diff(index, prepend=-1)), len(index))


def _any_of(cells: Mask, index: tuple[Index, Index]) -> Mask:
    """Blocks some of whose cells are among these."""
    first = [_starts(part)[:-1] for part in index]
    return np.asarray(np.logical_or.reduceat(np.logical_or.reduceat(cells, first[0]), first[1], axis=1))


def _near_wall(
    setting: Setting, clock: Clock, axes: tuple[Array, Array], blocks: Blocks, usable: Mask, wall: Wall
) -> Array:
    """Largest margins of the paths that may meet a wall in a step and end in a cell, (m, ...); -inf where none does."""
    y, q = axes
    hit = np.nonzero(usable)
    tube = tuple(part[hit] for part in blocks.strays.tube)
    sizes = wall.sizes(*tube)
    meets = ~wall.safe(sizes, np.zeros((1, 1)))
    hit = tuple(index[meets] for index in hit)
    tube = tuple(part[meets] for part in tube)
    f, undefined, _ = evaluate(setting.tape, [clock.times, *tube])
    low, high = np.where(undefined, -np.inf, f.lo.T), np.where(undefined, np.inf, f.hi.T)
    rates = Interval(low[0], high[0]), Interval(low[1], high[1])
    margins = wall.margins((tube[0], tube[1]), rates, clock.step, setting.noise * (1 + setting.spread))
    around = tube[0] - tube[1] * clock.shear
    found = np.full((sizes.shape[1], len(y) - 1, len(q) - 1), -np.inf)
    ends = [
        (np.searchsorted(axis, part.lo, side="right") - 1, np.searchsorted(axis, part.hi))
        for axis, part in ((y, around), (q, tube[1]))
    ]
    for k in range(len(hit[0])):
        part = tuple(slice(max(int(first[k]), 0), int(last[k])) for first, last in ends)
        found[(slice(None), *part)] = np.maximum(found[(slice(None), *part)], margins[:, k, None, None])
    return found


def _frame(
    images: Images, clock: Clock, axes: tuple[Array, Array], blocks: Blocks, usable: Mask,
    index: tuple[Index, Index], live: Mask,
) -> Frame:  # fmt: skip
    (y, q), spread = axes, np.ix_(*index)
    (image, radius, known), mean = images, blocks.strays.mean
    drift = np.stack([mean[0] + abs(clock.shear) * mean[1], mean[1]])
    zero = np.where(usable, 1.0, 0.0)
    return Frame(
        y=y, q=q, image=image, radius=radius, slopes=(blocks.slopes * zero)[:, spread[0], spread[1]],
        bends=(blocks.bends * zero)[:, spread[0], spread[1]], drift=(drift * zero)[:, spread[0], spread[1]],
        live=live & known,
    )  # fmt: skip


def _strays(blocks: Blocks, usable: Mask, p: tuple[float, float]) -> tuple[list[float], list[float]]:
    """The largest dips below (above) chords, and bows, of the blocks from which a path may meet p's faces."""
    low, high = blocks.strays.tube[0].lo, blocks.strays.tube[0].hi
    near = (usable & (low <= p[0]), usable & (high >= p[1]))
    dips = [float(np.where(keep, dip, 0.0).max()) for keep, dip in zip(near, blocks.strays.dip)]
    return dips, [float(np.where(keep, blocks.strays.bow, 0.0).max()) for keep in near]


def _around(images: list[Images]) -> Images:
    """Images of several steps in one: what holds for its radii, twice as large as needed, holds for each."""
    if len(images) == 1:
        return images[0]
    low = np.minimum.reduce([image - radius for image, radius, _ in images])
    high = np.maximum.reduce([image + radius for image, radius, _ in images])
    middle = (low + high) / 2
    return middle, (high - low) * (1 + 1e-9) + 4e-16 * np.abs(middle), np.logical_and.reduce([one[2] for one in images])


def _images(setting: Setting, clock: Clock, y: Array, q: Array, live: Mask) -> Images:
    """Images of the nodes of live cells, their radii, and the cells all of whose nodes are known."""
    grid = Grid(axes=(y, q))
    touched = np.zeros(grid.node_shape, dtype=bool)
    sides = [(a, b) for a in (slice(None, -1), slice(1, None)) for b in (slice(None, -1), slice(1, None))]
    for a, b in sides:
        touched[a, b] |= live
    place = np.nonzero(touched)
    tape = sheared(setting.tape, clock.shear)
    flown = flow(tape, [Interval.point(y[place[0]]), Interval.point(q[place[1]])], clock.step, _ORDERS[2], clock.begin)
    image, radius = np.zeros((2, *touched.shape)), np.zeros((2, *touched.shape))
    known = np.zeros(touched.shape, dtype=bool)
    known[place] = flown.known
    for axis in range(2):
        image[axis][place] = flown.end[axis].mid
        radius[axis][place] = flown.end[axis].rad
    return image, radius, np.logical_and.reduce([known[a, b] for a, b in sides])


def _bands(
    frame: Frame, blocks: Blocks, usable: Mask, index: tuple[Index, Index], edges: tuple[Array, Array], clock: Clock
) -> tuple[list[Band], Mask]:
    """Bands within which the covariance changes little, and the cells for which a band was found."""
    height = height_on(blocks, edges, index, (frame.y, frame.q))
    live = np.zeros_like(frame.live)
    bands = []
    for first, last in _groups(blocks, usable):
        poll("grids along the flow")
        part = usable.copy()
        part[:first] = False
        part[last:] = False
        base = base_of(blocks, part)
        cells = np.flatnonzero((index[0] >= first) & (index[0] < last))
        a, b = int(cells[0]), int(cells[-1]) + 1
        spread = np.ix_(index[0][a:b], index[1])
        alive = frame.live[a:b] & base.known[spread]
        if not alive.any():
            continue
        excess = np.where(alive, base.excess[:, spread[0], spread[1]], 0.0)
        band = band_of(frame, a, b, base, excess, height[a:b], alive, clock.omega)
        live[a:b] = band.live
        bands.append(band)
    return bands, live


def _groups(blocks: Blocks, usable: Mask) -> list[tuple[int, int]]:
    """Rows of blocks, taken together while S_qq differs by little; at most `_MOST_BANDS` groups."""
    qq = blocks.covariance[2].mid
    rows = np.flatnonzero(usable.any(axis=1))
    if not len(rows):
        raise InfeasibleError("no part of the safe set could be followed over a step; value functions prove nothing.")
    middle = np.array([float(np.median(line[keep])) if keep.any() else 0.0 for line, keep in zip(qq, usable)])
    tolerance = _APART
    while True:
        groups: list[tuple[int, int]] = []
        start, least, most = int(rows[0]), np.inf, -np.inf
        for row in range(int(rows[0]), int(rows[-1]) + 1):
            if not usable[row].any():
                continue
            a, b = min(least, middle[row]), max(most, middle[row])
            if b > a * (1 + tolerance) and row > start:
                groups.append((start, row))
                start, a, b = row, middle[row], middle[row]
            least, most = a, b
        groups.append((start, int(rows[-1]) + 1))
        if len(groups) <= _MOST_BANDS:
            return groups
        tolerance *= 1.5
