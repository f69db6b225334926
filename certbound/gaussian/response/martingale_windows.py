"""Numbers of the martingale windows: variances and spreads of every window, and what levels then cost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from certbound.arrays import Array, Integers
from certbound.errors import EngineError
from certbound.gaussian.response.linear_response import LinearResponse
from certbound.gaussian.scalar import log_below_above, log_tail

Found = TypeVar("Found")

ROUND = 1 + 1e-14


def logsumexp(values: Array) -> float:
    """Upper bound of log sum exp(values)."""
    values = np.asarray(values, dtype=float).ravel()
    top = float(values.max(initial=-np.inf))
    if not np.isfinite(top):
        return top
    total = np.log(np.exp(values - top).sum() * (1 + 1e-13 + 2e-16 * len(values))) + top
    return float(total + 4e-16 * (abs(top) + 1))


def level_left(level: Array, cost: Array) -> Array:
    """level - cost; an infinite level stays so, whatever it costs: nothing exceeds it."""
    with np.errstate(invalid="ignore"):
        return np.where(level == np.inf, np.inf, level - cost)


def ratio_down(level: Array, variance_hi: Array) -> Array:
    """level / standard deviation, rounded down; +inf for a variance of 0 and a level that is not negative."""
    sd = np.sqrt(np.maximum(variance_hi, 0.0)) * ROUND
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        value = level / sd
        value = np.where(sd > 0, value - np.abs(value) * 4e-16, np.where(level >= 0, np.inf, -np.inf))
    return np.where(level == np.inf, np.inf, value)


def ratio_up(level: Array, variance_lo: Array) -> Array:
    """level / standard deviation, rounded up."""
    sd = np.sqrt(np.maximum(variance_lo, 0.0)) / ROUND
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        value = level / sd
        value = np.where(sd > 0, value + np.abs(value) * 4e-16, np.inf)
    return np.where(level == np.inf, np.inf, value)


def spread_of(difference_hi: Array, scale: Array) -> Array:
    """Upper bound of sqrt((1 - rho)/(1 + rho)) from 1 - rho <= difference_hi / scale."""
    with np.errstate(divide="ignore", invalid="ignore"):
        gap = np.where(scale > 0, difference_hi / scale, 2.0) * ROUND
        gap = np.clip(gap, 0.0, 2.0)
        return np.sqrt(gap / np.maximum(2.0 - gap, 0.0)) * ROUND


def inverse_of(forward: Array, slack: float) -> tuple[Array, float]:
    """The inverse in floats and an entrywise bound of its error, where every entry of ``forward`` is off by ``slack``.

    Raises
    ------
    EngineError
        If it may be singular.
    """
    n = len(forward)
    inverse = np.asarray(np.linalg.inv(forward), dtype=float)
    size, norm = float(np.abs(inverse).sum(1).max()), float(np.abs(forward).sum(1).max())
    residual = float(np.abs(np.eye(n) - inverse @ forward).sum(1).max())
    residual += size * (n * slack + (n + 2) * 4e-16 * norm)
    if residual >= 0.5:
        raise EngineError(
            "the system is too stiff for the linear engine: the transition matrix of a window of its pieces of time is "
            "next to singular; shorten the horizon, or use another method."
        )
    return inverse, 2 * residual * size


def longer(forward: Array, slack: float, transition: Array, error: float) -> tuple[Array, float]:
    """The product with one more transition matrix, and its entrywise error bound."""
    n = len(forward)
    norm, size = float(np.abs(forward).sum(1).max()), float(np.abs(transition).max())
    column = float(np.abs(transition).sum(0).max())
    slack = slack * (column + n * error) + norm * error + (n + 2) * 4e-16 * norm * size
    return forward @ transition, slack * (1 + 1e-13)


@dataclass(frozen=True, eq=False, kw_only=True)
class Windows:
    """Bounds of the variances of r . M at the ends of every window, and spreads sqrt((1 - rho)/(1 + rho)).

    ``spread`` belongs to a window's start and end; ``turn`` to the previous window's direction and the window's own,
    at their common time.
    """

    end_high: Array
    begin_low: Array
    begin_high: Array
    spread: Array
    previous_low: Array
    turn: Array

    def log_exceedance(self, levels: Array) -> float:
        """Upper bound of log P(some window's r . M exceeds its level)."""
        if np.any(levels < 0):
            return 0.0
        above, below = ratio_down(levels, self.end_high), ratio_up(levels, self.begin_low)
        # at a window's start: the previous window kept its own direction below its level
        start_above = ratio_down(levels, self.begin_high)
        start = log_tail(start_above)
        joint = log_below_above(
            np.concatenate([below, ratio_up(levels[:-1], self.previous_low)]),
            np.concatenate([above, start_above[1:]]), spread=np.concatenate([self.spread, self.turn]),
        )
        inside = joint[: len(levels)] + np.log(2.0)
        start[1:] = np.minimum(start[1:], joint[len(levels) :])
        return min(logsumexp(np.concatenate([inside, start])), 0.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class Course:
    """One family of rows: its windows, the first piece of each, every piece's window, |b - r|, and a shape of levels.

    ``profile`` is the standard deviation, but in the first fifth at least that at its end, since a rough process at
    once leaves a band that vanishes with the standard deviation at t = 0.
    """

    windows: Windows
    starts: Integers
    window: Integers
    off: Array
    profile: Array


def remembered(memory: dict[Any, Any], key: object, compute: Callable[[], Found]) -> Found:
    """What ``compute`` returns, for all who share ``memory``."""
    if key not in memory:
        memory[key] = compute()
    found: Found = memory[key]
    return found


def size_of(response: LinearResponse, nodes: Integers) -> Array:
    """Bound of the standard deviation along any row with entries in [-1, 1], at ``nodes``."""
    total = np.abs(response.covariance[0, nodes]).sum(axis=(1, 2)) + np.abs(
        response.covariance_error[0, nodes]).sum(axis=(1, 2))
    return np.asarray(np.sqrt(total) * (1 + 1e-12))


def one_cell(response: LinearResponse, cell: int) -> LinearResponse:
    """The response of a single cell."""
    batches = {name: value for name, value in vars(response).items() if isinstance(value, np.ndarray)}
    alone: dict[str, Any] = {name: value[cell : cell + 1] for name, value in batches.items()}
    return replace(response, **alone)
