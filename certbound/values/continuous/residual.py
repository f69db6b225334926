"""Ranges of the residual, of V and of |g' grad V|^2 / 2 over cells and slabs.

V is the polynomial of `surface.Surface` on a cell: degree 3 in time, 5 in each of one or two states. With a
drift and a squared diffusion that are polynomials up to a remainder (`coefficients`), the residual

    R = V_t + f.grad V + tr(a V'') / 2 + Q2,        Q2 = grad V' a grad V / 2,

is a polynomial up to a remainder. It is evaluated at as many nodes as it has coefficients and turned into Bernstein
form. Rounding: with Z the size of V's coefficients on the cell (reference value subtracted), |V_t| <= 6 Z / dt,
|V_i| <= 10 Z / h_i, |V_ij| <= 100 Z / (h_i h_j), and each is evaluated with at most 200 roundoffs of that size (three
changes of basis with at most 8 terms each, differences included; `_ROUNDOFFS` doubles what the count gives). The
polynomial through the computed samples is off by as much times Lebesgue's constants; its own Bernstein coefficients
are off by `_CHANGE` units of its largest sample times the norms of the matrices that lead to them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from certbound.arrays import Array, Index
from certbound.rigor.rounding import UNIT
from certbound.values.continuous.coefficients import Interpolant
from certbound.values.polynomials import basis_at, lebesgue, nodes_of, norm, to_bernstein, to_parts

SPACE, TIME = 5, 3
_ROUNDOFFS = 500 * UNIT
_LEFT_OUT = 100 * UNIT
_CHANGE = 600 * UNIT  # dot products of at most 17 terms along each axis, or of 17^2 where two axes are one product


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

    def take(self, place: Index) -> Patches:
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
    patches: Patches, drifts: Sequence[Interpolant], squares: Interpolant, place: Index,
    counts: Sequence[int], *, wanted: float = 0.0, near: Array | float = math.inf, upper: bool = True,
    straight: bool = False,
) -> Ranges:
    """Ranges of R (its maximum over the drifts), V and Q2; see the module.

    Parameters
    ----------
    drifts : sequence of Interpolant
        One a branch of the disturbance, n outputs each, at the samples ``nodes_of(count)`` of every axis.
    squares : Interpolant
        a, n * n outputs, at the same samples.
    place : ndarray of int, shape (B,)
        Which cell of the interpolants a patch is.
    counts : sequence of int
        Samples in time and in each state; at least the degree of R plus 1.
    wanted : float
        Where |R| <= ``wanted`` the bound of Q2 may be 0, which saves its evaluation.
    near : float or ndarray, shape (B,)
        How far from the samples of R its bound, the upper or the lower one, may lie before the halves and quarters of
        a patch are looked at; two states.
    straight : bool
        Two states: R but for Q2 is bounded closely, and 0 <= Q2 by the sizes of its terms; ``counts`` may be those of
        the rest then.

    Notes
    -----
    ``residual_high`` bounds the supremum over all branches; ``residual_low`` is the best of the lower bounds of the
    single branches, each of which is a lower bound of the supremum.
    """
    n = len(patches.widths)
    extremes = _straight if straight else (_on_line, _in_plane)[n - 1]
    least, most, floor, largest = extremes(patches, drifts, squares, place, counts, wanted, near, upper)
    error, sizes = _errors(patches, squares.size[:, place], n)
    remainders = squares.remainder[:, place]
    loss = _coarsely(patches, remainders, sizes) if _exact(squares) else _diffusive_loss(patches, remainders, n)
    sampled = float(np.prod([lebesgue(count) for count in counts])) * _ROUNDOFFS
    changed = float(np.prod([norm(to_bernstein(count)) for count in counts])) * _CHANGE
    high, low = np.full(len(error), -np.inf), np.full(len(error), -np.inf)
    for branch, drift in enumerate(drifts):
        own, slack = error, loss
        for i in range(n):
            own = own + drift.size[i, place] * sizes[i]
            slack = slack + drift.remainder[i, place] * (sizes[i] if _exact(drift) else _steepest(patches, i))
        slack = (sampled * own + changed * largest[branch] + slack) * (1 + 1e-9)
        high, low = np.maximum(high, most[branch] + slack), np.maximum(low, least[branch] - slack)
    floor = np.maximum(floor - (sampled * error + changed * largest[-1] + loss) * (1 + 1e-9), 0.0)
    high = high + _most_energy(patches, squares, place, n) if straight else high
    v_low, v_high = value_range(patches)
    return Ranges(residual_low=low, residual_high=high, low=v_low, high=v_high, energy=floor)


Extremes = tuple[Array, Array, Array, Array]


def _on_line(
    patches: Patches, drifts: Sequence[Interpolant], squares: Interpolant, place: Index,
    counts: Sequence[int], wanted: float, near: Array | float, upper: bool,
) -> Extremes:
    """Least and largest Bernstein coefficients of R, one row a branch, the least of Q2, and the sizes of the samples.

    The sizes have one row a branch, then one of Q2. One state.
    """
    first = _derived(patches.coefficients, 2, patches.widths[0])
    slope = _at_samples(first, counts)
    half = 0.5 * squares.samples[0, place]
    energy = half * slope * slope
    rest = _at_samples(_derived(patches.coefficients, 1, patches.step), counts) + energy
    rest += half * _at_samples(_derived(first, 2, patches.widths[0]), counts)
    tables = [rest + drift.samples[0, place] * slope for drift in drifts]
    sizes = np.array([np.abs(table).max(axis=(1, 2)) for table in (*tables, energy)])
    found = [_extremes(table, counts) for table in tables]
    least, most = np.array([pair[0] for pair in found]), np.array([pair[1] for pair in found])
    floor = np.zeros(len(rest))
    looked = np.flatnonzero((least.min(axis=0) < -wanted) | (most.max(axis=0) > wanted))
    if len(looked):
        floor[looked] = _extremes(energy[looked], counts)[0]
    return least, most, floor, sizes


def _in_plane(
    patches: Patches, drifts: Sequence[Interpolant], squares: Interpolant, place: Index,
    counts: Sequence[int], wanted: float, near: Array | float, upper: bool,
) -> Extremes:
    """The same in two states, compiled; halves and quarters are looked at where the coefficients lie far off."""
    return _looked_at(_run_plane, patches, drifts, squares, place, counts, wanted, near, upper)


def _straight(
    patches: Patches, drifts: Sequence[Interpolant], squares: Interpolant, place: Index,
    counts: Sequence[int], wanted: float, near: Array | float, upper: bool,
) -> Extremes:
    """The same of R without Q2, in two states."""
    return _looked_at(partial(_run_plane, straight=True), patches, drifts, squares, place, counts, wanted, near, upper)


def _looked_at(
    run: Callable[..., Array], patches: Patches, drifts: Sequence[Interpolant], squares: Interpolant, place: Index,
    counts: Sequence[int], wanted: float, near: Array | float, upper: bool,
) -> Extremes:
    """What ``run`` finds on whole patches, and on their halves and quarters where the coefficients lie far off."""
    out = run(patches, drifts, squares, place, counts, 1, wanted)
    near = np.broadcast_to(near, len(out))
    for parts in (2, 4):
        far = out[:, :, 1] - np.maximum(out[:, :, 4], 0) if upper else np.minimum(out[:, :, 3], 0) - out[:, :, 0]
        beyond = np.maximum(out[:, :, 4] if upper else -out[:, :, 3], 0)
        bad = np.flatnonzero(np.any(far > near[:, None] + 0.05 * beyond, axis=1))
        if len(bad):
            out[bad] = run(patches.take(bad), drifts, squares, place[bad], counts, parts, wanted)
    sizes = np.vstack([np.maximum(-out[:, :, 3], out[:, :, 4]).T, out[:, :, 5].max(axis=1)])
    return out[:, :, 0].T, out[:, :, 1].T, out[:, :, 2].min(axis=1), sizes


def sample_in_plane(
    patches: Patches, drifts: Sequence[Interpolant], squares: Interpolant, place: Index,
    counts: Sequence[int], *, upper: bool,
) -> Array:
    """The largest sample of R over each patch and all branches, or of -R for the best branch: a sketch, no bound."""
    out = _run_plane(patches, drifts, squares, place, counts, 0, np.inf)
    return np.asarray(out[:, :, 4].max(axis=1) if upper else -out[:, :, 3].max(axis=1))


def _run_plane(
    patches: Patches, drifts: Sequence[Interpolant], squares: Interpolant, place: Index,
    counts: Sequence[int], parts: int, wanted: float, straight: bool = False,
) -> Array:
    """What the kernel finds with this many parts along each axis; samples alone for 0."""
    from certbound.values.continuous.kernel import extremes_in_plane

    time, x, y = (
        _derivatives(count, degree, orders) for count, degree, orders in zip(counts, (TIME, SPACE, SPACE), (2, 3, 3))
    )
    changes = tuple(to_parts(count, parts) if parts else np.empty((0, count, count)) for count in counts)
    out = np.empty((len(patches.size), len(drifts), 6))
    width_x, width_y = patches.widths
    extremes_in_plane(
        np.ascontiguousarray(patches.coefficients), patches.step, width_x, width_y, place,
        np.ascontiguousarray([drift.samples for drift in drifts]), np.ascontiguousarray(squares.samples),
        (*time, *x, *y), changes, wanted, straight, out,
    )  # fmt: skip
    return out


def _derivatives(count: int, degree: int, orders: int) -> list[Array]:
    """Values at the samples of a Bernstein basis and of its derivatives on the unit interval."""
    found, change = [], np.eye(degree + 1)
    for order in range(orders):
        found.append(basis_at(nodes_of(count), degree - order) @ change)
        change = (degree - order) * np.diff(change, axis=0)
    return found


def coarse_size(
    patches: Patches, drifts: Sequence[Interpolant], squares: Interpolant, place: Index
) -> Array:
    """An upper bound of |R| over each patch from the sizes of its terms: good where V hardly moves."""
    n = len(patches.widths)
    steep = [_steepest(patches, i) for i in range(n)]
    rate = _derived(patches.coefficients, 1, patches.step).reshape(len(patches.size), -1)
    total = np.abs(rate).max(axis=1) + _ROUNDOFFS * 6 * patches.size / patches.step
    for i in range(n):
        force = np.max([drift.size[i] + drift.remainder[i] for drift in drifts], axis=0)
        total = total + force[place] * steep[i]
        for j in range(n):
            a = squares.size[i * n + j] + squares.remainder[i * n + j]
            if a.any():
                total = total + 0.5 * a[place] * (_bent(patches, i, j) + steep[i] * steep[j])
    return np.asarray(total * (1 + 1e-12))


def _most_energy(patches: Patches, squares: Interpolant, place: Index, n: int) -> Array:
    """An upper bound of Q2 over each patch from the sizes of its terms."""
    steep, size = [_steepest(patches, i) for i in range(n)], squares.size + squares.remainder
    parts = [0.5 * size[i * n + j, place] * steep[i] * steep[j] for i in range(n) for j in range(n)]
    return np.asarray(np.sum(parts, axis=0) * (1 + 1e-12))


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
    return np.asarray(slope * (degree / width).reshape(-1, *([1] * (slope.ndim - 1))))


def _at_samples(coefficients: Array, counts: Sequence[int]) -> Array:
    matrices = [
        basis_at(nodes_of(count), size - 1) for count, size in zip(counts, coefficients.shape[1:])
    ]
    return _changed(coefficients, matrices)


def _errors(patches: Patches, squares: Array, n: int) -> tuple[Array, list[Array]]:
    """The size in which rounding errors of everything but f.grad V are counted, and the sizes of grad V."""
    sizes = [10 * patches.size / width for width in patches.widths]
    return 6 * patches.size / patches.step + _coarsely(patches, squares, sizes), sizes


def _coarsely(patches: Patches, squares: Array, sizes: list[Array]) -> Array:
    """A bound of |tr(a V'')| / 2 + Q2 for a of these sizes, from Z alone."""
    total, n = np.zeros(len(patches.size)), len(sizes)
    for i in range(n):
        for j in range(n):
            curved = 100 * patches.size / (patches.widths[i] * patches.widths[j]) + sizes[i] * sizes[j]
            total = total + 0.5 * squares[i * n + j] * curved
    return total


def _exact(polynomials: Interpolant) -> bool:
    """Whether what they leave out is a matter of rounding: coarse bounds of what it is multiplied with do then."""
    return bool(polynomials.remainder.max() <= _LEFT_OUT * polynomials.size.max())


def _steepest(patches: Patches, axis: int) -> Array:
    """A bound of |V_i| over each patch, from the derivative's own coefficients."""
    slope = _derived(patches.coefficients, 2 + axis, patches.widths[axis])
    flat = np.abs(slope).reshape(len(slope), -1).max(axis=1)
    return np.asarray(flat + _ROUNDOFFS * 10 * patches.size / patches.widths[axis])


def _bent(patches: Patches, i: int, j: int) -> Array:
    """A bound of |V_ij| over each patch."""
    curved = _derived(_derived(patches.coefficients, 2 + i, patches.widths[i]), 2 + j, patches.widths[j])
    size = np.abs(curved).reshape(len(curved), -1).max(axis=1)
    return np.asarray(size + _ROUNDOFFS * 100 * patches.size / (patches.widths[i] * patches.widths[j]))


def _diffusive_loss(patches: Patches, remainders: Array, n: int) -> Array:
    """What the remainders of a cost: their sum with |V_ij| + |V_i||V_j|, halved."""
    if not remainders.any():
        return np.zeros(len(patches.size))
    steep = [_steepest(patches, i) for i in range(n)]
    total = np.zeros(len(patches.size))
    for i in range(n):
        for j in range(n):
            total = total + 0.5 * remainders[i * n + j] * (_bent(patches, i, j) + steep[i] * steep[j])
    return total
