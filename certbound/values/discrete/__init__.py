"""Discrete time: backward induction with functions that are multilinear plus a parabola or a cubic on cells of a grid.

From the bottom: ``dominance`` (constants of the normal density), ``shocks`` (the noise as independent coordinates),
``kernels`` (integrals of the basis functions), ``functions`` (what is carried from step to step), ``fields`` (its mean
after the noise, as a function of where the noise-free step ends), ``steps`` (the noise-free step on a grid),
``cubic`` (one step where all is smooth), ``induction`` (one step back), ``failures`` (the answer, refined until it is
good), ``long_runs`` (any number of steps).
"""

from certbound.values.discrete.failures import bound_failure
from certbound.values.discrete.kernels import AxisKernel, axis_kernel
from certbound.values.discrete.layout import FailureBounds
from certbound.values.discrete.long_runs import bound_long_run, chart_failures, step_grids
from certbound.values.discrete.steps import evaluate

__all__ = [
    "AxisKernel",
    "FailureBounds",
    "axis_kernel",
    "bound_failure",
    "bound_long_run",
    "chart_failures",
    "evaluate",
    "step_grids",
]
