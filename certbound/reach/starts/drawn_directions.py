"""A normal start by the few directions that matter: X_0 = mean + gains z + rest, with z nearly standard normal.

With z = B (X_0 - mean) for a float matrix B, Cov z = B Sigma B' =: S, which is I but for ``distortion``: the density of
z differs from the standard one by the factor between (1 + e)^(-d/2) exp(-e |z|^2 / (2 (1 - e))) and
(1 - e)^(-d/2) exp(e |z|^2 / (2 (1 + e))). The rest e = (I - gains B)(X_0 - mean) is Gaussian with a covariance R, which
is enclosed. With R <= K K' + kappa D^2 (as forms) Anderson's inequality says of the symmetric convex set
C = {K xi: |xi| <= reach} + {|y| <= slack} that P(e in C) >= P(K xi + sqrt(kappa) D zeta in C) for standard normal xi,
zeta; what that lacks of 1 is ``missed``. Nothing is said of whether the rest and z are independent.

All holds for every covariance whose entries are the floats given, up to 1e-13 of the standard deviations' product: what
decimals lose of a singular covariance is less.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from flint import arb

from certbound.arrays import Array
from certbound.errors import EngineError
from certbound.gaussian.scalar import log_tail, log_tail_below
from certbound.problem.sets import GaussianStart
from certbound.rigor.balls import precision, upper
from certbound.rigor.intervals import Interval

FAR = 12.0
"""Standard deviations at which a direction is cut off: beyond are 4e-33 of it."""
_ENTRY = 1e-13  # of the product of two standard deviations: what an entry of the covariance may be off
_SINGULAR = 1e-7  # of a correlation's eigenvalues: variances below are left to the rest
_REST = 50.0  # deviations of what rounding leaves: fewer than 1e-500 lie beyond
_ROUND = 1e-12


@dataclass(frozen=True, eq=False, kw_only=True)
class StartDirections:
    """X_0 within ``mean`` + ``gains`` z + {``rest`` xi: |xi| <= ``reach``} + {|y| <= ``slack``}, but for ``missed``.

    Shapes (n,), (n, d), (n, p), and (n,).
    """

    mean: Array
    gains: Array
    rest: Array
    reach: float
    slack: Array
    missed: float
    distortion: float

    @property
    def count(self) -> int:
        """Number d of directions."""
        return int(self.gains.shape[1])

    @property
    def beyond(self) -> float:
        """An upper bound of P(|z_i| > FAR for some i)."""
        size = FAR / np.sqrt(1 + self.distortion) * (1 - _ROUND)
        return float(2 * self.count * np.exp(log_tail(size)) * (1 + _ROUND))

    def mass(self, low: Array, high: Array) -> tuple[Array, Array]:
        """Lower and upper bounds of P(low <= z <= high) for boxes (B, d) within FAR."""
        least, most = (np.prod(side, axis=1) for side in _between(low, high))
        square = (np.maximum(np.abs(low), np.abs(high)) ** 2).sum(axis=1) * (1 + _ROUND)
        e, d = self.distortion, self.count
        under = np.exp(-d / 2 * np.log1p(e) - square * e / (2 * (1 - e)))
        over = np.exp(-d / 2 * np.log1p(-e) + square * e / (2 * (1 + e)))
        return least * under * (1 - _ROUND), np.minimum(most * over * (1 + _ROUND), 1.0)


def _between(low: Array, high: Array) -> tuple[Array, Array]:
    """Bounds of P(low <= Z <= high) of a standard normal variable, entry by entry."""
    near = np.where(high <= 0, -high, low)
    far = np.where(high <= 0, -low, high)
    ends = [np.exp(log_tail_below(end)) * (1 - _ROUND) for end in (near, far)]
    tops = [np.exp(log_tail(end)) * (1 + _ROUND) for end in (near, far)]
    return np.maximum(ends[0] - tops[1], 0.0) * (1 - _ROUND), np.maximum(tops[0] - ends[1], 0.0) * (1 + _ROUND) + 1e-300


def start_directions(start: GaussianStart, effect: Array, *, most: int, missed: float) -> StartDirections:
    """The directions of a start that matter most for rows ``effect`` (m, n); the rest lies within its reach but for
    ``missed``.

    Raises
    ------
    EngineError
        If the covariance is 0, or its numbers differ by more than floats can tell.
    """
    scale = np.sqrt(np.diag(start.covariance))
    unit = np.where(scale > 0, scale, 1.0)
    correlation = start.covariance / unit[:, None] / unit
    values, vectors = np.linalg.eigh((correlation + correlation.T) / 2)
    kept = values > _SINGULAR * max(float(values[-1]), 0.0)
    if not np.any(scale > 0):
        raise EngineError("the random start has no variance; give its mean as the start.")
    spread = vectors[:, kept] * np.sqrt(values[kept])  # in units of the states' deviations
    seen = (effect * unit) @ spread
    order = np.linalg.svd(seen, full_matrices=True)[2][:most].T
    gains = unit[:, None] * (spread @ order)
    rows = order.T @ (vectors[:, kept] / np.sqrt(values[kept])).T / unit
    off = _ENTRY * scale[:, None] * scale
    covariance = Interval(start.covariance - off, start.covariance + off)
    own = Interval.point(rows) @ covariance @ Interval.point(rows.T) - np.eye(order.shape[1])
    distortion = float(own.mag.sum(axis=1).max()) * (1 + _ROUND)
    if not distortion < 1e-3:
        raise EngineError("the covariance of the random start is too badly conditioned; rescale the states.")
    left = np.eye(len(scale)) - Interval.point(gains) @ Interval.point(rows)
    rest = left @ covariance @ Interval(left.lo.T, left.hi.T)
    return _with_rest(start, gains, rest, unit, scale, missed, distortion)


def _with_rest(
    start: GaussianStart, gains: Array, rest: Interval, unit: Array, scale: Array, missed: float, distortion: float
) -> StartDirections:
    """The directions with what they leave: K from the larger eigenvalues, and the others as slack."""
    scaled = Interval(rest.lo, rest.hi) / (unit[:, None] * unit)
    middle = np.asarray(scaled.mid)
    values, vectors = np.linalg.eigh((middle + middle.T) / 2)
    kept = values > 1e-13
    factor = vectors[:, kept] * np.sqrt(values[kept])
    kappa = float((scaled - Interval.point(factor) @ Interval.point(factor.T)).mag.sum(axis=1).max()) * (1 + _ROUND)
    slack = _REST * np.sqrt(kappa) * scale * (1 + _ROUND)
    reach, lost = _reach(int(kept.sum()), missed)
    rounding = 1e-14 * (np.abs(gains).sum(axis=1) * FAR + reach * np.abs(factor).sum(axis=1) * unit)
    return StartDirections(
        mean=np.asarray(start.mean), gains=gains, rest=unit[:, None] * factor, reach=reach, slack=slack + rounding,
        missed=lost + 1e-300 * bool(kappa), distortion=distortion,
    )  # fmt: skip


def _reach(count: int, missed: float) -> tuple[float, float]:
    """A radius of the ball of so many standard normal variables, and an upper bound of what lies outside of it."""
    from scipy.stats import chi2

    if not count:
        return 0.0, 0.0
    square = float(chi2.isf(missed, count))
    with precision():
        outside = upper((arb(square) / 2).gamma_upper(arb(count) / 2, 1))
    return float(np.sqrt(square)) * (1 + _ROUND), outside
