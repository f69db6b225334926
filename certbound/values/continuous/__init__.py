"""Value functions in continuous time."""

from certbound.values.continuous.exits import ExitBounds, bound_exits

__all__ = ["ExitBounds", "bound_exits"]
