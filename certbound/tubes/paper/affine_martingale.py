"""Tail bounds from affine martingales (Lemmas 1 and 3 of the paper, with E7 of docs/theory.md).

M >= 0 is an affine martingale when, conditionally on the past, d E[M]/dt <= a_t M + b_t (CT) or E[M_{t+1}] <= a_t M_t +
b_t (DT, a_t >= 0: without that sign the statement is false). With psi_t = exp(int_t^T a) or prod_{k >= t} a_k,
M_t psi_t + int_t^T b psi (DT: sum_{k >= t} b_k psi_{k+1}) is a nonnegative supermartingale, so that

    P(exists t <= T: M_t psi_t + int_t^T b psi > level) <= (E[M_0] psi_0 + int_0^T b psi)/level.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from flint import arb
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.rigor.balls import lower, precision, upper
from certbound.tubes.ballpath import integral


@dataclass(frozen=True, eq=False, kw_only=True)
class AffineMartingale:
    """Coefficients of an affine martingale, constant on pieces.

    Parameters
    ----------
    times : array_like (K + 1,)
        Piece ends from 0 to the horizon; whole steps in discrete time.
    slope, offset : array_like (K,) or float
        a and b on [times[k], times[k+1]).
    continuous : bool
        CT (Lemma 1) or DT (Lemma 3).

    Raises
    ------
    ValueError
        If shapes differ, a value is not finite, or a < 0 in discrete time (E7).
    """

    times: ArrayLike
    slope: ArrayLike
    offset: ArrayLike
    continuous: bool

    def __post_init__(self) -> None:
        times = np.asarray(self.times, dtype=float)
        if times.ndim != 1 or len(times) < 2 or times[0] != 0 or not np.all(np.diff(times) > 0):
            raise ValueError("`times` must rise strictly from 0 and have at least two entries.")
        if not self.continuous and np.any(times != np.round(times)):
            raise ValueError("`times` must be whole numbers of steps in discrete time.")
        object.__setattr__(self, "times", times)
        for name in ("slope", "offset"):
            values = np.asarray(getattr(self, name), dtype=float)
            if values.ndim > 1 or (values.ndim == 1 and len(values) != len(times) - 1):
                raise ValueError(f"`{name}` must be a number or {len(times) - 1} values, got shape {values.shape}.")
            if not np.all(np.isfinite(values)):
                raise ValueError(f"`{name}` must be finite.")
            object.__setattr__(self, name, np.broadcast_to(values, len(times) - 1).copy())
        if not self.continuous and np.any(np.asarray(self.slope) < 0):
            raise ValueError("`slope` must not be negative in discrete time: Lemma 3 is false there (E7).")

    @cached_property
    def _nodes(self) -> tuple[list[arb], list[arb]]:
        """(psi, rest) at the times, rest = int_t^T b psi."""
        times, slopes = np.asarray(self.times).tolist(), np.asarray(self.slope).tolist()
        offsets = np.asarray(self.offset).tolist()
        with precision():
            psi, rest = [arb(1)], [arb(0)]
            for k in range(len(slopes) - 1, -1, -1):
                factor, spent = self._stretch(slopes[k], offsets[k], arb(times[k + 1]) - arb(times[k]))
                rest.append(rest[-1] + spent * psi[-1])
                psi.append(psi[-1] * factor)
        return psi[::-1], rest[::-1]

    def _stretch(self, slope: float, offset: float, length: arb) -> tuple[arb, arb]:
        """(psi over a stretch, int of b psi over it) in units of psi at its end."""
        a, b = arb(slope), arb(offset)
        if self.continuous:
            return (a * length).exp(), b * integral(a, length)
        power = a ** int(float(length))
        return power, b * (length if slope == 1 else (power - 1) / (a - 1))

    def bound(self, initial: float, level: float) -> float:
        """Upper bound of P(exists t: M_t psi_t + rest_t > level) for E[M_0] = ``initial``, at most 1.

        Examples
        --------
        >>> walk = AffineMartingale(times=[0.0, 2.0], slope=0.0, offset=1.0, continuous=True)
        >>> walk.bound(0.0, 20.0)
        0.1
        """
        if not (initial >= 0 and level > 0):
            raise ValueError(f"`initial` must not be negative and `level` positive, got {initial} and {level}.")
        psi, rest = self._nodes
        with precision():
            return min(1.0, max(0.0, upper((arb(initial) * psi[0] + rest[0]) / arb(level))))

    def threshold(self, level: float, t: float) -> float:
        """Largest M (rounded up) with M psi_t + rest_t <= level: the set that M stays in."""
        times = np.asarray(self.times)
        if not 0 <= t <= times[-1]:
            raise ValueError(f"`t` must lie in [0, {times[-1]}], got {t}.")
        psi, rest = self._nodes
        k = int(np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2))
        with precision():
            left = arb(float(times[k + 1])) - arb(float(t))
            factor, spent = self._stretch(float(np.asarray(self.slope)[k]), float(np.asarray(self.offset)[k]), left)
            value = (arb(level) - rest[k + 1] - spent * psi[k + 1]) / (factor * psi[k + 1])
            return upper(value) if lower(factor) > 0 else np.inf


def estimate_affine_excess(
    energy: Callable[[Array], Array],
    states: Array,
    successors: Array,
    slope: float,
    offset: float,
    *,
    step: float = 0.0,
) -> tuple[Array, Array]:
    """Sampled excess over the definition, and its standard error, at each state.

    Parameters
    ----------
    energy : callable
        M, from arrays of shape (..., n) to (...).
    states : ndarray (N, n)
        Where the definition is tested.
    successors : ndarray (N, samples, n)
        Independent samples of the next state (DT), or of the state after ``step`` (CT).
    slope, offset : float
        a_t and b_t.
    step : float
        Time step in CT; 0 in DT.

    Returns
    -------
    excess, error : ndarray (N,)
        Mean of M(successor) minus a M + b (DT) or M + step (a M + b) (CT); a value far above its error refutes M.
    """
    now, after = np.asarray(energy(states)), np.asarray(energy(successors))
    allowed = now + step * (slope * now + offset) if step > 0 else slope * now + offset
    return after.mean(axis=1) - allowed, after.std(axis=1, ddof=1) / np.sqrt(after.shape[1])
