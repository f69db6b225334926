"""A solution of the backward equation with its error: ``patches`` (v of a file), ``patch_residual`` (Thm K10)."""

from certbound.checker.values.kolmogorov.patch_residual import check_backward, check_backward_below

__all__ = ["check_backward", "check_backward_below"]
