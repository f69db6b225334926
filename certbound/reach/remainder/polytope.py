"""Boxes and the polytope {low <= rows . s <= high} that they are cut from, for batches of both."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Index, Mask

_WIDE = 1 + 1e-11
_LEAST = 1e-290


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes centre + [-radius, radius], shape (Q, active) each, of the pieces ``items`` (Q,)."""

    items: Index
    centre: Array
    radius: Array

    def __len__(self) -> int:
        return len(self.items)

    def __getitem__(self, chosen: Index | Mask) -> Boxes:
        return Boxes(self.items[chosen], self.centre[chosen], self.radius[chosen])

    def halved(self, along: Index) -> Boxes:
        """Every box cut in two along its coordinate ``along``."""
        number = np.arange(len(self))
        half, old = self.radius[number, along] / 2, self.centre[number, along]
        small = self.radius.copy()
        small[number, along] = half * (1 + 1e-15) + 4e-16 * (np.abs(old) + half)
        left, right = self.centre.copy(), self.centre.copy()
        left[number, along], right[number, along] = old - half, old + half
        return Boxes(np.tile(self.items, 2), np.concatenate([left, right]), np.concatenate([small, small]))


@dataclass(frozen=True, eq=False)
class Polytope:
    """{low <= rows . s <= high} on every piece: ``low`` and ``high`` (M, D), ``rows`` (M, D, active)."""

    low: Array
    high: Array
    rows: Array

    def cull(self, boxes: Boxes) -> tuple[Mask, Mask]:
        """Which boxes may meet the polytope of their piece, and which centres lie in it."""
        own = self.rows[boxes.items]
        value = np.einsum("qda,qa->qd", own, boxes.centre)
        reach = np.einsum("qda,qa->qd", np.abs(own), boxes.radius)
        slack = 1e-13 * (np.einsum("qda,qa->qd", np.abs(own), np.abs(boxes.centre)) + reach)
        lo, hi = self.low[boxes.items], self.high[boxes.items]
        keep = ((value - reach - slack <= hi) & (value + reach + slack >= lo)).all(axis=1)
        return keep, ((value <= hi) & (value >= lo)).all(axis=1)


def linear_range(matrix: Array, radius: Array, normals: Array, room: Array) -> Array:
    """Upper bounds of g . d over |d| <= e and one of normals_k . d <= room_k at a time, the least over k.

    For alpha >= 0, g . d <= |g - alpha w| . e + alpha room, which is convex in alpha: the kink alpha = g_j / w_j where
    it begins to grow serves best, and a face for which it grows from 0 on is of no use.

    ``matrix`` (Q, n, a) holds the rows g, ``radius`` (Q, a) is e, ``normals`` (Q, D, a) and ``room`` (Q, D) are the
    faces. The bounds (Q, n) are rounded up.

    Examples
    --------
    >>> g, e = np.array([[[1.0, 1.0]]]), np.ones((1, 2))
    >>> bound = linear_range(g, e, np.array([[[1.0, 1.0]]]), np.array([[0.5]]))
    >>> bool(0.5 <= bound[0, 0] < 0.5001)
    True
    """
    result = np.einsum("qna,qa->qn", np.abs(matrix), radius) * _WIDE + _LEAST
    reach = np.einsum("qda,qa->qd", np.abs(normals), radius)
    useful = room < reach * (1 - 1e-12)
    if not useful.any():
        return np.asarray(result)
    # at alpha = 0: b + sum |w| e, less twice the weights of the coordinates in which g falls
    signs, weights = np.sign(matrix), normals * radius[:, None]
    slopes = room[:, None] + reach[:, None] - np.abs(signs) @ np.abs(weights).swapaxes(1, 2)
    slopes -= signs @ weights.swapaxes(1, 2)
    box, row, face = np.nonzero((slopes < 0) & useful[:, None])
    g, w, b, e = matrix[box, row], normals[box, face], room[box, face], radius[box]
    falls, weight = g * w > 0, np.abs(weights[box, face])
    alpha = _turning(g, w, falls, weight, slopes[box, row, face])
    value = (np.abs(g - alpha[:, None] * w) * e).sum(axis=-1) + alpha * b
    size = (np.abs(g) * e).sum(axis=-1) + alpha * (weight.sum(axis=-1) + np.abs(b))
    np.minimum.at(result, (box, row), value + 1e-13 * size + _LEAST)
    return np.asarray(result)


def _turning(g: Array, w: Array, falls: Mask, weight: Array, slope: Array) -> Array:
    """Where sum |g - alpha w| e + alpha b begins to grow: (P,), of rows (P, a); ``slope`` < 0 at 0, ``weight`` |w| e.

    At a kink of a coordinate that ``falls`` the slope grows by twice its weight. 0 where numbers are out of range.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        kinks = np.where(falls, g / w, np.inf)
    order = np.argsort(kinks, axis=-1)
    grown = slope[:, None] + 2 * np.cumsum(np.take_along_axis(weight, order, axis=-1), axis=-1)
    last = np.maximum(falls.sum(axis=-1) - 1, 0)
    place = np.minimum(np.where((grown >= 0).any(axis=-1), np.argmax(grown >= 0, axis=-1), last), last)
    alpha = np.take_along_axis(np.take_along_axis(kinks, order, axis=-1), place[:, None], axis=-1)[:, 0]
    return np.where(alpha < 1e100, alpha, 0.0)


def grid(low: Array, high: Array, block: list[int], divisions: int) -> tuple[Array, Array]:
    """Boxes that cover [low, high] in the coordinates of ``block``: centres and radii (M, K, len(block))."""
    unit = (np.array(list(itertools.product(range(divisions), repeat=len(block)))) + 0.5) / divisions
    width = (high - low)[:, block]
    centre = low[:, None, block] + width[:, None] * unit[None]
    radius = (width / (2 * divisions))[:, None] * (1 + 1e-13) + 4e-16 * (np.abs(centre) + np.abs(low)[:, None, block])
    return centre, radius
