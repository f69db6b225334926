"""Grids on which the backward equation is solved: the nodes of a box, and of some cells beyond its limits.

A solution falls to 0 beyond limits that paths cross, softly where a cell does not resolve how it falls: paths are
killed at a rate beyond noise-free limits, and those that are carried beyond noisy ones as well. What is soft here is
paid later: nothing here is trusted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy.sparse as sp

from certbound.arrays import Array, Mask
from certbound.problem.sets import Inside
from certbound.values.kolmogorov.axes import Grazing
from certbound.values.kolmogorov.box_setting import Setting
from certbound.values.kolmogorov.equation.changing import ChangingEquation
from certbound.values.kolmogorov.equation.ghost_nodes import Ghosts, ghosts_of
from certbound.values.kolmogorov.equation.solve import SOLVED, Discretised, discretised
from certbound.values.kolmogorov.failed_cells import depth_of

DEEP = 3.0
"""Cells over which paths are killed, or arrive, at sets within the box."""

_AROUND = 5  # cells beyond a box around a safe set of another shape: a solution that falls to 0 at the box's end rings
_STIFF = 10.0  # how much faster than paths leave a cell nodes beyond an edge follow
_SOFT = 3.0  # widths and speeds of a bump of killing, in units of a grazing point's
_KILL = 10.0  # how much faster than paths cross the cells beyond a limit they are killed there
_FOLDS = 1.0, 3.0  # powers of e by which a solution may fall within a cell at a limit, and may not: where it falls
# by more, exits are not counted from below (v of Lorenz' model .31 with 6 and 12, .045 with these, failing -.028)


def ramp(y: Array) -> Array:
    """A C^2 step from 0 at 0 to 1 at 1."""
    z = np.clip(y, 0, 1)
    return np.asarray(z**3 * (10 - 15 * z + 6 * z * z))


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Mesh:
    """Nodes of a box, and beyond its limits by ``pad`` cells (lower and upper ends of each axis).

    ``inside`` holds the points of the box nearest to the nodes; ``layer`` is the survival at the end that faces allow,
    ``falls`` the share of it that limits take within the end layer, less where the flow is so strong against paths that
    the grid does not resolve their layer: no exits need be counted there. ``arrival`` is the rate of arriving in the
    target, ``leaving`` that of leaving the cells about a node. ``ghosts`` are nodes
    beyond shapes.
    """

    nodes: tuple[Array, ...]
    pad: tuple[tuple[int, int], ...]
    inside: Array
    equation: Discretised | ChangingEquation
    layer: Array
    falls: Array
    rate: Array
    arrival: Array | float
    leaving: Array
    ghosts: Ghosts | None


def extended(nodes: Array, before: int, behind: int) -> Array:
    """The nodes, and their mirror images beyond both ends."""
    return np.pad(nodes, (before, behind), mode="reflect", reflect_type="odd")


def mesh_of(
    setting: Setting, nodes: Sequence[Array], grazing: Sequence[Grazing], row: int, *, pad: tuple[int, int],
    kill: bool = False, span: float, fresh: Mask, early: bool = False, solved: float = SOLVED,
    failed: Mask | None = None, shaped: bool = False,
) -> Mesh:  # fmt: skip
    """A grid with its equation.

    Parameters
    ----------
    setting : Setting
    nodes : sequence of ndarray
    grazing : sequence of Grazing
        Where paths graze noise-free limits.
    row : int
        Which ends of the box are meant (0: the inner ones).
    pad : (int, int)
        Cells beyond noise-free limits that paths graze, and beyond noisy ones.
    kill : bool
        Whether paths are killed about the places where they graze limits.
    span : float
        The length of the layer at the end, in units of time.
    fresh : ndarray of bool, shape (2, n)
        Which ends are none of the stage after this.
    early : bool
        Whether paths arrive in some cells before the target, or in its first cells.
    solved : float
        Relative residual at which a system counts as solved.
    failed : ndarray of bool, optional
        Cells in which paths are killed.
    shaped : bool
        Whether solutions have a given value on the edges of shapes.
    """
    box = _Box(setting, nodes, {(one.axis, one.side) for one in grazing}, row, pad)
    dead, falls, layer = box.at_ends(span, fresh)
    rate = box.killed_beyond()
    for one in grazing:
        rate += box.killed_about(one, kill)
    if failed is not None and failed.any():
        within = ramp(depth_of(_padded(failed, box.pads, setting.around)) / DEEP)
        rate += _KILL * _leaving(box.lines, box.size, box.noise, DEEP) * within
    flow, spread, ghosts, more = box.flow, box.spread, None, None
    if shaped and setting.shapes:
        ghosts = ghosts_of(box.lines, partial(_within, setting.shapes))
        stiff = _STIFF * _leaving(box.lines, box.size, box.noise)
        more = sp.diags_array(stiff.ravel()) @ ghosts.matrix
        flow, spread = flow * ~ghosts.nodes, spread * ~ghosts.nodes
        dead &= ~ghosts.nodes
        rate = np.where(ghosts.nodes, stiff, rate)
    arrival: Array | float = 0.0
    layer[dead] = 0
    if setting.target is not None:
        depth = _depth(setting.target[:, row], box.lines, box.points)
        there = ramp(1 + depth if early else depth)
        arrival = _KILL * _leaving(box.lines, box.size, box.noise, DEEP) * there
        rate += arrival
        layer += (1 - layer) * there
        falls *= 1 - there
    equation: Discretised | ChangingEquation = (
        ChangingEquation(box.lines, dead, rate, setting.noisy, more) if setting.changing
        else discretised(box.lines, flow, spread, dead, rate, solved, more)
    )  # fmt: skip
    return Mesh(
        nodes=box.lines, pad=box.pads, inside=box.inside, equation=equation, layer=layer, falls=falls, rate=rate,
        arrival=arrival, leaving=_leaving(box.lines, box.size, box.noise), ghosts=ghosts,
    )  # fmt: skip


class _Box:
    """Nodes of a box and beyond it, and the coefficients there: those of the nearest points of the box."""

    def __init__(
        self, setting: Setting, nodes: Sequence[Array], free: set[tuple[int, int]], row: int, pad: tuple[int, int]
    ) -> None:
        n = setting.dimension
        self.setting, self.free = setting, free
        self.edges = setting.low[row], setting.high[row]
        least = np.where(setting.around, _AROUND, 0)
        own = [[max(pad[(i, side) not in free], int(least[side, i])) for side in (0, 1)] for i in range(n)]
        self.pads = tuple((before, behind) for before, behind in own)
        self.lines = tuple(extended(nodes[i], *self.pads[i]) for i in range(n))
        self.points = np.array(np.meshgrid(*self.lines, indexing="ij"))
        self.shape = self.points.shape[1:]
        low, high = (edge.reshape(-1, *[1] * n) for edge in self.edges)
        self.inside = np.clip(self.points, low, high)
        self.flow, self.spread = setting.flow(self.inside), setting.spread(self.inside).reshape(n, n, *self.shape)
        self.least, self.most, self.noise = (
            _extremes(setting, self.inside, self.flow, self.spread) if setting.changing
            else (self.flow, self.flow, self.spread)
        )  # fmt: skip
        self.size = np.maximum(self.most, -self.least)

    def at_ends(self, span: float, fresh: Mask) -> tuple[Mask, Array, Array]:
        """Nodes whose values are given; the share that falls there; the survival at the end that ends allow."""
        n, setting = self.setting.dimension, self.setting
        dead, falls, layer = np.zeros(self.shape, bool), np.zeros(self.shape), np.ones(self.shape)
        for i in range(n):
            for side, place in ((0, 0), (1, self.shape[i] - 1)):
                face = tuple(place if k == i else slice(None) for k in range(n))
                out = self.most[i][face] if side else -self.least[i][face]
                noise, line = self.noise[i, i][face], self.lines[i]
                leaves = (noise > 0) | (out >= 0)
                gap = abs(line[place] - line[1 if side == 0 else -2])
                resolved = 1 - _unresolved(-out, gap, noise) if setting.noisy[i] else np.ones(leaves.shape)
                dead[face] |= leaves
                falls[face] = np.maximum(falls[face], leaves * float(setting.limited[side, i]) * resolved)
                if fresh[side, i]:
                    width = np.sqrt(max(noise.max(), 0.0) * span) or np.maximum(out, 0).mean() * span
                    third = abs(line[place] - line[3 if side == 0 else -4])
                    layer = layer * ramp(np.abs(self.points[i] - line[place]) / max(width, third))
        return dead, falls, layer

    def killed_beyond(self) -> Array:
        """Rates of killing beyond limits that paths do not graze."""
        rate = np.zeros(self.shape)
        for i in range(self.setting.dimension):
            for side in (0, 1):
                if self.pads[i][side] and (i, side) not in self.free:
                    out, beyond = self._beyond(i, side)
                    rate += _KILL * (self.size[i] / beyond + self.noise[i, i] / beyond**2) * ramp(out / beyond)
        return rate

    def killed_about(self, one: Grazing, kill: bool) -> Array:
        """Rates of killing beyond a limit that paths graze, and softly about the place where they do."""
        out, beyond = self._beyond(one.axis, one.side)
        rate = np.zeros(self.shape)
        if self.pads[one.axis][one.side]:
            rate += _KILL * self.size[one.axis].max() / beyond * ramp(out / beyond)
        if kill:
            slowest = np.clip(0, self.least[one.axis], self.most[one.axis])
            width = (0.3 * _SOFT**3 + 2) * one.scale
            rate += 3 * _SOFT * one.speed / width * _bump(out / width) * _bump(slowest / (_SOFT * one.speed))
        return rate

    def _beyond(self, axis: int, side: int) -> tuple[Array, float]:
        """How far nodes lie beyond an end of the box, and how far the last ones do."""
        edge = self.edges[side][axis]
        return (2 * side - 1) * (self.points[axis] - edge), abs(self.lines[axis][-1 if side else 0] - edge)


def _unresolved(against: Array, gap: Array | float, noise: Array) -> Array:
    """How little cells of width ``gap`` resolve the layer that flow against paths leaves at a limit, from 0 to 1.

    Failing falls by e in it over noise / (2 flow).
    """
    folds = 2 * np.maximum(against, 0) * gap / (noise + 1e-300)
    return ramp((folds - _FOLDS[0]) / (_FOLDS[1] - _FOLDS[0]))


def _depth(target: Array, lines: tuple[Array, ...], points: Array) -> Array:
    """How deep nodes lie in the target, in units of three cells at its faces, negative before it.

    Where it reaches beyond the grid it has no face.
    """
    depth = np.full(points.shape[1:], np.inf)
    for i, line in enumerate(lines):
        for side in (0, 1):
            end = target[side, i]
            if line[0] < end < line[-1]:
                place = int(np.clip(np.searchsorted(line, end), 3, len(line) - 4))
                cells = (line[place + 3] - line[place - 3]) / 2
                depth = np.minimum(depth, (1 - 2 * side) * (points[i] - end) / cells)
            elif (end >= line[-1]) != bool(side):
                depth = np.full_like(depth, -np.inf)
    return depth


def _extremes(setting: Setting, points: Array, flow: Array, spread: Array) -> tuple[Array, Array, Array]:
    """Least and largest f and largest a over moments and disturbances."""
    least, most, noise = flow, flow, spread
    for time in setting.moments():
        for acting in setting.nodes:
            one = setting.flow(points, time, acting)
            least, most = np.minimum(least, one), np.maximum(most, one)
        noise = np.maximum(noise, setting.spread(points, time).reshape(spread.shape))
    return least, most, noise


def _leaving(lines: tuple[Array, ...], size: Array, noise: Array, cells: float = 1.0) -> Array:
    """Rates of leaving some cells about each node."""
    rate = np.zeros(size.shape[1:])
    for i, line in enumerate(lines):
        width = cells * np.gradient(line).reshape([-1 if k == i else 1 for k in range(len(lines))])
        rate += size[i] / width + noise[i, i] / width**2
    return rate


def _padded(failed: Mask, pads: Sequence[tuple[int, int]], around: Array) -> Mask:
    """Cells that have failed, and all beyond the ends of a box around a safe set."""
    result = np.pad(failed, pads, mode="edge")
    for k, (before, behind) in enumerate(pads):
        line = np.moveaxis(result, k, 0)
        line[:before] |= around[0, k]
        line[len(line) - behind :] |= around[1, k]
    return result


def _within(shapes: Sequence[Inside], points: Array) -> Mask:
    return np.asarray(np.logical_and.reduce([shape.satisfied(points) for shape in shapes]))


def _bump(y: Array) -> Array:
    return np.asarray(np.exp(-y * y / 2))


__all__ = ["DEEP", "Mesh", "extended", "mesh_of", "ramp"]
