"""Splines along one axis: knots, what their pieces are in Bernstein form, and differences of their coefficients."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from certbound.arrays import Array, Index

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Axis:
    """Splines of a degree with simple knots, clamped at both ends.

    ``knots`` has shape (cells + 1,); there are cells + degree coefficients, and those of cell k are k ... k + degree.
    """

    knots: Array
    degree: int

    @property
    def cells(self) -> int:
        """How many."""
        return len(self.knots) - 1

    @property
    def size(self) -> int:
        """How many coefficients."""
        return self.cells + self.degree

    @property
    def clamped(self) -> Array:
        """Knots with those at the ends repeated."""
        ends = np.full(self.degree, self.knots[0]), np.full(self.degree, self.knots[-1])
        return np.concatenate([ends[0], self.knots, ends[1]])

    @property
    def places(self) -> Array:
        """Greville's points: where a coefficient acts."""
        return np.array([self.clamped[k + 1 : k + self.degree + 1].mean() for k in range(self.size)])

    def differences(self, order: int) -> csr_matrix:
        """From coefficients to the derivative at `places`."""
        from scipy.interpolate import BSpline
        from scipy.sparse import csr_matrix

        basis = BSpline(self.clamped, np.eye(self.size), self.degree)
        return csr_matrix(basis(self.places, nu=order))

    def pieces(self, cell: Index, low: Array, high: Array) -> Array:
        """Bernstein coefficients on intervals [low, high] within cells from splines' coefficients.

        Shape (intervals, degree + 1, degree + 1): rows are the spline's blossom at low and high, so convex means of the
        coefficients; in floats they are off by at most 8 roundoffs for each of the three rounds.
        """
        d, knots = self.degree, self.clamped
        found = np.empty((len(cell), d + 1, d + 1))
        for row in range(d + 1):
            value = np.broadcast_to(np.eye(d + 1), (len(cell), d + 1, d + 1)).copy()
            for done in range(1, d + 1):
                at = high if done <= row else low
                for k in range(d, done - 1, -1):
                    left, right = knots[cell + k], knots[cell + k + d + 1 - done]
                    share = ((at - left) / (right - left))[:, None]
                    value[:, k] = (1 - share) * value[:, k - 1] + share * value[:, k]
            found[:, row] = value[:, d]
        return found

    @property
    def whole(self) -> Array:
        """`pieces` of all cells."""
        return self.pieces(np.arange(self.cells), self.knots[:-1], self.knots[1:])
