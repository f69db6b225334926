"""Rigorous matrix measures and induced norms of interval matrices in the norm sqrt(x^T P x).

Nothing here rests on a floating-point square root of P. For any invertible B, J^T P + P J <= 2cP holds
exactly if B^T (J^T P + P J) B <= 2c B^T P B. So the columns of B are P-orthonormal eigenvectors as computed,
and the bound follows from enclosures of T = B^T P J B and of the defect B^T P B - I = G: with |G| <= g < 1, c
<= lambda_max(sym T)/(1 - g) where that is positive and /(1 + g) where not. For the norm, with D and B from a
singular value decomposition, T = D^T P J B and ||J||_P <= ||T|| / sqrt((1 - f)(1 - g)).

Where J is affine in parameters, J = J_c + sum_k delta_k H_k with |delta_k| <= e_k, the terms enter T as
sum_k e_k |B^T P H_k B|, which keeps entries that share a parameter correlated.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array, Mask
from certbound.rigor.definite import eigenvalue_upper, finite_part, perron_upper
from certbound.rigor.intervals import Interval, matmul
from certbound.rigor.rounding import TINY, lower, product_error, quiet, upper


class Spread(NamedTuple):
    """Symmetric linear terms: J lies in centre + sum_k [-reach_k, reach_k] slopes_k."""

    slopes: Interval  # (N, k, n, n)
    reach: Array  # (N, k)


class Metric:
    """A norm sqrt(x^T P x) and the bounds in it; P = ``matrix``, shape (n, n), the identity when omitted.

    Raises ------ ValueError If P is not square of order n, not finite, not symmetric or not positive definite.
    """

    def __init__(self, matrix: ArrayLike | None, dimension: int) -> None:
        self.dimension = dimension
        self.matrix: Array | None = None
        self.frame = np.eye(dimension)
        if matrix is None:
            return
        p = np.asarray(matrix, dtype=np.float64)
        if p.shape != (dimension, dimension) or not np.all(np.isfinite(p)):
            size = f"{dimension} x {dimension}"
            raise ValueError(f"`metric` must be a finite {size} matrix, got shape {p.shape}.")
        if not np.allclose(p, p.T, rtol=1e-12, atol=0.0):
            raise ValueError("`metric` must be symmetric; use (P + P.T) / 2.")
        p = (p + p.T) / 2
        if np.array_equal(p, np.eye(dimension)):
            return
        smallest = float(np.linalg.eigvalsh(p)[0])
        if smallest <= 0:
            raise ValueError(f"`metric` must be positive definite, got smallest eigenvalue {smallest:.3g}.")
        self.matrix = p
        self.frame = np.linalg.inv(np.linalg.cholesky(p)).T  # F with F^T P F = I up to rounding

    @property
    def condition(self) -> float:
        """Condition number of P, in floating point."""
        return 1.0 if self.matrix is None else float(np.linalg.cond(self.matrix))

    def transform(self, jacobians: Array) -> Array:
        """F^-1 J F in floating point: the Euclidean picture, for samples and proposals."""
        if self.matrix is None:
            return jacobians
        return np.asarray((self.frame.T @ self.matrix) @ jacobians @ self.frame)

    def sample_measure(self, jacobians: Array) -> Array:
        """Matrix measures mu_P(J) in floating point."""
        m = self.transform(jacobians)
        return np.asarray(np.linalg.eigvalsh((m + np.swapaxes(m, -1, -2)) / 2)[..., -1])

    def sample_norm(self, jacobians: Array) -> Array:
        """Induced norms ||J||_P in floating point."""
        return np.asarray(np.linalg.norm(self.transform(jacobians), 2, axis=(-2, -1)))

    @quiet
    def measure(self, jacobians: Interval, spread: Spread | None = None) -> Array:
        """Upper bounds of mu_P(J) over batches of Jacobians (N, n, n), with linear terms ``spread`` around them.

        Proves: J^T P + P J <= 2 c P for every J in the member of the batch; +inf where the Jacobian is unbounded.
        """
        if self.matrix is None:  # symmetrise first: it cancels skew parts exactly
            jacobians = _half_sum(jacobians)
            if spread is None:
                return eigenvalue_upper(jacobians)
        centre, finite = finite_part(jacobians)
        m = self.transform(centre.mid)
        vectors = np.linalg.eigh(_tame(m / 2 + np.swapaxes(m, -1, -2) / 2))[1]
        right = self.frame @ vectors if self.matrix is not None else vectors
        left = self._covector(right)
        t = _half_sum(matmul(matmul(left, centre), right))
        off = t.mag
        index = np.arange(self.dimension)
        off[..., index, index] = t.hi[..., index, index]
        if spread is not None:
            slopes, reach, usable = _bounded_spread(spread)
            finite = finite & usable
            terms = _half_sum(matmul(matmul(left[:, None], slopes), right[:, None])).mag
            off = upper(off + _weighted(terms, reach))
        top = perron_upper(off)
        defect = self._defect(left, right)
        bound = upper(top / np.where(top >= 0, lower(1.0 - defect), upper(1.0 + defect)), tiny=TINY)
        return np.where(finite & (defect < 0.5), bound, np.inf)

    @quiet
    def norm(self, jacobians: Interval, spread: Spread | None = None) -> Array:
        """Upper bounds of ||J||_P over batches of Jacobians.

        Proves: J^T P J <= L^2 P for every J in the member of the batch. Parameters and result as `measure`.
        """
        centre, finite = finite_part(jacobians)
        u, _, vt = np.linalg.svd(_tame(self.transform(centre.mid)))
        first, right = self.frame @ u, self.frame @ np.swapaxes(vt, -1, -2)
        left, right_covector = self._covector(first), self._covector(right)
        entries = matmul(matmul(left, centre), right).mag
        if spread is not None:
            slopes, reach, usable = _bounded_spread(spread)
            finite = finite & usable
            terms = matmul(matmul(left[:, None], slopes), right[:, None]).mag
            entries = upper(entries + _weighted(terms, reach))
        held = np.asarray(np.isfinite(entries).all(axis=(-1, -2)))  # the product may overflow
        finite, entries = finite & held, np.where(held[..., None, None], entries, 0.0)
        gram = matmul(np.swapaxes(entries, -1, -2), entries).hi
        square = np.maximum(perron_upper(np.maximum(gram, np.swapaxes(gram, -1, -2))), 0.0)
        f, g = self._defect(left, first), self._defect(right_covector, right)
        shrink = lower(lower(1.0 - f) * lower(1.0 - g))
        bound = upper(np.sqrt(upper(square / np.maximum(shrink, 0.25), tiny=TINY)), tiny=TINY)
        return np.where(finite & (shrink > 0.25), bound, np.inf)

    def defect(self) -> float:
        """Upper bound of |F^T P F - I| in the spectral norm."""
        return 0.0 if self.matrix is None else float(self._defect(self._covector(self.frame), self.frame))

    def _covector(self, vectors: Array) -> Interval:
        """B^T P."""
        transposed = np.swapaxes(vectors, -1, -2)
        return Interval.point(transposed) if self.matrix is None else matmul(transposed, self.matrix)

    def _defect(self, covector: Interval, vectors: Array) -> Array:
        """Upper bounds of |B^T P B - I| in the spectral norm."""
        gram = (matmul(covector, vectors) - np.eye(self.dimension)).mag
        gamma, _ = product_error(self.dimension)
        return np.asarray(np.max(upper(np.sum(gram, axis=-1) * (1 + gamma)), axis=-1))


def _half_sum(x: Interval) -> Interval:
    """Symmetric part, entry by entry."""
    total = x + x.T
    large = 4 * TINY  # from there on halving is exact
    lo = np.where(np.abs(total.lo) >= large, 0.5 * total.lo, np.minimum(total.lo, 0.0))
    hi = np.where(np.abs(total.hi) >= large, 0.5 * total.hi, np.maximum(total.hi, 0.0))
    index = np.arange(x.shape[-1])
    lo[..., index, index], hi[..., index, index] = x.lo[..., index, index], x.hi[..., index, index]
    return Interval._raw(lo, hi)


def _tame(matrices: Array) -> Array:
    """Matrices that LAPACK's iterations survive, with the same vectors: entries of size 1; 0 where not finite.

    What the vectors are used for is proved for any vectors.
    """
    size = np.max(np.abs(matrices), axis=(-2, -1), keepdims=True)
    wild = ~((size > 1e-100) & (size < 1e100))
    if not wild.any():
        return matrices
    usable = np.isfinite(size) & (size > 0)
    with np.errstate(all="ignore"):
        scaled = matrices / np.where(usable, size, 1.0)
    return np.where(wild, np.where(usable & np.isfinite(scaled), scaled, 0.0), matrices)


def _bounded_spread(spread: Spread) -> tuple[Interval, Array, Mask]:
    slopes, finite = finite_part(spread.slopes)
    usable = np.isfinite(spread.reach)
    return slopes, np.where(usable, spread.reach, 0.0), np.asarray((finite & usable).all(axis=-1))


def _weighted(terms: Array, reach: Array) -> Array:
    """Upper bounds of sum_k reach_k terms_k."""
    gamma, eta = product_error(terms.shape[-3])
    return upper(np.einsum("nkij,nk->nij", terms, reach) * (1 + gamma), tiny=eta)
