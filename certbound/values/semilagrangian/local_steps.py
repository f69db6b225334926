"""One step from coarse boxes: the flow's derivatives, the covariance, the remainder, by blocks; the axes for it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from certbound.arrays import Array, Index, Mask
from certbound.errors import InfeasibleError
from certbound.rigor.intervals import Interval, concatenate, sq
from certbound.rigor.series import ZERO
from certbound.values.grids import graded_axis
from certbound.values.scouting import Scouted
from certbound.values.semilagrangian.confines import Ends
from certbound.values.semilagrangian.flows import EQUATIONS, augmented, during, flow, sheared
from certbound.values.semilagrangian.noisy_axis import Setting
from certbound.values.semilagrangian.remainders import Remainders, remainders


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Plan:
    """How fine: steps, and the cells' sizes.

    Attributes
    ----------
    count : int
        Steps.
    fine, wide : float
        Cells along y at the faces, in units of sigma_y, and the most anywhere, in units of the safe set's width.
    cell : float
        Cells along q, in units of sigma_q.
    loss : float
        Share of the answer that interpolation along y may add, where paths were scouted; ``wide`` is not asked then.
    spare : float
        Probability per step that may be paid for each rare event.
    """

    count: int
    fine: float
    wide: float
    cell: float
    spare: float
    loss: float = 0.04


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Clock:
    """One step: its length h, the shear, the level of the noise that is followed (``remainders``), when it begins."""

    step: float
    count: int
    shear: float
    omega: float
    begin: Interval = field(default_factory=lambda: ZERO)

    @property
    def times(self) -> Interval:
        """All times of the step."""
        return during(self.begin, self.step)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Blocks:
    """What is known of a step from boxes of (y, q), all of shape (blocks of y, blocks of q).

    Attributes
    ----------
    image : (Interval, Interval)
        Of the flow, in (y, q).
    slopes : ndarray, shape (4, ...)
        Ranges of d_y y and d_y q.
    bends : ndarray, shape (4, ...)
        |d_yy y|, |d_yy q|, |d_qq y|, |d_qq q|.
    covariance : (Interval, Interval, Interval)
        S_yy, S_yq, S_qq.
    tilted : (Interval, Interval, Interval)
        S_qq in the box's middle, and its derivatives by y and q over the box.
    strays : Remainders
        In (p, q).
    known : ndarray of bool
    """

    image: tuple[Interval, Interval]
    slopes: Array
    bends: Array
    covariance: tuple[Interval, Interval, Interval]
    tilted: tuple[Interval, Interval, Interval]
    strays: Remainders
    known: Mask


def blocks_of(
    setting: Setting, clock: Clock, y: Array, q: Array, *, order: int, wanted: Mask | None = None
) -> Blocks:
    """Enclose one step from every box of the grid y x q (from those ``wanted``; nothing is known of the others)."""
    low = np.meshgrid(y[:-1], q[:-1], indexing="ij")
    high = np.meshgrid(y[1:], q[1:], indexing="ij")
    shape = low[0].shape
    keep = np.ones(shape, dtype=bool) if wanted is None else wanted
    box = [Interval(a[keep], b[keep]) for a, b in zip(low, high)]
    size = int(keep.sum())
    middle = [Interval.point(value.mid) for value in box]
    both = [concatenate([value, point]) for value, point in zip(box, middle)]  # boxes and their middles in one go
    zero, one = Interval.point(np.zeros(2 * size)), Interval.point(np.ones(2 * size))
    tape = augmented(sheared(setting.tape, clock.shear), setting.noise, clock.shear)
    rest = [one, zero, zero, one, *[zero] * (EQUATIONS - 6)]
    flown = flow(tape, [*both, *rest], clock.step, order, clock.begin)
    end, centre = [value[:size] for value in flown.end], [value[size:] for value in flown.end]
    away = [value - point for value, point in zip(box, middle)]
    covariance = [_both(end[k], centre[k] + end[k + 3] * away[0] + end[k + 6] * away[1]) for k in range(10, 13)]
    p = box[0] + box[1] * clock.shear
    strays = remainders(
        setting.tape, setting.noise * (1 + setting.spread), p, box[1], step=clock.step, omega=clock.omega,
        begin=clock.begin,
    )  # fmt: skip
    loose = Interval(1 - 4 * setting.spread - 1e-15, 1 + 4 * setting.spread + 1e-15)

    def filled(part: Array) -> Array:
        whole = np.zeros((*part.shape[:-1], *shape))
        whole[..., keep] = part
        return whole

    def shaped(value: Interval) -> Interval:
        return Interval(filled(value.lo), filled(value.hi))

    known = flown.known[:size] & flown.known[size:] & strays.known
    return Blocks(
        image=(shaped(end[0]), shaped(end[1])),
        slopes=filled(np.stack([getattr(end[k], side) for k in (2, 3) for side in ("lo", "hi")])),
        bends=filled(np.stack([end[k].mag for k in range(6, 10)])),
        covariance=tuple(shaped(value * loose) for value in covariance),  # type: ignore[arg-type]
        tilted=tuple(shaped(value * loose) for value in (centre[12], end[15], end[18])),  # type: ignore[arg-type]
        strays=_filled(strays, filled), known=filled(known.astype(float)) > 0,
    )  # fmt: skip


def _filled(strays: Remainders, filled: Callable[[Array], Array]) -> Remainders:
    p, q = (Interval(filled(part.lo), filled(part.hi)) for part in strays.tube)
    return replace(
        strays, most=filled(strays.most), mean=filled(strays.mean), dip=filled(strays.dip),
        bow=filled(strays.bow), inward=filled(strays.inward), tube=(p, q),
    )  # fmt: skip


def _both(one: Interval, other: Interval) -> Interval:
    """The intersection of two enclosures of the same thing."""
    low, high = np.maximum(one.lo, other.lo), np.minimum(one.hi, other.hi)
    return Interval(np.minimum(low, high), high)


def height_on(
    blocks: Blocks, edges: tuple[Array, Array], index: tuple[Index, Index], axes: tuple[Array, Array]
) -> Interval:
    """S_qq on cells of finer axes, shape (len(y) - 1, len(q) - 1): its mean-value form about the blocks' middles."""
    spread = np.ix_(*index)
    found, by_y, by_q = (part[spread] for part in blocks.tilted)
    places = [
        Interval(axis[:-1], axis[1:]) - Interval.point(Interval(edge[:-1], edge[1:]).mid[block])
        for axis, edge, block in zip(axes, edges, index)
    ]
    found = found + by_y * places[0][:, None] + by_q * places[1][None]
    return _both(found, blocks.covariance[2][spread])


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Base:
    """The noise of y that a band's kernels are made for: D = S - diag(sigma_y^2, v) >= 0 on ``known`` blocks, if v is
    at most S_qq less ``tilt``.

    ``excess`` holds upper bounds of D_yy, |D_yq|, and the tilt D_yq^2/D_yy, shape (3, blocks of y, blocks of q).
    """

    sigma: float
    excess: Array
    known: Mask


def base_of(blocks: Blocks, known: Mask) -> Base:
    """About the largest such law, given up on the few blocks where the covariance is most uncertain."""
    yy, yq, qq = blocks.covariance
    with np.errstate(all="ignore"):
        tilt = np.where(known & (yy.lo > 0), yq.mag / np.sqrt(np.maximum(yy.lo, 1e-300) * qq.lo), np.inf)
    limit = max(0.02, 4 * float(np.median(tilt[known])))
    known = known & (tilt <= min(limit, 0.3))
    if not known.any():
        return Base(sigma=1.0, excess=np.zeros((3, *known.shape)), known=known)
    share = 4.2 * min(float(tilt[known].max()), 0.2) + 1e-6
    sigma = math.sqrt(float(yy.lo[known].min()) * (1 - share))
    first = yy - sq(Interval.point(sigma))
    fine = first.lo > 0
    least = sq(yq) / Interval.point(np.where(fine, first.lo, 1.0))
    return Base(sigma=sigma, excess=np.stack([first.hi, yq.mag, least.hi]), known=known & fine)


SHORT = 0.3
"""Standard bows of the noise by which p's faces move inward; larger ones are paid."""
_MIRRORED = 6.0  # standard deviations beyond q's faces over which nodes are mirror images
_COARSEST = (0.02, 2.5)  # cells along y over the width of the safe set, along q over the finest
_GRADING = 0.12
_BESIDE, _FINER = 1.5, 0.33  # deviations of q's noise beside an obstacle's end, and how much finer cells are there
_SEEN = 1e-3  # a share of the visits that is worth fine cells
_MOST_LINES = 200_000


def axes_of(
    setting: Setting, clock: Clock, plan: Plan, rough: Blocks, scout: Scouted | None = None
) -> tuple[Array, Array]:
    """The grid's nodes along y and q: fine at p's faces, and where `scout` saw paths that fail.

    Raises
    ------
    InfeasibleError
        The noise hardly reaches p.
    """
    (p0, p1), (q0, q1) = setting.faces
    known = rough.known
    yy, qq = rough.covariance[0].mid, rough.covariance[2].mid
    sigma = math.sqrt(max(float(np.median(yy[known])), 0.0)), math.sqrt(float(np.median(qq[known])))
    if not sigma[0] > 1e-7 * (p1 - p0):
        raise InfeasibleError(
            "the noise hardly reaches the coordinate without noise; value functions prove nothing here."
        )
    dip = rough.strays.dip[:, known] + SHORT * rough.strays.bow[known]
    p0, p1 = p0 + float(np.median(dip[0])), p1 - float(np.median(dip[1]))
    away = sorted((clock.shear * q0, clock.shear * q1))
    tube = rough.strays.tube
    ends = [float(tube[0].lo[known].min()), float(tube[0].hi[known].max())]
    tall = [float(tube[1].lo[known].min()), float(tube[1].hi[known].max())]
    slant = sorted((clock.shear * tall[0], clock.shear * tall[1]))
    low = min(ends[0] - slant[1], p0 - away[1]) - 13 * sigma[0]
    high = max(ends[1] - slant[0], p1 - away[0]) + 13 * sigma[0]
    places = np.linspace(low, high, 4001)
    gap = np.full(len(places), np.inf)
    for end, slant in _upright(setting, clock.shear, (p0, p1), scout):
        gap = np.minimum(gap, np.maximum(np.maximum(end - slant[1] - places, places - end + slant[0]), 0.0))
    wanted = np.minimum(plan.fine * sigma[0] + 0.1 * gap, plan.wide * (p1 - p0))
    widths = np.full(2, plan.cell * sigma[1])
    if scout is not None:
        wanted = np.minimum(plan.fine * sigma[0] + 0.1 * gap, _along_y(scout, clock, plan, places, sigma[0]))
        wanted = _graded(places, np.clip(wanted, 0.5 * plan.fine * sigma[0], _COARSEST[0] * (p1 - p0)))
        widths = plan.cell * sigma[1] * _along_q(scout, np.linspace(q0, q1, 401))
    y = _nodes(places, np.maximum(wanted, 1e-12))
    core = _core(setting, (q0, q1), widths, _FINER * plan.cell * sigma[1], _BESIDE * sigma[1], scout)
    beyond = 11 * sigma[1] + max(q0 - tall[0], tall[1] - q1, 0.0)
    left, right = (_outward(depths, sigma[1], plan.cell, beyond) for depths in (core - q0, (q1 - core)[::-1]))
    return y, np.concatenate([q0 - left[::-1], core, q1 + right])


def _core(
    setting: Setting, faces: Ends, widths: Array, fine: float, near: float, scout: Scouted | None
) -> Array:
    """Nodes of q within the box: ends of obstacles where paths fail, with cells ``fine`` up to ``near`` beside them."""
    (q0, q1), ends = faces, []
    for p, along in filter(None, (wall.ends() for wall in setting.walls)):
        for end in along:
            seen = math.inf
            if scout is not None:
                beside = (np.abs(scout.q - end) <= 2 * scout.cells[1]) & (scout.p >= p[0]) & (scout.p <= p[1])
                seen = float(np.where(beside, scout.visits, 0.0).max()) / float(scout.visits.max())
            ends += [end] if q0 < end < q1 and seen > _SEEN else []
    if not ends:
        return _nodes(np.linspace(q0, q1, len(widths)), widths, 8)
    places = np.linspace(q0, q1, 4001)
    widths = np.interp(places, np.linspace(q0, q1, len(widths)), widths)
    for end in ends:
        widths = np.minimum(widths, fine + _GRADING * np.maximum(np.abs(places - end) - near, 0.0))
    return graded_axis(q0, q1, places, widths, ends)


def _outward(depths: Array, sigma: float, cell: float, beyond: float) -> Array:
    """Distances of nodes beyond a face of q: mirror images of those inside, and coarser ones."""
    near = depths[1 : int(np.searchsorted(depths, _MIRRORED * sigma)) + 1]
    steps = near[-1] + np.cumsum(np.minimum(cell * 1.35 ** np.arange(1, 60), 1.6)) * sigma
    return np.concatenate([near, steps[: int(np.searchsorted(steps, beyond)) + 1]])


def _nodes(places: Array, widths: Array, least: int = 1) -> Array:
    """Nodes from the first place to the last at about these distances."""
    count = np.concatenate([[0.0], np.cumsum((1 / widths[1:] + 1 / widths[:-1]) / 2 * np.diff(places))])
    if not count[-1] < _MOST_LINES:  # where paths stray within a step about as far as the safe set is wide, say
        raise InfeasibleError(f"a grid would have more than {_MOST_LINES} lines; value functions prove nothing here.")
    nodes = np.interp(np.linspace(0, count[-1], max(least, math.ceil(count[-1])) + 1), count, places)
    nodes[0], nodes[-1] = places[0], places[-1]
    return np.asarray(nodes)


def _graded(places: Array, widths: Array) -> Array:
    """The largest widths below these that change at most at the rate `_GRADING`."""
    rise = _GRADING * places
    forth = np.minimum.accumulate(widths - rise) + rise
    return np.asarray(np.minimum(forth, np.minimum.accumulate((forth + rise)[::-1])[::-1] - rise))


def _along_y(scout: Scouted, clock: Clock, plan: Plan, places: Array, sigma: float) -> Array:
    """Cells that add `Plan.loss` at the least cost: a step adds D^2/12 (d_y log u)^2, so D^-3 goes with its mean."""
    bins = np.linspace(places[0], places[-1], 401)
    width = bins[1] - bins[0]
    share = np.histogram(scout.p - clock.shear * scout.q, bins, weights=scout.steep_p)[0] / width
    reach = max(1, math.ceil((scout.cells[0] + abs(clock.shear) * scout.cells[1] + 2 * sigma) / width))
    share = np.convolve(share, np.full(2 * reach + 1, 1 / (2 * reach + 1)), mode="same")
    share = np.maximum(share, 1e-9 * share.max())
    root = np.cbrt(share)
    found = math.sqrt(12 * plan.loss * clock.step / float(root.sum() * width)) / root
    return np.asarray(np.interp(places, (bins[1:] + bins[:-1]) / 2, found))


def _along_q(scout: Scouted, places: Array) -> Array:
    """Cells relative to the finest: a step adds D^3 |d_q log u|^3 and more, so D goes with its -1/4th power."""
    bins = np.linspace(places[0], places[-1], 41)
    share = np.histogram(scout.q, bins, weights=scout.steep_q)[0]
    share = np.maximum(np.convolve(share, np.full(3, 1 / 3), mode="same"), 1e-9 * share.max())
    found = np.clip((share / share.max()) ** -0.25, 1.0, _COARSEST[1])
    return np.asarray(np.interp(places, (bins[1:] + bins[:-1]) / 2, found))


def _upright(
    setting: Setting, shear: float, ends: Ends, scout: Scouted | None
) -> Iterator[tuple[float, list[float]]]:
    """Places of p where the safe set ends along q, about, each with the range of shear q there (where paths fail)."""
    faces = setting.faces[1]
    found = [(end, faces) for end, limit in zip(ends, setting.beyond[0]) if math.isfinite(limit)]
    for wall in setting.walls:
        hull = wall.hull()
        tall = float(np.clip(hull.lo[1], *faces)), float(np.clip(hull.hi[1], *faces))
        found += [(float(end), tall) for end in (hull.lo[0], hull.hi[0]) if math.isfinite(end)]
    for end, tall in found:
        if scout is not None:
            near = np.where(np.abs(scout.p - end) <= 2 * scout.cells[0], scout.visits, 0.0)
            seen = scout.q[near > _SEEN * scout.visits.max()]
            if not len(seen):
                continue
            tall = max(tall[0], seen.min() - 2 * scout.cells[1]), min(tall[1], seen.max() + 2 * scout.cells[1])
            if tall[0] >= tall[1]:
                continue
        yield end, sorted(shear * q for q in tall)
