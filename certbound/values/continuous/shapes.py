"""What proposals in one state are made of: layers at faces, grids, and cut ends (plain floats).

No floor is put under V: at the horizon it falls from each face as a straight line, V = -k d, and evolves from there
into the parabola -d^2 / (2 a tau) by a smooth tangent, with no corner that travels through the grid. Where V is far
below the answer the proof pays in units of the answer, and the grid may be coarse.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from certbound.arrays import Array
from certbound.values.continuous.proposal import Line, Sketch, through

_SPARE = 8.0
_MOST_CELLS = 20_000.0
_SLIVER = 3e-3  # of the way to the starts
_ROOM = 6.0  # how far below the answer V is to be known, as a logarithm
_BACKGROUND = 0.3  # share of the cells that is spread evenly


def sealed(line: Line, level: float, *, gated: bool = False) -> tuple[Line, tuple[bool, bool]]:
    """The line cut where the drift back inside keeps almost every path away: cut ends, and which they are.

    An end is cut (for upper bounds; for lower bounds it is known to be out of reach) where exp(-int 2 |f| / a) along
    the way out is far below P. The proof does not rest on that: leaving the longer line means leaving the shorter one.
    Held ends stay as they are, but before a gate (``gated``), whose front no cells hold where the noise ends.
    """
    ends, cut = [line.low, line.high], [False, False]
    for side in (0, 1):
        place = None if line.held[side] and not gated else _cut(line, side, _SPARE - level)
        if place is not None:
            ends[side], cut[side] = place, True
    held = (line.held[0] and not cut[0], line.held[1] and not cut[1])
    return replace(line, low=ends[0], high=ends[1], held=held), (cut[0], cut[1])


def before_held(line: Line) -> Line:
    """The line cut a little before its held ends."""
    middle = 0.5 * sum(line.starts)
    low, high = (
        end + _SLIVER * (middle - end) if held else end for end, held in zip((line.low, line.high), line.held)
    )
    return replace(line, low=low, high=high, held=(False, False))


def _cut(line: Line, side: int, barrier: float) -> float | None:
    """Where the way out from the starts (or from where the drift turns outward) has passed the barrier."""
    sign = 1.0 if side == 1 else -1.0
    begin, end = (line.starts[1], line.high) if side == 1 else (line.starts[0], line.low)
    x = np.linspace(begin, end, 4001)
    inward = np.min([(-sign * line.drift(t, x)).min(axis=0) for t in np.linspace(0, line.horizon, 9)], axis=0)
    most = np.max([line.square(t, x) for t in np.linspace(0, line.horizon, 9)], axis=0)
    outward = np.flatnonzero(inward <= 0)
    first = int(outward[-1]) if len(outward) else 0
    slope = np.where(np.arange(len(x)) >= first, 2 * inward / np.maximum(most, 1e-300), 0.0)
    height = np.cumsum(slope) * abs(x[1] - x[0])
    if not height[-1] > 1.3 * barrier:
        return None
    return float(x[int(np.argmax(height > barrier))])


def either(first: Array, second: Array) -> Array:
    """log(1 - (1 - e^first)(1 - e^second)): 0 exactly wherever one of them is."""
    most, least = np.maximum(first, second), np.minimum(first, second)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # of a proposal that is of no use, or its start
        return np.asarray(most + np.log1p(np.exp(least - most) - np.exp(least)))


def _distance(line: Line, x: Array, side: int) -> Array:
    return x - line.low if side == 0 else line.high - x


def _at_face(line: Line, side: int) -> tuple[float, float]:
    """a at a face at the horizon, and the drift away from it."""
    x = np.array([line.low if side == 0 else line.high])
    inward = float((line.drift(line.horizon, x) * (1 if side == 0 else -1)).min())
    return max(float(line.square(line.horizon, x)[0]), 1e-300), inward


def layer(line: Line, side: int, lead: float) -> tuple[float, float]:
    """Rate k and bend c of the layer (1 + c k d) exp(-k d), whose u'' a / 2 + f u' is 0 at the face."""
    a, inward = _at_face(line, side)
    rate = 1.3 * float(np.sqrt(2 / (a * lead))) + 4 * max(inward, 0.0) / a
    bend = (rate * a / 2 - inward) / (rate * a - inward)
    return rate, float(np.clip(bend, 0.0, 0.9))


def rise(line: Line, side: int, speed: float) -> float:
    """The slope k at which V = -k d follows a face whose value rises at that speed: a k^2 / 2 - f k = speed."""
    a, inward = _at_face(line, side)
    return (inward + float(np.sqrt(max(inward, 0.0) ** 2 + 2 * a * max(speed, 1e-9)))) / a


def spread(line: Line, marks: Sequence[tuple[float, float]], rough: Sketch, fineness: float) -> Array | None:
    """Nodes in proportion to the lengths over which V bends, 1/sqrt(a V''), wherever it is not far below the answer.

    None where that needs too many, or a slope is beyond floats.

    Beside a mark (place, k) V is a line of slope k that turns into a parabola at the distance a k tau: sqrt(k / d)
    bends a length; and where the parabola is above log P - 6, at most sqrt(2 L) / d, L = 6 - log P. At t = 0 the sketch
    knows V''.
    """
    even = np.linspace(line.low, line.high, 8001)
    away = np.geomspace(0.02, 200.0, 400)
    close = [place + np.concatenate([-away, away]) / rate for place, rate in marks]
    fine = np.unique(np.concatenate([even, *close]))
    fine = fine[(fine >= line.low) & (fine <= line.high)]
    scale = line.spread_of(fine)
    way = np.concatenate([[0.0], np.cumsum(0.5 * (scale[1:] + scale[:-1]) * np.diff(fine))])
    depth = max(-rough.level, 1.0) + _ROOM
    density = _bends(rough, fine) / scale
    for place, rate in marks:
        slope = rate / float(np.interp(place, fine, scale))
        distance = np.abs(way - np.interp(place, fine, way))
        with np.errstate(all="ignore"):
            near, later = np.sqrt(slope / (distance + 1 / slope)), np.sqrt(2 * depth) / np.maximum(distance, 1e-12)
        density = density + np.minimum(near, later)
    density = density + (_BACKGROUND * np.trapezoid(density, way) + 4) / way[-1]
    total = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(way))])
    if not fineness * total[-1] <= _MOST_CELLS:
        return None
    nodes = np.interp(np.linspace(0, total[-1], int(np.ceil(fineness * total[-1])) + 1), total, fine)
    nodes[0], nodes[-1] = line.low, line.high
    return through(nodes, line.starts)


def _bends(rough: Sketch, fine: Array) -> Array:
    """sqrt |V''| at time 0 where V is not far below the answer."""
    even = np.linspace(fine[0], fine[-1], 401)
    values = np.interp(even, rough.nodes, rough.values)
    curved = np.abs(np.gradient(np.gradient(values, even), even))
    return np.interp(fine, even, np.sqrt(np.where(values > rough.level - _ROOM, curved, 0.0)))
