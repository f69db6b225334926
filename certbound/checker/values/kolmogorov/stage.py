"""What v of one stage lacks of what is asked of it: on faces, where paths meet the target, at the end, at starts."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
from flint import arb

from certbound.checker.report import Unproved
from certbound.checker.statement import Model
from certbound.checker.values.batches import Array, Index, above, below, bernstein
from certbound.checker.values.kolmogorov.cell_operator import TOGETHER, Acting, Grid, Operator, about
from certbound.checker.values.kolmogorov.patch_residual import SUMS, UNIT, UP, Residual
from certbound.checker.values.kolmogorov.patches import DEGREE, ROUNDED, Splines
from certbound.checker.values.kolmogorov.stage_limits import StageLimits, common, faces


class Stage:
    """v of one stage, and what the problem asks of it."""

    def __init__(
        self, model: Model, operator: Operator, splines: Splines, stated: Array, actings: Sequence[Acting | None],
        *, upper: bool,
    ) -> None:  # fmt: skip
        self.above, self.operator, self.splines, self.n = upper, operator, splines, model.dimension
        self.budget, self.goal = splines.budget, 1.0 if upper else 0.0
        self.sides = [(arb(float(axis[0])), arb(float(axis[-1]))) for axis in splines.axes]
        span = (float(splines.times[0]), float(splines.times[-1]))
        self.limits = StageLimits(model, span, splines.axes, self.budget, above=upper)
        self.over = self.limits.over
        self.residual = Residual(splines, operator, stated, self.over, self.goal, actings)

    def check_box(self) -> None:
        """From above the box lies in the constraints of the stage."""
        if self.above and not self.limits.room.holds(*about(self.sides)):
            raise Unproved("the grid was not shown to lie in the safe set")

    def lacking(self, after: Stage | None) -> float:
        """gamma: what v lacks at faces by which paths leave, where they meet the target, and at the end."""
        parts = [self._at_face(*face) for face in faces(self.n)]
        return max([0.0, self._at_target(), self._at_end(after), *parts])

    # ---- faces ------------------------------------------------------------------------------------------------

    def _at_face(self, axis: int, side: int) -> float:
        """What v lacks of its goal where paths may leave by a face."""
        face = [(ends[side], ends[side]) if k == axis else ends for k, ends in enumerate(self.sides)]
        goal = 1.0 if self.above else -1.0 if self.limits.room.excludes(*about(face)) else 0.0
        function = self.splines.face(axis, side)
        leaves = self.operator.leaving(Grid(axes=self.splines.axes, times=self.splines.times), axis, side)
        beside = np.take(self.over, -side, axis=axis).ravel()
        chosen = np.flatnonzero(leaves & ~beside)
        least = np.inf
        self.budget.expect(len(chosen) * 4 * (DEGREE + 1) ** (self.n - 1))
        for first in range(0, len(chosen), TOGETHER):
            slab, cell = np.divmod(chosen[first : first + TOGETHER], beside.size)
            places = np.unravel_index(cell, function.cells)
            least = min(least, _least(function.patches(slab, places, 0).lowest()))
        return float(np.nextafter(goal - least, np.inf))

    def _at_target(self) -> float:
        """What v lacks of 0 where paths may meet the target."""
        lacks = -np.inf
        for axis in range(self.n if self.over.any() else 0):
            rows = np.moveaxis(self.over, axis, 0)
            for side in (0, 1):  # of the cell that is not over, the side on which the other one lies
                own, other = (rows[1:], rows[:-1]) if side == 0 else (rows[:-1], rows[1:])
                places = list(np.nonzero(~own & other))
                places[0] = places[0] + (1 - side)
                ahead = places.pop(0)
                places.insert(axis, ahead)
                lacks = max(lacks, self._on_side(places, axis, side))
        return lacks

    def _on_side(self, places: Sequence[Index], axis: int, side: int) -> float:
        """At most what v lacks of 0 on one side of some cells, in all slabs."""
        slabs, least = self.splines.slabs, np.inf
        count = slabs * len(places[0])
        self.budget.expect(count * 4 * (DEGREE + 1) ** self.n)
        for first in range(0, count, TOGETHER):
            cell, slab = np.divmod(np.arange(first, min(first + TOGETHER, count)), slabs)
            found = self.splines.patches(slab, [place[cell] for place in places], 0)
            least = min(least, _least(found.lowest(axis, side)))
        return float(np.nextafter(-least, np.inf))

    # ---- the end ----------------------------------------------------------------------------------------------

    def _at_end(self, after: Stage | None) -> float:
        """What v lacks at the end of the stage."""
        goal, own = np.full(self.over.shape, self.goal), self.limits
        reached = own.target is not None and own.opens <= own.span[1]
        if after is not None:
            here, there = common(self.splines.axes, after.splines.axes)
            next_ = np.zeros(self.over.shape, dtype=bool)
            next_[here] = True
            met = np.zeros(self.over.shape, dtype=bool)
            met[here] = after.over[there]
            if self.above:
                next_ &= own.within
            goal[next_ & met] = 0.0
            next_ &= ~met
        elif self.above:
            next_ = np.zeros(self.over.shape, dtype=bool)
            goal[own.within & (own.met if own.target is not None else True)] = 0.0
        else:
            next_ = np.zeros(self.over.shape, dtype=bool)
            goal[own.missed if own.target is not None else own.off] = -1.0
        if not self.above and after is not None:
            failed = own.off & (own.missed if reached else True)
            goal[failed] = -1.0
            next_ &= ~failed
        next_ &= ~self.over
        lacks = self._below(goal, np.flatnonzero(~self.over & ~next_))
        if after is None or not next_.any():
            return lacks
        offset = [one.start - two.start for one, two in zip(here, there)]
        return max(lacks, self._below_next(after, np.nonzero(next_), offset))

    def _below(self, goal: Array, cells: Index) -> float:
        """What v lacks at the end of a goal on some cells."""
        still, lacks = self.splines.at(-1), -np.inf
        for first in range(0, len(cells), TOGETHER):
            number = cells[first : first + TOGETHER]
            found = still.patches(0 * number, np.unravel_index(number, self.splines.cells), 0).lowest()
            lacks = max(lacks, -_least(found - goal.ravel()[number]))
        return float(np.nextafter(lacks, np.inf))

    def _below_next(self, after: Stage, places: Sequence[Index], offset: Sequence[int]) -> float:
        """What v lacks on some cells of the smaller of its end and the next v."""
        still, then, lacks = self.splines.at(-1), after.splines.at(0), -np.inf
        for first in range(0, len(places[0]), TOGETHER):
            own = [place[first : first + TOGETHER] for place in places]
            here = still.patches(0 * own[0], own, 0)
            there = then.patches(0 * own[0], [place - k for place, k in zip(own, offset)], 0)
            found = np.minimum(there.most_above(here), self.goal - here.lowest())
            lacks = max(lacks, -_least(-found))
        return float(np.nextafter(lacks, np.inf))

    # ---- starts -----------------------------------------------------------------------------------------------

    def is_over(self, point: Sequence[tuple[arb, arb]]) -> bool:
        """Whether a point may lie on a cell in which a path is over."""
        met = [(axis[:-1] <= above(x)) & (axis[1:] >= below(x)) for axis, (x, _) in zip(self.splines.axes, point)]
        return bool(self.over[np.ix_(*map(np.flatnonzero, met))].any())

    def most_over(self, box: Sequence[tuple[arb, arb]]) -> float:
        """At least v(0, .) on a box of starts."""
        if not all(low >= a and high <= b for (a, b), (low, high) in zip(self.sides, box)):
            raise Unproved("a start was not shown to lie in the grid")
        self.budget.floats(4 * sum(map(len, self.splines.axes)), 8)
        ends = [(below(low), above(high)) for low, high in box]
        met = [np.flatnonzero((axis[:-1] <= b) & (axis[1:] >= a)) for axis, (a, b) in zip(self.splines.axes, ends)]
        count, most = math.prod(map(len, met)), -np.inf
        for first in range(0, count, TOGETHER):
            number = np.unravel_index(np.arange(first, min(first + TOGETHER, count)), tuple(map(len, met)))
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
        slack = 8 * ROUNDED * SUMS[0] ** self.n * patches.size + UNIT * np.abs(patches.constants[0])
        return np.asarray(table.max(axis=tuple(range(self.n))) + patches.constants[0] + slack * UP)


def _least(values: Array) -> float:
    """The least of some numbers; minus infinity where one is none."""
    return float(np.where(np.isnan(values), -np.inf, values).min())
