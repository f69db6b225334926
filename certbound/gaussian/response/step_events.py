"""First exceedances of the Gaussian response along rows, in discrete time (scalar events of Thm K7)."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from certbound.arrays import Array
from certbound.gaussian.response.bounded_noise import BoundedNoise, reach_along
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


def _product_rounding(n: int) -> float:
    """Relative rounding error of a sum of n products."""
    return 1.02 * (n + 2) * 2.0**-53


class StepEvents:
    """Discrete time. ``gaussian`` noise: first exceedances; any other sub-Gaussian law: the union bound.

    ``bounded``: the noise, where its entries are bounded and Z begins at 0: no level beyond its reach is exceeded.
    """

    def __init__(
        self, response: LinearResponse, cell: int, gaussian: bool, bounded: BoundedNoise | None = None
    ) -> None:
        self.response, self.cell, self.gaussian = one_cell(response, cell), cell, gaussian
        self.bounded = bounded
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
