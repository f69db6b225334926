"""Random starts, cell by cell: the probability of failing itself, from both sides."""

from __future__ import annotations

from certbound.reach.starts.cell_masses import StartBounds
from certbound.reach.starts.noisy import bound_noisy_start
from certbound.reach.starts.shared_response import in_half_spaces
from certbound.reach.starts.silent import bound_silent_start, is_silent

__all__ = ["bound_noisy_start", "bound_silent_start", "in_half_spaces", "is_silent", "StartBounds"]
