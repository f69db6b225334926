"""First passage of a scalar linear equation d xi = c xi dt + sigma dW from 0, over a constant level."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from certbound.gaussian.scalar.normal import EPS, log_between
from certbound.gaussian.scalar.ornstein_uhlenbeck import log_polygon_crossing
from certbound.gaussian.scalar.pairs import double, total
from certbound.gaussian.scalar.scale import least_scale
from certbound.gaussian.scalar.slepian import group_windows
from certbound.rigor.rounding import quiet

__all__ = ["linear_exceedance", "linear_radius"]

Array = NDArray[np.float64]

_WEIGHT = 2.5
_MOST_WINDOWS = 400
_RANGE = 24.0  # how far back in log u windows may begin
_EARLY = 8.0  # the window from 0 keeps (z/s)^2 above its least value by this much


@quiet
def linear_exceedance(durations: ArrayLike, rates: ArrayLike, sigmas: ArrayLike, level: float) -> float:
    """Upper bound of log10 P(exists t <= T: xi_t > level) for d xi = c xi dt + sigma dW, xi_0 = 0.

    Proves: xi_t = exp(C_t) B_u with C = int c, u = int exp(-2C) sigma^2 dt and a Brownian motion B, so that
    xi exceeds the level when B_u > b(u) = level exp(-C). With constant c and sigma b^2 is linear in u: b is
    concave, hence above its chords; windows from u_1 on by `log_polygon_crossing`, one line from u = 0 to
    u_1 below the first part. u and b are known to a relative ``guard``, by which the levels are lowered and
    the clock log(u)/2 stretched.

    Parameters
    ----------
    durations, rates, sigmas : array_like, shape (K,)
        Lengths of the pieces, c and sigma >= 0 on them (scalars broadcast).
    level : float
        > 0.

    Raises
    ------
    ValueError
        For lengths that are not positive, negative sigma, a level <= 0, or exponents sum |c| h beyond 1e4.
    """
    h, c, sigma = (np.atleast_1d(np.asarray(v, dtype=np.float64)) for v in (durations, rates, sigmas))
    h, c, sigma = np.broadcast_arrays(h, c, sigma)
    if h.ndim != 1 or not np.all((h > 0) & np.isfinite(h)) or not np.all(np.isfinite(c)):
        raise ValueError("`durations` must be positive and `rates` finite, each a number or a row.")
    if not np.all((sigma >= 0) & np.isfinite(sigma)):
        raise ValueError("`sigmas` must be finite and not negative.")
    if not 0 < level < math.inf:
        raise ValueError(f"`level` must be positive, got {level}.")
    exponent = float(np.sum(np.abs(c) * h))
    if exponent > 1e4:
        raise ValueError(f"`rates` times `durations` sum to {exponent:g} > 1e4; shorten the horizon.")
    guard = max(1e-10, 16 * EPS * (len(h) + 16) * (1 + exponent))
    exponents = np.concatenate([[0.0], np.cumsum(c * h)])
    log_u, log_b = _refine(h, c, sigma, exponents, level)
    if not np.isfinite(log_u[-1]):
        return -np.inf
    # one node per value of u: b on arrival, on leaving, and the least while u stands still (sigma = 0)
    begin = np.flatnonzero(np.concatenate([[True], np.diff(log_u) > 0]))
    final = np.append(begin[1:], len(log_u)) - 1
    low = np.minimum.reduceat(log_b, begin)
    arrive, leave = log_b[begin], log_b[final]
    leave = np.where(low < np.minimum(arrive, leave), low, leave)
    log_u = log_u[begin]
    q_low = np.exp(low - 0.5 * log_u)
    least = float(np.min(q_low))
    first, origin = _first_window(log_u, low, math.sqrt(least * least + _EARLY), guard)
    steps = 0.5 * np.diff(log_u[first:]) * (1 + guard) + guard
    clock = np.concatenate([[0.0], np.cumsum(steps)])
    left = np.exp(leave - 0.5 * log_u)[first:-1] * (1 - 4 * guard)
    right = np.exp(arrive - 0.5 * log_u)[first + 1 :] * (1 - 4 * guard)
    if len(steps) == 0:
        logs, end = log_polygon_crossing([], [], [], origin=origin), origin[1]
    else:
        span = max(_span(least), float(clock[-1]) / _MOST_WINDOWS)
        lines = group_windows(clock, left, right, span)
        logs = log_polygon_crossing(lines.spans, lines.starts, lines.stops, origin=origin)
        end = float(lines.stops[-1])
    last = log_between(float(q_low[-1]) * (1 - 4 * guard), end)
    return float(total(np.append(logs, last)))


def _first_window(log_u: Array, log_b: Array, clear: float, guard: float) -> tuple[int, tuple[float, float]]:
    """The last node that a line from u = 0 reaches below all nodes and ``clear`` of 0 in units of s; that line."""
    top = float(np.max(log_b))
    b = np.exp(log_b - top)
    share = np.exp(np.minimum(log_u[None, 1:] - log_u[1:, None], 0.0))
    over = b[0] + (b[1:, None] - b[0]) * share - b[None, 1:]
    excess = np.max(np.tril(over), axis=1) + 4 * guard * np.maximum(b[0], b[1:])
    unit = np.exp(top - 0.5 * log_u[1:])
    base, end = (b[0] - excess) * unit, (b[1:] - excess) * unit
    nearest = np.where(end <= 2 * base, end, 2 * np.sqrt(np.maximum(base * (end - base), 0.0)))
    nearest = np.where(np.isnan(nearest), -np.inf, nearest)
    fine = np.flatnonzero(nearest >= clear)
    k = int(fine[-1]) if len(fine) else int(np.argmax(nearest))
    return k + 1, (float(base[k]), float(end[k]))


def _span(least: float) -> float:
    return _WEIGHT / max(least, 0.5) ** 2


@quiet
def _refine(h: Array, c: Array, sigma: Array, exponents: Array, level: float) -> tuple[Array, Array]:
    """log u and log b at the piece ends and at times between, about a third of a window apart in log u."""
    log_kappa = 2 * np.log(sigma) - 2 * exponents[:-1]
    log_u = np.logaddexp.accumulate(np.concatenate([[-np.inf], log_kappa + np.log(_phi(c, h))]))
    log_b = math.log(level) - exponents
    if not np.isfinite(log_u[-1]):
        return log_u, log_b
    least = float(np.min(np.exp(log_b - 0.5 * log_u)))
    step = max(2 * _span(least) / 3, _RANGE / (3 * _MOST_WINDOWS))
    grid = np.arange(log_u[-1] - _RANGE, log_u[-1] - 0.3 * step, step)
    piece = np.clip(np.searchsorted(log_u, grid, side="right") - 1, 0, len(h) - 1)
    run = np.exp(grid - log_kappa[piece]) - np.exp(log_u[piece] - log_kappa[piece])
    rate = c[piece]
    time = np.where(np.abs(rate) * run < 1e-9, run, -np.log1p(-2 * rate * run) / (2 * rate))
    keep = (sigma[piece] > 0) & (time > 1e-9 * h[piece]) & (time < (1 - 1e-9) * h[piece])
    piece, time, rate = piece[keep], time[keep], rate[keep]
    more_u = np.logaddexp(log_u[piece], log_kappa[piece] + np.log(_phi(rate, time)))
    more_b = math.log(level) - exponents[piece] - rate * time
    order = np.argsort(np.concatenate([np.arange(len(log_u)), piece + 0.5]), kind="stable")
    return np.concatenate([log_u, more_u])[order], np.concatenate([log_b, more_b])[order]


def _phi(c: Array, h: Array) -> Array:
    """int_0^h exp(-2 c s) ds."""
    x = -2 * c * h
    return np.where(np.abs(x) < 1e-300, h, np.expm1(x) / np.where(x == 0, 1.0, x) * h)


def linear_radius(
    durations: ArrayLike,
    rates: ArrayLike,
    sigmas: ArrayLike,
    delta: float,
    *,
    two_sided: bool = True,
    tolerance: float = 1e-4,
) -> float:
    """The least constant r with P(exists t <= T: |xi_t| > r) <= delta that `linear_exceedance` proves.

    Proves: d xi = c xi dt + sigma dW, xi_0 = 0 stays within r (``two_sided``) or below r up to the horizon
    with probability at least 1 - delta.

    Parameters
    ----------
    durations, rates, sigmas : array_like, shape (K,)
        Lengths of the pieces, c and sigma on them; numbers for a single piece.
    delta : float
        In (0, 1).
    two_sided : bool
        Twice the one-sided probability is charged.
    tolerance : float
        Relative accuracy of the search.

    Raises
    ------
    ValueError
        For delta outside (0, 1), and as `linear_exceedance`.

    Examples
    --------
    >>> radius = linear_radius(5.0, -0.5, 0.1**0.5, 1e-3)
    >>> 1.2858 < radius < 1.005 * 1.2858
    True
    """
    if not 0 < delta < 1:
        raise ValueError(f"`delta` must lie in (0, 1), got {delta}.")

    def bound(scale: float) -> float:
        value = linear_exceedance(durations, rates, sigmas, scale)
        return float(double(value)) if two_sided else value

    h, c, sigma = (np.atleast_1d(np.asarray(v, dtype=np.float64)) for v in (durations, rates, sigmas))
    growth = float(np.sum(np.maximum(c, 0) * h))
    spread = math.sqrt(float(np.sum(sigma**2 * h))) * math.exp(min(growth, 700.0))
    if spread == 0:
        raise ValueError("`sigmas` must not all be 0; the process then stays at 0.")
    guess = math.sqrt(2 * math.log(2 / delta)) * spread
    target = math.log10(delta) * (1 + 1e-15)
    return least_scale(bound, target, start=guess, tolerance=tolerance, largest=1e300)
