"""One step back after uniform noise, in one state.

h(m) = (1/2r) int_(m-r)^(m+r) U: at the middle c of an image from an antiderivative of U, and away from it by

    h(c + v) - h(c) = (1/2r) (int_0^v U(c + r + s) ds - int_0^v U(c - r + s) ds),

each of which is v times a mean of U within |v| of c + r (of c - r): v times the middle of U's range there, up to |v|
times half its width. So U may jump wherever it likes.

Everything is computed in floats. Positions are off by a few units of the largest of them, which an integral of U feels
by that times sup |U|; a sum of N terms by N units of the sum of their sizes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from flint import arb

from certbound.checker.report import Unproved
from certbound.checker.statement import Model
from certbound.checker.values import batches as tm
from certbound.checker.values.batches import Array, Batch, Index
from certbound.checker.values.step_back import DEGREE, Grid, Steps, Transition, Values

_UNIT = 2.0**-52


def halfwidth_of(model: Model) -> arb:
    """r, where one uniform entry of the noise moves the one state."""
    widths = model.noise.uniform
    assert widths is not None
    if model.dimension != 1:
        raise Unproved("value functions are proved for uniform noise in one state only")
    gains = [abs(gain) * width for gain, width in zip(model.noise.constant().entries(), widths)]
    moving = [size for size in gains if not size.is_zero()]
    if len(moving) != 1 or not moving[0] > 0:
        raise Unproved("value functions are proved for uniform noise only that is a single uniform number")
    return moving[0]


@dataclass(frozen=True, eq=False)
class _Integral:
    """An antiderivative of U, U's range over runs of cells, and the sizes that errors are measured in.

    ``heads`` are the antiderivative at the edges; ``low[k]`` and ``high[k]`` bound U over 2^k cells from each cell on,
    the two unbounded ones included.
    """

    edges: Array
    heads: Array
    coefficients: Array
    beyond: float
    low: list[Array]
    high: list[Array]
    largest: float
    wrong: float

    def at(self, y: Array) -> Array:
        """The antiderivative, up to ``wrong`` and ``largest`` times a few units of the positions."""
        cell = np.clip(np.searchsorted(self.edges, y, side="right") - 1, 0, len(self.edges) - 2)
        left, right = self.edges[cell], self.edges[cell + 1]
        xi = np.clip((2 * y - left - right) / (right - left), -1.0, 1.0)
        total = np.zeros(y.shape)
        for k in reversed(range(DEGREE + 1)):
            total = total + self.coefficients[k, cell] * (xi ** (k + 1) - (-1.0) ** (k + 1)) / (k + 1)
        outside = np.minimum(y - self.edges[0], 0.0) + np.maximum(y - self.edges[-1], 0.0)
        return np.asarray(self.heads[cell] + total * (right - left) / 2 + self.beyond * outside)

    def over(self, first: Array, last: Array) -> tuple[Array, Array]:
        """Ends of U on [first, last]."""
        a = np.searchsorted(self.edges, first, side="left")
        b = np.searchsorted(self.edges, last, side="right")
        power = np.log2(b - a + 1).astype(np.intp)
        power = np.where(2**power > b - a + 1, power - 1, power)
        return self._met(np.minimum, self.low, a, b, power), self._met(np.maximum, self.high, a, b, power)

    def _met(self, pick: np.ufunc, tables: list[Array], a: Index, b: Index, power: Index) -> Array:
        found = np.empty(a.shape)
        for k, table in enumerate(tables):
            here = power == k
            found[here] = pick(table[a[here]], table[b[here] + 1 - 2**k])
        return found


def _integral(value: Values) -> _Integral:
    (edges,), coefficients = value.grid.edges, value.coefficients
    half = np.diff(edges) / 2
    parts = half * sum(coefficients[k] * 2 / (k + 1) for k in range(0, DEGREE + 1, 2))
    sizes = np.abs(coefficients).sum(axis=0) * (1 + 8 * _UNIT)
    reach = sizes - np.abs(coefficients[0])
    slack = 8 * _UNIT * sizes
    low = [np.concatenate([[value.beyond], coefficients[0] - reach - slack, [value.beyond]])]
    high = [np.concatenate([[value.beyond], coefficients[0] + reach + slack, [value.beyond]])]
    while 2 ** len(low) <= len(low[0]):
        step = 2 ** (len(low) - 1)
        low.append(np.minimum(low[-1][:-step], low[-1][step:]))
        high.append(np.maximum(high[-1][:-step], high[-1][step:]))
    largest = max(float(sizes.max()), abs(value.beyond))
    wrong = (len(edges) + 64) * _UNIT * float((2 * half * sizes).sum()) * 2
    heads = np.concatenate([[0.0], np.cumsum(parts)])
    return _Integral(edges, heads, coefficients, value.beyond, low, high, largest, wrong)


class UniformTransition(Transition):
    """One step from some boxes into a grid, for uniform noise."""

    def __init__(self, steps: Steps, step: int, low: Array, high: Array, after: Grid) -> None:
        self.steps, self.n = steps, len(low)
        self.images = steps.all_images(step, low, high)
        exact = halfwidth_of(steps.model)
        self.reach = float(exact.mid())

    def table(self, value: Values) -> _Integral:
        """What the mean is computed from."""
        cells = len(value.grid.edges[0])
        self.steps.budget.fits(8 * cells * (2 * cells.bit_length() + 16))
        self.steps.budget.floats(cells * (2 * cells.bit_length() + 40), 100)
        return _integral(value)

    def mean(self, images: list[Batch], table: _Integral) -> Batch:
        """Taylor models of h(f)."""
        (image,) = images
        self.steps.budget.floats(400 * len(image.error), 200)
        good = np.isfinite(image.error)
        centre = np.where(good, image.value, 0.0)
        away = np.where(good, image.reach(), 0.0)
        size = (np.abs(centre) + away + self.reach + float(np.abs(table.edges).max())) * 16 * _UNIT
        ends = [table.over(centre + sign * self.reach - away - size, centre + sign * self.reach + away + size)
                for sign in (-1, 1)]  # fmt: skip
        double = 2 * self.reach
        height = (table.at(centre + self.reach) - table.at(centre - self.reach)) / double
        slope = ((ends[1][0] + ends[1][1]) - (ends[0][0] + ends[0][1])) / (2 * double)
        spread = ((ends[1][1] - ends[1][0]) + (ends[0][1] - ends[0][0])) / (2 * double)
        error = away * spread + (2 * table.wrong + 4 * table.largest * size) / double
        error = (error + np.abs(height) * 8 * _UNIT + np.abs(slope) * away * 8 * _UNIT) * (1 + 1e-9)
        moved = tm.scaled(tm.sub(image, tm.fixed(image.terms, centre)), slope)
        found = tm.add(moved, tm.fixed(image.terms, height, error))
        return tm.known(Batch(found.terms, found.coefficients, np.where(good, found.error, np.inf)))
