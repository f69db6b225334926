"""The search for a verdict where nothing is decided yet: which engine is asked next, and with which effort."""

from certbound.safety.search.efforts import Action, Standing, Turn, next_action

__all__ = ["Action", "Standing", "Turn", "next_action"]
