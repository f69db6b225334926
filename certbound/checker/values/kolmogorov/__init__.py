"""A solution of the backward equation with its error (Thm K10): ``solution``, and what it rests on.

``patches`` (v of a file), ``cell_operator`` (the generator on cells), ``patch_residual`` (what v_t + L v exceeds 0 by),
``stage_limits`` (what the problem asks in a stage of time), ``stage`` (what v lacks of it), ``start_mean`` (normal
starts).
"""

from certbound.checker.values.kolmogorov.solution import check_backward, check_backward_below

__all__ = ["check_backward", "check_backward_below"]
