"""Targets in continuous time (``entering``): who has met one cannot fail."""

from certbound.checker.values.reaching.entering import bound_failing_above, bound_failing_below

__all__ = ["bound_failing_above", "bound_failing_below"]
