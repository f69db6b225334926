"""Value functions: the probability of failing as a function of the state, proved step by step.

The only part of the checker that uses NumPy: ``batches`` are Taylor models over many boxes at once, ``spans`` intervals
over arrays. Both are the checker's own; ``batch_tapes`` (a tape on batches), ``normal_means`` (the mean after the
noise) and ``step_back`` (one step back) rest on them, ``passage`` and ``crossing`` (continuous time, from above and
from below). ``kolmogorov`` proves that a solution of the backward equation bounds the probability. ``quadratic`` proves
quadratic value bounds in balls, with ``boundaries`` (where paths may go) and ``second_order`` (what drives them).
"""

from certbound.checker.values.kolmogorov import check_backward, check_backward_below
from certbound.checker.values.proof import check_values, check_values_below
from certbound.checker.values.quadratic import check_quadratic

__all__ = ["check_backward", "check_backward_below", "check_quadratic", "check_values", "check_values_below"]
