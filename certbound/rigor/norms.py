"""The norm ||x||_P = sqrt(x^T P x) and its dual sqrt(a^T P^-1 a), bounded from the safe side.

The dual norm is the support function of the unit ball {||y||_P <= 1}. It is evaluated with a float matrix T
for which T T^T >= P^-1 has been proved, so that no inverse has to be trusted.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.errors import SolverError
from certbound.rigor import intervals as iv
from certbound.rigor.definite import eigenvalue_lower, eigenvalue_upper
from certbound.rigor.intervals import Interval

CORNERS = 10
"""Boxes with at most so many wide sides are bounded through their corners."""


def ball_root(matrix: Array) -> Array:
    """A float matrix T with P^-1 <= T T^T, close to equality: {||y||_P <= 1} lies in T times the unit ball.

    Proved through T^T P T >= I, whose congruence with T^-1 is P >= (T T^T)^-1, after powers of two (which are exact)
    have brought the diagonal of P near 1: states in small units must not hide behind those in large ones.

    Raises
    ------
    SolverError
        If ``matrix`` is too ill-conditioned for double precision.
    """
    given = np.asarray(matrix, dtype=float)
    units = np.exp2(-np.round(0.5 * np.log2(np.maximum(np.diag(given), 1e-300))))
    matrix = units[:, None] * given * units
    values, vectors = np.linalg.eigh(matrix)
    if values[0] > 0 and np.array_equal(matrix / units[:, None] / units, given):
        guess = vectors / np.sqrt(values)
        for slack in 10.0 ** np.arange(-14, -1):
            root: Array = guess * (1 + slack)
            point = Interval.point(root)
            proved = float(eigenvalue_lower(point.T @ Interval.point(matrix) @ point)) >= 1.0
            if proved and np.array_equal(units[:, None] * root / units[:, None], root):
                return np.asarray(units[:, None] * root)
    raise SolverError("`metric` could not be inverted with a proof; its condition number is too large.")


@dataclass(frozen=True, eq=False)
class Norm:
    """The weighted Euclidean norm of a metric P (the identity when None).

    Examples
    --------
    >>> norm = Norm(2, [[4.0, 0.0], [0.0, 1.0]])
    >>> bool(abs(float(norm.dual(np.array([1.0, 0.0]))) - 0.5) < 1e-9)
    True
    """

    dimension: int
    metric: ArrayLike | None = None  # (n, n)
    matrix: Array | None = field(init=False, repr=False)
    root: Array | None = field(init=False, repr=False)

    def __post_init__(self) -> None:
        matrix = None if self.metric is None else np.asarray(self.metric, dtype=float)
        object.__setattr__(self, "matrix", matrix)
        object.__setattr__(self, "root", None if matrix is None else ball_root(matrix))

    @property
    def shape(self) -> Array:
        """P^-1 in floating point: for choosing directions, not for proofs."""
        return np.eye(self.dimension) if self.root is None else self.root @ self.root.T

    def length(self, vectors: Interval) -> Array:
        """Upper bounds of ||v||_P over boxes of vectors, shape (..., n) -> (...).

        ||v|| <= ||mid|| + sqrt(rad^T |P| rad).
        """
        if self.matrix is None:
            return _root((iv.sq(vectors)).sum(axis=-1))
        if not np.all(np.isfinite(vectors.mag)):
            finite = np.isfinite(vectors.mag)
            ends = (np.where(finite, end, 0.0) for end in (vectors.lo, vectors.hi))
            return np.where(np.all(finite, axis=-1), self.length(Interval(*ends)), np.inf)
        mid, rad = Interval.point(vectors.mid), Interval.point(vectors.rad)
        centre = _root(_quadratic(mid, Interval.point(self.matrix)))
        if not np.any(vectors.rad):
            return centre
        spread = _root(_quadratic(rad, Interval.point(np.abs(self.matrix))))
        return (Interval.point(centre) + Interval.point(spread)).hi

    def dual(self, directions: ArrayLike | Interval) -> Array:
        """Upper bounds of sqrt(a^T P^-1 a), the unit ball's reach along a: shape (..., n) -> (...)."""
        vectors = directions if isinstance(directions, Interval) else Interval.point(directions)
        if self.root is not None:
            row = vectors.reshape(*vectors.shape[:-1], 1, vectors.shape[-1])
            vectors = (row @ Interval.point(self.root))[..., 0, :]
        return _root(iv.sq(vectors).sum(axis=-1))

    def section(self, rows: ArrayLike) -> float:
        """Upper bound of sup {||C y||_2 : ||y||_P <= 1} for C = ``rows``, shape (q, n)."""
        image = Interval.point(rows) @ (np.eye(self.dimension) if self.root is None else self.root)
        return float(_root(Interval.point(np.maximum(eigenvalue_upper(image @ image.T), 0.0))))


def largest_over_box(norm: Norm, box: Interval) -> Array:
    """Upper bounds of ||v||_P over boxes (..., n), through the corners where a box has few wide sides."""
    bound = norm.length(box)
    if norm.matrix is None:
        return bound
    wide = np.flatnonzero(np.any(box.width > 0, axis=tuple(range(box.ndim - 1))))
    if not 0 < len(wide) <= CORNERS:
        return bound
    best = np.zeros(box.shape[:-1])
    for choice in itertools.product((False, True), repeat=len(wide)):
        ends = box.lo.copy()
        for coordinate, high in zip(wide, choice):
            ends[..., coordinate] = (box.hi if high else box.lo)[..., coordinate]
        best = np.maximum(best, norm.length(Interval.point(ends)))
    return np.asarray(np.minimum(bound, best))


def _quadratic(vectors: Interval, matrix: Interval) -> Interval:
    row = vectors.reshape(*vectors.shape[:-1], 1, vectors.shape[-1])
    return (row @ matrix @ row.swapaxes(-1, -2))[..., 0, 0]


def _root(value: Interval) -> Array:
    return np.asarray(iv.sqrt(Interval(np.maximum(value.lo, 0.0), np.maximum(value.hi, 0.0))).hi)
