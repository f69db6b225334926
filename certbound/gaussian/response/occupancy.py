"""Obstacles that are boxes about as large as the noise: the expected number of steps spent inside, in discrete time.

A half-space that keeps the state off a box cannot see the box's far side. P(exists t: X_t in the box) <= sum_t P(X_t in
the box), and X_t = p_t + y_t + Z_t + R_t lies in it only if Z_t lies in the box moved by -p_t - y_t and widened by
|R_t|. y_t is the response to the start and the disturbances. Where it is the start's alone, it does not know the noise:
its box is split into cells, of which the worst one counts. A disturbance may have seen the noise; then the box is
widened by all of |y_t|.
"""

from __future__ import annotations

import itertools

import numpy as np

from certbound.arrays import Array
from certbound.gaussian.response.linear_response import LinearResponse
from certbound.gaussian.response.martingale_windows import logsumexp
from certbound.gaussian.scalar import log_rectangle
from certbound.problem.sets import Inside
from certbound.rigor.intervals import Interval

_SIDES, _STEPS = 3, 200  # sides looked at, most steps
_PARTS, _MOST = (1, 16, 16, 4), 4000  # cells of y along each side, by their number; cells and steps in all
_ROUND = 1e-14


def log_occupancy(
    constraint: Inside, response: LinearResponse, cell: int, *, nominal: Array, moved: Array, remainder: Array,
    disturbed: bool,
) -> float:
    """Upper bound of log P(X enters the box at some step), by Gaussian noise; 0 where there is nothing to say.

    Parameters
    ----------
    constraint : Outside
        Of a box that does not move; anything else is answered by 0.
    nominal : ndarray, shape (T + 1, n)
        p_t.
    moved, remainder : ndarray, shape (T + 1, n)
        Bounds of |y_t| and |R_t|.
    disturbed : bool
        Whether a disturbance is in y.
    """
    region = constraint.region
    if not (constraint.outside and region.form.axial) or region.moving or len(nominal) > _STEPS:
        return 0.0
    around, states = region.hull(), np.array(region.places(nominal.shape[1]))
    bounded = np.isfinite(around.lo) | np.isfinite(around.hi)
    states, low, high = states[bounded], around.lo[bounded], around.hi[bounded]
    if not len(states):
        return 0.0
    times = np.arange(float(len(nominal)))
    during = (0.0, times[-1]) if constraint.during is None else constraint.during
    steps = np.flatnonzero((times >= during[0]) & (times <= during[1]))
    p, y, r = (value[np.ix_(steps, states)] for value in (nominal, moved, remainder))
    if not (np.all(np.isfinite(y)) and np.all(np.isfinite(r))):
        return 0.0
    value, error = response.covariance[cell, steps], response.covariance_error[cell, steps]
    sd = np.sqrt(np.maximum(np.diagonal(value, axis1=1, axis2=2), 0.0))[:, states]
    if len(states) > _SIDES:  # those that say most at the last step
        with np.errstate(divide="ignore", invalid="ignore"):
            width = np.nan_to_num(np.minimum(high - low, 1e150) / sd[-1], nan=0.0, posinf=1e150)
        kept = np.sort(np.argsort(width, kind="stable")[:_SIDES])
        states, low, high, p, y, r = states[kept], low[kept], high[kept], p[:, kept], y[:, kept], r[:, kept]
    # errors as quadratic forms: an entry is off by at most the root of the product of its diagonal's
    bound = np.sqrt(np.maximum(np.diagonal(error, axis1=1, axis2=2), 0.0))[:, states] * (1 + 1e-12)
    off = bound[:, :, None] * bound[:, None, :] + 1e-300
    block = value[:, states][:, :, states]
    covariance = Interval(block - off, block + off)
    size = np.abs(low)[None], np.abs(high)[None]
    slack = [_ROUND * (np.where(np.isfinite(s), s, 0.0) + np.abs(p) + y + r) for s in size]
    parts = _PARTS[len(states)] if np.any(y > 0) and not disturbed else 1
    while parts > 1 and len(steps) * parts ** len(states) > _MOST:
        parts -= 1
    at = np.array(list(itertools.product(range(parts), repeat=len(states))), dtype=float)[:, None]
    start, stop = y * (2 * at / parts - 1), y * (2 * (at + 1) / parts - 1)
    ends = low - p - stop - r - slack[0], high - p - start + r + slack[1]
    shape = (len(at), *block.shape)
    turns = [np.broadcast_to(end, shape).reshape(-1, *block.shape[1:]) for end in (covariance.lo, covariance.hi)]
    low, high = (end.reshape(-1, len(states)) for end in ends)
    log = log_rectangle(low, high, Interval(*turns))
    return min(logsumexp(log.reshape(len(at), len(steps)).max(axis=0)), 0.0)
