"""Interval enclosures of traced functions: the tape read in outward-rounded arithmetic.

An enclosure is refused where the function (or the function that a derivative belongs to) is undefined or
jumps on the box: division by an interval that contains 0, log or sqrt of negatives, an undecided comparison,
sign or floor, atan2 across its cut. A kink (abs, min, max) is no obstacle: its generalised derivative is
enclosed.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np

from certbound.arrays import Mask
from certbound.errors import EnclosureError
from certbound.problem.model import ROWS, Node, Tape, enclosed, jumps_where, sources, undefined_where
from certbound.rigor.intervals import Interval
from certbound.watch import poll

CHUNK = 8192
"""Boxes evaluated at a time: the intermediate results stay in the processor's cache."""


class Refusal(NamedTuple):
    """A node that is undefined or jumps on some members of the batch."""

    node: int
    mask: Mask


def enclose(tape: Tape, inputs: Sequence[Interval], *, undefined: Literal["raise", "infinite"] = "raise") -> Interval:
    """Enclose the range of a traced function over boxes.

    Proves: the result, of shape (*batch, *tape.shape), contains f(z) for every z with z_i in inputs[i], one interval
    per input slot, broadcast to a common batch shape, member by member of the batch. The tape may be a Jacobian, whose
    nodes include those of the function, so that its jumps are seen. Where the function is undefined or jumps,
    ``undefined`` says what to do: "raise" an EnclosureError that names the expression and the box, or return [-inf,
    inf] in all outputs of that member ("infinite").

    Examples
    --------
    >>> from certbound.problem.model import trace
    >>> tape = trace(lambda x: [x[0] ** 2 + 1], {"x": ["a"]})
    >>> enclose(tape, [Interval([-1.0], [2.0])]).contains([[3.0]]).tolist()
    [[True]]
    """
    if len(inputs) != len(tape.inputs):
        raise ValueError(f"`inputs` must hold {len(tape.inputs)} intervals, got {len(inputs)}.")
    if undefined not in ("raise", "infinite"):
        raise ValueError(f'`undefined` must be "raise" or "infinite", got {undefined!r}.')
    batch = np.broadcast_shapes(*(x.shape for x in inputs)) if inputs else ()
    size = int(np.prod(batch))
    flat = [x if x.ndim == 0 else x.broadcast_to(batch).reshape(size) for x in inputs]
    lo, hi = np.empty((size, len(tape.outputs))), np.empty((size, len(tape.outputs)))
    for start in range(0, size, CHUNK):
        poll()
        part = [x if x.ndim == 0 else x[start : start + CHUNK] for x in flat]
        count = min(CHUNK, size - start)
        outputs, refusals = _evaluate(tape, part)
        if refusals and undefined == "raise":
            raise EnclosureError(_message(tape, part, refusals[0]))
        for column, value in enumerate(outputs):
            lo[start : start + count, column] = value.lo
            hi[start : start + count, column] = value.hi
        for refusal in refusals:
            bad = start + np.flatnonzero(np.broadcast_to(refusal.mask, (count,)))
            lo[bad], hi[bad] = -np.inf, np.inf
    shape = (*batch, *tape.shape)
    return Interval(lo.reshape(shape), hi.reshape(shape))


def _evaluate(tape: Tape, inputs: Sequence[Interval]) -> tuple[list[Interval], list[Refusal]]:
    """Outputs, and the nodes at which members of the batch are refused.

    An undecided jump is refused wherever it stands. An undefined operation is refused where an output or an
    unused node depends on it, save through a branch that the box switches off.
    """
    values: list[Interval] = []
    spoilt: list[Mask | None] = []  # members whose value here rests on an undefined operation
    refusals: list[Refusal] = []
    origins: list[Refusal] = []
    used = {arg for node in tape.nodes if node.op != "input" for arg in node.args}
    for index, node in enumerate(tape.nodes):
        if node.op == "input":
            values.append(inputs[node.args[0]])
            spoilt.append(None)
            continue
        args = [values[arg] for arg in node.args]
        value = enclosed(node, args)
        values.append(value)
        if _jumps(node, args, value, index, refusals):
            spoilt.append(None)
            continue
        mask = _inherited(node, args, [spoilt[arg] for arg in node.args])
        own = _undefined(node, args)
        if own is not None:
            origins.append(Refusal(index, own))
            mask = own if mask is None else mask | own
        spoilt.append(mask)
    ends = set(tape.outputs) | (set(range(len(tape.nodes))) - used)
    broken = [mask for index in sorted(ends) if (mask := spoilt[index]) is not None and mask.any()]
    if broken:
        total = broken[0]
        for mask in broken[1:]:
            total = total | mask
        refusals.extend(Refusal(node, mask & total) for node, mask in origins if np.any(mask & total))
    return [values[output] for output in tape.outputs], refusals


def _jumps(node: Node, args: Sequence[Interval], value: Interval, index: int, refusals: list[Refusal]) -> bool:
    """Whether the node can jump; undecided members are added to the refusals."""
    mask = jumps_where(node, value, args)
    if mask is None:
        return False
    if np.any(mask):
        refusals.append(Refusal(index, np.asarray(mask)))
    return node.op not in ("if_else_zero", "atan2", "jumping")


def _jump(node: Node) -> Callable[..., Mask] | None:
    return ROWS[node.op].jump if node.op in ROWS else None


def _undefined(node: Node, args: Sequence[Interval]) -> Mask | None:
    mask = undefined_where(node, args) if _jump(node) is None else None
    return mask if mask is not None and np.any(mask) else None


def _inherited(node: Node, args: Sequence[Interval], masks: Sequence[Mask | None]) -> Mask | None:
    present = [mask for mask in masks if mask is not None]
    if node.op == "if_else_zero" and masks[1] is not None:
        off = (args[0].lo == 0) & (args[0].hi == 0)
        inner: Mask = masks[1] & ~off
        return inner if masks[0] is None else inner | masks[0]
    if not present:
        return None
    return functools.reduce(np.logical_or, present)


def _message(tape: Tape, inputs: Sequence[Interval], refusal: Refusal) -> str:
    node = tape.nodes[refusal.node]
    member = int(np.flatnonzero(refusal.mask)[0]) if refusal.mask.ndim else 0
    box, decides = [], sources(replace(tape, outputs=(refusal.node,), shape=(1,)))[0]
    for place, (name, x) in enumerate(zip(tape.inputs, inputs, strict=True)):
        if place not in decides:
            continue
        lo, hi = (float(end if end.ndim == 0 else end[member]) for end in (x.lo, x.hi))
        box.append(f"{name} in [{lo:.6g}, {hi:.6g}]" if lo < hi else f"{name} = {lo:.6g}")
    what = "may jump (no derivative bounds it)" if _jump(node) else "is undefined somewhere"
    return (
        f"`{tape.describe(refusal.node)}` {what} on the box {', '.join(box)}; "
        "restrict the domain so that this does not happen, or change the model."
    )
