"""The proof by the backward equation (Thm K10): a function v, its error included, that the process cannot increase.

The file states v in a box (`patches`). With L v = f . v_x + tr(a v_xx) / 2, a = g g^T, and ``end`` = 1 from above, 0
from below, proved is

- v_t + L v <= eta_k in slab k wherever v < end;
- v >= goal - gamma on every face of the box by which a path may leave: from above goal = 1, from below -1 where all of
  the face breaks a constraint, else 0. By a face that noise does not cross a path leaves only where the drift points
  outward or along it;
- v >= -gamma at the horizon;
- from above: the box lies in the safe set, and the starts in the box; from below: a stated start lies in both sets.

Then, P being the probability of failing (theory.md, section 15),

    P <= v(0, x) + gamma + sum_k eta_k h_k     (above),     P >= -v(0, x) - gamma - sum_k eta_k h_k     (below).

On a patch v_t + L v is a cubic in time whose Bernstein coefficients are v_t's and L b_j. Of f and a Taylor models
about the patch's middle are made; their polynomials times those of v's derivatives are polynomials of degree 5 + d in
every xi, which lie below the largest of their Bernstein coefficients. What the models miss is paid by the size of the
derivatives. Where that does not show what the file states as ``eta``, the patch is cut; eta is what is found at last.

Roundings. An entry of the derivative of orders alpha of b_j, by powers of xi, is off by at most `patches.ROUNDED`
times the size times prod_i (2 / h_i)^alpha_i binomial (5, k_i) k_i!/(k_i - alpha_i)!, whose sums over k are ``_SUMS``.
The sum of all products, and the matrices to Bernstein's form, whose entries are at most 1, add a rounding for each
term of a sum.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from flint import arb

from certbound.checker.reading import Record
from certbound.checker.report import Budget, Unproved
from certbound.checker.statement import Model, SafeSet, starts_of
from certbound.checker.values import batches as tm
from certbound.checker.values.batch_tapes import run
from certbound.checker.values.batches import Array, Batch, Index, Mask, above, below, bernstein, terms
from certbound.checker.values.kolmogorov.patches import DEGREE, ROUNDED, Patches, Splines, along, read_splines
from certbound.problem.model import Tape

Orders = tuple[int, ...]
Generator = list[tuple[Orders, float, Batch]]

_TAYLOR = {2: 5, 3: 4}
"""Degree of the Taylor models by the number of states."""
_DEEPEST = 3
"""How often a patch is halved along every axis."""
_SUMS = (32.0, 80.0, 160.0)
"""Sums over k of binomial (5, k) k!/(k - order)!."""
_UNIT = 2.0**-52
_UP = 1 + 2.0**-40
_CHUNK = 512
"""Patches that are looked at together: their arrays stay in the cache."""
_TOGETHER = 4096
"""Patches for whose cells Taylor models are made together."""


def check_backward(model: Model, value: object, budget: Budget) -> arb:
    """Upper bound of the probability that a constraint is broken."""
    with np.errstate(all="ignore"):  # what is no number is unknown
        return Solution(model, value, budget, upper=True).bound()


def check_backward_below(model: Model, value: object, budget: Budget) -> arb:
    """Lower bound of the probability that a constraint is broken, from one of the stated starts."""
    if model.initial.around:
        raise Unproved("the initial set is stated by a box around it, of which lower bounds say nothing")
    with np.errstate(all="ignore"):
        return Solution(model, value, budget, upper=False).bound()


class Solution:
    """The proof's numbers, and what follows from them."""

    def __init__(self, model: Model, value: object, budget: Budget, *, upper: bool) -> None:
        names = ["engine", "axes", "times", "units", "values", "rates", "eta"]
        self.record = Record(value, "proof", [*names, *([] if upper else ["side", "starts"])])
        self.model, self.budget, self.above, self.n = model, budget, upper, model.dimension
        self._refuse()
        self.splines = read_splines(self.record, self.n, model.horizon, budget)
        self.stated = np.array(self.record.array("eta", self.splines.slabs))
        self.end = 1.0 if upper else 0.0
        self.sides = [(arb(float(axis[0])), arb(float(axis[-1]))) for axis in self.splines.axes]
        self.noisy = [self._is_noisy(i) for i in range(self.n)]

    def _refuse(self) -> None:
        """What this proof does not treat."""
        model, given = self.model, self.model.noise.diffusion
        tapes = [model.dynamics, *([given] if isinstance(given, Tape) else [])]
        if not model.continuous or self.n not in _TAYLOR:
            raise Unproved("this proof treats two and three states in continuous time")
        if model.target is not None or model.ends or model.hold is not None or model.plan is not None:
            raise Unproved("this proof treats no target, no plan with steps in time, and no path that ends unharmed")
        if model.disturbance or model.initial.covariance is not None:
            raise Unproved("this proof treats no disturbance and no random start")
        if any(node.op == "input" and node.args[0] == 0 for tape in tapes for node in tape.nodes):
            raise Unproved("this proof does not treat a model that changes with time")

    def bound(self) -> arb:
        """At least the probability of failing from any start, or (lower) at most that from one of the stated ones."""
        patches = self.splines.slabs * math.prod(self.splines.cells)
        self.budget.expect(patches * self._work() + self._work_of_models())
        limits = self._limits()
        start = self._at_starts()
        gamma = max([0.0, -self._at_end(), *(self._lacking(limits, *face) for face in self._faces())])
        if not math.isfinite(gamma):
            raise Unproved("v was not shown to be what the faces of the grid ask for")
        total = arb(start) + arb(gamma)
        times = [arb(float(t)) for t in self.splines.times]
        for eta, first, last in zip(self._payments(), times, times[1:]):
            total += arb(float(eta)) * (last - first)
        found = total if self.above else -total
        return arb.max(arb.min(found, arb(1)), arb(0)).upper() if self.above else arb.max(found, arb(0)).lower()

    # ---- the box, the faces, the end, the starts ------------------------------------------------------------------

    def _limits(self) -> SafeSet:
        """The safe set, which from above holds the box, and the starts touch no obstacle."""
        model = self.model
        always = [c.during is not None and c.during[0] <= 0 and c.during[1] >= model.horizon for c in model.constraints]
        asked = (replace(c, during=None) if all_ else c for c, all_ in zip(model.constraints, always))
        limits = SafeSet(replace(model, constraints=tuple(asked)), bounded=False)
        if self.above and not limits.holds(*_about(self.sides)):
            raise Unproved("the grid was not shown to lie in the safe set")
        starts = list(zip(model.initial.low, model.initial.high))
        if self.above and not limits.holds(*_about(starts), strictly=True):
            raise Unproved("the initial set was not shown to lie in the safe set")
        return limits

    def _is_noisy(self, i: int) -> bool:
        """Whether noise may move a state."""
        given = self.model.noise.diffusion
        if isinstance(given, Tape):
            columns = given.shape[1]
            rows = [given.nodes[place] for place in given.outputs[i * columns : (i + 1) * columns]]
            return not all(node.op == "const" and node.value == 0 for node in rows)
        return not all(given[i, k].is_zero() for k in range(given.ncols()))

    def _faces(self) -> list[tuple[int, int]]:
        return list(itertools.product(range(self.n), (0, 1)))

    def _lacking(self, limits: SafeSet, axis: int, side: int) -> float:
        """What v lacks of its goal where paths may leave by a face."""
        face = [(ends[side], ends[side]) if k == axis else ends for k, ends in enumerate(self.sides)]
        goal = 1.0 if self.above else -1.0 if limits.excludes(*_about(face)) else 0.0
        function = self.splines.face(axis, side)
        leaves = np.flatnonzero(self._leaving(axis, side).ravel())
        least = np.inf
        self.budget.expect(function.slabs * len(leaves) * 4 * (DEGREE + 1) ** (self.n - 1))
        for first in range(0, function.slabs * len(leaves), _TOGETHER):
            number = np.arange(first, min(first + _TOGETHER, function.slabs * len(leaves)))
            places = np.unravel_index(leaves[number % len(leaves)], function.cells)
            found = function.patches(number // len(leaves), places, 0).lowest()
            least = min(least, _least(found))
        return float(np.nextafter(goal - least, np.inf))

    def _leaving(self, axis: int, side: int) -> Mask:
        """The cells of a face by which a path may leave."""
        others = [row for k, row in enumerate(self.splines.axes) if k != axis]
        shape = tuple(len(row) - 1 for row in others)
        if self.noisy[axis]:
            return np.ones(shape, dtype=bool)
        place = float(self.splines.axes[axis][-side])
        inward = float(np.nextafter(place, np.inf if side == 0 else -np.inf))  # the drift may jump on the face
        which, found = terms(self.n, _TAYLOR[self.n], self.budget), []
        for first in range(0, math.prod(shape), _TOGETHER):
            number = np.arange(first, min(first + _TOGETHER, math.prod(shape)))
            places = iter(np.unravel_index(number, shape))
            ends = [(np.full(len(number), min(place, inward)), np.full(len(number), max(place, inward))) if k == axis
                    else _ends(row, next(places)) for k, row in enumerate(self.splines.axes)]  # fmt: skip
            inputs = [tm.variable(which, k, *row) for k, row in enumerate(ends)]
            low, high = self._drift(inputs)[axis].ends()
            found.append(~(low > 0) if side == 0 else ~(high < 0))
        return np.concatenate(found).reshape(shape)

    def _at_end(self) -> float:
        """At most v at the horizon."""
        splines, least = self.splines, np.inf
        still = Splines(axes=splines.axes, times=np.array([0.0, 1.0]), values=splines.values[[-1, -1]],
                        rates=np.zeros_like(splines.rates[:2]), budget=self.budget)  # fmt: skip
        for first in range(0, math.prod(splines.cells), _TOGETHER):
            number = np.arange(first, min(first + _TOGETHER, math.prod(splines.cells)))
            found = still.patches(0 * number, np.unravel_index(number, splines.cells), 0).lowest()
            least = min(least, _least(found))
        return least

    def _at_starts(self) -> float:
        """At least v(0, .) on the initial set, or (lower) at the best of the stated starts."""
        if self.above:
            initial = self.model.initial
            return self._most_over(list(zip(initial.low, initial.high)))
        return min(self._most_over([(x, x) for x in point]) for point in starts_of(self.model, self.record))

    def _most_over(self, box: Sequence[tuple[arb, arb]]) -> float:
        """At least v(0, .) on a box of starts."""
        if not all(low >= a and high <= b for (a, b), (low, high) in zip(self.sides, box)):
            raise Unproved("a start was not shown to lie in the grid")
        self.budget.floats(4 * sum(map(len, self.splines.axes)), 8)
        ends = [(below(low), above(high)) for low, high in box]
        met = [np.flatnonzero((axis[:-1] <= b) & (axis[1:] >= a)) for axis, (a, b) in zip(self.splines.axes, ends)]
        count, most = math.prod(map(len, met)), -np.inf
        for first in range(0, count, _TOGETHER):
            number = np.unravel_index(np.arange(first, min(first + _TOGETHER, count)), tuple(map(len, met)))
            places = [rows[part] for rows, part in zip(met, number)]
            found = self._most_of(places, ends)
            most = max(most, float(np.where(np.isnan(found), np.inf, found).max()))
        return float(np.nextafter(most, np.inf))

    def _most_of(self, places: Sequence[Index], ends: Sequence[tuple[float, float]]) -> Array:
        """At least v(0, .) on the part of each cell between the ends, by its polynomial in xi there."""
        patches = self.splines.patches(0 * places[0], places, 0)
        table, letters = patches.powers()[0], "xyz"[: self.n]
        self.budget.floats(20 * table.size * self.n, 200)
        for axis, (place, (a, b)) in enumerate(zip(places, ends)):
            row = self.splines.axes[axis]
            width = row[place + 1] - row[place]
            low, high = (np.clip(2 * (end - row[place]) / width - 1, -1, 1) for end in (a, b))
            middle, half = (low + high) / 2, (high - low) / 2 + 2.0**-48  # a dozen roundings of numbers up to 2
            shifted = np.zeros((DEGREE + 1, DEGREE + 1, len(place)))
            for k, j in itertools.combinations_with_replacement(range(DEGREE + 1), 2):
                shifted[k, j] = math.comb(j, k) * middle ** (j - k) * half**k
            matrix = np.einsum("ik,kjp->ijp", bernstein(DEGREE), shifted)
            out = letters.replace(letters[axis], "j")
            table = np.einsum(f"j{letters[axis]}p,{letters}p->{out}p", matrix, table)
        slack = 8 * ROUNDED * _SUMS[0] ** self.n * patches.size + _UNIT * np.abs(patches.constants[0])
        return np.asarray(table.max(axis=tuple(range(self.n))) + patches.constants[0] + slack * _UP)

    # ---- the residual ---------------------------------------------------------------------------------------------

    def _payments(self) -> Array:
        """eta of every slab: what its patches need, which the file says about."""
        splines, n = self.splines, self.n
        eta, count = np.zeros(splines.slabs), splines.slabs * math.prod(splines.cells)
        self.budget.fits(8 * 4 * (n + 2) * count)
        *places, slab = np.unravel_index(np.arange(count), (*splines.cells, splines.slabs))
        for level in range(_DEEPEST + 1):
            need = self._needs(slab, places, level)
            settled = (need <= self.stated[slab]) | (level == _DEEPEST)
            np.maximum.at(eta, slab[settled], need[settled])
            slab, *places = (part[~settled] for part in (slab, *places))
            if not len(slab):
                break
            many = 2**n
            self.budget.fits(8 * 4 * (n + 2) * many * len(slab))
            self.budget.expect(many * len(slab) * self._work())
            slab = np.repeat(slab, many)
            for axis, part in enumerate(itertools.zip_longest(*itertools.product((0, 1), repeat=n))):
                places[axis] = np.repeat(2 * places[axis], many) + np.tile(part, len(slab) // many)
        if not np.isfinite(eta).all():
            raise Unproved("the dynamics was not shown to be defined where v is asked for")
        return eta

    def _work(self) -> int:
        """Numbers that one patch takes at least."""
        return int(4 * (DEGREE + 1) ** self.n * (6 + 7 * self.n))

    def _work_of_models(self) -> int:
        """Numbers that the model takes on every cell at least, an array for each operation and three for a product."""
        given, cells = self.model.noise.diffusion, math.prod(self.splines.cells)
        columns = given.shape[1] if isinstance(given, Tape) else given.ncols()
        nodes = [*self.model.dynamics.nodes, *(given.nodes if isinstance(given, Tape) else ())]
        operations = sum(node.op != "input" for node in nodes) + 3 * self.n * self.n * columns
        return terms(self.n, _TAYLOR[self.n], self.budget).numbers(cells) * operations

    def _needs(self, slab: Index, places: Sequence[Index], level: int) -> Array:
        """What every patch needs as eta; 0 where v is beyond its end."""
        need, shape = np.zeros(len(slab)), tuple(count * 2**level for count in self.splines.cells)
        for first in range(0, len(slab), _TOGETHER):
            rows = slice(first, first + _TOGETHER)
            own, here = slab[rows], [place[rows] for place in places]
            self.budget.floats(200 * len(own), 40)
            cells, which = np.unique(np.ravel_multi_index(here, shape), return_inverse=True)
            models = self._models(np.unravel_index(cells, shape), level)
            for start in range(0, len(own), _CHUNK):
                part = slice(start, start + _CHUNK)
                patches = self.splines.patches(own[part], [place[part] for place in here], level)
                due = np.flatnonzero(~(patches.lowest() >= self.end))
                if len(due):
                    need[first + start + due] = self._need(patches.take(due), models, which[part][due])
        return need

    def _models(self, places: Sequence[Index], level: int) -> Generator:
        """The coefficients of L on some parts of cells: orders of a derivative, a factor, a Taylor model."""
        which, inputs = terms(self.n, _TAYLOR[self.n], self.budget), []
        for k, (axis, place) in enumerate(zip(self.splines.axes, places)):
            inputs.append(_part(tm.variable(which, k, *_ends(axis, place >> level)), k, place, level))
        found: Generator = []
        for i, rate in enumerate(self._drift(inputs)):
            found.append((_order(self.n, i), 1.0, rate))
        squares = self._squares(inputs)
        for i, j in itertools.combinations_with_replacement(range(self.n), 2):
            found.append((_order(self.n, i, j), 0.5 if i == j else 1.0, squares[i][j]))
        return [one for one in found if one[2].coefficients.any() or one[2].error.any()]

    def _need(self, patches: Patches, models: Generator, which: Index) -> Array:
        """At least v_t + L v on every patch."""
        n, degree, count = self.n, _TAYLOR[self.n], len(which)
        deep = DEGREE + 1 + degree
        monomials = sum(int(np.any(model.coefficients, axis=1).sum()) for *_, model in models)
        self.budget.fits(8 * count * (3 * 4 * deep**n + 6 * 4 * (DEGREE + 1) ** n))
        self.budget.floats(
            count * 4 * ((DEGREE + 1) ** n * (3 * monomials + 8 * len(models) + 12) + n * deep ** (n + 1) // 2),
            6 * monomials + 20 * len(models) + 40,
        )
        powers = patches.powers()
        total = np.zeros((4, *[deep] * n, count))
        inner: tuple[slice, ...] = (slice(None), *[slice(0, DEGREE + 1)] * n)
        total[inner] = _risen(np.diff(powers, axis=0) * (3 / patches.step))
        total.reshape(4, -1, count)[:, 0] += patches.speeds
        rounded, missed = 12 / patches.step * _SUMS[0] ** n, patches.off.copy()
        sums = deep * n * 8 + 400 + monomials
        for orders, weight, model in models:
            slope = _derivative(powers, orders)
            scale = np.full(count, weight)
            for half, order in zip(patches.half, orders):
                scale = scale / half**order
            slope = slope * scale
            own = model.coefficients[:, which]
            for exponents, row in zip(model.terms.exponents, own):
                if row.any():
                    place = tuple(slice(e, e + size) for e, size in zip(exponents, slope.shape[1:-1]))
                    total[(slice(None), *place)] += row * slope
            size = scale * math.prod(_SUMS[order] for order in orders) * patches.size
            largest = np.abs(slope).sum(axis=tuple(range(1, n + 1))).max(axis=0) + ROUNDED * size
            missed = missed + model.error[which] * largest
            rounded = rounded + np.abs(own).sum(axis=0) * scale * math.prod(_SUMS[order] for order in orders)
        matrix = bernstein(deep - 1)
        for axis in range(n):
            total = along(matrix, total, axis + 1)
        high = total.reshape(-1, count).max(axis=0)
        found = high + (missed + rounded * patches.size * (2 * ROUNDED + sums * _UNIT)
                        + sums * _UNIT * np.abs(patches.speeds).max(axis=0)) * _UP  # fmt: skip
        found = found + np.abs(found) * _UNIT
        return np.where(np.isfinite(found), np.maximum(found, 0.0), np.inf)

    def _drift(self, inputs: Sequence[Batch]) -> list[Batch]:
        """f; time is not among its inputs."""
        return run(self.model.dynamics, [self._time(inputs), *inputs])

    def _time(self, inputs: Sequence[Batch]) -> Batch:
        return tm.fixed(inputs[0].terms, np.zeros(inputs[0].error.shape))

    def _squares(self, inputs: Sequence[Batch]) -> list[list[Batch]]:
        """g g^T."""
        given, n = self.model.noise.diffusion, self.n
        columns = given.shape[1] if isinstance(given, Tape) else given.ncols()
        self.budget.fits(8 * (n * columns + 2 * n * n) * inputs[0].coefficients.size)
        if isinstance(given, Tape):
            entries = run(given, [self._time(inputs), *inputs])
        else:
            entries = [tm.fixed(inputs[0].terms, np.full(inputs[0].error.shape, float(x))) for x in given.entries()]
        rows = [entries[i * columns : (i + 1) * columns] for i in range(n)]
        return [[_summed([tm.mul(x, y) for x, y in zip(one, two)]) for two in rows] for one in rows]


def _about(sides: Sequence[tuple[arb, arb]]) -> tuple[list[arb], list[arb]]:
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


def _least(values: Array) -> float:
    """The least of some numbers; minus infinity where one is none."""
    return float(np.where(np.isnan(values), -np.inf, values).min())


def _summed(parts: Sequence[Batch]) -> Batch:
    total = parts[0]
    for part in parts[1:]:
        total = tm.add(total, part)
    return total


def _risen(slopes: Array) -> Array:
    """A quadratic in Bernstein's form as a cubic."""
    first, middle, last = slopes
    return np.stack([first, (first + 2 * middle) / 3, (2 * middle + last) / 3, last])


def _derivative(powers: Array, orders: Orders) -> Array:
    """Coefficients of a derivative by xi."""
    for axis, order in enumerate(orders, 1):
        for _ in range(order):
            count = powers.shape[axis]
            shape = [-1 if k == axis else 1 for k in range(powers.ndim)]
            powers = np.take(powers, range(1, count), axis=axis) * np.arange(1, count).reshape(shape)
    return powers
