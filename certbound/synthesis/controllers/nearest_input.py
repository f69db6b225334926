"""The quadratic program of the safety filter: the nearest input that leaves linearised faces their room."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.errors import SolverError

SLACK_WEIGHT = 1e6


class NearestInput:
    """min ||u - wanted||^2 + penalty * xi subject to rows u >= least - xi, xi >= 0, u in its box; Clarabel.

    All matrices keep one dense pattern, so that a solve costs no more than its numbers.
    """

    def __init__(self, faces: int, low: Array, high: Array) -> None:
        self._solver: Any = importlib.import_module("clarabel")
        sparse: Any = importlib.import_module("scipy.sparse")
        self._low, self._high, self._faces = low, high, faces
        m = len(low)
        above, below = np.isfinite(high), np.isfinite(low)
        self._bounds = np.concatenate([high[above], -low[below], [0.0]])
        self._dense = np.zeros((faces + len(self._bounds), m + 1))
        self._dense[faces:-1, :m] = np.concatenate([np.eye(m)[above], -np.eye(m)[below]])
        self._dense[:faces, m] = self._dense[-1, m] = -1.0
        rows, columns = self._dense.shape
        places = np.tile(np.arange(rows), columns), np.arange(columns + 1) * rows
        self._matrix = sparse.csc_matrix((self._dense.ravel(order="F"), *places), shape=self._dense.shape)
        self._weight = sparse.csc_matrix(np.eye(m + 1))
        self._settings = self._solver.DefaultSettings()
        self._settings.verbose = False
        self._cones = [self._solver.NonnegativeConeT(rows)]

    def solve(self, wanted: Array, rows: Array, least: Array) -> Array:
        """The input; faces that are not asked are left out of ``rows``."""
        m, count = len(wanted), len(rows)
        self._dense[: self._faces, :m] = 0.0
        self._dense[:count, :m] = -rows
        self._matrix.data[:] = self._dense.ravel(order="F")
        right = np.concatenate([-least, np.ones(self._faces - count), self._bounds])
        linear = np.append(-wanted, SLACK_WEIGHT)
        problem = (self._weight, linear, self._matrix, right, self._cones, self._settings)
        found = self._solver.DefaultSolver(*problem).solve()
        answer = np.asarray(found.x)[:m]
        if not np.all(np.isfinite(answer)):
            raise SolverError(f"the filter's program was not solved ({found.status}); scale the inputs to like sizes.")
        return np.asarray(np.clip(answer, self._low, self._high))
