"""One step back after any noise whose law is known: functions that are bounded by constants on cells.

For a box w_k of noise of probability at most p_k, and U_k the largest value of U over the cells that f(t, c, d) +
G(t, c) w_k meets, E U(f + G w) <= sum_k p_k U_k + p sup U on the cell c, p the probability of what lies in no box;
whatever the noise does with the state. From below with smallest values and least probabilities.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from flint import arb

from certbound.checker.report import FUNCTION, Unproved
from certbound.checker.statement import Model
from certbound.checker.values import batches as tm
from certbound.checker.values.batches import Array, Batch, Index, above, below, terms
from certbound.checker.values.step_back import DEGREE, Grid, Steps, Transition, Values

_MOST_STATES = 2
_MOST_PIECES = 200_000
_HELD = 20_000_000  # places that are kept for the next step
_BOX_BYTES, _BOX_WORK = 100, 2_000
"""Memory and units of work of a side of a box of noise while the arrays are made."""


@dataclass(frozen=True, eq=False)
class Pieces:
    """Boxes of noise, ends of shape (K, m), each with bounds of its probability; ``rest`` bounds that of all else."""

    low: Array
    high: Array
    least: Array
    most: Array
    rest: float


def pieces_of(model: Model, count: int) -> Pieces:
    """The law of the noise in about so many pieces an entry."""
    noise = model.noise
    if model.dimension > _MOST_STATES:
        raise Unproved(f"noise in pieces is for at most {_MOST_STATES} states")
    if noise.cut is None or not noise.entries:
        raise Unproved("value functions are proved for noise only with independent entries of a law that is known")
    model.budget.balls(count + len(noise.entries), 3 * FUNCTION)
    unit = noise.cut(count)
    inside = sum((share for _, _, share in unit), arb(0))
    still = [(arb(0), arb(0), arb(1))]
    axes = [[(a * size, b * size, share) for a, b, share in unit] if size > 0 else still for size in noise.entries]
    if not all(size > 0 or size.is_zero() for size in noise.entries):
        raise Unproved("a size of the noise was not decided")
    many = math.prod(map(len, axes))
    if many > _MOST_PIECES:
        raise Unproved(f"the noise would have more than {_MOST_PIECES} pieces")
    model.budget.take(16 * many * len(axes))
    model.budget.fits(_BOX_BYTES * many * len(axes))
    model.budget.balls(many * (1 + len(axes)), _BOX_WORK)
    boxes = list(itertools.product(*axes))
    shares = []
    for box in boxes:
        share = arb(1)
        for _, _, one in box:
            share *= one
        shares.append(share)
    return Pieces(
        low=np.array([[below(a) for a, _, _ in box] for box in boxes]),
        high=np.array([[above(b) for _, b, _ in box] for box in boxes]),
        least=np.array([max(below(share), 0.0) for share in shares]),
        most=np.array([max(above(share), 0.0) for share in shares]),
        rest=max(above(len(axes) * (1 - inside)), 0.0) * (1 + 1e-12),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Extremes:
    """The largest or smallest entries of blocks of a table whose sides are powers of 2."""

    blocks: Array
    pick: np.ufunc

    @classmethod
    def of(cls, table: Array, pick: np.ufunc) -> _Extremes:
        """Of a table of two axes."""
        levels = [int(size).bit_length() for size in table.shape]
        blocks = np.empty((*levels, *table.shape))
        blocks[0, 0] = table
        for b in range(1, levels[1]):
            half = 1 << (b - 1)
            blocks[0, b] = blocks[0, b - 1]
            blocks[0, b][:, :-half] = pick(blocks[0, b - 1][:, :-half], blocks[0, b - 1][:, half:])
        for a in range(1, levels[0]):
            half = 1 << (a - 1)
            blocks[a] = blocks[a - 1]
            blocks[a][:, :-half] = pick(blocks[a - 1][:, :-half], blocks[a - 1][:, half:])
        return cls(blocks, pick)

    def over(self, first: Index, last: Index) -> Array:
        """Over boxes from ``first`` to ``last``, both included, shapes (2, N)."""
        level = np.frexp(last - first + 1)[1] - 1
        ends = last - (1 << level) + 1
        found = [self.blocks[level[0], level[1], a, b] for a in (first[0], ends[0]) for b in (first[1], ends[1])]
        return np.asarray(self.pick.reduce(found))


def _table_size(shape: tuple[int, ...]) -> int:
    """Numbers of the `_Extremes` of a table over so many cells."""
    return math.prod((size + 2) * (size + 2).bit_length() for size in shape)


class PieceTransition(Transition):
    """One step from some boxes into a grid, by the pieces of the noise."""

    def __init__(self, steps: Steps, step: int, low: Array, high: Array, after: Grid, pieces: Pieces) -> None:
        self.steps, self.n, self.after, self.pieces = steps, len(low), after, pieces
        self.count = low.shape[1]
        steps.budget.take(8 * len(steps.disturbances) * (2 * self.n + 1) * self.count)
        self.ends = []
        for images in steps.images(step, low, high):
            self.ends.append(tuple(np.array(side) for side in zip(*(image.sharp_ends() for image in images))))
        self.gains = tuple(side.reshape(self.n, -1, self.count) for side in steps.gains(step, low, high))
        undefined = ~np.isfinite(self.gains).all(axis=(0, 1, 2))
        self.lost = [undefined | ~np.isfinite(ends).all(axis=(0, 1)) for ends in self.ends]
        self._places: dict[tuple[int, int], tuple[Index, Index]] = {}
        places = 4 * self.count * len(pieces.most) * len(self.ends)
        self._keeps = places <= _HELD
        steps.budget.take(8 * places if self._keeps else 0)

    def apply(self, value: Values) -> Batch:
        """A bound of sup over d of E U(f + w) on every box."""
        upper = self.steps.upper
        size = np.abs(value.coefficients[1:]).sum(axis=0) * (1 + 1e-12)
        middle, slack = value.coefficients[0], (np.abs(value.coefficients[0]) + size) * 1e-15
        cells = np.minimum(middle + size + slack, 1.0) if upper else np.maximum(middle - size - slack, 0.0)
        shape = (*value.grid.shape, 1)[:2]
        ring = [(1, 1)] * self.n + [(0, 0)] * (2 - self.n)
        self.steps.budget.fits(8 * _table_size(shape))
        self.steps.budget.floats(_table_size(shape))
        table = np.pad(np.maximum(cells, 0.0).reshape(shape), ring, constant_values=value.beyond)
        extremes = _Extremes.of(table, np.maximum if upper else np.minimum)
        found = [self._mean(extremes, part) for part in range(len(self.ends))]
        total = np.max(found, axis=0)
        if upper:
            total = total + self.pieces.rest * float(table.max())
        rounding = (len(self.pieces.most) + 16) * 2.0**-52
        total = np.clip(total * (1 + rounding if upper else 1 - rounding), 0.0, 1.0)
        return tm.fixed(terms(self.n, DEGREE), total)

    def _mean(self, extremes: _Extremes, part: int) -> Array:
        upper = self.steps.upper
        total = np.zeros(self.count)
        gains = self.gains[0].size if self._keeps else 2 * self.gains[0].size
        work = 12 * gains + 200 * self.count
        self.steps.budget.expect(len(self.pieces.most) * work)
        self.steps.budget.fits(8 * 8 * gains)
        for k, weight in enumerate(self.pieces.most if upper else self.pieces.least):
            if weight > 0:
                self.steps.budget.floats(work, 40)
                total += weight * extremes.over(*self._met(part, k))
        return np.where(self.lost[part], 1.0 if upper else 0.0, total)

    def _met(self, part: int, k: int) -> tuple[Index, Index]:
        """The cells that a piece of the noise leads to, with a ring around the grid."""
        if (part, k) in self._places:
            return self._places[part, k]
        low, high = self.pieces.low[k][None, :, None], self.pieces.high[k][None, :, None]
        products = [gain * end for gain in self.gains for end in (low, high)]
        pushed = np.min(products, axis=0).sum(axis=1), np.max(products, axis=0).sum(axis=1)
        slack = np.max(np.abs(products), axis=0).sum(axis=1)
        ends = self.ends[part]
        wrong = (slack + np.abs(ends[0]) + np.abs(ends[1])) * (len(self.pieces.low[k]) + 8) * 2.0**-52
        bottom, top = ends[0] + pushed[0] - wrong, ends[1] + pushed[1] + wrong
        first, last = np.zeros((2, self.count), dtype=np.intp), np.zeros((2, self.count), dtype=np.intp)
        for i, edges in enumerate(self.after.edges):  # what is not known is all
            first[i] = np.searchsorted(edges, np.where(bottom[i] == bottom[i], bottom[i], -np.inf), side="left")
            last[i] = np.searchsorted(edges, np.where(top[i] == top[i], top[i], np.inf), side="right")
        if self._keeps:
            self._places[part, k] = first, last
        return first, last
