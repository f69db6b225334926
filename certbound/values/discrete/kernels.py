"""Integrals of the basis functions of one axis against the normal density, as banded matrices.

On the interval [x_k, x_{k + 1}] of width D_k with tau = (y - x_k)/D_k the basis functions are L = 1 - tau, R = tau,
Q = D_k^2 tau (1 - tau)/2 and P = 1; the hat of a node is R to its left and L to its right, its cubic
D_k^2 tau (1 - tau^2)/6 to its left and D_k^2 tau (1 - tau)(2 - tau)/6 to its right. For every row m
    K^(a)[m, k] = d^a/dm^a int b_k(y) phi_s(y - m) dy = int b_k(y) s^-a He_a(z) phi_s(y - m) dy,  z = (y - m)/s,
is evaluated by Gauss's rule. `AxisKernel.error` bounds what is wrong with an entry, relative to the mass that the
dominating density phi_{kappa s} has on the interval; see ``dominance``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from flint import arb

from certbound.arrays import Array
from certbound.rigor.balls import precision
from certbound.values.discrete.dominance import KAPPA, dominance, quadrature_error

REACH = 10.0
"""Standard deviations up to which every interval is integrated that comes so near."""
ORDERS = 3
_MARGIN = REACH + 1e-3
_FARTHEST = 40.0  # beyond it the density is below 1e-140 of the dominating one
_ROWS = 32
_WANTED = 2e-14
_UNIT = 2.0**-53


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Block:
    """Rows ``first:last`` of an axis' matrices, on the intervals ``left:right``."""

    first: int
    last: int
    left: int
    right: int
    parts: dict[str, Array]
    """Name to (ORDERS, rows, intervals); ``hat`` and ``cubic`` have one column more."""
    mass: Array
    """Mass of the dominating density, (rows, intervals)."""


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class AxisKernel:
    """One axis: where the noise-free step may end (``points``), and the integrals from there.

    Parameters
    ----------
    points : ndarray, shape (M,)
        Rows.
    nodes : ndarray, shape (N + 1,)
        The grid's nodes.
    sigma : float or ndarray, shape (M,)
        Standard deviation, of every row if they differ; known up to the relative error ``spread``.
    error : float
        |K^(a) - computed| <= error s^-a mass, entry by entry, for basis functions bounded by 1.
    outside : ndarray, shape (ORDERS, M)
        Derivatives of the probability that m + w lies outside [nodes[0], nodes[-1]], up to error s^-a outside_mass.
    outside_mass : ndarray, shape (M,)
        That probability for the dominating density.
    """

    points: Array
    nodes: Array
    sigma: float | Array
    error: float
    blocks: list[Block] = field(repr=False)
    outside: Array = field(repr=False)
    outside_mass: Array = field(repr=False)

    def apply(self, name: str, tensor: Array, axis: int, orders: int = ORDERS) -> list[Array]:
        """Contract one axis of a tensor with the first ``orders`` derivatives of one basis' matrix."""
        before, after = tensor.shape[:axis], tensor.shape[axis + 1 :]
        flat = np.ascontiguousarray(tensor).reshape(math.prod(before), tensor.shape[axis], math.prod(after))
        found = np.empty((orders, len(flat), len(self.points), flat.shape[2]))
        for block in self.blocks:
            part = block.parts[name][:orders]
            columns, into = flat[:, block.left : block.left + part.shape[2]], found[:, :, block.first : block.last]
            if axis == 0:
                np.matmul(part, columns[0], out=into[:, 0])
                continue
            for matrix, place in zip(part, into):
                if after:
                    np.matmul(matrix, columns, out=place)
                else:
                    np.matmul(columns[:, :, 0], matrix.T, out=place[:, :, 0])
        return list(found.reshape(orders, *before, len(self.points), *after))

    def apply_mass(self, tensor: Array) -> Array:
        """Contract the first axis of a tensor over the intervals with the dominating masses."""
        flat = tensor.reshape(len(tensor), -1)
        found = np.empty((len(self.points), flat.shape[1]))
        for block in self.blocks:
            found[block.first : block.last] = block.mass @ flat[block.left : block.right]
        return found.reshape(len(self.points), *tensor.shape[1:])


def axis_kernel(
    points: Array, nodes: Array, sigma: float | Array, spread: float, *, orders: int = ORDERS, sides: bool = True,
    cubic: bool = False,
) -> AxisKernel:  # fmt: skip
    """The matrices of one axis.

    Parameters
    ----------
    points, nodes : ndarray
        Rising; points of rows with standard deviations of their own in any order.
    sigma, spread : float
        Standard deviation (one, or one for every row) and its relative uncertainty (at most 1e-9).
    orders : int
        Orders of derivatives, at most 5.
    sides : bool
        Whether the halves ``left`` and ``right`` of hats are kept, which take as much memory as all else.
    cubic : bool
        Whether cubics are wanted.
    """
    sizes = np.broadcast_to(np.asarray(sigma, dtype=float), points.shape)
    degree = 3 if cubic else 2
    half, rule = _rule_for(np.diff(nodes), float(np.min(sizes)), orders, degree)
    own, widest = np.ndim(sigma) > 0, 0.0
    blocks = []
    for first in range(0, len(points), _ROWS):
        rows, size = points[first : first + _ROWS], sizes[first : first + _ROWS]
        near = _MARGIN * float(size.max())
        index = np.flatnonzero((nodes[1:] >= rows.min() - near) & (nodes[:-1] <= rows.max() + near))
        left, right = (int(index[0]), int(index[-1]) + 1) if len(index) else (0, 0)
        if own:
            half, rule = _rule_for(np.diff(nodes[left : right + 1]), float(size.min()), orders, degree)
        widest = max(widest, half)
        parts, mass = _integrals(rows, nodes[left : right + 1], size, *rule, orders, cubic)
        kept = parts if sides else {name: part for name, part in parts.items() if name not in ("left", "right")}
        blocks.append(Block(first=first, last=first + len(rows), left=left, right=right, parts=kept, mass=mass))
    scale = float(max(np.abs(nodes).max(), np.abs(points).max())) / float(np.min(sizes))
    # density at a point: z is off by 3 u scale (the node) and |z| (3 u + spread), the exponential by 8 units; weights
    # and sums cost 40 u more. All of it is taken times (1 + |z|)^(2 + 2) phi <= dominance(...) phi_{kappa s}; beyond
    # order 2 times 8 (1 + |z|)^(k + 2), as |He_4| <= 3 (1 + |z|)^4 and |He_k'| <= 4 (1 + |z|)^3.
    slack = 3 * _UNIT * scale + 3 * _UNIT + spread + 60 * _UNIT
    more = 1.1 if orders <= ORDERS else 8.0
    error = _WANTED + more * slack * dominance(0, min(2 * widest, 3.0), orders + 1)
    outside, outside_mass = _outside(points, float(nodes[0]), float(nodes[-1]), sigma, orders)
    return AxisKernel(
        points=points, nodes=nodes, sigma=sigma, error=error, blocks=blocks, outside=outside, outside_mass=outside_mass
    )


def _rule_for(widths: Array, sigma: float, orders: int, degree: int) -> tuple[float, tuple[Array, Array]]:
    """Half the width of a panel in units of sigma, and a rule that suffices for it."""
    longest = float(widths.max(initial=0.0)) / sigma
    panels = max(1, math.ceil(longest / 0.9))
    half = longest / panels / 2 * (1 + 1e-9)
    if orders > ORDERS:  # rules are shared by rows whose standard deviations are nearly alike
        half = math.ceil(half * 64 + 1e-9) / 64
    return half, _rule(_points(half, orders, degree), panels)


@lru_cache(maxsize=256)
def _points(half: float, orders: int, degree: int) -> int:
    """Points of the rule that suffice for the derivatives and, to 1e-4 of themselves, for the masses."""

    def fits(count: int) -> bool:
        wrong = max(quadrature_error(count, half, order, _FARTHEST, degree=degree) for order in range(orders))
        return wrong <= _WANTED and quadrature_error(count, half / KAPPA, 0, (REACH + 1) / KAPPA, 1.0) <= 1e-4

    return next(count for count in range(4, 64) if fits(count))


@lru_cache(maxsize=64)
def _rule(count: int, panels: int) -> tuple[Array, Array]:
    """Gauss's rule on [0, 1], repeated on equal panels; nodes and weights are balls rounded to floats."""
    with precision():
        pairs = [arb.legendre_p_root(count, k, weight=True) for k in reversed(range(count))]
    root, weight = (np.array([float(pair[k]) for pair in pairs]) for k in range(2))
    shifts = np.arange(panels)[:, None]
    return ((shifts + (root + 1) / 2) / panels).ravel(), np.tile(weight / 2 / panels, panels)


def _integrals(
    rows: Array, nodes: Array, sizes: Array, place: Array, weight: Array, orders: int, cubic: bool
) -> tuple[dict[str, Array], Array]:
    widths, sigma = np.diff(nodes), sizes[:, None, None]
    y = nodes[:-1, None] + widths[:, None] * place
    z = (y[None] - rows[:, None, None]) / sigma
    density = np.exp(-0.5 * z * z) / (sigma * math.sqrt(2 * math.pi))
    gap = np.maximum(nodes[:-1] - rows[:, None], rows[:, None] - nodes[1:])
    near = (gap <= _MARGIN * sigma[:, :, 0])[:, :, None]
    density *= near
    basis = [1 - place, place, place * (1 - place) / 2, np.ones_like(place)]
    if cubic:
        basis += [place * (1 - place) * (2 - place) / 6, place * (1 - place) * (1 + place) / 6]
    shapes = np.stack(basis, axis=1) * weight[:, None]
    moments = [density, density * z / sigma, density * (z * z - 1) / sigma**2]
    if orders > ORDERS:
        moments += [density * (z * (z * z - 3)) / sigma**3, density * (z * z * (z * z - 6) + 3) / sigma**4]
    values = np.moveaxis(np.stack(moments[:orders]) @ shapes, -1, 0) * widths  # (basis, orders, rows, intervals)
    left, right, bubble, whole = values[:4]
    parts = {"hat": _joined(left, right), "left": left, "right": right, "bubble": bubble * widths**2, "whole": whole}
    if cubic:
        parts["cubic"] = _joined(*(values[4:] * widths**2))
    wide = np.exp(-0.5 * (z / KAPPA) ** 2) / (KAPPA * sigma * math.sqrt(2 * math.pi)) * near
    return parts, (wide @ weight) * widths


def _joined(left: Array, right: Array) -> Array:
    """What a node has to its right, and to its left."""
    found = np.zeros((*left.shape[:-1], left.shape[-1] + 1))
    found[..., :-1] += left
    found[..., 1:] += right
    return found


def _outside(points: Array, low: float, high: float, sigma: float | Array, orders: int) -> tuple[Array, Array]:
    """Probability of leaving [low, high], its derivatives by m, and the dominating one."""
    above, below = (high - points) / sigma, (points - low) / sigma
    density = [np.exp(-0.5 * z * z) / math.sqrt(2 * math.pi) for z in (above, below)]
    value = _upper_tail(above) + _upper_tail(below)
    found = [
        value,
        (density[0] - density[1]) / sigma,
        (above * density[0] + below * density[1]) / sigma**2,
        ((above**2 - 1) * density[0] - (below**2 - 1) * density[1]) / sigma**3,
        (above * (above**2 - 3) * density[0] + below * (below**2 - 3) * density[1]) / sigma**4,
    ]
    return np.stack(found[:orders]), _upper_tail(above / KAPPA) + _upper_tail(below / KAPPA)


def _upper_tail(z: Array) -> Array:
    """P(N(0, 1) > z), to the last places: balls, point by point."""
    with precision():
        root = arb(2).sqrt()
        return np.array([float((arb(float(value)) / root).erfc() / 2) for value in z])
