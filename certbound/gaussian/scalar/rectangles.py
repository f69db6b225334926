"""Upper bounds of the probability that a Gaussian vector lies in a box, for boxes about as large as its deviation."""

from __future__ import annotations

import numpy as np

from certbound.arrays import Array
from certbound.gaussian.scalar.normal import lift, log_between
from certbound.rigor.intervals import Interval
from certbound.rigor.rounding import quiet

_CELLS = (1, 32, 14, 8)  # along every side but the last, by the number of sides
_FAR = 9.0  # deviations beyond which the outermost cells are infinite
_ROUND = 1e-12


@quiet
def log_rectangle(low: Array, high: Array, covariance: Interval) -> Array:
    """Upper bound of log P(low <= X <= high), X centred Gaussian with a covariance within ``covariance``.

    Proves: given that X_1 lies in a cell [a, b], the rest is X' = (X - beta X_1) + beta X_1 with the first part
    independent of X_1, so that it must lie in the box moved by beta times something in the cell; the probabilities of
    the cells times those of the widened boxes are added, side after side.

    Parameters
    ----------
    low, high : ndarray, shape (M, d)
        Sides, infinite ones included; d from 1 to 4 (drop sides of larger boxes: the probability only grows).
    covariance : Interval, shape (M, d, d)

    Returns
    -------
    ndarray, shape (M,)

    Raises
    ------
    ValueError
        If d is larger than 4.

    Examples
    --------
    >>> value = log_rectangle(-np.ones((1, 2)), np.ones((1, 2)), Interval.point(np.eye(2)[None]))
    >>> bool(0 <= np.exp(value[0]) - 0.682689**2 < 1e-3)
    True
    """
    sides = low.shape[-1]
    if sides > len(_CELLS):
        raise ValueError(f"`low` must have at most {len(_CELLS)} sides, got {sides}.")
    sd = np.sqrt(np.maximum(np.diagonal(covariance.hi, axis1=-2, axis2=-1), 0.0))
    width = np.where(sd > 0, np.minimum(high - low, 1e150) / sd, 0.0)
    order = np.argsort(np.median(width, axis=0), kind="stable")  # the widest side is not cut
    turned = covariance[..., order, :][..., order]
    return _log_rectangle(low[..., order], high[..., order], turned, _CELLS[sides - 1])


def _log_rectangle(low: Array, high: Array, covariance: Interval, count: int) -> Array:
    """The same with ``count`` cells along every side but the last."""
    sides = low.shape[-1]
    variance = covariance[..., 0, 0]
    if sides == 1:
        return _log_line(low[..., 0], high[..., 0], variance)
    sd = np.sqrt(np.maximum(variance.hi, 0.0)) * (1 + _ROUND) + 1e-300
    inner = [np.clip(end, -_FAR * sd, _FAR * sd) for end in (low[..., 0], high[..., 0])]
    share = np.linspace(0.0, 1.0, count + 1).reshape(-1, *(1,) * (low.ndim - 1))
    edges = inner[0] + share * (inner[1] - inner[0])
    near, far = np.array(edges[:-1]), np.array(edges[1:])
    near[0], far[-1] = np.minimum(near[0], low[..., 0]), np.maximum(far[-1], high[..., 0])
    usable = variance.lo > 0
    base = Interval(np.where(usable, variance.lo, 1.0), np.where(usable, variance.hi, 1.0))
    cross = covariance[..., 1:, 0]
    slope = cross / base[..., None]
    rest = covariance[..., 1:, 1:] - slope[..., :, None] * cross[..., None, :]
    free = ~usable[..., None] & np.ones(cross.shape, dtype=bool)  # X_1 hardly moves: nothing is said of the rest
    ends = [np.where(np.isinf(e[..., None]) & (v == 0), 0.0, e[..., None] * v)
            for e in (near, far) for v in (slope.lo, slope.hi)]
    least, largest = np.minimum.reduce(ends), np.maximum.reduce(ends)
    slack = _ROUND * (np.where(np.isfinite(least), np.abs(least), 0.0) + np.where(
        np.isfinite(largest), np.abs(largest), 0.0))
    moved_low = np.where(free, -np.inf, low[..., 1:] - largest - slack - _ROUND * np.abs(low[..., 1:]))
    moved_high = np.where(free, np.inf, high[..., 1:] - least + slack + _ROUND * np.abs(high[..., 1:]))
    shape = (*near.shape, sides - 1, sides - 1)
    inside = _log_rectangle(
        np.where(np.isnan(moved_low), -np.inf, moved_low), np.where(np.isnan(moved_high), np.inf, moved_high),
        Interval(np.broadcast_to(rest.lo, shape), np.broadcast_to(rest.hi, shape)), count,
    )
    logs = _log_line(near, far, Interval(np.broadcast_to(variance.lo, near.shape), np.broadcast_to(
        variance.hi, near.shape))) + inside
    return np.minimum(lift(np.logaddexp.reduce(logs, axis=0), 64), 0.0)


def _log_line(low: Array, high: Array, variance: Interval) -> Array:
    """log P(low <= X <= high) for a variance within an interval: the widest range of X/s."""
    largest = np.sqrt(np.maximum(variance.hi, 0.0)) * (1 + _ROUND)
    least = np.sqrt(np.maximum(variance.lo, 0.0)) * (1 - _ROUND)
    start = np.where(low >= 0, low / largest, low / least)
    stop = np.where(high >= 0, high / least, high / largest)
    start = np.where(np.isnan(start), np.where(low > 0, np.inf, -np.inf), start - _ROUND * np.abs(start))
    stop = np.where(np.isnan(stop), np.where(high < 0, -np.inf, np.inf), stop + _ROUND * np.abs(stop))
    start, stop = np.where(low == 0, 0.0, start), np.where(high == 0, 0.0, stop)
    # without any noise X = 0
    noiseless, holds = largest == 0, (low <= 0) & (high >= 0)
    value = log_between(np.where(np.isnan(start), -np.inf, start), np.where(np.isnan(stop), np.inf, stop))
    return np.asarray(np.where(noiseless, np.where(holds, 0.0, -np.inf), np.where(
        (least == 0) & holds, 0.0, value)))
