"""Matrices, eigenvalues and normal tails in ball arithmetic."""

from __future__ import annotations

from certbound.checker.balls.eigen import FEWEST_HALVINGS, cholesky, largest_eigenvalue
from certbound.checker.balls.matrices import (
    column,
    diagonal,
    identity,
    is_positive_definite,
    magnitude,
    matrix,
    quadratic,
    row_sums,
    upper,
)
from certbound.checker.balls.normal import below_and_above, tail

__all__ = [
    "FEWEST_HALVINGS",
    "below_and_above",
    "cholesky",
    "column",
    "diagonal",
    "identity",
    "is_positive_definite",
    "largest_eigenvalue",
    "magnitude",
    "matrix",
    "quadratic",
    "row_sums",
    "tail",
    "upper",
]
