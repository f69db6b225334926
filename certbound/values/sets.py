"""What the constraints say about boxes: surely respected, surely broken, and the box around what is safe."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from certbound.arrays import Array, Mask
from certbound.problem.sets import Faces, Inside, Quadratic, Region
from certbound.rigor.intervals import Interval, sq, stack


def active_at(constraints: Sequence[Inside], step: int) -> list[Inside]:
    """The constraints that hold at a step."""
    return [c for c in constraints if c.during is None or c.during[0] <= step <= c.during[1]]


def as_stays(constraints: Sequence[Inside]) -> list[Inside]:
    """The constraints, half-spaces to keep out of as what they leave to stay in (`Inside.as_stay`)."""
    return [constraint.as_stay() for constraint in constraints]


def respected(
    constraints: Sequence[Inside], boxes: Interval, step: int, *, interiors: bool = False
) -> tuple[Mask, Mask]:
    """Boxes, shape (N, n), all of whose points respect every constraint, and boxes none of whose points do.

    With ``interiors`` only the boxes' interior points count: enough where noise has a density, since faces are null.
    """
    safe, broken = np.ones(len(boxes), dtype=bool), np.zeros(len(boxes), dtype=bool)
    for constraint in constraints:
        edge = not constraint.without_edge
        inside, outside = contains(constraint.region, boxes, step, interiors=interiors, edge=edge)
        if constraint.outside:
            inside, outside = outside, inside
        safe &= inside
        broken |= outside
    return safe, broken


def contains(
    region: Region, boxes: Interval, step: int, *, interiors: bool = False, edge: bool = True
) -> tuple[Mask, Mask]:
    """Boxes that surely lie in a region, and boxes that surely do not meet it.

    With ``interiors`` only the boxes' interior points count. Without its ``edge`` the region is the interior of a set
    with flat faces.
    """
    y = region.relative(boxes[:, region.places(boxes.shape[1])], step)
    match region.form:
        case Faces() as form:
            values = form.values(y)
            inside = (values.hi <= form.bounds) if interiors or edge else (values.hi < form.bounds)
            outside = (values.lo > form.bounds) if edge and not interiors else (values.lo >= form.bounds)
            return np.asarray(inside.all(axis=1)), np.asarray(outside.any(axis=1))
        case Quadratic() as form if form.even:
            square, limit = sq(y).sum(axis=-1), sq(Interval.point(form.radius))
        case Quadratic() as form:
            square = (y * (inverse_of(form.shape)[None] * y[:, None, :]).sum(axis=-1)).sum(axis=-1)
            limit = Interval.point(form.radius) * form.radius
    return np.asarray(square.hi <= limit.lo), np.asarray(square.lo > limit.hi)


def inverse_of(matrix: Array) -> Interval:
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
    for constraint in as_stays(constraints):
        if constraint.outside:
            continue
        places, around = constraint.region.places(dimension), constraint.region.hull(step)
        low[places] = np.maximum(low[places], around.lo)
        high[places] = np.minimum(high[places], around.hi)
    return low, high
