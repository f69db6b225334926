"""Piecewise polynomial curves whose float coefficients are exact: the centre lines of reach tubes.

On piece k, t in [t_k, t_{k+1}], the curve is p(t) = sum_j c_kj s^j with s = t - m_k; the middle m_k is a
float near the piece's centre. Nothing is rounded in that definition, so that every statement about p can be
proved. In discrete time piece k is step k alone and p is the constant c_k0.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.reach.nominal.series import polynomial_range
from certbound.rigor.intervals import Interval, stack
from certbound.rigor.series import Series


@dataclass(frozen=True, eq=False, kw_only=True)
class Curve:
    """A batch of piecewise polynomial curves on common time pieces.

    Examples
    --------
    >>> line = Curve(continuous=True, starts=[0.0], ends=[2.0], coefficients=[[[[1.0], [0.5]]]])
    >>> line.value(2.0)
    array([[1.5]])
    """

    continuous: bool  # False: discrete time, the pieces are the steps 0, 1, ..., K - 1
    # (K,): piece k is [starts[k], ends[k]], and starts[k + 1] = ends[k] in continuous time; in discrete time
    # starts = ends = the steps
    starts: Array
    ends: Array
    coefficients: Array  # (B, K, degree + 1, n): one curve per cell of the initial set

    def __post_init__(self) -> None:
        for name in ("starts", "ends", "coefficients"):
            array = np.array(getattr(self, name), dtype=float)
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @property
    def cells(self) -> int:
        """Number of curves B."""
        return int(self.coefficients.shape[0])

    @property
    def pieces(self) -> int:
        """Number of pieces or steps K."""
        return len(self.starts)

    @property
    def dimension(self) -> int:
        """State dimension n."""
        return int(self.coefficients.shape[-1])

    @property
    def middles(self) -> Array:
        """The expansion points m_k."""
        result: Array = np.clip(0.5 * self.starts + 0.5 * self.ends, self.starts, self.ends)
        return result

    @property
    def span(self) -> Interval:
        """Values of s = t - m_k on each piece, shape (K,)."""
        return self.offset(Interval(self.starts, self.ends))

    @property
    def times(self) -> Interval:
        """The time pieces as intervals, shape (K,)."""
        return Interval(self.starts, self.ends)

    def offset(self, times: Interval) -> Interval:
        """s = t - m_k for times given per piece, shape (K,)."""
        return times - self.middles

    def series(self) -> list[Series]:
        """Thin series at the middles, one per state; coefficients of shape (B, K)."""
        return [
            [Interval.point(self.coefficients[..., j, i]) for j in range(self.coefficients.shape[-2])]
            for i in range(self.dimension)
        ]

    def series_over(self, span: Interval) -> list[Series]:
        """Series whose coefficients hold at every s in ``span`` (shape (K,)): p^(j)(s)/j!."""
        result = []
        for thin in self.series():
            wide = []
            for j in range(len(thin)):
                shifted = [coefficient * float(comb(i, j)) for i, coefficient in enumerate(thin) if i >= j]
                wide.append(polynomial_range(shifted, span))
            result.append(wide)
        return result

    def range(self, span: Interval | None = None) -> Interval:
        """Enclosure of p over each piece (or over ``span`` of each piece), shape (B, K, n)."""
        where = self.span if span is None else span
        return stack([polynomial_range(series, where) for series in self.series()], axis=-1)

    def jumps(self) -> Interval:
        """Enclosure of the gap from piece k to piece k + 1 at their common time, shape (B, K - 1, n)."""
        first = self.range(self.offset(Interval.point(self.starts)))
        last = self.range(self.offset(Interval.point(self.ends)))
        return first[:, 1:] - last[:, :-1]

    def initial(self) -> Interval:
        """Enclosure of p(0), shape (B, n)."""
        return self.range(self.offset(Interval.point(self.starts)))[:, 0]

    def piece_of(self, time: float) -> int:
        """Index of a piece that contains ``time`` (the later one at a common end).

        Raises
        ------
        ValueError
            If the curve does not reach ``time``.
        """
        if not self.starts[0] <= time <= self.ends[-1]:
            raise ValueError(f"`t` must lie in [{self.starts[0]:g}, {self.ends[-1]:g}], got {time:g}.")
        if not self.continuous and time != int(time):
            raise ValueError(f"`t` must be a whole number of steps, got {time:g}.")
        index = int(np.searchsorted(self.starts, time, side="right")) - 1
        return min(index, self.pieces - 1)

    def value(self, time: ArrayLike) -> Array:
        """Floating-point p(t) of every cell, shape (B, *t.shape, n)."""
        times = np.asarray(time, dtype=float)
        index = np.array([self.piece_of(float(t)) for t in times.reshape(-1)], dtype=int)
        offsets = (times.reshape(-1) - self.middles[index])[:, None]
        chosen = self.coefficients[:, index]
        total = np.zeros((self.cells, len(index), self.dimension))
        for j in reversed(range(chosen.shape[-2])):
            total = total * offsets + chosen[..., j, :]
        return total.reshape(self.cells, *times.shape, self.dimension)

    def section(self, first: int, last: int) -> Curve:
        """Pieces ``first`` up to, but without, ``last``."""
        return Curve(
            continuous=self.continuous,
            starts=self.starts[first:last],
            ends=self.ends[first:last],
            coefficients=self.coefficients[:, first:last],
        )

    def until(self, pieces: int) -> Curve:
        """The first ``pieces`` pieces."""
        return self.section(0, pieces)
