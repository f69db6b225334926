"""One step without noise, and what is left out where the noise comes as one kick in the middle of the step.

From x the path solves X' = f(X) + s e W' (e the noisy coordinate). Beside it stands the path of the same equation that
feels nothing of the noise until h/2 and all of W_h at once there; Z and Zhat are where the noise-free flow has brought
both at 3h/2. With D the difference of the two drivers (W_t before h/2, W_t - W_h from then on, 0 after h), on a convex
tube K that holds all these paths, A >= |Df|, c >= |f_qq|, g >= |f_q'| |f| and G = exp(1.5 h A) entry by entry,
    Z = Zhat + delta + R,   delta = s B a(x),   B = int D dt ~ N(0, h^3/12), independent of W_h,   |a| <= A e,
    |R| <= G [1.5 h A A e s int|D| + (g h/2) s int|D| + c s^2 |W_h| int_{h/2}^h |D| + c s^2/2 int D^2],
    |Z - Zhat| <= G [A e s int|D| + c s^2/2 int D^2].
Given W_h = z sqrt(h), E D(t)^2 = t(1 - t/h) + z^2 t^2/h before h/2 and the mirror image after it, so that
    E int D^2 = h^2 (1/6 + z^2/12),   E int|D| <= h^1.5 (.553 + .145 z^2),
    |z| E int_{h/2}^h |D| <= h^1.5 (.103 + .248 z^2).
On the event that both halves of the noise stay within omega sqrt(h/2), |D| does too, and |W| stays within twice that.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Index, Mask
from certbound.problem.model import Graph, Tape, jacobian, sources
from certbound.rigor.intervals import Interval
from certbound.values.discrete import evaluate
from certbound.values.semilagrangian.carried.carried_problem import STATES, Voyage
from certbound.values.semilagrangian.flows import flow, reachable

_UP = 1 + 1e-9
_BLOCKS = (24, 24, 48)
_ORDER = 6
_NODES = 20_000  # flows enclosed at once


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Blocks:
    """What is known of a step from boxes of states, which are blocks of the grid's cells.

    ``index`` names the block of every cell, axis by axis; all else has shape (..., b0, b1, b2).

    Attributes
    ----------
    back : Interval, shape (3, ...)
        x - y, for y the noise-free image of x after h/2.
    bow, near : ndarray, shape (2, ...)
        How far (x, y) may be from the chord of a step, and half of how far they may come in one.
    inward : ndarray, shape (2, ...)
        Largest drift of q upwards and downwards.
    noisy : (ndarray, ndarray)
        Least and largest q of the tube.
    growth : ndarray, shape (3, 3, ...)
        Of |d_j Phi_i - delta_ij|.
    bends : ndarray, shape (3, 3, 3, ...)
        Of |d_jk Phi_i|.
    left : ndarray, shape (2, 3, ...)
        r and r' with E[|R| | W_h] <= r + r' z^2.
    swing : ndarray, shape (3, ...)
        Of s |a|, the size of delta by that of B.
    most : ndarray, shape (3, ...)
        Of |Z - Zhat|.
    known : ndarray of bool
    """

    index: tuple[Index, Index, Index]
    back: Interval
    bow: Array
    near: Array
    inward: Array
    noisy: tuple[Array, Array]
    growth: Array
    bends: Array
    left: Array
    swing: Array
    most: Array
    known: Mask


def needed(tape: Tape) -> tuple[bool, ...]:
    """Which states the drift depends on: along the others everything is the same."""
    reached = set[int]().union(*sources(tape))
    return tuple(1 + k in reached for k in range(STATES))


def blocks_of(voyage: Voyage, axes: Sequence[Array], step: float, omega: float) -> Blocks:
    """Enclose a step from every block of the grid's cells."""
    index, ends = [], []
    for axis, wanted, most in zip(axes, needed(voyage.tape), _BLOCKS):
        cells = len(axis) - 1
        count = min(most, cells) if wanted else 1
        index.append(np.arange(cells) * count // cells)
        ends.append(axis[np.append(np.flatnonzero(np.diff(index[-1], prepend=-1)), cells)])
    low = np.meshgrid(*(axis[:-1] for axis in ends), indexing="ij")
    high = np.meshgrid(*(axis[1:] for axis in ends), indexing="ij")
    shape = low[0].shape
    box = [Interval(a.ravel(), b.ravel()) for a, b in zip(low, high)]
    way, known = reachable(_reversed(voyage.tape), box, step / 2)
    rates, fine = _over(voyage.tape, way)
    known = known & fine
    back = rates * Interval.point(-step / 2)
    start = [part + back[k] for k, part in enumerate(box)]
    s = voyage.noise * (1 + voyage.spread)
    tube, held = _tube(voyage.tape, start, step, 2 * s * omega * math.sqrt(step / 2) * _UP)
    rates, fine = _over(voyage.tape, tube)
    known = known & held & fine
    width = (rates.hi - rates.lo)[:2] * step / 4 * _UP
    found = _sizes(voyage.tape, tube, rates, step, s, omega)
    known = known & found.pop("known").astype(bool)
    speed = rates[STATES - 1]
    parts = {
        "bow": width, "near": rates[:2].mag * step / 2 * _UP,
        "inward": np.stack([np.maximum(speed.hi, 0.0), np.maximum(-speed.lo, 0.0)]), **found,
    }  # fmt: skip
    shaped = {
        name: np.where(known, part, 0.0).reshape(*part.shape[:-1], *shape) for name, part in parts.items()
    }
    q = tube[STATES - 1]
    ends = [np.where(known, end, 0.0).reshape(STATES, *shape) for end in (back.lo, back.hi)]
    return Blocks(
        index=(index[0], index[1], index[2]), back=Interval(*ends),
        noisy=(q.lo.reshape(shape), q.hi.reshape(shape)), known=known.reshape(shape), **shaped,
    )  # fmt: skip


def _reversed(tape: Tape) -> Tape:
    graph = Graph(("t", "x", "y", "q"))
    outputs = tape.evaluate(graph.arithmetic(), [graph.input(slot) for slot in range(STATES + 1)])
    return graph.tape([graph.apply("neg", output) for output in outputs], (STATES,))


def _over(tape: Tape, box: Sequence[Interval]) -> tuple[Interval, Mask]:
    """The outputs over boxes, shape (outputs, N), and where they are known; 0 elsewhere."""
    found, undefined, jumps = evaluate(tape, [Interval.point(np.zeros(box[0].lo.shape)), *box])
    fine = np.isfinite(found.mag).all(axis=1) & ~undefined & ~jumps
    return Interval(np.where(fine, found.lo.T, 0.0), np.where(fine, found.hi.T, 0.0)), fine


def _tube(tape: Tape, start: Sequence[Interval], step: float, kick: float) -> tuple[list[Interval], Mask]:
    """A box K with start + [0, 1.5 h] f(K) + [-kick, kick] e inside K."""
    span = Interval(0.0, 1.5 * step * _UP)
    push = [Interval(-kick, kick) if k == STATES - 1 else Interval(0.0, 0.0) for k in range(STATES)]
    box = [part + more for part, more in zip(start, push)]
    held = np.zeros(start[0].lo.shape, dtype=bool)
    for _ in range(30):
        rates, fine = _over(tape, box)
        new = [part + span * rates[k] + push[k] for k, part in enumerate(start)]
        held = fine & np.all([(n.lo >= b.lo) & (n.hi <= b.hi) for n, b in zip(new, box)], axis=0)
        if held.all():
            break
        box = [
            Interval(*(np.where(held, e, v) for e, v in zip((b.lo, b.hi), _wider(n, b)))) for n, b in zip(new, box)
        ]
    return box, held


def _wider(new: Interval, old: Interval) -> tuple[Array, Array]:
    more = 0.02 * (new.hi - new.lo) + 1e-12 * (1 + new.mag)
    return np.minimum(new.lo - more, old.lo), np.maximum(new.hi + more, old.hi)


def _sizes(
    tape: Tape, tube: Sequence[Interval], rates: Interval, h: float, s: float, omega: float
) -> dict[str, Array]:
    """``growth``, ``bends``, ``left``, ``swing``, ``most`` and ``known`` of `Blocks`, shape (..., N)."""
    slots = tuple(range(1, STATES + 1))
    first = jacobian(tape, slots)
    size, fine = _over(first, tube)
    more, good = _over(jacobian(first, slots), tube)
    a = size.mag.reshape(STATES, STATES, -1)
    second = more.mag.reshape(STATES, STATES, STATES, -1)
    grown, lasting = exponential(a * h), exponential(a * 1.5 * h)
    eye = np.eye(STATES)[..., None]
    twice = np.einsum("ilmn,ljn,mkn->ijkn", second, grown, grown)
    bends = h * np.einsum("iln,ljkn->ijkn", grown, twice) * _UP
    gain, bent = a[:, -1], second[:, -1, -1]
    turning = np.einsum("ijn,jn->in", second[:, -1], rates.mag)
    pulled = 1.5 * h * np.einsum("ijn,jn->in", a, gain) + turning * h / 2
    parts = [
        s * h**1.5 * share[0] * pulled + s**2 * h**2 * share[1] * bent for share in ((0.553, 0.187), (0.145, 0.290))
    ]
    far = omega * math.sqrt(h / 2)
    sway = s * h * far * gain + s**2 / 2 * h * far**2 * bent
    left = np.stack([np.einsum("ijn,jn->in", lasting, part) for part in parts]) * _UP
    return {
        "growth": np.maximum(grown - eye, 0.0), "bends": bends, "left": left, "swing": s * gain * _UP,
        "most": np.einsum("ijn,jn->in", lasting, sway) * _UP,
        "known": (fine & good & np.isfinite(lasting).all(axis=(0, 1))).astype(float),
    }  # fmt: skip


def exponential(matrix: Array) -> Array:
    """Upper bound of the exponential of non-negative matrices, shape (3, 3, N)."""
    total = np.broadcast_to(np.eye(len(matrix))[..., None], matrix.shape).copy()
    term = total.copy()
    for k in range(1, 12):
        term = np.einsum("ijn,jkn->ikn", term, matrix) / k
        total += term
    norm = matrix.sum(axis=1).max(axis=0)
    rest = np.where(norm < 6, norm**12 / math.factorial(12) / (1 - np.minimum(norm, 6.0) / 13), np.inf)
    return np.where(total > 0, total + rest, 0.0) * _UP  # 0 after so many terms is 0 for good


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Images:
    """Where the noise-free step takes nodes: ``shift`` and ``radius`` (3, m0, m1, m2), m = 1 along idle axes."""

    shift: Array
    radius: Array
    known: Mask


def images_of(voyage: Voyage, axes: Sequence[Array], step: float) -> Images:
    """Enclose the flow over a step from the grid's nodes, one for all nodes along axes that the drift ignores."""
    kept = [axis if wanted else axis[:1] for axis, wanted in zip(axes, needed(voyage.tape))]
    nodes = [part.ravel() for part in np.meshgrid(*kept, indexing="ij")]
    shape = tuple(len(axis) for axis in kept)
    shift, radius = np.zeros((STATES, len(nodes[0]))), np.zeros((STATES, len(nodes[0])))
    known = np.zeros(len(nodes[0]), dtype=bool)
    for first in range(0, len(known), _NODES):
        part = slice(first, first + _NODES)
        start = [Interval.point(node[part]) for node in nodes]
        found = flow(voyage.tape, start, step, _ORDER)
        known[part] = found.known
        for k, (end, begin) in enumerate(zip(found.end, start)):
            moved = end - begin
            shift[k, part], radius[k, part] = moved.mid, moved.rad
    return Images(
        shift=shift.reshape(STATES, *shape), radius=radius.reshape(STATES, *shape), known=known.reshape(shape)
    )
