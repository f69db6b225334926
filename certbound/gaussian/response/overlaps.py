"""The probability that some of several rows ever exceeds its levels, in discrete time, less what is counted twice.

All pairs (step, row) are put in order. The first one that exceeds has every earlier one below its level, so that

    P(some exceeds) <= sum over (t, j) of P(row j exceeds at t, not at t - 1, and row i does not at s)

for any earlier (s, i), chosen anew for every (t, j). Each term is P(not at t - 1, exceeds at t), as for one row alone,
less P(row i exceeds at s; row j does not at t - 1, and does at t), which is bounded from below.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Integers
from certbound.gaussian.response.linear_response import LinearResponse
from certbound.gaussian.response.martingale_windows import logsumexp
from certbound.gaussian.response.step_events import StepEvents
from certbound.gaussian.scalar import log_below_above, triple_below
from certbound.rigor.intervals import Interval
from certbound.rigor.rounding import quiet

_MOST = 4000  # pairs of (step, row) looked at; where there are more, the rows' own events are added
_WORTH = 1e-3  # share of its fair part of the whole that an overlap must promise
_UNIT = 2.0**-53


@quiet
def log_any_exceedance(events: StepEvents, rows: Sequence[Array], levels: Sequence[Array]) -> float:
    """Upper bound of log P(exists t and j: rows[j][t] . Z_t > levels[j][t]), for Gaussian noise.

    Every row has the shape (nodes, n), its levels (nodes,), with +inf where nothing is asked.
    """
    if any(np.any(z < 0) for z in levels):
        return 0.0
    z = np.stack(levels, axis=1)
    count, number = z.shape
    reach = min(_MOST // max(count * number * number, 1), count) - 1
    if reach < 1:
        return logsumexp(np.array([events.along(r).log_exceedance(v) for r, v in zip(rows, levels, strict=True)]))
    steps = np.stack([events.along(r).log_steps(v) for r, v in zip(rows, levels, strict=True)], axis=1)
    whole = logsumexp(steps)
    if whole == -np.inf:
        return whole
    carried = _Carried.of(events.response, np.stack(rows, axis=1), reach)
    variance = [np.stack([getattr(events.along(r), end) for r in rows], axis=1) for end in ("low", "high")]
    chosen = _choice(carried, z, variance[1], np.exp(steps), np.exp(whole) * _WORTH / steps.size)
    if not len(chosen.t):
        return min(whole, 0.0)
    t, j, i, lag = chosen.t, chosen.j, chosen.i, chosen.lag
    s = t - lag

    def between(first: Integers, node: Integers, second: Integers, past: Integers) -> Interval:
        """cov(row ``first`` at ``node``, row ``second`` at ``past``), the later one first."""
        late = past > node
        return carried.covariance(np.where(late, second, first), np.maximum(node, past),
                                  np.where(late, first, second), np.minimum(node, past))

    own = tuple((variance[0][a, b].clip(0.0), variance[1][a, b].clip(0.0)) for a, b in ((t - 1, j), (t, j), (s, i)))
    counted = triple_below(
        z[t - 1, j], z[t, j], z[s, i], (own[0], own[1], own[2]),
        (between(j, t, j, t - 1), between(j, t - 1, i, s), between(j, t, i, s)),
    )
    total = np.exp(whole) * (1 + 1e-14) - float(np.sum(counted)) * (1 - 1e-12)
    return min(float(np.log(max(total, 1e-300))) + 1e-14, whole, 0.0)


@dataclass(frozen=True, eq=False)
class _Choice:
    """For row j at t: the row i at t - lag whose overlap is subtracted."""

    t: Integers
    j: Integers
    i: Integers
    lag: Integers


@dataclass(frozen=True, eq=False)
class _Carried:
    """Rows at node t seen from node t - lag: ``rows[lag][t, j]`` = w_j(t) Phi(t, t - lag), errors (lag, t, j)."""

    response: LinearResponse
    rows: Array
    errors: Array

    @staticmethod
    def of(response: LinearResponse, rows: Array, reach: int) -> _Carried:
        """``rows`` (nodes, J, n) carried back by up to ``reach`` steps."""
        count, number, n = rows.shape
        f, phi = response.transition[0], response.transition_error[0]
        found, errors = np.zeros((reach + 1, count, number, n)), np.zeros((reach + 1, count, number))
        found[0] = rows
        for lag in range(1, reach + 1):
            late = np.arange(lag, count)
            step, before, loose = f[late - lag], found[lag - 1, late], errors[lag - 1, late]
            found[lag, late] = before @ step
            size = (np.abs(before) @ np.abs(step)).max(axis=-1)
            column = np.abs(step).sum(axis=1).max(axis=-1)[:, None]
            loss = phi[late - lag][:, None]
            grown = column * loose + loss * (np.abs(before).sum(axis=-1) + n * loose)
            errors[lag, late] = (grown + 2 * (n + 2) * _UNIT * size) * (1 + 1e-12)
        return _Carried(response, found, errors)

    def rough(self, lag: int) -> Array:
        """cov(row j at t, row i at t - lag) in floats: (nodes - lag, J, J)."""
        count = self.rows.shape[1]
        seen = self.rows[lag, lag:] @ self.response.covariance[0, : count - lag]
        return np.asarray(seen @ np.swapaxes(self.rows[0, : count - lag], -1, -2))

    def covariance(self, first: Integers, node: Integers, second: Integers, past: Integers) -> Interval:
        """cov(row ``first`` at ``node``, row ``second`` at ``past``), past <= node."""
        lag = node - past
        row, other = self.rows[lag, node, first], self.rows[0, past, second]
        lo, hi = (bound[0] for bound in self.response.covariance_of(row[None], other[None], past))
        size = np.abs(self.response.covariance[0, past]) + np.abs(self.response.covariance_error[0, past])
        seen = np.einsum("kij,kj->k", size, np.abs(other))
        slack = self.errors[lag, node, first] * seen * (1 + 1e-12)
        return Interval(lo - slack, hi + slack)


def _choice(carried: _Carried, z: Array, variance: Array, terms: Array, worth: float) -> _Choice:
    """The overlaps that promise most: P(both) at t less P(both) at t - 1, in floats (any choice is sound)."""
    count, number = z.shape
    reach = len(carried.rows) - 1
    sd = np.sqrt(np.maximum(variance, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        unit = np.where(sd > 0, z / sd, np.inf)
    best, where = np.full((count, number), worth), np.zeros((2, count, number), dtype=np.int64)
    both = [_both(carried, unit, sd, lag) for lag in range(reach + 1)]  # [lag][t - lag, j, i]
    for lag in range(reach + 1):
        late = np.arange(max(lag, 1), count)
        # lag 0: row i at t, row j at t - 1
        before = both[lag - 1][late - lag] if lag else np.swapaxes(both[1], 1, 2)[late - 1]
        gain = both[lag][late - lag] - before
        for i in range(number):
            own = np.array([lag > 1 or (lag == 1 and i != j) or (lag == 0 and i < j) for j in range(number)])
            better = own & (terms[late] > worth) & (gain[:, :, i] > best[late])
            place = np.nonzero(better)
            best[late[place[0]], place[1]] = gain[:, :, i][better]
            where[0, late[place[0]], place[1]], where[1, late[place[0]], place[1]] = i, lag
    t, j = np.nonzero(best > worth)
    return _Choice(t, j, where[0, t, j], where[1, t, j])


def _both(carried: _Carried, unit: Array, sd: Array, lag: int) -> Array:
    """P(row j exceeds at t, row i at t - lag), about."""
    count = len(unit)
    scale = sd[lag:, :, None] * sd[: count - lag, None, :]
    with np.errstate(divide="ignore", invalid="ignore"):
        rho = np.clip(np.nan_to_num(carried.rough(lag) / scale), -1 + 1e-12, 1 - 1e-12)
    late, early = np.broadcast_arrays(unit[lag:, :, None], unit[: count - lag, None, :])
    return np.exp(log_below_above(-early, late, -rho))
