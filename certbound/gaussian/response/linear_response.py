"""Linear response along a nominal curve: the exact part of Thm K7, with every rounding error bounded.

On piece k of length h the slope is Jhat(tau) = A + tau K with float matrices A, K taken as exact, so that the
transition matrix F = Phi(t_{k+1}, t_k) is a convergent power series. Float values of F and of the covariance V
stand beside proved error bounds. Supports of the linear responses are computed by adjoint rows r_j = r_{j+1} F_j;
the residual of that float product meets the state of step j, whose size is known, so errors never wrap.

Discrete time is the case K = 0, F = A, h = 1.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from certbound.arrays import Array, Integers
from certbound.errors import EngineError
from certbound.watch import poll

_UNIT = 2.0**-53
_TINY = 1e-300
_TERMS = 24
_MEMORY = 6 * 2**30  # bytes that the rows of one cell may take
_KEPT = 2**29  # bytes of absolute values that are kept beside the coefficients
_ROW, _ENTRIES = 4000, 2**22  # products in a sum, and entries of a matrix, up to which all steps are one matrix
_MILD = 2.0  # norm of the slopes times a piece, up to which series run well in the states' own units
_SWEEPS, _FARTHEST = 20, 60  # of balancing; exponent of a unit
_LARGE, _SPARSE = 40, 0.1  # states and share of nonzero entries from which on products are sparse


def _gamma(count: int) -> float:
    """Bound of the relative rounding error of a sum of ``count`` products (any order of summation)."""
    return 1.01 * (count + 2) * _UNIT


def _absmul(a: Array, b: Array) -> Array:
    """Upper bound of |a| |b| for nonnegative results, rounded up."""
    return np.asarray((np.abs(a) @ np.abs(b)) * (1 + 2 * _gamma(a.shape[-1])) + _TINY)


def _transposed(a: Array) -> Array:
    return np.swapaxes(a, -1, -2)


def _norm(a: Array) -> Array:
    """Upper bound of the maximum row sum."""
    return np.asarray(np.abs(a).sum(-1).max(-1) * (1 + _gamma(a.shape[-1])))


@dataclass(frozen=True, eq=False, kw_only=True)
class LinearResponse:
    """Linear data of a batch of nominal curves (axis 0: cells of X0; axis 1: pieces or steps)."""

    step: float  # length h of a piece (1 in discrete time); the exact length is h up to one rounding
    # (B, N, n, n): A and K of Jhat(tau) = A + tau K
    slope: Array
    drift: Array
    # (B, N, n, n): F; the exact transition matrix differs by at most ``transition_error`` in every entry
    transition: Array
    transition_error: Array  # (B, N)
    deviation: Array  # (B, N, n, n): entrywise bound of |Phi(t, s) - I| for s <= t in one piece (0 in discrete time)
    # (B, N + 1, n, n): V and W with -W <= V_exact - V <= W as quadratic forms
    covariance: Array
    covariance_error: Array
    slope_error: float = 0.0  # entrywise bound of the exact slope minus its floats
    jumps: tuple[int, ...] = ()  # pieces without any length, whose transition is a jump of the state at one time

    @property
    def pieces(self) -> int:
        """Number of pieces N."""
        return int(self.slope.shape[1])

    def variance(self, rows: Array, nodes: Integers) -> tuple[Array, Array]:
        """Lower and upper bounds of the variances r V r^T of ``rows`` (B, M, n) at ``nodes`` (M,)."""
        return self.covariance_of(rows, rows, nodes)

    def covariance_of(self, first: Array, second: Array, nodes: Integers) -> tuple[Array, Array]:
        """Bounds of cov(first Z, second Z) at ``nodes``; rows (B, M, n)."""
        n = first.shape[-1]
        used = np.flatnonzero((first != 0).any(axis=(0, 1)) | (second != 0).any(axis=(0, 1)))
        if 2 * len(used) < n:  # zero entries add nothing
            first, second = first[..., used], second[..., used]
            place = np.ix_(np.arange(len(self.covariance)), nodes, used, used)
            v, w = self.covariance[place], self.covariance_error[place]
        else:
            v, w = self.covariance[:, nodes], self.covariance_error[:, nodes]
        value = np.einsum("bmi,bmij,bmj->bm", first, v, second)
        rounding = 2 * _gamma(n * n) * np.einsum("bmi,bmij,bmj->bm", abs(first), abs(v), abs(second))
        own = [np.einsum("bmi,bmij,bmj->bm", r, w, r) + _gamma(n * n) * 2 * np.einsum(
            "bmi,bmij,bmj->bm", abs(r), abs(w), abs(r)) for r in (first, second)]
        roots = [np.sqrt(np.maximum(square, 0)) for square in own]  # of the factors: their product may pass all floats
        error = roots[0] * roots[1] * (1 + 1e-12) + rounding + _TINY
        return value - error, value + error


def _transition(slope: Array, drift: Array, step: float, slope_error: float) -> tuple[Array, Array, Array]:
    """F, an entrywise error bound, and a bound of |Phi(t, s) - I| on the piece."""
    n = slope.shape[-1]
    a, k = slope * step, drift * step**2
    alpha, kappa = _norm(a) * (1 + 1e-14), _norm(k) * (1 + 1e-14)
    older, newer = np.zeros_like(a), np.broadcast_to(np.eye(n), a.shape)
    small, big = np.zeros_like(alpha), np.ones_like(alpha)
    total = newer.copy()
    for i in range(_TERMS):  # the last two terms: with all of them, states by the hundred would fill the memory
        older, newer = newer, (a @ newer + k @ older) / (i + 1)
        small, big = big, (alpha * big + kappa * small) / (i + 1)
        total += newer
    # beyond the last term the majorant falls by this ratio at least every second term
    ratio = (alpha + kappa) / _TERMS
    if np.any(ratio > 0.5):
        raise _too_stiff(float((alpha + kappa).max()))
    tail = 4.1 * (big + small) * np.maximum(ratio, _TINY)
    growth = np.exp(alpha + kappa) * (1 + 1e-13)
    error = tail + _TERMS * (3 * n + 12) * 2 * _UNIT * growth + 2 * n * step * slope_error * growth
    size_ = (np.abs(a) + np.abs(k)) * (1 + 1e-14)
    square = _absmul(size_, size_)
    mass = np.expm1(_norm(size_)) * (1 + 1e-13)
    deviation = size_ + 0.5 * (square + _absmul(square, np.broadcast_to(mass[..., None, None], a.shape)))
    return total, error, np.asarray(deviation * (1 + 1e-14))


def _too_stiff(turn: float) -> EngineError:
    return EngineError(
        f"the system is too stiff for the linear engine: ||J|| h = {turn:.3g} on its finest pieces of time, and its "
        f"series serve up to {_TERMS / 4:g}; shorten the horizon, or use another method."
    )


def _noise_covariance(slope: Array, drift: Array, step: float, gram: Array) -> tuple[Array, Array]:
    """Covariance Q gathered on a piece from g g^T = ``gram``, and an entrywise error bound."""
    n = slope.shape[-1]
    a, k = slope * step, drift * step**2
    start = np.broadcast_to(gram * step, a.shape)
    older, newer = np.zeros_like(a), start.copy()
    total = start.copy()
    alpha = (_norm(a) + _norm(_transposed(a))) * (1 + 1e-14)
    kappa = (_norm(k) + _norm(_transposed(k))) * (1 + 1e-14)
    small, big = np.zeros_like(alpha), np.ones_like(alpha)
    for i in range(1, _TERMS):
        product = a @ newer + k @ older
        older, newer = newer, (product + _transposed(product)) / (i + 1)
        small, big = big, (alpha * big + kappa * small) / (i + 1)
        total = total + newer
    ratio = (alpha + kappa) / _TERMS
    if np.any(ratio > 0.5):
        raise _too_stiff(float((alpha + kappa).max()) / 2)
    scale = _norm(gram) * step
    error = (4.1 * (big + small) * np.maximum(ratio, _TINY)
             + _TERMS * (3 * n + 12) * 4 * _UNIT * np.exp(alpha + kappa)) * scale
    return total, np.asarray(error + _TINY)


def _propagate(
    transition: Array, transition_error: Array, noise: Array, noise_error: Array, start: Array
) -> tuple[Array, Array]:
    """V_{k+1} = F V_k F^T + Q_k in floats, and W with |V_exact - V| <= W as quadratic forms."""
    cells, pieces, n, _ = transition.shape
    v = np.zeros((cells, pieces + 1, n, n))
    w = np.zeros_like(v)
    v[:, 0] = start
    w[:, 0] = np.eye(n) * (2 * n * _UNIT * float(np.abs(start).max(initial=0.0)))
    eye = np.eye(n)
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(pieces):
            poll()
            f, phi = transition[:, k], transition_error[:, k]
            product = f @ v[:, k] @ _transposed(f) + noise[:, k]
            v[:, k + 1] = (product + _transposed(product)) / 2
            size_f, size_v, size_w = _norm(f), _norm(v[:, k]), _norm(w[:, k])
            columns = _norm(_transposed(f))
            spread = n * phi * (size_f + columns + n * phi)
            rounding = 2 * _gamma(2 * n + 4) * (size_f * columns * (size_v + size_w) + _norm(v[:, k + 1]))
            residual = n * (rounding + noise_error[:, k]) + n * spread * (size_v + size_w)
            grown = f @ w[:, k] @ _transposed(f)
            w[:, k + 1] = (grown + _transposed(grown)) / 2 + (residual * (1 + 1e-10) + _TINY)[:, None, None] * eye
    if not (np.isfinite(v).all() and np.isfinite(w).all()):
        raise EngineError(
            "the deviation of the linearised system grows beyond all floats before the horizon; shorten the horizon."
        )
    return v, w


@dataclass(frozen=True, eq=False, kw_only=True)
class Jumps:
    """Pieces at which the state jumps by z -> S z: their numbers, S (B, J, n, n), and an entrywise error bound.

    They have no slope, no noise, and the length of all others only in what is divided by it.
    """

    places: tuple[int, ...]
    matrices: Array
    error: float


def continuous_response(
    slope: Array, drift: Array, step: float, diffusion: Array, start: Array, *, slope_error: float = 0.0,
    jumps: Jumps | None = None,
) -> LinearResponse:
    """Linear data in continuous time: dZ = (A + tau K) Z dt + g dW on every piece.

    ``diffusion`` is g (n, m), or one matrix a cell and piece, (B, N, n, m).
    ``slope_error`` bounds entrywise how far the exact slope (the model's constants) is from its floats.
    Where the slopes are too large for the series they run in units of the states in which the slopes are balanced, so
    that units cost no pieces of time; elsewhere bounds that are the same for all entries are best in the states' own.
    """
    mild = float(_norm(slope).max(initial=0.0)) * step <= _MILD
    unit = np.ones(slope.shape[-1]) if mild else _balancing_units(slope)
    back, size = unit[:, None] / unit, unit[:, None] * unit  # powers of two: products with them are exact
    own_error = slope_error * float(1 / back.min())  # of the slope in balanced units, as far as it may grow
    own_slope, own_drift, own_noise = slope / back, drift / back, diffusion / unit[:, None]
    transition, error, deviation = _transition(own_slope, own_drift, step, own_error)
    gram = own_noise @ _transposed(own_noise)
    noise, noise_error = _noise_covariance(own_slope, own_drift, step, gram)
    noise_error = noise_error + 4 * slope.shape[-1] * step * own_error * np.abs(noise).sum(axis=(-1, -2))
    noise_error = noise_error + _gamma(diffusion.shape[-1]) * 4 * step * float(
        (np.abs(own_noise) @ _transposed(np.abs(own_noise))).max(initial=0.0)
    )
    if jumps is not None:
        own = np.array(jumps.places)
        transition[:, own], error[:, own] = jumps.matrices / back, jumps.error / float(back.min())
        deviation[:, own] = 0.0
    v, w = _propagate(transition, error, noise, noise_error, start / size)
    return LinearResponse(
        step=step, slope=slope, drift=drift, transition=transition * back, transition_error=error * float(back.max()),
        deviation=deviation * back + _TINY, covariance=v * size, slope_error=slope_error,
        covariance_error=w * size + len(unit) * _TINY * np.eye(len(unit)),
        jumps=() if jumps is None else jumps.places,
    )


def _balancing_units(slopes: Array) -> Array:
    """Powers of two, (n,), in units of which rows and columns of slopes (..., n, n) are about equal.

    Any choice serves: it costs accuracy, and no more than that.
    """
    size = np.abs(slopes).reshape(-1, *slopes.shape[-2:]).max(axis=0)
    size = np.where(np.isfinite(size), size, 0.0) * (1 - np.eye(len(size)))
    exponents = np.zeros(len(size))
    for _ in range(_SWEEPS):
        before = exponents.copy()
        for i in range(len(size)):
            away = np.exp2(exponents - exponents[i])
            row, column = float(size[i] @ away), float(size[:, i] @ (1 / away))
            if row > 0 and column > 0:
                exponents[i] = np.clip(exponents[i] + np.round(np.log2(row / column) / 2), -_FARTHEST, _FARTHEST)
        if np.array_equal(before, exponents):
            break
    return np.asarray(np.exp2(exponents))


def balanced(slopes: Array) -> Array:
    """Slopes (..., n, n) in units of the states, powers of two, in which their rows and columns are about equal."""
    units = _balancing_units(slopes)
    return np.asarray(slopes / units[:, None] * units)


def discrete_response(
    slope: Array, covariance: Array, covariance_bound: float, start: Array, *, slope_error: float = 0.0
) -> LinearResponse:
    """Linear data in discrete time: Z+ = A Z + w with Cov(w) (or its proxy) given up to an entrywise bound."""
    cells, steps = slope.shape[:2]
    noise = np.broadcast_to(covariance, slope.shape)
    none = np.full((cells, steps), slope_error)
    v, w = _propagate(slope, none, noise, np.zeros_like(none) + covariance_bound, start)
    zero = np.zeros_like(slope)
    return LinearResponse(
        step=1.0, slope=slope, drift=zero, transition=slope, transition_error=none,
        deviation=zero, covariance=v, covariance_error=w, slope_error=slope_error,
    )


class RowResponse:
    """Supports, along chosen rows, of states driven through the response of one cell.

    The state obeys s_{j+1} = F_j s_j + b_j. For rows r at nodes k the class gives bounds of r . s_k from the sets
    of s_0 and b_j, by the adjoint rows of every earlier step.

    Parameters
    ----------
    rows : ndarray, shape (M, D, n)
        Rows at nodes 0 .. M - 1 (M <= N + 1).
    columns : ndarray of int, optional
        States that b_j is expected to move; what it does to the others is bounded coarsely (all when omitted).
    """

    def __init__(self, response: LinearResponse, cell: int, rows: Array, columns: Integers | None = None) -> None:
        self.nodes, asked, self.dimension = rows.shape
        n = self.dimension
        places: dict[bytes, int] = {}
        self.place = np.array([places.setdefault(rows[:, d].tobytes(), len(places)) for d in range(asked)], dtype=int)
        first = np.array([int(np.argmax(self.place == d)) for d in range(len(places))], dtype=int)
        self.count = len(places)
        self.transition, self.error = response.transition[cell], response.transition_error[cell]
        self.columns = np.arange(n) if columns is None else np.asarray(columns)
        self.others = np.setdiff1d(np.arange(n), self.columns)
        needed = 4.0 * self.nodes**2 * self.count * len(self.columns)  # bytes
        if needed > _MEMORY:
            raise EngineError(
                f"the linear engine would take {needed / 2**30:.3g} GiB of memory, for {self.count} rows at "
                f"{self.nodes} times, and stops at {_MEMORY / 2**30:g}; use another method, or a shorter horizon."
            )
        current = np.array(rows[:, first])
        self.coefficients: list[Array] = [np.empty(0)] * (self.nodes - 1)
        self.rest: list[Array] = [np.empty(0)] * (self.nodes - 1)  # row sums over the other columns
        for j in range(self.nodes - 2, -1, -1):
            poll()
            later = current[j + 1 :].reshape(-1, n).copy()
            self.coefficients[j] = np.ascontiguousarray(later[:, self.columns])
            if len(self.others):
                self.rest[j] = np.abs(later[:, self.others]).sum(axis=1) * (1 + 1e-12)
            current[j + 1 :] = _times(later, self.transition[j]).reshape(-1, self.count, n)
        self.initial = current

    def _gather(self, parts: Iterator[Array]) -> Array:
        """Sum over j of the contributions of step j to all later nodes: shape (M, D), or (M, D, ...) as they are."""
        total: Array | None = None
        for j, part in enumerate(parts):
            poll()
            more = part.reshape(-1, self.count, *part.shape[1:])
            total = np.zeros((self.nodes, *more.shape[1:])) if total is None else total
            total[j + 1 :] += more
        return np.zeros((self.nodes, len(self.place))) if total is None else total[:, self.place]

    def _sizes(self, bounds: Array) -> Array:
        """Sum over j of |coefficients| ``bounds``_j, (N, n) or (N, n, B): shape (M, D) or (M, D, B), not rounded."""
        few, own = bool(len(self.others)), bounds[:, self.columns]
        if (whole := self._whole) is not None and np.isfinite(bounds).all():  # 0 times infinity is no number
            steps = self.nodes - 1
            row = [own[:steps], bounds[:steps, self.others].max(axis=1, keepdims=True)] if few else [own[:steps]]
            flat = np.concatenate(row, axis=1).reshape(-1, *bounds.shape[2:])
            return np.asarray((whole @ flat).reshape(self.nodes, self.count, *bounds.shape[2:])[:, self.place])
        return self._gather(
            size @ own[j] + (np.multiply.outer(self.rest[j], bounds[j, self.others].max(axis=0)) if few else 0.0)
            for j, size in enumerate(self._magnitudes or map(np.abs, self.coefficients))
        )

    @cached_property
    def _magnitudes(self) -> list[Array] | None:
        """|coefficients|; None where they are large."""
        few = sum(part.nbytes for part in self.coefficients) <= _KEPT
        return [np.abs(part) for part in self.coefficients] if few else None

    @cached_property
    def _whole(self) -> Array | None:
        """|coefficients| of all steps, and the rest, as one matrix; None where it would be large."""
        # a sum of _ROW products, in any order, errs by less than the 1e-12 that whoever asks `_sizes` adds
        steps, width, few = self.nodes - 1, len(self.columns), int(len(self.others) > 0)
        if (terms := steps * (width + few)) > _ROW or terms * self.nodes * self.count > _ENTRIES:
            return None
        rows = np.zeros((self.nodes, self.count, steps, width + few))
        for j, c in enumerate(self.coefficients):
            rows[j + 1 :, :, j, :width] = np.abs(c).reshape(-1, self.count, width)
            rows[j + 1 :, :, j, width:] = self.rest[j].reshape(steps - j, self.count, few)
        return rows.reshape(self.nodes * self.count, terms)

    def errors(self, sizes: Array) -> Array:
        """Effect of the rounded adjoint rows for states with |s_j| <= ``sizes`` (N + 1, n): shape (M, D)."""
        steps = self.nodes - 1
        own = np.einsum("jab,jb->ja", np.abs(self.transition[:steps]), sizes[:steps]) * (2 * _gamma(self.dimension))
        own = own + (self.error[:steps] * sizes[:steps].sum(axis=1))[:, None]
        return self._sizes(own * (1 + 1e-12) + _TINY) * (1 + 1e-12)

    def start(self, generators: Array) -> Array:
        """Support of the zonotope of ``generators`` (G, n) at node 0, carried to every node: shape (M, D)."""
        if not len(generators):
            return np.zeros((self.nodes, len(self.place)))
        value = np.abs(self.initial @ generators.T).sum(-1)
        slack = _gamma(self.dimension + len(generators)) * 2
        size = (np.abs(self.initial) @ np.abs(generators.T)).sum(-1)
        return np.asarray(value + slack * size + _TINY)[:, self.place]

    def boxes(self, radii: Array) -> Array:
        """Support of the sum of the boxes |b_j| <= ``radii`` (N, n): shape (M, D)."""
        return np.asarray(self._sizes(radii) * (1 + _gamma(2 * self.nodes + self.dimension) * 2 + 1e-12))

    def centred(self, values: Array, radii: Array) -> tuple[Array, Array]:
        """The response to b_j = ``values`` (N, n), and the support of the boxes |b_j| <= ``radii`` around them.

        The latter includes the rounding error of the former, and what the other columns do.
        """
        total = self._gather(c @ values[j, self.columns] for j, c in enumerate(self.coefficients))
        size, rounding = np.abs(values), _gamma(2 * self.nodes + self.dimension) * 2
        both = self._sizes(np.stack([radii, size], axis=-1))
        slack = both[..., 0] * (1 + rounding + 1e-12) + both[..., 1] * rounding + _TINY
        if len(self.others):
            slack = slack + self._gather(
                rest * size[j, self.others].max() for j, rest in enumerate(self.rest)) * (1 + 1e-12)
        return total, slack

    def segments(self, generators: Array) -> Array:
        """Support of the sum over j of the zonotopes of ``generators`` (N, G, n): shape (M, D)."""

        def part(j: int, c: Array) -> Array:
            own, count = generators[j][:, self.columns], generators.shape[1]
            size = np.abs(generators[j]).sum(axis=0)
            found = np.abs(c @ own.T).sum(-1) + np.abs(c) @ size[self.columns] * (_gamma(self.dimension + count) * 2)
            return np.asarray(found + (self.rest[j] * size[self.others].max() if len(self.others) else 0.0))

        if not generators.size:
            return np.zeros((self.nodes, len(self.place)))
        total = self._gather(part(j, c) for j, c in enumerate(self.coefficients))
        return np.asarray(total * (1 + _gamma(2 * self.nodes + generators.shape[1]) * 2 + 1e-12))


def _times(rows: Array, matrix: Array) -> Array:
    """``rows`` @ ``matrix``, by a sparse product where that pays."""
    if len(matrix) < _LARGE or np.count_nonzero(matrix) > matrix.size * _SPARSE:
        return rows @ matrix
    from scipy.sparse import csr_array

    return np.ascontiguousarray((csr_array(matrix.T) @ rows.T).T)
