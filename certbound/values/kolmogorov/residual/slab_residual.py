"""The only trusted inequality: v_t + sup_d L^d v <= eta_k in slab k, bounded on every cell from above (Thm K10, 10.1).

v is a quintic tensor spline in space and a cubic in time, by its coefficients U_k and their time derivatives D_k at
the knots t_k. On a slab of length h it has the Bernstein coefficients (in time)

    b_0 = U_k,  b_1 = U_k + h D_k / 3,  b_2 = U_{k+1} - h D_{k+1} / 3,  b_3 = U_{k+1}.

With the mean rate S = (U_{k+1} - U_k) / h it is the line from U_k to U_{k+1} and a *bulge*, whose inner coefficients
are h (D_k - S) / 3 and h (S - D_{k+1}) / 3; and v_t is the line from D_k to D_{k+1} and a bulge with
2 S - D_k - D_{k+1} for both. For coefficients that do not depend on time the residual r = v_t + L v is accordingly the
line between the values D_k + L U_k at the knots, and a bulge of degree 3 with inner coefficients made of these, so that

    r <= max(D_k + L U_k, D_{k+1} + L U_{k+1}) + max(0, both coefficients of the bulge).

What is at a knot serves two slabs. The bulge is small where steps are, and is looked at on fewer points.

On a cell let p be the tensor interpolant of one of these functions, r_j, at the cell's lattice points, of degree m
along each axis, with the Lebesgue constant C, the tail's constant c and gaps g of `splines.Sampling`, and h_i the
cell's widths. With drift and noise replaced by their own interpolants (`cell_fields`), whose errors are paid by the
size of v's derivatives,

    r_j <= max p(lattice) + g^2 / 8 sum_i max (-h_i^2 d_ii p)^+                    (chords, `most_of_interpolants`)
           + sum_i C^i c h_i^(m+1) sup |d_i^(m+1) r_j|                                     (the interpolation's error),

and d_i^(m+1) r_j is bounded term by term: d^(m+1) (F D) = sum_k binomial(m + 1, k) d^k F d^(m+1-k) D, d^(m+1) F = 0.

Where L = sum_g c_g(t, d) L_g (`products`), each c_g is a polynomial of degree q in the share of the slab, but for an
error (`factors`). Then both parts are products of polynomials, of degrees 1 + q and 3 + q: with the coefficients x_j of
one of the parts of v, of degree p,

    sum_g sum_{i+j=k} binomial(q, i) binomial(p, j) / binomial(p + q, k) c_gi L_g x_j,

means of products, so that the same bounds of sizes serve; the errors of c_g are paid by the size of L_g v.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import comb
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.values.kolmogorov.cell_fields import Field
from certbound.values.kolmogorov.factors import Factor
from certbound.values.kolmogorov.residual.images import Images
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


@dataclass(frozen=True, eq=False, kw_only=True)
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

    @cached_property
    def images(self) -> Images:
        """The sum of the operators, for compiled loops."""
        return Images.of(self.axes, [(orders, weight * field.lattice) for orders, field, weight, _ in self.terms])

    def at_lattice(self, coefficients: Array) -> Array:
        """v at the lattice points."""
        for k in reversed(range(len(self.axes))):
            coefficients = self.axes[k].on_lattice[0].along(coefficients, k + 1)
        return coefficients

    def on_lattice(self, coefficients: Array) -> tuple[Array, list[Array]]:
        """v and every L_g v at the lattice points."""
        n = len(self.axes)
        parts: dict[tuple[int, ...], Array] = {(): coefficients}
        wanted = {orders for orders, *_ in self.terms} | {(0,) * n}
        for axis in reversed(range(n)):  # most points are made along the first axis, where memory is contiguous behind
            new: dict[tuple[int, ...], Array] = {}
            for orders in {one[axis:] for one in wanted}:
                new[orders] = self.axes[axis].on_lattice[orders[0]].along(parts[orders[1:]], axis + 1)
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
            each = rates(unit(i, n, degree + 1)) if degree < DEGREE else np.zeros(())
            for orders, field, weight, g in self.terms:
                for k in range(len(field.slopes[i])):
                    higher = plus(orders, unit(i, n, degree + 1 - k))
                    if max(higher) <= DEGREE:
                        each = each + weight * large[g] * comb(degree + 1, k) * field.slopes[i][k] * sizes(higher)
            total = total + scale * axis.sampling.tail * width ** (degree + 1) * each
            scale *= axis.sampling.lebesgue
        return np.asarray(total)

    def roundoff(self, sizes: Sizes, rates: Sizes, speed: Array, large: Sequence[Array | float]) -> Array:
        """Per cell: what the rounding of r_j at its lattice points may come to; rates have up to ``speed`` times v."""
        zero = (0,) * len(self.axes)
        total = rates(zero) + speed * sizes(zero)
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
                sizes = [(part.size(orders)[rows], factor) for part, rows, factor in group]
                scaled = [one if isinstance(factor, float) and factor == 1.0 else factor * one for one, factor in sizes]
                sums.append(scaled[0] if len(scaled) == 1 else np.add.reduce(scaled))
            self.known[orders] = (sums[0] if len(sums) == 1 else np.maximum.reduce(sums)) * (1 + 1e-13)
        return self.known[orders]


def residual_bound(
    generator: Generator, sketch: Generator, values: Array, rates: Array, steps: Array,
    factors: Sequence[Factor | None] = (None,), *, worst: bool = True, clock: Array | None = None,
    knots: Array | None = None,
) -> Array:  # fmt: skip
    """A bound of v_t + L v from above on every cell of every slab.

    Parameters
    ----------
    generator, sketch : Generator
        On the same axes; the second with fewer points on a cell, for the bulges.
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
    knots : ndarray, shape (K + 1, N_1, ...), optional
        What `most_at_knots` proves, where it is known already.

    Returns
    -------
    ndarray, shape (K, N_1, ...)
    """
    n = len(generator.axes)
    h = steps.reshape(-1, *[1] * n)
    v, d = Derivatives(generator.axes, values), Derivatives(generator.axes, rates)
    whole, speeds = _sizes(v, d, values, h)
    large = [1.0 if one is None else one.size.reshape(h.shape) for one in factors]
    off = [np.zeros(()) if one is None else (one.spread + worst * one.between).reshape(h.shape) for one in factors]
    if all(one is None for one in factors):
        bound = _between_knots(most_at_knots(generator, values, rates) if knots is None else knots)
    else:
        ends, paces = (Sizes([[(one, _EARLY, 1.0)], [(one, _LATE, 1.0)]]) for one in (v, d))
        extra = generator.remainder(ends, paces, large, off) + generator.roundoff(whole, speeds, 8 / h, large)
        bound = _lines(generator, values, rates, factors, worst) + extra * _UP
    bulge, middle = _bulges(values, rates, h)
    parts = [Derivatives(generator.axes, one) for one in (*bulge, middle)]
    bends, turns = Sizes([[(one, _EVERY, 1.0)] for one in parts[:2]]), Sizes([[(parts[2], _EVERY, 1.0)]])
    more = _most_of_bulge(sketch, bulge, middle, factors)
    over = sketch.remainder(bends, turns, large, off) + sketch.roundoff(whole, speeds, 8 / h, large)
    bound = bound + np.maximum(more, 0.0) + over * _UP
    if clock is not None:
        bound = bound + clock.reshape(h.shape) * speeds((0,) * n) * _UP
    return np.asarray(bound)


def rough_residual(
    generator: Generator, values: Array, rates: Array, steps: Array, factors: Sequence[Factor | None] = (None,),
    *, worst: bool = True,
) -> tuple[Array, Array]:  # fmt: skip
    """About the same, from values at lattice points: what is left at knots, by the cells, and in between, by steps.

    Nothing is proved of it.
    """
    h = steps.reshape(-1, *[1] * len(generator.axes))
    lines = _lines(generator, values, rates, factors, worst, proved=False)
    bulge, middle = _bulges(values, rates, h)
    more = _most_of_bulge(generator, bulge, middle, factors, proved=False)
    at_knots = np.maximum(lines, 0.0)
    return at_knots, np.maximum(lines + np.maximum(more, 0.0), 0.0) - at_knots


_LATE, _EARLY, _EVERY = slice(None, -1), slice(1, None), slice(None)


def most_at_knots(generator: Generator, values: Array, rates: Array, *, proved: bool = True) -> Array:
    """A bound of v_t + L v from above on every cell at every knot, for coefficients that do not change.

    Parameters
    ----------
    values, rates : ndarray, shape (K, N_1 + 5, ...)
    proved : bool
        Or about that: the largest of the values on the lattice.

    Returns
    -------
    ndarray, shape (K, N_1, ...)
    """
    bound = generator.images.most(values, rates, proved=proved)
    if not proved:
        return bound
    sizes, paces = (Sizes([[(Derivatives(generator.axes, one), _EVERY, 1.0)]]) for one in (values, rates))
    ones, none = [1.0] * generator.products, [np.zeros(())] * generator.products
    extra = generator.remainder(sizes, paces, ones, none) + generator.roundoff(sizes, paces, np.zeros(()), ones)
    return np.asarray(bound + extra * _UP)


def _between_knots(bounds: Array) -> Array:
    return np.asarray(np.maximum(bounds[_EARLY], bounds[_LATE]))


def _lines(
    generator: Generator, values: Array, rates: Array, factors: Sequence[Factor | None], worst: bool,
    proved: bool = True,
) -> Array:  # fmt: skip
    """The most of the interpolants of v_t + L v with what is linear between the knots, on every cell of every slab."""
    if all(one is None for one in factors):
        return _between_knots(most_at_knots(generator, values, rates, proved=proved))
    _, images = generator.on_lattice(values)
    pace = generator.at_lattice(rates)
    shares = [[image[_EARLY], image[_LATE]] for image in images]
    return _most(_combined([pace[_EARLY], pace[_LATE]], shares, factors), generator.axes, worst, proved)


def _bulges(values: Array, rates: Array, h: Array) -> tuple[list[Array], Array]:
    """Coefficients of the inner coefficients, in time, of the bulge of v, and of those of the bulge of v_t."""
    mean = (values[_LATE] - values[_EARLY]) / h
    early, late = rates[_EARLY] - mean, mean - rates[_LATE]
    return [h / 3 * early, h / 3 * late], late - early


def _most_of_bulge(
    generator: Generator, bulge: list[Array], middle: Array, factors: Sequence[Factor | None], proved: bool = True
) -> Array:  # fmt: skip
    """The most of the bulge's interpolants on every cell of every slab, whichever disturbance is best."""
    if all(one is None for one in factors):
        return np.asarray(np.maximum(*(generator.images.most(one, middle, proved=proved) for one in bulge)))
    return _most(_products(generator, bulge, middle, factors), generator.axes, True, proved)


def _products(
    generator: Generator, bulge: list[Array], middle: Array, factors: Sequence[Factor | None]
) -> list[list[Array]]:  # fmt: skip
    """Coefficients in time of the bulge of v_t + sum_g c_g L_g v at lattice points, for each disturbance's node."""
    _, first = generator.on_lattice(bulge[0])
    _, second = generator.on_lattice(bulge[1])
    pace = generator.at_lattice(middle)
    none = np.zeros_like(pace)
    shares = [[none, one, other, none] for one, other in zip(first, second)]
    return _combined([none, pace, pace, none], shares, factors)


def _combined(
    pace: list[Array], images: list[list[Array]], factors: Sequence[Factor | None]
) -> list[list[Array]]:  # fmt: skip
    """Bernstein coefficients of v_t + sum_g c_g L_g v, from those of its parts."""
    n = pace[0].ndim - 1
    degree = len(pace) - 1 + max((0 if one is None else one.degree for one in factors), default=0)
    moved = [_raised(pace, degree)]
    for factor, image in zip(factors, images):
        if factor is None:
            shares = [_raised(image, degree)]
        else:
            rows = factor.bernstein.reshape(*factor.bernstein.shape, *[1] * n)
            shares = [_product([row[:, i] for i in range(factor.degree + 1)], image, degree) for row in rows]
        if len(moved) < len(shares):
            moved = moved * len(shares)
        moved = [[a + b for a, b in zip(one, shares[v % len(shares)])] for v, one in enumerate(moved)]
    return moved


def _most(moved: list[list[Array]], axes: tuple[Axis, ...], worst: bool, proved: bool = True) -> Array:
    """The most on every cell over coefficients in time, and over disturbances or for the best of them."""
    most = most_of_interpolants if proved else over_cells
    bounds = [np.maximum.reduce([most(axes, r) for r in one]) for one in moved]
    return np.asarray(np.maximum.reduce(bounds) if worst else np.minimum.reduce(bounds))


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


def _sizes(v: Derivatives, d: Derivatives, values: Array, h: Array) -> tuple[Sizes, Sizes]:
    """Bounds of the derivatives of the Bernstein coefficients of v, and of those of v_t.

    The middle one of v_t is 3 (U_{k+1} - U_k) / h - D_k - D_{k+1}.
    """
    change = Derivatives(v.axes, (values[_LATE] - values[_EARLY]) * (3 / h))
    sizes = Sizes([[(v, _EARLY, 1.0), (d, _EARLY, h / 3)], [(v, _LATE, 1.0), (d, _LATE, h / 3)]])
    speeds = Sizes([[(change, _EVERY, 1.0), (d, _EARLY, 1.0), (d, _LATE, 1.0)]])
    return sizes, speeds
