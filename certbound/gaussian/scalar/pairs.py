"""Exceedances of Gaussian sequences and martingales from pair probabilities, and the plumbing they share."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from certbound.gaussian.scalar.normal import EPS, lift, log_below_above, log_tail
from certbound.rigor.rounding import down, quiet, up

__all__ = [
    "Bounds", "double", "ends", "exceedance_chain", "levels_of", "log_pair", "log_window", "standard_levels",
    "total", "total_symmetric", "union",
]  # fmt: skip

Array = NDArray[np.float64]
_NEGLIGIBLE = 45.0  # terms this far below the largest keep the plain tail: together below 1e-19 T of the sum
Bounds = Any
"""A pair (lo, hi) of array_likes, an object with attributes ``lo`` and ``hi``, or one array_like for both."""


def ends(value: Bounds, name: str, *, least: float = -np.inf) -> tuple[Array, Array]:
    """Lower and upper ends of a ``Bounds`` argument, checked: no NaN, lo <= hi, lo >= ``least``."""
    if hasattr(value, "lo") and hasattr(value, "hi"):
        value = (value.lo, value.hi)
    pair = value if isinstance(value, tuple) else (value, value)
    if len(pair) != 2:
        raise ValueError(f"`{name}` must be one array or a pair (lo, hi), got a tuple of length {len(pair)}.")
    lo, hi = np.broadcast_arrays(*(np.asarray(end, dtype=np.float64) for end in pair))
    if not np.all(lo <= hi):
        raise ValueError(f"`{name}` must satisfy lo <= hi, without NaN.")
    if not np.all(lo >= least):
        raise ValueError(f"`{name}` must be at least {least:g}, got {float(np.min(lo)):g}.")
    return lo, hi


def levels_of(value: ArrayLike, name: str = "levels") -> Array:
    """An array of levels: +inf allowed (no constraint), NaN refused."""
    array = np.asarray(value, dtype=np.float64)
    if np.any(np.isnan(array)):
        raise ValueError(f"`{name}` must not contain NaN.")
    return array


@quiet
def standard_levels(levels: Array, lo: Array, hi: Array) -> tuple[Array, Array]:
    """Least and largest z/s over s^2 in [lo, hi]; s = 0 means +inf for z >= 0, -inf for z < 0 (0 > z?)."""
    least, largest = down(np.sqrt(lo)), up(np.sqrt(hi))
    least, largest = np.where(lo > 0, least, 0.0), np.where(hi > 0, largest, 0.0)
    positive = levels >= 0
    small = down(levels / np.where(positive, largest, least))
    large = up(levels / np.where(positive, least, largest))
    small = np.where(levels == 0, 0.0, small)
    small = np.where(positive & (largest == 0), np.inf, small)
    large = np.where(levels == 0, np.where(least > 0, 0.0, np.inf), large)
    return np.where(levels == np.inf, np.inf, small), np.where(levels == np.inf, np.inf, large)


@quiet
def total(logs: ArrayLike, axis: int | tuple[int, ...] | None = None) -> Any:
    """Upper bound of log10 of the sum of probabilities given by natural logarithms, at most 0.

    Proves: log10 sum exp(logs) <= total(logs); -inf for an empty or impossible event.

    Examples
    --------
    >>> round(float(total([np.log(1e-5), np.log(2e-5)])), 6)
    -4.522879
    """
    array = np.asarray(logs, dtype=np.float64)
    if array.size == 0:
        return -np.inf
    top = np.max(array, axis=axis, keepdims=True)
    safe = np.where(np.isfinite(top), top, 0.0)
    mass = np.sum(np.exp(array - safe), axis=axis, keepdims=True)
    value = lift(safe + np.log(mass), 32 + array.size) / np.log(10.0)
    value = np.minimum(lift(value, 4), 0.0)
    result = np.squeeze(np.where(top == np.inf, 0.0, value), axis=axis)
    return float(result) if result.ndim == 0 else result


@quiet
def total_symmetric(logs: ArrayLike) -> float:
    """Upper bound of log10 P(some |xi^j| leaves its levels), given ln of bounds for each j, all jointly Gaussian.

    Proves: 1 - prod_j (1 - p_j), by Royen's Gaussian correlation inequality: centred Gaussian probabilities
    of convex sets symmetric about 0, such as {|xi^j_t| <= z^j_t for all t}, multiply at worst. Never above
    the sum; only for two-sided events with the same level on both sides.

    Examples
    --------
    >>> fourteen = np.full(14, np.log(2.0) + log_tail(2.5))
    >>> round(1 - 10 ** total_symmetric(fourteen), 3)
    0.839
    """
    array = np.minimum(np.atleast_1d(np.asarray(logs, dtype=np.float64)), 0.0)
    summed = float(total(array))
    if summed < -12:  # the product would gain less than its rounding
        return summed
    kept = float(np.sum(np.log1p(-np.minimum(np.exp(lift(array, 8)) + 1e-300, 1.0))))
    if not np.isfinite(kept):
        return 0.0
    share = -np.expm1(kept * (1 + (32 + array.size) * EPS))
    return min(summed, float(total(np.log(np.asarray([share])))))


def double(log10_probability: ArrayLike) -> Any:
    """Two-sided event from a one-sided bound: P(exists t: |xi_t| > z_t) <= 2 P(exists t: xi_t > z_t)."""
    value = np.asarray(log10_probability, dtype=np.float64) + np.log10(2.0) * (1 + 4 * EPS)
    value = np.minimum(up(value), 0.0)
    return float(value) if value.ndim == 0 else value


@quiet
def log_pair(
    below: ArrayLike, variance_below: Bounds, above: ArrayLike, variance_above: Bounds, covariance: Bounds
) -> Array:
    """Upper bound of log P(X <= below, Y > above), (X, Y) centred Gaussian with second moments in intervals.

    Proves the bound for every covariance matrix within the intervals: it takes the largest below/s_X, the
    least above/s_Y and the least correlation, in which the probability is monotone (Plackett). Zero
    variances are allowed.

    Parameters
    ----------
    below, above : array_like
        Levels; they broadcast with the moments.
    variance_below, variance_above, covariance : Bounds
        Enclosures of Var X, Var Y >= 0 and cov(X, Y).
    """
    v_lo, v_hi = ends(variance_below, "variance_below", least=0.0)
    w_lo, w_hi = ends(variance_above, "variance_above", least=0.0)
    c_lo, _ = ends(covariance, "covariance")
    _, a = standard_levels(levels_of(below, "below"), v_lo, v_hi)
    b, _ = standard_levels(levels_of(above, "above"), w_lo, w_hi)
    large, small = up(np.sqrt(v_hi)) * up(np.sqrt(w_hi)), down(np.sqrt(v_lo)) * down(np.sqrt(w_lo))
    product = np.where(c_lo >= 0, up(large), np.maximum(down(small), 0.0))
    rho = np.clip(down(c_lo / product), -1.0, 1.0)
    return log_below_above(a, b, np.where(np.isnan(rho), -1.0, rho))


def exceedance_chain(levels: ArrayLike, variances: Bounds, covariances: Bounds) -> Any:
    """Upper bound of log10 P(exists t = 1..T: xi_t > z_t) in discrete time, for **Gaussian** noise only.

    Proves: P <= P(xi_1 > z_1) + sum_t P(xi_t <= z_t, xi_{t+1} > z_{t+1}), by the first index that exceeds;
    each term is at most P(xi_{t+1} > z_{t+1}), so that the plain union bound is never smaller. Under
    conditionally sub-Gaussian noise the pair probabilities are not those of a Gaussian and the sum is false
    (up to nine times delta in examples): there use `union`.

    Parameters
    ----------
    levels : array_like, shape (..., T)
        Lower bounds of z_t; +inf where nothing is asked.
    variances : Bounds, shape (..., T)
        Enclosures of Var xi_t; 0 is a deterministic xi_t = 0.
    covariances : Bounds, shape (..., T - 1)
        Enclosures of cov(xi_t, xi_{t+1}).

    Returns
    -------
    float or ndarray, shape (...)

    Raises
    ------
    ValueError
        If shapes disagree, an enclosure is empty or a variance is negative.

    Notes
    -----
    Source: theory of the linear-response tube, scalar events in discrete time.

    Examples
    --------
    >>> value = exceedance_chain([3.0, 3.0], [1.0, 1.0], [1.0])
    >>> bool(abs(value - float(log_tail(3.0)) / np.log(10)) < 1e-6)
    True
    """
    z = levels_of(levels)
    v_lo, v_hi = ends(variances, "variances", least=0.0)
    c_lo, c_hi = ends(covariances, "covariances")
    if z.ndim == 0 or v_lo.shape[-1:] != z.shape[-1:] or c_lo.shape[-1:] != (z.shape[-1] - 1,):
        raise ValueError(
            "`levels` and `variances` must have T entries on the last axis and `covariances` T - 1, got "
            f"shapes {z.shape}, {v_lo.shape}, {c_lo.shape}."
        )
    first, _ = standard_levels(z[..., 0], v_lo[..., 0], v_hi[..., 0])
    start = log_tail(first)
    before, after = (v_lo[..., :-1], v_hi[..., :-1]), (v_lo[..., 1:], v_hi[..., 1:])
    steps = log_tail(standard_levels(z[..., 1:], *after)[0])
    parts = np.broadcast_arrays(steps, z[..., :-1], *before, z[..., 1:], *after, c_lo, c_hi)
    steps = np.array(parts[0])
    start = np.broadcast_to(start, steps.shape[:-1])
    largest = np.maximum(np.max(steps, axis=-1, initial=-np.inf), start)[..., None]
    counts = (steps > largest - _NEGLIGIBLE) & (steps > -np.inf)
    if np.any(counts):
        z0, v0, v1, z1, w0, w1, c0, c1 = (part[counts] for part in parts[1:])
        steps[counts] = np.minimum(steps[counts], log_pair(z0, (v0, v1), z1, (w0, w1), (c0, c1)))
    return total(np.concatenate([start[..., None], steps], axis=-1), axis=-1)


@quiet
def union(levels: ArrayLike, variances: Bounds, *, gaussian: bool = False) -> Any:
    """Upper bound of log10 P(exists t: xi_t > z_t) by the union bound, for sub-Gaussian xi_t.

    Proves: P <= sum_t exp(-z_t^2/(2 V_t)) for z_t >= 0 when E exp(l xi_t) <= exp(l^2 V_t/2) for every l > 0
    (Chernoff); ``gaussian=True`` replaces the terms by Q(z_t/s_t). No assumption on the dependence.

    Parameters
    ----------
    levels : array_like, shape (..., T)
        Lower bounds of z_t.
    variances : Bounds, shape (..., T)
        Variance proxies V_t (upper ends are used; with ``gaussian`` and z_t < 0 lower ends too).

    Returns
    -------
    float or ndarray, shape (...)

    Examples
    --------
    >>> round(union([3.0], [1.0]), 6)
    -1.954325
    """
    z = levels_of(levels)
    lo, hi = ends(variances, "variances", least=0.0)
    small, _ = standard_levels(z, lo, hi)
    if gaussian:
        return total(log_tail(small), axis=-1)
    size = np.clip(small, 0.0, 1e150)
    logs = -0.5 * size * size * (1 - 4 * EPS)
    return total(np.where(small == np.inf, -np.inf, logs), axis=-1)


@quiet
def log_window(levels: ArrayLike, variance: Bounds, increment: Bounds) -> Array:
    """Upper bound of log P(M_0 <= z and sup M > z over a window), M a continuous Gaussian martingale.

    Proves: the probability equals 2 P(M_0 <= z, M_1 > z) (reflection at the first passage: M_1 - z is
    symmetric after it), where corr(M_0, M_1)^2 = Var M_0/(Var M_0 + increment). It is bounded over the
    enclosures by taking the largest z/s_0, the least z/s_1 and the least correlation.

    Parameters
    ----------
    levels : array_like, shape (...)
        z, constant on the window.
    variance : Bounds, shape (...)
        Enclosure of Var M_0 >= 0 at the start of the window.
    increment : Bounds, shape (...)
        Enclosure of Var M_1 - Var M_0 >= 0, the quadratic variation of the window.

    Returns
    -------
    ndarray
        Natural logarithms, at most 0.

    Notes
    -----
    For xi_t = a_t^T Z_t: M_s = Phi(t_{k+1}, s) Z_s, and the link from one window to the next is `log_pair`.

    Examples
    --------
    >>> bool(abs(log_window(2.0, 0.0, 1.0) - np.log(2) - log_tail(2.0)) < 1e-12)
    True
    """
    z = levels_of(levels)
    v_lo, v_hi = ends(variance, "variance", least=0.0)
    w_lo, w_hi = ends(increment, "increment", least=0.0)
    _, a = standard_levels(z, v_lo, v_hi)
    b, _ = standard_levels(z, down(v_lo + w_lo) * (z < 0), up(v_hi + w_hi))
    whole = down(v_lo + w_hi)
    spread = up(np.sqrt(w_hi)) / down(down(np.sqrt(whole)) + down(np.sqrt(v_lo)))
    spread = np.where(w_hi == 0, 0.0, np.maximum(up(spread), 0.0))
    spread = np.where(np.isnan(spread) | (v_lo == 0), np.where(w_hi == 0, 0.0, 1.0), spread)
    value = log_below_above(a, b, spread=spread) + np.log(2.0)
    result: Array = np.minimum(lift(value, 4), 0.0)
    return result
