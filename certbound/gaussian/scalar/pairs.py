"""Probabilities of pairs and unions of Gaussian events, and the plumbing that events share."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.gaussian.scalar.normal import EPS, lift, log_below_above, log_tail
from certbound.rigor.rounding import down, quiet, up

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
def log_pair(
    below: ArrayLike, variance_below: Bounds, above: ArrayLike, variance_above: Bounds, covariance: Bounds
) -> Array:
    """Upper bound of log P(X <= below, Y > above), (X, Y) centred Gaussian with second moments in intervals.

    Proves the bound for every covariance matrix within the intervals: it takes the largest below/s_X, the
    least above/s_Y and the least correlation, in which the probability is monotone (Plackett). Zero
    variances are allowed.

    Parameters
    ----------
    below : array_like
    variance_below : Bounds
    above : array_like
    variance_above, covariance : Bounds
        The levels, and enclosures of Var X, Var Y >= 0 and cov(X, Y), which broadcast with each other.
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
