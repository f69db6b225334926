"""Levels along a family of rows that the Gaussian response exceeds with a granted probability."""

from __future__ import annotations

import numpy as np

from certbound.arrays import Array
from certbound.gaussian.response.clocks import SteadyEvent
from certbound.gaussian.response.events import WindowEvent
from certbound.gaussian.response.martingales import SplitEvent
from certbound.gaussian.response.step_events import StepEvent

Event = StepEvent | WindowEvent | SteadyEvent | SplitEvent

_TRIES = 12


def level_along(event: Event, target: float) -> Array:
    """Levels z, piece by piece, with P(exists t: row . Z > z) <= exp(target); inf if none are found.

    They follow the standard deviation. Where windows pay for a turning row, what it costs there is added there, lest
    the piece with the fastest turn raise the levels of all.
    """
    if not isinstance(event, WindowEvent):
        found = np.where(event.profile > 0, level_scale(event, event.profile, target), 0.0) * event.profile
        return event.capped(found) if isinstance(event, StepEvent) else np.asarray(found)
    deviation = np.sqrt(np.maximum(event.course.windows.end_high, 0.0))[event.course.window]
    shape = np.maximum(event.profile, deviation)
    factor = level_scale(event, shape, target, event.cost)
    return factor * shape + event.cost * (1 + 1e-15) if np.isfinite(factor) else np.full(len(shape), np.inf)


def level_scale(event: Event, shape: Array, target: float, offset: Array | float = 0.0) -> float:
    """Factor q, nearly the least, with P(exists t: row . Z > q shape + offset) <= exp(target); inf if none is found.

    log P falls by about q dq, which gives the next q; the last one tried that is proved counts.
    """
    q = float(np.sqrt(2 * max(-target, 0.0) + 2.0))
    best, low = np.inf, 0.0
    for _ in range(_TRIES):
        log = event.log_exceedance(q * shape + offset)
        if log <= target:
            best = q
            if log > target - 0.02:
                break
        else:
            low = q
        step = np.sqrt(max(q * q + 2 * (log - target + 0.01), 0.0)) if log < -0.1 else 1.3 * q
        q = float(step if low < step < best else (low + best) / 2 if np.isfinite(best) else 1.3 * q)
    return best
