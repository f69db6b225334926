"""Problems as other problems that engines serve: what is proved of the one holds of the other."""

from __future__ import annotations

from certbound.problem.reductions.resting_limits import RestingLimits, bring_to_rest

__all__ = ["bring_to_rest", "RestingLimits"]
