"""The function V that is proposed and then proved: floats at nodes, smooth whatever they are.

V(t, x) is the piecewise polynomial that takes given values, first and second derivatives at the nodes of a grid (degree
5 in each state), and given values and rates at the ends of slabs of time (degree 3). The data are shared by
neighbouring cells and slabs, so that V is twice continuously differentiable in x, continuous in t and continuously
differentiable in t on each slab for *any* finite data: a wrong proposal can only cost tightness.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.values.continuous.residual import Patches, along, value_range
from certbound.values.polynomials import CUBIC_HERMITE, HERMITE, QUARTERS
from certbound.watch import poll


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Surface:
    """Hermite data of V over a grid; one or two states.

    Attributes
    ----------
    axes : tuple of ndarray
        Rising nodes of each state, N_i + 1 of them.
    times : ndarray, shape (K + 1,)
        Rising ends of the slabs.
    values : ndarray, shape (K + 1, N_1 + 1, 3[, N_2 + 1, 3])
        V and its derivatives by order in each state, at the ends of the slabs.
    start_rates, end_rates : ndarray, shape (K, N_1 + 1, 3[, N_2 + 1, 3])
        Time derivatives of the same at the start and at the end of each slab.

    Raises
    ------
    ValueError
        Nodes or times that do not rise, or data that are not finite.
    """

    axes: tuple[Array, ...]
    times: Array
    values: Array
    start_rates: Array
    end_rates: Array

    def __post_init__(self) -> None:
        for name, nodes in (("times", self.times), *(("axes", axis) for axis in self.axes)):
            if not np.all(np.diff(nodes) > 0):
                raise ValueError(f"`{name}` must rise strictly.")
        for name in ("values", "start_rates", "end_rates"):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"`{name}` must be finite everywhere.")

    @property
    def slabs(self) -> int:
        """Number of slabs K."""
        return len(self.times) - 1

    @property
    def cells(self) -> tuple[int, ...]:
        """Number of cells along each state."""
        return tuple(len(axis) - 1 for axis in self.axes)

    @property
    def steps(self) -> Array:
        """Lengths of the slabs, correctly rounded."""
        return np.diff(self.times)

    def raised(self, shift: float) -> Surface:
        """V + shift (each value rounded: another V, as good as this one)."""
        values = self.values.copy()
        values[(slice(None), *(slice(None), 0) * len(self.axes))] += shift
        return replace(self, values=values)

    def refined(self, longest: float) -> Surface:
        """About the same V with slabs cut in equal parts, none longer than that: another V, as good as this one."""
        times, values, starts, ends = [self.times[:1]], [self.values[:1]], [], []
        for k, step in enumerate(self.steps):
            parts = max(1, math.ceil(step / longest))
            s = np.arange(parts + 1).reshape(-1, *([1] * (self.values.ndim - 1))) / parts
            a, b, p, q = self.values[k], self.values[k + 1], step * self.start_rates[k], step * self.end_rates[k]
            curve = a + s * (p + s * (3 * (b - a) - 2 * p - q + s * (2 * (a - b) + p + q)))
            rates = (p + s * (2 * (3 * (b - a) - 2 * p - q) + 3 * s * (2 * (a - b) + p + q))) / step
            curve[-1] = b
            times.append(np.append(self.times[k] + step * np.arange(1, parts) / parts, self.times[k + 1]))
            values.append(curve[1:])
            starts.append(rates[:-1])
            ends.append(rates[1:])
        return replace(
            self, times=np.concatenate(times), values=np.concatenate(values), start_rates=np.concatenate(starts),
            end_rates=np.concatenate(ends),
        )  # fmt: skip

    def readings(
        self, slabs: Sequence[int], near: tuple[float, float, float] | None, *, up: bool
    ) -> Iterator[tuple[float, int, tuple[Array, ...], Array]]:
        """Times at or in some slabs, each with its slab, nodes, and a bound of V over their cells.

        Without ``near`` all cells at the start of every slab. With (longest, low, high), in one state, times that are
        ``longest`` apart at most, and after the first one only the cells that meet [low, high]. V and its derivatives
        are cubics in time, of which `refined` makes no more than some roundoffs of the four numbers that each is made
        of; the time itself is off by one of the last time.
        """
        for k in slabs if near is None else slabs[:1]:
            time = float(self.times[k])
            if up and len(self.axes) > 1:
                yield time, k, *self.ceiling_at(k)
            else:
                yield time, k, self.axes, self.range_at(k)[up]
        if near is None:
            return
        nodes, (longest, *ends) = self.axes[0], near
        first = max(int(np.searchsorted(nodes, ends[0])) - 1, 0)
        part = self._cut(slice(first, int(np.searchsorted(nodes, ends[1], side="right")) + 1))
        fine, sign = part.refined(longest), 1 if up else -1
        owners = np.searchsorted(self.times, fine.times[:-1], side="right") - 1
        for j in np.flatnonzero(np.isin(owners, list(slabs)))[1:].tolist():
            k = int(owners[j])
            yield float(fine.times[j]), k, fine.axes, fine.range_at(j)[up] + sign * part._roundoff(k)

    def _cut(self, own: slice) -> Surface:
        parts = [part[:, own] for part in (self.values, self.start_rates, self.end_rates)]
        return Surface(
            axes=(self.axes[0][own], *self.axes[1:]), times=self.times, values=parts[0], start_rates=parts[1],
            end_rates=parts[2],
        )  # fmt: skip

    def _roundoff(self, k: int) -> Array:
        """What V over each cell in a slab may be off by after `refined`; one state."""
        widths, step = np.diff(self.axes[0]), float(self.steps[k])
        rates = np.abs(self.start_rates[k]) + np.abs(self.end_rates[k])
        size = np.abs(self.values[k]) + np.abs(self.values[k + 1]) + step * rates
        most = np.maximum(size[:-1], size[1:])
        total = most[:, 0] + widths * most[:, 1] + widths**2 * most[:, 2]
        return np.asarray(2.0**-53 * (200 + 20 * self.times[-1] / step) * total)

    def patches(self, first: int, last: int) -> Patches:
        """All cells of the slabs ``first`` to ``last`` - 1, flattened with time slowest."""
        parts = [self.values[first:last], self.start_rates[first:last],
                 self.values[first + 1 : last + 1], self.end_rates[first:last]]  # fmt: skip
        return self._patches(np.stack(parts, axis=1), self.steps[first:last])

    def chunks(self, limit: int = 4000) -> Iterator[tuple[int, int]]:
        """Ranges of slabs with at most ``limit`` patches (or one slab)."""
        stride = max(1, limit // int(np.prod(self.cells)))
        for first in range(0, self.slabs, stride):
            poll("proof of the value function")
            yield first, min(first + stride, self.slabs)

    def range_at(self, index: int) -> tuple[Array, Array]:
        """Bounds of V over each cell at one end of a slab, shape ``cells``."""
        low, high = value_range(self._patches_at(index))
        return low.reshape(self.cells), high.reshape(self.cells)

    def ceiling_at(self, index: int) -> tuple[tuple[Array, ...], Array]:
        """Nodes of cells cut in four along both of two states, and upper bounds of V over them at one end of a slab.

        A node in floats lies within two roundoffs of |x| of where the polynomial is cut, and |V_i| <= 10 Z / h_i; the
        products are convex combinations of at most Z, of six terms each.
        """
        patches = self._patches_at(index)
        cut = np.einsum("pia,bac,qjc->bpqij", QUARTERS, patches.coefficients[:, 0], QUARTERS, optimize=True)
        off = sum(np.max(np.abs(axis)) / width for axis, width in zip(self.axes, patches.widths))
        slack = 2.0**-53 * (1000 + 40 * off) * (patches.size + np.abs(patches.reference))
        high = (patches.reference + slack)[:, None, None] + cut.max(axis=(3, 4))
        rows, columns = self.cells
        high = high.reshape(rows, columns, 4, 4).swapaxes(1, 2).reshape(4 * rows, 4 * columns)
        share = np.arange(4) / 4
        nodes = [(axis[:-1, None] + np.diff(axis)[:, None] * share).ravel() for axis in self.axes]
        return tuple(np.append(node, axis[-1]) for node, axis in zip(nodes, self.axes)), high

    def floor_at(self, index: int, points: Array) -> Array:
        """Lower bounds of V at points, shape (N, n), at one end of a slab; -inf off the grid (see `ceiling_at`)."""
        cells = [
            np.clip(np.searchsorted(axis, x, side="right") - 1, 0, len(axis) - 2)
            for axis, x in zip(self.axes, points.T)
        ]
        shares = [(x - axis[k]) / (axis[k + 1] - axis[k]) for axis, x, k in zip(self.axes, points.T, cells)]
        inside = np.all([(x >= axis[0]) & (x <= axis[-1]) for axis, x in zip(self.axes, points.T)], axis=0)
        patches = self._patches_at(index).take(np.ravel_multi_index(tuple(cells), self.cells))
        value = patches.coefficients[:, 0]
        for share in shares:
            degree = value.shape[1] - 1
            share = np.clip(share, 0.0, 1.0)[:, None]
            powers = np.arange(degree + 1)
            binomial = np.array([math.comb(degree, k) for k in powers])
            weights = binomial * share**powers * (1 - share) ** (degree - powers)
            value = np.einsum("ni,ni...->n...", weights, value)
        off = sum(np.max(np.abs(axis)) / width for axis, width in zip(self.axes, patches.widths))
        slack = 2.0**-53 * (1000 + 40 * off) * (patches.size + np.abs(patches.reference))
        return np.where(inside, patches.reference + value - slack, -np.inf)

    def highest_end(self, cut: Sequence[tuple[bool, bool]] = ()) -> float:
        """Upper bound of V at the last time, and at the faces of each state that ``cut`` names."""
        faces = [self.face_range(axis, side)[1] for axis, sides in enumerate(cut) for side in (0, 1) if sides[side]]
        return max(float(self.range_at(-1)[1].max()), *faces, -math.inf)

    def face_range(self, axis: int, side: int) -> tuple[float, float]:
        """Bounds of V on one face of the grid over all times."""
        low, high = self.face_ranges(axis, side)
        return float(low.min()), float(high.max())

    def face_ranges(self, axis: int, side: int) -> tuple[Array, Array]:
        """Bounds of V on the cells of one face of the grid, shape (K, *cells along the other states)."""
        return self.across(axis, -side)

    def across(self, axis: int, node: int, *, begin: bool = False) -> tuple[Array, Array]:
        """The same where a state is at one of its nodes; ``begin``: V is in the first slab what it is at its start."""
        index: tuple[Any, ...] = (slice(None), *((slice(None),) * (2 * axis)), node, 0)
        parts = [self.values[:-1], self.start_rates, self.values[1:], self.end_rates]
        data = np.stack([part[index] for part in parts], axis=1)
        if begin:
            data[0, 1::2], data[0, 2] = 0.0, data[0, 0]
        rest = tuple(nodes for k, nodes in enumerate(self.axes) if k != axis)
        low, high = value_range(_patches_of(data, self.steps, rest))
        shape = (self.slabs, *(len(nodes) - 1 for nodes in rest))
        return low.reshape(shape), high.reshape(shape)

    def _patches_at(self, index: int) -> Patches:
        """All cells of a slab at which V is throughout what it is at one end of a slab."""
        data = self.values[index][None, None] * np.ones((1, 4, *([1] * (2 * len(self.axes)))))
        data[:, 1] = data[:, 3] = 0.0
        return self._patches(data, np.ones(1))

    def _patches(self, data: Array, steps: Array) -> Patches:
        return _patches_of(data, steps, self.axes)


def _patches_of(data: Array, steps: Array, axes: tuple[Array, ...]) -> Patches:
    """Bernstein coefficients from Hermite data of shape (S, 4, N_1 + 1, 3, ...): degree 5 in each state."""
    n, slabs = len(axes), len(steps)
    if n == 2:
        return _patches_in_plane(data, steps, axes)
    orders = 3
    cells = tuple(len(axis) - 1 for axis in axes)
    data = data.copy()
    for axis in range(n):  # (S, 4, ..., N + 1, d, ...) to (S, 4, ..., N, 2 d, ...)
        place = 2 + 2 * axis
        index = [slice(None)] * data.ndim
        index[place] = slice(None, -1)
        left = data[tuple(index)]
        index[place] = slice(1, None)
        data = np.concatenate([left, data[tuple(index)]], axis=place + 1)
    order = [0, *(2 + 2 * axis for axis in range(n)), 1, *(3 + 2 * axis for axis in range(n))]
    data = data.transpose(order).reshape(slabs * int(np.prod(cells, dtype=int)), 4, *([2 * orders] * n))
    step = np.repeat(steps, int(np.prod(cells, dtype=int)))
    widths = _cell_widths(axes, slabs)
    corner: tuple[Any, ...] = (slice(None), 0, *([0] * n))
    reference = data[corner].copy()
    values: tuple[Any, ...] = (slice(None), slice(0, 4, 2), *([slice(0, 2 * orders, orders)] * n))
    data[values] -= reference.reshape(-1, *([1] * (n + 1)))
    data[:, 1::2] *= step.reshape(-1, *([1] * (n + 1)))
    for axis, width in enumerate(widths):
        powers = np.stack([np.ones_like(width), width, width * width] * 2, axis=1)
        data *= powers.reshape(-1, *([1] * (axis + 1)), 2 * orders, *([1] * (n - 1 - axis)))
    coefficients, magnitude = along(CUBIC_HERMITE, data, 1), along(np.abs(CUBIC_HERMITE), np.abs(data), 1)
    for axis in range(n):
        coefficients = along(HERMITE, coefficients, 2 + axis)
        magnitude = along(np.abs(HERMITE), magnitude, 2 + axis)
    size = magnitude.reshape(len(step), -1).max(axis=1)
    return Patches(coefficients=coefficients, reference=reference, size=size, step=step, widths=widths)


def _patches_in_plane(data: Array, steps: Array, axes: tuple[Array, ...]) -> Patches:
    """The same in two states, compiled."""
    from certbound.values.continuous.kernel import bernstein_in_plane

    first, second = (np.diff(axis) for axis in axes)
    widths = _cell_widths(axes, len(steps))
    count = len(widths[0])
    coefficients, reference, size = np.empty((count, 4, 6, 6)), np.empty(count), np.empty(count)
    data, steps = np.ascontiguousarray(data), np.ascontiguousarray(steps)  # compiled for one layout
    bernstein_in_plane(data, steps, first, second, coefficients, reference, size)
    step = np.repeat(steps, count // len(steps))
    return Patches(coefficients=coefficients, reference=reference, size=size, step=step, widths=widths)


def _cell_widths(axes: tuple[Array, ...], slabs: int) -> tuple[Array, ...]:
    grids = np.meshgrid(*(np.diff(axis) for axis in axes), indexing="ij") if axes else []
    return tuple(np.tile(grid.ravel(), slabs) for grid in grids)
