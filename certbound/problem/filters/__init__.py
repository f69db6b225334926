"""Coloured noise and lags of inputs: linear filters, whose states stand behind those of a system."""

from __future__ import annotations

from certbound.problem.filters.filters import Filter
from certbound.problem.filters.joined import (
    beside,
    check_used,
    checked_filters,
    filter_states,
    law_beside,
    noise_beside,
    started,
)

__all__ = [
    "beside",
    "check_used",
    "checked_filters",
    "Filter",
    "filter_states",
    "law_beside",
    "noise_beside",
    "started",
]
