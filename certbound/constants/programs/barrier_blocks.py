"""Matrix inequalities F > 0 in P and multipliers, with the derivatives of -log det F; symbols of ``centers``."""

from __future__ import annotations

import numpy as np

from certbound.arrays import Array
from certbound.constants.programs.sectors import Sector


class Block:
    """One inequality F > 0 and the derivatives of -log det F."""

    def __init__(self, block: Array | Sector, *, continuous: bool) -> None:
        sector = block if isinstance(block, Sector) else None
        A = np.asarray(block.A if isinstance(block, Sector) else block, dtype=float)
        n, k = len(A), 0 if sector is None else sector.B.shape[1]
        self.continuous, self.n, self.k = continuous, n, k
        self.E = np.eye(n, n + k)
        self.H = A if sector is None else np.concatenate([A, sector.B], axis=1)
        self.Chat = np.zeros((k, n + k))
        if sector is not None:
            self.Chat[:, :n] = sector.C
        self.Qhat = np.eye(n + k)[n:]

    def terms(self, value: float) -> list[tuple[float, Array, Array]]:
        """(coefficient, X, Y) with the part of F that is linear in P equal to sum coefficient X' P Y."""
        if self.continuous:
            return [(2 * value, self.E, self.E), (-1.0, self.E, self.H), (-1.0, self.H, self.E)]
        return [(value, self.E, self.E), (-1.0, self.H, self.H)]

    def matrix(self, value: float, P: Array, multipliers: Array) -> Array:
        F = np.zeros(2 * self.H.shape[1:])
        for c, X, Y in self.terms(value):
            F += c * X.T @ P @ Y
        F += (self.Qhat.T * multipliers) @ self.Qhat - (self.Chat.T * multipliers) @ self.Chat
        return np.asarray((F + F.T) / 2)

    def add_barrier(
        self, value: float, W: Array, pairs: Pairs | None, here: slice, gradient: Array, hessian: Array
    ) -> None:
        """Add the derivatives of -log det F, where W = F^-1, with respect to P (first, unless ``pairs`` is None) and
        to the multipliers, whose places are ``here``; of the Hessian the upper triangle.
        """
        WC, WQ = W @ self.Chat.T, W @ self.Qhat.T
        cc, cq, qq = self.Chat @ WC, self.Chat @ WQ, self.Qhat @ WQ
        gradient[here] -= np.diag(qq) - np.diag(cc)
        hessian[here, here] += cc**2 - cq**2 - cq.T**2 + qq**2
        if pairs is None:
            return
        size, terms = pairs.size, self.terms(value)
        for a, (c, X, Y) in enumerate(terms):
            gradient[:size] -= c * pairs.gradient(Y @ W @ X.T)
            for b in range(a + 1):
                d, U, V = terms[b]
                part = pairs.hessian(V @ W @ X.T, Y @ W @ U.T)
                part *= c * d
                hessian[:size, :size] += part if a == b else part + part.T
            for sign, factor in ((1.0, WQ), (-1.0, WC)):
                left, right = X @ factor, Y @ factor
                cross = left[pairs.i] * right[pairs.j] + left[pairs.j] * right[pairs.i]
                hessian[:size, here] += sign * c * pairs.scale[:, None] * cross

    def smallest_value(self, P: Array, multipliers: Array) -> float:
        """The infimum of the values with F >= 0 at the given P and multipliers (inf when there is none)."""
        from scipy.linalg import cho_factor, cho_solve, eigh

        F = self.matrix(0.0, P, multipliers)
        n, corner = self.n, F[self.n :, self.n :]
        schur = F[:n, :n]
        if self.k:
            try:
                factor = cho_factor(corner)
            except np.linalg.LinAlgError:
                return float(np.inf)
            schur = schur - F[:n, n:] @ cho_solve(factor, F[n:, :n])
        top = float(eigh(-schur, P, eigvals_only=True, subset_by_index=[n - 1, n - 1])[0])
        return top / 2 if self.continuous else top


class Pairs:
    """Symmetric matrices by their upper triangle: gradients and the Hessian of tr(K dP L dP)."""

    def __init__(self, n: int) -> None:
        self.i, self.j = np.triu_indices(n)
        self.scale = np.where(self.i == self.j, 0.5, 1.0)
        self.n, self.size = n, len(self.i)

    def gradient(self, D: Array) -> Array:
        """Derivative of tr(D P) with respect to the entries of the upper triangle."""
        return np.asarray((D + D.T)[self.i, self.j] * self.scale)

    def matrix(self, entries: Array) -> Array:
        P = np.zeros((self.n, self.n))
        P[self.i, self.j] = entries
        P[self.j, self.i] = entries
        return P

    def hessian(self, K: Array, L: Array) -> Array:
        """Second derivative tr(K S_p L S_q) over basis pairs, symmetric part."""
        M = K.T
        # row pairs (a, a..n-1) at a time: whole rows of gathered columns, which stay in the cache
        MI, MJ, LI, LJ = (matrix[:, place] for matrix in (M, L) for place in (self.i, self.j))
        total = np.empty((self.size, self.size))
        start = 0
        for a in range(self.n):
            rows = total[start : start + self.n - a]
            np.multiply(LI[a:], MJ[a], out=rows)
            rows += LJ[a:] * MI[a]
            rows += MJ[a:] * LI[a]
            rows += MI[a:] * LJ[a]
            rows *= self.scale
            rows[0] *= 0.5
            start += self.n - a
        return total
