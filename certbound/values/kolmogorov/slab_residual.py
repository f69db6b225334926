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

Where L = sum_g c_g(t, d) L_g (`products`), each c_g is a polynomial of degree q in the share of the slab, but for an
error (`factors`). Then r has degree 3 + q, with coefficients

    r_k = (v_t)_k + sum_g sum_{i+j=k} binomial(q, i) binomial(3, j) / binomial(3 + q, k) c_gi L_g b_j,

means of products, so that the same bounds of sizes serve; the errors of c_g are paid by the size of L_g v.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import comb
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.values.kolmogorov.cell_fields import Field
from certbound.values.kolmogorov.factors import Factor
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
    """L = f . D + tr(a D^2) / 2 on a grid: derivatives' orders, their coefficients, and the products they belong to.

    The coefficient of d_kl, k < l, is a_kl; of d_kk it is a_kk / 2 (the weight holds the half). ``products`` counts the
    operators L_g with factors of time and disturbances of their own.
    """

    axes: tuple[Axis, ...]
    terms: tuple[tuple[tuple[int, ...], Field, float, int], ...]
    products: int = 1

    @classmethod
    def of(cls, axes: tuple[Axis, ...], *products: tuple[list[Field | None], list[Field | None]]) -> Generator:
        """From the outputs of the drift's tape and of that of a = g g' (row by row), product by product."""
        n = len(axes)
        terms: list[tuple[tuple[int, ...], Field, float, int]] = []
        for g, (drift, square) in enumerate(products):
            terms += [(unit(k, n), field, 1.0, g) for k, field in enumerate(drift) if field is not None]
            for i in range(n):
                for j in range(i, n):
                    field = square[i * n + j]
                    if field is not None:
                        terms.append((plus(unit(i, n), unit(j, n)), field, 0.5 if i == j else 1.0, g))
        return cls(axes=axes, terms=tuple(terms), products=len(products))

    def on_lattice(self, coefficients: Array) -> tuple[Array, list[Array]]:
        """v and every L_g v at the lattice points."""
        n = len(self.axes)
        parts: dict[tuple[int, ...], Array] = {(): coefficients}
        wanted = {orders for orders, *_ in self.terms} | {(0,) * n}
        for axis in range(n):
            new: dict[tuple[int, ...], Array] = {}
            for orders in {one[: axis + 1] for one in wanted}:
                new[orders] = self.axes[axis].on_lattice[orders[-1]].along(parts[orders[:-1]], axis + 1)
            parts = new
        totals = [np.zeros_like(parts[(0,) * n]) for _ in range(self.products)]
        for orders, field, weight, g in self.terms:
            part = parts[orders] * field.lattice
            totals[g] += part if weight == 1.0 else weight * part
        return parts[(0,) * n], totals

    def remainder(self, sizes: Sizes, rates: Sizes, large: Sequence[Array | float], off: Sequence[Array]) -> Array:
        """Per cell: the interpolation's error of r_j, and what the coefficients' own errors cost.

        ``sizes`` bounds the derivatives of every b_j, ``rates`` those of every (v_t)_j; ``large`` and ``off`` bound
        each factor and its error, slab by slab.
        """
        n = len(self.axes)
        total = np.zeros(())
        for orders, field, weight, g in self.terms:
            total = total + weight * large[g] * field.error * sizes(orders)
            if off[g].any():
                total = total + weight * off[g] * field.magnitude * sizes(orders)
        scale = 1.0
        for i, axis in enumerate(self.axes):
            degree = axis.sampling.parts
            width = axis.widths.reshape([-1 if k == i else 1 for k in range(n)])
            each = rates(unit(i, n, degree + 1))
            for orders, field, weight, g in self.terms:
                for k in range(degree + 1):
                    higher = plus(orders, unit(i, n, degree + 1 - k))
                    if max(higher) <= DEGREE:
                        each = each + weight * large[g] * comb(degree + 1, k) * field.slopes[i][k] * sizes(higher)
            total = total + scale * axis.sampling.tail * width ** (degree + 1) * each
            scale *= axis.sampling.lebesgue
        return np.asarray(total)

    def roundoff(self, sizes: Sizes, rates: Sizes, step: Array, large: Sequence[Array | float]) -> Array:
        """Per cell: what the rounding of r_j at its lattice points may come to."""
        zero = (0,) * len(self.axes)
        total = rates(zero) + 8 / step * sizes(zero)
        for orders, field, weight, g in self.terms:
            factors = [axis.condition[order] for axis, order in zip(self.axes, orders)]
            total = total + weight * large[g] * field.slopes[0][0] * outer(factors) * sizes(zero)
        more = 1 + 0.1 * self.products  # up to 20 roundings for each factor and sum
        return np.asarray((1 + amplified(self.axes)) * more * ROUNDOFF * total)


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


def residual_bound(
    generator: Generator, values: Array, rates: Array, steps: Array, factors: Sequence[Factor | None] = (None,),
    *, worst: bool = True, clock: Array | None = None,
) -> Array:  # fmt: skip
    """A bound of v_t + L v from above on every cell of every slab.

    Parameters
    ----------
    values, rates : ndarray, shape (K + 1, N_1 + 5, ...)
        Coefficients of v and v_t at the knots, from the last one backward.
    steps : ndarray, shape (K,)
        Lengths of the slabs in that order.
    factors : sequence of Factor or None
        Of each of the generator's products on these slabs; None for 1.
    worst : bool
        Whether the bound is one for all disturbances, or for the best of their nodes on each cell and slab.
    clock : ndarray, shape (K,), optional
        Share of each slab by which its length is off.

    Returns
    -------
    ndarray, shape (K, N_1, ...)
    """
    axes = generator.axes
    n = len(axes)
    h = steps.reshape(-1, *[1] * n)
    moved = _in_time(generator, values, rates, h, factors)
    bounds = [np.maximum.reduce([most_of_interpolants(axes, r) for r in one]) for one in moved]
    bound = np.maximum.reduce(bounds) if worst else np.minimum.reduce(bounds)
    sizes, speeds = _sizes(axes, values, rates, h)
    large = [1.0 if one is None else one.size.reshape(h.shape) for one in factors]
    off = [np.zeros(()) if one is None else (one.spread + worst * one.between).reshape(h.shape) for one in factors]
    extra = generator.remainder(sizes, speeds, large, off) + generator.roundoff(sizes, speeds, h, large)
    if clock is not None:
        extra = extra + clock.reshape(h.shape) * speeds((0,) * n)
    return np.asarray(bound + extra * _UP)


def rough_residual(
    generator: Generator, values: Array, rates: Array, steps: Array, factors: Sequence[Factor | None] = (None,),
    *, worst: bool = True,
) -> Array:  # fmt: skip
    """About the same, from values at lattice points alone: nothing is proved of it."""
    moved = _in_time(generator, values, rates, steps.reshape(-1, *[1] * len(generator.axes)), factors)
    bounds = [np.maximum.reduce([over_cells(generator.axes, r) for r in one]) for one in moved]
    return np.asarray(np.maximum.reduce(bounds) if worst else np.minimum.reduce(bounds))


def _in_time(
    generator: Generator, values: Array, rates: Array, h: Array, factors: Sequence[Factor | None]
) -> list[list[Array]]:  # fmt: skip
    """The Bernstein coefficients in time of v_t + L v at the lattice points: for all disturbances, or for each node."""
    n = len(generator.axes)
    value, images = generator.on_lattice(values)
    rate, images_of_rates = generator.on_lattice(rates)
    late, early = slice(None, -1), slice(1, None)
    degree = 3 + max((0 if one is None else one.degree for one in factors), default=0)
    moved = [_raised(_speeds(value, rate, h), degree)]
    for factor, image, of_rate in zip(factors, images, images_of_rates):
        parts = (
            image[early], image[early] + h / 3 * of_rate[early], image[late] - h / 3 * of_rate[late], image[late],
        )  # fmt: skip
        if factor is None:
            shares = [_raised(list(parts), degree)]
        else:
            rows = factor.bernstein.reshape(*factor.bernstein.shape, *[1] * n)
            shares = [_product([row[:, i] for i in range(factor.degree + 1)], parts, degree) for row in rows]
        if len(moved) < len(shares):
            moved = moved * len(shares)
        moved = [[a + b for a, b in zip(one, shares[v % len(shares)])] for v, one in enumerate(moved)]
    return moved


def _speeds(value: Array, rate: Array, h: Array) -> list[Array]:
    """Bernstein coefficients of v_t, of degree 2, from the early end of each slab to its late one."""
    late, early = slice(None, -1), slice(1, None)
    return [rate[early], 3 * (value[late] - value[early]) / h - (rate[early] + rate[late]), rate[late]]


def _raised(parts: list[Array], degree: int) -> list[Array]:
    """Bernstein coefficients of the same polynomial as one of a higher degree."""
    return _product([1.0] * (degree - len(parts) + 2), parts, degree)


def _product(first: Sequence[Array | float], second: Sequence[Array], degree: int) -> list[Array]:
    """Bernstein coefficients of a product of polynomials, raised to ``degree``."""
    p, q = len(first) - 1, len(second) - 1
    if p + q < degree:
        return _raised(_product(first, second, p + q), degree)
    result = []
    for k in range(degree + 1):
        total: Array | float = 0.0
        for i in range(max(0, k - q), min(p, k) + 1):
            share = comb(p, i) * comb(q, k - i) / comb(p + q, k)
            one = second[k - i] if isinstance(first[i], float) and first[i] == 1.0 else first[i] * second[k - i]
            total = total + (one if share == 1.0 else share * one)
        result.append(np.asarray(total))
    return result


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
