"""Ranges of scalar nodes of a tape over a box: interval enclosures, refined by bisection.

Proves, for each node: low <= value <= high at every point of the box. The outer ends come from enclosures
alone; point values only decide where to bisect next and when to stop. Boxes may be unbounded.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from certbound.arrays import Array
from certbound.constants.enclosures.enclosure import enclose
from certbound.problem.model import Graph, Node, Tape
from certbound.rigor.intervals import Interval

_BOXES = 4000
_ROUNDS = 60
_FAR = 1e300


def bound_ranges(
    tape: Tape,
    nodes: Sequence[int],
    inputs: Sequence[Interval],
    *,
    tolerance: float = 1e-3,
    boxes: int = _BOXES,
) -> list[tuple[float, float]]:
    """Enclosures of the ranges of some nodes, over a box of one scalar interval per input slot.

    Bisection stops once an outer end is within ``tolerance``, as a share of the range's size, from a sampled value, or
    after so many ``boxes`` per end.
    """
    if not nodes:
        return []
    whole = enclose(Tape(inputs=tape.inputs, nodes=tape.nodes, outputs=tuple(nodes), shape=(len(nodes),)), inputs)
    low, high = np.array([float(x.lo) for x in inputs]), np.array([float(x.hi) for x in inputs])
    ranges = []
    for position, node in enumerate(nodes):
        part = extract(tape, node)
        used = [slot for slot in _slots(part) if low[slot] < high[slot]]
        bottom, top = float(whole.lo[position]), float(whole.hi[position])
        if used and bottom < top:
            limits = tolerance, boxes
            top = min(top, _refined(part, used, low, high, *limits))
            bottom = max(bottom, -_refined(_negated(part), used, low, high, *limits))
        ranges.append((bottom, top))
    return ranges


def extract(tape: Tape, node: int) -> Tape:
    """The scalar function that a node computes, as a tape of its own over the same inputs."""
    return Graph.starting_with(tape).tape([node], (1,))


def _negated(tape: Tape) -> Tape:
    index = len(tape.nodes)
    nodes = (*tape.nodes, Node("neg", tape.outputs))
    return Tape(inputs=tape.inputs, nodes=nodes, outputs=(index,), shape=(1,))


def _slots(tape: Tape) -> list[int]:
    return sorted({node.args[0] for node in tape.nodes if node.op == "input"})


def _refined(tape: Tape, used: list[int], low: Array, high: Array, tolerance: float, boxes: int) -> float:
    """Upper bound of the largest value: boxes that may hold it are bisected, all at once."""
    lower, upper = low[None, :].copy(), high[None, :].copy()
    spent, closed, best = 0, -np.inf, -np.inf
    bounds = _upper(tape, lower, upper)
    smallest = -float(_upper(_negated(tape), lower, upper)[0])
    for _ in range(_ROUNDS):
        best = max(best, float(np.max(-_upper(_negated(tape), *(2 * [_inside(lower, upper)])))))
        top = max(float(bounds.max()), closed)
        scale = top - smallest if np.isfinite(top - smallest) else max(1.0, abs(best))
        open_ = bounds > best + tolerance * scale
        spent += len(bounds)
        if not open_.any() or spent >= boxes:
            break
        closed = max(closed, float(np.max(bounds[~open_], initial=-np.inf)))
        lower, upper = _bisected(lower[open_], upper[open_], used)
        bounds = _upper(tape, lower, upper)
    return max(float(bounds.max()), closed)


def _upper(tape: Tape, lower: Array, upper: Array) -> Array:
    idle = Interval(np.array(0.0), np.array(0.0))  # of hundreds of slots a range reads a few
    inputs = [idle] * lower.shape[1]
    for slot in _slots(tape):
        inputs[slot] = Interval(lower[:, slot], upper[:, slot])
    return np.asarray(enclose(tape, inputs, undefined="infinite").hi[:, 0])


def _inside(lower: Array, upper: Array) -> Array:
    """A finite point of each box: its middle, or a point that is far out where the box is unbounded."""
    low, high = np.maximum(lower, -1e3), np.minimum(upper, 1e3)
    return np.asarray(np.clip((low + high) / 2, lower, upper))


def _bisected(lower: Array, upper: Array, used: list[int]) -> tuple[Array, Array]:
    """Each box cut in two across its widest side; unbounded ones first, in steps that double."""
    a, b = lower[:, used], upper[:, used]
    both, left, right = np.isinf(a) & np.isinf(b), np.isinf(a) & np.isfinite(b), np.isfinite(a) & np.isinf(b)
    near_a, near_b = np.clip(a, -_FAR, _FAR), np.clip(b, -_FAR, _FAR)
    cut = np.where(both, 0.0, near_a / 2 + near_b / 2)
    cut = np.where(right, np.maximum(near_a + np.maximum(1.0, np.abs(near_a)), a), cut)
    cut = np.where(left, np.minimum(near_b - np.maximum(1.0, np.abs(near_b)), b), cut)
    width = np.where(np.isfinite(a) & np.isfinite(b), near_b - near_a, _FAR / np.maximum(1.0, np.abs(cut)))
    chosen = np.argmax(width, axis=1)
    rows = np.arange(len(a))
    slots = np.array(used)[chosen]
    first, second = upper.copy(), lower.copy()
    first[rows, slots] = cut[rows, chosen]
    second[rows, slots] = cut[rows, chosen]
    return np.concatenate([lower, second]), np.concatenate([first, upper])
