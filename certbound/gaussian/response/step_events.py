"""First exceedances of the Gaussian response along rows, in discrete time (scalar events of Thm K7).

Noise of bounded entries takes a row no further than its reach, with probability 1:

Z+ = F_t Z + G w with |w_j| <= h_j and Z_0 = 0 gives r . Z_t = sum_{s < t} r F_{t-1} ... F_{s+1} G w_s, so that

    |r . Z_t| <= sum_{s < t} sum_j |(r F_{t-1} ... F_{s+1} G)_j| h_j,

which is attained: the per-step reach of the error of tube MPC, and of its minimal robust positively invariant set for
t -> oo (Mayne, Seron, Rakovic, Automatica 41, 2005). The sub-Gaussian tail grows beyond it once t is large.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from certbound.arrays import Array
from certbound.gaussian.response.linear_response import LinearResponse
from certbound.gaussian.response.martingale_windows import (
    ROUND,
    logsumexp,
    one_cell,
    ratio_down,
    ratio_up,
    size_of,
)
from certbound.gaussian.scalar import log_below_above, log_tail

_KEPT = 16  # bounds that an event remembers
_UNIT = 2.0**-53
MOST_ENTRIES = 1_000_000
"""Numbers F ... F G over all steps beyond which the reach is not looked at: some 100 MB of the checker's memory."""


def _product_rounding(n: int) -> float:
    """Relative rounding error of a sum of n products."""
    return 1.02 * (n + 2) * 2.0**-53


class StepEvents:
    """Discrete time. ``gaussian`` noise: first exceedances; any other sub-Gaussian law: the union bound.

    ``bounded``: G and h of noise G w with |w_j| <= h_j where Z begins at 0: no level beyond its reach is exceeded then,
    which is looked at as long as the checker can.
    """

    def __init__(
        self, response: LinearResponse, cell: int, gaussian: bool, bounded: tuple[Array, Array] | None = None
    ) -> None:
        self.response, self.cell, self.gaussian = one_cell(response, cell), cell, gaussian
        noise = None if bounded is None else BoundedNoise(matrix=bounded[0], halfwidth=bounded[1])
        self.bounded = noise if noise is not None and noise.affordable(response.pieces) else None
        self.shared_log = -np.inf
        self.found: dict[bytes, StepEvent] = {}

    def along(self, rows: Array) -> StepEvent:
        """The event along ``rows`` (nodes, n); -w . Z has the law of w . Z."""
        if rows.ravel()[np.argmax(rows.ravel() != 0)] < 0:
            rows = 0.0 - rows
        key = rows.tobytes()
        if key not in self.found:
            self.found[key] = self._along(rows)
        return self.found[key]

    @cached_property
    def sizes(self) -> Array:
        """Bounds of the standard deviation along any row with entries in [-1, 1], at all nodes."""
        return size_of(self.response, np.arange(self.response.pieces + 1))

    def _along(self, rows: Array) -> StepEvent:
        nodes = np.arange(len(rows))
        variances = [v[0] for v in self.response.variance(rows[None], nodes)]
        if not self.gaussian:
            reach = None if self.bounded is None else reach_along(self.response, rows, self.bounded)
            return StepEvent(variances[0], variances[1], None, reach)
        low, high = variances
        following = np.einsum("ti,tij->tj", rows[1:], self.response.transition[0, : len(rows) - 1])
        # the row at t + 1 seen from t is w F up to the rounding of this product
        cross_lo, _ = self.response.covariance_of(following[None], rows[None, :-1], nodes[:-1])
        least, most = np.sqrt(np.maximum(low, 0)), np.sqrt(np.maximum(high, 0))
        scale, low_scale = most[:-1] * most[1:] * ROUND, least[:-1] * least[1:] / ROUND
        size = np.einsum("ti,tij->t", np.abs(rows[1:]), np.abs(self.response.transition[0, : len(rows) - 1]))
        loss = size * _product_rounding(rows.shape[1]) * self.sizes[: len(rows) - 1]
        cross = cross_lo[0] - loss * most[:-1] * ROUND
        with np.errstate(divide="ignore", invalid="ignore"):
            correlation = np.where(cross >= 0, cross / scale, cross / low_scale)
        correlation = np.where(np.isfinite(correlation), np.clip(correlation - 1e-14, -1.0, 1.0), -1.0)
        return StepEvent(low, high, correlation)


@dataclass(frozen=True, eq=False)
class StepEvent:
    """One row's variances (lower and upper bounds) and lower bounds of its correlations from step to step."""

    low: Array
    high: Array
    correlation: Array | None
    reach: Array | None = None  # what the row's value never exceeds
    known: dict[bytes, float] = field(default_factory=dict)  # the last few bounds found, by the levels' bytes

    @property
    def profile(self) -> Array:
        """Shape of levels: the standard deviation."""
        return np.asarray(np.sqrt(np.maximum(self.high, 0.0)))

    def capped(self, levels: Array) -> Array:
        """Levels that cost no more, the reach where they lie beyond it."""
        return levels if self.reach is None else np.minimum(levels, self.reach)

    def log_exceedance(self, levels: Array) -> float:
        """Upper bound of log P(exists t: rows[t] . Z_t > levels[t])."""
        if np.any(levels < 0):
            return 0.0
        key = levels.tobytes()
        if key not in self.known:
            while len(self.known) >= _KEPT:
                del self.known[next(iter(self.known))]
            self.known[key] = self._log_exceedance(levels)
        return self.known[key]

    def _log_exceedance(self, levels: Array) -> float:
        above = ratio_down(levels, self.high)
        if self.correlation is None:
            if self.reach is not None:
                above = np.where(levels >= self.reach, np.inf, above)
            with np.errstate(over="ignore"):
                exponent = -0.5 * np.minimum(above, 1e150) ** 2
            return min(logsumexp(np.where(above == np.inf, -np.inf, exponent * (1 - 1e-15))), 0.0)
        return min(logsumexp(self.log_steps(levels)), 0.0)

    def log_steps(self, levels: Array) -> Array:
        """Upper bounds of log P(xi_0 > z_0) and log P(xi_{t-1} <= z_{t-1}, xi_t > z_t): (nodes,); levels >= 0.

        Raises
        ------
        ValueError
            If the noise is not Gaussian: then this is no bound of what it says.
        """
        if self.correlation is None:
            raise ValueError("`levels` along sub-Gaussian noise have no joint law; use log_exceedance.")
        above = ratio_down(levels, self.high)
        single = log_tail(above)
        joint = log_below_above(ratio_up(levels, self.low)[:-1], above[1:], self.correlation)
        return np.concatenate([single[:1], np.minimum(joint, single[1:])])


@dataclass(frozen=True, eq=False, kw_only=True)
class BoundedNoise:
    """G (n, m) and h (m,), both exact."""

    matrix: Array
    halfwidth: Array

    def affordable(self, steps: int) -> bool:
        """Whether the reach is looked at over so many steps."""
        n, m = self.matrix.shape
        return bool((steps + 1) * steps * n * m // 2 <= MOST_ENTRIES)


def reach_along(response: LinearResponse, rows: Array, noise: BoundedNoise) -> Array:
    """Upper bounds of |rows[t] . Z_t| for one cell and rows (nodes, n), in floating point rounded up: shape (nodes,).

    Z_0 is 0; entries of F are known up to ``response.transition_error``.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        found = _reach(response.transition[0], response.transition_error[0], rows, noise)
    return np.where(np.isnan(found), np.inf, found)


def _reach(matrices: Array, errors: Array, rows: Array, noise: BoundedNoise) -> Array:
    n, m = noise.matrix.shape
    unit = (n + m + 4) * _UNIT * 1.01
    size, width = np.abs(noise.matrix), noise.halfwidth
    total = np.zeros(len(rows))
    row, error = np.array(rows[1:], dtype=float), np.zeros((len(rows) - 1, n))  # at t = 1, 2, ...
    for lag in range(len(rows) - 1):  # what w_{t-1-lag} does, at t > lag
        driven = np.abs(row @ noise.matrix) + unit * (np.abs(row) @ size) + error @ size * (1 + unit)
        total[lag + 1 :] += driven @ width
        row, error = row[1:], error[1:]
        f, slack = matrices[1 : len(row) + 1], errors[1 : len(row) + 1, None]  # F_{t-1-lag} at t > lag + 1
        length = np.abs(row)
        wide = np.einsum("ti,tij->tj", length, np.abs(f))
        spread = np.einsum("ti,tij->tj", error, np.abs(f)) + slack * error.sum(axis=1, keepdims=True)
        error = (spread + unit * wide + slack * length.sum(axis=1, keepdims=True)) * (1 + 4 * unit)
        row = np.einsum("ti,tij->tj", row, f)
    return np.asarray(total * (1 + (len(rows) + m + 8) * 2 * _UNIT) + np.where(total > 0, 1e-300, 0.0))
