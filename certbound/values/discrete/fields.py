"""The mean of a value function after the noise, as a function of where the noise-free step ends.

For U of ``functions`` and w = diag(s) xi + e zeta of ``shocks``,
    h(m) = E U(m + w)
is tabulated with its first and second derivatives on a mesh, by products of the axes' matrices; between the nodes it
is interpolated, or bounded. All errors are measured by one more table,
    H(m) >= int A(y) prod_i phi_{kappa s_i}(y_i - m_i) dy  (mixed over zeta),   A >= the parts of |U|,
since |d^alpha h| <= prod_i A_{alpha_i}(rho_i) s_i^{-alpha_i} H(m_0) where |m_i - m_0i| <= rho_i s_i (``dominance``).
The common factor is mixed by the trapezoidal rule with step eta, whose shifts e eta are whole numbers of mesh steps.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.rigor.rounding import product_error
from certbound.values.discrete.dominance import density_tail, dominance
from certbound.values.discrete.functions import ValueFunction
from certbound.values.discrete.kernels import REACH, AxisKernel, axis_kernel
from certbound.values.discrete.shocks import Inapplicable, Shocks
from certbound.values.grids import Grid, corners

POINTS = 8
"""Points of the interpolation between the mesh's nodes."""
FINENESS = 6.0
"""Mesh steps per standard deviation."""
_MOST_POINTS = 6_000_000
_UNIT = 2.0**-53
_DECAY = 34.5  # -log of the trapezoidal rule's error


Part = tuple[tuple[str, ...], Array]
"""One basis function for every axis, and its coefficients."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Mesh:
    """Equidistant points on every axis.

    Parameters
    ----------
    start, step : ndarray, shape (n,)
        First point and distance.
    count : tuple of int
        Points.
    """

    start: Array
    step: Array
    count: tuple[int, ...]

    def __post_init__(self) -> None:
        if math.prod(self.count) > _MOST_POINTS:
            raise Inapplicable(
                f"value functions would need tables of more than {_MOST_POINTS} entries: the safe set is very many "
                "standard deviations of the noise wide. Use another engine, which is at its best there."
            )

    def points(self, axis: int) -> Array:
        """Points of one axis."""
        return np.asarray(self.start[axis] + self.step[axis] * np.arange(self.count[axis]))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Field:
    """h on a mesh. ``tables[alpha]`` is d^alpha h up to ``error[alpha]`` H + ``floor[alpha]``."""

    mesh: Mesh
    tables: dict[tuple[int, ...], Array]
    dominant: Array
    error: dict[tuple[int, ...], float]
    floor: dict[tuple[int, ...], float]
    largest: float
    """At least sup |U|, and at least 1."""


def orders_up_to(total: int, dimension: int) -> list[tuple[int, ...]]:
    """Multi-indices of at most that order."""
    return [a for a in itertools.product(range(total + 1), repeat=dimension) if sum(a) <= total]


class Tables:
    """What turns value functions on one grid into fields on one mesh.

    Parameters
    ----------
    grid : Grid
        Of the value functions.
    shocks : Shocks
        The noise.
    low, high : ndarray, shape (n,)
        Ends of a box around the noise-free images.
    fineness : float
        Mesh steps per standard deviation.
    cubic : bool
        Whether functions may have second derivatives at the nodes.
    """

    def __init__(
        self, grid: Grid, shocks: Shocks, low: Array, high: Array, *, fineness: float = FINENESS, cubic: bool = False
    ) -> None:
        n = grid.dimension
        self.cubic = cubic
        self.grid, self.shocks, self.n = grid, shocks, n
        self.sigma = shocks.sigma.mid
        self.spread = float((shocks.sigma.rad / self.sigma).max()) + 2 * _UNIT
        self.factor = shocks.factor.mid
        self.eta, self.hops = self._trapezoid(fineness)
        step = self._steps(fineness)
        starts, counts = [], []
        for i in range(n):
            reach = REACH * float(
                self.sigma[i] + abs(self.factor[i])
            )  # beyond it U(m + w) = 1 but for the noise's tails
            floor, ceiling = grid.axes[i][0] - reach, grid.axes[i][-1] + reach
            first, last = (min(max(float(end[i]), floor), ceiling) for end in (low, high))
            number = max(2, math.ceil((last - first) / step[i]) + 1)
            starts.append(first - (POINTS // 2) * step[i])
            counts.append(number + POINTS)
        self.mesh = Mesh(start=np.array(starts), step=step, count=tuple(counts))
        self.kernels = [self._kernel(i) for i in range(n)]
        self._beside: dict[int, list[tuple[tuple[int, ...], Array]]] = {}
        self._constants()

    # ---- the common factor -----------------------------------------------------------------------------------

    def _trapezoid(self, fineness: float) -> tuple[float, int]:
        if not self.shocks.common:
            return 1.0, 0
        ratio = 1 + 2 * float(np.sum((self.factor / self.sigma) ** 2)) * (1 + 1e-9)
        eta = math.pi * math.sqrt(2 / (ratio * _DECAY))
        return eta, math.ceil(REACH / eta)

    def _steps(self, fineness: float) -> Array:
        step = self.sigma / fineness
        self.jump = np.zeros(self.n, dtype=int)
        for i in range(self.n):
            if self.factor[i]:
                hop = abs(self.factor[i]) * self.eta
                self.jump[i] = max(1, math.ceil(hop / step[i] - 1e-9))
                step[i] = hop / self.jump[i]
        return np.asarray(step)

    def _extended(self, i: int) -> Array:
        """The mesh's points of one axis, with those that the common factor reaches."""
        more = self.hops * int(self.jump[i])
        index = np.arange(-more, self.mesh.count[i] + more)
        return np.asarray(self.mesh.start[i] + self.mesh.step[i] * index)

    def _kernel(self, i: int) -> AxisKernel:
        return axis_kernel(self._extended(i), self.grid.axes[i], float(self.sigma[i]), self.spread, cubic=self.cubic)

    def _mixed(self, table: Array) -> Array:
        """The sum over the common factor's values of the shifted table."""
        if not self.shocks.common:
            return table
        total = np.zeros(self.mesh.count)
        for k in range(-self.hops, self.hops + 1):
            weight = self.eta * math.exp(-0.5 * (k * self.eta) ** 2) / math.sqrt(2 * math.pi)
            window = []
            for i in range(self.n):
                more = self.hops * int(self.jump[i])
                first = more + k * int(self.jump[i]) * (1 if self.factor[i] > 0 else -1)
                window.append(slice(first, first + self.mesh.count[i]))
            total += weight * table[tuple(window)]
        return total

    # ---- errors ----------------------------------------------------------------------------------------------

    def _constants(self) -> None:
        """``error`` and ``floor`` of every order up to 2."""
        n = self.n
        entry = max(kernel.error for kernel in self.kernels)
        terms = max(max(self.grid.node_shape), 2)
        gamma = product_error(terms)[0] + 16 * _UNIT
        self.error, self.tail = {}, {}
        for alpha in orders_up_to(2, n):
            bound = [dominance(a) for a in alpha]
            exact = math.prod(bound)
            wrong = math.prod(b + entry for b in bound) - exact
            rounding = (n + 1) * gamma * math.prod(b + entry for b in bound)
            relative = 2**n * (n + 2) * (wrong * (1 + 1e-9) + rounding) + self._mixing_error(alpha)
            scale = math.prod(float(self.sigma[i]) ** -alpha[i] for i in range(n))
            self.error[alpha] = relative * scale * (1 + 1e-9)
            self.tail[alpha] = self.beyond(alpha) * scale

    def _mixing_error(self, alpha: tuple[int, ...]) -> float:
        """Of the trapezoidal rule, by Cauchy's estimate on polydiscs of radii s_i; and of inexact shifts."""
        if not self.shocks.common:
            return 0.0
        rule = 2.1 * math.exp(-_DECAY + self.n) * dominance(0, 1.0) ** self.n * 1.01 * 2
        size = np.array([max(abs(kernel.points[0]), abs(kernel.points[-1])) for kernel in self.kernels])
        off = 8 * _UNIT * size + (self.hops * self.eta) * (self.shocks.factor.rad + 8 * _UNIT * np.abs(self.factor))
        moved = 0.0
        for i in range(self.n):
            raised = [a + (1 if k == i else 0) for k, a in enumerate(alpha)]
            moved += float(off[i] / self.sigma[i]) * math.prod(dominance(a, 1 / 64) for a in raised)
        return rule + moved + 64 * self.hops * _UNIT * math.prod(dominance(a) for a in alpha)

    def beyond(self, alpha: tuple[int, ...]) -> float:
        """What lies beyond ``REACH`` in some axis, relative to sup |U|, in units of prod s_i^-alpha_i."""
        total = 0.0
        for i in range(self.n):
            term = density_tail(alpha[i], REACH - 1)
            for k in range(self.n):
                term *= 1.0 if k == i else math.sqrt(math.factorial(alpha[k])) + 1e-9  # E |He_k| <= sqrt(k!)
            total += term
        if self.shocks.common:
            total += density_tail(0, REACH - 1) * math.prod(math.sqrt(math.factorial(a)) + 1e-9 for a in alpha)
        return 2 * total

    # ---- fields ----------------------------------------------------------------------------------------------

    def field(self, value: ValueFunction, *, order: int = 2) -> Field:
        """h and its derivatives up to an order of 0 or 2."""
        raw = self._raw(value, order)
        size = value.size()
        dominant = self._mixed(self._dominating(size)) * 1.001
        largest = max(1.0, float(size.max()))
        tables = {alpha: self._mixed(part) for alpha, part in raw.items()}
        floor = {alpha: 6 * largest * tail for alpha, tail in self.tail.items()}
        return Field(mesh=self.mesh, tables=tables, dominant=dominant, error=self.error, floor=floor, largest=largest)

    def means(self, value: ValueFunction) -> Array:
        """h alone, before the common factor."""
        return self._raw(value, 0)[(0,) * self.n]

    def _raw(self, value: ValueFunction, order: int) -> dict[tuple[int, ...], Array]:
        """Sums over the grid of what the parts of the function contribute, and what lies outside."""
        raw = self._contract(self._parts(value), order)
        if value.beyond:
            for alpha, part in self._outside(order):
                raw[alpha] = raw[alpha] + value.beyond * part
        return raw

    def _parts(self, value: ValueFunction) -> list[Part]:
        """The function as a sum: the multilinear part, on fixed cells the constant instead, and parabolas or cubics."""
        names: list[tuple[str, ...]] = [("hat",) * self.n]
        found = [value.nodal]
        if value.fixed is not None and value.fixed.any():
            names = list(itertools.product(("left", "right"), repeat=self.n))
            found = [np.where(value.fixed, value.level, corner) for corner in corners(value.nodal)]
        for i in range(self.n):
            if np.any(value.bend[i]):
                own, other = ("cubic", "hat") if value.curved else ("bubble", "whole")
                names.append(tuple(own if k == i else other for k in range(self.n)))
                found.append(-value.bend[i])
        return list(zip(names, found, strict=True))

    def _contract(self, parts: list[Part], order: int) -> dict[tuple[int, ...], Array]:
        """All derivatives up to the order of a sum of tensors, each against one basis function an axis.

        Axis by axis: what has the same basis functions along all later axes is added up before them.
        """
        sums = {((), names): tensor for names, tensor in parts}
        for axis, kernel in enumerate(self.kernels):
            found: dict[Any, Array] = {}
            for (alpha, (name, *rest)), tensor in sums.items():
                for a, table in enumerate(kernel.apply(name, tensor, axis, order - sum(alpha) + 1)):
                    key = (*alpha, a), tuple(rest)
                    if key in found:
                        found[key] += table
                    else:
                        found[key] = table
            sums = found
        return {alpha: table for (alpha, _), table in sums.items()}

    def _outside(self, order: int) -> list[tuple[tuple[int, ...], Array]]:
        """Derivatives of the probability of landing outside the grid: out_1 + in_1 out_2 + in_1 in_2 out_3."""
        if order in self._beside:
            return self._beside[order]
        found = []
        for alpha in orders_up_to(order, self.n):
            total = np.zeros([len(kernel.points) for kernel in self.kernels])
            for last in range(self.n):
                if any(alpha[last + 1 :]):
                    continue
                term = np.ones([1] * self.n)
                for i in range(last + 1):
                    out = self.kernels[i].outside[alpha[i]]
                    line = out if i == last else ((1 - out) if alpha[i] == 0 else -out)
                    term = term * line.reshape([-1 if k == i else 1 for k in range(self.n)])
                total = total + term
            found.append((alpha, total))
        self._beside[order] = found
        return found

    def _dominating(self, size: Array) -> Array:
        table = size
        for axis in range(self.n):
            table = np.moveaxis(self.kernels[axis].apply_mass(np.moveaxis(table, axis, 0)), 0, axis)
        for i, kernel in enumerate(self.kernels):
            table = table + kernel.outside_mass.reshape([-1 if k == i else 1 for k in range(self.n)])
        return table
