"""Faces that no path crosses, as the noise across them vanishes there: a price, a rate, a population stays above 0.

Behind them faces that hardly a path reaches (`rarely_reached`), in the same models.

**Lemma.** Let a_ii(t, x) <= K (c - x_i) and f_i(t, x, d) >= -K (c - x_i), a = g g', at all points with c - eta <= x_i
<= c whose other states are in a box B. Then a path that starts in B with X_i >= c keeps X_i >= c until another state
leaves B.

*Proof.* Stop X there, and where X_i = c - eta. For Y = X_i - c the integral of 1{-eta < Y < 0} d<Y>/|Y| is at most K t,
so that by the occupation formula the left local time of Y at 0 vanishes (Yamada and Watanabe; Le Gall). By Tanaka's
formula the negative part of Y is -int 1{Y < 0} dY, and its mean at most K times the integral of its mean: 0 by
Gronwall's inequality. QED.

So nothing is asked of a value function at such a face, and the inequality of Theorem K8-CT is proved up to it. The
hypotheses hold where a_ii = 0 <= f_i on the face itself and the derivatives of both by x_i are bounded beside it. Where
the model is not defined beyond the face (a square root of the state) no path is there.

**Lemma.** Let k > 0, L >= 0 and k f_i(t, x, d) + k^2 a_ii(t, x) / 2 <= L on a box B, at all times up to T. Then a path
that starts at x in B reaches X_i = c by T, before it leaves B in another way, with a probability of at most
exp(L T - k (c - x_i)).

*Proof.* exp(k X_i - L t), stopped where X leaves B, is a positive local supermartingale. QED.

The same holds with a slope k(x_i) >= 0 that is continuous, piecewise linear and 0 up to some place after the start,
where k f_i + (k^2 + k') a_ii / 2 <= L beyond that place: the probability is at most exp(L T) over the exponential of
k's integral, which is C^1 with a bounded second derivative, so that Ito's formula holds. Where the drift leads back,
k = -2 f_i / a_ii is as steep as the true one (Freidlin and Wentzell).

`resolved` writes the model for one side of the face: max(x, 0) is x where x >= 0, and sqrt(u)^2 is u where the root is
defined, which the tape goes on to ask (`squared_diffusion`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from certbound.arrays import Array, Mask
from certbound.errors import EnclosureError, InfeasibleError
from certbound.problem.model import JUMPS, Graph, Tape, compile_numpy, enclosed, jacobian
from certbound.rigor.intervals import Interval
from certbound.values.continuous.coefficients import Reader
from certbound.values.continuous.hypotheses import Model, Sides
from certbound.values.enclosing import enclose

Ends = tuple[float, float]

_PARTS = 16  # of the face in time and in every other state
_BESIDE = 1e-3  # eta, in units of the box
_SCANNED = 2001
_ALONG = 192  # cells of a slope that varies
_STEEPEST = 50.0  # what it may rise by over a cell
_LEVELS = np.geomspace(0.1, 20.0, 8)  # of its rate, over the horizon
_HALVINGS, _MOST_CELLS = 6, 4096  # of cells where noise of full rank is not seen at once
_NIL = 1e-13  # of the largest a: what counts as vanishing, for candidates


def check_noise(
    model: Model, span: tuple[float, float], ends: Sequence[tuple[float, float]], held: Sequence[Sides] = ()
) -> None:
    """Refuse noise that may vanish somewhere in a box over a span of time, but for the cells at its ``held`` faces.

    Where it has full rank a path that touches a face crosses it: what lower bounds rest on.

    Raises
    ------
    InfeasibleError
    """
    fine = [np.linspace(low, high, 17) for low, high in ends]
    fine = [axis[int(sides[0]) : 17 - int(sides[1])] for axis, sides in zip(fine, held or [(False, False)] * len(fine))]
    low = np.stack(np.meshgrid(*(axis[:-1] for axis in fine), indexing="ij")).reshape(len(fine), -1)
    high = np.stack(np.meshgrid(*(axis[1:] for axis in fine), indexing="ij")).reshape(len(fine), -1)
    for _ in range(_HALVINGS):
        smallest = _least_noise(model, span, low, high)
        if np.all(smallest > 0):
            return
        low, high = low[:, ~(smallest > 0)], high[:, ~(smallest > 0)]
        if low.shape[1] > _MOST_CELLS:
            break
        for axis in range(len(fine)):
            middle = low[axis] + (high[axis] - low[axis]) / 2
            low, high = np.hstack([low, low]), np.hstack([high, high])
            high[axis, : len(middle)], low[axis, len(middle) :] = middle, middle
    raise InfeasibleError(
        "value functions in continuous time need noise of full rank everywhere in the safe set, that is in every "
        "direction; here some direction has none somewhere (noise in the velocities only, say, or noise that vanishes "
        "with a state), and value functions prove nothing."
    )


def _least_noise(model: Model, span: Ends, low: Array, high: Array) -> Array:
    """Positive where a is positive definite on all of a box; boxes of shape (n, N)."""
    clock = [Interval(*span).broadcast_to(low.shape[1:])]
    values, _ = enclose(model.square.tape, clock + [Interval(a, b) for a, b in zip(low, high)])
    smallest = values[0].lo
    if len(low) == 2:
        cross = np.maximum(np.abs(values[1].lo), np.abs(values[1].hi))
        smallest = np.minimum(np.minimum(values[0].lo, values[3].lo), values[0].lo * values[3].lo - cross**2)
    return np.asarray(smallest)


def held_face(model: Model, box: Sequence[Ends], inner: Ends, span: Ends, axis: int, side: int) -> float | None:
    """A place of x_i between the starts and a side of the box that no path crosses outward; None if none was found.

    Parameters
    ----------
    model : Model
    box : sequence of (float, float)
        Finite.
    inner : (float, float)
        Ends of the starts along the axis: the face is outside of them.
    span : (float, float)
        Of time.
    axis, side : int

    Returns
    -------
    float or None
        Proved by the lemma of this module, for paths that are otherwise in the box.
    """
    begin, end = inner[side], box[axis][side]
    if not (end < begin if side == 0 else begin < end):
        return None
    places = _candidates(model, box, begin, end, span, axis)
    found = [place for place in places if _is_held(model, box, span, axis, side, place)]
    return (max(found) if side == 0 else min(found)) if found else None


def _candidates(model: Model, box: Sequence[Ends], begin: float, end: float, span: Ends, axis: int) -> list[float]:
    """Where a_ii may vanish on all of the box: its side, 0, and the edge of where it does, in plain floats."""
    low, high = min(begin, end), max(begin, end)
    square = compile_numpy(model.square.tape)
    rng = np.random.default_rng(0)
    others = [rng.uniform(*ends, size=(8, 1)) for ends in (span, *box)]

    def vanishes(places: Array) -> Mask:
        points = [np.broadcast_to(row, (8, len(places))) for row in others]
        points[1 + axis] = np.broadcast_to(places, (8, len(places)))
        with np.errstate(all="ignore"):
            a = np.broadcast_to(square(*points)[..., axis, axis], (8, len(places)))
        top = np.nanmax(np.abs(a), initial=1e-300)
        return np.asarray(~(a > _NIL * top).any(axis=0))

    line = np.linspace(begin, end, _SCANNED)
    gone = vanishes(line)
    places = [place for place in (end, 0.0) if low <= place <= high and place != begin]
    if gone.any() and not gone[0]:
        inside, outside = line[np.argmax(gone) - 1], line[np.argmax(gone)]
        for _ in range(60):
            middle = (inside + outside) / 2
            inside, outside = (inside, middle) if vanishes(np.array([middle]))[0] else (middle, outside)
        edge = round(float(outside), 10)
        places += [edge] if low <= edge <= high and edge != begin else []
    return places


def _is_held(model: Model, box: Sequence[Ends], span: Ends, axis: int, side: int, place: float) -> bool:
    """The hypotheses of the lemma on a face, in outward-rounded arithmetic."""
    width = _BESIDE * (abs(box[axis][1] - box[axis][0]) + abs(place))
    beside = Interval(place - width, place) if side == 0 else Interval(place, place + width)
    fine = [np.linspace(*ends, _PARTS + 1) for k, ends in enumerate((span, *box)) if k != 1 + axis]
    low = [cut.ravel() for cut in np.meshgrid(*(row[:-1] for row in fine), indexing="ij")]
    high = [cut.ravel() for cut in np.meshgrid(*(row[1:] for row in fine), indexing="ij")]
    cells = [Interval(a, b) for a, b in zip(low, high)]
    on, near = cells.copy(), cells.copy()
    on.insert(1 + axis, Interval(np.full(len(low[0]), place), np.full(len(low[0]), place)))
    near.insert(1 + axis, beside.broadcast_to(low[0].shape))
    n, sign = len(box), 1 - 2 * side
    square = _output(model.square.tape, axis * n + axis)
    drift = _output(model.drift.tape, axis)
    try:
        if not np.all(enclose(square, on)[0][0].mag == 0) or not _lipschitz(square, near, axis):
            return False
        for branch in model.branches:
            given = [one.broadcast_to(low[0].shape) for one in branch]
            inward = enclose(drift, [*on, *given])[0][0] * float(sign)
            if not np.all(inward.lo >= 0) or not _lipschitz(drift, [*near, *given], axis):
                return False
    except EnclosureError:
        return False
    return True


def rarely_reached(
    model: Model, box: Sequence[Ends], inner: Ends, span: Ends, axis: int, side: int
) -> float:
    """An upper bound of log P(X_i reaches a side of the box before it leaves the box in another way).

    Parameters
    ----------
    model, box, inner, span, axis, side
        As for `held_face`.

    Returns
    -------
    float
        0 where the drift leads there. Proved by the second lemma of this module, in outward-rounded arithmetic.
    """
    gap = inner[0] - box[axis][0] if side == 0 else box[axis][1] - inner[1]
    if not gap > 0:
        return 0.0
    length = Interval.point(span[1]) - Interval.point(span[0])
    try:
        half, outward = _across(model, box, span, axis, side, np.linspace(*box[axis], _PARTS + 1))
        room = _lengths(np.array(sorted((inner[side], box[axis][side]))))[0]
        least = 0.0
        for k in np.geomspace(1.0, 1e4, 41) / gap:
            steep = Interval.point(k)
            rate = float(((outward + half * steep) * steep).hi.max())
            least = min(least, float((Interval.point(max(rate, 0.0)) * length - steep * room).hi))
        places = np.linspace(inner[side], box[axis][side], _ALONG + 1)
        half, outward = _across(model, box, span, axis, side, np.sort(places))
        order = slice(None) if side == 1 else slice(None, None, -1)
        climbs = (_climb(outward[order], half[order], places, level, length) for level in _LEVELS / length.mid)
        least = min(least, *climbs)
    except EnclosureError:
        return 0.0
    return least if math.isfinite(least) else 0.0


def _across(
    model: Model, box: Sequence[Ends], span: Ends, axis: int, side: int, places: Array
) -> tuple[Interval, Interval]:
    """Upper bounds of a_ii / 2 and of the drift outward between places of an axis, shape (cells, parts of others)."""
    times = 1 if model.autonomous else _PARTS
    fine = [np.linspace(*ends, parts + 1) for ends, parts in zip((span, *box), (times, *[_PARTS] * len(box)))]
    fine[1 + axis] = places
    order = [1 + axis, *(k for k in range(len(fine)) if k != 1 + axis)]
    low = np.meshgrid(*(fine[k][:-1] for k in order), indexing="ij")
    high = np.meshgrid(*(fine[k][1:] for k in order), indexing="ij")
    back = np.argsort(order)
    cells = [Interval(low[k].ravel(), high[k].ravel()) for k in back]
    drift, n = _output(model.drift.tape, axis), len(box)
    half = enclose(_output(model.square.tape, axis * n + axis), cells)[0][0] * Interval.point(0.5)
    size = cells[0].lo.shape
    rates = [
        enclose(drift, [*cells, *(one.broadcast_to(size) for one in branch)])[0][0] * (2.0 * side - 1.0)
        for branch in model.branches
    ]
    shape = len(places) - 1, -1
    tops = [np.broadcast_to(one.hi, size).reshape(shape) for one in (half, *rates)]
    return Interval.point(tops[0]), Interval.point(np.max(tops[1:], axis=0))


def _climb(outward: Interval, half: Interval, places: Array, level: float, length: Interval) -> float:
    """The bound of the second lemma with a slope that rises from 0 as far as it may, at a rate of about ``level``."""
    slope = [0.0]
    for force, h, step in zip(outward.hi, np.maximum(half.hi, 1e-300), np.abs(np.diff(places))):
        k, b = slope[-1], force + h / step  # both ends of the cell keep to the level
        c = level + h * k / step
        root = np.hypot(b, 2 * np.sqrt(h * c))
        there = np.where(b > 0, 2 * c / np.maximum(root + b, 1e-300), (root - b) / (2 * h))
        most = np.minimum(there, k + step * ((level - k * force) / h - k * k)).min()
        slope.append(float(np.clip(most, 0.0, _STEEPEST / step)))
    ends = [Interval.point(np.array(part)) for part in (slope[:-1], slope[1:])]
    widths = _lengths(places)
    bend = (ends[1] - ends[0]) / widths
    noise = Interval(np.zeros(half.shape), half.hi)
    # k is linear, and the inequality convex in it: it holds all over a cell if it does at both ends
    rate = max(float((k[:, None] * outward + (k * k + bend)[:, None] * noise).hi.max()) for k in ends)
    rise = ((ends[0] + ends[1]) * widths * Interval.point(0.5)).sum()
    return float((Interval.point(max(rate, 0.0)) * length - rise).hi)


def _lengths(places: Array) -> Interval:
    """Distances between neighbours."""
    first, second = Interval.point(places[:-1]), Interval.point(places[1:])
    return second - first if places[-1] >= places[0] else first - second


def _output(tape: Tape, output: int) -> Tape:
    """One output of a tape alone; what it does not need is not asked."""
    graph = Graph.starting_with(tape)
    return graph.tape([tape.outputs[output]], (1,))


def _lipschitz(tape: Tape, near: Sequence[Interval], axis: int) -> bool:
    """Whether a function is Lipschitz along an axis on boxes: no jumps, and bounded generalised derivatives."""
    if any(node.op in JUMPS or node.op == "atan2" for node in tape.nodes):
        return False
    value = enclose(jacobian(tape, [1 + axis]), near)[0][0]
    return bool(np.isfinite(value.mag).all())


def resolved(model: Model, span: Ends, box: Sequence[Ends]) -> Model:
    """The model with the branch of every min, max and abs that it is on all over a box."""
    whole = [Interval.point(0.0) + Interval(*ends) for ends in (span, *box)]
    axes = 1 + len(box)
    given = [Interval(min(float(one.lo) for one in row), max(float(one.hi) for one in row))
             for row in zip(*model.branches)]  # fmt: skip
    drift = _resolved(model.drift.tape, [*whole, *given])
    square = _resolved(model.square.tape, whole)
    if drift is model.drift.tape and square is model.square.tape:
        return model
    return replace(model, drift=Reader(drift, axes), square=Reader(square, axes))


def _resolved(tape: Tape, inputs: Sequence[Interval]) -> Tape:
    if not any(node.op in ("min", "max", "abs") for node in tape.nodes):
        return tape
    graph = Graph(tape.inputs)
    arithmetic = graph.arithmetic()
    values: list[Interval] = []
    place: list[int] = []
    kept: list[int] = []
    for node in tape.nodes:
        args = [] if node.op == "input" else [values[arg] for arg in node.args]
        with np.errstate(all="ignore"):
            values.append(inputs[node.args[0]] if node.op == "input" else enclosed(node, args))
        chosen = _branch(node.op, args)
        if node.op == "input":
            place.append(graph.input(node.args[0]))
        elif node.op == "const":
            place.append(graph.const(node.value))
        elif chosen is not None:
            place.append(place[node.args[abs(chosen) - 1]])
            if chosen < 0:
                place[-1] = graph.apply("neg", place[-1])
        else:
            own = [place[arg] for arg in node.args]
            more = [node.value] if node.op == "pow" else [node.part] if node.part is not None else []
            place.append(arithmetic[node.op](*own, *more))
        if node.op == "sqrt":
            kept.append(place[-1])
    outputs = [place[output] for output in tape.outputs]
    return graph.tape(outputs, tape.shape, also=kept)


def _branch(op: str, args: Sequence[Interval]) -> int | None:
    """Which argument (from 1 on) a min, max or abs is everywhere, less than 0 for its negative."""
    if op == "abs":
        return 1 if np.all(args[0].lo >= 0) else -1 if np.all(args[0].hi <= 0) else None
    if op not in ("min", "max"):
        return None
    above = 1 if np.all(args[0].lo >= args[1].hi) else 2 if np.all(args[1].lo >= args[0].hi) else None
    return above if op == "max" or above is None else 3 - above
