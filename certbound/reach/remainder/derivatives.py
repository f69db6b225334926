"""Derivatives of the dynamics, sorted by what enters nonlinearly: what bounds of the remainder beta of Thm K7 read."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from certbound.arrays import Array, Index
from certbound.constants.enclosures import enclose
from certbound.problem.model import (
    JUMPS,
    Tape,
    compile_numpy,
    deciding,
    is_zero,
    jacobian,
    selected,
    sources,
    varying_outputs,
    watched,
)
from certbound.problem.problem import Problem
from certbound.problem.systems import ContinuousSystem
from certbound.reach.remainder.frame import Frame
from certbound.rigor.intervals import Interval

_NOTHING = 1e-9  # of a direction


@dataclass(frozen=True, eq=False)
class Derivatives:
    """Derivatives of the dynamics of a problem's closed loop."""

    problem: Problem
    active: Index = field(init=False)  # states whose column of the Jacobian is not constant
    # (n, n): constant entries of the Jacobian (up to rounding), 0 where the entry varies
    constant_slope: Interval = field(init=False)
    # positions in ``active`` that second derivatives couple, in groups whose outputs do not meet
    blocks: list[list[list[int]]] = field(init=False)
    entries: list[tuple[int, int]] = field(init=False)  # output and state of every entry of the Jacobian that varies
    # entry and state (-1: time) of every second derivative kept; of a mixed pair only one
    second_index: list[tuple[int, int]] = field(init=False)
    sources: list[list[int]] = field(init=False)  # states that every such entry depends on
    kinked: bool = field(init=False)  # whether abs, min or max let the Jacobian jump
    # whether planes bound it better than second derivatives do: networks have too many kinks to cut boxes at them, and
    # without motion in time nothing else needs their derivatives
    planar: bool = field(init=False)
    timed: list[int] = field(init=False)  # outputs that depend on time explicitly
    # f, its varying entries, their derivatives, derivatives by time, and the one by the disturbance
    value: Tape = field(init=False)
    varying: Tape = field(init=False)
    second: Tape = field(init=False)
    time: Tape = field(init=False)
    time2: Tape = field(init=False)
    gain: Tape | None = field(init=False)

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
        kinked = any(node.op in ("kink", "bent") for node in varying.nodes)
        second = jacobian(varying, [0, *states])
        kept = [o for o in range(len(entries) * (n + 1)) if not is_zero(second, o)]
        slots_of = sources(varying)
        touched = {e % n for e in entries} | {slot - 1 for found in slots_of for slot in found if 1 <= slot <= n}
        # of H_ijk and H_ikj one is enough
        named = {(*divmod(entries[o // (n + 1)], n), o % (n + 1) - 1): o for o in kept}
        kept = [o for (i, j, k), o in named.items() if k < 0 or j <= k or (i, k, j) not in named]
        q = len(self.problem.system.disturbance_names)
        slots = list(range(len(tape.inputs) - q, len(tape.inputs)))
        continuous = isinstance(self.problem.system, ContinuousSystem)
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
            "planar": any(node.op == "bent" or (node.part and not continuous) for node in tape.nodes),
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

    @cached_property
    def _kinks(self) -> Tape:
        """What kinks are zeros of."""
        sides = sorted({node.args[0] for node in self.varying.nodes if node.op == "kink"})
        return replace(self.varying, outputs=tuple(sides), shape=(len(sides),))

    @cached_property
    def kinks_of_sums(self) -> bool:
        """Whether something of several states has a kink."""
        return any(sum(slot - 1 in self.active for slot in slots) > 1 for slots in sources(self._kinks))

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
            mid = _middle(enclose(self.varying, slots, undefined="infinite"))
            for column, (i, j) in enumerate(self.entries):
                result[:, i, j] = mid[:, column]
        return result

    def reference_gain(self, time: Array, state: Array, inputs: Array, disturbance: Array) -> Array:
        """Float derivative by the disturbance at points (M, n): shape (M, n, q)."""
        n, q = state.shape[1], len(disturbance)
        if self.gain is None:
            return np.zeros((len(state), n, q))
        slots = self.slots(Interval.point(time), Interval.point(state), inputs, disturbance)
        return _middle(enclose(self.gain, slots, undefined="infinite").broadcast_to((len(state), n, q)))

    def reference_hessians(self, frame: Frame) -> Array:
        """Float Hessians over the active coordinates, of every output that has one: (M, outputs, active, active)."""
        position = {int(state): a for a, state in enumerate(self.active)}
        entries, index = self.entries, self.second_index
        outputs = sorted({entries[entry][0] for entry, state in index if state >= 0})
        result = np.zeros((len(frame), len(outputs), len(self.active), len(self.active)))
        if outputs:
            slots = self.slots(frame.middle_time, frame.middle, frame.inputs, frame.disturbance_middle)
            middle = _middle(enclose(self.second, slots, undefined="infinite"))
            for column, (entry, state) in enumerate(index):
                if state >= 0:
                    i, j = entries[entry]
                    result[:, outputs.index(i), position[j], position[state]] = middle[..., column]
                    if self.folded(entry, state):
                        result[:, outputs.index(i), position[state], position[j]] = middle[..., column]
        return (result + np.swapaxes(result, -1, -2)) / 2

    def turned_gradients(self, frame: Frame, shift: Array) -> Array:
        """How far gradients at deviations ``shift`` (M, K, active) are from their mean: (M, K, outputs, active).

        Of the outputs with an entry of the Jacobian that varies; where it jumps at a kink, along the normal of that.
        """
        with np.errstate(all="ignore"):
            values = np.asarray(compile_numpy(self.varying)(*self.shifted(frame, shift)))
            values = values.reshape(*shift.shape[:2], -1)
            values = values - values.mean(axis=1, keepdims=True)
        outputs = sorted({i for i, _ in self.entries})
        result = np.zeros((*shift.shape[:2], len(outputs), len(self.active)))
        for column, (i, j) in enumerate(self.entries):
            result[:, :, outputs.index(i), int(np.searchsorted(self.active, j))] = values[..., column]
        return np.where(np.isfinite(result), result, 0.0)

    def kink_normals(self, frame: Frame) -> Array:
        """Normals at the middle of the pieces of the kinks of sums of active coordinates, each once: (M, K, active)."""
        n, count = self.problem.system.dimension, len(self._kinks.outputs)
        slopes = jacobian(self._kinks, range(1, n + 1))
        values = compile_numpy(slopes)(*self.shifted(frame, np.zeros((len(frame), 1, len(self.active)))))
        normals = np.nan_to_num(values.reshape(len(frame), count, n)[..., self.active], posinf=0.0, neginf=0.0)
        size = np.linalg.norm(normals, axis=-1, keepdims=True)
        normals = np.divide(normals, size, out=np.zeros_like(normals), where=size > 0)
        alike = np.abs(np.einsum("mia,mja->mij", normals, normals))
        new = [i for i in range(count) if np.any(np.count_nonzero(np.abs(normals[:, i]) > _NOTHING, axis=1) > 1)
               and not np.any(np.all(alike[:, i, :i] > 1 - _NOTHING, axis=0))]  # fmt: skip
        return np.asarray(normals[:, new])

    def shifted(self, frame: Frame, shift: Array) -> list[Array]:
        """The inputs of the tape at the middle of the pieces, one row a deviation ``shift`` (M, K, active)."""
        m, points = shift.shape[:2]
        state = np.repeat(frame.middle.mid[:, None], points, axis=1)
        state[..., self.active] += shift
        fixed = [np.repeat(column, points) for column in (frame.middle_time.mid, *frame.inputs.T)]
        noisy = (np.full(m * points, d) for d in frame.disturbance_middle)
        return [fixed[0], *state.reshape(m * points, -1).T, *fixed[1:], *noisy]

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


def _middle(values: Interval) -> Array:
    """The middles of enclosures; 0 where there is none."""
    return np.asarray(np.where(np.isfinite(values.lo) & np.isfinite(values.hi), values.mid, 0.0))
