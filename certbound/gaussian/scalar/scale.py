"""The least scale of a profile for a given probability; the best split of a probability over directions."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from certbound.errors import InfeasibleError

__all__ = ["least_scale", "split_levels"]

Array = NDArray[np.float64]
Bound = Callable[[float], Any]


def least_scale(
    log10_probability: Bound,
    log10_delta: float,
    *,
    start: float = 1.0,
    tolerance: float = 1e-4,
    largest: float = 1e12,
) -> float:
    """The least q (to a relative ``tolerance``) at which a certified bound is at most delta.

    Proves: log10_probability(q) <= log10_delta for the q returned: it was evaluated there. That no smaller
    q does is certain only for a bound that falls in q; then the bound fails at q (1 - tolerance).

    Parameters
    ----------
    log10_probability : callable
        q -> upper bound of log10 of the probability with all levels scaled by q > 0.
    log10_delta : float
        Target, < 0.
    start : float
        First trial, > 0: a good guess saves evaluations (about seven are needed).
    tolerance : float
        Relative width of the final bracket.
    largest : float
        Give up beyond it.

    Returns
    -------
    float

    Raises
    ------
    ValueError
        If ``log10_delta`` is not negative, or ``start`` or ``tolerance`` is not positive.
    InfeasibleError
        If no scale up to ``largest`` will do.

    Examples
    --------
    >>> round(least_scale(lambda q: -q * q / 2, -8.0), 3)
    4.0
    """
    if not log10_delta < 0:
        raise ValueError(f"`log10_delta` must be negative (delta in (0, 1)), got {log10_delta}.")
    if not (start > 0 and tolerance > 0):
        raise ValueError(f"`start` and `tolerance` must be positive, got {start} and {tolerance}.")
    low, high, at_low, at_high = 0.0, math.inf, math.inf, -math.inf
    q = float(start)
    for count in range(200):
        value = float(log10_probability(q)) - log10_delta
        if value <= 0:
            high, at_high = q, value
        else:
            low, at_low = q, value
        if math.isfinite(high) and (high - low <= tolerance * high or high < 1e-300):
            return high
        if low > largest:
            break
        q = _next_trial(q, value, log10_delta, (low, high), (at_low, at_high), count, tolerance)
    raise InfeasibleError(
        f"no scale up to {largest:g} brings the bound down to 10^{log10_delta:g} (at {low:g} it is "
        f"10^{at_low + log10_delta:.3g}); ask for a larger delta or check that the levels scale with q."
    )


def _next_trial(
    q: float,
    value: float,
    target: float,
    bracket: tuple[float, float],
    values: tuple[float, float],
    count: int,
    tolerance: float,
) -> float:
    """The log of a Gaussian tail is nearly linear in q^2: extrapolate, then interpolate, safeguarded."""
    (low, high), (at_low, at_high) = bracket, values
    if low == 0.0 or not math.isfinite(high):
        level = value + target
        ratio = math.sqrt(target / level) if level < 0 and math.isfinite(level) else math.nan
        if low == 0.0:
            return q * (min(max(ratio * (1 - tolerance), 0.1), 0.97) if math.isfinite(ratio) else 0.5)
        return q * (min(max(ratio * (1 + tolerance), 1.03), 10.0) if math.isfinite(ratio) else 2.0)
    if count % 4 == 3 or not math.isfinite(at_high - at_low):
        return math.sqrt(low * high)
    share = at_low / (at_low - at_high)
    trial = math.sqrt(low * low + share * (high * high - low * low))
    # aim a little past the root, alternately to both sides, so that both ends of the bracket close in
    trial *= 1 + 0.4 * tolerance if count % 2 else 1 - 0.4 * tolerance
    return min(max(trial, low + 0.1 * tolerance * high), high - 0.1 * tolerance * high)


def split_levels(
    bounds: Sequence[Bound],
    log10_delta: float,
    *,
    weights: ArrayLike | None = None,
    start: ArrayLike | None = None,
    tolerance: float = 1e-4,
    rounds: int = 4,
) -> tuple[Array, Array]:
    """Scales q_j with sum_j P_j(q_j) <= delta that make sum_j w_j q_j small.

    Proves: bounds[j](q_j) <= log10_deltas[j] for each j, and the deltas sum to at most delta; so all levels
    hold at once with probability 1 - delta. The split is the stationary point of sum w_j q_j(delta_j), a
    convex problem where q_j(delta_j) is convex: delta_j proportional to w_j/|d log P_j/dq_j|, iterated.

    Parameters
    ----------
    bounds : sequence of callables
        q -> upper bound of log10 P_j at scale q.
    log10_delta : float
        Total, < 0.
    weights : array_like, optional
        w_j > 0; ones when omitted.
    start : array_like, optional
        First trial scales.
    tolerance : float
        Relative tolerance of each scale.
    rounds : int
        Rounds of the split; 1 means equal shares.

    Returns
    -------
    scales, log10_deltas : ndarray, shape (J,)

    Raises
    ------
    ValueError
        If there is nothing to split, or a weight is not positive.
    InfeasibleError
        From `least_scale`.

    Examples
    --------
    >>> scales, shares = split_levels([lambda q: -q * q, lambda q: -4 * q * q], -4.0)
    >>> bool(np.sum(10.0**shares) <= 1e-4), (scales**2).round(2).tolist()
    (True, [4.17, 1.12])
    """
    count = len(bounds)
    if count == 0:
        raise ValueError("`bounds` must hold at least one direction.")
    if not log10_delta < 0:
        raise ValueError(f"`log10_delta` must be negative (delta in (0, 1)), got {log10_delta}.")
    weight = np.ones(count) if weights is None else np.asarray(weights, dtype=np.float64)
    if weight.shape != (count,) or not np.all(weight > 0):
        raise ValueError(f"`weights` must be {count} positive numbers, got {weight.tolist()}.")
    scales = np.ones(count) if start is None else np.array(start, dtype=np.float64)
    shares = np.full(count, 1.0 / count)
    best: tuple[Array, Array] | None = None
    for _ in range(max(rounds, 1)):
        levels = log10_delta + np.log10(shares * (1 - 1e-12))
        scales = np.array(
            [
                least_scale(bound, level, start=q, tolerance=tolerance)
                for bound, level, q in zip(bounds, levels.tolist(), scales.tolist())
            ]
        )
        if best is None or float(weight @ scales) < float(weight @ best[0]):
            best = scales, levels
        slopes = np.array(
            [
                (float(bound(q)) - float(bound(1.02 * q))) / (0.02 * q)
                for bound, q in zip(bounds, scales.tolist())
            ]
        )
        if not np.all(np.isfinite(slopes) & (slopes > 0)):
            break
        shares = weight / slopes
        shares = shares / np.sum(shares)
    return best if best is not None else (scales, levels)
