"""What proposals in one state start from: end profiles, faces, and weakened layers (plain floats)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from certbound.values.continuous.proposal import Boundary, Line, graded, propose
from certbound.values.continuous.surface import Surface

__all__ = ["propose_lower", "propose_upper"]

Array = NDArray[np.float64]

_SPARE = 6.0


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
    slopes = [_slope_cap(line, side, _SPARE - floor) for side in (0, 1)]
    layers = [_layer(line, side, cap, lead) for side, cap in zip((0, 1), slopes)]
    least = float(np.exp(floor))

    def profile(x: Array) -> Array:
        u = np.full(len(x), least)
        for side, (rate, bend) in enumerate(layers):
            distance = _distance(line, x, side)
            u += (1 - least) * (1 + bend * rate * distance) * np.exp(-rate * distance)
        return np.log(u)

    zero = np.zeros(2)
    boundary = Boundary(profile=profile, faces=lambda tau: (zero, zero))
    nodes = graded(line, cells, [1 / rate for rate, _ in layers])
    drift = _weakened(line, slopes)
    return propose(line, nodes, boundary, tolerance=tolerance, drift=drift, floor=floor)


def propose_lower(
    line: Line, level: float, lead: float, *, share: float, cells: int, tolerance: float
) -> Surface | None:
    """V constant at T; on the faces it rises to 0 within ``lead``, save at faces that no path reaches: V' = 0 there."""
    floor = level + float(np.log(share))
    free = tuple(_slope_cap(line, side, _SPARE - level) < np.inf for side in (0, 1))
    if all(free):
        free = (False, False)

    def faces(tau: float) -> tuple[Array, Array]:
        s = min(tau / lead, 1.0)
        value, rate = floor * (1 - s * s * (3 - 2 * s)), -floor * 6 * s * (1 - s) / lead
        return np.where(free, floor, value), np.where(free, 0.0, rate)

    boundary = Boundary(profile=lambda x: np.full(len(x), floor), faces=faces, free=(free[0], free[1]))
    sizes = [0.3 * (line.high - line.low) if gone else 1 / _layer(line, side, np.inf, lead)[0]
             for side, gone in enumerate(free)]  # fmt: skip
    nodes = graded(line, cells, sizes)
    return propose(line, nodes, boundary, tolerance=tolerance, floor=floor)


def _distance(line: Line, x: Array, side: int) -> Array:
    return x - line.low if side == 0 else line.high - x


def _inward(line: Line, x: Array, side: int) -> Array:
    """The drift away from a face, the least of all branches and of three times."""
    sign = 1.0 if side == 0 else -1.0
    times = (0.0, 0.5 * line.horizon, line.horizon)
    return np.min([(sign * line.drift(t, x)).min(axis=0) for t in times], axis=0)


def _slope_cap(line: Line, side: int, barrier: float) -> float:
    """A slope that reaches ``barrier`` when 2 |f| / a is cut off at it; inf where the drift holds no such barrier."""
    width = 0.45 * (line.high - line.low)
    distance = np.linspace(0.0, width, 2001)
    x = line.low + distance if side == 0 else line.high - distance
    inward = _inward(line, x, side)
    end = int(np.argmax(inward <= 0)) if (inward <= 0).any() else len(x)
    slopes = 2 * inward[:end] / np.maximum(line.square(0.0, x[:end]), 1e-300)
    step = distance[1]
    if slopes.sum() * step < barrier:
        return np.inf
    low, high = 0.0, float(slopes.max())
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if np.minimum(slopes, middle).sum() * step < barrier else (low, middle)
    return high


def _layer(line: Line, side: int, cap: float, lead: float) -> tuple[float, float]:
    """Rate k and bend c of the layer (1 + c k d) exp(-k d), whose u'' a / 2 + f u' is 0 at the face."""
    x = np.array([line.low if side == 0 else line.high])
    a = max(float(line.square(line.horizon, x)[0]), 1e-300)
    inward = min(float(_inward(line, x, side)[0]), cap * a / 2)
    rate = 1.3 * float(np.sqrt(2 / (a * lead))) + 4 * max(inward, 0.0) / a
    bend = (rate * a / 2 - inward) / (rate * a - inward)
    return rate, float(np.clip(bend, 0.0, 0.9))


def _weakened(line: Line, caps: list[float]) -> Callable[[float, Array], Array] | None:
    """The drift with further branches whose inward part near a face is cut off (the supremum takes them where V' asks
    for it): layers that no path crosses become wide enough for the grid."""
    if all(cap == np.inf for cap in caps):
        return None

    def drift(t: float, x: Array) -> Array:
        own = line.drift(t, x)
        half, weak = 0.5 * line.square(t, x), own.copy()
        middle = 0.5 * (line.low + line.high)
        if caps[0] < np.inf:
            weak = np.where(x < middle, np.minimum(weak, caps[0] * half), weak)
        if caps[1] < np.inf:
            weak = np.where(x > middle, np.maximum(weak, -caps[1] * half), weak)
        return np.concatenate([own, weak])

    return drift
