"""Discrete time: one step back of a function that lies above (below) the probability of failing, cell by cell.

With V_t(x) the largest probability of failing from x at step t on, V_t = 1 off the safe set of step t and elsewhere

    V_t(x) = sup over d of E V_(t+1)(f(t, x, d) + w),        V_T = 0 on the safe set.

``Values`` holds a function of the same kind for V_t: a polynomial on every cell of a grid, one number beyond. If it
lies above V_(t+1), so does the mean h of it after the noise, and h of f(t, x, d) is bounded from above on every cell by
a polynomial: h by its Taylor polynomial about a point of a mesh (`normal_means`), f by a Taylor model, whatever both
miss added to the constant. A cell that is not shown to be safe counts as 1, and so does all that lies beyond the grid.
From below: what is missed is subtracted, only cells that are shown to be unsafe count as 1, and others of which nothing
is known as 0; any one disturbance will do.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from flint import arb, arb_mat

from certbound.checker.report import Budget, Unproved
from certbound.checker.statement import Constraint, Model, StepSet
from certbound.checker.values import batches as tm
from certbound.checker.values.batch_tapes import run
from certbound.checker.values.batches import Array, Batch, Mask, Terms, above, terms
from certbound.checker.values.normal_means import (
    FARTHEST,
    ORDER,
    PER_DEVIATION,
    AxisTable,
    axis_table,
    mean_table,
)
from certbound.problem.model import Tape

Side = tuple[arb, arb]

DEGREE = 4
_CHUNK = 4096
_BOX_BYTES = 400
"""Memory of a side of a cell, in balls."""
_MOST_POINTS = 400_000
_MOST_ENTRIES = 1_000_000
"""Of the integrals of one axis, which are held 40 times over."""


@dataclass(frozen=True, eq=False)
class Grid:
    """A box cut into cells by rising edges of every state; cells are numbered with the last state fastest."""

    edges: tuple[Array, ...]

    @property
    def shape(self) -> tuple[int, ...]:
        """Cells along the states."""
        return tuple(len(edges) - 1 for edges in self.edges)

    def boxes(self) -> tuple[Array, Array]:
        """Lower and upper ends of all cells, shape (states, cells)."""
        low = np.meshgrid(*(edges[:-1] for edges in self.edges), indexing="ij")
        high = np.meshgrid(*(edges[1:] for edges in self.edges), indexing="ij")
        return np.stack([a.ravel() for a in low]), np.stack([a.ravel() for a in high])


@dataclass(frozen=True, eq=False)
class Values:
    """A polynomial on every cell, shape (terms, cells), and a number beyond the grid."""

    grid: Grid
    coefficients: Array
    beyond: float

    @property
    def size(self) -> int:
        """Numbers in its `pieces`."""
        powers: int = (DEGREE + 1) ** len(self.grid.edges)
        return powers * math.prod(count + 2 for count in self.grid.shape)

    def pieces(self) -> Array:
        """Coefficients by exponents and cells, with the outer cells, shape (degree + 1, ..., cells + 2, ...)."""
        n = len(self.grid.edges)
        table = np.zeros((DEGREE + 1,) * n + tuple(count + 2 for count in self.grid.shape))
        table[(0,) * n] = self.beyond
        inner = (slice(1, -1),) * n
        for exponents, row in zip(terms(n, DEGREE).exponents, self.coefficients):
            table[exponents + inner] = row.reshape(self.grid.shape)
        return table


class Steps:
    """The dynamics and the noise of a model; ``parts`` cut every side of the set of disturbances."""

    def __init__(self, model: Model, parts: int, budget: Budget, *, upper: bool) -> None:
        self.model, self.budget, self.upper = model, budget, upper
        self.terms = terms(model.dimension + len(model.disturbance), DEGREE, budget)
        many = parts ** len(model.disturbance) if upper else 2 ** len(model.disturbance)
        budget.take(100 * (1 + len(model.disturbance)) * many)
        budget.spend(1_000 * (1 + len(model.disturbance)) * many)
        self.disturbances = _parts(model.disturbance, parts, upper)
        tapes = [model.dynamics, *([g] if isinstance(g := model.noise.diffusion, Tape) else [])]
        clock = any(node.op == "input" and node.args[0] == 0 for tape in tapes for node in tape.nodes)
        rows = model.plan
        self.steady = not clock and (rows is None or all(row == rows[0] for row in rows))

    def images(self, step: int, low: Array, high: Array) -> Iterator[list[Batch]]:
        """f over some boxes, shape (states, boxes), one part of the disturbances after the other, by states."""
        count = low.shape[1]
        for part in self.disturbances:
            self.budget.fits(8 * 2 * len(low) * self.terms.numbers(count))
            chunks = [
                self._image(step, low[:, start : start + _CHUNK], high[:, start : start + _CHUNK], part)
                for start in range(0, count, _CHUNK)
            ]
            yield [tm.joined([chunk[i] for chunk in chunks]) for i in range(len(low))]

    def all_images(self, step: int, low: Array, high: Array) -> list[list[Batch]]:
        """The same for all parts at once, held in memory."""
        self.budget.take(8 * len(self.disturbances) * len(low) * (self.terms.numbers(low.shape[1]) + low.shape[1]))
        return list(self.images(step, low, high))

    def gains(self, step: int, low: Array, high: Array) -> Array:
        """Ends of what multiplies the noise over some boxes, shape (2, entries row by row, boxes)."""
        given, count = self.model.noise.diffusion, low.shape[1]
        entries = len(given.outputs) if isinstance(given, Tape) else given.nrows() * given.ncols()
        self.budget.take(8 * 2 * entries * count)
        self.budget.floats(2 * entries * count)
        found = np.empty((2, entries, count))
        if not isinstance(given, Tape):
            found[:] = np.array([float(x) for x in given.entries()])[None, :, None]
            return found
        for start in range(0, count, _CHUNK):
            part = slice(start, start + _CHUNK)
            for place, gain in enumerate(run(given, self._states(step, low[:, part], high[:, part]))):
                found[:, place, part] = gain.sharp_ends()
        return found

    def _states(self, step: int, low: Array, high: Array) -> list[Batch]:
        which, count = self.terms, low.shape[1]
        inputs = [tm.fixed(which, np.full(count, float(step)))]
        return inputs + [tm.variable(which, i, low[i], high[i]) for i in range(len(low))]

    def _image(self, step: int, low: Array, high: Array, part: Sequence[tuple[float, float]]) -> list[Batch]:
        which, count, n = self.terms, low.shape[1], len(low)
        inputs = self._states(step, low, high)
        if self.model.plan is not None:
            inputs += [tm.fixed(which, np.full(count, value)) for value in self.model.plan[step]]
        for j, (a, b) in enumerate(part):
            inputs.append(tm.variable(which, n + j, np.full(count, a), np.full(count, b)))
        return run(self.model.dynamics, inputs)


def _deviations(model: Model) -> list[arb]:
    """Standard deviations of the noise, which must move every state on its own."""
    if not model.noise.gaussian:
        raise Unproved("value functions are proved for normal and uniform noise only")
    found = independent(model.noise.covariance(), "noise")
    return found if model.noise.entries else [x.union(x * (1 - arb(2) ** -38)) for x in found]  # it may be raised


def independent(covariance: arb_mat, what: str) -> list[arb]:
    """Standard deviations of a normal vector whose entries are independent."""
    n = covariance.nrows()
    if any(not covariance[i, j].is_zero() for i in range(n) for j in range(n) if i != j):
        raise Unproved(f"value functions are proved for {what} only that is independent from state to state")
    if not all(covariance[i, i] > 0 for i in range(n)):
        raise Unproved(f"value functions are proved only where every state of {what} varies")
    return [covariance[i, i].sqrt() for i in range(n)]


def _parts(ranges: list[tuple[float, float]], parts: int, upper: bool) -> list[tuple[tuple[float, float], ...]]:
    """Boxes that cover the disturbances; from below their corners, any of which will do."""
    sides: list[list[tuple[float, float]]] = []
    for low, high in ranges:
        cuts = [low, *(low + (high - low) * k / parts for k in range(1, parts)), high] if low < high else [low, high]
        sides.append(list(itertools.pairwise(sorted(cuts))) if upper else [(cut, cut) for cut in sorted({low, high})])
    return list(itertools.product(*sides))


class Transition:
    """One step from some boxes into a grid: the images of the boxes, a mesh around these, and the axes' integrals."""

    def __init__(self, steps: Steps, step: int, low: Array, high: Array, after: Grid) -> None:
        self.steps, self.n = steps, len(low)
        self.images = steps.all_images(step, low, high)
        spreads = _deviations(steps.model)
        self._scales = [(float((1 / s).mid()), above(abs(1 / s - float((1 / s).mid())))) for s in spreads]
        self._spacing = [float(s.mid()) / PER_DEVIATION for s in spreads]
        if not all(width > 0 and math.isfinite(scale) for width, (scale, _) in zip(self._spacing, self._scales)):
            raise Unproved("the noise is too small for value functions in floats")
        points = [self._points(i, after.edges[i]) for i in range(self.n)]
        if math.prod(map(len, points)) > _MOST_POINTS:
            raise Unproved(f"the mesh around the images would have more than {_MOST_POINTS} points")
        if max(len(one) * len(edges) for one, edges in zip(points, after.edges)) > _MOST_ENTRIES:
            raise Unproved(f"the mesh and the grid of one state make more than {_MOST_ENTRIES} pairs")
        self.axes: list[AxisTable] = [
            axis_table(one, edges, s, DEGREE, steps.budget)
            for one, edges, s in zip(points, after.edges, spreads)
        ]

    def _points(self, i: int, edges: Array) -> Array:
        """The mesh of one state: all images that come near the grid."""
        values = np.concatenate([part[i].value[np.isfinite(part[i].error)] for part in self.images])
        reach = FARTHEST * self._spacing[i] * PER_DEVIATION
        low, high = edges[0] - reach, edges[-1] + reach
        values = values[(values >= low) & (values <= high)]
        first, last = (float(values.min()), float(values.max())) if len(values) else (low, low)
        count = int((last - first) / self._spacing[i]) + 2
        return np.asarray(first + self._spacing[i] * np.arange(min(count, _MOST_POINTS + 1)), dtype=float)

    def apply(self, value: Values) -> Batch:
        """A bound of sup over d of E U(f + w) on every box, the constant terms included; unknown where none is."""
        table = self.table(value)
        best: Batch | None = None
        for images in self.images:
            found = _without(self._means(images, table), self.n, upper=self.steps.upper)
            best = found if best is None else _larger(best, found, upper=self.steps.upper)
        assert best is not None
        return best

    def table(self, value: Values) -> Any:
        """What the mean after the noise is computed from."""
        self.steps.budget.fits(8 * 2 * value.size)
        return mean_table(self.axes, value.pieces(), self.steps.budget)

    def _means(self, images: list[Batch], table: Any) -> Batch:
        chunks = []
        for start in range(0, len(images[0].error), _CHUNK):
            self.steps.budget.check()
            chunks.append(self.mean([image.take(slice(start, start + _CHUNK)) for image in images], table))
        return tm.joined(chunks)

    def mean(self, images: list[Batch], table: Any) -> Batch:
        """Taylor models of h(f)."""
        which, places, shifts = self.steps.terms, [], []
        square = np.zeros(images[0].error.shape)
        for i, image in enumerate(images):
            points = self.axes[i].points
            place = np.clip(np.rint((image.value - points[0]) / self._spacing[i]), 0, len(points) - 1).astype(int)
            shift = tm.scaled(tm.sub(image, tm.fixed(which, points[place])), *self._scales[i])
            self.steps.budget.floats(40 * len(place), 20)
            places.append(place)
            shifts.append(shift)
            square = square + (np.abs(shift.value) + shift.reach()) ** 2
        index = tuple(places)
        self.steps.budget.fits(8 * len(table.derivatives) * len(square))
        self.steps.budget.floats(8 * len(table.derivatives) * len(square), len(table.derivatives))
        total = self._polynomial(shifts, {a: part[index] for a, part in table.derivatives.items()})
        missing = table.missing(np.sqrt(square) * (1 + 1e-12))
        error = total.error + (table.dominant[index] * missing + table.far) * (1 + 1e-9)
        return tm.known(Batch(which, total.coefficients, error))

    def _polynomial(self, shifts: list[Batch], parts: dict[tuple[int, ...], Array]) -> Batch:
        """sum over a of D_a v^a, by Horner's scheme in one state after the other."""
        return self._nested(shifts, parts, ())

    def _nested(self, shifts: list[Batch], parts: dict[tuple[int, ...], Array], last: tuple[int, ...]) -> Batch:
        """The part of the sum that has the powers ``last`` of the last states, without these."""
        place, orders = self.n - 1 - len(last), ORDER - sum(last)
        if place == 0:
            return _horner(self.steps.terms, shifts[0], [parts[(a, *last)] for a in range(orders)])
        total: Batch | None = None
        for b in reversed(range(orders)):
            inner = self._nested(shifts, parts, (b, *last))
            total = inner if total is None else tm.add(tm.mul(total, shifts[place]), inner)
        assert total is not None
        return total


def _horner(which: Terms, x: Batch, factors: list[Array]) -> Batch:
    total = tm.fixed(which, factors[-1])
    for factor in reversed(factors[:-1]):
        total = tm.add(tm.mul(total, x), tm.fixed(which, factor))
    return total


def _without(x: Batch, n: int, *, upper: bool) -> Batch:
    """The bound over all disturbances of a part: a polynomial in the states alone, its error in the constant."""
    which = terms(n, x.terms.degree, x.terms.budget)
    x.terms.budget.floats(2 * x.coefficients.size, len(x.terms.exponents))
    place = {a: k for k, a in enumerate(which.exponents)}
    coefficients, error = np.zeros((len(which.exponents), len(x.error))), x.error.copy()
    for exponents, row in zip(x.terms.exponents, x.coefficients):
        if any(exponents[n:]):
            error = error + np.abs(row)
        else:
            coefficients[place[exponents[:n]]] = row
    error = error * (1 + 1e-12)
    sign = 1.0 if upper else -1.0
    moved = coefficients[0] + sign * error
    coefficients[0] = np.nextafter(moved, sign * np.inf)
    return tm.known(Batch(which, coefficients, np.where(np.isfinite(error), 0.0, np.inf)))


def _larger(x: Batch, y: Batch, *, upper: bool) -> Batch:
    """At least the larger of two functions everywhere (upper), or one of them on each box (lower)."""
    good = np.isfinite(x.error) & np.isfinite(y.error)
    first = np.where(np.isfinite(x.error), x.value, -np.inf) >= np.where(np.isfinite(y.error), y.value, -np.inf)
    found, other = tm.chosen(first, x, y), tm.chosen(first, y, x)
    if not upper:
        return found
    gap = np.abs(other.coefficients[1:] - found.coefficients[1:]).sum(axis=0) + (other.value - found.value)
    coefficients = found.coefficients.copy()
    size = np.abs(found.coefficients).sum(axis=0) + np.abs(other.coefficients).sum(axis=0)
    coefficients[0] += np.maximum(gap, 0.0) + 1e-14 * size
    return tm.known(Batch(x.terms, coefficients, np.where(good, 0.0, np.inf)))


# ---- functions on grids --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Zones:
    """Which cells of a grid surely break no constraint at a step (``safe``), and which surely do throughout.

    Likewise which surely lie in the target, and which surely do not meet it; None where it does not count at the step.
    From above a path that ends where it leaves the domain does not count any more beyond it: nothing is asked of a cell
    there. From below only cells that surely lie ``within`` count.
    """

    safe: Mask
    unsafe: Mask
    done: Mask | None
    undone: Mask | None
    within: Mask


def zones(grid: Grid, model: Model, step: int, budget: Budget, *, strictly: bool = False) -> Zones:
    """What is known of every cell; ``strictly``: one that touches an obstacle is not safe."""
    budget.fits(_BOX_BYTES * len(grid.edges) * math.prod(grid.shape))
    low, high = grid.boxes()
    boxes = [[(arb(a), arb(b)) for a, b in zip(low[:, k], high[:, k])] for k in range(low.shape[1])]
    limits, domain = (model.constraints[:-1], model.constraints[-1:]) if model.ends else (model.constraints, ())
    allowed, inside = (StepSet(replace(model, constraints=part), step, budget) for part in (limits, domain))
    done: Mask | None = None
    undone: Mask | None = None
    if counts(model, step):
        target = StepSet(replace(model, constraints=(target_of(model),)), step, budget)
        done, undone = _decided(target.holds, boxes, budget), _decided(target.excludes, boxes, budget)
    budget.expect(2 * len(boxes) * allowed.work)
    safe = _decided(partial(allowed.holds, strictly=strictly), boxes, budget)
    unsafe = _decided(allowed.excludes, boxes, budget)
    return Zones(safe, unsafe, done, undone, _decided(inside.holds, boxes, budget))


def counts(model: Model, step: int) -> bool:
    """Whether being in the target counts at a step: within its window, and later where it must be stayed in."""
    if model.target is None:
        return False
    first, last = model.target.during or (0.0, math.inf)
    return first <= step and (step <= last or model.stays)


def target_of(model: Model) -> Constraint:
    """The target without its window."""
    assert model.target is not None
    return replace(model.target, during=None)


def _decided(test: Callable[[Sequence[Side]], bool], boxes: Sequence[Sequence[Side]], budget: Budget) -> Mask:
    found = np.zeros(len(boxes), dtype=bool)
    for k, box in enumerate(boxes):
        budget.box()
        found[k] = test(box)
    return found


def bounded(found: Batch, *, upper: bool) -> Array:
    """Coefficients of a step's function from what its cells lead to: 1 (upper) or 0 where nothing is known."""
    coefficients = found.coefficients.copy()
    rest = np.abs(coefficients[1:]).sum(axis=0)
    lost = ~np.isfinite(found.error) | (rest > 8)
    if upper:
        lost |= coefficients[0] - rest * (1 + 1e-9) >= 1
    return levelled(coefficients, lost, 1.0 if upper else 0.0)


def levelled(coefficients: Array, cells: Mask, level: float) -> Array:
    """The same with a constant on some cells, in place."""
    coefficients[:, cells] = 0.0
    coefficients[0, cells] = level
    return coefficients


def highest(found: Batch) -> float:
    """At least the largest value over all boxes."""
    tops = (found.coefficients[0] + np.abs(found.coefficients[1:]).sum(axis=0)) * (1 + 1e-12) + 1e-300
    return float(np.where(np.isfinite(found.error), tops, 1.0).max())


def lowest(found: Batch) -> float:
    """At most the largest of the least values over the boxes."""
    rest = np.abs(found.coefficients[1:]).sum(axis=0) * (1 + 1e-12) + 1e-300
    bottoms = found.coefficients[0] - rest - np.abs(found.coefficients[0]) * 1e-12
    return float(np.where(np.isfinite(found.error), bottoms, 0.0).max())
