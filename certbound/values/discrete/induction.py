"""Backward induction: one function above, one below the probability of failing from every state at every step.

With V_t(x) the largest probability, over the disturbances, of failing from x at step t on,
    V_T = 1 off S_T and 0 on it,  V_t = 1 off S_t,  V_t(x) = sup_d E V_{t+1}(f(t, x, d) + G w) on S_t.
Above: U_t is 1 outside the grid and on every cell that is not surely safe, and at least sup_d phi elsewhere; below: the
grid contains S_t, U_t is 1 on cells that are surely unsafe, and at most phi for one disturbance a cell elsewhere (V_t
is at least that everywhere). Over cells on which f may jump U_t is a constant that does so (`_across`). A target G_t
that ends the danger puts 0 on its cells, and 1 on the others at step T.

A target that must be stayed in: W_t, the probability of failing of who has arrived, comes by the same induction with
every step off G_t unsafe, and V_t = W_t on G_t, W_t >= V_t elsewhere. V_{t+1} jumps there, so that it is given as a sum
of two functions, each 0 on the other's cells; means are sums, and so are their bounds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from certbound.arrays import Array, Mask
from certbound.problem.sets import Inside, Region
from certbound.values.discrete.cubic import CubicTransition
from certbound.values.discrete.functions import ValueFunction
from certbound.values.discrete.scaled import ScaledTransition
from certbound.values.discrete.transitions import Transition, Windows
from certbound.values.discrete.uniform_noise import UniformTransition
from certbound.values.grids import Grid, around_nodes, corners
from certbound.values.sets import contains, respected

AnyTransition = Transition | CubicTransition | UniformTransition | ScaledTransition
Parts = tuple[ValueFunction, ...]
"""Functions whose sum is meant."""

_STEEPEST = 0.5
"""Largest bend times width^2/8 that a cell keeps; beyond it the cell is constant."""
_SUM = 1e-15  # what the sum of a few numbers may be off, of the larger ones of which none is far below 0


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Zones:
    """Which cells of a grid are surely safe, surely unsafe, surely in the target, surely outside it."""

    safe: Mask
    unsafe: Mask
    done: Mask
    undone: Mask
    has_target: bool


def zones_of(
    grid: Grid, constraints: Sequence[Inside], target: Region | None, step: int, *, ends: bool = True
) -> Zones:
    """The zones of a grid at a step, given the constraints active then; faces of cells do not count.

    A target that does not end the danger yet (not ``ends``) has no cell.
    """
    cells = grid.cells()
    safe, unsafe = respected(constraints, cells, step, interiors=True)
    done = np.zeros(len(cells), dtype=bool)
    undone = ~done
    if target is not None and ends:
        done, undone = contains(target, cells, step, interiors=True)
    masks = (mask.reshape(grid.shape) for mask in (safe, unsafe, done, undone))
    return Zones(**dict(zip(("safe", "unsafe", "done", "undone"), masks)), has_target=target is not None)


def final(grid: Grid, zones: Zones, *, above: bool, beyond: float = 1.0) -> ValueFunction:
    """The function at the horizon; ``beyond`` the grid it is 1, or 0 where paths end there."""
    if above:
        level = np.where(zones.safe & (zones.done | (not zones.has_target)), 0.0, 1.0)
        fixed = level > 0
    else:
        level = np.where(zones.unsafe, 1.0, 0.0)
        if zones.has_target:
            level = np.where(zones.undone, 1.0, level)
        fixed = level > 0
    return assembled(grid, np.zeros(grid.node_shape), np.zeros((grid.dimension, *grid.shape)), fixed, level, beyond)


def back_above(transition: AnyTransition, value: ValueFunction, zones: Zones, *more: ValueFunction) -> ValueFunction:
    """A function at least V_t, given one that is at least V_{t+1}, or several whose sum is."""
    if isinstance(transition, CubicTransition):
        return transition.back(value, above=True)
    grid = transition.step.grid
    nodal, bend, known, level = values_above(transition, value, *more)
    fixed, level = ~zones.safe | ~known, np.where(zones.safe, level, 1.0)
    if zones.has_target:
        ended = zones.done & zones.safe
        fixed, level = fixed | ended, np.where(ended, 0.0, level)
    return assembled(grid, nodal, bend, fixed, level, value.beyond)


def values_above(transition: AnyTransition, *values: ValueFunction) -> tuple[Array, Array, Mask, Array]:
    """Node values, bends and the cells on which they lie above sup_d phi, phi the mean of the sum of some functions.

    Last a constant on every cell that is at least min(sup_d phi, 1) on all others.
    """
    most: list[Array] = []
    bend, bump, known, level = np.zeros(1), np.zeros(1), np.ones(1, dtype=bool), np.zeros(1)
    for value in values:
        field: Any = transition.tables.field(value)
        each = [at + error for at, error in transition.at_nodes(field)]
        most = [a + b for a, b in zip(most, each, strict=True)] if most else each
        more, raised, sure = _bends(transition, field, above=True)
        bend, bump, known = bend + more, bump + raised, known & sure
        level = level + _across(transition, field, above=True)
    nodal = np.maximum.reduce(most) + bump
    if len(values) > 1:
        nodal, bend = nodal + _SUM * np.abs(nodal), bend - _SUM * np.abs(bend)
    nodal, holes = _without_holes(nodal, 1.0)
    return nodal, bend, known & ~holes, np.clip(level + _SUM * np.abs(level), 0.0, 1.0)


def nodes_below(transition: AnyTransition, *values: ValueFunction, **options: Any) -> list[Array]:
    """Node values at most phi, one array for each disturbance that is tried."""
    return _least_at_nodes(transition, [transition.tables.field(value, **options) for value in values])


def _least_at_nodes(transition: AnyTransition, fields: list[Any]) -> list[Array]:
    found: list[Array] = []
    for field in fields:
        least = [at - error for at, error in transition.at_nodes(field)]
        found = [a + b - _SUM * np.abs(a + b) for a, b in zip(found, least, strict=True)] if found else least
    return found


def back_below(transition: AnyTransition, value: ValueFunction, zones: Zones, *more: ValueFunction) -> ValueFunction:
    """A function at most V_t, given one that is at most V_{t+1}, or several whose sum is."""
    if isinstance(transition, CubicTransition):
        return transition.back(value, above=False)
    grid = transition.step.grid
    fields: list[Any] = [transition.tables.field(one) for one in (value, *more)]
    options = _least_at_nodes(transition, fields)
    nodal = options[0] if len(options) == 1 else _policy(options)
    bends = [_bends(transition, field, above=False) for field in fields]
    bend, known = np.sum([found[0] for found in bends], axis=0), np.all([found[2] for found in bends], axis=0)
    bend = bend + _SUM * np.abs(bend) if more else bend
    nodal, holes = _without_holes(nodal, 0.0)
    fixed = zones.unsafe | ~known | holes
    least = np.sum([_across(transition, field, above=False) for field in fields], axis=0)
    level = np.where(zones.unsafe, 1.0, np.clip(least - _SUM * np.abs(least), 0.0, 1.0))
    if zones.has_target:
        maybe = ~zones.undone & ~zones.unsafe
        fixed, level = fixed | maybe, np.where(maybe, 0.0, level)
    return assembled(grid, nodal, bend, fixed, level, value.beyond)


def jointly(value: ValueFunction, arrived: ValueFunction, cells: Mask) -> Parts:
    """The function that is ``arrived`` on some cells and ``value`` on all others and beyond the grid, in two parts."""
    return _cleared(value, cells, value.beyond), _cleared(arrived, ~cells, 0.0)


def _cleared(value: ValueFunction, cells: Mask, beyond: float) -> ValueFunction:
    """The function, with 0 on some cells."""
    before = np.zeros(value.grid.shape, dtype=bool) if value.fixed is None else value.fixed
    level = np.where(cells, 0.0, value.level)
    return assembled(value.grid, value.nodal, value.bend, before | cells, level, beyond)


def _policy(options: list[Array]) -> Array:
    """Node values below phi under one disturbance a cell: the vertex that is best at the cell's corners."""
    finite = [np.where(np.isfinite(option), option, -1e300) for option in options]
    score = [sum(corners(option)) for option in finite]
    choice = np.argmax(np.stack(score), axis=0)
    nodal = np.full(options[0].shape, np.inf)
    for k, option in enumerate(finite):
        nodal = np.minimum(nodal, np.where(around_nodes((choice == k).astype(float), largest=True) > 0, option, np.inf))
    return np.where(nodal < -1e299, -np.inf, nodal)


def _bends(transition: AnyTransition, field: Any, *, above: bool) -> tuple[Array, Array, Mask]:
    """b per axis and cell, what disturbances between vertices add at the nodes, and where all of it is known."""
    grid, n = transition.step.grid, transition.n
    extra = transition.step.pieces.shape[1]
    found: list[list[Array]] = transition.bends(field, range(n + (extra if above else 0)), above=above)
    merge = np.minimum if above else np.maximum
    bend = np.stack([merge.reduce([box[i] for box in found]).reshape(grid.shape) for i in range(n)])
    steep = sum(np.abs(bend[i]) * grid.widths(i) ** 2 / 8 for i in range(n))
    known = np.all([images.steady for images in transition.step.cells], axis=0).reshape(grid.shape)
    known &= np.asarray(steep < _STEEPEST)
    bump = np.zeros(grid.node_shape)
    if above and extra:
        raised = np.zeros(grid.shape)
        for box, width in zip(found, transition.step.pieces):
            more = sum(np.maximum(-box[n + k], 0.0) * width[k] ** 2 / 8 for k in range(extra))
            raised = np.maximum(raised, np.reshape(more, grid.shape) * (1 + 1e-12))
        bump = around_nodes(raised, largest=False)
    return np.where(known, bend, 0.0), bump, known


def _across(transition: AnyTransition, field: Any, *, above: bool) -> Array:
    """A constant above (below) sup_d phi on every cell over which f may jump, or has no slope; else 1 (0).

    On such a cell phi lies between the least and the largest h over the range of f there, which holds both sides of a
    jump and all that lies between them; from below one box of disturbances is enough. Nothing is known of h beyond the
    mesh.
    """
    grid, cells, unknown = transition.step.grid, transition.step.cells, 1.0 if above else 0.0
    rough = np.flatnonzero(~np.all([images.steady for images in cells], axis=0))
    level = np.full(math.prod(grid.shape), unknown)
    if len(rough) and not isinstance(transition, ScaledTransition | CubicTransition):
        mesh, (low, high) = transition.tables.mesh, transition.ranges(field)
        last, found = mesh.start + mesh.step * (np.array(mesh.count) - 1), []
        for images in (images.ranges_of(rough) for images in cells):
            ends = Windows(images, transition.tables).extreme(high if above else low, largest=above)
            inside = np.all((images.image.lo >= mesh.start) & (images.image.hi <= last), axis=1)
            found.append(np.where(images.defined & inside & np.isfinite(ends), ends, unknown))
        level[rough] = np.maximum.reduce(found)
    return level.reshape(grid.shape)


def _without_holes(nodal: Array, filling: float) -> tuple[Array, Mask]:
    """Finite node values, and the cells that touch a node without one."""
    bad = ~np.isfinite(nodal)
    if not bad.any():
        return nodal, np.zeros([size - 1 for size in nodal.shape], dtype=bool)
    return np.where(bad, filling, nodal), np.logical_or.reduce(corners(bad))


def assembled(
    grid: Grid, nodal: Array, bend: Array, fixed: Mask, level: Array, beyond: float
) -> ValueFunction:
    """Cells that are not fixed keep their bends; nodes that only fixed cells use take their level."""
    if not fixed.any():
        return ValueFunction(grid=grid, nodal=nodal, bend=bend, fixed=None, level=level, beyond=beyond)
    bend = np.where(fixed, 0.0, bend)
    level = np.where(fixed, level, 0.0)
    lonely = around_nodes((~fixed).astype(float), largest=True) <= 0
    nodal = np.where(lonely, np.clip(around_nodes(level, largest=True), 0.0, 1.0), nodal)
    return ValueFunction(grid=grid, nodal=nodal, bend=bend, fixed=fixed, level=level, beyond=beyond)
