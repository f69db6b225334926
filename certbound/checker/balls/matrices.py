"""Ball matrices: the few operations that python-flint's ``arb_mat`` leaves out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from flint import arb, arb_mat

from certbound.checker.report import Budget


def matrix(rows: Sequence[Sequence[Any]]) -> arb_mat:
    """A matrix of balls from rows of balls or floats."""
    count = len(rows[0]) if rows else 0
    return arb_mat(len(rows), count, [value if isinstance(value, arb) else arb(value) for row in rows for value in row])


def column(values: Sequence[arb]) -> arb_mat:
    """A column."""
    return arb_mat(len(values), 1, list(values))


def identity(n: int) -> arb_mat:
    """The identity."""
    return diagonal([arb(1)] * n)


def diagonal(values: Sequence[arb]) -> arb_mat:
    """A diagonal matrix."""
    n = len(values)
    entries = [arb(0)] * (n * n)
    for i, value in enumerate(values):
        entries[i * n + i] = value
    return arb_mat(n, n, entries)


def magnitude(a: arb_mat) -> arb_mat:
    """Upper bounds of |a_ij|."""
    return arb_mat(a.nrows(), a.ncols(), [x.abs_upper() for x in a.entries()])


def upper(x: arb) -> arb:
    """The upper end, an exact ball (+inf for what is not a number)."""
    return arb.pos_inf() if x.is_nan() else x.upper()


def row_sums(a: arb_mat) -> arb:
    """Upper bound of the largest row sum of |a|: the norm that maximum vectors induce."""
    columns = a.ncols()
    values = [x.abs_upper() for x in a.entries()]
    best = arb(0)
    for start in range(0, len(values), columns):
        best = arb.max(best, sum(values[start : start + columns], arb(0)))
    return best.upper()


def quadratic(first: arb_mat, form: arb_mat, second: arb_mat) -> arb:
    """first form second^T for rows ``first`` and ``second``."""
    return (first * form * second.transpose())[0, 0]


def is_positive_definite(a: arb_mat, budget: Budget | None = None) -> bool:
    """Whether every symmetric matrix in the ball matrix is positive definite (Cholesky on balls).

    Examples
    --------
    >>> is_positive_definite(matrix([[2.0, 1.0], [1.0, 2.0]])), is_positive_definite(matrix([[1.0, 1.0], [1.0, 1.0]]))
    (True, False)
    """
    n = a.nrows()
    if budget is not None:
        budget.balls(n * n * (n + 9) // 3)
    rows = [[a[i, j] for j in range(i + 1)] for i in range(n)]
    for j in range(n):
        pivot = rows[j][j]
        if not pivot > 0:
            return False
        for i in range(j + 1, n):
            factor = rows[i][j] / pivot
            for k in range(j + 1, i + 1):
                rows[i][k] = rows[i][k] - factor * rows[k][j]
    return True
