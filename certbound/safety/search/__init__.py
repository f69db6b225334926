"""The search for a verdict: which engine is asked next, with which effort, and limits that move at rest."""

from certbound.safety.search.efforts import Action, Standing, Turn, next_action
from certbound.safety.search.moving_limits import is_moving, moving_verdict

__all__ = ["Action", "is_moving", "moving_verdict", "next_action", "Standing", "Turn"]
