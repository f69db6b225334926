"""The noise-free step f(t, x, d) on a grid: where nodes and cells land, and with which derivatives."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Integers, Mask
from certbound.problem.model import Tape, enclosed, jacobian, jumps_where, undefined_where
from certbound.problem.problem import Problem
from certbound.rigor.intervals import Interval
from certbound.values.grids import Grid

_CHUNK = 16384


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class CellImages:
    """f over every cell of a grid and one box of disturbances; V = n + disturbances variables.

    Parameters
    ----------
    image : Interval, shape (cells, n)
        Range of f.
    slopes, bends : Interval, shape (cells, n, V)
        d f_k / d v_i and d^2 f_k / d v_i^2.
    defined, steady, smooth : ndarray of bool, shape (cells,)
        Whether the range is finite and f defined; whether f is also continuous there with bounded slopes, so that
        ``slopes`` holds its generalised derivative; whether ``bends`` holds too.
    """

    image: Interval
    slopes: Interval
    bends: Interval
    defined: Mask
    steady: Mask
    smooth: Mask

    def ranges_of(self, cells: Integers) -> CellImages:
        """Some cells alone, of which nothing but the range is told: steady wherever f is defined."""
        defined, parts = self.defined[cells], (self.image[cells], self.slopes[cells], self.bends[cells])
        return CellImages(
            image=parts[0], slopes=parts[1], bends=parts[2], defined=defined, steady=defined, smooth=defined & False
        )


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Step:
    """One noise-free step from a grid.

    Parameters
    ----------
    grid : Grid
    vertices : list of (Interval, ndarray of bool)
        Per vertex of the cut set of disturbances: images of the nodes, shape (nodes, n), and where f is defined.
    cells : list of CellImages
        Per box of disturbances.
    pieces : Array, shape (boxes, l)
        Widths of those boxes, rounded up (l = 0 without disturbances).
    """

    grid: Grid
    vertices: list[tuple[Interval, Mask]]
    cells: list[CellImages]
    pieces: Array

    def width(self, box: int, variable: int) -> Array | float:
        """Width of the cells, or of a box of disturbances, along a variable; rounded down."""
        n = self.grid.dimension
        if variable >= n:
            return float(self.pieces[box, variable - n]) * (1 - 1e-12) or 1.0
        widths = self.grid.widths(variable) * (1 - 1e-12)
        return np.asarray(np.broadcast_to(np.where(widths > 0, widths, 1.0), self.grid.shape).ravel())

    def hull(self) -> tuple[Array, Array]:
        """Ends of a box around all images that are finite, shapes (n,)."""
        low = np.full(self.grid.dimension, np.inf)
        high = -low
        for image, usable in self.vertices:
            if usable.any():
                low = np.minimum(low, image.lo[usable].min(axis=0))
                high = np.maximum(high, image.hi[usable].max(axis=0))
        for part in self.cells:
            if part.defined.any():
                low = np.minimum(low, part.image.lo[part.defined].min(axis=0))
                high = np.maximum(high, part.image.hi[part.defined].max(axis=0))
        return np.where(low <= high, low, 0.0), np.where(low <= high, high, 0.0)


class Dynamics:
    """The closed loop of a problem, read on boxes.

    Parameters
    ----------
    problem : Problem
        In discrete time, with a plan if its system has inputs.
    parts : int
        Parts along each side of the set of disturbances.
    """

    def __init__(self, problem: Problem, parts: int = 4) -> None:
        self.problem, self.parts = problem, parts
        tape = problem.closed_loop
        system = problem.system
        self.n = system.dimension
        sequence = problem.input_sequence
        self._inputs = sequence
        first = 1 + self.n + (0 if sequence is None else sequence.shape[1])
        count = len(system.disturbance_names)
        self.columns = [*range(1, 1 + self.n), *range(first, first + count)]
        self.tape = tape
        self.slopes = jacobian(tape, self.columns)
        self.bends = [jacobian(_column(self.slopes, i), [slot]) for i, slot in enumerate(self.columns)]
        used = {arg for node in tape.nodes if node.op != "input" for arg in node.args} | set(tape.outputs)
        clock = any(node.op == "input" and node.args[0] == 0 and k in used for k, node in enumerate(tape.nodes))
        self.steady = not clock and (sequence is None or bool(np.all(sequence == sequence[0])))
        """Whether every step is the same."""

    def step(self, t: int, grid: Grid) -> Step:
        """The step from time t on a grid."""
        low, high = self._disturbances()
        vertices = [self._nodes(t, grid, Interval.point(vertex)) for vertex in _vertices(low, high, self.parts)]
        boxes = _boxes(low, high, self.parts)
        cells = [self.over(t, grid.cells(), box) for box in boxes]
        pieces = np.array([box.width for box in boxes]).reshape(len(boxes), len(low))
        return Step(grid=grid, vertices=vertices, cells=cells, pieces=pieces)

    def _disturbances(self) -> tuple[Array, Array]:
        box = self.problem.system.disturbance
        return (np.empty(0), np.empty(0)) if box is None else (np.asarray(box.low), np.asarray(box.high))

    def arguments(self, t: int, states: Interval, disturbance: Interval) -> list[Interval]:
        found = [Interval.point(float(t)), *(states[:, k] for k in range(self.n))]
        if self._inputs is not None:
            found += [Interval.point(float(value)) for value in self._inputs[t]]
        return found + [disturbance[k] for k in range(len(disturbance))]

    def _nodes(self, t: int, grid: Grid, vertex: Interval) -> tuple[Interval, Mask]:
        image, undefined, _ = evaluate(self.tape, self.arguments(t, Interval.point(grid.nodes()), vertex))
        return image, ~undefined & np.isfinite(image.lo).all(axis=1) & np.isfinite(image.hi).all(axis=1)

    def over(self, t: int, boxes: Interval, box: Interval) -> CellImages:
        """f and its derivatives over boxes of states, shape (boxes, n), and one box of disturbances."""
        whole = self.arguments(t, boxes, box)
        image, undefined, jumps = evaluate(self.tape, whole)
        slopes, bad_slopes, kinks = evaluate(self.slopes, whole)
        count, variables = len(boxes), len(self.columns)
        slopes = slopes.reshape(count, self.n, variables)
        parts = [evaluate(tape, whole) for tape in self.bends]
        bends = Interval(
            *(np.stack([getattr(p[0], end).reshape(count, self.n) for p in parts], -1) for end in ("lo", "hi"))
        )
        steady = ~undefined & ~jumps & ~bad_slopes & ~kinks & np.isfinite(slopes.mag).all(axis=(1, 2))
        smooth = steady & ~np.any([p[1] | p[2] for p in parts], axis=0) & np.isfinite(bends.mag).all(axis=(1, 2))
        image = self._centred(t, boxes, box, image, slopes, steady)
        defined = ~undefined & np.isfinite(image.mag).all(axis=1)
        return CellImages(
            image=image, slopes=slopes, bends=bends, defined=defined, steady=steady & defined, smooth=smooth & defined
        )

    def _centred(
        self, t: int, boxes: Interval, box: Interval, image: Interval, slopes: Interval, steady: Mask
    ) -> Interval:
        """f(middle) + slopes (v - middle), where that is sharper."""
        if not steady.any():
            return image
        middle, centre = Interval.point(boxes.mid), Interval.point(box.mid)
        at, undefined, _ = evaluate(self.tape, self.arguments(t, middle, centre))
        usable = steady & ~undefined & np.isfinite(at.mag).all(axis=1)
        away = boxes - middle
        if len(box):
            rest = (box - centre).broadcast_to((len(boxes), len(box)))
            away = Interval(np.concatenate([away.lo, rest.lo], axis=1), np.concatenate([away.hi, rest.hi], axis=1))
        found = at + (slopes * away[:, None, :]).sum(axis=-1)
        low = np.where(usable[:, None], np.maximum(image.lo, found.lo), image.lo)
        high = np.where(usable[:, None], np.minimum(image.hi, found.hi), image.hi)
        return Interval(low, np.maximum(high, low))


def _column(slopes: Tape, column: int) -> Tape:
    """One column of a Jacobian, as a vector."""
    rows, columns = slopes.shape
    outputs = tuple(slopes.outputs[row * columns + column] for row in range(rows))
    return Tape(inputs=slopes.inputs, nodes=slopes.nodes, outputs=outputs, shape=(rows,))


def _vertices(low: Array, high: Array, parts: int) -> list[Array]:
    cuts = [np.linspace(a, b, parts + 1) if a < b else np.array([a]) for a, b in zip(low, high)]
    return [np.array(point) for point in itertools.product(*cuts)]


def _boxes(low: Array, high: Array, parts: int) -> list[Interval]:
    cuts = [np.linspace(a, b, parts + 1) if a < b else np.array([a, a]) for a, b in zip(low, high)]
    pieces = [list(itertools.pairwise(cut)) for cut in cuts]
    return [
        Interval(np.array([p[0] for p in box]), np.array([p[1] for p in box])) for box in itertools.product(*pieces)
    ]


def evaluate(tape: Tape, inputs: list[Interval]) -> tuple[Interval, Mask, Mask]:
    """Enclosure of a tape over a batch of boxes, and two masks of members.

    Returns
    -------
    Interval, shape (N, outputs)
        The range; at an undecided jump all values that the operation may take.
    undefined : ndarray of bool, shape (N,)
        Where some operation is undefined somewhere on the box, needed or not.
    jumps : ndarray of bool, shape (N,)
        Where a jump is undecided: derivatives do not count there.
    """
    size = max((len(x) for x in inputs if x.ndim), default=1)
    lo, hi = np.empty((size, len(tape.outputs))), np.empty((size, len(tape.outputs)))
    undefined, jumps = np.zeros(size, dtype=bool), np.zeros(size, dtype=bool)
    for start in range(0, size, _CHUNK):
        part = slice(start, min(start + _CHUNK, size))
        values = _run(tape, [x[part] if x.ndim else x for x in inputs], undefined[part], jumps[part])
        for column, output in enumerate(tape.outputs):
            lo[part, column], hi[part, column] = values[output].lo, values[output].hi
    return Interval(lo, hi), undefined, jumps


def _run(tape: Tape, inputs: list[Interval], undefined: Mask, jumps: Mask) -> list[Interval]:
    values: list[Interval] = []
    chosen = _choices(tape)
    for index, node in enumerate(tape.nodes):
        if node.op == "input":
            values.append(inputs[node.args[0]])
            continue
        args = [values[arg] for arg in node.args]
        value = enclosed(node, args)
        if index in chosen:
            x, y = (values[arg] for arg in chosen[index])
            value = Interval(np.fmax(value.lo, np.minimum(x.lo, y.lo)), np.fmin(value.hi, np.maximum(x.hi, y.hi)))
        if (jump := jumps_where(node, value, args)) is not None:
            np.logical_or(jumps, jump, out=jumps)
        elif (mask := undefined_where(node, args)) is not None:
            np.logical_or(undefined, mask, out=undefined)
        values.append(value)
    return values


def _choices(tape: Tape) -> dict[int, tuple[int, int]]:
    """The sums that are ``where(c, x, y)`` as it is traced, with the nodes x and y: their value is one of both."""
    nodes, found = tape.nodes, {}
    for index, node in enumerate(nodes):
        if node.op != "add" or any(nodes[arg].op != "if_else_zero" for arg in node.args):
            continue
        (c, x), (d, y) = (nodes[arg].args for arg in node.args)
        if any(nodes[one].op == "not" and nodes[one].args == (other,) for one, other in ((c, d), (d, c))):
            found[index] = x, y
    return found
