"""Boxes of the deviation: the remainder beta of Thm K7 expanded to second order on each of them.

About the centre c of a box and the middle t_m of a piece,

    beta = beta(t_m, c) + (J(t_m, c) - J_m) . d + d . H d / 2 + (motion over the piece),     |d| <= e,

with the interval Hessian H over the box and the piece. In continuous time the motion is that of beta's difference from
what it is at s = 0, which `certbound.reach.remainder.nominal_defect` encloses apart. Values at points are enclosed by
intervals; everything that is a radius is summed in floats and widened by a bound of the rounding errors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from certbound.constants.enclosures import enclose
from certbound.reach.remainder.derivatives import Derivatives
from certbound.reach.remainder.frame import Frame
from certbound.reach.remainder.nominal_defect import Still
from certbound.reach.remainder.polytope import linear_range
from certbound.rigor.intervals import Interval

__all__ = ["Expansion", "Parts"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

_UNIT = 2.0**-53
_WIDE = 1 + 1e-11  # covers the rounding errors of every sum of radii
_LEAST = 1e-290  # and their underflow


@dataclass(frozen=True, eq=False, kw_only=True)
class Parts:
    """beta on a batch of boxes (axis 0).

    ``lower`` and ``upper`` (Q, n) hold all but the linear term, which is ``gradient`` . d up to ``blur`` . |d|, with
    one column for each varying entry of the Jacobian (Q, E). ``middle`` is beta at the centres (floats), ``spend``
    (Q, n, active) what the width of each coordinate costs beyond the linear term (floats). Where ``bad``, beta is not
    defined on the whole box, and the other entries mean nothing.
    """

    lower: Array
    upper: Array
    gradient: Array
    blur: Array
    middle: Array
    spend: Array
    bad: Mask


class Expansion:
    """Expansions of one model over the pieces of one frame."""

    def __init__(self, model: Derivatives, frame: Frame) -> None:
        self.model, self.frame, self.active = model, frame, model.active
        n = frame.spread.shape[1]
        position = {int(state): a for a, state in enumerate(self.active)}
        self.entries = [(i, position[j]) for i, j in model.entries]
        used = np.any(frame.slope.mag[:, :, self.active] > 0, axis=0)
        for i, a in self.entries:
            used[i, a] = True
        rows, self.columns = np.nonzero(used)
        own = frame.slope[:, rows, self.active[self.columns]]
        self.slope, self.slope_rad = own.mid, own.rad
        self.drift = frame.drift[:, rows, self.active[self.columns]]
        self.gather = np.zeros((len(rows), n))
        self.gather[np.arange(len(rows)), rows] = 1.0
        where = {(int(i), int(a)): p for p, (i, a) in enumerate(zip(rows, self.columns, strict=True))}
        self.chosen = np.array([where[entry] for entry in self.entries], dtype=np.intp)
        self.of_output = np.array([i for i, _ in self.entries], dtype=np.intp)
        self.of_state = np.array([a for _, a in self.entries], dtype=np.intp)
        self.relative = 4 * (len(self.active) + 8) * _UNIT
        number = {entry: e for e, entry in enumerate(self.entries)}
        # (column, entry, its coordinate or -1 for time, the entry with both coordinates swapped or -1)
        self.second = []
        for column, (entry, state) in enumerate(model.second_index):
            i, a = self.entries[entry]
            b = -1 if state < 0 else position[state]
            self.second.append((column, entry, b, number.get((i, b), -1) if model.folded(entry, state) else -1))
        self.still = Still(model, frame) if frame.half else None

    def boxes(self, items: Indices, centre: Array, radius: Array) -> Parts:
        """The expansions on boxes centre + [-radius, radius] (Q, active) of the pieces ``items``.

        To first order, with the Jacobian over the whole box, where it may jump (abs, min, max).
        """
        parts = self._expanded(items, centre, radius, order=2)
        if not self.model.kinked or not parts.bad.any():
            return parts
        kinks = np.flatnonzero(parts.bad)
        other = self._expanded(items[kinks], centre[kinks], radius[kinks], order=1)
        merged = {name: getattr(parts, name).copy() for name in Parts.__dataclass_fields__}
        for name, array in merged.items():
            array[kinks] = getattr(other, name)
        return Parts(**merged)

    def _expanded(self, items: Indices, centre: Array, radius: Array, *, order: int) -> Parts:
        f, model = self.frame, self.model
        count, n, entries = len(items), f.spread.shape[1], len(self.entries)
        shift, reach = np.zeros((count, n)), f.spread[items]
        shift[:, self.active] = centre
        reach[:, self.active] += radius
        reach = reach * (1 + 1e-14)
        thin = f.middle[items] + shift
        slots = model.slots(f.middle_time[items], thin, f.inputs[items], f.disturbance_middle)
        wide = model.slots(f.span[items], thin + Interval(-reach, reach), f.inputs[items], f.disturbance_middle)
        value = enclose(model.value, slots, undefined="infinite").broadcast_to((count, n))
        bad = _infinite(value)
        if model.jumping:  # no derivative shows a jump: it must be decided over the whole box and piece
            bad = bad | _infinite(enclose(model.value, wide, undefined="infinite").broadcast_to((count, n)))
        first = second = None
        if entries:
            where = slots if order == 2 else wide
            first = enclose(model.varying, where, undefined="infinite").broadcast_to((count, entries))
            bad = bad | _infinite(first)
        if order == 2 and (self.second or model.kinked):
            columns = len(model.second.outputs)
            second = enclose(model.second, wide, undefined="infinite").broadcast_to((count, columns))
            bad = bad | _infinite(second)
        with np.errstate(invalid="ignore", over="ignore"):
            base, rest = self._base(items, order)
            lower, upper, middle = self._values(items, centre, value, base, rest)
            gradient, blur = self._gradients(items, first)
            spend = np.zeros((count, n, len(self.active)))
            if order == 1:
                self._first_order(items, centre, radius, wide, first, lower, upper, blur)
            else:
                self._second_order(items, centre, radius, reach, first, second, lower, upper, blur, spend)
                if f.half and model.timed:
                    self._explicit_time(items, slots, wide, lower, upper)
        return Parts(lower=lower, upper=upper, gradient=gradient, blur=blur * _WIDE + _LEAST, middle=middle,
                     spend=spend, bad=bad)

    def _first_order(
        self, items: Indices, centre: Array, radius: Array, wide: list[Interval], first: Interval | None,
        lower: Array, upper: Array, blur: Array,
    ) -> None:
        """Add the motion over the piece, by the rate of beta over the whole box and piece."""
        f, model, half = self.frame, self.model, self.frame.half
        if not half:
            return
        velocity, drift = f.velocity[items], self.drift[items]
        rate = _product(model.constant_slope, velocity) - f.acceleration[items]
        box = (Interval(-radius, radius) + centre)[:, self.columns] * drift
        rates = [rate[:, i] for i in range(rate.shape[1])]
        for p, i in enumerate(self.gather.argmax(axis=1)):
            rates[i] = rates[i] - box[:, p]
        for entry, (i, a) in enumerate(self.entries):
            assert first is not None
            rates[i] = rates[i] + first[:, entry] * velocity[:, self.active[a]]
        if model.timed:
            once = enclose(model.time, wide, undefined="infinite").broadcast_to((len(items), len(model.timed)))
            for column, i in enumerate(model.timed):
                rates[i] = rates[i] + once[:, column]
        for i, rate in enumerate(rates):
            motion = half * rate.mag * _WIDE + _LEAST
            lower[:, i] -= motion + 8 * _UNIT * (np.abs(lower[:, i]) + motion)
            upper[:, i] += motion + 8 * _UNIT * (np.abs(upper[:, i]) + motion)
        blur += half * np.abs(drift[:, self.chosen])

    def _base(self, items: Indices, order: int) -> tuple[Interval, Interval | None]:
        """What beta is counted from at the middle of a piece, and beta itself there over the piece."""
        if self.still is None or order == 1:
            return self.frame.middle_velocity[items], None
        return self.still.value[items], self.still.defect[items]

    def _values(
        self, items: Indices, centre: Array, value: Interval, base: Interval, rest: Interval | None
    ) -> tuple[Array, Array, Array]:
        """beta(t_m, c) = f - base - J_m c, and the ``rest`` that it has at s = 0: bounds and floats."""
        product = self.slope[items] * centre[:, self.columns]
        moved, size = product @ self.gather, np.abs(product) @ self.gather
        blur = (self.slope_rad[items] * np.abs(centre[:, self.columns])) @ self.gather
        slack = self.relative * (size + value.mag + base.mag) + blur * _WIDE + _LEAST
        middle = (value.lo + value.hi - base.lo - base.hi) / 2 - moved
        lower, upper = value.lo - base.hi - moved - slack, value.hi - base.lo - moved + slack
        if rest is None:
            return lower, upper, middle
        total = Interval(lower, upper) + rest
        return total.lo, total.hi, middle

    def _gradients(self, items: Indices, first: Interval | None) -> tuple[Array, Array]:
        """J(t_m, c) - J_m entry by entry: floats and radii."""
        if first is None:
            nothing = np.zeros((len(items), 0))
            return nothing, nothing.copy()
        slope = self.slope[items][:, self.chosen]
        gradient = (first.lo + first.hi) / 2 - slope
        blur = (first.hi - first.lo) / 2 + self.slope_rad[items][:, self.chosen]
        return gradient, blur + 8 * _UNIT * (first.mag + np.abs(slope))

    def _second_order(
        self, items: Indices, centre: Array, radius: Array, reach: Array, first: Interval | None,
        second: Interval | None, lower: Array, upper: Array, blur: Array, spend: Array,
    ) -> None:
        """Add d H d / 2 and the motion over the piece to the bounds and radii; fill in ``spend``."""
        f, half = self.frame, self.frame.half
        n, count = reach.shape[1], len(items)
        plus, minus = np.zeros((count, n)), np.zeros((count, n))
        if half:
            speed = f.velocity[items]
            velocity, shake = speed.mid, speed.rad
            pace = np.abs(velocity) + shake
            turn, blurred, swell = (np.zeros(blur.shape) for _ in range(3))  # dJ/dt: floats, radii; |J - J(c)|
            bend = np.zeros((count, n))
            assert self.still is not None
            beside = self.still.second[items]
        for column, entry, b, other in self.second:
            assert second is not None
            lo, hi = second.lo[:, column], second.hi[:, column]
            size = np.maximum(-lo, hi)
            i, a = self.entries[entry]
            if b >= 0:
                square = radius[:, a] * radius[:, b]
                if a == b:
                    plus[:, i] += np.maximum(hi, 0.0) * square / 2
                    minus[:, i] += np.maximum(-lo, 0.0) * square / 2
                else:
                    cost = size * square * (1.0 if other >= 0 else 0.5)
                    plus[:, i] += cost
                    minus[:, i] += cost
                    spend[:, i, b] += size * square / 2
                spend[:, i, a] += size * square / 2
            if not half:
                continue
            centre_h, radius_h = (lo + hi) / 2, (hi - lo) / 2 + 4 * _UNIT * size
            change = np.maximum(hi - beside.lo[:, column], beside.hi[:, column] - lo)
            change = change + 4 * _UNIT * (size + np.maximum(-beside.lo[:, column], beside.hi[:, column]))
            pairs = [(entry, b)] if other < 0 else [(entry, b), (other, a)]
            for target, along in pairs:
                if along < 0:
                    turn[:, target] += centre_h
                    blurred[:, target] += radius_h
                    swell[:, target] += half * size
                    bend[:, i] += 2 * change * pace[:, self.active[a]]
                    continue
                state = self.active[along]
                turn[:, target] += centre_h * velocity[:, state]
                blurred[:, target] += radius_h * pace[:, state] + size * (shake[:, state] + 16 * (
                    len(self.active) + 4) * _UNIT * pace[:, state])
                swell[:, target] += size * reach[:, state]
                bend[:, i] += change * pace[:, self.active[self.of_state[target]]] * pace[:, state]
        if half:
            drift = self.drift[items]
            if self.entries:
                own = drift[:, self.chosen]
                blur += half * (np.abs(turn - own) + blurred + 8 * _UNIT * (np.abs(turn) + np.abs(own)))
            motion = self._motion(items, centre, drift, first, swell, bend)
            plus += motion
            minus += motion
        upper += plus * _WIDE + _LEAST
        lower -= minus * _WIDE + _LEAST
        slack = 8 * _UNIT
        upper += slack * np.abs(upper)
        lower -= slack * np.abs(lower)

    def _motion(
        self, items: Indices, centre: Array, drift: Array, first: Interval | None, swell: Array, bend: Array
    ) -> Array:
        """half |d gamma/dt at (t_m, c)| + half^2/2 |d^2 gamma/dt^2 at c|, without explicit time: (Q, n).

        gamma is beta less what it is at s = 0.
        """
        f, half, still = self.frame, self.frame.half, self.still
        assert still is not None
        rate = still.rate[items]
        turned = drift * centre[:, self.columns]
        value, error = -rate.mid - turned @ self.gather, rate.rad
        size = np.abs(rate.mid) + np.abs(turned) @ self.gather
        curve = still.curve[items] + bend
        if first is not None:
            speed, acceleration = f.middle_velocity[items], f.acceleration[items].mag
            middle, radius = first.mid, first.rad
            beside = still.first_over[items]
            change = np.maximum(first.hi - beside.lo, beside.hi - first.lo) + 4 * _UNIT * (first.mag + beside.mag)
            for entry, (i, a) in enumerate(self.entries):
                j = self.active[a]
                v, r = speed.lo[:, j] / 2 + speed.hi[:, j] / 2, (speed.hi[:, j] - speed.lo[:, j]) / 2
                value[:, i] += middle[:, entry] * v
                size[:, i] += np.abs(middle[:, entry] * v)
                error[:, i] += radius[:, entry] * (np.abs(v) + r) + np.abs(middle[:, entry]) * (
                    r + 4 * _UNIT * np.abs(v))
                curve[:, i] += (change[:, entry] + swell[:, entry]) * acceleration[:, j]
        return half * (np.abs(value) + error + self.relative * size) + half * half / 2 * curve

    def _explicit_time(
        self, items: Indices, slots: list[Interval], wide: list[Interval], lower: Array, upper: Array
    ) -> None:
        """Add the derivatives by explicit time, less what they are at s = 0."""
        model, half, still = self.model, self.frame.half, self.still
        assert still is not None
        shape = (len(items), len(model.timed))
        once = enclose(model.time, slots, undefined="infinite").broadcast_to(shape) - still.once[items]
        twice = enclose(model.time2, wide, undefined="infinite").reshape(shape) - still.twice[items]
        for column, i in enumerate(model.timed):
            motion = (half * once.mag[:, column] + half * half / 2 * twice.mag[:, column]) * _WIDE
            upper[:, i] = (upper[:, i] + motion) + 4 * _UNIT * (np.abs(upper[:, i]) + motion)
            lower[:, i] = (lower[:, i] - motion) - 4 * _UNIT * (np.abs(lower[:, i]) + motion)

    def plain_range(self, parts: Parts, radius: Array) -> tuple[Array, Array]:
        """Bounds of beta over whole boxes: (Q, n); infinite where beta is not defined."""
        n = parts.lower.shape[1]
        linear = np.zeros((len(radius), n))
        for entry, (i, a) in enumerate(self.entries):
            linear[:, i] += (np.abs(parts.gradient[:, entry]) + parts.blur[:, entry]) * radius[:, a]
        return _closed(parts, linear, linear)

    def polytope_range(
        self, items: Indices, parts: Parts, centre: Array, radius: Array, low: Array, high: Array, rows: Array
    ) -> tuple[Array, Array]:
        """Bounds of beta over the parts of boxes in {low <= rows . s <= high}, given per piece: (Q, n)."""
        n = parts.lower.shape[1]
        matrix = np.zeros((len(items), n, len(self.active)))
        matrix[:, self.of_output, self.of_state] = np.where(parts.bad[:, None], 0.0, parts.gradient)
        blur = np.zeros((len(items), n))
        for entry, (i, a) in enumerate(self.entries):
            blur[:, i] += parts.blur[:, entry] * radius[:, a]
        own = rows[items]
        value = np.einsum("qda,qa->qd", own, centre)
        slack = 1e-13 * np.einsum("qda,qa->qd", np.abs(own), np.abs(centre))
        above = high[items] - value + slack + 1e-15 * np.abs(high[items])
        below = value - low[items] + slack + 1e-15 * np.abs(low[items])
        normals, room = np.concatenate([own, -own], axis=1), np.concatenate([above, below], axis=1)
        up, down = (linear_range(sign * matrix, radius, normals, room) for sign in (1.0, -1.0))
        return _closed(parts, down + blur, up + blur)


def _closed(parts: Parts, below: Array, above: Array) -> tuple[Array, Array]:
    """lower - below and upper + above, rounded outward; infinite where beta is not defined."""
    below, above = below * (1 + np.sign(below) * 1e-11), above * (1 + np.sign(above) * 1e-11)
    slack = 4 * _UNIT
    lower = parts.lower - below - slack * (np.abs(parts.lower) + np.abs(below)) - _LEAST
    upper = parts.upper + above + slack * (np.abs(parts.upper) + np.abs(above)) + _LEAST
    lost = parts.bad[:, None] | ~np.isfinite(lower) | ~np.isfinite(upper)
    return np.where(lost, -np.inf, lower), np.where(lost, np.inf, upper)


def _infinite(x: Interval) -> Mask:
    return np.asarray(~(np.isfinite(x.lo) & np.isfinite(x.hi)).all(axis=1))


def _product(matrix: Interval, vector: Interval) -> Interval:
    """``matrix`` (n, n) times a batch of interval vectors (M, n)."""
    return (matrix[None, :, :] * vector[:, None, :]).sum(axis=-1)
