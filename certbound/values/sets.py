"""What the constraints say about boxes: surely respected, surely broken, and the box around what is safe."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from certbound.problem.model import Tape, arithmetic
from certbound.problem.sets import Ball, Box, Ellipsoid, HalfSpace, Inside, Outside, Polytope, Region
from certbound.rigor.intervals import Interval, sq, sqrt, stack

__all__ = ["active_at", "box_around", "contains", "respected"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def active_at(constraints: Sequence[Inside], step: int) -> list[Inside]:
    """The constraints that hold at a step."""
    return [c for c in constraints if c.during is None or c.during[0] <= step <= c.during[1]]


def respected(
    constraints: Sequence[Inside], boxes: Interval, step: int, *, interiors: bool = False
) -> tuple[Mask, Mask]:
    """Boxes, shape (N, n), all of whose points respect every constraint, and boxes none of whose points do.

    With ``interiors`` only the boxes' interior points count: enough where noise has a density, since faces are null.
    """
    safe, broken = np.ones(len(boxes), dtype=bool), np.zeros(len(boxes), dtype=bool)
    for constraint in constraints:
        inside, outside = contains(constraint.region, boxes, step, interiors=interiors)
        if isinstance(constraint, Outside):
            inside, outside = outside, inside
        safe &= inside
        broken |= outside
    return safe, broken


def contains(region: Region, boxes: Interval, step: int, *, interiors: bool = False) -> tuple[Mask, Mask]:
    """Boxes that surely lie in a region, and boxes that surely do not meet it (but for points of their faces)."""
    local = boxes if region.coordinates is None else boxes[:, list(region.coordinates)]
    if isinstance(region, Box):
        y = local if region.center is None else local - _center(region, step)
        inside = (y.lo >= region.low) & (y.hi <= region.high)
        outside = (y.hi < region.low) | (y.lo > region.high)
        if interiors:
            outside |= (y.hi <= region.low) | (y.lo >= region.high)
        return np.asarray(inside.all(axis=1)), np.asarray(outside.any(axis=1))
    if isinstance(region, HalfSpace | Polytope):
        normals, bounds = region.halfspaces()
        values = (Interval.point(normals) * local[:, None, :]).sum(axis=-1)
        outside = (values.lo >= bounds) if interiors else (values.lo > bounds)
        return np.asarray((values.hi <= bounds).all(axis=1)), np.asarray(outside.any(axis=1))
    if isinstance(region, Ball):
        square = sq(local - _center(region, step)).sum(axis=-1)
        limit = sq(Interval.point(region.radius))
        return np.asarray(square.hi <= limit.lo), np.asarray(square.lo > limit.hi)
    assert isinstance(region, Ellipsoid)
    y = local - _center(region, step)
    whole = (y * (_inverse(region.shape)[None] * y[:, None, :]).sum(axis=-1)).sum(axis=-1)
    return np.asarray(whole.hi <= 1), np.asarray(whole.lo > 1)


def _center(region: Region, step: int) -> Interval:
    center = region.center
    if not isinstance(center, Tape):
        return Interval.point(center)
    return stack(center.evaluate(arithmetic("interval"), [Interval.point(float(step))]))


def _inverse(matrix: Array) -> Interval:
    """Enclosure of the inverse of a matrix of at most three rows, by cofactors."""
    n = len(matrix)
    entry = Interval.point(matrix)

    def minor(rows: list[int], columns: list[int]) -> Interval:
        if not rows:
            return Interval.point(1.0)
        total = Interval.point(0.0)
        for place, column in enumerate(columns):
            rest = columns[:place] + columns[place + 1 :]
            term = entry[rows[0], column] * minor(rows[1:], rest)
            total = total + term if place % 2 == 0 else total - term
        return total

    whole = list(range(n))
    determinant = minor(whole, whole)
    rows = []
    for i in range(n):
        row = []
        for j in range(n):
            cofactor = minor([k for k in whole if k != j], [k for k in whole if k != i])
            row.append((cofactor if (i + j) % 2 == 0 else -cofactor) / determinant)
        rows.append(stack(row))
    return stack(rows)


def box_around(constraints: Sequence[Inside], dimension: int, step: int) -> tuple[Array, Array]:
    """Ends of a box that contains every safe state, shapes (n,); infinite where nothing bounds a state."""
    low, high = np.full(dimension, -np.inf), np.full(dimension, np.inf)
    for constraint in constraints:
        if isinstance(constraint, Outside):
            continue
        region = constraint.region
        places = list(range(dimension)) if region.coordinates is None else list(region.coordinates)
        below, above = _ends(region, step)
        low[places] = np.maximum(low[places], below)
        high[places] = np.minimum(high[places], above)
    return low, high


def _ends(region: Region, step: int) -> tuple[Array, Array]:
    """Ends of a box around a region, in its coordinates."""
    if isinstance(region, Box):
        if region.center is None:
            return region.low, region.high
        center = _center(region, step)
        low = np.where(np.isfinite(region.low), np.nextafter(region.low + center.lo, -np.inf), -np.inf)
        return low, np.where(np.isfinite(region.high), np.nextafter(region.high + center.hi, np.inf), np.inf)
    if isinstance(region, Ball | Ellipsoid):
        spread = Interval.point(np.full(region.dimension, region.radius)) if isinstance(region, Ball) else None
        if isinstance(region, Ellipsoid):
            spread = sqrt(Interval.point(np.diag(region.shape)))
        assert spread is not None
        center = _center(region, step)
        return (center - spread).lo, (center + spread).hi
    normals, bounds = region.halfspaces()
    low, high = np.full(region.dimension, -np.inf), np.full(region.dimension, np.inf)
    for normal, bound in zip(normals, bounds):
        places = np.flatnonzero(normal)
        if len(places) != 1:
            continue
        place = int(places[0])
        end = Interval.point(bound) / Interval.point(normal[place])
        if normal[place] > 0:
            high[place] = min(high[place], float(end.hi))
        else:
            low[place] = max(low[place], float(end.lo))
    return low, high
