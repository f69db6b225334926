"""Matrices of one band: smoothing along y by N(0, s_y^2) and along q by N(0, s_q^2).

With hat functions h_i of the y-axis and cells [y_i, y_{i+1}], all matrices below have non-negative entries or are used
with absolute values; sup over a cell is over all y of the cell [Y_k, Y_{k+1}].

    rows     E h_i(Y_k + s z)                       nodes from nodes
    spread   E h_k(y_i + s z), transposed           what a kink at y_i contributes to the kink of the rows at Y_k
    cells    E D tau (1 - tau), D tau = y_i + s z - Y_k in [0, D = D_k], transposed     what a unit of a kink at y_i
             spread over cell k may bring about between its ends: a unit in the place tau does D tau (1 - tau)
    ceiling  sup over cell k of E h_i(y + s z)
    density  sup over cell k of phi_s(y - y_i)
    mass     min(1, D_i sup of phi over cell k - cell i), for s and for the wider s kappa

For the q-axis: matrices of values, first and second derivatives from nodal values and from parabolas, the suprema of
|phi|, |phi'|, |phi''| over cell - cell, and the suprema of phi, |phi''| and the mass over all s between s_q and s_q
stretch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from certbound.arrays import Array, Mask
from certbound.values.discrete import AxisKernel, axis_kernel

if TYPE_CHECKING:
    from scipy.sparse import csr_array

REACH = 10.0
"""Standard deviations beyond which smoothing neglects what it meets; the neglected mass is below 2e-23."""
WIDER = 1.4
"""Ratio of the standard deviations of the dominating density and of the noise; at least that of ``axis_kernel``."""
_ROUND = 1 + 1e-9
_BLOCK = 48  # rows of the q-axis that are multiplied at once


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Along:
    """Matrices of the y-axis (rows: the mesh ``first_row:last_row``, columns: ``first:last`` of the grid's nodes)."""

    rows: csr_array
    spread: csr_array
    cells: csr_array
    ceiling: csr_array
    density: csr_array
    mass: csr_array
    wide: csr_array
    error: float

    def cut(self, rows: slice, lines: slice) -> Along:
        """For some of the rows, from some of the lines."""
        cells, between = slice(rows.start, rows.stop - 1), slice(lines.start, lines.stop - 1)
        return Along(
            rows=self.rows[rows, lines], spread=self.spread[rows, lines], cells=self.cells[cells, lines],
            ceiling=self.ceiling[cells, lines], density=self.density[cells, lines], mass=self.mass[cells, between],
            wide=self.wide[cells, between], error=self.error,
        )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Across:
    """Matrices of the q-axis: ``values[a]`` and ``parabolas[a]`` for derivative a = 0, 1, 2; ``sup[a]`` on cells.

    ``spans`` holds (first row, last row, first column, last column) of blocks outside of which all matrices are 0.
    """

    values: tuple[Array, ...]
    parabolas: tuple[Array, ...]
    sup: tuple[Array, ...]
    density: Array
    fourth: Array
    mass: Array
    wide: Array
    error: float
    spans: tuple[tuple[int, int, int, int], ...]

    def cut(self, nodes: slice, sources: slice) -> Across:
        """For some of the nodes, from some of them."""
        cells, between = slice(nodes.start, nodes.stop - 1), slice(sources.start, sources.stop - 1)
        spans = [
            (max(first, nodes.start) - nodes.start, min(last, nodes.stop) - nodes.start,
             max(left, sources.start) - sources.start, min(right, sources.stop) - sources.start)
            for first, last, left, right in self.spans if first < nodes.stop and last > nodes.start
        ]  # fmt: skip
        return Across(
            values=tuple(part[nodes, sources] for part in self.values),
            parabolas=tuple(part[nodes, between] for part in self.parabolas),
            sup=tuple(part[cells, between] for part in self.sup), density=self.density[cells, between],
            fourth=self.fourth[cells, between], mass=self.mass[cells, between], wide=self.wide[cells, between],
            error=self.error, spans=tuple(span for span in spans if span[2] < span[3]),
        )  # fmt: skip


def along(nodes: Array, sigma: float, spread: float, rows: slice, lines: slice) -> Along:
    """The matrices of a band's y-axis.

    Parameters
    ----------
    nodes : ndarray, shape (ny,)
        All nodes of the axis.
    sigma, spread : float
        Standard deviation and its relative uncertainty.
    rows, lines : slice
        Mesh nodes that are wanted, and nodes within `REACH` standard deviations of them.
    """
    mesh, source = nodes[rows], nodes[lines]
    forth = axis_kernel(mesh, source, sigma, spread)
    around = slice(rows.start - 1, rows.stop + 1)
    back = axis_kernel(source, nodes[around], sigma, spread)
    hats = _dense(forth, "hat", len(source))
    kinks = _dense(back, "hat", len(nodes[around]))[:, 1:-1].T
    whole = _dense(back, "whole", len(nodes[around]) - 1)[:, 1:-1].T
    bows = _dense(back, "bubble", len(nodes[around]) - 1)[:, 1:-1].T * (2 / np.diff(mesh))[:, None]
    density = peak(mesh[:-1], mesh[1:], source, source, sigma)[0]
    widths, cells = np.diff(source), np.diff(mesh)
    bend = np.zeros(len(source))
    bend[1:-1] = 1 / widths[:-1] + 1 / widths[1:]
    lift = np.minimum(cells[:, None] ** 2 / 8 * density, cells[:, None] / 4 * np.minimum(whole * _ROUND, 1.0)) * bend
    ceiling = np.maximum(hats[:-1], hats[1:]) + lift
    from scipy.sparse import csr_array

    return Along(
        rows=csr_array(hats), spread=csr_array(kinks), cells=csr_array(bows), ceiling=csr_array(ceiling),
        density=csr_array(density), mass=csr_array(_mass(mesh, source, sigma)),
        wide=csr_array(_mass(mesh, source, sigma, WIDER)), error=forth.error + back.error,
    )  # fmt: skip


def across(nodes: Array, sigma: float, spread: float, stretch: float) -> Across:
    """The matrices of a band's q-axis, all nodes from all nodes."""
    kernel = axis_kernel(nodes, nodes, sigma, spread)
    values = tuple(_dense(kernel, "hat", len(nodes), order) for order in range(3))
    parabolas = tuple(_dense(kernel, "bubble", len(nodes) - 1, order) for order in range(3))
    sup = peak(nodes[:-1], nodes[1:], nodes[:-1], nodes[1:], sigma)
    density, _, fourth = peak(nodes[:-1], nodes[1:], nodes[:-1], nodes[1:], sigma, stretch)
    wide = _mass(nodes, nodes, sigma, WIDER)
    return Across(
        values=values, parabolas=parabolas, sup=sup, density=density, fourth=fourth,
        mass=np.minimum(density * np.diff(nodes), 1.0), wide=wide, error=kernel.error,
        spans=spans_of([*values, *parabolas, *sup, density, fourth, wide]),
    )  # fmt: skip


def spans_of(matrices: list[Array]) -> tuple[tuple[int, int, int, int], ...]:
    """Blocks of rows with the columns in which some of the matrices is not 0."""
    rows, columns = (max(matrix.shape[axis] for matrix in matrices) for axis in (0, 1))
    found = np.zeros((rows, columns), dtype=bool)
    for matrix in matrices:
        found[: matrix.shape[0], : matrix.shape[1]] |= matrix != 0
    spans = []
    for first in range(0, rows, _BLOCK):
        last = min(first + _BLOCK, rows)
        used = np.flatnonzero(found[first:last].any(axis=0))
        spans.append((first, last, int(used[0]), int(used[-1]) + 1) if len(used) else (first, last, 0, 0))
    return tuple(spans)


def across_by(lines: Array, matrix: Array, spans: tuple[tuple[int, int, int, int], ...]) -> Array:
    """``lines @ matrix.T``, block by block: most of a wide matrix is 0."""
    found = np.zeros((len(lines), len(matrix)))
    for first, last, left, right in spans:
        found[:, first:last] = lines[:, left:right] @ matrix[first:last, left:right].T
    return found


def _dense(kernel: AxisKernel, name: str, columns: int, order: int = 0) -> Array:
    """One matrix of an axis kernel, rows by columns."""
    blocks = kernel.blocks
    found = np.zeros((blocks[-1].last, columns))
    for block in blocks:
        part = block.parts[name][order]
        found[block.first : block.last, block.left : block.left + part.shape[1]] = part
    return found


def peak(
    low: Array, high: Array, left: Array, right: Array, sigma: float, stretch: float = 1.0
) -> tuple[Array, Array, Array]:
    """sup of |phi_s|, |phi_s'|, |phi_s''| over differences of cells and s in [sigma, sigma stretch]."""
    first = (low[:, None] - right[None]) / sigma
    last = (high[:, None] - left[None]) / sigma
    first, last = np.minimum(first, first / stretch), np.maximum(last, last / stretch)
    slack = 1e-12 * (1 + np.abs(first) + np.abs(last))
    first, last = first - slack, last + slack
    nearest = np.maximum(np.maximum(first, -last), 0.0)
    near = nearest < REACH + 4
    scale = near / (math.sqrt(2 * math.pi) * sigma) * _ROUND

    def phi(z: Array) -> Array:
        return np.asarray(np.exp(-0.5 * z * z))

    def holds(z: float) -> Mask:
        return np.asarray((first <= z) & (last >= z) | (first <= -z) & (last >= -z))

    zero = phi(nearest)
    one = np.maximum(np.abs(first) * phi(first), np.abs(last) * phi(last))
    one = np.where(holds(1.0), math.exp(-0.5), one)
    two = np.maximum(np.abs(first**2 - 1) * phi(first), np.abs(last**2 - 1) * phi(last))
    two = np.where(holds(math.sqrt(3.0)), np.maximum(two, 2 * math.exp(-1.5)), two)
    two = np.where(holds(0.0), 1.0, two)
    return zero * scale, one * scale / sigma, two * scale / sigma**2


def _mass(mesh: Array, source: Array, sigma: float, ratio: float = 1.0) -> Array:
    """min(1, D_i sup phi), shape (mesh cells, cells)."""
    density = peak(mesh[:-1], mesh[1:], source[:-1], source[1:], sigma * ratio)[0]
    return np.minimum(density * np.diff(source), 1.0)
