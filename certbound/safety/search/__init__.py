"""The search for a verdict: which engine is asked next, and with which effort; and of limits that move in what terms."""

from certbound.safety.search.efforts import Action, Standing, Turn, next_action
from certbound.safety.search.moving_limits import is_moving, moving_verdict

__all__ = ["Action", "is_moving", "moving_verdict", "next_action", "Standing", "Turn"]
