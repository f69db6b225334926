"""Where paths can leave a box, and by how much v falls short of what is asked of it there (Thm K10, 10.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Mask
from certbound.rigor.intervals import Interval
from certbound.values.enclosing import enclose
from certbound.values.kolmogorov.cell_fields import Fields
from certbound.values.kolmogorov.splines import Axis, Banded, most_on_cells

ALWAYS = Interval.point(0.0)
"""The time where nothing changes with it."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Face:
    """One end of a box along an axis.

    Attributes
    ----------
    axis, side : int
        Which coordinate, and whether its lower (0) or upper (1) end.
    leaves : ndarray of bool, shape (N_1, ...) without that axis, or (slabs, N_1, ...)
        Face cells through which a path may leave: noise crosses, or the drift may point outward or along the face, at
        some time of the slab and for some disturbance.
    goal : float
        What is asked of v there.
    place : int or None
        The node where the face stands, if it is none of the box but one of the target.
    """

    axis: int
    side: int
    leaves: Mask
    goal: float
    place: int | None = None


def face_of(
    axes: Sequence[Axis], drift: Fields, noisy: bool, axis: int, side: int, goal: float,
    time: Interval = ALWAYS, disturbance: Sequence[Interval] = (),
) -> Face:  # fmt: skip
    """The face, with the cells where paths can leave by outward-rounded enclosures of the drift on and before it.

    ``time`` holds an interval for each slab where the drift changes with it, shape (slabs,).
    """
    others = [one for k, one in enumerate(axes) if k != axis]
    shape = tuple(one.cells for one in others)
    if noisy:
        return Face(axis=axis, side=side, leaves=np.ones(shape, dtype=bool), goal=goal)
    place = axes[axis].nodes[-side]
    ends = [(one.nodes[:-1], one.nodes[1:]) for one in others]
    lows, highs = (np.meshgrid(*rows, indexing="ij", sparse=True) for rows in zip(*ends))
    boxes = [Interval(low, high) for low, high in zip(lows, highs)]
    inward = float(np.nextafter(place, np.inf if side == 0 else -np.inf))  # the drift may jump on the face
    boxes.insert(axis, Interval(min(place, inward), max(place, inward)))
    slabs = time.shape
    time = time.reshape(*slabs, *[1] * len(axes[1:])) if slabs else time
    values, _ = enclose(drift.tape, [time, *boxes, *disturbance])
    across = values[axis].broadcast_to((*slabs, *shape))
    leaves = across.hi >= 0 if side else across.lo <= 0
    return Face(axis=axis, side=side, leaves=np.asarray(leaves), goal=goal)


def shortfall(axes: Sequence[Axis], face: Face, values: Array, rates: Array, steps: Array) -> Array:
    """goal - v, at least 0, on every face cell where paths can leave; shape (slabs, face cells).

    v lies above the least Bernstein coefficient, in space and time, of each face cell and slab.
    """
    others = tuple(one for k, one in enumerate(axes) if k != face.axis)
    layer, off = (-1 if face.side else 0), 0.0
    if face.place is not None:  # the first Bernstein coefficient of a cell is the value at its lower node
        axis = axes[face.axis]
        row = Banded(axis.bernstein.start[6 * face.place :][:1], axis.bernstein.weights[6 * face.place :][:1])
        off = 1e-11 + 1e-13 * float(axis.moved[face.place])
        sizes = [np.abs(rows).max(axis=tuple(range(1, rows.ndim)), keepdims=True) for rows in (values, rates)]
        values, rates = (row.along(rows, face.axis + 1) for rows in (values, rates))
        layer = 0
    v, d = (np.take(rows, layer, axis=face.axis + 1) for rows in (values, rates))
    h = steps.reshape(-1, *[1] * (v.ndim - 1)) / 3
    parts = (v[1:], v[1:] + h * d[1:], v[:-1] - h * d[:-1], v[:-1])
    most = np.maximum.reduce([most_on_cells(others, -part) for part in parts])
    missing = (face.goal + most) * (1 + 1e-12) + 1e-15
    if face.place is not None:
        size, rate = (np.squeeze(one, axis=face.axis + 1) for one in sizes)
        missing = missing + off * np.maximum(size[1:] + h * rate[1:], size[:-1] + h * rate[:-1])
    return np.where(face.leaves, np.maximum(missing, 0.0), 0.0)
