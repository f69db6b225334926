"""How much a reach tube may still grow before it breaks a constraint.

For every time piece a number r is proved such that the set of the piece plus {||y||_P <= r} keeps the
constraint while it is asked. Both the nominal curve and moving centres are bounded over the whole piece
through their Taylor forms; nothing between nodes is left out.

- Safe polyhedra, face by face: r = (b - sup a.(p - o) - spread(a)) / sqrt(a^T P^-1 a).
- Safe balls and ellipsoids {||M (C x - o)|| <= 1}: r = (1 - sup||M (C p - o)|| - spread) / sup_{||y||_P <=
  1}||M C y||.
- Convex obstacles: any direction a separates, r = (inf a.(C p - o) - h(a) - spread(-a)) / sqrt(a^T P^-1 a)
  with h the obstacle's support function; a proposal comes from the nearest point in the metric (7.16 of
  theory).

Source: set erosion, Thm 1 and Prop 4 (paper), with the nominal piece enclosed as in Thm K5 (theory).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from certbound.arrays import Array, Mask
from certbound.problem.model import Tape
from certbound.problem.sets import Faces, Inside, Quadratic, Region
from certbound.reach.nominal import Curve, Series, expand, polynomial_range
from certbound.reach.sets.separation import polyhedral_weights, round_directions
from certbound.rigor import intervals as iv
from certbound.rigor.intervals import Interval
from certbound.rigor.norms import Norm, ball_root
from certbound.rigor.series import product
from certbound.watch import poll


class Sets(Protocol):
    """What is read of a reach tube: its curve, and the sets about it (see `ReachTube`)."""

    @property
    def curve(self) -> Curve:
        """The nominal curve of every cell."""

    @property
    def norm(self) -> Norm:
        """The norm of ``radius``."""

    @property
    def radius(self) -> Array:
        """Radius per cell and piece."""

    @property
    def generators(self) -> Array | None:
        """Of a zonotope."""

    @property
    def box(self) -> Interval | None:
        """And of a box."""

    def spread(self, directions: Interval) -> Array:
        """Support of the sets about the curve."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Clearance:
    """Room of one constraint over the time pieces."""

    radius: Array  # (K,): proved r per piece; inf where the constraint is not asked, -inf where nothing could be proved
    factor: Array  # (K,): Euclidean distance per unit of r along the binding direction (for people; not rounded)


def constraint_clearance(tube: Sets, constraint: Inside, norm: Norm) -> Clearance:
    """Room of ``constraint`` around the sets of ``tube``, measured in ``norm``."""
    poll(f"room of '{constraint.label}'")
    curve = tube.curve
    asked, span = _window(curve, constraint)
    relative = _relative(curve, constraint.region, span)
    if constraint.outside:
        room = _outside(tube, constraint.region, norm, relative, span)
    else:
        room = _inside(tube, constraint.region, norm, relative, span)
    radius = np.where(np.isnan(room.radius), -np.inf, room.radius)
    return Clearance(radius=np.where(asked, radius, np.inf), factor=room.factor)


def _window(curve: Curve, constraint: Inside) -> tuple[Mask, Interval]:
    """Pieces on which the constraint is asked, and the offsets s at which it is, shape (K,)."""
    if constraint.during is None:
        return np.ones(curve.pieces, dtype=bool), curve.span
    first, last = constraint.during
    asked = (curve.ends >= first) & (curve.starts <= last)
    low = np.where(asked, np.maximum(curve.starts, first), curve.starts)
    high = np.where(asked, np.minimum(curve.ends, last), curve.ends)
    return asked, curve.offset(Interval(low, high))


def _relative(curve: Curve, region: Region, span: Interval) -> list[Series]:
    """Series of C p(s) - o(s) in the region's coordinates, valid for s in ``span``."""
    states = curve.series()
    chosen = [states[i] for i in region.places(len(states))]
    if not isinstance(region.center, Tape):
        if region.center is None:
            return chosen
        return [[series[0] - value, *series[1:]] for series, value in zip(chosen, np.asarray(region.center))]
    one = Interval.point(1.0)
    middle = expand(region.center, [[Interval.point(curve.middles), one]], 2)
    reach = Interval(np.minimum(span.lo, 0.0), np.maximum(span.hi, 0.0))
    piece = expand(region.center, [[Interval.point(curve.middles) + reach, one]], 2)
    result = []
    for series, at_middle, over in zip(chosen, middle, piece):
        center = [at_middle[0], at_middle[1], over[2]]
        if not all(np.all(np.isfinite(c.mag)) for c in center):
            center = [over[0]]
        length = max(len(series), len(center))
        padded = [x + [Interval.point(0.0)] * (length - len(x)) for x in (series, center)]
        result.append([a - b for a, b in zip(*padded)])
    return result


def _functional(relative: list[Series], direction: Interval, span: Interval) -> Interval:
    """Range of a . (C p - o) over the piece; ``direction`` of shape (..., q) -> (B, K)."""
    return polynomial_range(_combined(relative, [direction[..., i] for i in range(len(relative))]), span)


def _lift(direction: Interval, region: Region, dimension: int) -> Interval:
    """A direction of the region's coordinates as one of the whole state."""
    if region.coordinates is None:
        return direction
    return Interval(region.lifted(direction.lo, dimension), region.lifted(direction.hi, dimension))


def _room(tube: Sets, norm: Norm, gap: Interval, lifted: Interval) -> tuple[Array, Array]:
    """(gap - spread)/dual length per cell and piece, and the Euclidean length of a unit of it."""
    room = (gap - Interval.at_most(tube.spread(lifted))).lo
    dual = np.broadcast_to(norm.dual(lifted), room.shape)
    euclidean = np.linalg.norm(lifted.mid, axis=-1)
    with np.errstate(all="ignore"):
        factor = np.broadcast_to(dual / euclidean, room.shape)
    return _in_units(room, dual), factor


def _in_units(room: Array, unit: Array | float) -> Array:
    """Room over a unit, rounded down; none is proved where numbers overflowed."""
    finite = np.isfinite(room)
    return np.where(finite, (Interval.point(np.where(finite, room, 0.0)) / Interval.point(unit)).lo, -np.inf)


def _least(radius: Array, factor: Array) -> Clearance:
    """The tightest member along the leading axes, per piece."""
    flat, scale = radius.reshape(-1, radius.shape[-1]), factor.reshape(-1, factor.shape[-1])
    index = np.argmin(flat, axis=0)
    columns = np.arange(flat.shape[1])
    return Clearance(radius=flat[index, columns], factor=scale[index, columns])


def _inside(tube: Sets, region: Region, norm: Norm, relative: list[Series], span: Interval) -> Clearance:
    if isinstance(region.form, Quadratic):
        return _inside_round(tube, region, region.form, norm, relative, span)
    faces, bounds = region.form.normals, region.form.bounds
    shape = (tube.curve.cells, tube.curve.pieces)
    if len(faces) == 0:
        return Clearance(radius=np.full(shape[1], np.inf), factor=np.ones(shape[1]))
    rooms = []
    for face, bound in zip(faces, bounds):
        kept = np.flatnonzero(face)  # most faces of a large model read one state
        series = _combined([relative[i] for i in kept], face[kept].tolist())
        gap = Interval.point(bound) - polynomial_range(series, span)
        rooms.append(_room(tube, norm, gap, _lift(Interval.point(face), region, tube.curve.dimension)))
    radius, factor = (np.stack([np.broadcast_to(room[i], shape) for room in rooms]) for i in (0, 1))
    return _least(radius, factor)


def _inside_round(
    tube: Sets, region: Region, form: Quadratic, norm: Norm, relative: list[Series], span: Interval
) -> Clearance:
    scale = np.eye(form.dimension) if form.even else ball_root(form.shape).T
    squared: Series = []
    for row in scale:
        kept = np.flatnonzero(row)
        series = _combined([relative[i] for i in kept], row[kept].tolist())
        squared = _added(squared, product(series, series))
    ranges = polynomial_range(squared, span)
    largest = iv.sqrt(_nonnegative(ranges))
    rows = region.lifted(scale, tube.curve.dimension)
    spread = Interval.at_most(tube.radius) * tube.norm.section(rows)
    lifted = Interval.point(rows)
    if tube.generators is not None:
        images = lifted @ Interval.point(tube.generators)
        lengths = iv.sqrt(_nonnegative(iv.sq(images).sum(axis=-2)))
        spread = spread + Interval.at_most(lengths.hi).sum(axis=-1)
    if tube.box is not None:
        image = (lifted @ tube.box.reshape(*tube.box.shape, 1))[..., 0]
        spread = spread + Interval.at_most(iv.sqrt(_nonnegative(iv.sq(image).sum(axis=-1))).hi)
    section = norm.section(rows)
    radius = _in_units((form.radius - largest - spread).lo, section)
    euclidean = float(np.linalg.norm(rows, 2))
    return _least(radius, np.full(radius.shape, section / euclidean))


def _nonnegative(x: Interval) -> Interval:
    return Interval(np.maximum(x.lo, 0.0), np.maximum(x.hi, 0.0))


def _combined(relative: list[Series], weights: Sequence[Interval | float]) -> Series:
    """The sum of the series times their weights."""
    total: Series = []
    for weight, series in zip(weights, relative, strict=True):
        total = _added(total, [coefficient * weight for coefficient in series])
    return total


def _added(x: Series, y: Series) -> Series:
    if len(x) < len(y):
        x, y = y, x
    return [a + y[j] if j < len(y) else a for j, a in enumerate(x)]


def _outside(
    tube: Sets, region: Region, norm: Norm, relative: list[Series], span: Interval
) -> Clearance:
    """The best of a few separating directions per cell and piece."""
    shape = (tube.curve.cells, tube.curve.pieces)
    picked = region.places(tube.curve.dimension)
    points = np.stack([np.broadcast_to(series[0].mid, shape) for series in relative], axis=-1)
    best, scale = np.full(shape, -np.inf), np.ones(shape)
    for matrix in (norm.shape[np.ix_(picked, picked)], np.eye(len(picked))):
        for direction, height in _directions(region, points, matrix):
            gap = _functional(relative, direction, span) - height
            room, factor = _room(tube, norm, gap, -_lift(direction, region, tube.curve.dimension))
            better = room > best
            best, scale = np.where(better, room, best), np.where(better, factor, scale)
    return _least(best, scale)


def _directions(region: Region, points: Array, matrix: Array) -> list[tuple[Interval, Interval]]:
    """Pairs (direction a, upper bound of the obstacle's support in it) per cell and piece."""
    match region.form:
        case Quadratic() as form:
            direction = Interval.point(round_directions(points, form.matrix, matrix))
            if form.even:
                length = iv.sqrt(iv.sq(direction).sum(axis=-1))
            else:
                row = direction.reshape(*direction.shape[:-1], 1, direction.shape[-1])
                length = iv.sqrt(_nonnegative((row @ Interval.point(form.shape) @ row.T)[..., 0, 0]))
            return [(direction, length * float(form.radius))]
        case Faces() as form:
            pairs = []
            for weights in polyhedral_weights(points, form.normals, form.bounds, matrix):
                direction = Interval.point(weights) @ Interval.point(form.normals)
                height = (Interval.point(weights) * Interval.point(form.bounds)).sum(axis=-1)
                pairs.append((direction, height))
            return pairs
