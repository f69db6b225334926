"""Ranges of the residual, of V and of |g' grad V|^2 / 2 over cells and slabs.

V is the polynomial of `surface.Surface` on a cell: degree 3 in time, 5 in each state. With a drift and a squared
diffusion that are polynomials up to a remainder (`coefficients`), the residual

    R = V_t + f.grad V + tr(a V'') / 2 + Q2,        Q2 = grad V' a grad V / 2,

is a polynomial up to a remainder. It is evaluated at as many nodes as it has coefficients and turned into Bernstein
form. Rounding: with Z the size of V's coefficients on the cell (reference value subtracted), |V_t| <= 6 Z / dt,
|V_i| <= 10 Z / h_i, |V_ij| <= 100 Z / (h_i h_j), and each is evaluated with at most 200 roundoffs of that size (three
changes of basis with at most 8 terms each, differences included; `_ROUNDOFFS` doubles what the count gives).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from certbound.rigor.rounding import UNIT
from certbound.values.continuous.coefficients import Interpolant
from certbound.values.continuous.polynomials import basis_at, nodes_of, norm, to_bernstein

__all__ = ["Patches", "Ranges", "bound_ranges", "coarse_size", "value_range"]

Array = NDArray[np.float64]

SPACE, TIME = 5, 3
_ROUNDOFFS = 500 * UNIT


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Patches:
    """V on B cells times slabs: Bernstein coefficients less a reference, and the cells' sides.

    Attributes
    ----------
    coefficients : ndarray, shape (B, 4, 6) or (B, 4, 6, 6)
    reference, size : ndarray, shape (B,)
        V = reference + polynomial; Z of the module.
    step : ndarray, shape (B,)
        Lengths of the slabs.
    widths : tuple of ndarray, shape (B,)
    """

    coefficients: Array
    reference: Array
    size: Array
    step: Array
    widths: tuple[Array, ...]

    def take(self, place: NDArray[np.intp]) -> Patches:
        """Some of the patches."""
        return Patches(
            coefficients=self.coefficients[place], reference=self.reference[place], size=self.size[place],
            step=self.step[place], widths=tuple(width[place] for width in self.widths),
        )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Ranges:
    """Proved bounds over each patch, shape (B,): of R from both sides, of V, and of Q2 from below."""

    residual_low: Array
    residual_high: Array
    low: Array
    high: Array
    energy: Array


def along(matrix: Array, array: Array, axis: int) -> Array:
    """A matrix applied along one axis."""
    return np.moveaxis(np.tensordot(array, matrix, axes=([axis], [1])), -1, axis)


def bound_ranges(
    patches: Patches, drifts: Sequence[Interpolant], squares: Interpolant, counts: Sequence[int], *, wanted: float = 0.0
) -> Ranges:
    """Ranges of R (its maximum over the drifts), V and Q2; see the module.

    Parameters
    ----------
    drifts : sequence of Interpolant
        One a branch of the disturbance, n outputs each, at the samples ``nodes_of(count)`` of every axis.
    squares : Interpolant
        a, n * n outputs, at the same samples.
    counts : sequence of int
        Samples in time and in each state; at least the degree of R plus 1.
    wanted : float
        Where |R| <= ``wanted`` the bound of Q2 is 0, which saves its evaluation.

    Notes
    -----
    ``residual_high`` bounds the supremum over all branches; ``residual_low`` is the best of the lower bounds of the
    single branches, each of which is a lower bound of the supremum.
    """
    n = len(patches.widths)
    slopes, rest, energy = _sampled(patches, squares, counts)
    error, sizes = _errors(patches, squares, n)
    amplification = float(np.prod([norm(to_bernstein(count)) for count in counts]))
    high, low = np.full(len(error), -np.inf), np.full(len(error), -np.inf)
    for drift in drifts:
        total = rest.copy()
        own = error.copy()
        loss = np.zeros(len(error))
        for i in range(n):
            total += drift.samples[i] * slopes[i]
            own = own + drift.size[i] * sizes[i]
            loss = loss + drift.remainder[i] * _steepest(patches, i)
        slack = amplification * _ROUNDOFFS * own + loss + _diffusive_loss(patches, squares, n)
        least, most = _extremes(total, counts)
        high, low = np.maximum(high, most + slack * (1 + 1e-9)), np.maximum(low, least - slack * (1 + 1e-9))
    v_low, v_high = value_range(patches)
    floor = np.zeros(len(error))
    place = np.flatnonzero((low < -wanted) | (high > wanted))
    if len(place):
        least, _ = _extremes(energy[place], counts)
        slack = amplification * _ROUNDOFFS * error + _diffusive_loss(patches, squares, n)
        floor[place] = np.maximum(least - slack[place], 0.0)
    return Ranges(residual_low=low, residual_high=high, low=v_low, high=v_high, energy=floor)


def coarse_size(patches: Patches, drifts: Sequence[Interpolant], squares: Interpolant) -> Array:
    """An upper bound of |R| over each patch from the sizes of its terms: good where V hardly moves."""
    n = len(patches.widths)
    steep = [_steepest(patches, i) for i in range(n)]
    rate = _derived(patches.coefficients, 1, patches.step).reshape(len(patches.size), -1)
    total = np.abs(rate).max(axis=1) + _ROUNDOFFS * 6 * patches.size / patches.step
    for i in range(n):
        force = np.max([drift.size[i] + drift.remainder[i] for drift in drifts], axis=0)
        total = total + force * steep[i]
        for j in range(n):
            a = squares.size[i * n + j] + squares.remainder[i * n + j]
            if a.any():
                total = total + 0.5 * a * (_bent(patches, i, j) + steep[i] * steep[j])
    return total * (1 + 1e-12)


def value_range(patches: Patches) -> tuple[Array, Array]:
    """Lower and upper bounds of V over each patch."""
    flat = patches.coefficients.reshape(len(patches.size), -1)
    slack = _ROUNDOFFS * (patches.size + np.abs(patches.reference))
    return patches.reference + flat.min(axis=1) - slack, patches.reference + flat.max(axis=1) + slack


def _extremes(samples: Array, counts: Sequence[int]) -> tuple[Array, Array]:
    flat = _changed(samples, [to_bernstein(count) for count in counts]).reshape(len(samples), -1)
    return flat.min(axis=1), flat.max(axis=1)


def _changed(array: Array, matrices: Sequence[Array]) -> Array:
    """One matrix along each axis behind the first; in two axes as one product, which the processor does faster."""
    if len(matrices) == 2:
        whole = np.kron(matrices[0], matrices[1])
        return (array.reshape(len(array), -1) @ whole.T).reshape(-1, *(len(matrix) for matrix in matrices))
    for axis in range(len(matrices), 0, -1):
        array = along(matrices[axis - 1], array, axis)
    return array


def _derived(coefficients: Array, axis: int, width: Array) -> Array:
    """Bernstein coefficients of the derivative along an axis of the coefficient array."""
    degree = coefficients.shape[axis] - 1
    slope = np.diff(coefficients, axis=axis)
    return slope * (degree / width).reshape(-1, *([1] * (slope.ndim - 1)))


def _at_samples(coefficients: Array, counts: Sequence[int]) -> Array:
    matrices = [
        basis_at(nodes_of(count), size - 1) for count, size in zip(counts, coefficients.shape[1:])
    ]
    return _changed(coefficients, matrices)


def _sampled(patches: Patches, squares: Interpolant, counts: Sequence[int]) -> tuple[list[Array], Array, Array]:
    """grad V, V_t + tr(a V'')/2 + Q2, and Q2 at the samples."""
    c, n = patches.coefficients, len(patches.widths)
    first = [_derived(c, 2 + i, patches.widths[i]) for i in range(n)]
    slopes = [_at_samples(slope, counts) for slope in first]
    rest = _at_samples(_derived(c, 1, patches.step), counts)
    energy = np.zeros_like(rest)
    for i in range(n):
        for j in range(n):
            if not squares.size[i * n + j].any():
                continue
            half = 0.5 * squares.samples[i * n + j]
            energy += half * slopes[i] * slopes[j]
            rest += half * _at_samples(_derived(first[i], 2 + j, patches.widths[j]), counts)
    return slopes, rest + energy, energy


def _errors(patches: Patches, squares: Interpolant, n: int) -> tuple[Array, list[Array]]:
    """The size in which rounding errors of everything but f.grad V are counted, and the sizes of grad V."""
    sizes = [10 * patches.size / width for width in patches.widths]
    total = 6 * patches.size / patches.step
    for i in range(n):
        for j in range(n):
            curved = 100 * patches.size / (patches.widths[i] * patches.widths[j]) + sizes[i] * sizes[j]
            total = total + 0.5 * squares.size[i * n + j] * curved
    return total, sizes


def _steepest(patches: Patches, axis: int) -> Array:
    """A bound of |V_i| over each patch, from the derivative's own coefficients."""
    slope = _derived(patches.coefficients, 2 + axis, patches.widths[axis])
    flat = np.abs(slope).reshape(len(slope), -1).max(axis=1)
    return flat + _ROUNDOFFS * 10 * patches.size / patches.widths[axis]


def _bent(patches: Patches, i: int, j: int) -> Array:
    """A bound of |V_ij| over each patch."""
    curved = _derived(_derived(patches.coefficients, 2 + i, patches.widths[i]), 2 + j, patches.widths[j])
    size = np.abs(curved).reshape(len(curved), -1).max(axis=1)
    return size + _ROUNDOFFS * 100 * patches.size / (patches.widths[i] * patches.widths[j])


def _diffusive_loss(patches: Patches, squares: Interpolant, n: int) -> Array:
    """What the remainders of a cost: their sum with |V_ij| + |V_i||V_j|, halved."""
    if not squares.remainder.any():
        return np.zeros(len(patches.size))
    steep = [_steepest(patches, i) for i in range(n)]
    total = np.zeros(len(patches.size))
    for i in range(n):
        for j in range(n):
            total = total + 0.5 * squares.remainder[i * n + j] * (_bent(patches, i, j) + steep[i] * steep[j])
    return total
