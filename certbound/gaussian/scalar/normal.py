"""Upper bounds of normal and bivariate normal probabilities, vectorised and in natural logarithms.

The rounding model is that of ``certbound.rigor.rounding``: + - * / sqrt are rounded to nearest, exp, log and
their kin are good to ``LIBRARY_ULPS`` units. Every function adds a margin that covers these errors and the
truncation errors named in its docstring. Symbols: phi and Q are the standard normal density and upper tail,
R = Q/phi is Mills' ratio, eps = 2^-52.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.rigor.rounding import quiet

EPS = 2.0**-52
MILLS_ERROR = 2.0**-48
LOG_ROOT_2PI = 0.9189385332046727  # within eps of log sqrt(2 pi)
LOG_PI = 1.1447298858494002
_CELLS, _DEGREE, _FAR = 8, 11, 16.0  # cells per unit, Taylor degree, start of the asymptotic series
_PANELS, _NODES = 2, 24
_ELLIPSES = np.array([1.2, 1.35, 1.5, 1.7, 2.0, 2.5, 3.5])
_DROP = 26.0  # the integrand is followed down to e^-26 of its peak
_REACH = 1e60  # levels beyond it fall back on the marginal tail
_ERROR = 64.0 / 15.0


@lru_cache(maxsize=1)
def _mills_table() -> Array:
    """Taylor coefficients of R at the centres (i + 1/2)/8, from R' = x R - 1 in balls; shape (12, 128)."""
    from flint import arb, ctx

    before, ctx.prec = ctx.prec, 320
    try:
        table = np.empty((_DEGREE + 1, int(_CELLS * _FAR)))
        for i in range(table.shape[1]):
            x = arb(2 * i + 1) / (2 * _CELLS)
            previous = (arb.pi() / 2).sqrt() * (x * x / 2).exp() * (x / arb(2).sqrt()).erfc()
            current, factorial = x * previous - 1, arb(1)
            table[0, i] = float(previous)
            for k in range(1, _DEGREE + 1):
                factorial *= k
                table[k, i] = float(current / factorial)
                previous, current = current, x * current + k * previous
    finally:
        ctx.prec = before
    table.setflags(write=False)
    return table


@lru_cache(maxsize=1)
def _mills_rows() -> list[list[float]]:
    """The same, cell by cell, highest powers first."""
    rows: list[list[float]] = _mills_table()[::-1].T.tolist()
    return rows


@lru_cache(maxsize=8)
def gauss_rule(count: int) -> tuple[Array, Array]:
    """Gauss-Legendre nodes and weights on [-1, 1], the exact ones rounded to nearest."""
    from flint import arb, ctx

    before, ctx.prec = ctx.prec, 128
    try:
        pairs = [arb.legendre_p_root(count, k, weight=True) for k in range(count)]
    finally:
        ctx.prec = before
    nodes, weights = (np.array([float(pair[i]) for pair in pairs]) for i in (0, 1))
    nodes.setflags(write=False)
    weights.setflags(write=False)
    return nodes, weights


def mills(x: Array) -> Array:
    """Mills' ratio R(x) = Q(x)/phi(x) for x >= 0 with relative error at most ``MILLS_ERROR`` = 2^-48.

    Below 16: Taylor series of degree 11 in cells of half-width 1/16; the remainder is at most
    sup|R^(12)| (1/16)^12/12! < 1e-19, since |R^(k)| = int t^k exp(-xt - t^2/2) dt falls in x. From 16
    on: x R = 1 - y + 3y^2 - ... up to y^10 with y = 1/x^2; the series envelops R, its next term is below
    1e-15. Horner's rule on these rapidly falling coefficients loses less than 8 eps.
    """
    if x.size == 1 and x.flat[0] < _FAR:  # the same arithmetic on one number, ten times as fast
        return np.full(x.shape, _mills_of(max(float(x.flat[0]), 0.0)))
    near = np.fmin(np.fmax(x, 0.0), _FAR * (1 - EPS))  # NaN as 0
    cell = (near * _CELLS).astype(np.intp)
    table = _mills_table()
    u = near - (cell + 0.5) / _CELLS
    small = table.take(cell, axis=1) if cell.size < 4096 else None  # of few numbers all coefficients at once
    value, term = table[_DEGREE].take(cell), np.empty_like(u)
    for k in range(_DEGREE - 1, -1, -1):
        value *= u
        value += table[k].take(cell, out=term, mode="clip") if small is None else small[k]
    far = x >= _FAR
    if np.any(far):
        large = x[far]
        y = 1.0 / (large * large)
        series = np.ones_like(large)
        for k in range(10, 0, -1):
            series = 1.0 - (2 * k - 1) * y * series
        value = np.array(value)
        value[far] = series / large
    result: Array = value
    return result


def _mills_of(x: float) -> float:
    """`mills` of one number in [0, 16)."""
    near = min(x, _FAR * (1 - EPS))
    cell = int(near * _CELLS)
    u, (value, *rest) = near - (cell + 0.5) / _CELLS, _mills_rows()[cell]
    for coefficient in rest:
        value = value * u + coefficient
    return value


@quiet
def mills_deficit(x: Array) -> Array:
    """Upper bound of 1 - x R(x) = int_0^inf t exp(-xt - t^2/2) dt for x >= 0 (absolute margin 2^-46)."""
    near = 1.0 - x * mills(np.minimum(x, _FAR)) + 4 * MILLS_ERROR
    value: Array = np.where(x < _FAR, near, 1.0 / (x * x))
    return np.minimum(value, 1.0)


def _log_right_tail(x: Array) -> tuple[Array, Array]:
    """log Q(x) for x >= 0 and a bound of its error."""
    log_mills = np.log(mills(x))
    square = x * x
    value = -0.5 * square - LOG_ROOT_2PI + log_mills
    return value, EPS * (2 * square + 16 * np.abs(log_mills) + 64)


def lift(value: Array, count: float) -> Array:
    """``value`` + count eps (1 + |value|): room for the rounding of a few sums; infinite entries stay."""
    raised: Array = np.where(np.isfinite(value), value + count * EPS * (1 + np.abs(value)), value)
    return raised


@quiet
def log_tail(x: ArrayLike) -> Array:
    """Upper bound of log Q(x) = log P(X > x) for standard normal X, of any size.

    Proves: log_tail(x) >= log Q(x); above it by at most 1e-14 (1 + x^2). Levels beyond 1e150 (where x^2
    leaves the floating-point range) give the bound at 1e150; +inf gives -inf, NaN gives 0.

    Examples
    --------
    >>> log_tail([0.0, 40.0]).round(6).tolist()
    [-0.693147, -804.608442]
    """
    x = np.asarray(x, dtype=np.float64)
    size = np.minimum(np.abs(x), 1e150)
    value, error = _log_right_tail(np.atleast_1d(size))
    value, error = value.reshape(x.shape), error.reshape(x.shape)
    below = np.log1p(-np.exp(np.minimum(value - error, -0.5)) * (1 - 16 * EPS))
    below = np.where(below > -1e-300, 0.0, below * (1 - 16 * EPS))
    result = np.where(x >= 0, value + error, below)
    result = np.where(x == np.inf, -np.inf, result)
    return np.where(np.isnan(x), 0.0, result)


@quiet
def log_tail_below(x: ArrayLike) -> Array:
    """Lower bound of log Q(x), as near as `log_tail` is from above.

    Examples
    --------
    >>> bool(0 <= log_tail(3.0) - log_tail_below(3.0) < 1e-12)
    True
    """
    x = np.asarray(x, dtype=np.float64)
    value, error = _log_right_tail(np.atleast_1d(np.minimum(np.abs(x), 1e150)))
    value, error = value.reshape(x.shape), error.reshape(x.shape)
    over = np.minimum(np.exp(np.minimum(value + error, -0.5)) * (1 + 16 * EPS), 1.0)
    below = np.log1p(-over) * (1 + 16 * EPS) - 1e-300
    result = np.where(x >= 0, value - error, below)
    return np.where(np.isnan(x) | (x > 1e150), -np.inf, result)


@quiet
def log_between(low: ArrayLike, high: ArrayLike) -> Array:
    """Upper bound of log P(low < X <= high) for standard normal X; -inf where low >= high.

    Same sign: phi(b) [R(b) - exp(-(a - b)(a + b)/2) R(a)] with b the end nearer to 0, plus
    64 eps phi(b) R(b); or phi(b) (a - b), whichever is smaller, so that the relative excess stays below
    1e-7. Opposite signs: 1 - Q(-low) - Q(high), or (high - low) phi(0).
    """
    low, high = np.broadcast_arrays(np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64))
    mirrored = high <= 0
    near, far = np.where(mirrored, -high, low), np.where(mirrored, -low, high)
    shape = near.shape
    b, a = np.atleast_1d(np.clip(near, -_REACH, 1e150)), np.atleast_1d(far)
    b_size = np.abs(b)
    ratio_b, ratio_a = mills(b_size), mills(np.minimum(np.abs(a), 1e150))
    log_density = -0.5 * b * b - LOG_ROOT_2PI + EPS * (2 * b * b + 16)
    gap = (a - b) * (1 + EPS)
    fall = np.exp(-0.5 * (a - b) * (a + b))
    tail = log_density + np.log(ratio_b - np.where(a == np.inf, 0.0, fall * ratio_a) + 64 * EPS * ratio_b)
    density_b, density_a = np.exp(-0.5 * b * b - LOG_ROOT_2PI), np.exp(-0.5 * a * a - LOG_ROOT_2PI)
    across = np.log(1.0 - density_b * ratio_b - np.where(a == np.inf, 0.0, density_a * ratio_a) + 64 * EPS)
    value = np.where(b >= 0, tail, across)
    narrow = np.log(gap) + np.where(b >= 0, log_density, -LOG_ROOT_2PI)
    value = np.minimum(np.minimum(value, narrow), 0.0)
    value = np.where(a > b, lift(value, 32), -np.inf)
    return np.where(near == np.inf, -np.inf, value.reshape(shape))


@quiet
def log_below_above(
    below: ArrayLike,
    above: ArrayLike,
    correlation: ArrayLike | tuple[ArrayLike, ArrayLike] | None = None,
    *,
    spread: ArrayLike | None = None,
) -> Array:
    """Upper bound of log P(X <= below, Y > above) for standard bivariate normal (X, Y).

    Proves, with a = below, b = above, any correlation >= the given one, and tau = sqrt((1 - rho)/(1 + rho)):
    the probability falls in rho (Plackett), so that it is at most
    P(b < X <= a) + (1/pi) exp(-(a^2 + b^2)/4) int_0^tau exp(-(D^2/t^2 + S^2 t^2)/2) dt/(1 + t^2),
    D = |a - b|/2, S = |a + b|/2: all terms positive, hence accurate to about 1e-6 at any depth. (Plackett's
    d P/d rho = -density, integrated from rho = 1, with rho = (1 - t^2)/(1 + t^2).) The integral runs over
    log t; Gauss's rule with the remainder over Bernstein ellipses (see `_log_integral`).

    Parameters
    ----------
    below, above : array_like
        Levels, infinite ones included; they broadcast together.
    correlation : array_like or pair of array_likes
        Lower bound of the correlation, in [-1, 1]; or its two bounds, of which the lower one decides.
    spread : array_like, optional
        Upper bound of tau, instead of ``correlation`` where 1 - rho is known better than rho.

    Returns
    -------
    ndarray
        Natural logarithms, never above log P(Y > above) and log P(X <= below).

    Raises
    ------
    ValueError
        If neither or both of ``correlation`` and ``spread`` are given, or out of range.

    Examples
    --------
    >>> bound = log_below_above(3.0, 3.0, 0.0)
    >>> bool(abs(bound - log_tail(3.0) - log_tail(-3.0)) < 1e-6)
    True
    """
    if (correlation is None) == (spread is None):
        raise ValueError("give exactly one of `correlation` and `spread`.")
    if spread is None:
        lower = correlation[0] if isinstance(correlation, tuple) else correlation
        rho = np.asarray(lower, dtype=np.float64)
        if not np.all((rho >= -1) & (rho <= 1)):
            raise ValueError("`correlation` must lie in [-1, 1]; clip it outward (downward) first.")
        spread = np.sqrt((1 - rho) / (1 + rho)) * (1 + 8 * EPS)
    tau = np.asarray(spread, dtype=np.float64)
    if not np.all(tau >= 0):
        raise ValueError("`spread` must not be negative.")
    a, b, tau = np.broadcast_arrays(
        np.asarray(below, dtype=np.float64), np.asarray(above, dtype=np.float64), tau
    )
    result = np.asarray(np.minimum(log_tail(b), log_tail(-a)))
    inner = (np.abs(a) < _REACH) & (np.abs(b) < _REACH)
    if np.any(inner):
        first, second, width = a[inner], b[inner], tau[inner]
        extra = np.full_like(first, -np.inf)
        moving = width > 0
        extra[moving] = _log_integral(first[moving], second[moving], width[moving])
        joint = np.logaddexp(log_between(second, first), extra)
        joint = lift(joint, 8)
        result[inner] = np.minimum(result[inner], joint)
    return result


def _log_integral(a: Array, b: Array, tau: Array) -> Array:
    """Upper bound of log((1/pi) exp(-(a^2 + b^2)/4) int_0^tau exp(-g) dt/(1 + t^2)), tau > 0.

    g = (D^2/t^2 + S^2 t^2)/2; with v = log t the integrand is k(v) = exp(-g) sech(v)/2. Pieces: v in [left,
    right], two panels of 24 Gauss nodes; beyond them `_end_tail`, above ``right`` its mirror image under
    t -> 1/t or, where shorter, (1/t_right - 1/tau) exp(-S^2 t_right^2/2). An n-point rule on a panel of
    half-length h errs by at most h (64/15) M r^{-2n}/(1 - r^{-2}), M a bound of |k| on the Bernstein
    ellipse of any parameter r (Trefethen, Approximation Theory and Approximation Practice, Thm 19.3). For
    |Im v| = y < pi/4: |k| <= exp(-cos(2y) min g)/(2 sqrt(cosh(x)^2 - sin(y)^2)).
    """
    dd, ss = 0.25 * (a - b) ** 2, 0.25 * (a + b) ** 2
    end = np.log(tau)
    end = np.where(tau == np.inf, 1e3, end + 8 * EPS * (1 + np.abs(end)))
    log_s, log_d = 0.5 * np.log(ss), 0.5 * np.log(dd)
    left = np.minimum(np.minimum(end, -log_s), 0.0) - 5.0
    right = np.minimum(np.maximum(log_d, 0.0) + 5.0, end)
    balance = np.where(dd > 0, np.where(ss > 0, 0.5 * (log_d - log_s), np.inf), -np.inf)
    centre = np.clip(balance, np.minimum(left, right), right)
    reference = _exponent(dd, ss, centre)
    top = reference + _DROP
    root = top + np.sqrt(np.maximum(top * top - dd * ss, 0.0))
    left = np.maximum(left, 0.5 * np.log(dd / root))
    right = np.minimum(right, 0.5 * np.log(root / ss))
    left = np.minimum(left, right - 1e-9)
    nodes, weights = gauss_rule(_NODES)
    edges = left + np.linspace(0.0, 1.0, _PANELS + 1)[:, None] * (right - left)
    middle, half = 0.5 * (edges[1:] + edges[:-1]), 0.5 * (edges[1:] - edges[:-1])
    v = middle[:, None, :] + half[:, None, :] * nodes[:, None]
    t = np.exp(v)
    x = t * t
    density = np.exp(reference - 0.5 * (dd / x + ss * x)) * (t / (1.0 + x))
    total = np.einsum("pnk,n,pk->k", density, weights, half)
    total = total + _rule_error(dd, ss, reference, balance, middle, half).sum(axis=0)
    total = total + _end_tail(dd, ss, reference, np.exp(left))
    stop = np.exp(-right)
    short = (stop - np.exp(-end)) * np.exp(reference - 0.5 * ss / (stop * stop)) + 8 * EPS * stop
    total = total + np.where(right < end, np.minimum(_end_tail(ss, dd, reference, stop), short), 0.0)
    scale = 0.25 * (a * a + b * b) + reference
    margin = EPS * (64 + 8 * np.abs(left)) * (4 + scale + _DROP)
    value = np.log(total) - LOG_PI - scale + margin
    return np.where((total > 0) & ~np.isnan(value), value, np.inf)


def _exponent(dd: Array, ss: Array, v: Array) -> Array:
    x = np.exp(2 * v)
    return 0.5 * (dd / x + ss * x)


def _end_tail(dd: Array, ss: Array, reference: Array, t: Array) -> Array:
    """Upper bound of exp(reference) int_0^t exp(-g(s)) ds.

    Without the S-part it is t exp(-c^2/2) (1 - c R(c)), c = D/t. In log s, g is convex: where it still
    falls at t, the integral is at most t exp(-g(t))/(1 + |g'|), g' = S^2 t^2 - D^2/t^2.
    """
    low, high = dd / (t * t), ss * t * t
    bare = t * np.exp(reference - 0.5 * low) * mills_deficit(np.sqrt(low))
    steep = t * np.exp(reference - 0.5 * (low + high)) / (1.0 + np.maximum(low - high, 0.0))
    return np.minimum(bare, np.where(low >= high, steep, np.inf))


def _rule_error(dd: Array, ss: Array, reference: Array, balance: Array, middle: Array, half: Array) -> Array:
    """Gauss remainder per panel, times exp(reference); shapes of ``middle`` and ``half``: (panels, k)."""
    r = _ELLIPSES[:, None, None]
    across, along = 0.5 * (r - 1 / r) * half, 0.5 * (r + 1 / r) * half
    low, high = middle - along, middle + along
    least = _exponent(dd, ss, np.clip(balance, low, high))
    nearest = np.maximum(np.maximum(low, -high), 0.0)
    size = np.exp(reference - np.cos(2 * across) * least) / (
        2 * np.sqrt(np.cosh(nearest) ** 2 - np.sin(across) ** 2)
    )
    bound = half * _ERROR * size * r ** (-2.0 * _NODES) / (1 - r**-2.0) * 1.001
    bound = np.where((across < 0.78) & ~np.isnan(bound), bound, np.inf)
    best: Array = bound.min(axis=0)
    return best
