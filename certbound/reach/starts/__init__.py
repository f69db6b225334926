"""Random starts, cell by cell: the probability of failing itself, from both sides."""

from __future__ import annotations

from certbound.reach.starts.averages import StartBounds
from certbound.reach.starts.silent import bound_silent_start

__all__ = ["bound_silent_start", "StartBounds"]
