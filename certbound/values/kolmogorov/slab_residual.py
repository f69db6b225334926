"""The only trusted inequality: v_t + sup_d L^d v <= eta_k in slab k, bounded on every cell from above (Thm K10, 10.1).

v is a quintic tensor spline in space and a cubic in time, by its coefficients U_k and their time derivatives D_k at
the knots t_k. On a slab of length h it has the Bernstein coefficients (in time)

    b_0 = U_k,  b_1 = U_k + h D_k / 3,  b_2 = U_{k+1} - h D_{k+1} / 3,  b_3 = U_{k+1},

and v_t those of 3 (b_{j+1} - b_j) / h, raised by one degree. For coefficients that do not depend on time the residual
r = v_t + L v is a cubic in time with coefficients r_j(x) = (v_t)_j + L b_j, and r <= max_j r_j.

On a cell let p be the tensor interpolant of r_j at the cell's lattice points, of degree m along each axis, with the
Lebesgue constant C, the tail's constant c and gaps g of `splines.Sampling`, and h_i the cell's widths. With drift and
noise replaced by their own interpolants (`cell_fields`), whose errors are paid by the size of v's derivatives,

    r_j <= max p(lattice) + g^2 / 8 sum_i max (-h_i^2 d_ii p)^+                    (chords, `most_of_interpolants`)
           + sum_i C^i c h_i^(m+1) sup |d_i^(m+1) r_j|                                     (the interpolation's error),

and d_i^(m+1) r_j is bounded term by term: d^(m+1) (F D) = sum_k binomial(m + 1, k) d^k F d^(m+1-k) D, d^(m+1) F = 0.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import comb
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.values.kolmogorov.cell_fields import Field
from certbound.values.kolmogorov.splines import (
    DEGREE,
    ROUNDOFF,
    Axis,
    Derivatives,
    amplified,
    most_of_interpolants,
    outer,
    over_cells,
    plus,
    unit,
)

_UP = 1 + 1e-11


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Generator:
    """L = f . D + tr(a D^2) / 2 on a grid: pairs of a derivative's orders and its coefficient.

    The coefficient of d_kl, k < l, is a_kl; of d_kk it is a_kk / 2 (``weights`` holds the half).
    """

    axes: tuple[Axis, ...]
    terms: tuple[tuple[tuple[int, ...], Field, float], ...]

    @classmethod
    def of(cls, axes: tuple[Axis, ...], drift: list[Field | None], square: list[Field | None]) -> Generator:
        """From the outputs of the drift's tape and of that of a = g g' (row by row)."""
        n = len(axes)
        terms = [(unit(k, n), field, 1.0) for k, field in enumerate(drift) if field is not None]
        for i in range(n):
            for j in range(i, n):
                field = square[i * n + j]
                if field is not None:
                    terms.append((plus(unit(i, n), unit(j, n)), field, 0.5 if i == j else 1.0))
        return cls(axes=axes, terms=tuple(terms))

    def on_lattice(self, coefficients: Array) -> tuple[Array, Array]:
        """v and L v at the lattice points."""
        n = len(self.axes)
        parts: dict[tuple[int, ...], Array] = {(): coefficients}
        wanted = {orders for orders, _, _ in self.terms} | {(0,) * n}
        for axis in range(n):
            new: dict[tuple[int, ...], Array] = {}
            for orders in {one[: axis + 1] for one in wanted}:
                new[orders] = self.axes[axis].on_lattice[orders[-1]].along(parts[orders[:-1]], axis + 1)
            parts = new
        total = np.zeros_like(parts[(0,) * n])
        for orders, field, weight in self.terms:
            part = parts[orders] * field.lattice
            total += part if weight == 1.0 else weight * part
        return parts[(0,) * n], total

    def remainder(self, sizes: Sizes, rates: Sizes) -> Array:
        """Per cell: the interpolation's error of r_j, and what the coefficients' own errors cost.

        ``sizes`` bounds the derivatives of every b_j, ``rates`` those of every (v_t)_j.
        """
        n = len(self.axes)
        total = np.zeros(())
        for orders, field, weight in self.terms:
            total = total + weight * field.error * sizes(orders)
        scale = 1.0
        for i, axis in enumerate(self.axes):
            degree = axis.sampling.parts
            width = axis.widths.reshape([-1 if k == i else 1 for k in range(n)])
            each = rates(unit(i, n, degree + 1))
            for orders, field, weight in self.terms:
                for k in range(degree + 1):
                    higher = plus(orders, unit(i, n, degree + 1 - k))
                    if max(higher) <= DEGREE:
                        each = each + weight * comb(degree + 1, k) * field.slopes[i][k] * sizes(higher)
            total = total + scale * axis.sampling.tail * width ** (degree + 1) * each
            scale *= axis.sampling.lebesgue
        return np.asarray(total)

    def roundoff(self, sizes: Sizes, rates: Sizes, step: Array) -> Array:
        """Per cell: what the rounding of r_j at its lattice points may come to."""
        zero = (0,) * len(self.axes)
        total = rates(zero) + 8 / step * sizes(zero)
        for orders, field, weight in self.terms:
            factors = [axis.condition[order] for axis, order in zip(self.axes, orders)]
            total = total + weight * field.slopes[0][0] * outer(factors) * sizes(zero)
        return np.asarray((1 + amplified(self.axes)) * ROUNDOFF * total)


Part = tuple[Derivatives, "slice[Any, Any, Any]", Any]
"""Tensor splines, which of them, and the factor."""


class Sizes:
    """Bounds of the derivatives of several functions, each a sum of tensor splines with factors, on every cell."""

    def __init__(self, groups: Sequence[Sequence[Part]]) -> None:
        self.groups, self.known = groups, dict[tuple[int, ...], Array]()

    def __call__(self, orders: tuple[int, ...]) -> Array:
        """The largest over the functions."""
        if orders not in self.known:
            sums = []
            for group in self.groups:
                sums.append(np.add.reduce([factor * part.size(orders)[rows] for part, rows, factor in group]))
            self.known[orders] = np.maximum.reduce(sums) * (1 + 1e-13)
        return self.known[orders]


def residual_bound(generator: Generator, values: Array, rates: Array, steps: Array) -> Array:
    """A bound of v_t + L v from above on every cell of every slab.

    Parameters
    ----------
    values, rates : ndarray, shape (K + 1, N_1 + 5, ...)
        Coefficients of v and v_t at the knots, from the last one backward.
    steps : ndarray, shape (K,)
        Lengths of the slabs in that order.

    Returns
    -------
    ndarray, shape (K, N_1, ...)
    """
    axes = generator.axes
    h = steps.reshape(-1, *[1] * len(axes))
    bound = np.full((len(steps), *(axis.cells for axis in axes)), -np.inf)
    for residual in _in_time(generator, values, rates, h):
        bound = np.maximum(bound, most_of_interpolants(axes, residual))
    sizes, speeds = _sizes(axes, values, rates, h)
    extra = generator.remainder(sizes, speeds) + generator.roundoff(sizes, speeds, h)
    return np.asarray(bound + extra * _UP)


def rough_residual(generator: Generator, values: Array, rates: Array, steps: Array) -> Array:
    """About the same, from values at lattice points alone: nothing is proved of it."""
    h = steps.reshape(-1, *[1] * len(generator.axes))
    parts = [over_cells(generator.axes, residual) for residual in _in_time(generator, values, rates, h)]
    return np.asarray(np.maximum.reduce(parts))


def _in_time(generator: Generator, values: Array, rates: Array, h: Array) -> Iterator[Array]:
    """The Bernstein coefficients in time of v_t + L v, at the lattice points."""
    value, image = generator.on_lattice(values)
    rate, image_of_rate = generator.on_lattice(rates)
    late, early = slice(None, -1), slice(1, None)
    # m = 3 (b_2 - b_1) / h; the raised coefficients of v_t are D_k, (D_k + 2 m) / 3, (2 m + D_{k+1}) / 3, D_{k+1}
    middle = 2 * (value[late] - value[early]) / h - (2 / 3) * (rate[early] + rate[late])
    yield rate[early] + image[early]
    yield rate[early] / 3 + middle + (image[early] + h / 3 * image_of_rate[early])
    yield middle + rate[late] / 3 + (image[late] - h / 3 * image_of_rate[late])
    yield rate[late] + image[late]


def _sizes(axes: tuple[Axis, ...], values: Array, rates: Array, h: Array) -> tuple[Sizes, Sizes]:
    """Bounds of the derivatives of the Bernstein coefficients of v, and of those of v_t.

    The middle ones of v_t are (D_k + 2 m) / 3 with m = 3 (U_{k+1} - U_k) / h - D_k - D_{k+1}, and the same mirrored.
    """
    late, early, every = slice(None, -1), slice(1, None), slice(None)
    v, d = Derivatives(axes, values), Derivatives(axes, rates)
    change = Derivatives(axes, (values[late] - values[early]) * (2 / h))
    sizes = Sizes([[(v, early, 1.0), (d, early, h / 3)], [(v, late, 1.0), (d, late, h / 3)]])
    speeds = Sizes([[(d, early, 1.0)], [(d, late, 1.0)], [(change, every, 1.0), (d, early, 1.0), (d, late, 1.0)]])
    return sizes, speeds
