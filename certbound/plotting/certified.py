"""What is certified of every constraint over time: the room that a tube leaves of it, and the curve that this proves.

Where an engine measured the room along each constraint's own direction, that is shown: it is what the verdict's margin
is the least of. Elsewhere it is the room that the tube with noise leaves, a little smaller, since a tube holds for all
directions at once.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from certbound.arrays import Array
from certbound.plotting.asked import Panel
from certbound.plotting.scene import Scene
from certbound.reach.nominal import polynomial_range
from certbound.rigor.intervals import Interval
from certbound.rigor.norms import Norm

if TYPE_CHECKING:
    from certbound.reach.sets import ReachTube


def supports(tube: ReachTube, direction: Array) -> Array:
    """max a.x over the tube on each piece, over all cells: shape (K,)."""
    coefficients = tube.curve.coefficients
    along = [Interval.point(coefficients[:, :, j] @ direction) for j in range(coefficients.shape[2])]
    centre = polynomial_range(along, tube.curve.span)
    return np.asarray(np.max(np.asarray(centre.hi) + tube.spread(direction), axis=0))


def stairs(tube: ReachTube, values: Array) -> tuple[Array, Array]:
    """Piecewise-constant data as a polyline."""
    if not tube.curve.continuous:
        return np.asarray(tube.curve.starts), values
    return np.stack([tube.curve.starts, tube.curve.ends], axis=1).ravel(), np.repeat(values, 2)


def bounds_of(scene: Scene, panel: Panel) -> list[tuple[Array, Array]]:
    """For every limit of a panel the certified bound of its function and the room left, both (K,), piece by piece.

    The function stays on the inner side of each bound while its constraint is asked, at all times at once, but for the
    problem's delta. The room is ``inf`` where nothing is asked.
    """
    if scene.tube is None:
        return []
    if panel.direction is None:
        room = _distance(scene, panel)
        return [] if room is None else [(room, room)]
    found = []
    for limit, sign in ((panel.high, 1.0), (panel.low, -1.0)):
        if np.isfinite(limit):
            own = _along(scene, panel, sign)
            room = sign * limit - supports(scene.tube, sign * panel.direction) if own is None else own
            found.append((limit - sign * room, room))
    return found


def room_of(scene: Scene, panel: Panel) -> Array | None:
    """The certified room of a panel's constraints on each piece, in the units of the panel; None without a tube."""
    rooms = [room for _, room in bounds_of(scene, panel)]
    return np.asarray(np.min(rooms, axis=0)) if rooms else None


def _along(scene: Scene, panel: Panel, sign: float) -> Array | None:
    """The room that the engine measured of one side of a linear panel."""
    assert panel.direction is not None
    assert scene.tube is not None
    row = sign * panel.direction
    for number, rows, room in scene.rooms:
        if number in panel.numbers and len(room) == scene.tube.curve.pieces and np.array_equal(rows[0], row):
            return room
    return None


def _distance(scene: Scene, panel: Panel) -> Array | None:
    from certbound.reach.sets import constraint_clearance

    assert scene.tube is not None
    pieces = scene.tube.curve.pieces
    own = [room for number, _, room in scene.rooms if number in panel.numbers and len(room) == pieces]
    if own:
        return np.asarray(np.min(own, axis=0))
    room = constraint_clearance(scene.tube, panel.constraint, Norm(scene.tube.curve.dimension)).radius
    return np.asarray(room) if np.any(np.isfinite(room)) else None
