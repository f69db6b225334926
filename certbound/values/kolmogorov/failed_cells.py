"""Obstacles and safe sets of any shape, by cells (Thm K10, 10.5).

A path fails on the edge of the safe set, so in a cell that is neither proved safe nor failed as a whole. There v has a
goal in those parts of the cell that the edge meets; in failed cells nothing is asked of it. Limits along the
coordinates stand on ends of the box instead, where they lose nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np

from certbound.arrays import Array, Index, Mask
from certbound.problem.sets import Faces, Inside
from certbound.rigor.intervals import Interval
from certbound.values.kolmogorov.splines import Axis, cells_of, controls_on_some
from certbound.values.sets import respected

_BESIDE = 1e-9  # of a shape's size or distance from 0: how far off its faces nodes stand
_CUTS = (0.0, 0.03, 0.25, 0.5, 0.75, 0.97, 1.0)
"""Where a cell is cut along each axis into parts in which the edge is looked for: thin ones for faces on nodes."""

_OVER = 1e-12  # of a cell, by which parts overlap: rounding leaves no gaps
_TOGETHER = 2**15  # cells times knots
_PARTS = tuple((max(a - _OVER, 0.0), min(b + _OVER, 1.0)) for a, b in pairwise(_CUTS))

Places = tuple[tuple[float, ...], ...]
"""Of every axis, places at which a node serves."""


def limits_and_shapes(constraints: Sequence[Inside], dimension: int) -> tuple[list[Inside], list[Inside]]:
    """Constraints that are limits along the coordinates, and others."""
    limits, shapes = list[Inside](), list[Inside]()
    for one in constraints:
        form = one.region.form
        along = isinstance(form, Faces) and bool(np.all((form.normals != 0).sum(axis=1) == 1))
        (limits if dimension == 1 or (along and not one.outside) else shapes).append(one)
    return limits, shapes


def places_of(shapes: Sequence[Inside], dimension: int) -> Places:
    """Where faces of shapes stand along the coordinates, a little off on the side that has failed, for nodes."""
    found: list[set[float]] = [set() for _ in range(dimension)]
    for one in shapes:
        if isinstance(one.region.form, Faces):
            for own, ends in zip(found, zip(*_hull(one, dimension, -_BESIDE if one.outside else _BESIDE))):
                own |= {float(end) for end in ends if np.isfinite(end)}
    return tuple(tuple(sorted(own)) for own in found)


def ends_of(shapes: Sequence[Inside], dimension: int) -> tuple[Array, Array]:
    """Lower and upper ends of a box beyond which paths have left a shape, shapes (n,); infinite for none."""
    hulls = [_hull(one, dimension, _BESIDE) for one in shapes if not one.outside]
    low = np.max([low for low, _ in hulls] + [np.full(dimension, -np.inf)], axis=0)
    high = np.min([high for _, high in hulls] + [np.full(dimension, np.inf)], axis=0)
    return low, high


def _hull(shape: Inside, dimension: int, share: float) -> tuple[Array, Array]:
    """A box around a shape, larger by a share of its size and of its distance from 0."""
    low, high = np.full(dimension, -np.inf), np.full(dimension, np.inf)
    hull, places = shape.region.hull(), shape.region.places(dimension)
    low[places], high[places] = hull.lo, hull.hi
    with np.errstate(invalid="ignore"):
        sizes = np.abs([low, high, high - low])
    off = share * np.where(np.isfinite(sizes), sizes, 0.0).max(axis=0)
    return low - off, high + off


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Shapes:
    """Cells of a grid by what shapes say of them.

    Attributes
    ----------
    failed : ndarray of bool, shape (N_1, ...)
        Cells all of which has failed: no path gets there.
    cut : tuple of ndarray, shapes (R,)
        Places of the cells that are neither failed nor proved safe.
    met, kept : ndarray of bool, shape (R, 6, ...)
        Of the parts of each of these those that are neither: in one of them a path fails;
        and those that have not failed.
    """

    failed: Mask
    cut: tuple[Index, ...]
    met: Mask
    kept: Mask

    @classmethod
    def of(cls, shapes: Sequence[Inside], axes: Sequence[Axis]) -> Shapes:
        shape, n = cells_of(tuple(axes)), len(axes)
        parts = (len(_PARTS),) * n
        if not shapes:
            nowhere = np.zeros(0, dtype=np.intp)
            no_parts = np.zeros((0, *parts), dtype=bool)
            return cls(failed=np.zeros(shape, dtype=bool), cut=(nowhere,) * n, met=no_parts, kept=no_parts)
        ends = [(axis.nodes[:-1], axis.nodes[1:]) for axis in axes]
        low, high = (np.stack([m.ravel() for m in np.meshgrid(*rows, indexing="ij")], axis=1) for rows in zip(*ends))
        safe, failed = respected(shapes, Interval(low, high), 0)
        cut = np.nonzero(~(safe | failed).reshape(shape))
        places = np.array(np.meshgrid(*[np.arange(len(_PARTS))] * n, indexing="ij")).reshape(n, -1)
        starts, stops = (np.array(rows) for rows in zip(*_PARTS))
        lows, highs = [], []
        for axis, cell, place in zip(axes, cut, places):
            a, b = axis.nodes[cell, None], axis.nodes[cell + 1, None]
            rounding = 2.0**-50 * np.maximum(np.abs(a), np.abs(b))
            lows.append(np.where(place == 0, a, a + (b - a) * starts[place] - rounding))
            highs.append(np.where(place == len(_PARTS) - 1, b, a + (b - a) * stops[place] + rounding))
        boxes = Interval(*(np.stack(rows, axis=-1).reshape(-1, n) for rows in (lows, highs)))
        safe, broken = respected(shapes, boxes, 0)
        met, kept = (rows.reshape(-1, *parts) for rows in (~(safe | broken), ~broken))
        return cls(failed=failed.reshape(shape), cut=cut, met=met, kept=kept)


def depth_of(failed: Mask) -> Array:
    """How many nodes a node lies within the cells that have failed, negative before them, 0 at their faces."""
    from scipy.ndimage import distance_transform_edt

    padded = np.pad(failed, 1, mode="edge")
    corners = [
        padded[tuple(slice(c, c + size + 1) for c, size in zip(corner, failed.shape))]
        for corner in product((0, 1), repeat=failed.ndim)
    ]
    within, touched = np.logical_and.reduce(corners), np.logical_or.reduce(corners)
    if within.all() or not touched.any():
        return np.full(within.shape, np.inf if within.all() else -np.inf)
    return np.asarray(distance_transform_edt(within) - distance_transform_edt(~touched))


def distance_to(nodes: Mask) -> Array:
    """How many nodes each one lies off the marked ones."""
    from scipy.ndimage import distance_transform_edt

    return np.asarray(distance_transform_edt(~nodes)) if nodes.any() else np.full(nodes.shape, np.inf)


def shortfall_on(
    axes: tuple[Axis, ...], shapes: Shapes, goal: float, values: Array, rates: Array, steps: Array
) -> Array:  # fmt: skip
    """goal - v, at least 0, where paths fail in cells that shapes cut, in every slab; shape (slabs, R)."""
    result = np.zeros((len(steps), len(shapes.cut[0])))
    h = steps.reshape(-1, 1, 1) / 3
    for some, cells, part in _parts(shapes, shapes.met, len(values)):
        (v, off), (d, more) = (controls_on_some(axes, rows, cells, part) for rows in (values, rates))
        parts = (v[1:], v[1:] + h * d[1:], v[:-1] - h * d[:-1], v[:-1])
        least = np.minimum.reduce([one.min(axis=-1) for one in parts])
        slack = np.maximum(off[1:] + h[..., 0] * more[1:], off[:-1] + h[..., 0] * more[:-1])
        result[:, some] = np.maximum(result[:, some], (goal - least + slack) * (1 + 1e-12) + 1e-15)
    return np.maximum(result, 0.0)


def most_kept(axes: tuple[Axis, ...], shapes: Shapes, coefficients: Array) -> Array:
    """An upper bound of a tensor spline on what has not failed of the cells that shapes cut, shape (R,)."""
    result = np.full(len(shapes.cut[0]), -np.inf)
    for some, cells, part in _parts(shapes, shapes.kept, 1):
        (value,), (off,) = controls_on_some(axes, coefficients[None], cells, part)
        result[some] = np.maximum(result[some], value.max(axis=-1) + off)
    return result


def _parts(
    shapes: Shapes, chosen: Mask, knots: int
) -> Iterator[tuple[Index, tuple[Index, ...], list[tuple[float, float]]]]:
    """Cells that shapes cut, as numbers and as places, and a part of them that is chosen, a batch at a time."""
    many = max(1, _TOGETHER // knots)
    for part in product(range(len(_PARTS)), repeat=chosen.ndim - 1):
        own = np.flatnonzero(np.moveaxis(chosen, 0, -1)[part])
        for some in (own[k : k + many] for k in range(0, len(own), many)):
            yield some, tuple(place[some] for place in shapes.cut), [_PARTS[k] for k in part]
