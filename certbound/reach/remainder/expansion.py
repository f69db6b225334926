"""Boxes of the deviation: the remainder beta of Thm K7 expanded to second order on each of them.

About the centre c of a box and the middle t_m of a piece,

    beta = beta(t_m, c) + (J(t_m, c) - J_m) . d + d . H d / 2 + (motion over the piece),     |d| <= e,

with the interval Hessian H over the box and the piece. In continuous time the motion is that of beta's difference from
what it is at s = 0, which `certbound.reach.remainder.nominal_defect` encloses apart. Values at points are enclosed by
intervals; everything that is a radius is summed in floats and widened by a bound of the rounding errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Index, Mask
from certbound.constants.enclosures import enclose
from certbound.reach.remainder.derivatives import Derivatives
from certbound.reach.remainder.frame import Frame
from certbound.reach.remainder.lines import follow_lines
from certbound.reach.remainder.nominal_defect import NominalDefect, product
from certbound.reach.remainder.polytope import Boxes, Polytope, linear_range
from certbound.rigor.intervals import Interval, stack

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


@dataclass(frozen=True, eq=False, kw_only=True)
class _Enclosed:
    """Boxes, the reach of all states, the model at their centres (``slots``) and over the whole, its derivatives."""

    boxes: Boxes
    reach: Array
    slots: list[Interval]
    wide: list[Interval]
    first: Interval | None
    second: Interval | None
    planes: Interval | None  # slopes of planes in place of the first derivatives


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
        self.nominal = NominalDefect(model, frame) if frame.half else None

    def parts(self, boxes: Boxes) -> Parts:
        """The expansions on boxes; to first order, with the Jacobian over the whole box, where it may jump.

        The kinks of networks are bounded by planes instead: beta is a linear function up to their distance.
        """
        if self.model.planar:
            return self._expanded(boxes, order=1)
        parts = self._expanded(boxes, order=2)
        if not self.model.kinked or not parts.bad.any():
            return parts
        kinks = np.flatnonzero(parts.bad)
        other = self._expanded(boxes[kinks], order=1)
        merged = {name: getattr(parts, name).copy() for name in Parts.__dataclass_fields__}
        for name, array in merged.items():
            array[kinks] = getattr(other, name)
        return Parts(**merged)

    def _expanded(self, boxes: Boxes, *, order: int) -> Parts:
        held, value, bad = self._enclosed(boxes, order)
        with np.errstate(invalid="ignore", over="ignore"):
            lower, upper, middle = self._values(boxes, value, *self._base(boxes.items, order))
            gradient, blur = self._gradients(boxes.items, held.first if held.planes is None else held.planes)
            spend = np.zeros((*lower.shape, len(self.active)))
            if order == 2:
                plus, minus, spend = self._curvature(held)
                if self.frame.half:
                    motion, shaken = self._second_motion(held)
                    plus, minus, blur = plus + motion, minus + motion, blur + shaken
                upper, lower = upper + (plus * _WIDE + _LEAST), lower - (minus * _WIDE + _LEAST)
                upper, lower = upper + 8 * _UNIT * np.abs(upper), lower - 8 * _UNIT * np.abs(lower)
                if self.frame.half and self.model.timed:
                    timed, motion = self.model.timed, self._explicit_time(held)
                    up, down = upper[:, timed], lower[:, timed]
                    upper[:, timed] = (up + motion) + 4 * _UNIT * (np.abs(up) + motion)
                    lower[:, timed] = (down - motion) - 4 * _UNIT * (np.abs(down) + motion)
            elif self.frame.half:
                motion, shaken = self._first_motion(held)
                upper = upper + (motion + 8 * _UNIT * (np.abs(upper) + motion))
                lower = lower - (motion + 8 * _UNIT * (np.abs(lower) + motion))
                blur = blur + shaken
        return Parts(lower=lower, upper=upper, gradient=gradient, blur=blur * _WIDE + _LEAST, middle=middle,
                     spend=spend, bad=bad)

    def _enclosed(self, boxes: Boxes, order: int) -> tuple[_Enclosed, Interval, Mask]:
        """What is known over boxes, f at their centres, and where something is not defined."""
        f, model, items = self.frame, self.model, boxes.items
        count, n, entries = len(boxes), f.spread.shape[1], len(self.entries)
        shift, reach = np.zeros((count, n)), f.spread[items]
        shift[:, self.active] = boxes.centre
        reach[:, self.active] += boxes.radius
        reach = reach * (1 + 1e-14)
        thin = f.middle[items] + shift
        slots = model.slots(f.middle_time[items], thin, f.inputs[items], f.disturbance_middle)
        wide = model.slots(f.span[items], thin + Interval(-reach, reach), f.inputs[items], f.disturbance_middle)
        planes: Interval | None = None
        if model.planar:
            value, planes = self._planes(slots, boxes.radius)
        else:
            value = enclose(model.value, slots, undefined="infinite").broadcast_to((count, n))
        bad = _infinite(value)
        if model.jumping:  # no derivative shows a jump: it must be decided over the whole box and piece
            bad = bad | _infinite(enclose(model.value, wide, undefined="infinite").broadcast_to((count, n)))
        first = second = None
        if entries and (planes is None or f.half):
            where = slots if order == 2 else wide
            first = enclose(model.varying, where, undefined="infinite").broadcast_to((count, entries))
            bad = bad | _infinite(first)
        if order == 2 and (self.second or model.kinked):
            columns = len(model.second.outputs)
            second = enclose(model.second, wide, undefined="infinite").broadcast_to((count, columns))
            bad = bad | _infinite(second)
        held = _Enclosed(
            boxes=boxes, reach=reach, slots=slots, wide=wide, first=first, second=second, planes=planes
        )  # fmt: skip
        return held, value, bad

    def _planes(self, slots: list[Interval], radius: Array) -> tuple[Interval, Interval]:
        """What planes leave of f (Q, n), and their slopes by the varying entries (Q, E)."""
        count = len(radius)
        lines = follow_lines(self.model.value, slots, {1 + j: radius[:, a] for a, j in enumerate(self.active)})
        rests = [line.rest.broadcast_to((count,)) for line in lines]
        nothing = Interval.point(np.zeros(count))
        slopes = [
            lines[i].coefficients.get(1 + int(self.active[a]), nothing).broadcast_to((count,)) for i, a in self.entries
        ]
        return stack(rests, axis=1), stack(slopes, axis=1) if slopes else nothing[:, None][:, :0]

    def _first_motion(self, held: _Enclosed) -> tuple[Array, Array]:
        """The motion over the piece, by the rate of beta over the whole box and piece: of beta, of its slopes."""
        f, model, half, items = self.frame, self.model, self.frame.half, held.boxes.items
        velocity, drift = f.velocity[items], self.drift[items]
        rate = product(model.constant_slope, velocity) - f.acceleration[items]
        box = (Interval(-held.boxes.radius, held.boxes.radius) + held.boxes.centre)[:, self.columns] * drift
        rates = [rate[:, i] for i in range(rate.shape[1])]
        for p, i in enumerate(self.gather.argmax(axis=1)):
            rates[i] = rates[i] - box[:, p]
        for entry, (i, a) in enumerate(self.entries):
            assert held.first is not None
            rates[i] = rates[i] + held.first[:, entry] * velocity[:, self.active[a]]
        if model.timed:
            by_time = enclose(model.time, held.wide, undefined="infinite").broadcast_to((len(items), len(model.timed)))
            for column, i in enumerate(model.timed):
                rates[i] = rates[i] + by_time[:, column]
        motion = np.stack([half * rate.mag * _WIDE + _LEAST for rate in rates], axis=1)
        return motion, half * np.abs(drift[:, self.chosen])

    def _base(self, items: Index, order: int) -> tuple[Interval, Interval | None]:
        """What beta is counted from at the middle of a piece, and beta itself there over the piece."""
        if self.nominal is None or order == 1:
            return self.frame.middle_velocity[items], None
        return self.nominal.value[items], self.nominal.defect[items]

    def _values(
        self, boxes: Boxes, value: Interval, base: Interval, rest: Interval | None
    ) -> tuple[Array, Array, Array]:
        """beta(t_m, c) = f - base - J_m c, and the ``rest`` that it has at s = 0: bounds and floats."""
        items, centre = boxes.items, boxes.centre
        product = self.slope[items] * centre[:, self.columns]
        moved, size = product @ self.gather, np.abs(product) @ self.gather
        blur = (self.slope_rad[items] * np.abs(centre[:, self.columns])) @ self.gather
        slack = self.relative * (size + value.mag + base.mag) + blur * _WIDE + _LEAST
        middle = (value.lo + value.hi - base.lo - base.hi) / 2 - moved
        lower, upper = value.lo - base.hi - moved - slack, value.hi - base.lo - moved + slack
        if rest is None:
            return lower, upper, middle
        known = np.isfinite(lower) & np.isfinite(upper)
        total = Interval(np.where(known, lower, -np.inf), np.where(known, upper, np.inf)) + rest
        return total.lo, total.hi, middle

    def _gradients(self, items: Index, first: Interval | None) -> tuple[Array, Array]:
        """J(t_m, c) - J_m entry by entry: floats and radii."""
        if first is None:
            nothing = np.zeros((len(items), 0))
            return nothing, nothing.copy()
        slope = self.slope[items][:, self.chosen]
        gradient = (first.lo + first.hi) / 2 - slope
        blur = (first.hi - first.lo) / 2 + self.slope_rad[items][:, self.chosen]
        return gradient, blur + 8 * _UNIT * (first.mag + np.abs(slope))

    def _curvature(self, held: _Enclosed) -> tuple[Array, Array, Array]:
        """d H d / 2 upward and downward (Q, n), and what it costs in each coordinate (Q, n, active)."""
        radius = held.boxes.radius
        plus, minus = np.zeros(held.reach.shape), np.zeros(held.reach.shape)
        spend = np.zeros((*held.reach.shape, len(self.active)))
        for column, entry, b, other in self.second:
            if b < 0:
                continue
            assert held.second is not None
            lo, hi = held.second.lo[:, column], held.second.hi[:, column]
            size = np.maximum(-lo, hi)
            i, a = self.entries[entry]
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
        return plus, minus, spend

    def _second_motion(self, held: _Enclosed) -> tuple[Array, Array]:
        """The motion over the piece but for explicit time: of beta (Q, n), and of its slopes (Q, E)."""
        f, half, items = self.frame, self.frame.half, held.boxes.items
        velocity, shake = f.velocity[items].mid, f.velocity[items].rad
        pace = np.abs(velocity) + shake
        # dJ/dt: floats, radii; |J - J(c)|
        turn, blurred, swell = (np.zeros((len(items), len(self.entries))) for _ in range(3))
        bend = np.zeros(held.reach.shape)
        assert self.nominal is not None
        nominal = self.nominal.second[items]
        for column, entry, b, other in self.second:
            assert held.second is not None
            lo, hi = held.second.lo[:, column], held.second.hi[:, column]
            size = np.maximum(-lo, hi)
            i, a = self.entries[entry]
            centre, radius = (lo + hi) / 2, (hi - lo) / 2 + 4 * _UNIT * size
            change = np.maximum(hi - nominal.lo[:, column], nominal.hi[:, column] - lo)
            change = change + 4 * _UNIT * (size + np.maximum(-nominal.lo[:, column], nominal.hi[:, column]))
            for target, along in [(entry, b)] if other < 0 else [(entry, b), (other, a)]:
                if along < 0:
                    turn[:, target] += centre
                    blurred[:, target] += radius
                    swell[:, target] += half * size
                    bend[:, i] += 2 * change * pace[:, self.active[a]]
                    continue
                state = self.active[along]
                turn[:, target] += centre * velocity[:, state]
                blurred[:, target] += radius * pace[:, state] + size * (shake[:, state] + 16 * (
                    len(self.active) + 4) * _UNIT * pace[:, state])
                swell[:, target] += size * held.reach[:, state]
                bend[:, i] += change * pace[:, self.active[self.of_state[target]]] * pace[:, state]
        own = self.drift[items][:, self.chosen]
        shaken = half * (np.abs(turn - own) + blurred + 8 * _UNIT * (np.abs(turn) + np.abs(own)))
        return self._motion(held, swell, bend), shaken

    def _motion(self, held: _Enclosed, swell: Array, bend: Array) -> Array:
        """half |d gamma/dt at (t_m, c)| + half^2/2 |d^2 gamma/dt^2 at c|, without explicit time: (Q, n).

        gamma is beta less what it is at s = 0.
        """
        f, half, nominal, items, first = self.frame, self.frame.half, self.nominal, held.boxes.items, held.first
        assert nominal is not None
        rate = nominal.rate[items]
        turned = self.drift[items] * held.boxes.centre[:, self.columns]
        value, error = -rate.mid - turned @ self.gather, rate.rad
        size = np.abs(rate.mid) + np.abs(turned) @ self.gather
        curve = nominal.curve[items] + bend
        if first is not None:
            speed, acceleration = f.middle_velocity[items], f.acceleration[items].mag
            middle, radius = first.mid, first.rad
            along = nominal.first_over[items]
            change = np.maximum(first.hi - along.lo, along.hi - first.lo) + 4 * _UNIT * (first.mag + along.mag)
            for entry, (i, a) in enumerate(self.entries):
                j = self.active[a]
                v, r = speed.lo[:, j] / 2 + speed.hi[:, j] / 2, (speed.hi[:, j] - speed.lo[:, j]) / 2
                value[:, i] += middle[:, entry] * v
                size[:, i] += np.abs(middle[:, entry] * v)
                error[:, i] += radius[:, entry] * (np.abs(v) + r) + np.abs(middle[:, entry]) * (
                    r + 4 * _UNIT * np.abs(v))
                curve[:, i] += (change[:, entry] + swell[:, entry]) * acceleration[:, j]
        return half * (np.abs(value) + error + self.relative * size) + half * half / 2 * curve

    def _explicit_time(self, held: _Enclosed) -> Array:
        """What the derivatives by explicit time add to the motion, less what they are at s = 0: (Q, timed)."""
        model, half, nominal, items = self.model, self.frame.half, self.nominal, held.boxes.items
        assert nominal is not None
        shape = (len(items), len(model.timed))
        first = enclose(model.time, held.slots, undefined="infinite").broadcast_to(shape) - nominal.by_time[items]
        second = enclose(model.time2, held.wide, undefined="infinite").reshape(shape) - nominal.by_time_twice[items]
        return (half * first.mag + half * half / 2 * second.mag) * _WIDE

    def plain_range(self, parts: Parts, boxes: Boxes) -> tuple[Array, Array]:
        """Bounds of beta over whole boxes: (Q, n); infinite where beta is not defined."""
        n = parts.lower.shape[1]
        linear = np.zeros((len(boxes), n))
        for entry, (i, a) in enumerate(self.entries):
            linear[:, i] += (np.abs(parts.gradient[:, entry]) + parts.blur[:, entry]) * boxes.radius[:, a]
        return _closed(parts, linear, linear)

    def polytope_range(
        self, parts: Parts, boxes: Boxes, polytope: Polytope, outputs: Sequence[int] | None = None
    ) -> tuple[Array, Array]:
        """Bounds of beta over the parts of boxes in the polytopes of their pieces: (Q, n); none beside ``outputs``."""
        items, centre, radius, n = boxes.items, boxes.centre, boxes.radius, parts.lower.shape[1]
        matrix = np.zeros((len(items), n, len(self.active)))
        matrix[:, self.of_output, self.of_state] = np.where(parts.bad[:, None], 0.0, parts.gradient)
        blur = np.zeros((len(items), n))
        for entry, (i, a) in enumerate(self.entries):
            blur[:, i] += parts.blur[:, entry] * radius[:, a]
        own, low, high = polytope.rows[items], polytope.low[items], polytope.high[items]
        value = np.einsum("qda,qa->qd", own, centre)
        slack = 1e-13 * np.einsum("qda,qa->qd", np.abs(own), np.abs(centre))
        above = high - value + slack + 1e-15 * np.abs(high)
        below = value - low + slack + 1e-15 * np.abs(low)
        normals, room = np.concatenate([own, -own], axis=1), np.concatenate([above, below], axis=1)
        chosen = np.arange(n) if outputs is None else np.array(outputs)
        up, down = np.full((2, len(items), n), np.inf)
        for kept, sign in ((up, 1.0), (down, -1.0)):
            kept[:, chosen] = linear_range(sign * matrix[:, chosen], radius, normals, room)
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
