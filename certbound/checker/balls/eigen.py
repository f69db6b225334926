"""Largest eigenvalues and Cholesky factors of ball matrices."""

from __future__ import annotations

from flint import arb, arb_mat

from certbound.checker.balls.matrices import identity, is_positive_definite, matrix, row_sums
from certbound.checker.report import Budget, Unproved

_HALVINGS = 60
FEWEST_HALVINGS = 40
"""Matrices that are looked at for the `largest_eigenvalue` of one that is not 0 and has more than one row, at least."""


def cholesky(a: arb_mat, budget: Budget | None = None) -> arb_mat:
    """Lower triangular L with L L^T = a, for every symmetric matrix in the ball matrix.

    `Unproved` where that is not shown to be positive definite.
    """
    n = a.nrows()
    if budget is not None:
        budget.balls(n * n * (n + 9) // 3)
    low = [[arb(0)] * n for _ in range(n)]
    for j in range(n):
        pivot = a[j, j] - sum((x * x for x in low[j][:j]), arb(0))
        if not pivot > 0:
            raise Unproved("a matrix is not positive definite")
        low[j][j] = pivot.sqrt()
        for i in range(j + 1, n):
            rest = a[i, j] - sum((low[i][k] * low[j][k] for k in range(j)), arb(0))
            low[i][j] = rest / low[j][j]
    return matrix(low)


def largest_eigenvalue(a: arb_mat, budget: Budget | None = None) -> arb:
    """Upper bound of the largest eigenvalue of a symmetric matrix, close to it; at least 0.

    Examples
    --------
    >>> found = largest_eigenvalue(matrix([[2.0, 1.0], [1.0, 2.0]]))
    >>> bool(found >= 3), bool(found < 3.000001)
    (True, True)
    """
    n, top = a.nrows(), row_sums(a)
    if n == 1:
        return arb.max(a[0, 0].upper(), arb(0))
    low, high = arb(0), top
    one = identity(n)
    for _ in range(_HALVINGS):
        if high - low <= high * arb(2) ** -FEWEST_HALVINGS:
            break
        middle = ((low + high) / 2).mid()
        if is_positive_definite(one * middle - a, budget):
            high = middle
        else:
            low = middle
    return high.upper()
