"""Boxes and the polytope {low <= rows . s <= high} that they are cut from, for batches of both."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

__all__ = ["cull", "grid", "halve", "linear_range"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

_WIDE = 1 + 1e-11
_LEAST = 1e-290


def linear_range(matrix: Array, radius: Array, normals: Array, room: Array) -> Array:
    """Upper bounds of g . d over |d| <= e and one of normals_k . d <= room_k at a time, the least over k.

    For alpha >= 0, g . d <= |g - alpha w| . e + alpha room: the least value over the kinks alpha = g_j / w_j counts.

    Parameters
    ----------
    matrix : ndarray, shape (Q, n, a)
        Rows g.
    radius : ndarray, shape (Q, a)
    normals : ndarray, shape (Q, D, a)
    room : ndarray, shape (Q, D)

    Returns
    -------
    ndarray, shape (Q, n)
        Rounded up.

    Examples
    --------
    >>> g, e = np.array([[[1.0, 1.0]]]), np.ones((1, 2))
    >>> bound = linear_range(g, e, np.array([[[1.0, 1.0]]]), np.array([[0.5]]))
    >>> bool(0.5 <= bound[0, 0] < 0.5001)
    True
    """
    result = np.einsum("qna,qa->qn", np.abs(matrix), radius) * _WIDE + _LEAST
    reach = np.einsum("qda,qa->qd", np.abs(normals), radius)
    box, face = np.nonzero(room < reach * (1 - 1e-12))
    g, w, e, b = matrix[box], normals[box, face][:, None], radius[box][:, None], room[box, face][:, None]
    for j in range(matrix.shape[2]):
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            alpha = g[:, :, j] / w[:, :, j]
        alpha = np.where((alpha > 0) & (alpha < 1e100), alpha, 0.0)[..., None]
        left = np.abs(g - alpha * w)
        value = (left * e).sum(axis=-1) + alpha[..., 0] * b
        size = ((np.abs(g) + alpha * np.abs(w)) * e).sum(axis=-1) + alpha[..., 0] * np.abs(b)
        np.minimum.at(result, box, value + 1e-13 * size + _LEAST)
    return np.asarray(result)


def cull(items: Indices, centre: Array, radius: Array, low: Array, high: Array, rows: Array) -> tuple[Mask, Mask]:
    """Which boxes may meet the polytope low <= rows . c <= high, and which centres lie in it."""
    own = rows[items]
    value = np.einsum("qda,qa->qd", own, centre)
    reach = np.einsum("qda,qa->qd", np.abs(own), radius)
    slack = 1e-13 * (np.einsum("qda,qa->qd", np.abs(own), np.abs(centre)) + reach)
    lo, hi = low[items], high[items]
    keep = ((value - reach - slack <= hi) & (value + reach + slack >= lo)).all(axis=1)
    return keep, ((value <= hi) & (value >= lo)).all(axis=1)


def grid(low: Array, high: Array, block: list[int], divisions: int) -> tuple[Array, Array]:
    """Boxes that cover [low, high] in the coordinates of ``block``: centres and radii (M, K, len(block))."""
    unit = (np.array(list(itertools.product(range(divisions), repeat=len(block)))) + 0.5) / divisions
    width = (high - low)[:, block]
    centre = low[:, None, block] + width[:, None] * unit[None]
    radius = (width / (2 * divisions))[:, None] * (1 + 1e-13) + 4e-16 * (np.abs(centre) + np.abs(low)[:, None, block])
    return centre, radius


def halve(items: Indices, centre: Array, radius: Array, along: Indices) -> tuple[Indices, Array, Array]:
    """Cut every box in two along its coordinate ``along``."""
    number = np.arange(len(items))
    half, old = radius[number, along] / 2, centre[number, along]
    small = radius.copy()
    small[number, along] = half * (1 + 1e-15) + 4e-16 * (np.abs(old) + half)
    left, right = centre.copy(), centre.copy()
    left[number, along], right[number, along] = old - half, old + half
    return np.concatenate([items, items]), np.concatenate([left, right]), np.concatenate([small, small])
