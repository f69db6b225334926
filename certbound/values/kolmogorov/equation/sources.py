"""Smooth sources from what is asked for on cells and slabs: about it at first, above it in the end (Thm K10, 10.2).

An error that is to be carried costs what its source costs. A source above whatever is asked for, and smooth, costs many
times more than that where it is needed on a few cells only; one that is about it in the mean leaves less than half of
it to the next pass, and costs no more than it has to. So the first pass takes means, two more take the larger of
neighbours, smoothed, and the last ones what is enough on every cell.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from itertools import pairwise

import numpy as np

from certbound.arrays import Array


class Breadth(Enum):
    """How much a source takes of what is asked for around a node."""

    MEAN = "the mean over the cells about it"
    LARGEST = "the largest of these, smoothed over nodes"
    ABOVE = "the largest of the cells two nodes around, smoothed: above what is asked for everywhere"


BREADTHS = (Breadth.MEAN, Breadth.LARGEST, Breadth.LARGEST, Breadth.ABOVE)
"""Of the first passes; the last one goes on."""
_SMOOTH = (0.25, 0.5, 0.25)


def at_nodes(cells: Array, pads: Sequence[tuple[int, int]], breadth: Breadth, skip: int | None = None) -> Array:
    """A source at the nodes of a grid that reaches beyond the cells by ``pads``; ``skip`` is an axis left as it is.

    Parameters
    ----------
    cells : ndarray, shape (N_1, ...)
        What is asked for.
    pads : sequence of (int, int)
        Cells before and behind, along each axis; nothing is asked for there.
    breadth : Breadth
    skip : int, optional

    Returns
    -------
    ndarray, shape (before_1 + N_1 + behind_1 + 1, ...)
    """
    from scipy.ndimage import convolve1d, maximum_filter, uniform_filter

    for axis, (before, behind) in enumerate(pads):
        if axis != skip:
            around = [(before + 1, behind + 1) if k == axis else (0, 0) for k in range(cells.ndim)]
            moved = np.moveaxis(np.pad(cells, around), axis, 0)
            both = (moved[1:] + moved[:-1]) / 2 if breadth is Breadth.MEAN else np.maximum(moved[1:], moved[:-1])
            cells = np.moveaxis(both, 0, axis)
    if breadth is Breadth.ABOVE:
        size = [1 if axis == skip else 3 for axis in range(cells.ndim)]
        return np.asarray(uniform_filter(maximum_filter(cells, size), size))
    for axis in range(cells.ndim):
        if axis != skip:
            cells = convolve1d(cells, _SMOOTH, axis=axis, mode="nearest")
    return np.asarray(cells)


def at_knots(slabs: Sequence[Array], steps: Array, breadth: Breadth) -> list[Array]:
    """Sources at the knots between slabs, in between linear: means of the slabs about a knot, or the larger one."""
    if breadth is Breadth.MEAN:
        inner = [(p * h + q * g) / (h + g) for (p, q), (h, g) in zip(pairwise(slabs), pairwise(steps))]
    else:
        inner = [np.maximum(p, q) for p, q in pairwise(slabs)]
    return [slabs[0], *inner, slabs[-1]]


__all__ = ["BREADTHS", "Breadth", "at_knots", "at_nodes"]
