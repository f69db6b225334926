"""Continuous time: V of the file is proved to be, but for what is paid, above log of the probability of leaving.

On a box of states in the safe set, with R = V_t + sup_d f . V_x + tr(a V_xx)/2 + Q2, Q2 = V_x . a V_x/2, a = g g^T:

- V >= 0 on the sides of the box at all times (what it lacks is added to V everywhere);
- R <= lam_k + eps_k exp(v0 - V) + m(V) Q2 wherever V < 0 in slab k, v0 being at least V(0, .) on the initial set;
- m is a step function of the level, q is continuous and linear on every step, q = 0 below the lowest one, 0 <= q < 1,
  and q' >= (1 - q)(m - q).

Then w = exp(theta(V)), theta(V) = V + int_V^0 q, has w_t + L w <= lam_k w + eps_k exp(v0 + Q), Q = int q over all
levels, since theta' = 1 - q is in (0, 1], theta'' + theta'^2 - theta' <= -m theta' and theta(V) - V <= Q. With L_k the
integral of lam over slab k and all later ones,

    P + (1 - P) exp(inf V(T, .)) <= exp(L_0 + theta(v0)) + exp(v0 + Q) sum_k eps_k h_k exp(L_k)

for the probability P of leaving within T: at T the process is at least 1 on paths that left, exp(V(T, .)) on others.

m, q and eps are stated in the file. lam is what the patches of each slab then need; the lam of the file only says where
a closer look is worth its time.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from flint import arb

from certbound.checker.balls import tail
from certbound.checker.reading import Record, numbers, unpacked
from certbound.checker.report import FUNCTION, Budget, Unproved
from certbound.checker.statement import Model, SafeSet
from certbound.checker.values import batches as tm
from certbound.checker.values.batch_tapes import run
from certbound.checker.values.batches import Array, Batch, Index, Mask, Terms, above, below, terms
from certbound.checker.values.hermite import Levels, Patches, Surface
from certbound.checker.values.step_back import independent
from certbound.errors import CertificateError
from certbound.problem.model import Tape

MOST_PATCHES = 400_000
MOST_LEVELS = 200
MOST_PARTS = 20_000
_FAR = 40.0
"""Standard deviations of a random start beyond the grid that are looked at from below."""
_DEGREES = {1: (6, 8), 2: (6, 8, 10, 12)}
"""Of the Taylor models by the number of states: higher ones where lower ones do not show what the file states."""
_CUT = {1: ((8, 2),), 2: ((8, 2), (12, 2))}
"""Degrees on so many parts of a patch along every axis, where no degree served on all of it."""
_LEAST = 2.0**-20  # V is at least so far below 0 where paths end that have not left, so that exp(V) is not 1
_ENTRIES = 4_000_000
_CHUNK = 4096
"""Parts of cells that are looked at together."""


class Passage:
    """The proof's numbers, and what follows from them for the upper bound."""

    upper_side = True

    def __init__(self, model: Model, value: object, budget: Budget) -> None:
        self.random = model.initial.covariance is not None
        names = ["engine", "axes", "times", "values", "rates", "edges", "m", "q", "lam", "eps"]
        names += ["pieces"] if self.random else []
        record = self.record = Record(value, "proof", [*names, *self._named()])
        self.model, self.budget, n = model, budget, model.dimension
        if n not in _DEGREES:
            raise Unproved(f"value functions are proved for at most {max(_DEGREES)} states")
        if model.plan is not None:
            raise Unproved("this proof does not treat a plan with steps in time")
        if self.random and n > 1:
            raise Unproved("value functions are proved for random starts in one state only")
        self.surface = self._read(record)
        edges, m, q = (record.array(name, None) for name in ("edges", "m", "q"))
        self.levels = Levels(edges, m, q, self.upper_side)
        slabs = len(self.surface.times) - 1
        self.stated, self.eps = np.array(record.array("lam", slabs)), np.array(record.array("eps", slabs))
        if len(self.levels.m) > MOST_LEVELS or not (self.eps >= 0).all():
            raise CertificateError(f"`proof.eps` must not be negative, nor `proof.m` have over {MOST_LEVELS} entries.")
        self.pieces = record.whole("pieces", 1, MOST_PARTS) if self.random else 1
        if self.random and self.pieces * self.surface.cells[0] > MOST_PARTS:
            raise CertificateError(f"`proof.pieces` must cut the cells into at most {MOST_PARTS} parts.")
        self.degrees = _DEGREES[n]
        self.lift = 0.0
        self.due: Mask | None = None

    def _named(self) -> list[str]:
        """What else the file states."""
        return [] if self.upper_side else ["side"] if self.random else ["side", "starts"]

    def _first(self) -> float:
        """When it begins."""
        return 0.0

    def _last(self) -> float:
        """When it is over."""
        return self.model.horizon

    def _read(self, record: Record) -> Surface:
        n = self.model.dimension
        axes = [np.array(numbers(row, "proof.axes", None)) for row in record.items("axes", n, n)]
        times = np.array(record.array("times", None))
        for name, row in [("times", times), *(("axes", axis) for axis in axes)]:
            if len(row) < 2 or not (np.diff(row) > 0).all():
                raise CertificateError(f"`proof.{name}` must be two or more numbers that rise.")
        if times[0] != self._first() or times[-1] != self._last():
            raise Unproved("the slabs of time do not cover the horizon")
        if (len(times) - 1) * math.prod(len(axis) - 1 for axis in axes) > MOST_PATCHES:
            raise CertificateError(f"`proof.axes` and `proof.times` must make at most {MOST_PATCHES} patches.")
        shape = (len(times), *(size for axis in axes for size in (len(axis), 3)))
        found = (unpacked(record[name], record.at(name), math.prod(shape), self.budget) for name in ("values", "rates"))
        values, rates = (np.frombuffer(part).reshape(shape) for part in found)
        return Surface(times, tuple(axes), values, rates, self.budget)

    def upper(self) -> arb:
        """At least the probability of leaving."""
        self._check_box()
        self.lift = self._missing()
        return self.followed([self])

    def followed(self, stages: Sequence[Passage]) -> arb:
        """The same over stages that follow each other, this one being the first; all are lifted."""
        start = self._middle() if self.random else self._at_start()
        if not start < 0:
            return arb(1)
        total, later, v0 = arb(0), arb(0), arb(start)
        for lam, eps in reversed([paid for stage in stages for paid in stage.paid(start)]):
            later += lam
            total += eps * later.exp()
        most = self.levels.above(arb(self.levels.edges[0]))
        if self.random:
            found = self._mean(lambda _, high: arb.min((later + most + arb(high)).exp(), arb(1)), lambda *_: True)
        else:
            found = (later + v0 + self.levels.above(v0)).exp()
        found += (v0 + most).exp() * total
        least = min([stages[-1]._at_end(), *(stage._where_spared() for stage in stages)])
        floor = arb.min(arb(least), arb(-_LEAST)).exp()
        return arb.min((found - floor) / (1 - floor), arb(1)).upper()

    def paid(self, start: float) -> list[tuple[arb, arb]]:
        """lam and eps of every slab, times its length."""
        times = [arb(float(t)) for t in self.surface.times]
        return [
            (arb(float(lam)) * (b - a), arb(float(eps)) * (b - a))
            for lam, eps, (a, b) in zip(self._payments(start), self.eps, pairwise(times))
        ]

    def _check_box(self) -> None:
        """The box of the grid lies in the safe set, and the starts in it."""
        sides = [(arb(float(axis[0])), arb(float(axis[-1]))) for axis in self.surface.axes]
        centre, radius = [(a + b) / 2 for a, b in sides], [(b - a) / 2 for a, b in sides]
        if not self.limits().holds(centre, radius):
            raise Unproved("the grid was not shown to lie in the safe set")
        initial = self.model.initial
        if self._first() == 0 and not self.random and not all(
            low >= a and high <= b for (a, b), low, high in zip(sides, initial.low, initial.high)
        ):
            raise Unproved("the initial set was not shown to lie in the grid")

    def limits(self) -> SafeSet:
        """The constraints that a path may break: without the domain where a path ends as it leaves that."""
        model = self.model
        return SafeSet(replace(model, constraints=model.constraints[:-1]) if model.ends else model, bounded=False)

    def _spared(self) -> list[tuple[int, int]]:
        """(state, end) of the sides by which a path ends that does not fail: where it has left the domain before."""
        if not self.model.ends:
            return []
        return self.excluded(SafeSet(replace(self.model, constraints=self.model.constraints[-1:]), bounded=False))

    def excluded(self, region: SafeSet) -> list[tuple[int, int]]:
        """(state, end) of the sides of the grid that lie outside of a region."""
        sides = [(arb(float(axis[0])), arb(float(axis[-1]))) for axis in self.surface.axes]
        found = []
        for number, end in itertools.product(range(len(sides)), (0, 1)):
            face = [(side[end], side[end]) if k == number else side for k, side in enumerate(sides)]
            if region.excludes([(a + b) / 2 for a, b in face], [(b - a) / 2 for a, b in face]):
                found.append((number, end))
        return found

    def _missing(self) -> float:
        """What V lacks of 0 on the sides by which paths fail: V plus that has the same residual."""
        spared = self._spared()
        sides = [side for side in itertools.product(range(self.model.dimension), (0, 1)) if side not in spared]
        return -min([0.0, *(float(self.across(axis, -end)[0].min()) for axis, end in sides)])

    def across(self, axis: int, node: int) -> tuple[Array, Array]:
        """Ends of V, before it is lifted, where a state is at a node: over all patches, time slowest."""
        n, face = self.model.dimension, self.surface.across(axis, node)
        which, found = terms(n, 3 + 5 * (n - 1), self.budget), []
        for block in face.blocks():
            found.append(face.patches(*block).derivative(which, (0,) * n).sharp_ends())
        low, high = (np.concatenate(parts) for parts in zip(*found))
        return np.where(np.isnan(low), -np.inf, low), np.where(np.isnan(high), np.inf, high)

    def _at_start(self) -> float:
        """At least V(0, .) on the initial set."""
        initial = self.model.initial
        _, high = self._over([below(x) for x in initial.low], [above(x) for x in initial.high])
        return float(np.nextafter(high.max() + self.lift, np.inf))

    def _over(self, low: Sequence[float], high: Sequence[float]) -> tuple[Array, Array]:
        """Ends of V(0, .) on the parts of a box that meet the patches, before V is lifted."""
        n, ends = self.model.dimension, []
        met = [np.flatnonzero((axis[:-1] <= b) & (axis[1:] >= a)) for axis, a, b in zip(self.surface.axes, low, high)]
        if not all(map(len, met)):
            raise Unproved("a start was not shown to lie in the grid")
        places = [part.ravel() for part in np.meshgrid(*met, indexing="ij")]
        for first in range(0, len(places[0]), _CHUNK):
            found = self.surface.chosen(0, [part[first : first + _CHUNK] for part in places])
            rows = [np.full(found.low.shape[1], value) for value in (*low, *high)]
            ends.append(self._parts(found, rows[:n], rows[n:]))
        return np.concatenate([end[0] for end in ends]), np.concatenate([end[1] for end in ends])

    def _parts(self, patches: Patches, low: Sequence[Array], high: Sequence[Array]) -> tuple[Array, Array]:
        """Ends of V on the part of every patch of a frozen surface that lies between ``low`` and ``high``."""
        return self.part_of(patches, low, high).sharp_ends()

    def part_of(self, patches: Patches, low: Sequence[Array], high: Sequence[Array]) -> Batch:
        """V on these parts, before it is lifted."""
        n = self.model.dimension
        whole = patches.derivative(terms(n + 1, 5 * n, self.budget), (0,) * (n + 1))
        parts = [self._part(patches, i, low[i], high[i], whole.terms) for i in range(n)]
        return _substituted(whole, parts)

    def _law(self) -> tuple[Array, Array, Array]:
        """Edges of the parts of the cells of one state, and ends of V(0, .) on each, V being lifted."""
        patches = self.surface.chosen(0, [np.arange(self.surface.cells[0])])
        a, b = patches.low[1], patches.high[1]
        rows = np.stack([a, *(a + (b - a) * (k / self.pieces) for k in range(1, self.pieces)), b])
        if not (np.diff(rows, axis=0) > 0).all():
            raise Unproved("the parts of the cells are too small")
        ends = [self._parts(patches, [low], [high]) for low, high in pairwise(rows)]
        low, high = (np.stack([end[side] for end in ends]).T.ravel() for side in (0, 1))
        edges = np.append(rows[:-1].T.ravel(), b[-1])
        return edges, np.nextafter(low + self.lift, -np.inf), np.nextafter(high + self.lift, np.inf)

    def _middle(self) -> float:
        """About the logarithm of the mean of exp(V(0, .)) over a random start: any number would do."""
        found = self._mean(lambda _, high: arb(min(high, 0.0)).exp(), lambda *_: self.upper_side)
        return float(found.log().mid()) if found > 0 else -1e3

    def _mean(self, weigh: Callable[[float, float], arb], beyond: Callable[[float, float], bool]) -> arb:
        """The mean of a function of V's ends over a random start; what lies beyond the grid counts 1 where asked."""
        centre, covariance = arb(self.model.initial.centre[0]), self.model.initial.covariance
        assert covariance is not None
        (spread,) = independent(covariance, "the start")
        edges, low, high = self._law()
        self.budget.balls(len(edges), 3 * FUNCTION)
        scale = spread * arb(2).sqrt()
        tails = [((arb(float(x)) - centre) / scale).erfc() / 2 for x in edges]
        total, far = arb(0), _FAR * float(spread.mid())
        for k, (a, b) in enumerate(zip(low, high)):
            total += arb.max(tails[k] - tails[k + 1], arb(0)) * weigh(float(a), float(b))
        for end, mass, sign in ((edges[0], 1 - tails[0], -1), (edges[-1], tails[-1], 1)):
            place = float(end) + sign * far
            if beyond(float(end), place):
                reach = tail((arb(place) - centre) * sign / spread)
                total += mass if self.upper_side else arb.max(mass - reach, arb(0))
        return total

    def _at_end(self) -> float:
        """At most V at the horizon."""
        return float(np.nextafter(self.last_ends()[0].min() + self.lift, -np.inf))

    def last_ends(self) -> tuple[Array, Array]:
        """Ends of V, before it is lifted, on all cells at the end, in their shape."""
        n, last = self.model.dimension, self.surface.frozen(-1)
        which, low, high = terms(n + 1, 5 + 3 * (n - 1), self.budget), np.empty(last.cells), np.empty(last.cells)
        for first, end, cells in last.blocks():
            found = last.patches(first, end, cells).derivative(which, (0,) * (n + 1)).sharp_ends()
            low[cells], high[cells] = (part.reshape(low[cells].shape) for part in found)
        return low, high

    def _where_spared(self) -> float:
        """At most V on the sides by which a path ends that does not fail, in whatever stage it does."""
        least = min((float(self.across(axis, -end)[0].min()) for axis, end in self._spared()), default=np.inf)
        return float(np.nextafter(least + self.lift, -np.inf))

    def _part(self, patches: Patches, i: int, low: Array, high: Array, which: Terms) -> Batch:
        """xi of a state on the part of every patch between ``low`` and ``high``."""
        a, b = patches.low[1 + i], patches.high[1 + i]
        x = tm.variable(which, 1 + i, np.maximum(a, low), np.minimum(b, high))
        middle = tm.fixed(which, a / 2 + b / 2, (np.abs(a) + np.abs(b)) * 2.0**-51)
        return tm.scaled(tm.sub(x, middle), 2 / (b - a), 4 / (b - a) * 2.0**-52)

    # ---- the residual ----------------------------------------------------------------------------------------

    def _payments(self, start: float) -> Array:
        """lam of every slab: what its patches need, which the file says about."""
        lam = np.zeros(len(self.eps))
        for first, last, cells in self.surface.blocks():
            patches = self.surface.patches(first, last, cells)
            slab = first + np.arange(patches.low.shape[1]) * (last - first) // patches.low.shape[1]
            if self.due is not None:  # nothing is asked where paths are over
                here = np.flatnonzero(np.tile(self.due[cells].ravel(), last - first))
                patches, slab = patches.take(here), slab[here]
            for degree, parts in (looks := [*((degree, 1) for degree in self.degrees), *_CUT[self.model.dimension]]):
                needs = [self._needs(part, slab, start, degree) for part in patches.cut(parts)]
                need = np.max(needs, axis=0)
                settled = (need <= self.stated[slab]) | ((degree, parts) == looks[-1])
                np.maximum.at(lam, slab[settled], need[settled])
                rest = np.flatnonzero(~settled)
                patches, slab = patches.take(rest), slab[rest]
        if not np.isfinite(lam).all():
            raise Unproved("the dynamics was not shown to be defined where V is negative")
        return lam

    def _needs(self, patches: Patches, slab: Index, start: float, degree: int) -> Array:
        """What every patch needs as lam, from Taylor models of some degree."""
        which = terms(self._variables(), degree, self.budget)
        need, size = np.zeros(len(slab)), max(32, _ENTRIES // (degree + 1) ** which.variables)
        for first in range(0, len(slab), size):
            self.budget.check()
            part = slice(first, first + size)
            need[part] = self._need(patches.take(part), self.eps[slab[part]], start, which)
        return need

    def _variables(self) -> int:
        """Of the Taylor models: time, the states and the disturbances."""
        return 1 + self.model.dimension + len(self.model.disturbance)

    def _need(self, patches: Patches, eps: Array, start: float, which: Terms) -> Array:
        low, high = patches.derivative(which, (0,) * (self.model.dimension + 1)).sharp_ends()
        low, high = np.nextafter(low + self.lift, -np.inf), np.nextafter(high + self.lift, np.inf)
        need, due = np.zeros(len(eps)), np.flatnonzero(~(low >= 0))
        if len(due):
            low, high = low[due], high[due]
            excess = self._residual(patches.take(due), self.levels.least(low, high), which).sharp_ends()[1]
            self.budget.balls(len(due), FUNCTION)
            reach = np.array([below(arb(x).exp()) for x in np.minimum(start - high, 600.0)])
            found = (excess - eps[due] * reach * (1 - 1e-12)) * (1 + 1e-12)
            need[due] = np.where(np.isfinite(excess), np.maximum(found, 0.0), np.inf)
        return need

    def _residual(self, patches: Patches, m: Array, which: Terms) -> Batch:
        """R - m Q2, the disturbance being a variable."""
        count, inputs = patches.low.shape[1], self._inputs(patches, which)
        pushed = [
            tm.variable(which, len(inputs) + j, np.full(count, a), np.full(count, b))
            for j, (a, b) in enumerate(self.model.disturbance)
        ]
        return self._balance(patches, inputs + pushed, self._squares(inputs), 1 - m, (1 + m) * 2.0**-52)

    def _inputs(self, patches: Patches, which: Terms) -> list[Batch]:
        """Time and states."""
        return [patches.variable(which, i) for i in range(self.model.dimension + 1)]

    def _balance(
        self, patches: Patches, inputs: Sequence[Batch], a: list[list[Batch]], share: Array, off: Array
    ) -> Batch:
        """V_t + f . V_x + tr(a V_xx)/2 + a factor times Q2, which ``share`` misses by at most ``off``."""
        which, n = inputs[0].terms, self.model.dimension
        slope = [patches.derivative(which, _order(n, i)) for i in range(n)]
        total = patches.derivative(which, (1,) + (0,) * n)
        for rate, one in zip(self._drift(inputs), slope):
            total = tm.add(total, tm.mul(rate, one))
        for i, j in itertools.product(range(n), repeat=2):
            if j < i:
                continue
            energy = tm.scaled(tm.mul(slope[i], slope[j]), share, off)
            inner = tm.add(patches.derivative(which, _order(n, i, j)), energy)
            total = tm.add(total, tm.mul(tm.scaled(a[i][j], 0.5 if i == j else 1.0), inner))
        return total

    def _drift(self, inputs: Sequence[Batch]) -> list[Batch]:
        """f: where it jumps all values on both sides, but not from below, where disturbances may answer the jump."""
        return run(self.model.dynamics, inputs, jumps=self.upper_side or not self.model.disturbance)

    def _squares(self, inputs: Sequence[Batch]) -> list[list[Batch]]:
        """g g^T."""
        given, n = self.model.noise.diffusion, self.model.dimension
        columns = given.shape[1] if isinstance(given, Tape) else given.ncols()
        self.budget.fits(8 * (n * columns + 2 * n * n) * inputs[0].coefficients.size)
        if isinstance(given, Tape):
            entries = run(given, inputs)
        else:
            entries = [tm.fixed(inputs[0].terms, np.full(inputs[0].error.shape, float(x))) for x in given.entries()]
        rows = [entries[i * columns : (i + 1) * columns] for i in range(n)]
        return [[_summed(tm.mul(x, y) for x, y in zip(one, two)) for two in rows] for one in rows]


def _order(n: int, *states: int) -> tuple[int, ...]:
    """The orders of a derivative by some states."""
    return (0, *(states.count(i) for i in range(n)))


def _summed(parts: Iterator[Batch]) -> Batch:
    return functools.reduce(tm.add, parts)


def _substituted(x: Batch, parts: Sequence[Batch]) -> Batch:
    """x at tau = 0, with other models for the states' xi."""
    total = tm.fixed(x.terms, np.zeros(x.error.shape))
    for exponents, row in zip(x.terms.exponents, x.coefficients):
        if not row.any():
            continue
        term = tm.fixed(x.terms, row)
        for part, power in zip(parts, exponents[1:]):
            for _ in range(power):
                term = tm.mul(term, part)
        total = tm.add(total, term)
    return Batch(x.terms, total.coefficients, total.error + x.error)
