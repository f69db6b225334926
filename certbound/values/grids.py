"""Grids of boxes: their axes, their cells, and how fine they should be where."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.rigor.intervals import Interval


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Grid:
    """A box cut into cells by rising nodes on every axis.

    Parameters
    ----------
    axes : tuple of ndarray, shapes (N_i + 1,)
        Nodes; the outermost ones are the box.
    """

    axes: tuple[Array, ...]

    @property
    def dimension(self) -> int:
        """Number of axes."""
        return len(self.axes)

    @property
    def shape(self) -> tuple[int, ...]:
        """Cells along the axes."""
        return tuple(len(axis) - 1 for axis in self.axes)

    @property
    def node_shape(self) -> tuple[int, ...]:
        """Nodes along the axes."""
        return tuple(len(axis) for axis in self.axes)

    def nodes(self) -> Array:
        """All nodes, shape (nodes, n)."""
        return np.stack([axis.ravel() for axis in np.meshgrid(*self.axes, indexing="ij")], axis=1)

    def cells(self) -> Interval:
        """All cells as boxes, shape (cells, n)."""
        low = np.meshgrid(*(axis[:-1] for axis in self.axes), indexing="ij")
        high = np.meshgrid(*(axis[1:] for axis in self.axes), indexing="ij")
        return Interval(*(np.stack([side.ravel() for side in ends], axis=1) for ends in (low, high)))

    def widths(self, axis: int) -> Array:
        """Widths of the cells along an axis, rounded up, shaped to broadcast against cells."""
        widths = np.diff(self.axes[axis]) * (1 + 1e-15)  # 0 on an axis of two equal nodes
        return widths.reshape([-1 if k == axis else 1 for k in range(self.dimension)])


def corners(nodal: Array) -> list[Array]:
    """Views of a tensor over nodes as its values at the 2^n corners of every cell; lower ends first."""
    found = [nodal]
    for axis in range(nodal.ndim):
        first = tuple(slice(None, -1) if k == axis else slice(None) for k in range(nodal.ndim))
        second = tuple(slice(1, None) if k == axis else slice(None) for k in range(nodal.ndim))
        found = [part[side] for part in found for side in (first, second)]
    return found


def over_corners(pick: np.ufunc, nodal: Array) -> Array:
    """The largest (``np.maximum``) or smallest (``np.minimum``) corner of every cell."""
    for axis in range(nodal.ndim):
        before = (slice(None),) * axis
        nodal = pick(nodal[(*before, slice(None, -1))], nodal[(*before, slice(1, None))])
    return nodal


def around_nodes(cellwise: Array, *, largest: bool) -> Array:
    """The largest (smallest) value of the cells around every node."""
    shape = tuple(size + 1 for size in cellwise.shape)
    nodal = np.full(shape, -np.inf if largest else np.inf)
    for view in corners(nodal):
        np.copyto(view, np.maximum(view, cellwise) if largest else np.minimum(view, cellwise))
    return nodal


def graded_axis(low: float, high: float, places: Array, widths: Array, marks: Sequence[float] = ()) -> Array:
    """Nodes from low to high whose distances follow the wanted widths.

    Parameters
    ----------
    low, high : float
        Ends, which become nodes exactly.
    places, widths : ndarray, shape (K,)
        Wanted cell widths (positive) at rising places, linear in between.
    marks : sequence of float
        Numbers between the ends that become nodes.
    """
    ends = [low, *sorted({float(mark) for mark in marks if low < mark < high}), high]
    parts = []
    for first, last in itertools.pairwise(ends):
        fine = np.linspace(first, last, 513)
        rate = 1 / np.interp(fine, places, widths)
        count = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(fine))])
        number = max(1, math.ceil(count[-1] - 1e-9))
        inner = np.interp(np.linspace(0, count[-1], number + 1), count, fine)[:-1]
        inner[0] = first
        parts.append(inner)
    axis = np.unique(np.concatenate([*parts, [high]]))
    return np.asarray(axis[np.concatenate([[True], np.diff(axis) > 0])])
