"""Metrics of a sector set from Riccati equations: a second for two hundred states, where no semidefinite program goes.

With the multipliers Lambda given (diagonal, k numbers), the metrics in which the sector set reaches a value v lie
between two solutions of bounded-real Riccati equations. The smallest solves

    v P = A'PA + C'Lam C + A'PB (Lam - B'PB)^-1 B'PA                      (discrete time, v = L^2)
    0 = (A - c I)'P + P (A - c I) + C'Lam C + P B Lam^-1 B'P              (continuous time, v = c)

and the largest is the inverse of the smallest solution of the dual, with A', C', B' and Lam^-1 for A, B, C and Lam.
Every mean of the two serves as well, for the inequality is convex in (P, Lambda). The equations are solved by doubling:
twenty products of n x n matrices. All of them are proposals: ``recheck`` proves.

Source: Zhou, Doyle, Glover, Robust and Optimal Control (1996), Ch. 13; Chu, Fan, Lin, A structure-preserving doubling
algorithm for continuous-time algebraic Riccati equations, Linear Algebra Appl. 396 (2005).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.constants.programs.sectors import Sector

_DOUBLINGS = 60
_SETTLED = 1e-12
_HALVINGS = 14
SLIGHT = 1e-9
"""The least residual: it keeps solutions off the border of the inequality, in units of what enters the equation."""
_RESIDUALS = 10.0 ** np.arange(0.0, -9.0, -1.0)
"""Larger ones, tried at last: what the slopes do not see should weigh something too."""
SHARE = 1e-3
"""Weight of the largest metric in a mean: the smallest is the better conditioned, and lies on the border."""


@dataclass(frozen=True, eq=False)
class Pencil:
    """The smallest and the largest metric of a sector set at one value, with the multipliers of both."""

    smallest: Array  # (n, n)
    largest: Array  # (n, n)
    multipliers: Array  # (k,)
    value: float

    def mean(self, share: float = SHARE) -> Array:
        """A metric in between, exactly symmetric."""
        P = (1 - share) * self.smallest + share * self.largest
        return np.asarray((P + P.T) / 2)


def pencil(
    block: Sector, multipliers: Array, value: float, *, continuous: bool, residual: float = SLIGHT
) -> Pencil | None:
    """The two extreme metrics at a value, c or L^2; None where there is none (or none was found)."""
    A, B, C = block.A, block.B, block.C
    smallest = _solution(A.T, C.T, B.T, multipliers, value, residual, continuous=continuous)
    if smallest is None:
        return None
    inverse = _solution(A, B, C, 1 / multipliers, value, residual, continuous=continuous)
    if inverse is None:
        return None
    largest = np.linalg.inv(inverse) / (1.0 if continuous else value)
    return Pencil(smallest, (largest + largest.T) / 2, multipliers, value)


def least_value(
    block: Sector, multipliers: Array, *, continuous: bool, lower: float, tolerance: float
) -> Pencil | None:
    """The metrics at the least value, up to ``tolerance``, that given multipliers allow; ``lower`` bounds it below.

    None where no value up to 1e4 times the size of the Jacobian allows any.
    """
    size = max(float(np.linalg.norm(block.A, 2)) ** (1 if continuous else 2), 1e-300)

    def tried(value: float) -> Pencil | None:
        return pencil(block, multipliers, value, continuous=continuous)

    low, step = lower, tolerance
    high, found = lower + step, tried(lower + step)
    while found is None:
        if step > 1e4 * size:
            return None
        step *= 4
        low, high = high, lower + step
        found = tried(high)
    for _ in range(_HALVINGS):
        if high - low <= tolerance:
            break
        middle = (low + high) / 2
        better = tried(middle)
        low, high, found = (middle, high, found) if better is None else (low, middle, better)
    for residual in _RESIDUALS:
        better = pencil(block, multipliers, high + tolerance, continuous=continuous, residual=float(residual))
        if better is not None:
            return better
    return found


def _solution(
    A: Array, B: Array, C: Array, weights: Array, value: float, residual: float, *, continuous: bool
) -> Array | None:
    """The smallest X with v X = A X A' + B W B' + A X C' (W - C X C')^-1 C X A' (or its like in continuous time)."""
    n = len(A)
    known = (B * weights) @ B.T
    known = known + residual * (float(np.trace(known)) / n or 1.0) * np.eye(n)
    quadratic = -(C.T / weights) @ C
    with np.errstate(all="ignore"):
        try:
            if continuous:
                start = _cayley((A - value * np.eye(n)).T, quadratic, known)
                X = _doubled(*start)
            else:
                X = None if value <= 0 else _doubled(A.T / np.sqrt(value), quadratic, known / value)
        except np.linalg.LinAlgError:
            return None
    if X is None:
        return None
    if float(np.linalg.eigvalsh(X)[0]) <= 0:
        return None
    inner = C @ X @ C.T / np.sqrt(np.outer(weights, weights))
    if not continuous and len(inner) and float(np.linalg.eigvalsh(inner)[-1]) >= 1:
        return None
    return X


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
        if not np.isfinite(H).all() or not np.isfinite(G).all():
            return None
        if float(np.linalg.norm(added)) <= _SETTLED * float(np.linalg.norm(H)):
            return H
    return None


def _cayley(A: Array, G: Array, H: Array) -> tuple[Array, Array, Array]:
    """The first matrices of the doubling for A' X + X A - X G X + H = 0."""
    shift = 0.55 * float(np.linalg.norm(A, 2)) + 1e-300
    identity = np.eye(len(A))
    moved = A - shift * identity
    inverse = np.linalg.inv(moved)
    W = np.linalg.inv(moved.T + H @ inverse @ G)
    return identity + 2 * shift * W.T, 2 * shift * inverse @ G @ W, 2 * shift * W @ H @ inverse
