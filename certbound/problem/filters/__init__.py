"""Coloured noise and lags of inputs: linear filters, whose states stand behind those of a system."""

from __future__ import annotations

from certbound.problem.filters.filters import Filter
from certbound.problem.filters.joined import Filters

__all__ = ["Filter", "Filters"]
