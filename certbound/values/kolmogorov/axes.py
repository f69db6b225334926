"""Graded axes: cells that are small where the solution varies, by the scales of the equation.

- Inside, a cell is a share of the range that paths visit; beyond the range cells grow.
- Toward a limit that noise crosses cells are small: the solution has layers there, of width a / (2 |f_n|) where the
  flow leads away from it, and of width sqrt(a tau) a time tau before the end.
- Toward a noise-free limit, paths graze it where the flow across, c v, changes its sign. Noise smooths what grazing
  leaves over the distance c v_0^3 / a, where v_0 is the cell about v = 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from certbound.arrays import Array
from certbound.values.kolmogorov.box_setting import Setting

_FINE = 100001  # points on which an axis is planned
_ALONG = 41  # points along each axis of a face
_BEYOND, _WIDEST = 0.35, 4.0  # growth of cells beyond the range, and their largest size there
_TO_LIMIT, _TO_FREE, _ABOUT = 0.25, 0.3, 0.12  # growth away from noisy limits, noise-free limits, grazing points
_TYPICAL = 0.35  # of the speed at one cell's distance from a grazing point: that of what is killed there
_FEWEST, _FEWEST_AMONG = 8, 2  # cells between places at which nodes have to stand, and at which they serve shapes
_APART = 0.5  # of a cell: a node nearer than that to another serves nobody
_SMALLEST = 0.15  # of an inner cell, where a limit is due
_AT_LIMIT = 0.15  # of an inner cell, at noisy limits

Size = Callable[[Array], Array]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Grazing:
    """Where paths graze a noise-free limit: the face, the speed of a typical cell, and the scale across."""

    axis: int
    side: int
    speed: float
    scale: float


Plan = tuple[list[Array], list[Grazing]]
"""Nodes of each axis, and where paths graze."""


def plan_axes(stages: Sequence[Setting], cell: Array, row: int, shapes: Sequence[Size] = ()) -> list[Plan]:
    """Nodes of each axis, and where paths graze, for each stage; stages have the nodes in common that both hold.

    ``cell`` holds a share of the range for each axis; ``row`` says which ends of the box are meant (0: the inner ones).
    With ``shapes``, a width at every place of each axis, cells follow these but where paths graze.
    """
    planned = [_sizes(one, cell, row, shapes) for one in stages]
    lines = []
    for i in range(stages[0].dimension):
        ends = [float(end) for one in stages for rows in (one.low, one.high, one.due_low, one.due_high)
                for end in rows[row, i : i + 1] if np.isfinite(end)]  # fmt: skip
        ends += [float(end) for one in stages if one.target is not None for end in one.target[:, row, i]]
        cuts = np.unique([end for end in ends if np.isfinite(end)])
        cuts = cuts[(cuts >= min(float(one.low[row, i]) for one in stages))
                    & (cuts <= max(float(one.high[row, i]) for one in stages))]  # fmt: skip
        sizes = [size for own, _ in planned for size in own[i]]
        places = stages[0].places[i]
        cuts, fewest = _with_places(cuts, places, sizes), _FEWEST_AMONG if places else _FEWEST
        parts = [_nodes(low, high, sizes, fewest) for low, high in pairwise(cuts)]
        lines.append(np.unique(np.concatenate(parts)))
    return [
        ([line[(line >= one.low[row, i]) & (line <= one.high[row, i])] for i, line in enumerate(lines)], grazing)
        for one, (_, grazing) in zip(stages, planned)
    ]  # fmt: skip


def _sizes(
    setting: Setting, cell: Array, row: int, shapes: Sequence[Size]
) -> tuple[list[list[Size]], list[Grazing]]:  # fmt: skip
    """What cells along each axis are to be, and where paths graze."""
    low, high = setting.low[row], setting.high[row]
    width = setting.range[1] - setting.range[0]
    cell = np.broadcast_to(cell, width.shape)
    n = setting.dimension
    sizes: list[list[Size]] = [[_inner(cell[i] * width[i], *setting.range[:, i])] for i in range(n)]
    if shapes:
        sizes = [[shape] for shape in shapes]
    grazing: list[Grazing] = []
    for i in range(n):
        for side, place in enumerate((low[i], high[i])):
            if not setting.limited[side, i]:
                continue
            if setting.noisy[i] and not shapes:
                sizes[i].append(_toward(place, _AT_LIMIT * cell[i] * width[i]))
            points = _face(setting, low, high, i, place)
            for time in setting.moments(i):
                f, a = setting.flow(points, time)[i], setting.spread(points, time).reshape(n, n, *points.shape[1:])
                if not setting.noisy[i]:
                    grazing += _graze(setting, points, f, a, i, side, cell * width, sizes, place, time)
        for place in (setting.due_low[row, i], setting.due_high[row, i]):
            if np.isfinite(place):
                sizes[i].append(_toward(float(place), _SMALLEST * cell[i] * width[i]))
    return sizes, grazing


def _inner(size: float, low: float, high: float) -> Size:
    return lambda y: size * np.minimum(1 + _BEYOND * np.maximum(0, np.maximum(low - y, y - high)) / size, _WIDEST)


def _toward(place: float, smallest: float, growth: float = _TO_LIMIT) -> Size:
    return lambda y: smallest + growth * np.abs(y - place)


def _face(setting: Setting, low: Array, high: Array, axis: int, place: float) -> Array:
    """Points of a face within the range of the other coordinates, shape (n, points)."""
    n = setting.dimension
    lines = [np.linspace(max(low[k], setting.range[0, k]), min(high[k], setting.range[1, k]), _ALONG) for k in range(n)]
    lines[axis] = np.array([place])
    return np.array([m.ravel() for m in np.meshgrid(*lines, indexing="ij")])


def _graze(
    setting: Setting, points: Array, f: Array, a: Array, axis: int, side: int, cells: Array, sizes: list[list[Size]],
    place: float, time: float,
) -> list[Grazing]:  # fmt: skip
    """Refine toward a noise-free limit and about the surface on it where the flow turns."""
    if not f.min() < 0 < f.max():
        return []
    n = setting.dimension
    near = np.abs(f) <= np.quantile(np.abs(f), max(0.03, 2.0 / len(f)))
    chosen = points[:, near]
    slopes = np.zeros((n, chosen.shape[1]))
    for k in range(n):
        if k != axis:
            moved = chosen.copy()
            moved[k] += 1e-5 * cells[k]
            slopes[k] = (setting.flow(moved, time)[axis] - setting.flow(chosen, time)[axis]) / (1e-5 * cells[k])
    mean = np.abs(slopes).mean(axis=1)
    noise = float(np.mean(np.einsum("ip,ijp,jp->p", slopes, a[:, :, near], slopes)))
    speed = _TYPICAL * float(np.max(mean * cells))
    if speed <= 0:
        return []
    scale = float(np.clip(speed**3 / max(noise, 1e-300), 1e-6 * cells[axis], 0.5 * cells[axis]))
    sizes[axis].append(_toward(place, scale, _TO_FREE))
    steep = np.flatnonzero(mean > 1e-9 * mean.max())
    if len(steep) == 1:
        k = int(steep[0])
        middle = float(np.mean(chosen[k] - f[near] / slopes[k]))
        sizes[k].append(_toward(middle, speed / mean[k], _ABOUT))
    return [Grazing(axis=axis, side=side, speed=speed, scale=scale)]


def _with_places(cuts: Array, places: Sequence[float], sizes: list[Size]) -> Array:
    """Cuts, and those places among them that stand about a cell off all others."""
    for place in places:
        cell = min(float(size(np.array([place]))[0]) for size in sizes)
        if cuts[0] < place < cuts[-1] and np.abs(cuts - place).min() > _APART * cell:
            cuts = np.sort(np.append(cuts, place))
    return cuts


def _nodes(low: float, high: float, sizes: list[Size], fewest: int) -> Array:
    """Nodes whose distances follow the least of the sizes."""
    y = np.linspace(low, high, _FINE)
    density = 1 / np.min([size(y) for size in sizes], axis=0)
    count = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2 * (y[1] - y[0]))])
    cells = max(int(np.ceil(count[-1])), fewest)
    nodes = np.interp(np.linspace(0, count[-1], cells + 1), count, y)
    nodes[0], nodes[-1] = low, high
    return nodes
