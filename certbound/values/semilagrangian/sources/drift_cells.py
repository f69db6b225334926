"""The drift on cells of a grid: bilinear functions with a proved remainder, kinks and jumps included.

With slopes of f along an axis between a and b on a cell of width w, f lies within t (1 - t) w (b - a) <= w (b - a)/4 of
its chord: f(t) <= min(f(0) + b t w, f(1) - a (1 - t) w), weighted with 1 - t and t; from below alike. Along both axes
in turn, f lies within the sum of the two of what interpolates its corners. The slopes are the tape's generalised
derivatives in interval arithmetic, so that a kink costs what its slope jumps by, on the cells that it crosses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.model import Tape, jacobian
from certbound.rigor.intervals import Interval
from certbound.values.discrete import evaluate

_UP = 1 + 1e-12


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class DriftCells:
    """(F, g) on cells of p x q.

    Attributes
    ----------
    corners : ndarray, shape (2, cells of p, cells of q, 2, 2)
        Of the bilinear functions, by the ends of p and of q.
    remainder : ndarray, shape (2, cells of p, cells of q)
        |F - bilinear|, |g - bilinear| at most.
    nodes : Interval, shape (2, knots of p, knots of q)
    """

    corners: Array
    remainder: Array
    nodes: Interval


def drift_cells(tape: Tape, p: Array, q: Array) -> DriftCells:
    """Enclose a drift that does not depend on time.

    Raises
    ------
    InfeasibleError
        It is undefined somewhere.
    """
    still = Interval.point(np.zeros(1))
    points = [Interval.point(x.ravel()) for x in np.meshgrid(p, q, indexing="ij")]
    value, bad, _ = evaluate(tape, [still, *points])
    nodes = Interval(*(part.T.reshape(2, len(p), len(q)) for part in (value.lo, value.hi)))
    low = [x.ravel() for x in np.meshgrid(p[:-1], q[:-1], indexing="ij")]
    high = [x.ravel() for x in np.meshgrid(p[1:], q[1:], indexing="ij")]
    boxes = [Interval(a, b) for a, b in zip(low, high)]
    shape = len(p) - 1, len(q) - 1
    ranges, worse, jumps = evaluate(tape, [still, *boxes])
    slopes, worst, more = evaluate(jacobian(tape, (1, 2)), [still, *boxes])
    if bad.any() or worse.any() or worst.any() or not np.isfinite(ranges.mag).all():
        raise InfeasibleError("the model is undefined somewhere in the safe set; value functions prove nothing here.")
    middle, radius = nodes.mid, nodes.rad
    corners = np.stack([_corner(middle, i, j) for i in (0, 1) for j in (0, 1)], axis=-1)
    rounded = np.max([_corner(radius, i, j) for i in (0, 1) for j in (0, 1)], axis=0)
    widths = np.stack([b - a for a, b in zip(low, high)], axis=1)
    swings = (slopes.hi - slopes.lo).reshape(-1, 2, 2)
    with np.errstate(all="ignore"):
        remainder = (np.einsum("nij,nj->ni", swings, widths) / 4).T.reshape(2, *shape) + rounded
    broken = (jumps | more).reshape(shape) | ~np.isfinite(remainder).all(axis=0)
    flat = [part.T.reshape(2, *shape) for part in (ranges.mid, ranges.rad)]
    remainder = np.where(broken, flat[1], remainder) + 1e-15 * np.abs(corners).max(axis=-1)
    corners = np.where(broken[..., None], flat[0][..., None], corners)
    return DriftCells(corners=corners.reshape(2, *shape, 2, 2), remainder=remainder * _UP + 1e-300, nodes=nodes)


def _corner(values: Array, i: int, j: int) -> Array:
    return values[:, i : values.shape[1] - 1 + i, j : values.shape[2] - 1 + j]
