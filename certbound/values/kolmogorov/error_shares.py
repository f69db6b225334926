"""Where the carried error comes from, and the axes and steps that make less of it with as much work.

To first order the error at the start is the sum over cells and slabs of residual times the time that paths spend there:
the shares. That time solves the equation with the transposed matrix. What of a cell's residual is due to its width
along each axis is told by the spline itself: by the jumps of its fifth derivative, and by its fourth one; what is left
between knots is due to the step. With shares falling as the third power of widths and steps, the sum is least where the
density of nodes is the fourth root of the share's density at that width; the numbers of cells of the axes, and that of
the steps, are balanced alike. Nothing here is trusted.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.values.kolmogorov.carry import Side
from certbound.values.kolmogorov.splines import DEGREE, Derivatives, sliding_max, unit

_POWER = 3.0  # of the widths, as which shares fall
_STEEPEST = 0.3  # growth of cells along an axis, per unit of length
_COARSEST = 10.0  # ratio of the largest cell of an axis to its smallest
_TURN = 1.5  # largest change of the number of cells of one axis against the others
_DAMPED = 0.5  # of what would balance the axes: of coarse cells shares fall faster than as the third power, and axes
# that follow them at once swing between two grids (errors of Lorenz' model from below: .01 and .04, by turns)
_FINER, _WIDER = 3.0, 1.5  # largest changes of a cell: what shares tell of much larger ones is not to be trusted
_SETTLED = 5
_SECOND, _UPWIND = 1 / 100, 1 / 12  # what errors of second derivatives and of upwind differences are of theirs


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Shape:
    """Widths of cells along one axis.

    Attributes
    ----------
    places, sizes : ndarray, shape (N,)
        Widths at places, in between linear.
    """

    places: Array
    sizes: Array

    def __call__(self, y: Array) -> Array:
        return np.interp(y, self.places, self.sizes)

    def scaled(self, factor: float) -> Shape:
        """The same with all widths times a factor."""
        return Shape(places=self.places, sizes=self.sizes * factor)


def better_shapes(side: Side, parts: Sequence[Array], starts: Array) -> list[Shape]:
    """Widths of cells, and last steps, with which the same work leaves less error at the starts, shape (points, n).

    ``parts`` are those of `Side.rough_parts`.
    """
    (*along, by_steps), crossed = _due(side, parts, starts)
    rows = [((axis.nodes[1:] + axis.nodes[:-1]) / 2, axis.widths, share) for axis, share in zip(side.axes, along)]
    passed = np.cumsum(side.steps) - side.steps / 2
    rows.append((passed[side.free], side.steps[side.free], max(crossed, 1.0) * by_steps[side.free]))
    *shapes, longest = _shapes(rows)
    finer = [float((width / shape(middle)).mean()) for (middle, width, _), shape in zip(rows, shapes)]
    steps = len(side.steps_of(longest)) / len(side.steps)  # steps within layers are as they were
    return [*(shape.scaled(float(np.prod(finer) * steps) ** (1 / len(shapes))) for shape in shapes), longest]


def shares(side: Side, parts: Sequence[Array], starts: Array) -> list[Array]:
    """Along each axis, for each of its cells, what is due to its width of the error at the starts; shapes (N_i,).

    The last row, shape (slabs,), is what is due to each step.
    """
    return _due(side, parts, starts)[0]


def _due(side: Side, parts: Sequence[Array], starts: Array) -> tuple[list[Array], float]:
    """The shares, and how many cells paths cross within a step, in the mean.

    Sources of all passes but the first differ from cell to cell. Steps that lead paths across several of them leave as
    many times the error of what is carried that they leave of v.
    """
    n = len(side.axes)
    crossed, paths = 0.0, 0.0
    leaving = _at_cells(side, side.carrier.leaving)
    result = [np.zeros(axis.cells) for axis in side.axes] + [np.zeros(len(side.steps))]
    for slabs, time in _occupation(side, starts):
        by_cells, by_steps = (np.array([side.steps[k] * parts[k][j] for k in slabs]) * time for j in (0, 1))
        due = by_cells.sum(axis=0)
        due[side.shapes.cut] = 0.0  # what edges leave there is due to no axis
        result[n][slabs] = by_steps.reshape(len(slabs), -1).sum(axis=1)
        crossed += float((time * leaving).sum() * (side.steps[slabs] ** 2).sum())
        paths += float(time.sum() * side.steps[slabs].sum())
        along = _indicators(side, slabs[len(slabs) // 2])
        total = np.add.reduce(along) + 1e-300
        for i in range(n):
            others = tuple(j for j in range(n) if j != i)
            result[i] += np.maximum((due * along[i] / total).sum(axis=others), 0.0)
    return result, crossed / max(paths, 1e-300)


def _occupation(side: Side, starts: Array) -> Iterator[tuple[list[int], Array]]:
    """Groups of slabs from the start on, and the share of paths in each cell by then."""
    equation = side.carrier.equation
    there = np.zeros(equation.shape)
    for point in starts:
        place = tuple(int(np.abs(line - y).argmin()) for line, y in zip(side.carrier.nodes, point))
        there[place] += 1.0 / len(starts)
    longest, slabs, gone = float(side.steps.max()), list[int](), 0.0
    for k in reversed(range(len(side.steps))):
        slabs.append(k)
        gone += float(side.steps[k])
        if gone < longest * (1 - 1e-9) and k:
            continue
        side.follow(k)
        there = equation.adjoint(longest, there)
        yield slabs, np.maximum(_at_cells(side, there), 0.0)
        slabs, gone = [], 0.0


def _at_cells(side: Side, nodes: Array) -> Array:
    """Means over the corners of every cell, of values at the nodes on which e is solved for."""
    for i, (before, behind) in enumerate(side.carrier.pad):
        line = np.moveaxis(nodes, i, 0)[before : nodes.shape[i] - behind]
        nodes = np.moveaxis((line[1:] + line[:-1]) / 2, 0, i)
    return nodes


def _indicators(side: Side, knot: int) -> list[Array]:
    """About how much of the residual on each cell is due to its width along each axis, at one knot."""
    n, setting = len(side.axes), side.setting
    lines = [(axis.nodes[1:] + axis.nodes[:-1]) / 2 for axis in side.axes]
    middles = np.array(np.meshgrid(*lines, indexing="ij"))
    flow, spread = setting.flow(middles), setting.spread(middles).reshape(n, n, *middles.shape[1:])
    derivatives = Derivatives(side.axes, side.values[knot][None])
    result = []
    for i, axis in enumerate(side.axes):
        width = axis.widths.reshape([-1 if j == i else 1 for j in range(n)])
        jumps = np.abs(np.diff(derivatives.along(i, DEGREE)[0], axis=i))
        jumps = np.pad(jumps, [(3, 3) if j == i else (0, 0) for j in range(n)])
        jumps = sliding_max(jumps, i, 6)  # at the ends of an axis the splines have none
        for j in range(n):
            if j != i:
                jumps = sliding_max(jumps, j, DEGREE + 1)
        due = _SECOND * spread[i, i] / 2 * width**3 * jumps
        if setting.noisy[i]:
            due += _UPWIND / 5 * np.abs(flow[i]) * width**4 * jumps
        else:
            due += _UPWIND * np.abs(flow[i]) * width**3 * derivatives.size(unit(i, n, DEGREE - 1))[0]
        result.append(due)
    return result


def _shapes(rows: Sequence[tuple[Array, Array, Array]]) -> list[Shape]:
    """Better widths, from the middles of cells, their widths and their shares, axis by axis."""
    shapes, wholes = [], []
    for middle, width, share in rows:
        count = len(share)
        constant = np.maximum(share, 0.0) / width ** (_POWER + 1)  # the share of a cell is constant x width^4
        density = constant ** (1 / (_POWER + 1))
        sizes = 1 / np.maximum(density, max(float(density.max()) / _COARSEST, 1e-300))
        for _ in range(_SETTLED):  # neither changes the number of cells, nor one cell by much
            sizes = np.clip(sizes * float((width / sizes).sum()) / count, width / _FINER, width * _WIDER)
        sizes = np.min(sizes + _STEEPEST * np.abs(middle[:, None] - middle), axis=1)
        sizes *= float((width / sizes).sum()) / count
        wholes.append(float((constant * width * sizes**_POWER).sum()))
        shapes.append(Shape(places=middle, sizes=sizes))
    usual = np.exp(np.mean(np.log(np.maximum(wholes, 1e-300))))
    turns = np.clip((usual / np.maximum(wholes, 1e-300)) ** (_DAMPED / _POWER), 1 / _TURN, _TURN)
    return [Shape(places=one.places, sizes=one.sizes * turn) for one, turn in zip(shapes, turns)]


__all__ = ["Shape", "better_shapes", "shares"]
