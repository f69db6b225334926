"""What the proposal of a phase starts from at its end: layers at new faces, steps at gates (plain floats).

At the end of a phase V is that of the next one, but for two things. A face that the next phase does not have needs a
layer, as at the horizon. Beyond a gate V is 0; there the next V, a line that falls from the gate, is bent smoothly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from certbound.arrays import Array
from certbound.values.continuous.proposal import Boundary, Line, Sketch, propose
from certbound.values.continuous.shapes import either, layer, rise, spread
from certbound.values.continuous.surface import Surface

Values = Callable[[Array], Array]
_SHARE = 0.005  # what a lower bound starts from at the horizon, as a share of P; it is subtracted at last
_DEEP = 3.0  # how far below log P an upper V has its floor where paths come to rest
_APART = 4.0  # how far beyond a gate a lower V begins to rise, in units of its slope
_BENT = 3.0  # over which length V is bent at a gate, in units of its slope
_SHARPER = 0.25  # at jumps, what lower bounds need in addition: their V has to rise from far below
_SOFTER = 2.0  # at gates where V need not jump: what is lost by bending it is of second order
_SHIFTED = 1e-3  # a face at which the next V is lower than this is new


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class End:
    """The end of a phase in its own coordinate: the gate's ends, and the next V there (None: nothing comes after)."""

    gate: tuple[float, float]
    after: Values | None


def values_of(surface: Surface) -> Values:
    """V at the surface's beginning as a function of its coordinate; 0 beyond its faces."""
    from scipy.interpolate import BPoly

    nodes = surface.axes[0]
    curve = BPoly.from_derivatives(nodes, surface.values[0])

    def values(y: Array) -> Array:
        inside = (y > nodes[0]) & (y < nodes[-1])
        return np.where(inside, curve(np.clip(y, nodes[0], nodes[-1])), 0.0)

    return values


def propose_above(
    line: Line, end: End, rough: Sketch, lead: float, sharpness: float, *, fineness: float, tolerance: float
) -> Surface | None:
    """V = 0 on both faces and beyond the gate."""
    layers = [(0.0, 0.0) if line.held[side] else layer(line, side, lead) for side in (0, 1)]
    steep = _gate_slopes(line, end, rough, sharpness, 1.0)

    def profile(y: Array) -> Array:
        rows: list[tuple[Array, Array | None, float]] = []
        for side, (rate, bend) in enumerate(layers):
            inward = _inward(y, end.gate, side)
            if _inside(line, end, side):  # the gate stands in the room: smooth from 0 there
                falls = -steep[side] * np.maximum(inward, 0.0) if _jump(line, end, side) else 0.0 * y
                rows.append((falls, inward, _BENT / steep[side]))
            elif _new(line, end, side):
                away = rate * _inward(y, (line.low, line.high), side)
                rows.append((np.log1p(bend * away) - away, None, 0.0))
        total = np.full(len(y), -np.inf) if end.after is None else end.after(y)
        for value, _, _ in rows:
            if np.any(value):
                total = either(np.minimum(total, 0.0), np.minimum(value, 0.0))
        for _, past, depth in rows:
            if past is not None:
                total = np.minimum(total, 0.0) * _smooth(past / depth)
        if line.absorbing:
            total = np.logaddexp(total, rough.level - _DEEP)
        return np.asarray(np.maximum(total, -1e4))

    zero = np.zeros(2)
    boundary = Boundary(profile=profile, faces=lambda tau: (zero, zero), step=_first_step(line, end, steep, lead))
    slopes = [None if line.held[side] else rate for side, (rate, _) in enumerate(layers)]
    nodes = spread(line, _marks(line, end, slopes, steep), rough, fineness)
    return propose(line, nodes, boundary, tolerance=tolerance, level=rough.level)


def propose_below(
    line: Line, end: End, rough: Sketch, lead: float, sharpness: float, closed: tuple[bool, bool],
    far: tuple[bool, bool], *, fineness: float, tolerance: float, floor: float | None = None,
) -> Surface | None:
    """V <= 0; on faces 0 after a rise, V' = 0 on far ones; at the horizon and on cut faces a small share of P at most.

    With a ``floor`` it is just that there.
    """
    top = rough.level + float(np.log(_SHARE)) if floor is None else floor
    floor = top if line.absorbing and end.after is None else floor
    steep = _gate_slopes(line, end, rough, sharpness, _SHARPER)
    rates = [0.0 if line.held[side] else rise(line, side, -2 * top / lead) for side in (0, 1)]

    def flat(y: Array) -> Array:
        return np.full(len(y), top)

    absent = (far[0] or line.held[0], far[1] or line.held[1])
    profile = flat if floor is not None else _profile_below(line, end, absent, top, rates, steep)
    at_faces = profile(np.array([line.low, line.high]))
    target = np.where(closed, 0.0, top)
    rising = np.array(closed) & (at_faces < -1e-9)
    target = np.where(np.array(closed) | (end.after is None), target, np.minimum(at_faces, top))

    def faces(tau: float) -> tuple[Array, Array]:
        s = min(tau / lead, 1.0)
        gap = np.where(rising, target - at_faces, 0.0)
        value = at_faces + gap * s**3 * (10 - 15 * s + 6 * s * s)
        return value, gap * 30 * (s * (1 - s)) ** 2 / lead

    boundary = Boundary(profile=profile, faces=faces, step=_first_step(line, end, steep, lead), free=far)
    slopes = [None if absent[k] else rates[k] for k in (0, 1)]
    nodes = spread(line, _marks(line, end, slopes, steep), rough, fineness)
    return propose(line, nodes, boundary, tolerance=tolerance, level=rough.level)


def propose_arrival(
    line: Line, side: int, rough: Sketch, lead: float, floor: float, *, fineness: float, tolerance: float
) -> Surface | None:
    """V = 0 on one face at all times, and ``floor`` on the other one and at the horizon, but for a layer."""
    (rate, bend), least = layer(line, side, lead), float(np.exp(floor))

    def profile(y: Array) -> Array:
        away = rate * np.maximum(_inward(y, (line.low, line.high), side), 0.0)
        return np.asarray(np.log(least + (1 - least) * (1 + bend * away) * np.exp(-away)))

    ends, zero = profile(np.array([line.low, line.high])), np.zeros(2)
    boundary = Boundary(profile=profile, faces=lambda tau: (ends, zero), step=0.02 * lead)
    nodes = spread(line, [(line.low if side == 0 else line.high, rate)], rough, fineness)
    return propose(line, nodes, boundary, tolerance=tolerance, level=rough.level)


def _profile_below(
    line: Line, end: End, far: tuple[bool, bool], top: float, rates: list[float], steep: list[float]
) -> Values:
    def profile(y: Array) -> Array:
        inward = [_inward(y, end.gate, side) for side in (0, 1)]
        if end.after is not None:
            total = np.minimum(end.after(y), 0.0)
        else:
            rows = []
            for side in (0, 1):
                stands = _inside(line, end, side)
                away = inward[side] if stands else _inward(y, (line.low, line.high), side)
                k = steep[side] if stands else rates[side]
                rows.append(np.full(len(y), -np.inf) if far[side] else -k * np.maximum(away, 0.0))
            total = top + (either(*rows) if not all(far) else 0.0 * y)
        for side in (0, 1):
            if not _inside(line, end, side):
                continue
            if end.after is not None and _jump(line, end, side):
                falls = steep[side] * inward[side] + _APART - end.after(_mark(end, side))[0]
                total = either(total, -np.logaddexp(0.0, falls))
                continue
            k = steep[side] if end.after is None else _slope(line, end, side)
            shift = -top if end.after is None else 0.0
            z, width = k * inward[side] + shift, k * _BENT / steep[side]
            soft = -0.5 * (z + np.sqrt(z * z + width * width))
            rest = np.where(inward[side] > 0, np.minimum(total, 0.0) + np.maximum(z, 0.0), 0.0)
            total = np.minimum(soft + rest * _smooth(inward[side] * steep[side] / _BENT), soft + rest)
        return np.asarray(np.maximum(total, -1e4))

    return profile


def _inward(y: Array, ends: tuple[float, float], side: int) -> Array:
    return y - ends[0] if side == 0 else ends[1] - y


def _inside(line: Line, end: End, side: int) -> bool:
    """Whether an end of the gate stands inside the phase's box."""
    slack = 1e-9 * (line.high - line.low)
    return bool(end.gate[0] > line.low + slack) if side == 0 else bool(end.gate[1] < line.high - slack)


def _mark(end: End, side: int) -> Array:
    return np.array([end.gate[side]])


def _jump(line: Line, end: End, side: int) -> bool:
    """Whether V has to jump at an end of the gate, since the next V is below 0 there."""
    if end.after is None:
        return True
    near = end.gate[side] + (1e-6 if side == 0 else -1e-6) * (line.high - line.low)
    return bool(end.after(np.array([near]))[0] < -0.02)


def _new(line: Line, end: End, side: int) -> bool:
    if line.held[side]:
        return False
    if end.after is None:
        return True
    face = np.array([line.low if side == 0 else line.high])
    return bool(end.after(face)[0] < -_SHIFTED)


def _gate_slopes(line: Line, end: End, rough: Sketch, sharpness: float, jump: float) -> list[float]:
    """How steep V may be beside a gate: it moves the gate by 1/k, and P by sqrt(2 |log P| / (a T)) times that."""
    found = []
    for side in (0, 1):
        place = np.array([line.low if side == 0 else line.high])
        spread_out = max(float(np.sqrt(line.square(line.horizon, place)[0] * line.horizon)), 1e-150)
        sharp = sharpness * (jump if _inside(line, end, side) and _jump(line, end, side) else _SOFTER)
        found.append(float(np.sqrt(2 * (1 - rough.level))) / (spread_out * sharp))
    return found


def _slope(line: Line, end: End, side: int) -> float:
    """How steeply the next V falls from an end of the gate."""
    if end.after is None or not _inside(line, end, side):
        return 0.0
    step = 1e-4 * (line.high - line.low)
    inside = end.gate[side] + (step if side == 0 else -step)
    return max(float(-end.after(np.array([inside]))[0] / step), 1e-6)


def _smooth(s: Array) -> Array:
    s = np.clip(s, 0.0, 1.0)
    return np.asarray(s**3 * (10 - 15 * s + 6 * s * s))


def _first_step(line: Line, end: End, steep: list[float], lead: float) -> float:
    """A step that follows what happens first: a layer at a face, or V that is bent at a gate."""
    step = 0.02 * lead
    for side in (0, 1):
        if _inside(line, end, side):
            a = max(float(line.square(line.horizon, _mark(end, side))[0]), 1e-300)
            step = min(step, 0.02 / (a * steep[side] ** 2))
    return step


def _marks(line: Line, end: End, rates: list[float | None], steep: list[float]) -> list[tuple[float, float]]:
    """Faces and ends of the gate, each with the slope of V beside it."""
    faces = [
        (place, rate)
        for side, (place, rate) in enumerate(zip((line.low, line.high), rates))
        if rate is not None and not _inside(line, end, side)  # behind a gate V is 0 up to the face
    ]
    return faces + [(end.gate[side], steep[side]) for side in (0, 1) if _inside(line, end, side)]


def shifted(line: Line, start: float) -> Line:
    """A line whose clock begins at a time."""
    return replace(
        line, drift=lambda t, y: line.drift(start + t, y), square=lambda t, y: line.square(start + t, y)
    )
