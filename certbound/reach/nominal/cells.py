"""The initial set, split into cells with one nominal curve each."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.problem.problem import Problem
from certbound.problem.sets import Quadratic
from certbound.rigor import intervals as iv
from certbound.rigor.definite import eigenvalue_upper, is_positive_definite
from certbound.rigor.intervals import Interval
from certbound.rigor.norms import Norm, ball_root, largest_over_box

MOST_CELLS = 4096


@dataclass(frozen=True, eq=False, kw_only=True)
class Cells:
    """Boxes (B, n) whose union contains the initial set, and a float point of each.

    ``round`` is the initial set itself, when it is one cell and a ball or an ellipsoid: its centre and its form.
    ``generators`` (B, G, n) are cells that are zonotopes about their centres, each within its box; the deviation of a
    random start may then begin with a covariance that is off its floats by ``start_error`` (n, n), entry by entry.
    """

    centres: Array
    boxes: Interval
    generators: Array | None = None
    start_error: Array | None = None
    round: tuple[Array, Quadratic] | None = None

    def radii(self, norm: Norm, starts: Interval) -> Array:
        """Upper bounds of sup ||x_0 - p(0)||_P per cell, shape (B,); ``starts`` encloses p(0), (B, n)."""
        bound = largest_over_box(norm, self.boxes - starts)
        if self.round is None:
            return bound
        center, form = self.round
        radius = _round_radius(form, norm)
        if not np.isfinite(radius):  # of an ellipsoid that is nearly flat
            return bound
        shift = norm.length(Interval.point(center) - starts)
        around = Interval.point(radius) + Interval.point(shift)
        return np.asarray(np.minimum(bound, around.hi))


def initial_cells(problem: Problem, cells: int | Cells | None = None) -> Cells:
    """Split the initial set into ``cells`` parts along every side that has width, or as it is given.

    A random start is represented by its mean: its spread belongs to the stochastic deviation.

    Raises
    ------
    ValueError
        If ``cells`` is not a positive integer, or asks for more than 4096 cells.
    """
    if isinstance(cells, Cells):
        return cells
    number = isinstance(cells, (int, float, np.integer)) and not isinstance(cells, bool)
    if cells is not None and not (number and cells >= 1 and cells % 1 == 0):
        raise ValueError(f"`cells` must be a positive integer (parts along each side), got {cells!r}.")
    start = problem.initial
    if start.random:
        mean = start.middle[None]
        return Cells(centres=mean, boxes=Interval.point(mean))
    low, high = start.hull().lo, start.hull().hi
    parts = 1 if cells is None else int(cells)
    if parts == 1:
        centre = np.clip(0.5 * low + 0.5 * high, low, high)
        whole = (start.center_at(), start.form) if start.form.round else None
        return Cells(centres=centre[None], boxes=Interval(low[None], high[None]), round=whole)
    wide = low < high
    if parts ** int(np.count_nonzero(wide)) > MOST_CELLS:
        raise ValueError(
            f"`cells` must make at most {MOST_CELLS} cells, got {parts} along each of "
            f"{np.count_nonzero(wide)} sides; use fewer."
        )
    edges = []
    for a, b, splits in zip(low, high, wide):
        nodes = np.linspace(a, b, parts + 1 if splits else 2)
        nodes[0], nodes[-1] = a, b
        edges.append(list(itertools.pairwise(np.maximum.accumulate(nodes))))
    corners = np.array(list(itertools.product(*edges)))
    lows, highs = corners[..., 0], corners[..., 1]
    return Cells(centres=np.clip(0.5 * lows + 0.5 * highs, lows, highs), boxes=Interval(lows, highs))


def _round_radius(form: Quadratic, norm: Norm) -> float:
    """Upper bound of ||y||_P over the ball or ellipsoid {y} around its centre; inf if not proved."""
    matrix = np.eye(norm.dimension) if norm.matrix is None else norm.matrix
    if form.even:
        if norm.matrix is None:
            return float(form.radius)
        largest = iv.sqrt(Interval.point(float(eigenvalue_upper(matrix))))
        return float((largest * float(form.radius)).hi)
    inner = np.linalg.inv(form.shape) * (1 - 1e-9)
    inner = (inner + inner.T) / 2
    point = Interval.point(inner)
    if not bool(is_positive_definite(point - point @ Interval.point(form.shape) @ point)):
        return float(np.inf)
    root = Interval.point(ball_root(inner))  # the ellipsoid lies in {y^T inner y <= 1}
    longest = iv.sqrt(Interval.point(float(eigenvalue_upper(root.T @ Interval.point(matrix) @ root))))
    return float((longest * form.radius).hi)
