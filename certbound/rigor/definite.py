"""Rigorous bounds of eigenvalues over batches of interval matrices.

The floating-point eigenvectors V only choose coordinates: the matrix is enclosed
in them rigorously, T = V^T A V, and the bound is read off T with the defect of orthogonality, |V^T V - I| <=
g, accounted for. There the largest eigenvalue of T is bounded by Collatz and Wielandt's quotient, which holds
for every positive vector w: lambda_max(T) <= max_i (N w)_i / w_i with N_ii = sup T_ii and N_ij = sup |T_ij|.
The bounds are exact up to rounding for point matrices and to first order in the radii.
"""

from __future__ import annotations

import numpy as np

from certbound.arrays import Array, Mask
from certbound.rigor.arithmetic import Interval, IntervalLike, matmul
from certbound.rigor.rounding import STEP, TINY, lower, product_error, quiet, upper

LARGE = 32
"""From this size on a single matrix is proved positive definite by a Cholesky factor: a tenth of the work."""


def _matrices(name: str, matrix: IntervalLike) -> Interval:
    x = matrix if isinstance(matrix, Interval) else Interval.point(matrix)
    if x.ndim < 2 or x.shape[-1] != x.shape[-2]:
        raise ValueError(f"`{name}` must be a batch of square matrices, got shape {x.shape}.")
    return x


@quiet
def eigenvalue_upper(A: IntervalLike) -> Array:
    """Upper bounds of the largest eigenvalue of symmetric interval matrices.

    Proves: lambda_max(S) <= result for every symmetric S in A; a diagonal that is unbounded below is allowed.

    Parameters
    ----------
    A : Interval or ndarray, shape (..., n, n)
        Read as the set of its symmetric members; an entry and its mirror image are intersected.

    Returns
    -------
    ndarray, shape (...)
        +inf where an entry that matters is unbounded.

    Raises
    ------
    ValueError
        If the matrices are not square, or an array is not symmetric.

    Examples
    --------
    >>> bool(0 <= eigenvalue_upper(np.array([[2.0, 1.0], [1.0, 2.0]])) - 3.0 < 1e-14)
    True
    """
    x = _matrices("A", A)
    n = x.shape[-1]
    if n == 1:
        return np.array(x.hi[..., 0, 0])
    lo, hi = np.maximum(x.lo, x.lo.swapaxes(-1, -2)), np.minimum(x.hi, x.hi.swapaxes(-1, -2))
    if not np.all(lo <= hi):
        raise ValueError("`A` must hold symmetric matrices; use (A + A.T) / 2.")
    diagonal = np.arange(n)
    lo[..., diagonal, diagonal] = hi[..., diagonal, diagonal]  # lambda_max rises with the diagonal
    if n == 2:
        return _largest_of_two(hi[..., 0, 0], hi[..., 1, 1], np.maximum(-lo[..., 0, 1], hi[..., 0, 1]))
    s, finite = finite_part(Interval._raw(lo, hi))
    v: Array = np.linalg.eigh(s.mid)[1]
    top = _collatz(matmul(v.swapaxes(-1, -2), matmul(s, v)))
    defect = _defect(v)
    bound = upper(top / np.where(top >= 0, lower(1.0 - defect), upper(1.0 + defect)), tiny=TINY)
    return np.where(finite & (defect < 0.5), bound, np.inf)


def eigenvalue_lower(A: IntervalLike) -> Array:
    """Lower bounds of the smallest eigenvalue; see `eigenvalue_upper`."""
    return -eigenvalue_upper(-_matrices("A", A))


@quiet
def is_positive_definite(A: IntervalLike) -> Mask:
    """True only where every symmetric matrix in A is proved positive definite.

    A is scaled to a unit diagonal by powers of two (which is exact) before its eigenvalues are bounded, so
    that badly scaled matrices are decided too.

    Parameters
    ----------
    A : Interval or ndarray, shape (..., n, n)

    Returns
    -------
    ndarray of bool, shape (...)

    Raises
    ------
    ValueError
        If the matrices are not square, or an array is not symmetric.
    """
    x = _matrices("A", A)
    diagonal = np.diagonal(x.lo, axis1=-2, axis2=-1)
    possible = np.all((diagonal > 0) & (diagonal < np.inf), axis=-1)
    safe = np.where(possible[..., None], diagonal, 1.0)
    exponent = -np.round(0.5 * np.log2(safe)).astype(np.int64)
    shift = np.clip(exponent[..., :, None] + exponent[..., None, :], -900, 900)
    scaled = Interval._raw(lower(np.ldexp(x.lo, shift), tiny=TINY), upper(np.ldexp(x.hi, shift), tiny=TINY))
    if x.ndim == 2 and x.shape[-1] >= LARGE:
        return np.asarray(possible & has_cholesky(scaled))
    return np.asarray(possible & (eigenvalue_lower(scaled) > 0))


@quiet
def has_cholesky(A: Interval) -> bool:
    """Whether one symmetric interval matrix, of a diagonal near 1, is proved positive definite by a factor R.

    Proves: with E = A - R^T R - s I in exact arithmetic, S >= (s - ||E||) I for every symmetric S in A, and ||E|| is at
    most its largest row sum. R is the floating-point Cholesky factor of the middle less s I, whatever its errors: only
    the product R^T R is enclosed. About three matrix products: n = 400 takes a tenth of a second.

    Parameters
    ----------
    A : Interval, shape (n, n)
    """
    if not (np.isfinite(A.lo).all() and np.isfinite(A.hi).all()):
        return False
    lo, hi = np.maximum(A.lo, A.lo.T), np.minimum(A.hi, A.hi.T)
    if not np.all(lo <= hi):
        raise ValueError("`A` must hold symmetric matrices; use (A + A.T) / 2.")
    x = Interval._raw(lo, hi)
    n, middle = x.shape[-1], x.mid
    gamma, _ = product_error(n)
    size = float(np.max(np.diag(middle), initial=0.0))
    spread = float(np.max(_sum_up(x.rad, axis=-1)))
    for factor in (1.0, 8.0):
        shift = factor * (2 * gamma * n * size) + 1.01 * spread
        try:
            R: Array = np.asarray(np.linalg.cholesky(middle - shift * np.eye(n)).T, dtype=float)
        except np.linalg.LinAlgError:
            return False
        rest = x - matmul(R.T, R) - shift * np.eye(n)
        if float(np.max(_sum_up(rest.mag, axis=-1))) < shift:
            return True
    return False


def finite_part(x: Interval) -> tuple[Interval, Mask]:
    """Matrices with those that hold an unbounded entry replaced by 0, and the mask of the bounded ones."""
    finite = np.asarray(np.isfinite(x.lo).all(axis=(-1, -2)) & np.isfinite(x.hi).all(axis=(-1, -2)))
    keep = finite[..., None, None]
    return Interval._raw(np.where(keep, x.lo, 0.0), np.where(keep, x.hi, 0.0)), finite


def _largest_of_two(a: Array, d: Array, b: Array) -> Array:
    """lambda_max of [[a, b], [b, d]] with b >= 0, rounded up.

    It is max(a, d) + b^2 / (r + s) with s = |a - d|/2 and r = sqrt(s^2 + b^2), and at most max(a, d) + b.
    """
    largest, smallest = np.maximum(a, d), np.minimum(a, d)
    half = np.maximum(lower(0.5 * lower(largest - smallest)), 0.0)
    square = np.maximum(lower(half * half + b * b, tiny=TINY), 0.0)
    denominator = lower(np.maximum(lower(np.sqrt(square)), b) + half)
    excess = upper(b * (b / denominator) * (1 + 4 * STEP), tiny=TINY)
    excess = np.where(b == 0, 0.0, np.minimum(excess, b))
    total = np.where(excess == 0, largest, upper(largest + excess))
    return np.where(np.isfinite(largest) & np.isfinite(b), total, np.inf)


def _sum_up(x: Array, axis: int | tuple[int, ...]) -> Array:
    """Upper bounds of sums of nonnegative numbers."""
    total = np.sum(x, axis=axis)
    gamma, _ = product_error(x.size // max(np.size(total), 1))
    return upper(total * (1 + gamma))


def _defect(v: Array) -> Array:
    """Upper bounds of the spectral norm of V^T V - I."""
    gram = matmul(v.swapaxes(-1, -2), v) - np.eye(v.shape[-1])
    return np.asarray(np.max(_sum_up(gram.mag, axis=-1), axis=-1))


def _quotient(n: Array, w: Array) -> Array:
    """Upper bounds of max_i (N w)_i / w_i for w > 0; N may have negative entries on its diagonal."""
    gamma, eta = product_error(n.shape[-1])
    product = np.einsum("...ij,...j->...i", n, w)
    slack = gamma * np.einsum("...ij,...j->...i", np.abs(n), w)
    quotients = upper(upper(product + upper(slack, tiny=eta)) / w, tiny=TINY)
    result: Array = np.max(quotients, axis=-1)
    return np.where(np.isnan(result), np.inf, result)


def _collatz(t: Interval) -> Array:
    """Upper bounds of lambda_max over the symmetric matrices in t, nearly diagonal ones in mind."""
    n = t.mag
    diagonal = np.arange(n.shape[-1])
    n[..., diagonal, diagonal] = t.hi[..., diagonal, diagonal]
    return perron_upper(n)


def perron_upper(n: Array) -> Array:
    """Upper bounds of lambda_max over symmetric matrices whose entries ``n`` bounds.

    Proves: lambda_max(S) <= result whenever S_ii <= n_ii and |S_ij| <= n_ij, from the quotients of the vector
    of ones and of the computed dominant eigenvector; +inf where an entry is unbounded.

    Parameters
    ----------
    n : ndarray, shape (..., n, n)
        Nonnegative off the diagonal.
    """
    bound = _quotient(n, np.ones(n.shape[:-1]))
    floor = np.max(np.diagonal(n, axis1=-2, axis2=-1), axis=-1)
    size = np.max(np.abs(n), axis=(-1, -2))
    loose = np.isfinite(bound) & (bound - floor > 1e-13 * size)
    if loose.any():
        rough = np.maximum(n[loose], n[loose].swapaxes(-1, -2))
        values, vectors = np.linalg.eigh(rough)
        vector = np.maximum(np.abs(vectors[..., -1]), 1e-8)
        better = _quotient(rough, vector)
        # one sweep of Jacobi gives the small components of the eigenvector their relative accuracy
        inner = np.diagonal(rough, axis1=-2, axis2=-1)
        rest = np.maximum(np.einsum("...ij,...j->...i", rough, vector) - inner * vector, TINY)
        sweep = rest / np.maximum(values[..., -1:] - inner, 1e-300)
        largest = np.max(vector, axis=-1, keepdims=True)
        better = np.minimum(better, _quotient(rough, np.where(vector == largest, vector, sweep)))
        bound = np.array(bound)
        bound[loose] = np.minimum(bound[loose], better)
    return bound
