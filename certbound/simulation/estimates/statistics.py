"""What counts say about probabilities and quantiles."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array


def check_confidence(confidence: Any) -> float:
    """A number in (0, 1)."""
    value = float(confidence)
    if not 0.0 < value < 1.0:
        raise ValueError(f"`confidence` must lie in (0, 1), got {confidence!r}.")
    return value


def bound_binomial(successes: ArrayLike, trials: int, confidence: float = 0.99) -> tuple[Array, Array]:
    """Clopper-Pearson limits: each side misses the true probability with chance at most (1 - confidence)/2.

    Parameters
    ----------
    successes : array_like of int
        Number of successes, each among ``trials`` independent trials.
    trials : int
    confidence : float

    Returns
    -------
    tuple of ndarray
        Lower and upper limits, of the shape of ``successes``.

    Notes
    -----
    Clopper and Pearson (1934): quantiles of beta distributions. With no success at all the upper limit is
    1 - (alpha/2)^(1/trials), about 5.3/trials at 99 %.

    Examples
    --------
    >>> lower, upper = bound_binomial(0, 1000)
    >>> float(lower), round(float(upper), 5)
    (0.0, 0.00528)
    """
    from scipy.special import betaincinv

    tail = 0.5 * (1.0 - check_confidence(confidence))
    k = np.asarray(successes, dtype=float)
    if trials < 1 or np.any((k < 0) | (k > trials)):
        raise ValueError(f"`successes` must lie between 0 and `trials` = {trials}, got {successes!r}.")
    lower = np.where(k > 0, betaincinv(np.maximum(k, 1.0), trials - k + 1.0, tail), 0.0)
    upper = np.where(k < trials, betaincinv(k + 1.0, np.maximum(trials - k, 1.0), 1.0 - tail), 1.0)
    return lower, upper


def order_ranks(level: float, trials: int, confidence: float) -> tuple[int, int]:
    """Ranks (from 0) of order statistics that bracket the quantile of the given level; may be -1 or
    ``trials``.

    The number of values below the quantile is binomial, so that ranks at its tail quantiles miss it with
    chance at most (1 - confidence)/2 each.
    """
    from scipy.special import bdtr

    tail = 0.5 * (1.0 - check_confidence(confidence))
    spread = 10.0 * np.sqrt(trials * level * (1.0 - level)) + 50.0
    low, high = max(int(trials * level - spread), 0), min(int(trials * level + spread), trials)
    ranks = np.arange(low, high + 1)
    below = bdtr(ranks.astype(float), trials, level)  # P(number below <= rank)
    lower = low + int(np.searchsorted(below, tail)) - 1
    upper = low + min(int(np.searchsorted(below, 1.0 - tail)), high - low)
    return lower, upper
