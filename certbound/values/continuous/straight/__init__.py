"""Two states, failing not too rare: the probability U itself instead of its logarithm.

``ramps`` proposes U, ``near_one`` corrects it by its own residual and proves V = e (U - 1) with a small e by
`hypotheses`: exp(V) is e U and a constant, but for e^2, so that the theorem of V = log u becomes the linear one.
"""

from certbound.values.continuous.straight.near_one import bound_between, bound_plane
from certbound.values.continuous.straight.ramps import PAST, SMALL, Ramps, Solve, left_at, ramp_of, stage_rates
from certbound.values.continuous.straight.relative import relative_below

__all__ = [
    "PAST", "SMALL", "Ramps", "Solve", "bound_between", "bound_plane", "left_at", "ramp_of", "relative_below",
    "stage_rates",
]
