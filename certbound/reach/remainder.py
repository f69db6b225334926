"""What the linear response leaves over: rigorous bounds of the remainder beta of Thm K7.

On a piece with nominal curve p and slope Jhat(t) = J_m + (t - t_m) K,

    beta = f(t, p + s, d) - p' - Jhat s - E (d - d0),

over s in a polytope. The polytope is cut into boxes of the coordinates that enter the dynamics nonlinearly; on each
box beta is expanded to second order (`certbound.reach.boxes`), and boxes that reach beyond what is asked for are cut
further. Coordinates that no second derivative couples are handled side by side.

Symbols: H second derivatives of f, J first ones; Thm K7 and "Bounding beta" of docs/theory.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from certbound.constants.enclosures import enclose
from certbound.problem.problem import Problem
from certbound.problem.tape import JUMPS, Tape
from certbound.problem.trace import jacobian
from certbound.reach.boxes import Expansion, Parts
from certbound.reach.frame import Frame
from certbound.reach.polytope import cull, grid, halve
from certbound.reach.tapes import adds_plainly, deciding, is_zero, selected, sources, varying_outputs, watched
from certbound.rigor.intervals import Interval

__all__ = ["Remainder"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Target = tuple[Array, Array]

_GRID = {1: 16, 2: 6, 3: 4}
_MOST = 300  # boxes per piece that one round may cut
_STALLED = 0.995  # cutting a box must make it exceed less
_EFFORT = ((0, np.inf), (8, 0.5), (12, 0.2), (20, 0.08))  # rounds of bisection, tolerated excess over the range


@dataclass(frozen=True, eq=False)
class Remainder:
    """Derivatives of the dynamics, sorted by what enters nonlinearly.

    Attributes
    ----------
    active : ndarray
        States whose column of the Jacobian is not constant.
    constant_slope : Interval, shape (n, n)
        Constant entries of the Jacobian (up to rounding), 0 where the entry varies.
    blocks : list of groups of lists of int
        Positions in ``active`` that second derivatives couple, in groups whose outputs do not meet.
    entries : list of (int, int)
        Output and state of every entry of the Jacobian that varies.
    second_index : list of (int, int)
        Entry and state (-1: time) of every second derivative kept; of a mixed pair only one.
    sources : list of lists of int
        States that every such entry depends on.
    kinked : bool
        Whether abs, min or max let the Jacobian jump.
    timed : list of int
        Outputs that depend on time explicitly.
    value, varying, second, time, time2, gain : Tape
        f, its varying entries, their derivatives, derivatives by time, and the one by the disturbance.
    """

    problem: Problem
    active: Indices = field(init=False)
    constant_slope: Interval = field(init=False)
    blocks: list[list[list[int]]] = field(init=False)
    entries: list[tuple[int, int]] = field(init=False)
    second_index: list[tuple[int, int]] = field(init=False)
    sources: list[list[int]] = field(init=False)
    kinked: bool = field(init=False)
    timed: list[int] = field(init=False)
    value: Tape = field(init=False)
    varying: Tape = field(init=False)
    second: Tape = field(init=False)
    time: Tape = field(init=False)
    time2: Tape = field(init=False)
    gain: Tape | None = field(init=False)
    recent: list[tuple[Frame, Expansion]] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        tape = self.problem.closed_loop
        n = self.problem.system.dimension
        states = list(range(1, n + 1))
        first = jacobian(tape, states)
        moving = varying_outputs(first)
        entries = [output for output in range(n * n) if moving[output]]
        fixed = [output for output in range(n * n) if not moving[output]]
        low, high = np.zeros(n * n), np.zeros(n * n)
        if fixed:
            nowhere = [Interval.point(np.zeros(1))] * len(tape.inputs)
            # of their own nodes alone: the function itself may be undefined at 0, where they are read
            values = enclose(selected(first, fixed, None), nowhere, undefined="infinite")
            low[fixed], high[fixed] = values.broadcast_to((1, len(fixed))).lo[0], values.hi.reshape(-1)
        varying = selected(first, entries, tape)
        # where the Jacobian has kinks its own nodes are kept: as jumps they tell on which boxes it is smooth
        kinked = any(node.op == "kink" for node in varying.nodes)
        second = jacobian(varying, [0, *states])
        kept = [o for o in range(len(entries) * (n + 1)) if not is_zero(second, o)]
        slots_of = sources(varying)
        touched = {e % n for e in entries} | {slot - 1 for found in slots_of for slot in found if 1 <= slot <= n}
        # of H_ijk and H_ikj one is enough
        named = {(*divmod(entries[o // (n + 1)], n), o % (n + 1) - 1): o for o in kept}
        kept = [o for (i, j, k), o in named.items() if k < 0 or j <= k or (i, k, j) not in named]
        q = len(self.problem.system.disturbance_names)
        slots = list(range(len(tape.inputs) - q, len(tape.inputs)))
        time = jacobian(tape, [0])
        timed = [i for i in range(n) if not is_zero(time, i)]
        by_time = selected(time, timed, tape)
        found = {
            "constant_slope": Interval(low.reshape(n, n), high.reshape(n, n)),
            "entries": [divmod(e, n) for e in entries],
            "second_index": [(o // (n + 1), o % (n + 1) - 1) for o in kept],
            "active": np.array(sorted(touched | self._stirring()), dtype=np.intp),
            "value": tape,
            "varying": varying,
            "sources": [sorted(slot - 1 for slot in found if 1 <= slot <= n) for found in slots_of],
            "second": watched(selected(second, kept, varying)) if kinked else selected(second, kept, tape),
            "kinked": kinked,
            "time": by_time,
            "timed": timed,
            "time2": jacobian(by_time, [0]) if timed else by_time,
            "gain": jacobian(tape, slots) if q else None,
        }
        for name, value in found.items():
            object.__setattr__(self, name, value)
        object.__setattr__(self, "blocks", self._colours())

    def folded(self, entry: int, state: int) -> bool:
        """Whether the second derivative of ``entry`` by ``state`` also stands for the one with both states swapped."""
        i, j = self.entries[entry]
        return state >= 0 and state != j and (i, state) in self.entries and (
            self.entries.index((i, state)), j) not in self.second_index

    def _stirring(self) -> set[int]:
        """States that the diffusion depends on: they ask for bounds, though not of beta."""
        diffusion = getattr(self.problem.system, "diffusion", None)
        if not isinstance(diffusion, Tape):
            return set()
        # by what the operations read, not by derivatives: a jump has none
        return {slot - 1 for slot in set().union(*sources(diffusion)) if slot > 0}

    @property
    def jumping(self) -> bool:
        """Whether the dynamics may jump."""
        return any(node.op in JUMPS for node in self.value.nodes)

    def _colours(self) -> list[list[list[int]]]:
        """Blocks of coupled active coordinates, grouped so that no output meets two blocks of one group."""
        position = {int(state): a for a, state in enumerate(self.active)}
        parent = list(range(len(self.active)))

        def root(a: int) -> int:
            while parent[a] != a:
                a = parent[a]
            return a

        outputs: dict[int, set[int]] = {a: set() for a in parent}
        for (i, j), states in zip(self.entries, self.sources, strict=True):
            outputs[position[j]].add(i)
            for state in states:  # not only where a second derivative shows it: a kink couples too
                parent[root(position[state])] = root(position[j])
                outputs[position[state]].add(i)
        for slots in deciding(self.value).values():  # a jump couples what decides it, and no derivative shows that
            own = [position[slot - 1] for slot in slots if slot - 1 in position]
            for a in own:
                parent[root(a)] = root(own[0])
                outputs[a] |= set(range(len(self.value.outputs)))
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
        slots = self.slots(Interval.point(time), Interval.point(state), inputs, disturbance)
        result = np.broadcast_to(self.constant_slope.mid, (len(state), n, n)).copy()
        if self.entries:
            values = enclose(self.varying, slots, undefined="infinite")
            finite = np.isfinite(values.lo) & np.isfinite(values.hi)
            mid = np.where(finite, values.mid, 0.0)
            for column, (i, j) in enumerate(self.entries):
                result[:, i, j] = mid[:, column]
        return result

    def reference_gain(self, time: Array, state: Array, inputs: Array, disturbance: Array) -> Array:
        """Float derivative by the disturbance at points (M, n): shape (M, n, q)."""
        n, q = state.shape[1], len(disturbance)
        if self.gain is None:
            return np.zeros((len(state), n, q))
        slots = self.slots(Interval.point(time), Interval.point(state), inputs, disturbance)
        values = enclose(self.gain, slots, undefined="infinite").broadcast_to((len(state), n, q))
        return np.asarray(np.where(np.isfinite(values.lo) & np.isfinite(values.hi), values.mid, 0.0))

    def reference_hessians(self, frame: Frame) -> Array:
        """Float Hessians over the active coordinates, of every output that has one: (M, outputs, active, active)."""
        position = {int(state): a for a, state in enumerate(self.active)}
        entries, index = self.entries, self.second_index
        outputs = sorted({entries[entry][0] for entry, state in index if state >= 0})
        result = np.zeros((len(frame), len(outputs), len(self.active), len(self.active)))
        if outputs:
            slots = self.slots(frame.middle_time, frame.middle, frame.inputs, frame.disturbance_middle)
            values = enclose(self.second, slots, undefined="infinite")
            middle = np.where(np.isfinite(values.lo) & np.isfinite(values.hi), values.mid, 0.0)
            for column, (entry, state) in enumerate(index):
                if state >= 0:
                    i, j = entries[entry]
                    result[:, outputs.index(i), position[j], position[state]] = middle[..., column]
                    if self.folded(entry, state):
                        result[:, outputs.index(i), position[state], position[j]] = middle[..., column]
        return (result + np.swapaxes(result, -1, -2)) / 2

    @staticmethod
    def slots(
        time: Interval, state: Interval, inputs: Array, disturbance: Array, widths: tuple[Array, Array] | None = None
    ) -> list[Interval]:
        """The inputs of the dynamics' tape, one interval per slot."""
        slots = [time, *(state[:, i] for i in range(state.shape[1]))]
        slots += [Interval.point(inputs[:, i]) for i in range(inputs.shape[1])]
        for i, value in enumerate(disturbance):
            low, high = (value, value) if widths is None else (widths[0][i], widths[1][i])
            slots.append(Interval(np.full(len(state), low), np.full(len(state), high)))
        return slots

    def bound(
        self, frame: Frame, low: Array, high: Array, rows: Array, effort: int = 2, target: Target | None = None,
        only: Indices | None = None,
    ) -> tuple[Array, Array]:
        """Enclosure of beta over every piece of ``frame``.

        Parameters
        ----------
        low, high : ndarray, shape (M, D)
            Bounds of s along the active coordinates (first) and along ``rows``.
        rows : ndarray, shape (M, D - active, active)
            Further directions, over the active coordinates.
        effort : int
            0 (one grid of boxes) to 3 (the boxes that matter are cut in many rounds).
        target : (ndarray, ndarray), shape (M, n), optional
            Bounds hoped for: boxes are cut no further than it takes to prove them.
        only : ndarray of int, optional
            The pieces asked for; what is returned for the others means nothing.

        Returns
        -------
        lower, upper : ndarray, shape (M, n)
            Infinite where the dynamics is not defined on the whole polytope.
        """
        m, count = len(frame), len(self.active)
        expansion = self._expansion(frame)
        extra = self._disturbance(frame, low[:, :count], high[:, :count]) if self.gain is not None else None
        if target is not None and extra is not None:
            target = target[0] - extra.lo, target[1] - extra.hi
        if len(self.blocks) == 1:
            lower, upper = self._group(expansion, self.blocks[0], low, high, rows, effort, target, only)
        else:
            origin = np.zeros((m, count))
            base = Interval(*expansion.plain_range(expansion.boxes(np.arange(m), origin, origin), origin))
            total = base
            for group in self.blocks:
                total = total + (Interval(*self._group(expansion, group, low, high, rows, effort, None, only)) - base)
            lower, upper = total.lo, total.hi
        if extra is not None:
            total = Interval(lower, upper) + extra
            lower, upper = total.lo, total.hi
        return lower, upper

    def defect(self, frame: Frame) -> Array:
        """What no cutting of boxes takes off a bound of beta, on either side: its motion over the piece, (M, n)."""
        origin = np.zeros((len(frame), len(self.active)))
        expansion = self._expansion(frame)
        lower, upper = expansion.plain_range(expansion.boxes(np.arange(len(frame)), origin, origin), origin)
        return np.nan_to_num((upper - lower) / 2, nan=0.0, posinf=0.0)

    def _expansion(self, frame: Frame) -> Expansion:
        """The expansions over ``frame``; those of the last frame are kept."""
        if not self.recent or self.recent[0][0] is not frame:
            self.recent[:] = [(frame, Expansion(self, frame))]
        return self.recent[0][1]

    def _disturbance(self, frame: Frame, low: Array, high: Array) -> Interval:
        """(D_d f - E)(d - d0) over the whole polytope's box."""
        n, q = frame.spread.shape[1], len(frame.disturbance_middle)
        assert self.gain is not None
        if adds_plainly(self.value, self.gain, q):
            point = [Interval.point(np.zeros(1))] * len(self.value.inputs)
            gain = enclose(selected(self.gain, list(range(n * q)), None), point).reshape(1, n, q)
        else:
            shift, size = np.zeros(frame.spread.shape), frame.spread.copy()
            shift[:, self.active] = (low + high) / 2
            size[:, self.active] += (high - low) / 2 * (1 + 1e-12) + 1e-15 * (np.abs(low) + np.abs(high)) + 1e-300
            size = size * (1 + 1e-15)
            state = frame.middle + shift + Interval(-size, size)
            widths = (frame.disturbance_low, frame.disturbance_high)
            slots = self.slots(frame.span, state, frame.inputs, frame.disturbance_middle, widths)
            gain = enclose(self.gain, slots, undefined="infinite").broadcast_to((len(frame), n, q))
        reach = Interval(frame.disturbance_low, frame.disturbance_high) - frame.disturbance_middle
        return ((gain - frame.input_gain) * reach[None, None, :]).sum(axis=-1)

    def _group(
        self, expansion: Expansion, group: list[list[int]], low: Array, high: Array, rows: Array, effort: int,
        target: Target | None, only: Indices | None,
    ) -> tuple[Array, Array]:
        """Bounds over the boxes of one group of blocks, displaced together."""
        m, count, n = len(low), len(self.active), expansion.frame.spread.shape[1]
        size, alone = len(group[0]), len(group) == 1
        divisions = _GRID.get(size, 2 if size <= 8 else 1)
        each = divisions**size
        items = np.repeat(np.arange(m), each)
        centre, radius = np.zeros((m, each, count)), np.zeros((m, each, count))
        for block in group:
            centre[..., block], radius[..., block] = grid(low[:, :count], high[:, :count], block, divisions)
        centre, radius = centre.reshape(-1, count), radius.reshape(-1, count)
        if only is not None:
            chosen = np.isin(items, only)
            items, centre, radius = items[chosen], centre[chosen], radius[chosen]
        lower, upper = np.full((m, n), np.inf), np.full((m, n), -np.inf)
        inner_lo, inner_hi = lower.copy(), upper.copy()
        rounds, tolerance = _EFFORT[effort]
        bound = (low[:, count:], high[:, count:], rows)
        curbed = alone and rows.shape[1] > 0
        before = np.full(len(items), np.inf)  # by how much the box that a box was cut from exceeded
        for step in range(rounds + 1):
            inside = np.ones(len(items), dtype=bool)
            if curbed:
                keep, inside = cull(items, centre, radius, *bound)
                items, centre, radius, inside = items[keep], centre[keep], radius[keep], inside[keep]
                before = before[keep]
            if not len(items):
                break
            parts = expansion.boxes(items, centre, radius)
            if curbed:
                lo, hi = expansion.polytope_range(items, parts, centre, radius, *bound)
            else:
                lo, hi = expansion.plain_range(parts, radius)
            np.fmax.at(inner_hi, items[inside], parts.middle[inside])
            np.fmin.at(inner_lo, items[inside], parts.middle[inside])
            if step == rounds or not alone or size > 6:
                excess = np.full((len(items), n), -np.inf)
            elif target is None:
                span = np.maximum(inner_hi - inner_lo, 1e-300)[items]
                excess = np.maximum(hi - inner_hi[items], inner_lo[items] - lo) / span - tolerance
            else:
                span = np.maximum(target[1] - target[0], 1e-300)[items]
                excess = np.maximum(hi - target[1][items], target[0][items] - lo) / span
            excess = np.where(np.isfinite(excess) | (excess < 0), excess, np.inf)
            largest = excess.max(axis=1)
            worst = (largest > 0) & ((largest < _STALLED * before) | np.isinf(before))
            if worst.sum() > _MOST * m:
                worst &= largest > np.partition(largest, -_MOST * m)[-_MOST * m]
            done = ~worst
            np.minimum.at(lower, items[done], lo[done])
            np.maximum.at(upper, items[done], hi[done])
            if not worst.any():
                break
            along = _costliest(expansion, parts, radius, excess)[worst]
            items, centre, radius = halve(items[worst], centre[worst], radius[worst], along)
            before = np.tile(largest[worst], 2)
        # a polytope without any box left is empty: nothing can leave it, and 0 stands for the empty set
        empty = lower > upper
        return np.where(empty, 0.0, lower), np.where(empty, 0.0, upper)


def _costliest(expansion: Expansion, parts: Parts, radius: Array, excess: Array) -> Indices:
    """The coordinate of every box whose width costs most in the output that exceeds most."""
    worst = np.argmax(excess, axis=1)
    number = np.arange(len(radius))
    cost = np.where(np.isfinite(parts.spend[number, worst]), parts.spend[number, worst], 0.0)
    for entry, (i, a) in enumerate(expansion.entries):
        linear = (0.25 * np.abs(parts.gradient[:, entry]) + parts.blur[:, entry]) * radius[:, a]
        cost[:, a] += np.where((worst == i) & np.isfinite(linear), linear, 0.0)
    usable = radius > 0
    return np.asarray(np.argmax(np.where(usable, np.where(parts.bad[:, None], radius, cost), -1.0), axis=1))
