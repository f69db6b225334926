"""The upper bound for a region with curved walls: what `hypotheses` shows for a box, on the part of it that is safe.

Let O be the region of `walls` within the surface's box. A path is stopped when it reaches the boundary of O, V >= 0 or
T; until then it is in O. So Theorem K8-CT needs V >= 0 on the boundary of O and the residual inequality at points of O
with V < 0, and nothing of the cells, and parts of cut cells, that surely do not meet the closure of O.

V >= 0 on a wall {g = 0}: there V = V + mu g for every mu, and with mu the ratio of the slopes V + mu g is flat to first
order. Its Bernstein coefficients on a part bound V there far closer than V's own. What is missing is added to V.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import comb
from typing import TypeVar

import numpy as np

from certbound.arrays import Array, Index
from certbound.problem.sets import Inside, Region
from certbound.rigor.intervals import Interval
from certbound.values.continuous.coefficients import Interpolant
from certbound.values.continuous.curved.boundaries import Wall, Walls
from certbound.values.continuous.curved.cuts import Cuts, Ends
from certbound.values.continuous.hypotheses import (
    NEGLIGIBLE,
    Model,
    Need,
    Proof,
    cheapest,
    extreme_over,
    interpolants,
    raised_above,
    side_by_side,
    up,
)  # fmt: skip
from certbound.values.continuous.payment import Payment
from certbound.values.continuous.residual import Patches, Ranges, bound_ranges, coarse_size, value_range
from certbound.values.continuous.surface import Surface
from certbound.values.polynomials import QUARTERS

Found = TypeVar("Found")

_UNIT = 2.0**-53
_NEAR = 40.0  # as in `hypotheses`
_ELEVATE = np.array([
    [comb(2, j) * comb(3, i - j) / comb(5, i) if 0 <= i - j <= 3 else 0.0 for j in range(3)] for i in range(6)
])  # fmt: skip
"""Bernstein coefficients of degree 5 from those of degree 2, each entry rounded once."""
_DEEPEST = 7
FINER = 16  # parts of a part of a cell, where V on a wall is looked at


def raised_over_walls(surface: Surface, cuts: Cuts) -> Surface:
    """The surface, raised by what it misses of V >= 0 on the walls and on the faces of its box.

    Proves: V >= 0 on the boundary of O at all times.
    """
    surface, more = raised_above(surface), 1e-12
    while (least := least_on_walls(surface, cuts)) < 0:
        surface, more = surface.raised(up(-least) + more), 10 * more
    return surface


def least_on_walls(surface: Surface, cuts: Cuts) -> float:
    """A lower bound of V over the boundary of O within the surface's box; infinite where there is none."""
    if not cuts.touched:
        return np.inf
    least = np.inf
    for first, last in surface.chunks():
        parts = cuts.parts(surface.patches(first, last).take(tiled(cuts.cut, surface, last - first)), last - first)
        for wall, mask in cuts.touched:
            place = np.flatnonzero(np.tile(mask, last - first))
            chosen = np.flatnonzero(mask)
            ends = tuple((left[chosen], right[chosen]) for left, right in cuts.ends)
            least = min(least, float(_on_wall(parts.take(place), wall, ends, last - first).min()))
    return least


def _on_wall(patches: Patches, wall: Wall, ends: Ends, slabs: int) -> Array:
    """Lower bounds of V over each patch where g = 0, by parts of it that the wall may meet."""
    patches, ends = quartered(patches, ends)
    (low, _), (least, most) = leaning(patches, wall, ends, slabs, (-np.inf, np.inf))
    return np.asarray(np.where((least > 0) | (most < 0), np.inf, low).reshape(-1, FINER).min(axis=1))


def leaning(
    patches: Patches, wall: Wall, ends: Ends, slabs: int, factors: tuple[float, float]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Lower and upper bounds over each patch of V + mu g, and of g; ``ends`` are those of the patches of one slab.

    mu is a polynomial in time whose Bernstein coefficients lie between the ``factors``.
    """
    found = wall.bernstein(ends)
    table = np.einsum("ai,sij,bj->sab", _ELEVATE, found.mid, _ELEVATE)
    size = np.abs(table).max(axis=(1, 2))
    off = found.rad.max(axis=(1, 2)) + 40 * _UNIT * size
    sign = np.tile(found.lo.min(axis=(1, 2)), slabs), np.tile(found.hi.max(axis=(1, 2)), slabs)
    table, size, off = (np.tile(part, (slabs, *[1] * (part.ndim - 1))) for part in (table, size, off))
    factor = np.clip(_ratio(patches.coefficients, table), *factors)
    moved = (patches.coefficients + factor[:, :, None, None] * table[:, None]).reshape(len(factor), -1)
    slack = _UNIT * (1000 * (patches.size + np.abs(patches.reference)) + 10 * np.abs(factor).max(axis=1) * size)
    slack += np.abs(factor).max(axis=1) * off * (1 + 1e-12)
    ends_of_v = patches.reference + moved.min(axis=1) - slack, patches.reference + moved.max(axis=1) + slack
    return ends_of_v, sign


def quartered(
    patches: Patches, ends: Ends
) -> tuple[Patches, Ends]:
    """Each patch in `FINER` equal parts, one after the other; enclosed ends of the parts of one slab."""
    shares = np.arange(5) / 4
    finer = np.einsum("pai,qbj,ktij->kpqtab", QUARTERS, QUARTERS, patches.coefficients, optimize=True)
    coefficients = finer.reshape(-1, *patches.coefficients.shape[1:])
    widths = tuple(np.repeat(width / 4, FINER) for width in patches.widths)
    reference, size, step = (np.repeat(one, FINER) for one in (patches.reference, patches.size, patches.step))
    parts = Patches(coefficients=coefficients, reference=reference, size=size, step=step, widths=widths)
    places = np.meshgrid(np.arange(4), np.arange(4), indexing="ij")
    found = []
    for (left, right), place in zip(ends, places):
        width = right - left
        first, last = (
            (left[:, None] + width[:, None] * Interval.point(shares[place.ravel() + k])[None]).reshape(-1)
            for k in (0, 1)
        )
        found.append((first, last))
    return parts, (found[0], found[1])


def _ratio(coefficients: Array, table: Array) -> Array:
    """mu for each coefficient in time, which takes most of V's slope away: any number will do."""
    slopes = [
        (array[..., -1, :] - array[..., 0, :]).mean(axis=-1) for array in (coefficients, coefficients.swapaxes(-1, -2))
    ]
    own = [(array[..., -1, :] - array[..., 0, :]).mean(axis=-1) for array in (table, table.swapaxes(-1, -2))]
    square = np.maximum(own[0] ** 2 + own[1] ** 2, 1e-300)
    return np.asarray(-(slopes[0] * own[0][:, None] + slopes[1] * own[1][:, None]) / square[:, None])


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Lot:
    """Patches of some slabs with the model's polynomials there: ``place`` says which, ``slab`` and ``cell`` where."""

    patches: Patches
    drifts: list[Interpolant]
    squares: Interpolant
    place: Index
    slab: Index
    cell: Index


def look_over(
    surface: Surface, cuts: Cuts, model: Model, counts: tuple[int, ...], look: Callable[[Lot], Found]
) -> list[Found]:
    """``look`` at all that the safe region meets: whole cells and parts of cut cells, some slabs at a time."""
    fixed = _interpolants(surface, cuts, model, 0, 1, counts) if model.autonomous else None

    def at(ends: tuple[int, int]) -> list[Found]:
        first, last = ends
        patches, slabs = surface.patches(first, last), last - first
        whole, cut = (tiled(cells, surface, slabs) for cells in (cuts.whole, cuts.cut))
        parts = np.tile(np.arange(len(cuts.cell)), slabs)
        places = [np.tile(cuts.whole, slabs), parts] if fixed else [whole, np.arange(len(parts))]
        both = fixed or _interpolants(surface, cuts, model, first, last, counts)
        groups = [patches.take(whole), cuts.parts(patches.take(cut), slabs)]
        found = []
        for group, (drifts, squares), place, cell in zip(groups, both, places, (cuts.whole, cuts.cut[cuts.cell])):
            slab = first + np.repeat(np.arange(slabs), len(cell))
            lot = Lot(patches=group, drifts=drifts, squares=squares, place=place, slab=slab, cell=np.tile(cell, slabs))
            found += [look(lot)] if len(slab) else []
        return found

    return list(itertools.chain.from_iterable(side_by_side(at, list(surface.chunks()))))


def _interpolants(
    surface: Surface, cuts: Cuts, model: Model, first: int, last: int, counts: tuple[int, ...]
) -> list[tuple[list[Interpolant], Interpolant]]:
    whole = interpolants(surface, model, first, last, counts)
    return [whole, cuts.interpolants(surface, model, first, last, counts) if len(cuts.cut) else whole]


def examine_within(
    surface: Surface, cuts: Cuts, model: Model, need: Need, *, upper: bool = True, straight: bool = False
) -> Proof:
    """Enclose R (closely on one side), V and Q2 on every patch, and part of a cut patch, that needs it."""
    counts = model.counts(straight)
    share = _NEAR * (0.5 + 0.5 * surface.times[-1] / (surface.slabs * surface.steps))

    def look(lot: Lot) -> tuple[Ranges, Index, Index] | None:
        low, high = value_range(lot.patches)
        size = np.inf if straight else coarse_size(lot.patches, lot.drifts, lot.squares, lot.place)
        due = ~(low >= need.top) & ~(high <= need.bottom) & ~(size <= need.free(high))  # no number is looked at, too
        kept = np.flatnonzero(due)
        if not len(kept):
            return None
        ranges = bound_ranges(
            lot.patches.take(kept), lot.drifts, lot.squares, lot.place[kept], counts, wanted=need.spare,
            near=share[lot.slab[kept]] * need.free(high[kept]), upper=upper, straight=straight,
        )  # fmt: skip
        return ranges, lot.slab[kept], lot.cell[kept]

    found = [one for one in look_over(surface, cuts, model, counts, look) if one is not None]
    joined = {
        name: np.concatenate([np.empty(0), *(getattr(ranges, name) for ranges, _, _ in found)])
        for name in Ranges.__dataclass_fields__
    }
    none = np.empty(0, dtype=np.intp)
    return Proof(
        ranges=Ranges(**joined), slab=np.concatenate([none, *(slab for _, slab, _ in found)]),
        cell=np.concatenate([none, *(cell for _, _, cell in found)]), seen=(surface, need),
    )  # fmt: skip


def tiled(cells: Index, surface: Surface, slabs: int) -> Index:
    """Where some cells are among the patches of so many slabs."""
    per = int(np.prod(surface.cells))
    return np.asarray((np.arange(slabs)[:, None] * per + cells).ravel())


def prove_within(surface: Surface, walls: Walls, model: Model, initial: Region) -> Payment:
    """An upper bound of log P(leaving O by the last time from anywhere in ``initial``), whatever the surface is."""
    cuts = Cuts.of(surface.axes, walls)
    surface = raised_over_walls(surface, cuts)
    start = up(highest_over(surface, walls, initial))
    need = Need(spare=NEGLIGIBLE / float(surface.times[-1]), start=start, top=0.0)
    payment, lift = cheapest(examine_within(surface, cuts, model, need), need, surface, start)
    return replace(payment, lift=lift)


def highest_over(surface: Surface, walls: Walls, initial: Region) -> float:
    """An upper bound of V(0, .) over the starts; infinite unless all of them surely lie in O and in the box."""
    own = Walls.of([Inside(initial)])
    around = initial.hull()
    hull = (Interval(around.lo[:1], around.hi[:1]), Interval(around.lo[1:], around.hi[1:]))
    if not _surely_within(hull, walls, own):
        return np.inf
    ends = [(float(a), float(b)) for a, b in zip(around.lo, around.hi)]
    rough = extreme_over(surface, ends, upper=True)
    if initial.form.axial or rough == np.inf:
        return rough
    axes, ceiling = surface.ceiling_at(0)
    low = np.meshgrid(*(axis[:-1] for axis in axes), indexing="ij")
    high = np.meshgrid(*(axis[1:] for axis in axes), indexing="ij")
    away = own.locate((Interval(low[0], high[0]), Interval(low[1], high[1])))[1]
    return min(rough, float(ceiling[~away].max()))


def _surely_within(box: tuple[Interval, Interval], walls: Walls, own: Walls) -> bool:
    """Whether all points of a box that may belong to the set of ``own`` surely lie in O."""
    for _ in range(_DEEPEST):
        open_ = np.flatnonzero(~own.locate(box)[1] & ~walls.locate(box)[0])
        if not len(open_):
            return True
        halves = [[Interval(one.lo[open_], one.mid[open_]), Interval(one.mid[open_], one.hi[open_])] for one in box]
        pairs = list(itertools.product(*halves))
        box = (
            Interval(np.concatenate([x.lo for x, _ in pairs]), np.concatenate([x.hi for x, _ in pairs])),
            Interval(np.concatenate([y.lo for _, y in pairs]), np.concatenate([y.hi for _, y in pairs])),
        )
    return False
