"""phi(x) = E U(m(x) + sqrt(S(x)) xi) for independent normal xi: values at nodes, second derivatives over cells.

As a function h of m and S it solves heat equations, dh/dS_a = (1/2) d^2h/dm_a^2 (where S_a > 0, for every bounded U),
so that every derivative of phi by x is a sum of derivatives of h by m. With the symbol
    q_B = sum_a d_B m_a X_a + (1/2) d_B S_a X_a^2,  X_a standing for d/dm_a,
that sum is the Bell polynomial P_alpha(X) = sum over partitions of alpha into blocks of prod q_B. At the nodes h is
integrated up to fourth derivatives, which gives g = d_ii phi there; over a cell with sides delta g lies between its
corners, up to sum_j delta_j^2/8 sup |d_jj d_ii phi|. In that d^beta h (of up to the eighth order) is dominated by
    |d^beta h(m, S)| <= prod_a A_{beta_a}(rho_a, tau_a) S_0a^(-beta_a/2) H(m_0, S_0)
of the corner of the cell that is nearest (``dominance``), |m_a - m_0a| <= rho_a sqrt(S_0a) and S_a between
S_0a/tau_a^2 and S_0a tau_a^2.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from certbound.arrays import Array, Integers, Mask
from certbound.rigor.intervals import Interval
from certbound.rigor.rounding import product_error
from certbound.values.discrete.dominance import dominance
from certbound.values.discrete.fields import Part, Tables, orders_up_to
from certbound.values.discrete.functions import ValueFunction
from certbound.values.discrete.kernels import AxisKernel, axis_kernel
from certbound.values.discrete.scaled.scaled_motion import Alpha, Jets, ScaledDynamics, cells_and_nodes
from certbound.values.discrete.shocks import Inapplicable, Shocks
from certbound.values.discrete.steps import CellImages, Step
from certbound.values.grids import Grid, corners, over_corners

_UNIT = 2.0**-53
_SHIFTS = (1 / 16, 1 / 8, 1 / 4, 3 / 8, 1 / 2)
_STRETCHES = (1.005, 1.02, 1.05)
_EXACT = 1e-10  # to which means and variances at nodes are known, in units of the noise
_MOST_ENTRIES = 150_000_000  # of kernels, a gigabyte
_ORDER = 4

Symbol = dict[Alpha, Any]
"""A polynomial in X: exponents to coefficients, one for every box."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ScaledField:
    """d^alpha h at the nodes, up to ``error[alpha]`` H + ``floor[alpha]``, both in units of prod s_a^-alpha_a."""

    tables: dict[Alpha, Array]
    dominant: Array
    error: dict[Alpha, float]
    floor: dict[Alpha, float]
    largest: float


class ScaledTables(Tables):
    """What turns value functions on one grid into their means from points with variances of their own; see ``Tables``.

    Parameters
    ----------
    grid : Grid
        Of the value functions.
    mean, size : ndarray, shape (P, n)
        Means and standard deviations, the latter known up to the relative error ``spread``.
    """

    def __init__(self, grid: Grid, mean: Array, size: Array, spread: float) -> None:
        self.grid, self.n = grid, grid.dimension
        self.mean, self.size, self.spread = mean, size, spread
        typical = np.median(size, axis=0)
        self.shocks = Shocks(sigma=Interval.point(typical), factor=Interval.point(np.zeros(self.n)))
        wide = [20 * float(typical[i]) / float(np.median(np.diff(grid.axes[i]))) for i in range(self.n)]
        entries = [min(one, len(axis)) for one, axis in zip(wide, grid.axes)]
        if 3 * (_ORDER + 1) * len(mean) * sum(entries) > _MOST_ENTRIES:
            raise Inapplicable("value functions would need kernels of more than a gigabyte.")
        self._sided = False
        self.kernels = self._kernels()
        self._constants()

    def _kernels(self) -> list[AxisKernel]:
        return [
            axis_kernel(
                self.mean[:, i], self.grid.axes[i], self.size[:, i], self.spread, orders=_ORDER + 1, sides=self._sided
            )
            for i in range(self.n)
        ]

    def _constants(self) -> None:
        entry = max(kernel.error for kernel in self.kernels)
        gamma = product_error(max(*self.grid.node_shape, 2))[0] + 16 * _UNIT
        n, self.error, self.tail = self.n, {}, {}
        for alpha in orders_up_to(_ORDER, n):
            bound = [dominance(a) for a in alpha]
            wrong = math.prod(b + entry for b in bound) - math.prod(bound)
            rounding = (n + 1) * gamma * math.prod(b + entry for b in bound)
            moved = _EXACT * sum(
                math.prod(dominance(a + more * (k == i), 1 / 16, stretch=1.005) for k, a in enumerate(alpha))
                for i in range(n)
                for more in (1, 2)
            )
            self.error[alpha] = (2**n * (n + 2) * (wrong * (1 + 1e-9) + rounding) + moved) * (1 + 1e-9)
            self.tail[alpha] = self.beyond(alpha)

    def field(self, value: ValueFunction, *, order: int = _ORDER) -> ScaledField:  # type: ignore[override]
        """h and its derivatives, up to order 0 or 4."""
        tables = self._raw(value, _ORDER if order else 0)
        size = value.size()
        dominant = self._dominating(size) * 1.001
        largest = max(1.0, float(size.max()))
        floor = {alpha: 6 * largest * tail for alpha, tail in self.tail.items()}
        return ScaledField(
            tables=tables, dominant=dominant, error=self.error, floor=floor, largest=largest
        )

    def _contract(self, parts: list[Part], order: int) -> dict[Alpha, Array]:
        if not self._sided and any("left" in names for names, _ in parts):
            self._sided = True
            self.kernels = self._kernels()
        found = np.zeros((order + 1, order + 1, len(self.mean)))
        for one, two in zip(*(kernel.blocks for kernel in self.kernels), strict=True):
            for names, tensor in parts:
                first, second = one.parts[names[0]][: order + 1], two.parts[names[1]][: order + 1]
                window = tensor[one.left : one.left + first.shape[2], two.left : two.left + second.shape[2]]
                half = (first.reshape(-1, first.shape[2]) @ window).reshape(*first.shape[:2], -1)
                found[:, :, one.first : one.last] += np.einsum("arl,brl->abr", half, second)
        return {alpha: found[alpha] for alpha in orders_up_to(order, 2)}

    def _outside(self, order: int) -> list[tuple[Alpha, Array]]:
        found = []
        for alpha in orders_up_to(order, self.n):
            total = np.zeros(len(self.mean))
            for last in range(self.n):
                if not any(alpha[last + 1 :]):
                    term = self.kernels[last].outside[alpha[last]]
                    for i in range(last):
                        out = self.kernels[i].outside[alpha[i]]
                        term = term * ((1 - out) if alpha[i] == 0 else -out)
                    total = total + term
            found.append((alpha, total))
        return found

    def _dominating(self, size: Array) -> Array:
        table = np.empty(len(self.mean))
        for one, two in zip(*(kernel.blocks for kernel in self.kernels), strict=True):
            window = size[one.left : one.right, two.left : two.right]
            table[one.first : one.last] = ((one.mass @ window) * two.mass).sum(axis=1)
        return table + self.kernels[0].outside_mass + self.kernels[1].outside_mass


class ScaledTransition:
    """One step from a grid into the next function, but for cells ``left_out``; offers what ``Transition`` does."""

    def __init__(self, dynamics: ScaledDynamics, t: int, grid: Grid, after: Grid, left_out: Mask) -> None:
        self.n, self._grid = grid.dimension, grid
        cells, nodes = cells_and_nodes(dynamics, t, grid)
        zero = (0,) * self.n
        mean, variance = _halves(nodes.parts[zero])
        middle = np.where(variance.lo > 0, variance.mid, 1.0)
        size = np.sqrt(middle)
        exact = nodes.sure & np.all((variance.lo > 0) & (variance.rad <= _EXACT * middle), axis=1)
        self._usable = exact & np.all(mean.rad <= _EXACT * size, axis=1)
        typical = np.median(size[self._usable], axis=0) if self._usable.any() else np.ones(self.n)
        size = np.where(self._usable[:, None], size, typical)
        centre = np.where(self._usable[:, None], np.nan_to_num(mean.mid), np.array([axis[0] for axis in after.axes]))
        self._size = size
        self.tables = ScaledTables(after, centre, size, dynamics.spread)
        self._second = [_bell(nodes.parts, (i, i), zero) for i in range(self.n)]
        self.step = self._prepared(cells, left_out)

    def _prepared(self, cells: Jets, left_out: Mask) -> Step:
        """The step without images; also what d_jj d_ii phi is at most over each cell, in units of H at its corners."""
        grid, n, zero = self._grid, self.n, (0,) * self.n
        sizes = self._size.reshape(*grid.node_shape, n)
        least = [over_corners(np.minimum, sizes[..., i]).ravel() for i in range(n)]
        sure = np.logical_and.reduce(corners(self._usable.reshape(grid.node_shape))).ravel() & cells.sure
        shift, stretch = np.zeros((n, len(sure))), np.ones((n, len(sure)))
        halves = [np.broadcast_to(grid.widths(j) / 2, grid.shape).ravel() for j in range(n)]  # to the nearest corner
        for i in range(n):
            moved = [sum(cells.parts[_unit(j, n)].mag[:, row] * halves[j] for j in range(n)) for row in (i, n + i)]
            shift[i] = moved[0] / least[i] + 2 * _EXACT
            share = np.minimum(moved[1] / least[i] ** 2 + 2 * _EXACT, 0.5)
            stretch[i] = 1 / np.sqrt(1 - share)
        kinds = [np.searchsorted(_SHIFTS, shift * (1 + 1e-9)), np.searchsorted(_STRETCHES, stretch * (1 + 1e-9))]
        sure &= np.all((kinds[0] < len(_SHIFTS)) & (kinds[1] < len(_STRETCHES)), axis=0)
        kinds = [np.minimum(kinds[0], len(_SHIFTS) - 1), np.minimum(kinds[1], len(_STRETCHES) - 1)]
        if not np.all(sure | left_out.ravel()):
            raise Inapplicable(
                "value functions that are smooth need a smooth model, and noise on every state wherever paths may be "
                "that does not change much over a cell."
            )
        largest = {alpha: np.where(sure[:, None], part.mag, 0.0) for alpha, part in cells.parts.items()}
        self._fourth = [[self._dominated(_bell(largest, (i, i, j, j), zero), least, kinds) for j in range(n)]
                        for i in range(n)]  # fmt: skip
        empty = Interval.point(np.zeros((len(sure), n, n)))
        image = Interval.point(np.zeros((len(sure), n)))
        images = CellImages(image=image, slopes=empty, bends=empty, defined=sure, steady=sure, smooth=sure)
        return Step(grid=grid, vertices=[], cells=[images], pieces=np.empty((1, 0)))

    def _dominated(self, symbol: Symbol, least: list[Array], kinds: list[Integers]) -> tuple[Array, Array]:
        """sum_beta |P_beta| times bounds of d^beta h: in units of H, and of what lies beyond the kernels' reach."""
        near, beyond = np.zeros(len(least[0])), np.zeros(len(least[0]))
        top = 1 + max(max(beta) for beta in symbol)
        factor = np.empty((self.n, top, len(least[0])))
        for i in range(self.n):
            pairs, place = np.unique(np.stack([kind[i] for kind in kinds]), axis=1, return_inverse=True)
            for order in range(top):
                bound = [dominance(order, _SHIFTS[a], stretch=_STRETCHES[b]) for a, b in pairs.T]
                factor[i, order] = np.array(bound)[place.ravel()]
        for beta, weight in symbol.items():
            scaled = weight * math.prod(least[i] ** -beta[i] for i in range(self.n))
            near += scaled * math.prod(factor[i, beta[i]] for i in range(self.n))
            beyond += scaled * (12 * self.tables.beyond(beta))
        return near * (1 + 1e-9), beyond * (1 + 1e-9)

    def at_nodes(self, field: ScaledField) -> list[tuple[Array, Array]]:
        """phi at the nodes, and a bound of its error (inf where the step is undefined)."""
        zero, shape = (0,) * self.n, self._grid.node_shape
        error = np.where(self._usable, (field.error[zero] * field.dominant + field.floor[zero]) * (1 + 1e-9), np.inf)
        return [(field.tables[zero].reshape(shape), error.reshape(shape))]

    def bends(self, field: ScaledField, variables: range, *, above: bool) -> list[list[Array]]:
        """Per variable: the least (else largest) second derivative of phi over every cell."""
        shape = self._grid.node_shape
        units = {alpha: math.prod(self._size[:, i] ** -alpha[i] for i in range(self.n)) for alpha in field.tables}
        close = over_corners(np.maximum, field.dominant.reshape(shape)).ravel()
        found = []
        for i in variables:
            value, error = np.zeros(len(self._size)), np.zeros(len(self._size))
            for beta, factor in self._second[i].items():
                value += factor.mid * field.tables[beta]
                bound = math.prod(dominance(b) for b in beta) * (1 + 1e-6)
                loose = factor.rad * bound + factor.mag * (field.error[beta] + 128 * _UNIT * bound)
                error += (loose * field.dominant + 2 * factor.mag * field.floor[beta]) * units[beta]
            error = np.where(self._usable, error * (1 + 1e-9), 0.0)
            value = np.where(self._usable, value, 0.0)
            slack = np.zeros(len(close))
            for j in range(self.n):
                near, beyond = self._fourth[i][j]
                width = np.broadcast_to(self._grid.widths(j), self._grid.shape).ravel()
                slack += width**2 / 8 * (near * close + beyond * field.largest)
            slack *= 1 + 1e-9
            pick, sign = (np.minimum, -1) if above else (np.maximum, 1)
            found.append(over_corners(pick, (value + sign * error).reshape(shape)).ravel() + sign * slack)
        return [found]


def _halves(rows: Interval) -> tuple[Interval, Interval]:
    n = rows.shape[1] // 2
    return rows[:, :n], rows[:, n:]


def _unit(j: int, n: int) -> Alpha:
    return tuple(int(k == j) for k in range(n))


def _bell(parts: dict[Alpha, Any], slots: tuple[int, ...], zero: Alpha) -> Symbol:
    """P_alpha, alpha given as a list of variables: the sum over all partitions of the list of products of symbols."""
    total: Symbol = {}
    for blocks in _partitions(list(range(len(slots)))):
        product: Symbol = {}
        for block in blocks:
            order = list(zero)
            for slot in block:
                order[slots[slot]] += 1
            symbol = _symbol(parts[tuple(order)], len(zero))
            product = _times(product, symbol) if product else symbol
        for beta, factor in product.items():
            total[beta] = total[beta] + factor if beta in total else factor
    return total


def _symbol(rows: Any, n: int) -> Symbol:
    found: Symbol = {}
    for a in range(n):
        found[_unit(a, n)] = rows[:, a]
        found[tuple(2 * b for b in _unit(a, n))] = rows[:, n + a] * 0.5
    found = {beta: factor for beta, factor in found.items() if np.any(_magnitude(factor))}
    return found or {(0,) * n: rows[:, 0] * 0.0}


def _magnitude(factor: Any) -> Array:
    return np.asarray(factor.mag if isinstance(factor, Interval) else factor)


def _times(first: Symbol, second: Symbol) -> Symbol:
    found: Symbol = {}
    for (a, x), (b, y) in itertools.product(first.items(), second.items()):
        beta = tuple(p + q for p, q in zip(a, b))
        found[beta] = found[beta] + x * y if beta in found else x * y
    return found


def _partitions(items: list[int]) -> list[list[list[int]]]:
    """All partitions of a list."""
    if not items:
        return [[]]
    found = []
    for rest in _partitions(items[1:]):
        found.append([[items[0]], *rest])
        found += [[*rest[:k], [items[0], *rest[k]], *rest[k + 1 :]] for k in range(len(rest))]
    return found
