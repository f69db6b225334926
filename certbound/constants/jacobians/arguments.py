"""Matrix helpers of this room: checks of arguments, metric coordinates, low-rank factors."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array, Index

UNIT = float(np.finfo(float).eps)


def metric_roots(metric: ArrayLike) -> tuple[Array, Array]:
    """P^{1/2} and P^{-1/2} in floating point (for proposals and coordinates, not for proofs)."""
    matrix = square_matrix("metric", metric)
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    if values[0] <= 0:
        raise ValueError(f"`metric` must be positive definite, its smallest eigenvalue is {values[0]:.3g}.")
    return (vectors * np.sqrt(values)) @ vectors.T, (vectors / np.sqrt(values)) @ vectors.T


def factor(term: Array) -> tuple[Array, Array, Array]:
    """Factors with term = columns @ rows up to the entrywise bound returned third (zero where exact)."""
    rows = np.flatnonzero(term.any(axis=1))
    columns = np.flatnonzero(term.any(axis=0))
    n = len(term)
    u, s, vt = _compact_svd(term, rows, columns)
    rank = int(np.count_nonzero(s > s[0] * n * 4 * UNIT)) if len(s) and s[0] > 0 else 0
    if min(len(rows), len(columns)) <= rank:  # exact: unit vectors on one side
        if len(columns) <= len(rows):
            return term[:, columns], np.eye(n)[columns], np.zeros((n, n))
        return np.eye(n)[:, rows], term[rows], np.zeros((n, n))
    left, right = u[:, :rank] * np.sqrt(s[:rank]), np.sqrt(s[:rank])[:, None] * vt[:rank]
    size = np.abs(left) @ np.abs(right) + np.abs(term)
    return left, right, (np.abs(term - left @ right) + (2 * n + 4) * UNIT * size) * (1 + 8 * UNIT)


def _compact_svd(term: Array, rows: Index, columns: Index) -> tuple[Array, Array, Array]:
    """Singular vectors of a matrix from those of its rows and columns that are not zero."""
    u, s, vt = np.linalg.svd(term[np.ix_(rows, columns)], full_matrices=False)
    left, right = np.zeros((len(term), len(s))), np.zeros((len(s), len(term)))
    left[rows], right[:, columns] = u, vt
    return left, s, right


def is_near(
    columns: Array,
    target: Array,
    tolerance: float | Array,
    bounds: tuple[float, float | None] | list[tuple[float, float]],
    normalised: Array | None = None,
) -> bool:
    """Whether some x in the bounds (summing to 1 if asked) has |columns x - target| <= tolerance."""
    if columns.shape[1] == 0:
        return bool(np.all(np.abs(target) <= tolerance))
    from scipy.optimize import linprog

    upper = np.concatenate([target + tolerance, tolerance - target])
    result = linprog(
        np.zeros(columns.shape[1]),
        A_ub=np.concatenate([columns, -columns]),
        b_ub=upper,
        A_eq=normalised,
        b_eq=None if normalised is None else np.ones(1),
        bounds=bounds,
        method="highs",
        options={"primal_feasibility_tolerance": 1e-10},
    )
    return bool(result.status == 0)


def finite_array(name: str, value: ArrayLike) -> Array:
    try:
        array = np.array(value, dtype=float)
    except ValueError as error:
        raise ValueError(f"`{name}` must be a rectangular array of numbers: {error}.") from error
    if not np.all(np.isfinite(array)):
        raise ValueError(f"`{name}` must be finite; bound the domain, or use a metric along the tube.")
    return array


def square_matrix(name: str, value: ArrayLike) -> Array:
    array = finite_array(name, value)
    if array.ndim != 2 or array.shape[0] != array.shape[1] or array.shape[0] == 0:
        raise ValueError(f"`{name}` must be a square matrix, got shape {array.shape}.")
    return array


def parameter_range(low: ArrayLike, high: ArrayLike) -> Array:
    lower, upper = np.atleast_1d(finite_array("low", low)), np.atleast_1d(finite_array("high", high))
    if lower.shape != upper.shape or lower.ndim != 1:
        raise ValueError(f"`low` and `high` must be vectors of one length, got shapes {lower.shape}, {upper.shape}.")
    if np.any(lower > upper):
        raise ValueError("`low` must not exceed `high`.")
    return np.stack([lower, upper])


def matrix_batch(matrices: ArrayLike, dimension: int) -> Array:
    batch = np.asarray(matrices, dtype=float)
    if batch.ndim < 2 or batch.shape[-2:] != (dimension, dimension):
        raise ValueError(f"matrices must have shape (..., {dimension}, {dimension}), got {batch.shape}.")
    return batch
