"""What comes and goes in continuous time: targets (``entering``), constraints that hold in windows (``gated``)."""

from certbound.checker.values.reaching.entering import bound_failing_above, bound_failing_below
from certbound.checker.values.reaching.gated import check_stages

__all__ = ["bound_failing_above", "bound_failing_below", "check_stages"]
