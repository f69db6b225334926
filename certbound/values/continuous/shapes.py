"""What proposals in one state start from: end profiles, faces, and cut ends (plain floats)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from certbound.arrays import Array
from certbound.values.continuous.proposal import Boundary, Line, graded, propose
from certbound.values.continuous.surface import Surface

_SPARE = 8.0


def sealed(line: Line, level: float) -> tuple[Line, tuple[bool, bool]]:
    """The line cut where the drift back inside keeps almost every path away: cut ends, and which they are.

    An end is cut (for upper bounds; for lower bounds it is known to be out of reach) where exp(-int 2 |f| / a) along
    the way out is far below P. The proof does not rest on that: leaving the longer line means leaving the shorter one.
    """
    ends, cut = [line.low, line.high], [False, False]
    for side in (0, 1):
        place = _cut(line, side, _SPARE - level)
        if place is not None:
            ends[side], cut[side] = place, True
    return replace(line, low=ends[0], high=ends[1]), (cut[0], cut[1])


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


def propose_upper(
    line: Line, level: float, lead: float, *, share: float, cells: int, tolerance: float
) -> Surface | None:
    """V = 0 on both faces; at T a layer at each face, evolved for about ``lead``, over a floor.

    Parameters
    ----------
    level : float
        Estimate of log P.
    lead : float
        Time by which the start profile is ahead: the relative cost is that of a longer horizon.
    share : float
        The floor is this share of P.
    """
    floor = level + float(np.log(share))
    layers = [_layer(line, side, lead) for side in (0, 1)]
    least = float(np.exp(floor))

    def profile(x: Array) -> Array:
        u = np.full(len(x), least)
        for side, (rate, bend) in enumerate(layers):
            distance = _distance(line, x, side)
            u += (1 - least) * (1 + bend * rate * distance) * np.exp(-rate * distance)
        return np.asarray(np.log(u))

    zero = np.zeros(2)
    boundary = Boundary(profile=profile, faces=lambda tau: (zero, zero), step=0.02 * lead)
    nodes = graded(line, cells, [1 / rate for rate, _ in layers])
    return propose(line, nodes, boundary, tolerance=tolerance, floor=floor)


def propose_lower(
    line: Line, level: float, lead: float, far: tuple[bool, bool], *, share: float, cells: int, tolerance: float
) -> Surface | None:
    """V constant at T; on the faces it rises to 0 within ``lead``, save on those that no path reaches: V' = 0 there."""
    floor = level + float(np.log(share))

    def faces(tau: float) -> tuple[Array, Array]:
        s = min(tau / lead, 1.0)
        value = floor * (1 - s**3 * (10 - 15 * s + 6 * s * s))
        rate = -floor * 30 * (s * (1 - s)) ** 2 / lead
        return np.full(2, value), np.full(2, rate)

    boundary = Boundary(profile=lambda x: np.full(len(x), floor), faces=faces, step=0.02 * lead, free=far)
    sizes = [0.3 * (line.high - line.low) if far[side] else 1 / _layer(line, side, lead)[0] for side in (0, 1)]
    return propose(line, graded(line, cells, sizes), boundary, tolerance=tolerance)


def _distance(line: Line, x: Array, side: int) -> Array:
    return x - line.low if side == 0 else line.high - x


def _layer(line: Line, side: int, lead: float) -> tuple[float, float]:
    """Rate k and bend c of the layer (1 + c k d) exp(-k d), whose u'' a / 2 + f u' is 0 at the face."""
    x = np.array([line.low if side == 0 else line.high])
    a = max(float(line.square(line.horizon, x)[0]), 1e-300)
    inward = float((line.drift(line.horizon, x) * (1 if side == 0 else -1)).min())
    rate = 1.3 * float(np.sqrt(2 / (a * lead))) + 4 * max(inward, 0.0) / a
    bend = (rate * a / 2 - inward) / (rate * a - inward)
    return rate, float(np.clip(bend, 0.0, 0.9))
