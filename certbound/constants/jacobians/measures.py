"""Matrix measures and induced norms for the norms 1, 2 and infinity, weighted or not.

With ||x|| = ||D x||_p, D = diag(weights) (p = 1, inf), or ||x|| = sqrt(x^T P x) (p = 2): mu(A) is the one-sided
derivative of ||I + h A|| at h = 0, and ||A|| the induced norm. Closed forms, in floating point; `diagonal_weights`
finds D by linear programming. Source: Sec. 1 of docs/theory.md; Desoer and Vidyasagar, Feedback Systems (1975), Ch. 2.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.constants.jacobians.arguments import finite_array, metric_roots
from certbound.constants.jacobians.jacobian_sets import JacobianSet, as_set

Order = Literal[1, 2] | float


def matrix_measure(matrix: ArrayLike, order: Order = 2, *, weights: ArrayLike | None = None) -> Any:
    """Matrix measure mu(A) = lim_{h -> 0+} (||I + h A|| - 1) / h.

    Parameters
    ----------
    matrix : array_like, shape (..., n, n)
    order : 1, 2 or inf
    weights : array_like, optional
        Positive diagonal (n,) for the orders 1 and inf; positive definite P (n, n) for the order 2.

    Returns
    -------
    float or ndarray, shape (...)

    Raises
    ------
    ValueError
        For another order, or a matrix or weights of the wrong shape or sign.

    Examples
    --------
    >>> matrix_measure([[-2.0, 1.0], [0.0, -3.0]], np.inf)
    -1.0
    >>> matrix_measure([[-2.0, 1.0], [0.0, -3.0]], 1)
    -2.0
    """
    A = _weighted(matrix, order, weights)
    if order == 2:
        return _plain(np.linalg.eigvalsh((A + A.swapaxes(-1, -2)) / 2)[..., -1])
    diagonal = np.diagonal(A, axis1=-2, axis2=-1)
    rest = np.abs(A).sum(axis=-1 if order == np.inf else -2) - np.abs(diagonal)
    return _plain(np.max(diagonal + rest, axis=-1))


def induced_norm(matrix: ArrayLike, order: Order = 2, *, weights: ArrayLike | None = None) -> Any:
    """Induced norm ||A|| = max ||A x|| / ||x||; parameters as for `matrix_measure`.

    Examples
    --------
    >>> induced_norm([[0.5, 0.25], [0.0, 0.5]], np.inf)
    0.75
    >>> round(induced_norm([[0.0, 4.0], [1.0, 0.0]], 2, weights=[[1.0, 0.0], [0.0, 4.0]]), 12)
    2.0
    """
    A = _weighted(matrix, order, weights)
    if order == 2:
        return _plain(np.linalg.norm(A, ord=2, axis=(-2, -1)))
    return _plain(np.max(np.abs(A).sum(axis=-1 if order == np.inf else -2), axis=-1))


def diagonal_weights(
    jacobians: JacobianSet | ArrayLike,
    order: Order = np.inf,
    *,
    continuous: bool,
    max_ratio: float = 1e6,
    tolerance: float = 1e-9,
) -> tuple[Array, float]:
    """Weights of the 1- or inf-norm with the smallest mu (continuous time) or norm over a set of Jacobians.

    For a fixed value v and the order inf, J_ii e_i + sum_j |J_ij| e_j <= v e_i for all i and all vertices J is a
    linear program in e = 1/weights (without moduli on the diagonal in continuous time only); v is bisected.

    Parameters
    ----------
    jacobians : JacobianSet or array_like
    order : 1 or inf
    continuous : bool
    max_ratio : float
        Bound on the largest over the smallest weight.
    tolerance : float
        Of the bisection, relative to the size of the Jacobians.

    Returns
    -------
    weights : ndarray, shape (n,)
        Smallest entry 1.
    value : float
        mu or norm in them, evaluated from the weights.

    Raises
    ------
    ValueError
        For another order or a ratio below 1.

    Examples
    --------
    >>> weights, value = diagonal_weights([[-1.0, 4.0], [0.0, -1.0]], continuous=True)
    >>> value < -0.99
    True
    """
    if order not in (1, np.inf):
        raise ValueError(f"`order` must be 1 or inf, got {order}; for 2 use `propose_metrics`.")
    if not max_ratio >= 1:
        raise ValueError(f"`max_ratio` must be at least 1, got {max_ratio}.")
    matrices = as_set(jacobians).vertices()
    measure = matrix_measure if continuous else induced_norm
    rows = matrices if order == np.inf else matrices.swapaxes(-1, -2)
    majorants = np.abs(rows)
    if continuous:
        index = np.arange(rows.shape[-1])
        majorants[:, index, index] = rows[:, index, index]
    weights = np.ones(rows.shape[-1])
    high = float(np.max(measure(matrices, order)))
    low = float(np.max(np.linalg.eigvals(majorants).real))  # Perron: no weights do better
    size = max(1.0, float(np.abs(rows).max()))
    while high - low > tolerance * size:
        middle = (low + high) / 2
        inverse = _feasible(majorants, middle, max_ratio)
        if inverse is None:
            low = middle
            continue
        found = 1 / inverse if order == np.inf else inverse
        found = found / found.min()
        reached = float(np.max(measure(matrices, order, weights=found)))
        if reached >= high:
            break  # below the accuracy of the linear program
        weights, high = found, reached
    return weights, high


def _feasible(majorants: Array, value: float, max_ratio: float) -> Array | None:
    """e with majorant e <= value e and 1 <= e <= max_ratio, or None."""
    from scipy.optimize import linprog

    count, n = len(majorants), majorants.shape[-1]
    left = (majorants - value * np.eye(n)).reshape(count * n, n)
    margin = np.ones((count * n, 1))
    result = linprog(
        np.append(np.zeros(n), -1.0),
        A_ub=np.concatenate([left, margin], axis=1),
        b_ub=np.zeros(count * n),
        bounds=[(1.0, max_ratio)] * n + [(None, 1.0)],
        method="highs",
    )
    if result.status != 0 or result.x is None or result.x[-1] < 0:
        return None
    return np.asarray(result.x[:-1])


def _weighted(matrix: ArrayLike, order: Order, weights: ArrayLike | None) -> Array:
    A = finite_array("matrix", matrix)
    if A.ndim < 2 or A.shape[-1] != A.shape[-2] or A.shape[-1] == 0:
        raise ValueError(f"`matrix` must be square, got shape {A.shape}.")
    if order not in (1, 2, np.inf):
        raise ValueError(f"`order` must be 1, 2 or inf, got {order}.")
    if weights is None:
        return A
    n = A.shape[-1]
    scale = finite_array("weights", weights)
    if order == 2:
        if scale.shape != (n, n):
            raise ValueError(f"`weights` must be an {n} x {n} matrix for the order 2, got shape {scale.shape}.")
        root, inverse = metric_roots(scale)
        return np.asarray(root @ A @ inverse)
    if scale.shape != (n,) or np.any(scale <= 0):
        raise ValueError(f"`weights` must hold {n} positive numbers for the order {order}, got {weights!r}.")
    return np.asarray(A * scale[:, None] / scale)


def _plain(value: Any) -> Any:
    array = np.asarray(value)
    return float(array) if array.ndim == 0 else array
