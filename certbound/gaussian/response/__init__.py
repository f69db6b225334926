"""Exceedances of the Gaussian response of a linear equation along rows, in discrete and continuous time."""

from __future__ import annotations

from certbound.gaussian.response.adjoint_rows import RowResponse
from certbound.gaussian.response.clocks import ClockEvents, SteadyEvent
from certbound.gaussian.response.events import WindowEvents
from certbound.gaussian.response.levels import level_along, level_scale
from certbound.gaussian.response.linear_response import (
    Jumps,
    LinearResponse,
    balanced,
    continuous_response,
    discrete_response,
)
from certbound.gaussian.response.martingale_windows import logsumexp
from certbound.gaussian.response.martingales import MartingaleEvent, Martingales, SplitEvents, Windowed, quantile
from certbound.gaussian.response.occupancy import log_occupancy
from certbound.gaussian.response.overlaps import log_any_exceedance
from certbound.gaussian.response.step_events import StepEvents
from certbound.gaussian.response.unions_below import Exceedances

__all__ = [
    "balanced",
    "ClockEvents",
    "continuous_response",
    "discrete_response",
    "Exceedances",
    "Jumps",
    "level_along",
    "level_scale",
    "LinearResponse",
    "log_any_exceedance",
    "log_occupancy",
    "logsumexp",
    "MartingaleEvent",
    "Martingales",
    "quantile",
    "RowResponse",
    "SplitEvents",
    "SteadyEvent",
    "StepEvents",
    "Windowed",
    "WindowEvents",
]
