"""One state and a model without t: the mean time of leaving and the rate, by functions of the state alone."""

from certbound.values.continuous.line.stationary.leaving_rate import Rate, bound_rate
from certbound.values.continuous.line.stationary.mean_time import bound_mean_time

__all__ = ["Rate", "bound_mean_time", "bound_rate"]
