"""Backward induction over the steps: a function above the probability of failing from every state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter

from certbound.arrays import Array, Mask
from certbound.values.grids import around_nodes, corners
from certbound.values.semilagrangian.bands import Band, Frame, through
from certbound.values.semilagrangian.smoothing import Lines


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Bounds:
    """What U must be at least: ``level`` at nodes (0 where nothing is asked), and how far remainders reach in cells."""

    level: Array
    reach: tuple[int, int]


def back(frame: Frame, bands: list[Band], bounds: Bounds, value: Lines) -> Lines:
    """One step back.

    Proves: if value >= u_{t+1} in the sense of the module ``semilagrangian``, the returned function is >= u_t.
    """
    slopes = _slopes(frame, value, bounds.reach)
    nodal = np.zeros_like(value.nodal)
    bend = np.full_like(value.bend, -np.inf)
    payment = np.zeros(frame.live.shape)
    for band in bands:
        at, curve, paid = through(band, frame, value, slopes)
        nodes = slice(band.first, band.last + 1)
        nodal[nodes] = np.maximum(nodal[nodes], at)
        bend[nodes] = np.maximum(bend[nodes], curve)
        payment[band.first : band.last] = paid
    bend = np.where(np.isfinite(bend), bend, 0.0)
    return limited(frame, bounds, nodal + around_nodes(payment, largest=True), bend)


def limited(frame: Frame, bounds: Bounds, nodal: Array, bend: Array) -> Lines:
    """Raise a function to its levels, and lower it to 1 where it is at least that all around."""
    nodal = np.maximum(nodal, bounds.level)
    full = np.minimum.reduce(corners(nodal)) >= 1
    capped = (around_nodes((~full).astype(float), largest=True) <= 0) & (bounds.level <= 1)
    nodal = np.where(capped, 1.0, nodal)
    fixed = capped | (bounds.level > 0)
    sides = fixed[:, :-1] | fixed[:, 1:]
    return Lines(nodal=nodal, bend=np.where(sides, np.maximum(bend, 0.0), bend))


def _slopes(frame: Frame, value: Lines, reach: tuple[int, int]) -> tuple[Array, Array]:
    """Bounds of |d_y U| and |d_q U| on all cells that a remainder may reach from a cell."""
    dy, dq = np.diff(frame.y)[:, None], np.diff(frame.q)
    along_y = np.abs(np.diff(value.nodal, axis=0)) / dy
    first = np.maximum(along_y[:, 1:], along_y[:, :-1]) + np.abs(np.diff(value.bend, axis=0)) / dy * dq**2 / 8
    across = np.abs(np.diff(value.nodal, axis=1)) / dq + np.abs(value.bend) * dq / 2
    second = np.maximum(across[1:], across[:-1])
    size = (2 * reach[0] + 1, 2 * reach[1] + 1)
    one, two = (np.asarray(maximum_filter(part, size, mode="nearest")) for part in (first, second))
    return one * (1 + 1e-9), two * (1 + 1e-9)


def highest(frame: Frame, value: Lines, starts: tuple[tuple[float, float], tuple[float, float]], shear: float) -> float:
    """Upper bound of the function over the starts p x q."""
    p, q = starts
    best = 0.0
    first = max(int(np.searchsorted(frame.q, q[0], side="right")) - 1, 0)
    last = min(int(np.searchsorted(frame.q, q[1])), len(frame.q) - 1)
    for j in range(first, max(last, first + 1)):
        low, high = max(q[0], frame.q[j]), min(q[1], frame.q[j + 1])
        ends = sorted((shear * low, shear * high))
        slack = 1e-14 * (1 + abs(p[0]) + abs(p[1]))
        y = (p[0] - ends[1] - slack, p[1] - ends[0] + slack)
        if y[0] < frame.y[0] or y[1] > frame.y[-1]:
            return 1.0
        best = max(best, _over_strip(frame, value, j, (low, high), y))
    return best


def _over_strip(frame: Frame, value: Lines, j: int, q: tuple[float, float], y: tuple[float, float]) -> float:
    """Largest value over part of a column of cells: bilinear parts at corners, parabolas at their tops."""
    d = frame.q[j + 1] - frame.q[j]
    share = [min(max((end - frame.q[j]) / d, 0.0), 1.0) for end in q]
    lines = np.stack([(1 - s) * value.nodal[:, j] + s * value.nodal[:, j + 1] for s in share])
    arch = np.maximum(value.bend[:, j], 0.0) * d**2 / 8
    inside = (frame.y >= y[0]) & (frame.y <= y[1])
    ends = [np.interp(end, frame.y, line + arch) for end in y for line in lines]
    return float(max(*ends, (lines + arch)[:, inside].max(initial=0.0))) * (1 + 1e-12)


def start_levels(frame: Frame, safe: Mask, inner: Mask) -> Array:
    """Least values at nodes: 1 at corners of cells not surely safe, 2 where a noisy face may have been crossed.

    ``safe`` and ``inner``, shape (ny - 1, nq - 1): cells within the noise-free faces, and within the noisy ones.
    """
    outside = around_nodes((~safe).astype(float), largest=True)
    beyond = around_nodes((~inner).astype(float), largest=True)
    return np.where(beyond > 0, 2.0, np.where(outside > 0, 1.0, 0.0))
