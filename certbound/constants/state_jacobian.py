"""The state Jacobian of a model over boxes of everything it depends on: enclosures, slopes, samples."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from certbound.arrays import Array
from certbound.constants.enclosures import Spread, enclose
from certbound.problem.model import ROWS, Node, Tape, compile_numpy, jacobian, sources
from certbound.rigor.intervals import Interval

PERIOD = 6.283185307179588
"""A float above 2 pi."""
SLOPE_LIMIT = 20_000
"""Largest number of nodes times parameters at which second derivatives are worth their price."""


class StateJacobian:
    """D_x f over a box of (t, states, inputs, disturbances), with only the active ones as coordinates.

    ``dynamics`` is f, shape (n,), ``columns`` are the input slots of the states, ``ranges``, shape
    (len(dynamics.inputs),), say where each input slot lives; infinite ends are legal. ``active`` are the slots that the
    Jacobian depends on, ``box``, shape (len(active),), their ranges; one period of an angle is enough.
    """

    def __init__(self, dynamics: Tape, columns: Sequence[int], ranges: Interval) -> None:
        self.dynamics = dynamics
        self.columns = tuple(columns)
        self.tape = jacobian(dynamics, self.columns)
        self.active = _dependencies(self.tape)
        self.ranges = _folded(self.tape, ranges, self.active)
        self.box = self.ranges[list(self.active)]
        self._float = compile_numpy(self.tape)
        self._slopes: Tape | None = None
        size = len(self.tape.nodes) * max(len(self.active), 1)
        if self.active and size <= SLOPE_LIMIT:
            self._slopes = jacobian(self.tape, self.active)

    def starts(self, limit: int = 256) -> Interval:
        """Boxes (N, k) over which the supremum of a convex function of J equals that over the whole box.

        Where J is affine in one coordinate with the others fixed, a convex function of J (a measure, a norm)
        is largest at an end of that coordinate: only the ends are kept, while there are at most ``limit``.
        """
        lo, hi = self.box.lo[None], self.box.hi[None]
        for column, slot in enumerate(self.active):
            a, b = float(self.box.lo[column]), float(self.box.hi[column])
            if 2 * len(lo) <= limit and a < b and np.isfinite(b - a) and _is_affine(self.tape, slot):
                lo, hi = np.concatenate([lo, lo]), np.concatenate([hi, hi])
                ends = np.repeat([a, b], len(lo) // 2)
                lo[:, column], hi[:, column] = ends, ends
        return Interval(lo, hi)

    @property
    def dimension(self) -> int:
        """State dimension n."""
        return len(self.columns)

    def remark(self, status: str) -> str:
        """``status``, and that the Jacobian is the generalised one where the model has kinks (abs, min, max)."""
        if all(node.op not in ("kink", "bent") for node in self.tape.nodes):
            return status
        return f"{status}; generalised Jacobian at the kinks of abs, min, max"

    def enclose(self, boxes: Interval) -> Interval:
        """Jacobians over boxes of the active slots (N, k): shape (N, n, n), unbounded where refused."""
        return enclose(self.tape, self._inputs(boxes), undefined="infinite")

    def spread(self, boxes: Interval) -> tuple[Interval, Spread] | None:
        """Mean-value form: Jacobians at the midpoints, and the slopes over the boxes.

        Proves: D_x f(z) = J_c + sum_k (z_k - c_k) H_k with H_k in the slopes, for every z in the box (the
        mean-value theorem entry by entry).
        """
        if self._slopes is None:
            return None
        middle = np.clip(boxes.mid, -1e300, 1e300)
        centre = enclose(self.tape, self._inputs(Interval.point(middle)), undefined="infinite")
        slopes = enclose(self._slopes, self._inputs(boxes), undefined="infinite")
        n, k = self.dimension, len(self.active)
        stacked = slopes.reshape(len(middle), n, n, k)
        terms = Interval(np.moveaxis(stacked.lo, -1, 1), np.moveaxis(stacked.hi, -1, 1))
        return centre, Spread(terms, boxes.rad)

    def values(self, points: Array) -> Array:
        """Jacobians at points (N, k) in floating point; NaN where undefined."""
        inputs: list[Array] = list(np.clip(0.0, self.ranges.lo, self.ranges.hi))
        for column, slot in enumerate(self.active):
            inputs[slot] = points[:, column]
        with np.errstate(all="ignore"):
            result = np.asarray(self._float(*inputs), dtype=np.float64)
        return np.broadcast_to(result, (len(points), self.dimension, self.dimension))

    def explain(self, box: Interval) -> str:
        """Why the Jacobian is unbounded over one box (k,): the entry's name.

        Where it is undefined or jumps there, an EnclosureError names the expression and the box.
        """
        enclosed = enclose(self.tape, self._inputs(box.reshape(1, -1)), undefined="raise")[0]
        rows, columns = np.nonzero(~(np.isfinite(enclosed.lo) & np.isfinite(enclosed.hi)))
        names = self.dynamics.inputs
        if len(rows) == 0:
            return "no single entry"
        row, column = int(rows[0]), int(columns[0])
        states = [names[slot] for slot in self.columns]
        where = ", ".join(f"{names[slot]} in [{lo:.6g}, {hi:.6g}]" for slot, lo, hi in zip(self.active, box.lo, box.hi))
        entry = self.tape.describe(self.tape.outputs[row * self.dimension + column])
        return f"entry d f_{states[row]} / d {states[column]} = {entry} on {where}"

    def _inputs(self, boxes: Interval) -> list[Interval]:
        inputs = [self.ranges[slot] for slot in range(len(self.dynamics.inputs))]
        if self.active:
            for column, slot in enumerate(self.active):
                inputs[slot] = boxes[:, column]
        elif inputs:
            inputs[0] = inputs[0].broadcast_to((len(boxes),))
        return inputs


def _is_affine(tape: Tape, slot: int) -> bool:
    """Whether the outputs are affine in one slot, and nothing that may be undefined or jump depends on it."""
    depends: list[bool] = []
    for node in tape.nodes:
        if node.op == "input":
            depends.append(node.args[0] == slot)
            continue
        inner = [depends[arg] for arg in node.args]
        depends.append(any(inner))
        if _is_risky(node) and (inner[-1] if node.op == "div" else any(inner)):
            return False
    return slot not in _dependencies(jacobian(tape, [slot]))


def _is_risky(node: Node) -> bool:
    """Whether it may jump or be undefined."""
    row = ROWS.get(node.op)
    return row is not None and (row.jump is not None or row.undefined is not None)


def _dependencies(tape: Tape) -> tuple[int, ...]:
    """Input slots on which the outputs depend."""
    return tuple(sorted(set().union(*sources(tape))))


def _folded(tape: Tape, ranges: Interval, active: Sequence[int]) -> Interval:
    """Ranges with angles folded to one period.

    A slot is an angle if adding 2 pi to it changes no output, and no argument of an operation that may be
    undefined or jump. Every node is followed by the integer k with node(z + 2 pi) = node(z) + 2 pi k.
    """
    lo, hi = np.array(ranges.lo), np.array(ranges.hi)
    for slot in active:
        if hi[slot] - lo[slot] > PERIOD and _is_angle(tape, slot):
            lo[slot], hi[slot] = -PERIOD / 2, PERIOD / 2
    return Interval(lo, hi)


def _is_angle(tape: Tape, slot: int) -> bool:
    turns: list[int | None] = []
    for node in tape.nodes:
        if node.op == "input":
            turns.append(1 if node.args[0] == slot else 0)
            continue
        args = [turns[arg] for arg in node.args]
        risky = _is_risky(node)
        if risky and node.op != "tan" and any(args):
            return False
        turns.append(_turns(node.op, args, [tape.nodes[arg] for arg in node.args]))
        if risky and any(turn is None for turn in args):
            return False
    return all(turns[output] == 0 for output in tape.outputs)


def _turns(op: str, args: Sequence[int | None], nodes: Sequence[Node]) -> int | None:
    if any(arg is None for arg in args):
        return None
    whole = [arg for arg in args if arg is not None]
    if op in ("sin", "cos", "tan") or not any(whole):
        return 0
    if op == "neg":
        return -whole[0]
    if op in ("add", "sub"):
        return whole[0] + whole[1] if op == "add" else whole[0] - whole[1]
    if op == "mul":
        for factor, other in ((nodes[0], whole[1]), (nodes[1], whole[0])):
            if factor.op == "const" and float(factor.value).is_integer():
                return int(factor.value) * other
    return None
