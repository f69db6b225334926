"""A solution of the backward equation with its error: ``patches`` (what a file states), ``supersolution`` (Thm K10)."""

from certbound.checker.values.kolmogorov.supersolution import check_backward, check_backward_below

__all__ = ["check_backward", "check_backward_below"]
