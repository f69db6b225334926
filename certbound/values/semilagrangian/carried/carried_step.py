"""One step back: V_k(y) >= E V_{k+1}(Phi(y + s W_h e)) and what the split noise leaves out (docs/values.md, K8-SL)."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.values.discrete import axis_kernel
from certbound.values.grids import around_nodes, corners, over_corners
from certbound.values.semilagrangian.carried.carried_cells import (
    PAIRS,
    at_images,
    beside,
    crosses_of,
    kinks_of,
    near,
    over_images,
    slopes_of,
)
from certbound.values.semilagrangian.carried.carried_motion import Blocks, Images
from certbound.values.semilagrangian.remainders import upper_tail
from certbound.values.semilagrangian.smoothers import across_by, peak, spans_of

_UP = 1 + 1e-9
_SOFT = 5  # cells: an odd number
_CUT = 2.0  # above which nothing is kept: a cut at 1 would put a concave kink where the function is steep
_KEPT = 0.5  # share of what exceeds 1 that is kept each step where all around does


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Kick:
    """The noise of one step on the axis of q.

    Attributes
    ----------
    nodes : ndarray, shape (nq, nq)
        Upper bounds of E h_k(q_j + s z) for the hats of inner nodes.
    beyond : ndarray, shape (nq - 1,)
        Upper bounds, on cells, of the probability of ending in the outermost cells or beyond.
    bend : ndarray, shape (nq - 1, nq)
        D_j^2/8 times the largest density on cell j of ending at node k.
    mass, second : ndarray, shape (nq - 1, nq - 1)
        Upper bounds on cell j of P(end in cell k) and of E[z^2; end in cell k], for |z| up to ``most``.
    """

    nodes: Array
    beyond: Array
    bend: Array
    mass: Array
    second: Array
    spans: tuple[tuple[int, int, int, int], ...]

    @staticmethod
    def _flat(part: Array) -> Array:
        return part.reshape(-1, part.shape[-1])

    def apply(self, part: Array, matrix: Array) -> Array:
        """A matrix along the last axis."""
        return across_by(self._flat(part), matrix, self.spans).reshape(*part.shape[:-1], -1)


def kick_of(q: Array, sigma: float, spread: float, most: float) -> Kick:
    """The matrices for N(0, sigma^2), sigma known up to the relative error ``spread``."""
    kernel = axis_kernel(q, q, sigma, spread)
    hats = np.zeros((len(q), len(q)))
    for block in kernel.blocks:
        rows = slice(block.first, block.last)
        part = np.maximum(block.parts["hat"][0], 0.0)
        hats[rows, block.left : block.left + part.shape[1]] += part
        cells = block.mass.shape[1]
        for side in (0, 1):
            hats[rows, block.left + side : block.left + side + cells] += kernel.error * block.mass * (1 + 1e-3)
    hats[:, 0] = hats[:, -1] = 0.0
    s = sigma * (1 + spread)
    beyond = np.array([
        upper_tail((q[-2] - high) / s) + upper_tail((low - q[1]) / s) for low, high in itertools.pairwise(q)
    ])  # fmt: skip
    widths = np.diff(q)
    bend = peak(q[:-1], q[1:], q, q, sigma)[0] * widths[:, None] ** 2 / 8 * (1 + 4 * spread)
    first, last = ((a - b) / sigma for a, b in ((q[:-1, None], q[None, 1:]), (q[1:, None], q[None, :-1])))
    least = np.maximum(np.maximum(first, -last), 0.0) * (1 - 1e-12 - spread)
    far = np.maximum(np.abs(first), np.abs(last)) * (1 + 1e-12 + spread)
    share = widths / (sigma * math.sqrt(2 * math.pi)) * (1 + 2 * spread) * _UP
    near = least <= most
    mass = np.where(near, np.minimum(np.exp(-0.5 * least**2) * share, 1.0), 0.0)
    turn = np.clip(math.sqrt(2.0), least, far)
    second = np.where(near, turn**2 * np.exp(-0.5 * turn**2) * share, 0.0)
    parts = {"nodes": hats * _UP, "bend": bend * _UP, "mass": mass, "second": second * _UP}
    return Kick(beyond=beyond * _UP, spans=spans_of(list(parts.values())), **parts)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Layout:
    """All that an induction needs.

    Attributes
    ----------
    axes : tuple of ndarray
        Nodes along x, y and q.
    level : ndarray, shape (cells)
        0 on cells that lie in the safe set, half a step ahead; else what the function must be at least, 1 or 2.
    reach : ndarray, shape (3,)
        How far Z may be from Zhat.
    sway : (float, float)
        Upper bounds of E|B| and of its standard deviation.
    """

    axes: tuple[Array, Array, Array]
    blocks: Blocks
    images: Images
    kick: Kick
    level: Array
    reach: Array
    sway: tuple[float, float]
    sweep: Array


def terminal(layout: Layout) -> Array:
    """The function at the horizon, half a step ahead: 1 outside of the safe set, falling to 0 over a few cells in it.

    0 would do in all of the safe set; but fronts as steep as cells are dear.
    """
    from scipy.ndimage import maximum_filter1d, uniform_filter1d

    level = around_nodes(layout.level, largest=True)
    found = np.minimum(level, 1.0)
    for axis in (0, 1):
        found = np.asarray(maximum_filter1d(found, 2 * _SOFT - 1, axis=axis, mode="nearest"))
        for _ in range(2):
            found = np.asarray(uniform_filter1d(found, _SOFT, axis=axis, mode="nearest", origin=0))
    return np.maximum(level, np.maximum(found, 0.0))


def back(layout: Layout, value: Array) -> tuple[Array, float]:
    """The function one step earlier, at nodes, and the largest value that was met.

    Proves: if value >= u_{k+1} half a step ahead, and at least the levels, so is what is returned with u_k.
    """
    top = max(2.0, float(value.max())) * _UP
    moved, nearby = _moved(layout, value, top)
    kick = layout.kick
    moved[..., 0] = moved[..., -1] = 0.0  # what ends there counts as beyond
    found = kick.apply(moved, kick.nodes)
    slope = np.diff(moved, axis=2) / np.diff(layout.axes[2])
    bends = np.zeros_like(moved)
    bends[..., 1:-1] = np.maximum(-np.diff(slope, axis=2), 0.0)
    rising = kick.apply(bends, kick.bend) + (kick.beyond + 1e-21) * top
    found[..., 1:-1] += np.maximum(rising[..., 1:], rising[..., :-1])
    found[..., (0, -1)] += rising[..., (0, -1)]
    return _levelled(layout, (found + around_nodes(_left_out(layout, nearby), largest=True)) * _UP), top


def _moved(layout: Layout, value: Array, top: float) -> tuple[Array, Array]:
    """A majorant of V o Phi by its nodes, and slopes of V and prices of delta near the images of cells, (7, cells).

    Off the cells of level 2 a function above u may be cut at 1. A cell whose nodes are raised to at least 1, or to all
    that V is within the reach of the remainder, pays nothing else: that is taken where it is less.
    """
    images, blocks = layout.images, layout.blocks
    slopes, crosses = slopes_of(value, layout.axes), crosses_of(value, layout.axes)
    up, down = kinks_of(value, layout.axes)
    free = near(layout.level, layout.axes, layout.reach) < 2.0
    most = over_corners(np.maximum, value)
    far = [*slopes, np.where(free, np.minimum(most, 1.0), most), 1.0 - free]
    parts = [near(field, layout.axes, layout.reach) for field in far]
    parts += [near(field, layout.axes, layout.sweep) for field in _swung(layout, beside(up), crosses)]
    around = np.stack(parts)
    steep = slopes.max(axis=(1, 2, 3))
    moved = at_images(value, *layout.axes, images.shift, images.radius, images.known, steep, top)
    excess, nearby, lost = over_images(
        *layout.axes, images.shift, images.radius, images.known, blocks.index, blocks.growth, blocks.bends,
        blocks.known, layout.reach, slopes, crosses, down, around, steep,
    )  # fmt: skip
    highest, bound = nearby[3], (nearby[4] > 0) | lost
    cut = np.where(around_nodes(bound.astype(float), largest=True) > 0, moved, np.minimum(moved, _CUT))
    excess += over_corners(np.maximum, moved - cut)
    filled = ~bound & (_lack(cut, np.ones(bound.shape)) < 8 * excess)
    price = sum(nearby[b] * blocks.left[:, b].sum(axis=0).max() for b in range(3))
    flat = ~lost & (_lack(cut, highest) < 8 * (price + np.where(filled, 0.0, excess)))
    least = np.where(lost, top, np.where(flat, highest, np.where(filled, 1.0, 0.0)))
    raised = np.maximum(cut + around_nodes(np.where(flat | filled | lost, 0.0, excess), largest=True),
                        around_nodes(least, largest=True))  # fmt: skip
    return raised, np.where(flat | lost, 0.0, np.delete(nearby, (3, 4), axis=0))


def _lack(nodal: Array, level: Array) -> Array:
    """By how much the eight corners of cells are below a level, together."""
    return np.asarray(np.sum([np.maximum(level - corner, 0.0) for corner in corners(nodal)], axis=0))


def _swung(layout: Layout, kinks: Array, crosses: Array) -> list[Array]:
    """On cells: bounds of E V(z + B d) - V(z) for kinks and cross derivatives as there: over |d_b|, and the rest."""
    swing = layout.blocks.swing.max(axis=(1, 2, 3))
    first, square = layout.sway[0], layout.sway[1] ** 2
    found = [
        (first / 2 + square * swing[b] / float(np.diff(layout.axes[b]).min())) * kinks[b] * _UP for b in range(3)
    ]
    rest = sum(square * swing[b] * swing[e] * crosses[place] for place, (b, e) in enumerate(PAIRS))
    return [*found, np.asarray(rest) * _UP]


def _left_out(layout: Layout, nearby: Array) -> Array:
    """What cells pay for the mean of |Z - Zhat - delta|, and for delta."""
    kick, live = layout.kick, layout.level == 0
    place = np.ix_(*layout.blocks.index)
    total = kick.apply(nearby[6], kick.mass)
    for b in range(3):
        if not layout.blocks.swing[b].any() and not layout.blocks.left[:, b].any():
            continue
        left, second, swing = (part[place] for part in (*layout.blocks.left[:, b], layout.blocks.swing[b]))
        total += left * kick.apply(nearby[b], kick.mass) + second * kick.apply(nearby[b], kick.second)
        total += swing * kick.apply(nearby[3 + b], kick.mass)
    return np.where(live, total, 0.0)


def _levelled(layout: Layout, found: Array) -> Array:
    """The levels where steps say nothing; 1 at nodes all around which the function is at least that."""
    level = around_nodes(layout.level, largest=True)
    live = around_nodes((layout.level == 0).astype(float), largest=True) > 0
    found = np.where(live, np.maximum(found, level), level)
    full = over_corners(np.minimum, found) >= 1.0
    capped = (around_nodes(full.astype(float), largest=False) > 0) & (level <= 1.0)
    return np.where(capped, 1 + _KEPT * (found - 1), found)
