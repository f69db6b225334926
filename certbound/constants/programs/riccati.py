"""Metrics of a sector set from Riccati equations: a second for two hundred states, where no semidefinite program goes.

With the multipliers and a residual given, the inequality of the sector form (Sec. 6 of docs/theory.md) becomes an
equation for X = P^-1, the bounded-real Riccati equation of the scaled plant in its dual form:

    v X = A X A' + B M B' + R + A X C' (M - C X C')^-1 C X A'              (discrete time, v = L^2)
    0 = (A - c I) X + X (A - c I)' + B M B' + R + X C' M^-1 C X            (continuous time)

with M the inverse multipliers (diagonal, k numbers) and R >= 0. Any solution X > 0 with M > C X C' (discrete time)
proposes P = X^-1, with c or L^2 at most the value. The equation is solved by doubling: twenty products of n x n
matrices. Its derivatives follow from one linear equation of the same size, so that M and R can be searched by any
smooth objective. Everything is a proposal: ``recheck`` proves.

Source: Zhou, Doyle, Glover, Robust and Optimal Control (1996), Ch. 13; Chu, Fan, Lin, A structure-preserving doubling
algorithm for continuous-time algebraic Riccati equations, Linear Algebra Appl. 396 (2005).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from certbound.arrays import Array
from certbound.constants.programs.sectors import Sector

_DOUBLINGS = 60
_SETTLED = 1e-12
_STEPS = 14
"""Halvings of the distance to the least value that a bisection takes."""


class Slopes(NamedTuple):
    """Derivatives of a function of X with respect to the value, the inverse multipliers and the residual R."""

    value: float
    weights: Array  # (k,)
    residual: Array  # (n, n)


@dataclass(frozen=True, eq=False)
class SectorRiccati:
    """The Riccati equation of one centred sector set."""

    block: Sector
    continuous: bool

    @property
    def dimension(self) -> int:
        """State dimension n."""
        return len(self.block.A)

    def solve(self, value: float, weights: Array, residual: Array) -> Array | None:
        """X, shape (n, n), for inverse multipliers (k,) and a residual (n, n); None where there is none."""
        A, B, C = self.block.A, self.block.B, self.block.C
        known = (B * weights) @ B.T + residual
        quadratic = -(C.T / weights) @ C
        with np.errstate(all="ignore"):
            try:
                if self.continuous:
                    start = _cayley((A - value * np.eye(len(A))).T, quadratic, known)
                    X = None if start is None else _doubled(*start)
                elif value > 0:
                    X = _doubled(A.T / np.sqrt(value), quadratic, known / value)
                else:
                    X = None
            except np.linalg.LinAlgError:
                return None
        return X if X is not None and self._serves(X, value, weights) else None

    def slopes(self, X: Array, value: float, weights: Array, gradient: Array) -> Slopes | None:
        """Derivatives of f(X) with df = tr(gradient dX); None where the linear equation has no solution."""
        B, C = self.block.B, self.block.C
        try:
            closed, reach = self._closed(X, value, weights)
            Z = _adjoint(closed, gradient, value, continuous=self.continuous)
        except (np.linalg.LinAlgError, ValueError):
            return None
        if not np.isfinite(Z).all():
            return None
        share = np.einsum("ik,ij,jk->k", B, Z, B, optimize=True)
        share -= np.einsum("ik,ij,jk->k", reach, Z, reach, optimize=True) / weights**2
        scale = 2.0 if self.continuous else 1.0
        return Slopes(-scale * float(np.sum(Z * X)), share, Z)

    def _closed(self, X: Array, value: float, weights: Array) -> tuple[Array, Array]:
        """The matrix that small changes of X go through, and the columns by which changes of M enter."""
        A, C = self.block.A, self.block.C
        if self.continuous:
            reach = X @ C.T
            return A - value * np.eye(len(A)) + (reach / weights) @ C, reach
        gain = np.linalg.solve(np.diag(weights) - C @ X @ C.T, C @ X @ A.T).T
        closed = A + gain @ C
        return closed, closed @ X @ C.T

    def _serves(self, X: Array, value: float, weights: Array) -> bool:
        """Whether X > 0 solves the equation, with M > C X C' in discrete time."""
        if not np.isfinite(X).all():
            return False
        values = np.linalg.eigvalsh(X)
        if values[0] <= 1e-14 * values[-1]:
            return False
        if self.continuous:
            return True
        inner = self.block.C @ X @ self.block.C.T / np.sqrt(np.outer(weights, weights))
        return not len(inner) or float(np.linalg.eigvalsh(inner)[-1]) < 1


def spectral_values(block: Sector, *, continuous: bool) -> float:
    """The largest spectral abscissa (or squared radius) at the middle and at the two ends of all slopes."""
    matrices = np.array([block.A + s * block.B @ block.C for s in (-1.0, 0.0, 1.0)])
    eigenvalues = np.linalg.eigvals(matrices)
    return float(eigenvalues.real.max() if continuous else (np.abs(eigenvalues) ** 2).max())


def least_value(
    equation: SectorRiccati, weights: Array, *, lower: float, tolerance: float
) -> tuple[Array, float] | None:
    """X and the least value, up to ``tolerance``, at which the equation with given multipliers has a solution.

    ``lower`` is a lower bound of the value. The residual is as large as a tenth of the room above the least value
    allows, so that X is no worse conditioned than need be. None where no value up to 1e4 times the size of the
    Jacobian has a solution.
    """
    size = float(np.linalg.norm(equation.block.A, 2)) ** (1 if equation.continuous else 2)
    n = equation.dimension
    unit = np.eye(n) * float(np.trace((equation.block.B * weights) @ equation.block.B.T) or 1.0) / n
    slight = 1e-9 * unit
    high, step = lower + tolerance, tolerance
    low = lower
    found = equation.solve(high, weights, slight)
    while found is None:
        if step > 1e4 * max(size, 1e-300):
            return None
        step *= 4
        low, high = high, lower + step
        found = equation.solve(high, weights, slight)
    for _ in range(_STEPS):
        if high - low <= tolerance:
            break
        middle = (low + high) / 2
        X = equation.solve(middle, weights, slight)
        if X is None:
            low = middle
        else:
            high, found = middle, X
    value = high + tolerance
    for exponent in np.arange(0.0, -9.0, -1.0):
        X = equation.solve(value, weights, 10**exponent * unit)
        if X is not None:
            return X, value
    return found, high


def inverted(X: Array) -> Array:
    """P = X^-1, exactly symmetric."""
    P = np.linalg.inv((X + X.T) / 2)
    return np.asarray((P + P.T) / 2)


def _doubled(A: Array, G: Array, H: Array) -> Array | None:
    """The solution X of X = A' X (I + G X)^-1 A + H by doubling; None where it does not settle."""
    n = len(A)
    identity = np.eye(n)
    for _ in range(_DOUBLINGS):
        both = np.linalg.solve(identity + G @ H, np.concatenate([A, G @ A.T], axis=1))
        added = A.T @ H @ both[:, :n]
        spread = A @ both[:, n:]
        H = H + (added + added.T) / 2
        G = G + (spread + spread.T) / 2
        A = A @ both[:, :n]
        size = float(np.linalg.norm(H))
        if not np.isfinite(size):
            return None
        if float(np.linalg.norm(added)) <= _SETTLED * size:
            return H
    return None


def _cayley(A: Array, G: Array, H: Array) -> tuple[Array, Array, Array] | None:
    """The first matrices of the doubling for A' X + X A - X G X + H = 0."""
    shift = 1.1 * float(np.linalg.norm(A, 2)) / 2 + 1e-300
    identity = np.eye(len(A))
    moved = A - shift * identity
    inverse = np.linalg.inv(moved)
    W = np.linalg.inv(moved.T + H @ inverse @ G)
    return identity + 2 * shift * W.T, 2 * shift * inverse @ G @ W, 2 * shift * W @ H @ inverse


def _adjoint(closed: Array, gradient: Array, value: float, *, continuous: bool) -> Array:
    """Z with v Z = F' Z F + gradient (discrete time), F' Z + Z F + gradient = 0 (continuous time)."""
    from scipy.linalg import solve_continuous_lyapunov

    if continuous:
        Z = solve_continuous_lyapunov(closed.T, -gradient)
        return np.asarray((Z + Z.T) / 2)
    power, Z = closed / np.sqrt(value), gradient / value
    for _ in range(_DOUBLINGS):
        added = power.T @ Z @ power
        Z = Z + added
        power = power @ power
        if not float(np.linalg.norm(added)) > _SETTLED * float(np.linalg.norm(Z)):
            break
    return np.asarray((Z + Z.T) / 2)
