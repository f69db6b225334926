"""Columns of the diffusion over z, enlarged by what bounds the rest of it or a remainder of the drift."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from certbound.rigor.intervals import Interval, sqrt

EXACT = 1e-10
"""Remainders below this share of a working box a second are left to the proof, which pays for them."""
SLOPE = 8.0
"""q: about |grad V|."""
_SHARE = 0.02  # least a: the share by which the known part of the diffusion is enlarged where something is left


def padded(columns: Interval) -> Interval:
    """A row of zeros below matrices of shape (C, n, m)."""
    pad = [(0, 0), (0, 1), (0, 0)]
    return Interval(np.pad(columns.lo, pad), np.pad(columns.hi, pad))


def with_columns(columns: Interval, rest: Interval) -> Interval:
    """The columns enlarged, with others for what is left of them: rest (C, n) bounds the row sums of |E|."""
    if np.max(rest.hi) < EXACT:  # rounding: the proof pays for it
        wide = Interval(-rest.hi, rest.hi).reshape(*rest.shape, 1)
        return padded(columns + wide)
    n, loose = columns.shape[1], np.flatnonzero(np.max(rest.hi, axis=0) > 0)
    total = rest.sum(axis=-1).hi
    size = float(np.max(np.linalg.norm(columns.mid, axis=1)))
    share = float(np.clip(np.max(total) / max(size, 1e-300), _SHARE, 1.0))
    known = columns * sqrt(Interval.point(1.0) + Interval.point(share))
    weight = (Interval.point(1.0) + Interval.point(1.0) / Interval.point(share)) * Interval.point(total)
    side = sqrt(weight.reshape(-1, 1) * Interval.point(rest.hi))
    others = side.reshape(-1, n, 1) * Interval.point(np.eye(n)[:, loose])
    return padded(Interval(np.concatenate([known.lo, others.lo], 2), np.concatenate([known.hi, others.hi], 2)))


def with_small(columns: Interval, worst: Interval, small: Sequence[int]) -> Interval:
    """More columns sqrt(r_i / q) e_i."""
    if not small:
        return columns
    batch, size, _ = columns.shape
    more = np.zeros((batch, size, len(small)))
    more[:, list(small), np.arange(len(small))] = (sqrt(Interval.point(worst.hi[list(small)] / SLOPE))).hi
    return Interval(np.concatenate([columns.lo, more], axis=2), np.concatenate([columns.hi, more], axis=2))
