"""Linear response along a nominal curve: the exact part of Thm K7, with every rounding error bounded.

On piece k of length h the slope is Jhat(tau) = A + tau K with float matrices A, K taken as exact, so that the
transition matrix F = Phi(t_{k+1}, t_k) is a convergent power series. Float values of F and of the covariance V
stand beside proved error bounds.

Discrete time is the case K = 0, F = A, h = 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Integers
from certbound.errors import EngineError
from certbound.rigor.rounding import quiet
from certbound.watch import poll

_UNIT = 2.0**-53
TINY = 1e-300
_TERMS = 24
_MILD = 2.0  # norm of the slopes times a piece, up to which series run well in the states' own units
_SWEEPS, _FARTHEST = 20, 60  # of balancing; exponent of a unit


def gamma(count: int) -> float:
    """Bound of the relative rounding error of a sum of ``count`` products (any order of summation)."""
    return 1.01 * (count + 2) * _UNIT


def _absmul(a: Array, b: Array) -> Array:
    """Upper bound of |a| |b| for nonnegative results, rounded up."""
    return np.asarray((np.abs(a) @ np.abs(b)) * (1 + 2 * gamma(a.shape[-1])) + TINY)


def _transposed(a: Array) -> Array:
    return np.swapaxes(a, -1, -2)


def _norm(a: Array) -> Array:
    """Upper bound of the maximum row sum."""
    return np.asarray(np.abs(a).sum(-1).max(-1) * (1 + gamma(a.shape[-1])))


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

    @quiet
    def covariance_of(self, first: Array, second: Array, nodes: Integers) -> tuple[Array, Array]:
        """Bounds of cov(first Z, second Z) at ``nodes``; rows (B, M, n). Where numbers overflow they are infinite."""
        n = first.shape[-1]
        used = np.flatnonzero((first != 0).any(axis=(0, 1)) | (second != 0).any(axis=(0, 1)))
        if 2 * len(used) < n:  # zero entries add nothing
            first, second = first[..., used], second[..., used]
            place = np.ix_(np.arange(len(self.covariance)), nodes, used, used)
            v, w = self.covariance[place], self.covariance_error[place]
        else:
            v, w = self.covariance[:, nodes], self.covariance_error[:, nodes]
        value = np.einsum("bmi,bmij,bmj->bm", first, v, second)
        rounding = 2 * gamma(n * n) * np.einsum("bmi,bmij,bmj->bm", abs(first), abs(v), abs(second))
        own = [np.einsum("bmi,bmij,bmj->bm", r, w, r) + gamma(n * n) * 2 * np.einsum(
            "bmi,bmij,bmj->bm", abs(r), abs(w), abs(r)) for r in (first, second)]
        roots = [np.sqrt(np.maximum(square, 0)) for square in own]  # of the factors: their product may pass all floats
        error = roots[0] * roots[1] * (1 + 1e-12) + rounding + TINY
        low, high = value - error, value + error
        return np.where(np.isnan(low), -np.inf, low), np.where(np.isnan(high), np.inf, high)


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
    if not np.all(ratio <= 0.5):
        raise _too_stiff(float((alpha + kappa).max()))
    tail = 4.1 * (big + small) * np.maximum(ratio, TINY)
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
    if not np.all(ratio <= 0.5):
        raise _too_stiff(float((alpha + kappa).max()) / 2)
    scale = _norm(gram) * step
    error = (4.1 * (big + small) * np.maximum(ratio, TINY)
             + _TERMS * (3 * n + 12) * 4 * _UNIT * np.exp(alpha + kappa)) * scale
    return total, np.asarray(error + TINY)


def _propagate(
    transition: Array, transition_error: Array, noise: Array, noise_error: Array, start: Array,
    start_error: Array | None = None,
) -> tuple[Array, Array]:
    """V_{k+1} = F V_k F^T + Q_k in floats, and W with |V_exact - V| <= W as quadratic forms."""
    cells, pieces, n, _ = transition.shape
    v = np.zeros((cells, pieces + 1, n, n))
    w = np.zeros_like(v)
    v[:, 0] = start
    w[:, 0] = np.eye(n) * (2 * n * _UNIT * float(np.abs(start).max(initial=0.0)))
    if start_error is not None:
        w[:, 0] += np.diag(start_error.sum(axis=-1) * (1 + gamma(n)))
    eye = np.eye(n)
    for k in range(pieces):
        poll()
        f, phi = transition[:, k], transition_error[:, k]
        product = f @ v[:, k] @ _transposed(f) + noise[:, k]
        v[:, k + 1] = (product + _transposed(product)) / 2
        size_f, size_v, size_w = _norm(f), _norm(v[:, k]), _norm(w[:, k])
        columns = _norm(_transposed(f))
        spread = n * phi * (size_f + columns + n * phi)
        rounding = 2 * gamma(2 * n + 4) * (size_f * columns * (size_v + size_w) + _norm(v[:, k + 1]))
        residual = n * (rounding + noise_error[:, k]) + n * spread * (size_v + size_w)
        grown = f @ w[:, k] @ _transposed(f)
        w[:, k + 1] = (grown + _transposed(grown)) / 2 + (residual * (1 + 1e-10) + TINY)[:, None, None] * eye
    return v, w


def _finite(response: LinearResponse) -> LinearResponse:
    """The response; what overflowed says nothing of what it bounds.

    Raises
    ------
    EngineError
        If some number of it is beyond all floats.
    """
    parts = (response.transition, response.transition_error, response.deviation, response.covariance,
             response.covariance_error)  # fmt: skip
    if not all(np.isfinite(part).all() for part in parts):
        raise EngineError(
            "the response of the linearised system grows beyond all floats before the horizon, or what its rounding "
            "may cost does; shorten the horizon, or rescale the states."
        )
    return response


@dataclass(frozen=True, eq=False, kw_only=True)
class Jumps:
    """Pieces at which the state jumps by z -> S z: their numbers, S (B, J, n, n), and an entrywise error bound.

    They have no slope, no noise, and the length of all others only in what is divided by it.
    """

    places: tuple[int, ...]
    matrices: Array
    error: float


@quiet
def continuous_response(
    slope: Array, drift: Array, step: float, diffusion: Array, start: Array, *, slope_error: float = 0.0,
    jumps: Jumps | None = None, start_error: Array | None = None,
) -> LinearResponse:
    """Linear data in continuous time: dZ = (A + tau K) Z dt + g dW on every piece.

    ``diffusion`` is g (n, m), or one matrix a cell and piece, (B, N, n, m).
    ``start_error`` bounds entrywise how far the start's covariance is from its floats, (n, n).
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
    noise_error = noise_error + gamma(diffusion.shape[-1]) * 4 * step * float(
        (np.abs(own_noise) @ _transposed(np.abs(own_noise))).max(initial=0.0)
    )
    if jumps is not None:
        own = np.array(jumps.places)
        transition[:, own], error[:, own] = jumps.matrices / back, jumps.error / float(back.min())
        deviation[:, own] = 0.0
    v, w = _propagate(
        transition, error, noise, noise_error, start / size, None if start_error is None else start_error / size)
    return _finite(LinearResponse(
        step=step, slope=slope, drift=drift, transition=transition * back, transition_error=error * float(back.max()),
        deviation=deviation * back + TINY, covariance=v * size, slope_error=slope_error,
        covariance_error=w * size + len(unit) * TINY * np.eye(len(unit)),
        jumps=() if jumps is None else jumps.places,
    ))


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


@quiet
def discrete_response(
    slope: Array, covariance: Array, covariance_bound: float, start: Array, *, slope_error: float = 0.0,
    start_error: Array | None = None,
) -> LinearResponse:
    """Linear data in discrete time: Z+ = A Z + w with Cov(w) (or its proxy) given up to an entrywise bound."""
    cells, steps = slope.shape[:2]
    noise = np.broadcast_to(covariance, slope.shape)
    none = np.full((cells, steps), slope_error)
    v, w = _propagate(slope, none, noise, np.zeros_like(none) + covariance_bound, start, start_error)
    zero = np.zeros_like(slope)
    return _finite(LinearResponse(
        step=1.0, slope=slope, drift=zero, transition=slope, transition_error=none,
        deviation=zero, covariance=v, covariance_error=w, slope_error=slope_error,
    ))
