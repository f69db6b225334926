"""Lower bounds in a region with curved walls by proposals of U itself, where failing is not too rare.

The way of `near_walls` from below: what a proof would have to pay is taken off U as a source, and the rest is paid as
a share of U (`straight.relative_below`).
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from certbound.arrays import Array, Index
from certbound.problem.problem import Problem
from certbound.rigor.intervals import Interval
from certbound.values.continuous.curved.boundaries import Walls
from certbound.values.continuous.curved.cuts import Cuts
from certbound.values.continuous.curved.proof import Lot, look_over
from certbound.values.continuous.curved.proof_below import seen_within, sunk_within, surely_in
from certbound.values.continuous.curved.region import limits_around
from certbound.values.continuous.curved.walled_ramps import WalledRamps
from certbound.values.continuous.held_faces import check_noise
from certbound.values.continuous.hypotheses import NEGLIGIBLE, Model, Proof, covers
from certbound.values.continuous.plane import Plane, Source
from certbound.values.continuous.residual import Ranges, sample_in_plane, value_range
from certbound.values.continuous.straight import relative_below
from certbound.values.continuous.surface import Surface
from certbound.values.room import points_of
from certbound.watch import OutOfTime

_SAMPLES = (4, 6, 6)
_FACTORS = (0.6, 0.9, 1.12, 1.12, 1.12)  # of what a proof would pay, for one source after the other
_SAMPLED = 3  # of which samples tell, and its bounds after that
_LITTLE = 0.05  # of P: below that U is left to W and eps
_SPARED = 0.02  # of U, summed over the horizon, which need not be carried
_FLOORS = (0.0, 0.003, 0.01, 0.03, 0.06, 0.1, 0.2)  # of P, by which W may be more than it must be
_ALONG = 9  # points of a box of starts along each state
_PARTS = 256  # of a face, which is no limit if some of them may meet the region
_STRONG = 1.0  # a drift from a face back into the box, in units of what a cell holds: U = 0 there then


def bound_near_walls_below(
    problem: Problem, plane: Plane, walls: Walls, model: Model, cells: int, level: float
) -> float | None:
    """The lower bound of log P from the best start on a grid with so many cells along each state; None where none is.

    ``level`` is about P.

    Raises
    ------
    InfeasibleError
        Noise that may vanish somewhere in the box.
    """
    plane, points = ended_at_limits(problem, plane, walls, cells), surely_in(walls, _starts(problem))
    check_noise(model, (0.0, plane.horizon), list(zip(plane.low, plane.high)))
    if not len(points):
        return None
    solver, found = WalledRamps(plane, walls, cells, below=level), list[float]()
    source: Source | None = None
    try:
        for number, factor in enumerate(_FACTORS):
            surface = solver.surface(source, below=True)
            if not covers(surface, plane.horizon, plane.low, plane.high, within=False):
                break
            cuts = Cuts.of(surface.axes, walls)
            surface = sunk_within(surface, cuts, walls)
            value = 1 + float(surface.floor_at(0, points).max()) / solver.small
            if not 0 < value < 1:
                break
            needed, least = _missing(surface, cuts, model, solver.small, _LITTLE * value)
            if number >= _SAMPLED:
                spare = NEGLIGIBLE * solver.small * value
                proof = seen_within(surface, cuts, model, points, spare, plane.cut)
                log = best_below(proof, solver.small * value)
                found += [] if log is None else [log]
                needed = _needed(proof, surface, solver.small, _LITTLE * value)
            if not np.isfinite(needed).all():
                break
            left = _SPARED / plane.horizon * np.maximum(least, 0.0)
            needed = np.maximum(needed - left, 0.0)
            beside = np.pad(needed, ((1, 1), (0, 0), (0, 0)))  # sources that change fast feed each other
            needed = np.maximum(needed, np.maximum(beside[:-2], beside[2:]))
            needed[-1] = 0.0  # U is next to nothing yet
            more = Source.above(surface, factor * needed)
            source = more if source is None else source.plus(more)
    except (RuntimeError, ValueError):  # a singular system, or a proposal that is not finite
        pass
    except OutOfTime:
        if not found:
            raise
    return max(found, default=None)


def ended_at_limits(problem: Problem, plane: Plane, walls: Walls, cells: int) -> Plane:
    """The box for lower bounds: a side lies beyond a limit, or the box is only cut there if it meets closure(O).

    Cut is a side, too, from which the drift leads back faster than cells can follow: U = 0 there costs little.
    """
    inner, outer = limits_around(problem)
    ends, sides = [list(plane.low), list(plane.high)], list(itertools.product((0, 1), (0, 1)))
    limits = {(axis, side): ends[side][axis] == inner[side][axis] for axis, side in sides}
    for axis, side in sides:
        ends[side][axis] = float(outer[side][axis]) if limits[axis, side] else ends[side][axis]
    wide = replace(plane, low=(ends[0][0], ends[0][1]), high=(ends[1][0], ends[1][1]))
    cut = {
        one: not (limits[one] and _follows(wide, *one, cells)) and _meets(wide, walls, *one) for one in sides
    }  # fmt: skip
    return replace(wide, cut=((cut[0, 0], cut[0, 1]), (cut[1, 0], cut[1, 1])))


def _follows(plane: Plane, axis: int, side: int, cells: int) -> bool:
    """Whether no drift at a face leads back faster than so many cells can follow, in floats."""
    place = [np.linspace(low, high, 33) for low, high in zip(plane.low, plane.high)]
    place[axis] = np.full(33, (plane.low, plane.high)[side][axis])
    drift = plane.drift(0.0, *place)[0, axis] * (1 - 2 * side)
    width = (plane.high[axis] - plane.low[axis]) / cells
    return bool(np.all(drift * width <= _STRONG * plane.square(0.0, *place)[axis, axis]))


def _meets(plane: Plane, walls: Walls, axis: int, side: int) -> bool:
    """Whether a face may meet closure(O)."""
    other = np.linspace(plane.low[1 - axis], plane.high[1 - axis], _PARTS + 1)
    at = Interval.point(np.full(_PARTS, (plane.low, plane.high)[side][axis]))
    along = Interval(other[:-1], other[1:])
    return not walls.locate((at, along) if axis == 0 else (along, at))[1].all()


def _starts(problem: Problem) -> Array:
    """Points that are surely starts, shape (N, 2)."""
    points, around = points_of(problem), problem.initial.hull()
    if points is not None:
        return points
    ends = [np.unique(np.linspace(a, b, _ALONG)) for a, b in zip(around.lo, around.hi)]
    return np.stack([one.ravel() for one in np.meshgrid(*ends, indexing="ij")], axis=1)


def best_below(proof: Proof, value: float) -> float | None:
    """The best lower bound of log P where W is what it must be, or more: of V below it nothing is asked then.

    Proves: log P is at least that, if V of `seen_within` is at most 0 on closure(O). ``value`` is about e P.
    """
    assert proof.seen is not None
    surface, need = proof.seen
    found = list[float]()
    for share in _FLOORS:
        end = need.bottom + share * value
        kept = np.flatnonzero(~(proof.ranges.high <= end))
        ranges = Ranges(**{name: getattr(proof.ranges, name)[kept] for name in Ranges.__dataclass_fields__})
        seen = surface, replace(need, bottom=end)
        log = relative_below(Proof(ranges=ranges, slab=proof.slab[kept], cell=proof.cell[kept], seen=seen), 0.0)
        found += [] if log is None else [log]
    return max(found, default=None)


def _needed(proof: Proof, surface: Surface, small: float, little: float) -> Array:
    """What a proof found missing, of U, where that is not ``little``."""
    table = np.zeros((surface.slabs, int(np.prod(surface.cells))))
    due = 1 + proof.ranges.high / small > little
    np.maximum.at(table, (proof.slab, proof.cell), np.where(due, -proof.ranges.residual_low / small, 0.0))
    return table.reshape(surface.slabs, *surface.cells)


def _missing(surface: Surface, cuts: Cuts, model: Model, small: float, little: float) -> tuple[Array, Array]:
    """Samples of what is missing of U's residual where ``little`` < U <= 1, and U's least values, on each patch."""

    def look(lot: Lot) -> tuple[Array, Array, Index, Index]:
        missing = sample_in_plane(lot.patches, lot.drifts, lot.squares, lot.place, _SAMPLES, upper=False)
        low, high = value_range(lot.patches)
        return np.where((1 + high / small > little) & (low <= 0), missing, 0.0), low, lot.slab, lot.cell

    shape = (surface.slabs, int(np.prod(surface.cells)))
    missing, least = np.zeros(shape), np.ones(shape)
    for found, low, slab, cell in look_over(surface, cuts, model, _SAMPLES, look):
        np.maximum.at(missing, (slab, cell), found / small)
        np.minimum.at(least, (slab, cell), 1 + low / small)
    whole = (surface.slabs, *surface.cells)
    return missing.reshape(whole), least.reshape(whole)
