"""Vectorised branch and bound: a certified upper bound of a supremum over a box, and a sampled lower one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Index
from certbound.rigor.intervals import Interval
from certbound.watch import poll

ROUND = 2048
"""Boxes split at a time."""
FEWEST = 64
"""Parts that a round ends with at least: a batch of so many costs hardly more than a batch of two."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Supremum:
    """Result of a branch and bound.

    No value over the box exceeds ``upper``; the largest one that was found, in floating point, is ``sampled``, at
    ``point``; ``boxes`` were evaluated; ``worst`` is one on which the upper bound is attained, to explain it. To go on
    from: ``rest``, shape (N, k), are boxes that could be split further, ``settled`` bounds all the others.
    """

    upper: float
    sampled: float
    point: Array
    boxes: int
    worst: Interval
    settled: float
    rest: Interval


def bound_supremum(
    bound: Callable[[Interval, float], tuple[Array, Array]],
    value: Callable[[Array], Array],
    box: Interval,
    *,
    tolerance: float,
    budget: int = 60_000,
    ceiling: float = np.inf,
    starts: Interval | None = None,
    earlier: Supremum | None = None,
    share: float = 1.0,
) -> Supremum:
    """Bound sup value over a box, best boxes first.

    Proves: value(z) <= result.upper for every z in the box, provided that ``bound`` is rigorous: the upper bounds of
    all boxes that are not split any further are kept.

    ``bound`` takes boxes (N, k) and a threshold to rigorous upper bounds (N,), which need not be sharp below the
    threshold, and to the coordinates' weights (N, k), the largest of which says what to halve next; ``value`` takes
    points (N, k) to values (N,) in floating point, NaN where undefined. Infinite ends of the box are legal.

    The search stops once upper - sampled is at most ``tolerance``, or after about ``budget`` boxes. ``ceiling`` is an
    upper bound known beforehand, ``starts`` boxes that together hold the supremum, ``earlier`` a search of the same
    supremum that ran out of its budget, to go on from. ``share`` is that of the usual number of samples to be taken,
    where a value is expensive.
    """
    if not tolerance > 0:
        raise ValueError(f"`tolerance` must be positive, got {tolerance}.")
    rng = np.random.default_rng(0)
    retired, retired_box, count, rounds_unbounded = -np.inf, box, 0, 0
    if earlier is None:
        boxes = box.reshape(1, -1) if starts is None else starts
        sampled, point = -np.inf, _centres(boxes)[0]
        tried = [_centres(boxes), random_points(rng, box, max(8, int(2048 * share)))]
        if share < 1 and np.isfinite(box.lo).all() and np.isfinite(box.hi).all():
            tried.append(np.stack([box.lo, box.hi]))  # few samples: the ends of all sides at once among them
        sampled, point = _sample(value, tried, sampled, point)
        sampled, point = _climb(value, rng, box, sampled, point, share)
    else:
        boxes, sampled, point = earlier.rest, earlier.sampled, earlier.point
        retired, retired_box, count = min(earlier.settled, ceiling), earlier.worst, earlier.boxes
    uppers, weights = bound(boxes, -np.inf) if len(boxes) else (np.empty(0), np.empty((0, len(box))))
    uppers = np.minimum(uppers, ceiling)
    count += len(boxes)
    while len(boxes):
        poll()
        done = uppers <= sampled + tolerance
        done |= ~np.any(boxes.lo < boxes.hi, axis=1)
        if done.any():
            first = int(np.argmax(np.where(done, uppers, -np.inf)))
            if done[first] and uppers[first] > retired:  # boxes that are ruled out have -inf, and count for nothing
                retired, retired_box = float(uppers[first]), boxes[first]
            keep = ~done
            boxes, uppers, weights = boxes[keep], uppers[keep], weights[keep]
        unbounded = bool(len(boxes)) and bool(np.isinf(uppers).any())
        rounds_unbounded = rounds_unbounded + 1 if unbounded else 0
        if not len(boxes) or count >= budget or rounds_unbounded > 60 or max(uppers) <= retired:
            break
        order = np.argsort(-uppers, kind="stable")
        chosen, rest = order[:ROUND], order[ROUND:]
        children, above = _parts(boxes[chosen], weights[chosen], uppers[chosen])
        new_uppers, new_weights = bound(children, sampled + tolerance)
        new_uppers = np.minimum(new_uppers, above)
        count += len(children)
        best = np.argsort(-new_uppers, kind="stable")[:256]
        points = [_centres(children[best]), _inside(rng, children[best])]
        sampled, point = _sample(value, points, sampled, point)
        boxes = Interval(np.concatenate([boxes.lo[rest], children.lo]), np.concatenate([boxes.hi[rest], children.hi]))
        uppers = np.concatenate([uppers[rest], new_uppers])
        weights = np.concatenate([weights[rest], new_weights])
    sampled, point = _climb(value, rng, box, sampled, point, share)
    worst, settled = retired_box, retired
    if len(boxes) and uppers.max() > retired:
        first = int(np.argmax(uppers))
        retired, worst = float(uppers[first]), boxes[first]
    return Supremum(upper=retired, sampled=sampled, point=point, boxes=count, worst=worst, settled=settled, rest=boxes)


def _centres(boxes: Interval) -> Array:
    """A cutting point of each side: the middle, or a finite number inside an infinite side."""
    lo, hi = boxes.lo, boxes.hi
    with np.errstate(all="ignore"):
        middle = 0.5 * lo + 0.5 * hi
        beyond = np.where(lo == -np.inf, np.where(hi > 0, 0.0, 2 * hi - 1), np.where(lo < 0, 0.0, 2 * lo + 1))
    both = np.where((lo == -np.inf) & (hi == np.inf), 0.0, beyond)
    result: Array = np.where(np.isfinite(lo) & np.isfinite(hi), middle, both)
    return np.clip(result, np.maximum(lo, -1e300), np.minimum(hi, 1e300))


def _parts(boxes: Interval, weights: Array, uppers: Array) -> tuple[Interval, Array]:
    """Halves of all boxes, halved again while they are few and bounded; and the bounds of what they come from."""
    while True:
        side = _heaviest(boxes, weights)
        boxes, uppers = split_boxes(boxes, weights), np.concatenate([uppers, uppers])
        if len(boxes) >= FEWEST or not np.isfinite(uppers).all() or not np.isfinite(boxes.hi - boxes.lo).all():
            return boxes, uppers
        weights = weights.copy()
        weights[np.arange(len(weights)), side] /= 2
        weights = np.concatenate([weights, weights])


def _heaviest(boxes: Interval, weights: Array) -> Index:
    wide = boxes.lo < boxes.hi
    side: Index = np.argmax(np.where(wide, np.where(np.isnan(weights), np.inf, weights), -1.0), axis=1)
    return side


def split_boxes(boxes: Interval, weights: Array) -> Interval:
    """Halve each box along its heaviest side of positive width; first halves first."""
    side = _heaviest(boxes, weights)
    rows = np.arange(len(boxes))
    cut = _centres(boxes)[rows, side]
    lo, hi = np.array(boxes.lo), np.array(boxes.hi)
    left_hi, right_lo = hi.copy(), lo.copy()
    left_hi[rows, side] = cut
    right_lo[rows, side] = cut
    return Interval(np.concatenate([lo, right_lo]), np.concatenate([left_hi, hi]))


def _inside(rng: np.random.Generator, boxes: Interval) -> Array:
    """A random point or corner of each box."""
    centre = _centres(boxes)
    share = rng.uniform(-1.0, 1.0, centre.shape)
    share = np.where(rng.uniform(size=(len(centre), 1)) < 0.5, np.sign(share), share)
    with np.errstate(all="ignore"):
        lo = np.where(np.isfinite(boxes.lo), boxes.lo, centre - 1.0 - np.abs(centre))
        hi = np.where(np.isfinite(boxes.hi), boxes.hi, centre + 1.0 + np.abs(centre))
    return np.where(share < 0, centre + share * (centre - lo), centre + share * (hi - centre))


def random_points(rng: np.random.Generator, box: Interval, count: int) -> Array:
    """Random points of a box, half of them with coordinates at the ends."""
    boxes = box.broadcast_to((count, *box.shape))
    wide = np.tan(0.49 * np.pi * rng.uniform(-1.0, 1.0, boxes.shape))
    lo, hi = boxes.lo, boxes.hi
    with np.errstate(all="ignore"):
        bounded = lo + rng.uniform(size=boxes.shape) * (hi - lo)
        from_lo, from_hi = lo + np.abs(wide), hi - np.abs(wide)
    free = np.where(np.isfinite(lo), from_lo, np.where(np.isfinite(hi), from_hi, wide))
    points = np.where(np.isfinite(lo) & np.isfinite(hi), bounded, free)
    end = np.where(rng.uniform(size=boxes.shape) < 0.5, lo, hi)
    use = (np.arange(count) % 2 == 0)[:, None] & (rng.uniform(size=boxes.shape) < 0.7) & np.isfinite(end)
    return np.where(use, end, points)


def _climb(
    value: Callable[[Array], Array], rng: np.random.Generator, box: Interval, sampled: float, point: Array, share: float
) -> tuple[float, Array]:
    """Random search around the best point, in ever smaller steps."""
    with np.errstate(all="ignore"):
        width = np.where(np.isfinite(box.hi - box.lo), box.hi - box.lo, 1.0 + np.abs(point))
    count = max(1, int(48 * share))
    for step in 0.3 * 0.6 ** np.arange(24):
        near = point + step * width * rng.normal(size=(count, len(point))) * (rng.uniform(size=(count, 1)) < 0.8)
        sampled, point = _sample(value, [np.clip(near, box.lo, box.hi)], sampled, point)
    return sampled, point


def _sample(value: Callable[[Array], Array], groups: list[Array], sampled: float, point: Array) -> tuple[float, Array]:
    points = np.concatenate(groups)
    with np.errstate(all="ignore"):
        found = value(points)
    found = np.where(np.isfinite(found), found, -np.inf)
    first = int(np.argmax(found))
    if found[first] > sampled:
        return float(found[first]), points[first]
    return sampled, point
