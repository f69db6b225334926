"""What noise of bounded entries can do at most along rows, in discrete time: the reach of Z, with probability 1.

Z+ = F_t Z + G w with |w_j| <= h_j and Z_0 = 0 gives r . Z_t = sum_{s < t} r F_{t-1} ... F_{s+1} G w_s, so that

    |r . Z_t| <= sum_{s < t} sum_j |(r F_{t-1} ... F_{s+1} G)_j| h_j,

which is attained: the per-step reach of the error of tube MPC, and of its minimal robust positively invariant set for
t -> oo (Mayne, Seron, Rakovic, Automatica 41, 2005). The sub-Gaussian tail grows beyond it once t is large.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.gaussian.response.linear_response import LinearResponse

MOST_ENTRIES = 1_000_000
"""Numbers F ... F G over all steps beyond which the reach is not looked at: some 100 MB of the checker's memory."""
_UNIT = 2.0**-53


@dataclass(frozen=True, eq=False, kw_only=True)
class BoundedNoise:
    """G (n, m) and h (m,), both exact."""

    matrix: Array
    halfwidth: Array

    def affordable(self, steps: int) -> bool:
        """Whether the reach is looked at over so many steps."""
        n, m = self.matrix.shape
        return (steps + 1) * steps * n * m // 2 <= MOST_ENTRIES


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
    return total * (1 + (len(rows) + m + 8) * 2 * _UNIT) + np.where(total > 0, 1e-300, 0.0)
