"""L = f . D + tr(a D^2) / 2, a = g g^T, on cells: Taylor models of f and of a, and the faces by which paths may leave.

Variables of the models are the states and, where the model reads them, time on a slab and the disturbances on their
intervals. Where disturbances are given (`acting`), they are numbers. Where the drift jumps, by the state or by time,
it has all values on either side: Ito's formula asks of v alone to be smooth. From below, where disturbances change
with the state, a drift that jumps by the state is refused.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from flint import arb

from certbound.checker.report import Budget
from certbound.checker.statement import Model
from certbound.checker.values import batches as tm
from certbound.checker.values.batch_tapes import run
from certbound.checker.values.batches import Array, Batch, Index, Mask, Terms, terms
from certbound.problem.model import Node, Tape

Orders = tuple[int, ...]
Generator = list[tuple[Orders, float, Batch]]
Acting = tuple[float, ...]
Slabs = tuple[Array, Index]

_DEGREES = {2: 5, 3: 4}
"""Degree of the Taylor models by the number of states."""
_STEEPEST = 3
"""Largest power of time and of a disturbance that is kept."""
TOGETHER = 4096
"""Parts of cells that are looked at together."""
_TERMS = 56
"""Monomials with which so many are."""
_IN_TIME = 15
"""Degree of what reads time alone: on slabs beside a bend or a jump it must be known on which side they are."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Grid:
    """Nodes of every axis, and times of the slabs."""

    axes: tuple[Array, ...]
    times: Array


class Operator:
    """L of a model with two or three states.

    Parameters
    ----------
    model : Model
    budget : Budget
    """

    def __init__(self, model: Model, budget: Budget) -> None:
        self.model, self.budget, self.n = model, budget, model.dimension
        given = model.noise.diffusion
        self.tapes = [model.dynamics, *([given] if isinstance(given, Tape) else [])]
        read = {node.args[0] for tape in self.tapes for node in tape.nodes if node.op == "input"}
        self.timed = 0 in read
        self.free = [k for k in range(len(model.disturbance)) if 1 + self.n + k in read]

    def variables(self, acting: Acting | None) -> int:
        """How many variables the models have."""
        return self.n + self.timed + (len(self.free) if acting is None else 0)

    def terms(self, acting: Acting | None) -> Terms:
        """Their monomials."""
        return terms(self.variables(acting), _DEGREES[self.n], self.budget)

    def together(self, acting: Acting | None) -> int:
        """Parts of cells whose models are made together."""
        return max(TOGETHER * _TERMS // max(len(self.terms(acting).exponents), _TERMS), TOGETHER // 16)

    def work(self, cells: int, slabs: int, acting: Acting | None) -> int:
        """Numbers that the models take on every cell at least, an array for each operation and three for a product."""
        given = self.model.noise.diffusion
        columns = given.shape[1] if isinstance(given, Tape) else given.ncols()
        operations = sum(node.op != "input" for tape in self.tapes for node in tape.nodes)
        many = cells * (slabs if self.timed else 1)
        return self.terms(acting).numbers(many) * (operations + 3 * self.n * self.n * columns)

    # ---- on parts of cells ------------------------------------------------------------------------------------

    def models(
        self, grid: Grid, slab: Index, places: Sequence[Index], level: int, acting: Acting | None
    ) -> Generator:
        """The coefficients of L: orders of a derivative, a factor, a Taylor model.

        ``places`` count parts of cells, which are cut into 2^level equal parts along every axis.
        """
        which, states = self.terms(acting), []
        for k, (axis, place) in enumerate(zip(grid.axes, places)):
            states.append(_part(tm.variable(which, k, *_ends(axis, place >> level)), k, place, level))
        slabs = (grid.times, slab)
        found: Generator = []
        for i, rate in enumerate(self._drift(slabs, states, acting)):
            found.append((_order(self.n, i), 1.0, rate))
        squares = self._squares(slabs, states)
        for i, j in itertools.combinations_with_replacement(range(self.n), 2):
            found.append((_order(self.n, i, j), 0.5 if i == j else 1.0, squares[i][j]))
        found = [(orders, weight, self._trimmed(one)) for orders, weight, one in found]
        return [one for one in found if one[2].coefficients.any() or one[2].error.any()]

    def _run(
        self, tape: Tape, slabs: Slabs, states: Sequence[Batch], rows: Sequence[Batch], jumps: bool = False
    ) -> list[Batch]:
        """A tape; what reads time alone comes from a table of all slabs."""
        which, shape = states[0].terms, states[0].error.shape
        known = {}
        if self.timed:
            number, (times, slab) = self.n, slabs
            clock: Clock = self.budget.once(times, ("clock", id(tape)), lambda: Clock(tape, times, self.budget))
            known = clock.on(which, number, slab)
        return run(tape, [tm.fixed(which, np.zeros(shape)), *states, *rows], known=known, jumps=jumps)

    def _drift(self, slabs: Slabs, states: Sequence[Batch], acting: Acting | None) -> list[Batch]:
        """f."""
        which, shape, rows = states[0].terms, states[0].error.shape, []
        for k, (low, high) in enumerate(self.model.disturbance):
            if acting is not None:
                rows.append(tm.fixed(which, np.full(shape, acting[k])))
            elif k in self.free:
                number = self.n + self.timed + self.free.index(k)
                rows.append(tm.variable(which, number, np.full(shape, low), np.full(shape, high)))
            else:
                rows.append(tm.fixed(which, np.zeros(shape)))
        return self._run(self.model.dynamics, slabs, states, rows, jumps=acting is None or not self.free)

    def _squares(self, slabs: Slabs, states: Sequence[Batch]) -> list[list[Batch]]:
        """g g^T."""
        given, n, like = self.model.noise.diffusion, self.n, states[0]
        columns = given.shape[1] if isinstance(given, Tape) else given.ncols()
        self.budget.fits(8 * (n * columns + 2 * n * n) * like.coefficients.size)
        if isinstance(given, Tape):
            entries = self._run(given, slabs, states, [])
        else:
            entries = [tm.fixed(like.terms, np.full(like.error.shape, float(x))) for x in given.entries()]
        rows = [entries[i * columns : (i + 1) * columns] for i in range(n)]
        return [[_summed([tm.mul(x, y) for x, y in zip(one, two)]) for two in rows] for one in rows]

    def _trimmed(self, model: Batch) -> Batch:
        """Without high powers of time and of disturbances, which go into the error."""
        high = [k for k, powers in enumerate(model.terms.exponents) if max(powers[self.n :], default=0) > _STEEPEST]
        if not high or not model.coefficients[high].any():
            return model
        self.budget.floats(3 * model.coefficients.size, 10)
        coefficients = model.coefficients.copy()
        coefficients[high] = 0.0
        lost = np.abs(model.coefficients[high]).sum(axis=0)
        return Batch(model.terms, coefficients, (model.error + lost) * (1 + 2.0**-40))

    # ---- faces ------------------------------------------------------------------------------------------------

    @cached_property
    def noisy(self) -> list[bool]:
        """Whether noise may move each state."""
        return [self._is_noisy(i) for i in range(self.n)]

    def _is_noisy(self, i: int) -> bool:
        given = self.model.noise.diffusion
        if isinstance(given, Tape):
            columns = given.shape[1]
            rows = [given.nodes[place] for place in given.outputs[i * columns : (i + 1) * columns]]
            return not all(node.op == "const" and node.value == 0 for node in rows)
        return not all(given[i, k].is_zero() for k in range(given.ncols()))

    def leaving(self, grid: Grid, axis: int, side: int) -> Mask:
        """By which cells of a face a path may leave, for some disturbance; shape (slabs, face cells).

        Noise crosses the face, or the drift was not shown to lead inward on all of the cell in the slab.
        """
        others = [row for k, row in enumerate(grid.axes) if k != axis]
        cells, slabs = math.prod(len(row) - 1 for row in others), len(grid.times) - 1
        self.budget.fits(8 * cells * slabs)
        if self.noisy[axis]:
            return np.ones((slabs, cells), dtype=bool)
        own = slabs if self.timed else 1
        found = np.concatenate(list(self._not_inward(grid, axis, side, own)))
        return np.broadcast_to(found.reshape(own, cells), (slabs, cells))

    def _not_inward(self, grid: Grid, axis: int, side: int, slabs: int) -> Iterator[Mask]:
        shape = (slabs, *(len(row) - 1 for k, row in enumerate(grid.axes) if k != axis))
        place = float(grid.axes[axis][-side])
        inward = float(np.nextafter(place, np.inf if side == 0 else -np.inf))  # the drift may jump on the face
        which, most = self.terms(None), self.together(None)
        for first in range(0, math.prod(shape), most):
            number = np.arange(first, min(first + most, math.prod(shape)))
            slab, *rest = np.unravel_index(number, shape)
            places = iter(rest)
            ends = [(np.full(len(number), min(place, inward)), np.full(len(number), max(place, inward))) if k == axis
                    else _ends(row, next(places)) for k, row in enumerate(grid.axes)]  # fmt: skip
            states = [tm.variable(which, k, *row) for k, row in enumerate(ends)]
            low, high = self._drift((grid.times, slab), states, None)[axis].ends()
            yield ~(low > 0) if side == 0 else ~(high < 0)


class Clock:
    """What a tape makes of time alone, on every slab: Taylor models of one variable and of a high degree.

    Parameters
    ----------
    tape : Tape
        Over time and more.
    times : ndarray
        Ends of the slabs.
    budget : Budget
    """

    def __init__(self, tape: Tape, times: Array, budget: Budget) -> None:
        found = dict[int, int]()
        nodes = list[Node]()
        for index, node in enumerate(tape.nodes):
            is_time = node.op == "input" and node.args[0] == 0
            if is_time or node.op == "const" or (node.op != "input" and all(arg in found for arg in node.args)):
                found[index] = len(nodes)
                nodes.append(node if is_time else node._replace(args=tuple(found[arg] for arg in node.args)))
        self.own = {index for index in found if tape.nodes[index].op != "const"}
        read = {arg for index, node in enumerate(tape.nodes) if index not in found and node.op != "input"
                for arg in node.args} | set(tape.outputs)  # fmt: skip
        self.read = sorted(self.own & read)
        outputs = tuple(found[index] for index in self.read)
        part = Tape(inputs=tape.inputs[:1], nodes=tuple(nodes), outputs=outputs, shape=(len(outputs),))
        which = terms(1, _IN_TIME, budget)
        budget.take(8 * (len(outputs) + 1) * which.numbers(len(times)))
        values = run(part, [tm.variable(which, 0, times[:-1], times[1:])], jumps=True)
        self.values, self.budget = dict(zip(self.read, values)), budget

    def on(self, which: Terms, number: int, slab: Index) -> dict[int, Batch]:
        """The same in other variables, of which time is one, on boxes in these slabs."""
        powers = [tuple(k if i == number else 0 for i in range(which.variables)) for k in range(which.degree + 1)]
        places = [which.exponents.index(row) for row in powers]
        nothing = tm.fixed(which, np.zeros(0))
        found = dict.fromkeys(self.own, nothing)
        for index, value in self.values.items():
            self.budget.fits(8 * which.numbers(len(slab)))
            self.budget.floats(2 * which.numbers(len(slab)), 20)
            coefficients = np.zeros((len(which.exponents), len(slab)))
            coefficients[places] = value.coefficients[: which.degree + 1, slab]
            error = value.error + np.abs(value.coefficients[which.degree + 1 :]).sum(axis=0) * (1 + 2.0**-40)
            found[index] = Batch(which, coefficients, error[slab])
        return found


def about(sides: Sequence[tuple[arb, arb]]) -> tuple[list[arb], list[arb]]:
    """Middles and half-sides of a box."""
    return [(a + b) / 2 for a, b in sides], [(b - a) / 2 for a, b in sides]


def _ends(axis: Array, place: Index) -> tuple[Array, Array]:
    return axis[place], axis[place + 1]


def _part(x: Batch, variable: int, place: Index, level: int) -> Batch:
    """A coordinate of cells as one of their parts."""
    middle, half, parts = x.value, x.coefficients[1 + variable], 2**level
    found = x.coefficients.copy()
    found[0] = middle + half * ((2 * (place % parts) + 1) / parts - 1)
    found[1 + variable] = half / parts
    return Batch(x.terms, found, x.error + (np.abs(middle) + np.abs(half)) * 2.0**-51)


def _order(n: int, *states: int) -> Orders:
    """The orders of a derivative by some states."""
    return tuple(states.count(i) for i in range(n))


def _summed(parts: Sequence[Batch]) -> Batch:
    total = parts[0]
    for part in parts[1:]:
        total = tm.add(total, part)
    return total
