"""Bounds of the stochastic deviation, coordinate by coordinate and piece by piece."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array, Index


@dataclass(frozen=True, eq=False, kw_only=True)
class DeviationTube:
    """Bounds, coordinate by coordinate, of the deviation X - x from every associated trajectory.

    Proves: with probability at least 1 - 10**log10_delta, |X_t - x_t|_i <= ``half_widths[k, i]`` for every state i
    and every t in [times[k], times[k + 1]), whatever the start and the disturbance. Source: Thm K7.

    Parameters
    ----------
    times : ndarray, shape (K + 1,)
    half_widths : ndarray, shape (K, n)
    log10_delta : float
    """

    times: Array
    half_widths: Array
    log10_delta: float
    method: str = "linear"
    level: str = "trajectory"
    certified: bool = True
    parameters: Mapping[str, float] = field(default_factory=dict)

    @property
    def horizon(self) -> float:
        """Last time that the tube covers."""
        return float(self.times[-1])

    @cached_property
    def radii(self) -> Array:
        """Euclidean bound of the deviation on each piece."""
        return np.asarray(np.linalg.norm(self.half_widths, axis=1) * (1 + 1e-14))

    def _piece(self, t: ArrayLike) -> Index:
        index = np.searchsorted(self.times, np.asarray(t, dtype=float), side="right") - 1
        return np.clip(index, 0, len(self.half_widths) - 1)

    def radius(self, t: ArrayLike) -> Any:
        """Euclidean bound of the deviation at times ``t``."""
        value = self.radii[self._piece(t)]
        return float(value) if np.ndim(t) == 0 else value

    def bound(self, t0: float, t1: float) -> float:
        """Supremum of the radius over [t0, t1]."""
        return float(self.radii[int(self._piece(t0)) : int(self._piece(t1)) + 1].max())

    def extent(self, directions: ArrayLike, t: ArrayLike) -> Any:
        """Bound of a . (X_t - x_t) for directions a of shape (..., n)."""
        value = np.abs(np.asarray(directions, dtype=float)) @ self.half_widths[self._piece(t)].T * (1 + 1e-14)
        return float(value) if np.ndim(value) == 0 else value
