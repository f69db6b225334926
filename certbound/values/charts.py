"""Maps of the probability of failing over the states: certified bounds, constant on the cells of a grid."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array, Mask

LOWEST = -300.0  # below this logarithm nothing is told apart
_LN10 = 2.302585092994046


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Chart:
    """log10 of a bound of P(failing by the horizon | X = x at ``time``) that holds for all x of a cell, faces too.

    Parameters
    ----------
    time : float
        Seconds, or a step.
    axes : tuple of ndarray, shapes (N_i + 1,)
        Rising nodes of each state.
    log10 : ndarray, shape (N_1, ..., N_n)
        Upper bounds, or lower bounds (-inf where nothing is known).
    """

    time: float
    axes: tuple[Array, ...]
    log10: Array

    def at(self, points: Array, *, up: bool) -> Array:
        """The bound at points, shape (P, n): the best of the cells that hold a point; 0 (up) or -inf outside."""
        pick = np.minimum if up else np.maximum
        inside = np.ones(len(points), dtype=bool)
        options = []
        for axis, x in zip(self.axes, points.T):
            inside &= (x >= axis[0]) & (x <= axis[-1])
            found = [np.searchsorted(axis, x, side=side) - 1 for side in ("left", "right")]
            options.append([np.clip(index, 0, len(axis) - 2) for index in found])
        values = [self.log10[cell] for cell in itertools.product(*options)]
        return np.asarray(np.where(inside, pick.reduce(values), 0.0 if up else -np.inf))

    def joined(self, other: Chart) -> Chart:
        """The smaller of two upper bounds at the same time, on the grid of all nodes; outside its own, each says 1."""
        axes = tuple(np.union1d(a, b) for a, b in zip(self.axes, other.axes))
        return Chart(time=self.time, axes=axes, log10=np.minimum(self._onto(axes), other._onto(axes)))

    def _onto(self, axes: tuple[Array, ...]) -> Array:
        """The upper bounds on a grid whose nodes contain this one's."""
        padded = np.pad(self.log10, 1)  # log10 of 1 around
        places = [np.searchsorted(own, axis[:-1], side="right") for own, axis in zip(self.axes, axes)]
        return padded[np.ix_(*places)]

    @property
    def middles(self) -> tuple[Array, ...]:
        """The middles of the cells along each axis."""
        return tuple((axis[1:] + axis[:-1]) / 2 for axis in self.axes)

    def boxes(self, cells: Mask) -> Array:
        """The chosen cells as boxes, shape (K, n, 2), neighbours along the last axis joined."""
        rows = cells.reshape(-1, cells.shape[-1])
        padded = np.zeros((len(rows), rows.shape[1] + 2), dtype=np.int8)
        padded[:, 1:-1] = rows
        change = np.diff(padded, axis=1)
        row, first = np.nonzero(change == 1)
        last = np.nonzero(change == -1)[1]
        others = np.unravel_index(row, cells.shape[:-1]) if cells.ndim > 1 else ()
        ends = [np.stack([axis[k], axis[k + 1]], axis=-1) for axis, k in zip(self.axes, others)]
        ends.append(np.stack([self.axes[-1][first], self.axes[-1][last]], axis=-1))
        return np.stack(ends, axis=1)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Charts:
    """Upper bounds at the start and, in one state, at later times; lower bounds too where there are any."""

    upper: tuple[Chart, ...]
    lower: tuple[Chart, ...] = ()


def from_natural(logarithms: Array, *, up: bool) -> Array:
    """log10 of what has these natural logarithms, rounded up or down; at most 0."""
    value = logarithms / _LN10
    slack = 1e-15 * np.abs(value)
    return np.minimum(np.maximum(value + slack, LOWEST), 0.0) if up else np.minimum(value - slack, 0.0)


def from_probability(probabilities: Array, *, up: bool) -> Array:
    """log10 of probabilities, rounded up or down; -inf for a lower bound that says nothing."""
    value = np.log10(np.maximum(probabilities, 10.0**LOWEST))
    slack = 1e-14 * np.abs(value) + 1e-15
    if up:
        return np.asarray(np.minimum(value + slack, 0.0))
    return np.asarray(np.where(probabilities > 10.0**LOWEST, np.minimum(value - slack, 0.0), -np.inf))
