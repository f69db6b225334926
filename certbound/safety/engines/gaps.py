"""A problem's constraints as functions of the state, and ranges of functions, for branch and bound over boxes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.constants.enclosures import enclose, split_boxes
from certbound.problem.model import Tape
from certbound.problem.problem import Problem
from certbound.problem.sets import Quadratic
from certbound.rigor.intervals import Interval, sq

_CUTS = 12  # halvings of every side of a set


@dataclass(frozen=True, eq=False, kw_only=True)
class Gap:
    """A constraint as phi(x) <= 0; on its boundary phi = 0.

    phi is max(rows x - bounds) or, ``round``, |x - bounds|^2 - radius^2 over the coordinates that ``rows`` picks; with
    the other sign for an obstacle.
    """

    rows: Array
    bounds: Array
    outside: bool
    radius: float | None = None

    def over(self, boxes: Interval) -> Interval:
        """phi over boxes: (N, n) to (N,)."""
        values = (Interval.point(self.rows) * boxes[:, None, :]).sum(axis=-1) - self.bounds
        if self.radius is not None:
            value = sq(values).sum(axis=-1) - sq(Interval.point(self.radius))
        else:
            value = Interval(values.lo.max(axis=-1), values.hi.max(axis=-1))
        return -value if self.outside else value


def gaps_of(problem: Problem) -> list[Gap]:
    """The constraints that ask anything."""
    n = problem.system.dimension
    found = []
    for constraint in problem.constraints:
        region, center = constraint.region, constraint.region.center_at()
        radius: float | None = None
        match region.form:
            case Quadratic() as form if form.even:
                rows, bounds, radius = np.eye(form.dimension), center, form.radius
            case _:
                rows, bounds = region.halfspaces()
                if region.center is not None:  # to the side on which less is safe
                    moved = Interval.point(bounds) + (Interval.point(rows) * center).sum(axis=-1)
                    bounds = moved.hi if constraint.outside else moved.lo
                if not len(rows) and not constraint.outside:
                    continue  # a box without finite sides
        found.append(Gap(rows=region.lifted(rows, n), bounds=bounds, outside=constraint.outside, radius=radius))
    return found


def hull_of(gaps: list[Gap]) -> Array:
    """A box that contains the safe set: shape (2, n), infinite where nothing bounds a state."""
    n = gaps[0].rows.shape[1] if gaps else 1
    low, high = np.full(n, -np.inf), np.full(n, np.inf)
    for gap in gaps:
        sign = -1.0 if gap.outside else 1.0
        if gap.outside and (gap.radius is not None or len(gap.rows) > 1):
            continue
        for row, bound in zip(gap.rows, gap.bounds):
            places = np.flatnonzero(row)
            if len(places) != 1:
                continue
            place, factor = int(places[0]), sign * float(row[places[0]])
            if gap.radius is not None:
                ends = Interval.point(bound) + Interval(-gap.radius, gap.radius)
                low[place], high[place] = max(low[place], float(ends.lo)), min(high[place], float(ends.hi))
                continue
            end = Interval.point(sign * bound) / Interval.point(factor)
            if factor > 0:
                high[place] = min(high[place], float(end.hi))
            else:
                low[place] = max(low[place], float(end.lo))
    return np.array([low, high])


def lies_inside(gaps: list[Gap], box: Interval) -> bool:
    """Whether every point of a box (n,) provably satisfies every constraint."""
    boxes = box.reshape(1, -1)
    for _ in range(_CUTS * len(box) + 1):
        undecided = np.any([gap.over(boxes).hi > 0 for gap in gaps], axis=0)
        if not undecided.any():
            return True
        boxes = boxes[np.asarray(undecided)]
        middle = Interval.point(boxes.mid)
        if np.any([gap.over(middle).lo > 0 for gap in gaps]) or len(boxes) > 4096:
            return False
        boxes = split_boxes(boxes, boxes.rad)
    return False


def range_over(tape: Tape, slope: Tape, boxes: Interval) -> tuple[Interval, Array]:
    """Ranges of a function over boxes (N, k), the better of natural and centred ends, and what each coordinate adds.

    ``slope`` is the function's Jacobian. Where it is undefined or jumps the range is infinite.
    """
    middle = Interval.point(boxes.mid)
    inputs, at = ([part[:, k] for k in range(boxes.shape[1])] for part in (boxes, middle))
    whole = enclose(tape, inputs, undefined="infinite")[:, 0]
    gradient = enclose(slope, inputs, undefined="infinite")[:, 0]
    with np.errstate(invalid="ignore"):
        centred = enclose(tape, at, undefined="infinite")[:, 0] + (gradient * (boxes - middle)).sum(axis=-1)
        weights = np.nan_to_num(gradient.mag * boxes.rad, nan=np.inf, posinf=np.inf)
        low, high = np.fmax(whole.lo, centred.lo), np.fmin(whole.hi, centred.hi)
    return Interval(np.where(np.isnan(low), -np.inf, low), np.where(np.isnan(high), np.inf, high)), weights
