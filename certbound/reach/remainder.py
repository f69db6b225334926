"""What the linear response leaves over: rigorous bounds of the remainder beta of Thm K7.

On a piece with nominal curve p and slope Jhat(t) = J_m + (t - t_m) K,

    beta = f(t, p + s, d) - p' - Jhat s - E (d - d0),

over s in a polytope. The polytope is cut into boxes c + [-e, e] of the coordinates that enter the dynamics
nonlinearly; on each box beta is expanded to second order in s about c and in t about t_m, with the interval Hessian
as the rest term. Coordinates that no second derivative couples are handled side by side.

Symbols: H second derivatives of f, J first ones; Thm K7 and "Bounding beta" of docs/theory.md.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from certbound.constants.enclosures import enclose
from certbound.problem.problem import Problem
from certbound.problem.tape import Tape
from certbound.problem.trace import compile_numpy, jacobian
from certbound.rigor.intervals import Interval

__all__ = ["Frame", "Remainder"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_GRID = {1: 16, 2: 6, 3: 4}
_REFINED = 300
_EFFORT = ((0, np.inf), (2, 0.5), (3, 0.2), (3, 0.08))  # rounds of bisection, tolerated excess over the range


@dataclass(frozen=True, eq=False, kw_only=True)
class Frame:
    """Nominal data of a batch of pieces (axis 0), as enclosures.

    ``velocity`` encloses p' over the piece and ``middle_velocity`` at t_m (in discrete time the next node);
    ``spread`` bounds |p_t - p(t_m)|. ``half`` is half the length of a piece (0 in discrete time).
    """

    half: float
    middle_time: Interval
    span: Interval
    middle: Interval
    spread: Array
    middle_velocity: Interval
    velocity: Interval
    middle_acceleration: Interval
    acceleration: Interval
    jerk: Interval
    slope: Interval
    drift: Array
    input_gain: Array
    inputs: Array
    disturbance_middle: Array
    disturbance_low: Array
    disturbance_high: Array

    def __len__(self) -> int:
        return len(self.spread)

    def take(self, items: Indices) -> Frame:
        """The frame of a selection of pieces (with repetition)."""
        whole = ("half", "disturbance_middle", "disturbance_low", "disturbance_high")
        return Frame(**{
            name: getattr(self, name) if name in whole else getattr(self, name)[items]
            for name in self.__dataclass_fields__
        })


def _select(tape: Tape, outputs: list[int]) -> Tape:
    return Tape(
        inputs=tape.inputs, nodes=tape.nodes, outputs=tuple(tape.outputs[i] for i in outputs), shape=(len(outputs),)
    )


def _varying(tape: Tape) -> list[bool]:
    """Whether each output depends on any input."""
    depends: list[bool] = []
    for node in tape.nodes:
        depends.append(node.op == "input" or any(depends[arg] for arg in node.args))
    return [depends[output] for output in tape.outputs]


def _is_zero(tape: Tape, output: int) -> bool:
    node = tape.nodes[tape.outputs[output]]
    return node.op == "const" and node.value == 0


@dataclass(frozen=True, eq=False)
class Remainder:
    """Derivatives of the dynamics, sorted by what enters nonlinearly.

    Attributes
    ----------
    active : ndarray
        States whose column of the Jacobian is not constant.
    constant_slope : Interval, shape (n, n)
        Constant entries of the Jacobian (up to rounding), 0 where the entry varies.
    """

    problem: Problem
    active: Indices = field(init=False)
    constant_slope: Interval = field(init=False)
    blocks: list[list[list[int]]] = field(init=False)

    def __post_init__(self) -> None:
        tape = self.problem.closed_loop
        n = self.problem.system.dimension
        states = list(range(1, n + 1))
        first = jacobian(tape, states)
        moving = _varying(first)
        entries = [output for output in range(n * n) if moving[output]]
        fixed = [output for output in range(n * n) if not moving[output]]
        low, high = np.zeros(n * n), np.zeros(n * n)
        if fixed:
            nowhere = [Interval.point(np.zeros(1))] * len(tape.inputs)
            values = enclose(_select(first, fixed), nowhere, undefined="infinite")
            low[fixed], high[fixed] = values.broadcast_to((1, len(fixed))).lo[0], values.hi.reshape(-1)
        varying = _select(first, entries)
        second = jacobian(varying, [0, *states])
        kept = [o for o in range(len(entries) * (n + 1)) if not _is_zero(second, o)]
        q = len(self.problem.system.disturbance_names)
        slots = list(range(len(tape.inputs) - q, len(tape.inputs)))
        time = jacobian(tape, [0])
        timed = [i for i in range(n) if not _is_zero(time, i)]
        set_ = object.__setattr__
        set_(self, "constant_slope", Interval(low.reshape(n, n), high.reshape(n, n)))
        set_(self, "_entries", [divmod(e, n) for e in entries])
        set_(self, "_second_index", [(o // (n + 1), o % (n + 1) - 1) for o in kept])
        touched = {e % n for e in entries} | {o % (n + 1) - 1 for o in kept if o % (n + 1)}
        set_(self, "active", np.array(sorted(touched | self._stirring()), dtype=np.intp))
        set_(self, "_value", tape)
        set_(self, "_varying", varying)
        set_(self, "_second", _select(second, kept))
        set_(self, "_time", _select(time, timed))
        set_(self, "_timed", timed)
        set_(self, "_time2", jacobian(_select(time, timed), [0]) if timed else None)
        set_(self, "_gain", jacobian(tape, slots) if q else None)
        set_(self, "blocks", self._colours())

    def _stirring(self) -> set[int]:
        """States that the diffusion depends on: they ask for bounds, though not of beta."""
        diffusion = getattr(self.problem.system, "diffusion", None)
        if not isinstance(diffusion, Tape):
            return set()
        slopes = jacobian(diffusion, list(range(1, len(diffusion.inputs))))
        n = len(diffusion.inputs) - 1
        return {output % n for output in range(len(slopes.outputs)) if not _is_zero(slopes, output)}

    def _colours(self) -> list[list[list[int]]]:
        """Blocks of coupled active coordinates, grouped so that no output meets two blocks of one group."""
        position = {int(state): a for a, state in enumerate(self.active)}
        parent = list(range(len(self.active)))

        def root(a: int) -> int:
            while parent[a] != a:
                a = parent[a]
            return a

        outputs: dict[int, set[int]] = {a: set() for a in parent}
        for entry, state in self._second_index:  # type: ignore[attr-defined]
            i, j = self._entries[entry]  # type: ignore[attr-defined]
            outputs[position[j]].add(i)
            if state >= 0:
                parent[root(position[state])] = root(position[j])
                outputs[position[state]].add(i)
        for i, j in self._entries:  # type: ignore[attr-defined]
            outputs[position[j]].add(i)
        blocks: dict[int, list[int]] = {}
        for a in range(len(self.active)):
            if outputs[a]:
                blocks.setdefault(root(a), []).append(a)
        groups: list[tuple[int, set[int], list[list[int]]]] = []
        for block in blocks.values():
            touched = set().union(*(outputs[a] for a in block))
            for size, used, members in groups:
                if size == len(block) and not used & touched:
                    used |= touched
                    members.append(block)
                    break
            else:
                groups.append((len(block), touched, [block]))
        return [members for _, _, members in groups]

    def reference_slope(self, time: Array, state: Array, inputs: Array, disturbance: Array) -> Array:
        """Float Jacobian at points (M, n), with the constant entries exactly as the model states them."""
        n = state.shape[1]
        slots = self._slots(Interval.point(time), Interval.point(state), inputs, disturbance)
        result = np.broadcast_to(self.constant_slope.mid, (len(state), n, n)).copy()
        if self._entries:  # type: ignore[attr-defined]
            values = enclose(self._varying, slots, undefined="infinite")  # type: ignore[attr-defined]
            finite = np.isfinite(values.lo) & np.isfinite(values.hi)
            mid = np.where(finite, values.mid, 0.0)
            for column, (i, j) in enumerate(self._entries):  # type: ignore[attr-defined]
                result[:, i, j] = mid[:, column]
        return result

    def reference_gain(self, time: Array, state: Array, inputs: Array, disturbance: Array) -> Array:
        """Float derivative by the disturbance at points (M, n): shape (M, n, q)."""
        n, q = state.shape[1], len(disturbance)
        if self._gain is None:  # type: ignore[attr-defined]
            return np.zeros((len(state), n, q))
        slots = self._slots(Interval.point(time), Interval.point(state), inputs, disturbance)
        values = enclose(self._gain, slots, undefined="infinite").broadcast_to((len(state), n, q))  # type: ignore[attr-defined]
        return np.asarray(np.where(np.isfinite(values.lo) & np.isfinite(values.hi), values.mid, 0.0))

    def reference_hessians(self, frame: Frame) -> Array:
        """Float Hessians over the active coordinates, of every output that has one: (M, outputs, active, active)."""
        position = {int(state): a for a, state in enumerate(self.active)}
        entries, index = self._entries, self._second_index  # type: ignore[attr-defined]
        outputs = sorted({entries[entry][0] for entry, state in index if state >= 0})
        result = np.zeros((len(frame), len(outputs), len(self.active), len(self.active)))
        if outputs:
            slots = self._slots(frame.middle_time, frame.middle, frame.inputs, frame.disturbance_middle)
            values = enclose(self._second, slots, undefined="infinite")  # type: ignore[attr-defined]
            middle = np.where(np.isfinite(values.lo) & np.isfinite(values.hi), values.mid, 0.0)
            for column, (entry, state) in enumerate(index):
                if state >= 0:
                    i, j = entries[entry]
                    result[:, outputs.index(i), position[j], position[state]] = middle[..., column]
        return (result + np.swapaxes(result, -1, -2)) / 2

    @staticmethod
    def _slots(
        time: Interval, state: Interval, inputs: Array, disturbance: Array, widths: tuple[Array, Array] | None = None
    ) -> list[Interval]:
        """The inputs of the dynamics' tape, one interval per slot."""
        slots = [time, *(state[:, i] for i in range(state.shape[1]))]
        slots += [Interval.point(inputs[:, i]) for i in range(inputs.shape[1])]
        for i, value in enumerate(disturbance):
            low, high = (value, value) if widths is None else (widths[0][i], widths[1][i])
            slots.append(Interval(np.full(len(state), low), np.full(len(state), high)))
        return slots

    def bound(self, frame: Frame, low: Array, high: Array, rows: Array, effort: int = 2) -> tuple[Array, Array]:
        """Enclosure of beta over every piece of ``frame``.

        Parameters
        ----------
        low, high : ndarray, shape (M, D)
            Bounds of s along the active coordinates (first) and along ``rows``.
        rows : ndarray, shape (M, D - active, active)
            Further directions, over the active coordinates.
        effort : int
            0 (one grid of boxes) to 3 (the boxes that matter are cut in three rounds).

        Returns
        -------
        lower, upper : ndarray, shape (M, n)
            Infinite where the dynamics is not defined on the whole polytope.
        """
        m, count = len(frame), len(self.active)
        origin = np.zeros((m, count))
        base_lo, base_hi, _ = self._boxes(frame, np.arange(m), origin, origin)
        if not len(self.blocks):
            lower, upper = base_lo, base_hi
        else:
            parts = [self._group(frame, group, low, high, rows, effort) for group in self.blocks]
            total = Interval(parts[0][0], parts[0][1])
            base = Interval(base_lo, base_hi)
            for lo, hi in parts[1:]:
                total = total + (Interval(lo, hi) - base)
            lower, upper = total.lo, total.hi
        if self._gain is not None:  # type: ignore[attr-defined]
            extra = self._disturbance(frame, low[:, :count], high[:, :count])
            total = Interval(lower, upper) + extra
            lower, upper = total.lo, total.hi
        return lower, upper

    def estimate(self, frame: Frame, low: Array, high: Array, rows: Array) -> tuple[Array, Array]:
        """Range of beta at the middle of every piece over sample points of the polytope (a guess, not a bound)."""
        m, count, n = len(frame), len(self.active), frame.spread.shape[1]
        function = compile_numpy(self._value)  # type: ignore[attr-defined]
        middle, half = (low[:, :count] + high[:, :count]) / 2, (high[:, :count] - low[:, :count]) / 2
        known = [frame.middle_time.mid, *frame.inputs.T] if frame.inputs.size else [frame.middle_time.mid]
        slope = frame.slope.mid[:, :, self.active]

        def value(shift: Array) -> Array:
            state = frame.middle.mid.copy()
            state[:, self.active] += shift
            slots = [known[0], *state.T, *known[1:], *(np.full(m, d) for d in frame.disturbance_middle)]
            with np.errstate(all="ignore"):
                exact = np.asarray(function(*slots))
            return np.asarray(exact - frame.middle_velocity.mid - np.einsum("mij,mj->mi", slope, shift))

        base = value(np.zeros((m, count)))
        total_lo, total_hi = base.copy(), base.copy()
        for group in self.blocks:
            size = len(group[0])
            signs = list(itertools.product((-1.0, 0.0, 1.0), repeat=size)) if size <= 4 else list(
                np.random.default_rng(0).choice([-1.0, 1.0], (64, size)))
            lo, hi = np.zeros((m, n)), np.zeros((m, n))
            for sign in signs:
                step = np.zeros((m, count))
                for block in group:
                    step[:, block] = half[:, block] * np.asarray(sign)
                reach = np.ones(m)
                if len(group) == 1 and rows.shape[1]:
                    along = np.einsum("mda,ma->md", rows, step)
                    offset = np.einsum("mda,ma->md", rows, middle)
                    room = np.where(along > 0, high[:, count:] - offset, offset - low[:, count:])
                    with np.errstate(divide="ignore", invalid="ignore"):
                        ratio = np.where(np.abs(along) > 0, room / np.abs(along), np.inf)
                    reach = np.clip(ratio.min(axis=1), 0.0, 1.0)
                for fraction in (1.0, 0.5):
                    shift = np.zeros((m, count))
                    for block in group:
                        shift[:, block] = middle[:, block]
                    found = value(shift + fraction * reach[:, None] * step) - base
                    lo, hi = np.fmin(lo, found), np.fmax(hi, found)
            total_lo, total_hi = total_lo + lo, total_hi + hi
        return total_lo, total_hi

    def _disturbance(self, frame: Frame, low: Array, high: Array) -> Interval:
        """(D_d f - E)(d - d0) over the whole polytope's box."""
        state = self._states(frame, (low + high) / 2, (high - low) / 2 * (1 + 1e-12) + 1e-300, spread=True)
        time = frame.span
        widths = (frame.disturbance_low, frame.disturbance_high)
        slots = self._slots(time, state, frame.inputs, frame.disturbance_middle, widths)
        n, q = state.shape[1], len(frame.disturbance_middle)
        gain = enclose(self._gain, slots, undefined="infinite").broadcast_to((len(state), n, q))  # type: ignore[attr-defined]
        reach = Interval(frame.disturbance_low, frame.disturbance_high) - frame.disturbance_middle
        return ((gain - frame.input_gain) * reach[None, None, :]).sum(axis=-1)

    def _states(self, frame: Frame, centre: Array, radius: Array | None, *, spread: bool) -> Interval:
        """p_m + c + [-e, e] (plus the motion of p over the piece)."""
        shift = np.zeros(frame.spread.shape)
        shift[:, self.active] = centre
        state = frame.middle + shift
        if spread or radius is not None:
            size = frame.spread.copy() if spread else np.zeros(frame.spread.shape)
            if radius is not None:
                size[:, self.active] += radius
            state = state + Interval(-size * (1 + 1e-15), size * (1 + 1e-15))
        return state

    def _boxes(self, frame: Frame, items: Indices, centre: Array, radius: Array) -> tuple[Array, Array, Array]:
        """Enclosure of beta on boxes, one a row, and its float value at their centres."""
        f = frame.take(items)
        n, half = f.spread.shape[1], f.half
        thin = self._states(f, centre, None, spread=False)
        slots = self._slots(f.middle_time, thin, f.inputs, f.disturbance_middle)
        displacement = Interval.point(centre)
        slope = f.slope[:, :, self.active]
        value = enclose(self._value, slots, undefined="infinite")  # type: ignore[attr-defined]
        value = value - f.middle_velocity - (slope * displacement[:, None, :]).sum(axis=-1)
        middle = np.where(np.isfinite(value.lo) & np.isfinite(value.hi), value.mid, np.nan)
        entries, index = self._entries, self._second_index  # type: ignore[attr-defined]
        position = {int(state): a for a, state in enumerate(self.active)}
        if entries:
            first = enclose(self._varying, slots, undefined="infinite")  # type: ignore[attr-defined]
            wide = self._slots(f.span, self._states(f, centre, radius, spread=True), f.inputs,
                               f.disturbance_middle)
            second = enclose(self._second, wide, undefined="infinite") if index else None  # type: ignore[attr-defined]
        zero = Interval.point(np.zeros(len(items)))
        moving = [zero] * len(entries)  # derivative of J_ij along p, over the piece
        swell = [zero] * len(entries)  # |J_ij - J_ij(centre)| over the box and the piece
        quadratic = [zero] * n
        bend = [zero] * n  # second derivative along p
        size = f.spread.copy()
        size[:, self.active] += radius
        for column, (entry, state) in enumerate(index):
            assert second is not None
            h = second[:, column]
            i, j = entries[entry]
            if state < 0:
                moving[entry] = moving[entry] + h
                swell[entry] = swell[entry] + half * _symmetric(h)
                bend[i] = bend[i] + 2.0 * h * f.velocity[:, j]
                continue
            product = Interval.point(radius[:, position[j]]) * Interval.point(radius[:, position[state]])
            if state == j:
                quadratic[i] = quadratic[i] + 0.5 * h * Interval(np.zeros(len(items)), product.hi)
            else:
                quadratic[i] = quadratic[i] + 0.5 * h * Interval(-product.hi, product.hi)
            if half:
                moving[entry] = moving[entry] + h * f.velocity[:, state]
                swell[entry] = swell[entry] + h * Interval(-size[:, state], size[:, state])
                bend[i] = bend[i] + h * f.velocity[:, j] * f.velocity[:, state]
        result = [value[:, i] + quadratic[i] for i in range(n)]
        for entry, (i, j) in enumerate(entries):
            difference = first[:, entry] - f.slope[:, i, j]
            if half:
                difference = difference + half * _symmetric(moving[entry] - f.drift[:, i, j])
            e = radius[:, position[j]]
            result[i] = result[i] + difference * Interval(-e, e)
        if half:
            self._in_time(f, centre, wide if entries else slots, first if entries else None, swell, bend, result)
        lower = np.stack([r.lo for r in result], axis=-1)
        upper = np.stack([r.hi for r in result], axis=-1)
        return lower, upper, middle

    def _in_time(
        self, f: Frame, centre: Array, wide: list[Interval], first: Interval | None, swell: list[Interval],
        bend: list[Interval], result: list[Interval],
    ) -> None:
        """Add the motion over the piece: half |rate at t_m| + half^2 / 2 |curvature| to every output."""
        n, half = f.spread.shape[1], f.half
        constant = self.constant_slope
        drift = f.drift[:, :, self.active]
        rate = _product(constant, f.middle_velocity) - f.middle_acceleration
        rate = rate - (Interval.point(drift) * Interval.point(centre)[:, None, :]).sum(axis=-1)
        curve = _product(constant, f.acceleration) - f.jerk
        rates = [rate[:, i] for i in range(n)]
        curves = [curve[:, i] + bend[i] for i in range(n)]
        if first is not None:
            for entry, (i, j) in enumerate(self._entries):  # type: ignore[attr-defined]
                value = first[:, entry]
                rates[i] = rates[i] + value * f.middle_velocity[:, j]
                curves[i] = curves[i] + (value + _symmetric(swell[entry])) * f.acceleration[:, j]
        if self._timed:  # type: ignore[attr-defined]
            thin = self._states(f, centre, None, spread=False)
            slots = self._slots(f.middle_time, thin, f.inputs, f.disturbance_middle)
            by_time = enclose(self._time, slots, undefined="infinite")  # type: ignore[attr-defined]
            twice = enclose(self._time2, self._slots(  # type: ignore[attr-defined]
                f.span, self._states(f, centre, None, spread=True), f.inputs, f.disturbance_middle,
            ), undefined="infinite")
            twice = twice.reshape((len(f), len(self._timed)))  # type: ignore[attr-defined]
            for column, i in enumerate(self._timed):  # type: ignore[attr-defined]
                rates[i] = rates[i] + by_time[:, column]
                curves[i] = curves[i] + twice[:, column]
        for i in range(n):
            result[i] = result[i] + half * _symmetric(rates[i]) + (half * half * 0.5) * _symmetric(curves[i])

    def _group(
        self, frame: Frame, group: list[list[int]], low: Array, high: Array, rows: Array, effort: int
    ) -> tuple[Array, Array]:
        """Bounds over the boxes of one group of blocks, displaced together."""
        m, count = len(frame), len(self.active)
        size = len(group[0])
        single = len(group) == 1
        divisions = _GRID.get(size, 2 if size <= 8 else 1)
        unit = (np.array(list(itertools.product(range(divisions), repeat=size))) + 0.5) / divisions
        items = np.repeat(np.arange(m), len(unit))
        centre, radius = np.zeros((m * len(unit), count)), np.zeros((m * len(unit), count))
        width = high[:, :count] - low[:, :count]
        for block in group:
            for axis, a in enumerate(block):
                centre[:, a] = (low[:, None, a] + width[:, None, a] * unit[None, :, axis]).ravel()
                radius[:, a] = np.repeat(width[:, a] / (2 * divisions), len(unit)) * (1 + 1e-13)
                radius[:, a] += 4e-16 * (np.abs(centre[:, a]) + np.repeat(np.abs(low[:, a]), len(unit)))
        n = frame.spread.shape[1]
        lower, upper = np.full((m, n), np.inf), np.full((m, n), -np.inf)
        inner_lo, inner_hi = np.full((m, n), np.inf), np.full((m, n), -np.inf)
        rounds, tolerance = _EFFORT[effort]
        bound = (low[:, count:], high[:, count:], rows)
        for step in range(rounds + 1):
            if single and rows.shape[1]:
                keep, inside = _cull(items, centre, radius, *bound)
                items, centre, radius, inside = items[keep], centre[keep], radius[keep], inside[keep]
            else:
                inside = np.ones(len(items), dtype=bool)
            if not len(items):
                break
            lo, hi, value = self._boxes(frame, items, centre, radius)
            np.fmax.at(inner_hi, items[inside], value[inside])
            np.fmin.at(inner_lo, items[inside], value[inside])
            if step == rounds or not single or size > 6:
                worst = np.zeros(len(items), dtype=bool)
            else:
                span = np.maximum(inner_hi - inner_lo, 1e-300)
                excess = np.maximum((hi - inner_hi[items]) / span[items], (inner_lo[items] - lo) / span[items])
                excess = np.where(np.isfinite(excess), excess, np.inf).max(axis=1)
                worst = excess > tolerance
                if worst.sum() > _REFINED * m:
                    worst = excess > np.partition(excess, -_REFINED * m)[-_REFINED * m]
            done = ~worst
            np.minimum.at(lower, items[done], lo[done])
            np.maximum.at(upper, items[done], hi[done])
            if not worst.any():
                break
            items, centre, radius = _halve(items[worst], centre[worst], radius[worst], group[0])
        # a polytope without any box left is empty: nothing can leave it, and 0 stands for the empty set
        empty = lower > upper
        return np.where(empty, 0.0, lower), np.where(empty, 0.0, upper)


def _cull(
    items: Indices, centre: Array, radius: Array, low: Array, high: Array, rows: Array
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which boxes may meet the polytope low <= rows . c <= high, and which centres lie in it."""
    own = rows[items]
    value = np.einsum("qda,qa->qd", own, centre)
    reach = np.einsum("qda,qa->qd", np.abs(own), radius)
    slack = 1e-13 * (np.einsum("qda,qa->qd", np.abs(own), np.abs(centre)) + reach)
    lo, hi = low[items], high[items]
    keep = ((value - reach - slack <= hi) & (value + reach + slack >= lo)).all(axis=1)
    return keep, ((value <= hi) & (value >= lo)).all(axis=1)


def _halve(
    items: Indices, centre: Array, radius: Array, block: list[int]
) -> tuple[Indices, Array, Array]:
    """Cut every box in two along each coordinate of the block."""
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=len(block))))
    pieces = len(signs)
    items, centre, radius = np.repeat(items, pieces), np.repeat(centre, pieces, 0), np.repeat(radius, pieces, 0)
    half = radius[:, block] / 2
    old = centre[:, block]
    centre[:, block] = old + np.tile(signs, (len(items) // pieces, 1)) * half
    radius[:, block] = half * (1 + 1e-15) + 4e-16 * (np.abs(old) + half)
    return items, centre, radius


def _symmetric(x: Interval) -> Interval:
    """[-|x|, |x|]."""
    size = x.mag
    return Interval(-size, size)


def _product(matrix: Interval, vector: Interval) -> Interval:
    """``matrix`` (n, n) times a batch of interval vectors (M, n)."""
    return (matrix[None, :, :] * vector[:, None, :]).sum(axis=-1)
