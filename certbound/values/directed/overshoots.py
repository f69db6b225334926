"""By how much the mean of a function on lines, after the noise, can exceed its bilinear interpolation on a cell.

U is linear in y between lines y_i, on each of which it is linear in q between nodes, and a constant beyond the ends of
q; W(y, m) = E U(y, m + w). Beyond the outermost lines W is continued by its value there. W is linear in y on strips and
smooth in m, so that along a straight way (Delta_y, Delta_m) of f_I the function psi(tau) = W on it has
    psi'' = W_mm Delta_m^2 + 2 W_ym Delta_y Delta_m, and kinks |Delta_y| K_i(m) where it crosses line i,
K_i the jump of W_y. Above its chord psi is at most by 1/8 sup (-psi'')^+ + sum tau (1 - tau) |Delta_y| K_i^-. With
kinks k_j of U along a line, slopes g_j along y of a strip's nodes, and jumps c of U at the ends of q,
    W_mm = sum k_j phi(q_j - m) + sum c z/s phi,   W_ym = sum (g_{j+1} - g_j)/d_j P(cell j) + ends,
    K_i = sum K_ij B_j,
whose terms of either sign are summed apart, over a mesh's cell with the largest and least values of ``hats``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.values.directed.cell_landings import TINY, Landing
from certbound.values.directed.hats import ROUND, Ranges

_UNITS = 512 * 2.0**-53


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Lines:
    """A function: values at the nodes, shape (lines, nodes), and its constants below and above the nodes of q."""

    nodal: Array
    below: float
    above: float

    @property
    def size(self) -> float:
        """The largest absolute value, at least 1."""
        return max(1.0, float(np.abs(self.nodal).max()), abs(self.below), abs(self.above))


def _edge(jumps: Array, over: tuple[Array, Array], row: int) -> Array:
    """At least jump times x of one row of the ranges, for every jump."""
    found: Array = np.maximum(jumps[:, None] * over[0][row], jumps[:, None] * over[1][row])
    return found + ROUND * np.abs(found)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Bends:
    """Over the cells of a mesh: what -W_mm, |W_ym|, -K_i and |W_m|, |W_y| are at most."""

    curved: Array
    twisted: Array
    kinked: Array
    steep: Array
    high: Array


def bends_of(value: Lines, y: Array, q: Array, ranges: Ranges, *, steep: bool, high: bool) -> Bends:
    """Bounds on lines (strips for |W_ym| and |W_y|) times cells of m; the last two only if they are asked for."""
    u, width, apart = value.nodal, np.diff(q), np.diff(y)[:, None]
    along, across = np.diff(u, axis=1) / width, np.diff(u, axis=0) / apart
    kinks = np.diff(along, axis=1, prepend=0.0, append=0.0)
    ends = u[:, 0] - value.below, value.above - u[:, -1]
    curved = ranges.densities.largest(-kinks)
    for row, jump in zip((0, 1), ends):
        curved += _edge(-jump, ranges.edges, row)
    twist = np.diff(across, axis=1) / width
    twisted = np.maximum(ranges.masses.largest(twist), ranges.masses.largest(-twist))
    for row in (0, -1):
        twisted += np.abs(across[:, [row]]) * ranges.densities.high[row] * (1 + ROUND)
    kinked = ranges.hats.largest(-np.diff(across, axis=0, prepend=0.0, append=0.0))
    nothing = np.zeros((0, 0))
    slope = ranges.masses.sizes(along) if steep else nothing
    for row, jump in zip((0, -1), ends):
        slope = slope + np.abs(jump)[:, None] * ranges.densities.high[row] if steep else nothing
    return Bends(
        curved=np.maximum(curved, 0.0), twisted=np.maximum(twisted, 0.0), kinked=np.maximum(kinked, 0.0), steep=slope,
        high=ranges.hats.sizes(across) if high else nothing,
    )  # fmt: skip


def overshoots(value: Lines, y: Array, q: Array, ranges: Ranges, landing: Landing, s: float) -> Array:
    """What W(f) exceeds the bilinear interpolation of its values W(f_I) at the corners by, at most, on live cells.

    Rounding: slopes are off by 4u of themselves, kinks by 8u of the slopes beside them, at most 2 size/width; times
    what counts of them here that is 64u size for moves of one width, and more by the square of these.
    """
    (side_y, side_m), (other_y, other_m) = landing.moves
    least, size = float(np.diff(q).min()), value.size
    strays = landing.away[1] > TINY * s
    bends = bends_of(value, y, q, ranges, steep=bool(strays.any()), high=bool(len(landing.rough)))
    found = (side_m**2 + other_m**2) * landing.lines.largest(bends.curved) / 8
    found += (side_y * side_m + other_y * other_m) * landing.strips.largest(bends.twisted) / 4
    if len(landing.cell):
        part = landing.weight * landing.crossed.largest(bends.kinked)
        found += np.bincount(landing.cell, weights=part, minlength=len(found))
    found += landing.away[1] * (landing.lines.largest(bends.steep) if strays.any() else 2 * size / s)
    steepest = float(np.abs(np.diff(value.nodal, axis=0)).max(initial=0.0)) / float(np.diff(y).min())
    lift = landing.away[0] * steepest
    if len(landing.rough):
        near = landing.away[0][landing.rough] * landing.steep.largest(bends.high)
        lift[landing.rough] = near + landing.slip * steepest
    moved = 1 + (side_m + other_m) / least + (side_y + other_y) / landing.narrow
    return (found + lift) * (1 + ROUND) + _UNITS * size * moved**2
