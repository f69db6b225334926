"""Rice's formula with enclosures: expected crossings of a smooth Gaussian process, piece by piece."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.gaussian.scalar.normal import EPS, LOG_ROOT_2PI, lift, log_tail, mills_deficit
from certbound.gaussian.scalar.pairs import Bounds, ends, levels_of, standard_levels, total
from certbound.rigor.rounding import down, quiet, up


@quiet
def crossing_rate(
    durations: ArrayLike,
    levels: ArrayLike,
    variance: Bounds,
    covariance: Bounds,
    velocity_variance: Bounds,
    *,
    start_variance: Bounds | None = None,
) -> Any:
    """Upper bound of log10 P(exists t: xi_t > z_t) for a process xi with continuous derivative eta.

    Proves: P <= P(xi_0 > z_0) + E #{up-crossings}, and the expected number is int phi(z/s)/s E(m + v N)^+
    dt, m = c z/s^2 - z', v^2 = Var eta - c^2/s^2, c = cov(xi, eta) (Rice; as an upper bound by Kac's
    formula and Fatou's lemma, no tangency because xi_t has a bounded density). On each piece the integrand
    is bounded by sup phi(z/s)/s times E(m + v N)^+ = m^+ + v phi(m/v) (1 - |m/v| R(|m/v|)) at the largest m
    and v; or, where s may vanish, from |c| <= s sd(eta): by phi(z/s)/s (sd(eta) (z/s + phi(0)) + (z')^-). A
    level that jumps down from z- to z+ adds P(z+ < xi <= z-) <= (z- - z+) sup phi(z+/s)/s.

    Parameters
    ----------
    durations : array_like, shape (K,)
        Lengths of the pieces, > 0.
    levels : array_like, shape (..., K) or (..., K, 2)
        Lower bound of the level on each piece: a constant, or a line by its two ends. A trailing axis of
        length 2 after an axis of length K means ends. Levels must be finite.
    variance, covariance, velocity_variance : Bounds, shape (..., K)
        Enclosures of s^2, c and Var eta over each piece.
    start_variance : Bounds, optional
        Enclosure of s^2 at the start; that of the first piece when omitted.

    Returns
    -------
    float or ndarray, shape (...)

    Notes
    -----
    Needs xi continuously differentiable (a_t^T g_t = 0 throughout, a_t continuously differentiable): where
    the direction a_t jumps, begin a new call and add the two. Source: theory of the linear-response tube.

    Examples
    --------
    >>> exact = np.log10(float(np.exp(log_tail(4.0))) + 10 * np.exp(-8.0) / (2 * np.pi))
    >>> value = crossing_rate([10.0], [4.0], [1.0], [0.0], [1.0])
    >>> bool(0 <= value - exact < 1e-12)
    True
    """
    parts = log_crossings(durations, levels, variance, covariance, velocity_variance, start_variance=start_variance)
    return total(lift(np.concatenate(parts, axis=-1), 64), axis=-1)


@quiet
def log_crossings(
    durations: ArrayLike, levels: ArrayLike, variance: Bounds, covariance: Bounds, velocity_variance: Bounds, *,
    start_variance: Bounds | None = None,
) -> tuple[Array, Array, Array]:
    """The parts of `crossing_rate`, as natural logarithms: at the start (..., 1), of each piece (..., K), of jumps."""
    h = np.atleast_1d(np.asarray(durations, dtype=np.float64))
    if h.ndim != 1 or not np.all((h > 0) & (h < np.inf)):
        raise ValueError("`durations` must be a row of positive numbers.")
    left, right = _line_ends(levels_of(levels), len(h))
    v_lo, v_hi = ends(variance, "variance", least=0.0)
    c_lo, c_hi = ends(covariance, "covariance")
    _, e_hi = ends(velocity_variance, "velocity_variance", least=0.0)
    for name, array in (("variance", v_lo), ("covariance", c_lo), ("velocity_variance", e_hi)):
        if array.shape[-1:] != h.shape:
            raise ValueError(f"`{name}` must end in an axis of {len(h)} entries, got shape {array.shape}.")
    first = (v_lo[..., 0], v_hi[..., 0])
    if start_variance is not None:
        first = ends(start_variance, "start_variance", least=0.0)
    initial = log_tail(standard_levels(left[..., 0], *first)[0])
    low, high = np.minimum(left, right), np.maximum(left, right)
    fall = np.maximum(up(up(left - right) / h), 0.0)  # (z')^-
    slope = down(down(right - left) / h)
    mean = _largest_drift(low, high, v_lo, v_hi, c_lo, c_hi) - slope
    mean = mean + 4 * EPS * (np.abs(mean) + np.abs(slope))
    nearest = np.where((c_lo <= 0) & (c_hi >= 0), 0.0, np.minimum(np.abs(c_lo), np.abs(c_hi)))
    rest = np.maximum(up(e_hi - nearest * nearest / v_hi * (1 - 4 * EPS)), 0.0)
    rest = np.where(v_hi > 0, rest, e_hi)
    log_density = _largest_density(low, high, v_lo, v_hi)
    near = log_density + _log_positive_part(mean, up(np.sqrt(rest)))
    far = _vanishing(low, v_hi, up(np.sqrt(e_hi)), fall)
    rates = np.fmin(np.where(np.isnan(near), np.inf, near), far) + np.log(h)
    initial = np.broadcast_to(initial, rates.shape[:-1])[..., None]
    jumps = np.broadcast_to(_log_jumps(left, right, v_lo, v_hi), (*rates.shape[:-1], len(h) - 1))
    return initial, rates, jumps


def _log_jumps(left: Array, right: Array, v_lo: Array, v_hi: Array) -> Array:
    """Logs of what a level adds where it jumps down, P(z+ < xi <= z-), at every node between two pieces."""
    drop = right[..., :-1] - left[..., 1:]
    drop = np.where(drop > 0, up(drop), 0.0)
    node = (np.maximum(v_lo[..., :-1], v_lo[..., 1:]), np.minimum(v_hi[..., :-1], v_hi[..., 1:]))
    node = (np.minimum(*node), node[1])
    after, upper = left[..., 1:], np.maximum(left[..., 1:], right[..., :-1])
    jumps = np.where(drop > 0, np.log(drop) + _largest_density(after, upper, *node), -np.inf)
    return np.fmin(jumps, np.where(drop > 0, log_tail(standard_levels(after, *node)[0]), -np.inf))


def _line_ends(levels: Array, count: int) -> tuple[Array, Array]:
    if not np.all(np.isfinite(levels)):
        raise ValueError("`levels` must be finite; leave out the pieces without a constraint.")
    if levels.shape[-2:] == (count, 2):
        return levels[..., 0], levels[..., 1]
    if levels.shape[-1:] == (count,):
        return levels, levels
    raise ValueError(f"`levels` must end in the shape ({count},) or ({count}, 2), got {levels.shape}.")


def _largest_drift(low: Array, high: Array, v_lo: Array, v_hi: Array, c_lo: Array, c_hi: Array) -> Array:
    """Upper bound of c z/s^2 over the enclosures."""
    product = np.maximum(np.maximum(c_lo * low, c_lo * high), np.maximum(c_hi * low, c_hi * high))
    product = up(product)
    value: Array = up(np.where(product >= 0, product / v_lo, product / v_hi))
    return np.where(product == 0, 0.0, value)


def _largest_density(low: Array, high: Array, v_lo: Array, v_hi: Array) -> Array:
    """Upper bound of log(phi(z/s)/s) over z in [low, high] and s^2 in [v_lo, v_hi]; largest at s = |z|."""
    size = np.where((low <= 0) & (high >= 0), 0.0, np.minimum(np.abs(low), np.abs(high)))
    square = size * size
    v = np.clip(square, v_lo, v_hi)
    value = -0.5 * square / v - 0.5 * np.log(v) - LOG_ROOT_2PI
    value = value + 16 * EPS * (1 + square / v + np.abs(np.log(v)))
    value = np.where(v > 0, value, np.where(square > 0, -np.inf, np.inf))
    return np.where(np.isnan(value), np.inf, value)


def _log_positive_part(mean: Array, deviation: Array) -> Array:
    """Upper bound of log E(m + v N)^+, E(m + v N)^+ = m^+ + v phi(|m|/v) (1 - (|m|/v) R(|m|/v))."""
    ratio = np.minimum(np.abs(mean) / deviation, 1e150) * (1 - 4 * EPS)
    bell = -0.5 * ratio * ratio * (1 - 8 * EPS) - LOG_ROOT_2PI
    spread = np.where(deviation > 0, np.log(deviation) + bell + np.log(mills_deficit(ratio)), -np.inf)
    return lift(np.logaddexp(np.log(np.maximum(mean, 0.0)), spread), 64)


def _vanishing(low: Array, v_hi: Array, deviation: Array, fall: Array) -> Array:
    """Log of the bound by |c| <= s sd(eta), for z >= low > 0 and s^2 in (0, v_hi]; r = z/s >= low/s_hi.

    phi(r)/s = r phi(r)/z <= sup r phi(r)/low, and phi(r) r/s <= sup r^2 phi(r)/low; the suprema over r >=
    r_0 are at max(r_0, 1) and max(r_0, sqrt 2).
    """
    least = np.where(v_hi > 0, low / up(np.sqrt(v_hi)), np.inf) * (1 - 4 * EPS)
    one, two = np.maximum(least, 1.0), np.maximum(least, np.sqrt(2.0))
    linear = np.log(one) - 0.5 * one * one - LOG_ROOT_2PI
    square = 2 * np.log(two) - 0.5 * two * two - LOG_ROOT_2PI
    value = np.logaddexp(np.log(deviation) + square, np.log(0.4 * deviation + fall) + linear) - np.log(low)
    value = value + 64 * EPS * (1 + two * two)
    return np.where((low > 0) & ~np.isnan(value), value, np.where((v_hi > 0) | (low < 0), np.inf, -np.inf))
