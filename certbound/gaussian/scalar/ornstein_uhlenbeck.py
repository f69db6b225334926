"""First passage of a stationary Ornstein-Uhlenbeck process over a polygon: closed forms, summed over windows.

U is the stationary Gaussian process with correlation exp(-|clock difference|). With u = exp(2 clock), B_u =
sqrt(u) U is a Brownian motion; a boundary q for U is b(u) = sqrt(u) q for B. **All boundaries here are
chords in these Brownian coordinates**: on a window from clock 0 to clock ``span`` the line from (1, q0) to
(exp(2 span), exp(span) q1). Symbols: a = b - x the distance to the line, C = exp(2 span) - 1 the length of
the window, beta its slope, L(a) = Q((a + beta C)/sqrt C) + exp(-2 a beta) Phi((beta C - a)/sqrt C) the
probability that a Brownian motion started a below the line meets it (Bachelier-Levy).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.gaussian.scalar.normal import (
    EPS,
    LOG_ROOT_2PI,
    gauss_rule,
    lift,
    log_below_above,
    log_between,
    log_tail,
    mills,
)
from certbound.rigor.rounding import quiet

_EDGES, _NODES = np.array([0.0, 0.2, 0.5, 1.0]), 16  # panels, as parts of the range; nodes in each
_ELLIPSES = np.array([1.3, 1.7, 2.2, 3.0, 4.5, 7.0])
_DROP = 26.0
_ERROR = 64.0 / 15.0


@quiet
def log_line_crossing(start: ArrayLike, stop: ArrayLike, span: ArrayLike) -> Array:
    """Upper bound of log P(U_0 <= start, U meets the line within ``span``), natural logarithms.

    Proves: with rho = exp(-span), beta = (stop - rho start)/(2 sinh span) the probability is P(X <= start,
    Y > stop) + exp(2 beta (beta - start)) P(X <= start - 2 beta, Y > 2 rho (start - beta) - stop), (X, Y)
    standard normal with correlation rho: the first term counts paths that end above the line, the second is
    the reflected part, int phi(x) exp(-2 a beta) Phi((beta C - a)/sqrt C) dx, by a shift of x. Each of the
    three parameters is rounded in the direction that raises the bound.

    Parameters
    ----------
    start, stop : array_like
        Levels q0, q1 in standard deviations of U; they broadcast with ``span``.
    span : array_like
        Clock of the window, > 0 (a relative error of a few eps is covered).

    Examples
    --------
    >>> bool(log_line_crossing(3.0, 3.0, 1e-6) < -12)  # hardly any time: hardly any probability
    True
    """
    q0, q1, d = np.broadcast_arrays(*(np.asarray(v, dtype=np.float64) for v in (start, stop, span)))
    rho, width = np.exp(-d), 2 * np.sinh(d)
    size = np.abs(q0) + np.abs(q1)
    beta, slack = (q1 - rho * q0) / width, 64 * EPS * size * (1 + d) / width
    below = q0 - 2 * beta
    above = 2 * rho * (q0 - beta) - q1
    shift = 2 * beta * (beta - q0)
    loose = 2 * slack + 32 * EPS * (size + np.abs(beta))
    shift = shift + slack * (4 * np.abs(beta) + 2 * np.abs(q0)) + 16 * EPS * (np.abs(shift) + beta * beta)
    spread = np.sqrt(np.tanh(0.5 * d)) * (1 + 64 * EPS)
    direct, reflected = log_below_above(
        np.stack([q0, below + loose]), np.stack([q1, above - loose]), spread=np.stack([spread, spread])
    )
    value = np.logaddexp(direct, reflected + shift)
    result: Array = np.minimum(lift(value, 16), 0.0)
    return result


@quiet
def _meeting(a: Array, beta: Array, length: Array) -> Array:
    """L(a) by Mills' ratios; ``length`` = C may be infinite (then exp(-2 a beta), beta >= 0)."""
    root = np.sqrt(length)
    w, y = (a + beta * length) / root, (a - beta * length) / root
    density = np.exp(-0.5 * w * w - LOG_ROOT_2PI)
    first = density * mills(np.abs(w))
    first = np.where(w >= 0, first, 1.0 - first)
    second = density * mills(np.abs(y))
    second = np.where(y >= 0, second, np.exp(-2 * a * beta) - second)
    return np.where(length == np.inf, np.exp(-2 * a * beta), first + second)


@quiet
def _log_excluding(prior: tuple[Array, Array, Array], after: tuple[Array, Array, Array]) -> Array:
    """Upper bound of log P(U below the prior line throughout its window, then meets the next one).

    Proves: at the common node U = x splits the past from the future, and the reversed past is an OU process
    under a line too; the probability is at most P(n < U <= p) plus int_0^inf phi(m - s) (1 - L_prior(p - m
    + s)) L_next(n - m + s) ds, with p, n the ends of the two lines at the node and m = min(p, n). Gauss's
    rule on three panels; the remainder from the Bernstein ellipse, on which |phi(w)| <= phi(Re w)
    exp(Im(w)^2/2) and likewise for Q; the tail from L(a) <= exp(-(a + beta C)^2/(2C)), true for a >= |beta|
    C. +inf where no useful bound results.
    """
    (p, beta_p, len_p), (n, beta_n, len_n) = prior, after
    m = np.minimum(p, n)
    lift_p, lift_n = p - m, n - m
    # envelope exp(-kappa (s - centre)^2/2) of phi(m - s) L_next
    kappa = 1 + 1 / len_n
    centre = (m - beta_n - lift_n / len_n) / kappa
    reach = np.maximum(centre, 0.0) + np.sqrt(2 * _DROP / kappa)
    reach = np.where(centre < 0, centre + np.sqrt(centre**2 + 2 * _DROP / kappa), reach)
    reach = np.maximum(reach, np.abs(beta_n) * len_n - lift_n + 1e-9)
    size = 1 + np.abs(p) + np.abs(n) + reach + np.abs(beta_n) * (1 + len_n)
    size = size * (1 + 1 / np.sqrt(len_n) + 1 / np.sqrt(len_p))
    size = size + np.abs(beta_p) * np.where(len_p == np.inf, 1.0, 1 + np.sqrt(len_p))
    slack = 1024 * EPS * size * size
    nodes, weights = gauss_rule(_NODES)
    half = 0.5 * np.diff(_EDGES)[:, None] * reach
    middle = 0.5 * (_EDGES[1:] + _EDGES[:-1])[:, None] * reach
    s = middle[:, None, :] + half[:, None, :] * nodes[:, None]
    log_density = -0.5 * (m - s) ** 2 - LOG_ROOT_2PI
    survive = np.minimum(1.0 - _meeting(lift_p + s, beta_p, len_p) + slack, 1.0)
    meet = np.minimum(_meeting(lift_n + s, beta_n, len_n), 1.0)
    value = np.einsum("pnk,n,pk->k", np.exp(log_density) * survive * meet, weights, half)
    value = value + _ellipse_error(m, (lift_p, beta_p, len_p), (lift_n, beta_n, len_n), middle, half)
    const = -0.5 * (m * m + (lift_n + beta_n * len_n) ** 2 / len_n - kappa * centre**2)
    tail = const - 0.5 * np.log(kappa) + log_tail((reach - centre) * np.sqrt(kappa))
    value = (value + np.exp(tail)) * (1 + slack)
    usable = (value > 1e-270) & (slack < 1e-3)  # nothing that matters has underflowed
    value = np.logaddexp(np.log(value), log_between(n, p))
    usable &= ~np.isnan(value)
    return np.where(usable, lift(value, 16), np.inf)


def _ellipse_error(
    m: Array, prior: tuple[Array, Array, Array], after: tuple[Array, Array, Array], middle: Array, half: Array
) -> Array:
    """Remainder of Gauss's rule summed over the panels, the least over a few ellipses."""
    r = _ELLIPSES[:, None, None]
    across, along = 0.5 * (r - 1 / r) * half, 0.5 * (r + 1 / r) * half
    low, high = middle - along, middle + along
    distance = np.maximum(np.maximum(m - high, low - m), 0.0)
    square = across * across
    log_size = -0.5 * distance**2 - LOG_ROOT_2PI + 0.5 * square
    for (gap, beta, length), extra in ((prior, 1.0), (after, 0.0)):
        root = np.sqrt(length)
        a, far = gap + low, gap + high
        w, y = (a + beta * length) / root, (a - beta * length) / root
        second = np.exp(log_tail(y) - 2 * np.minimum(a * beta, far * beta))
        # the same function is phi(w) R(y)
        peak = np.clip(0.0, w, (far + beta * length) / root)
        joint = np.exp(-0.5 * peak * peak - LOG_ROOT_2PI) * mills(np.maximum(y, 0.0))
        second = np.minimum(second, np.where(y >= 0, joint, np.inf))
        first = np.exp(log_tail(w))
        forever = np.exp(-2 * np.minimum(a * beta, far * beta))
        size = np.where(length == np.inf, forever, (first + second) * np.exp(0.5 * square / length))
        log_size = log_size + np.log(extra + size)
    bound = half * _ERROR * np.exp(log_size) * r ** (-2.0 * _NODES) / (1 - r**-2.0) * 1.001
    best: Array = np.where(np.isnan(bound), np.inf, bound).min(axis=0).sum(axis=0)
    return best


@quiet
def log_polygon_crossing(
    spans: ArrayLike,
    starts: ArrayLike,
    stops: ArrayLike,
    *,
    fresh: ArrayLike = False,
) -> Array:
    """Natural logarithms of terms whose sum bounds P(U exceeds a polygon), one line per window.

    Proves: P <= P(first window) + sum_k P(no passage in window k - 1, passage in window k): every passage
    has a first window, and the window before it is free of passages. Each term is the smaller of the closed
    form (`log_line_crossing`, which only asks U to be below at the node) and the integral that uses the
    whole previous window.

    Parameters
    ----------
    spans : array_like, shape (K,)
        Clocks of the windows, > 0.
    starts, stops : array_like, shape (K,)
        Levels of the lines at the two ends of each window (they may jump from window to window).
    fresh : array_like of bool, shape (K,)
        Windows whose past is not that of the same process (blocks of a comparison): only U at their start is
        known to be below the line before.

    Returns
    -------
    ndarray, shape (K + 1,)
        The first entry is P(U > starts[0]).
    """
    d, q0, q1 = (np.atleast_1d(np.asarray(v, dtype=np.float64)) for v in (spans, starts, stops))
    if len(d) == 0:
        raise ValueError("`spans` must hold at least one window.")
    single = log_line_crossing(q0, q1, d)
    length = np.expm1(2 * d)
    forward, backward = (np.exp(d) * q1 - q0) / length, (np.exp(d) * q0 - q1) / length
    before, after = (q1[:-1], backward[:-1], length[:-1]), (q0[1:], forward[1:], length[1:])
    linked = single[1:]
    jump = log_between(after[0], before[0])
    closed = lift(np.logaddexp(linked, jump), 8)
    own = ~np.broadcast_to(np.asarray(fresh, dtype=bool), single.shape)[1:]
    if np.any(own):
        refined = _log_excluding((before[0][own], *(x[own] for x in before[1:])), tuple(x[own] for x in after))
        closed[own] = np.minimum(closed[own], refined)
    linked[:] = closed
    return np.concatenate([np.atleast_1d(log_tail(q0[0])), single])
