"""One panel a constraint: a linear function of the state with its limits, or a distance, over time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from certbound.arrays import Array
from certbound.plotting.plane import supports
from certbound.plotting.scene import BLUE, GREY, INK, VERMILION, Scene
from certbound.problem.sets import Inside, Quadratic, clearance

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from certbound.problem.problem import Problem
    from certbound.reach.sets import ReachTube


@dataclass(frozen=True, eq=False, kw_only=True)
class Panel:
    """A linear function with limits (``direction``), or the distance to a constraint (``constraint``)."""

    label: str
    direction: Array | None = None
    low: float = -np.inf
    high: float = np.inf
    constraint: Any = None
    during: tuple[float, float] | None = None

    @property
    def limits(self) -> list[float]:
        """Where the constraint is broken: the finite limits, or a distance of 0."""
        return [0.0] if self.direction is None else [end for end in (self.low, self.high) if np.isfinite(end)]

    def values(self, states: Array, times: Array) -> Array:
        """The function along states (..., K, n) at times (K,)."""
        if self.direction is not None:
            return np.asarray(states @ self.direction)
        distances = [clearance(self.constraint, states[..., k, :], None, float(t)) for k, t in enumerate(times)]
        return np.stack(distances, axis=-1)


def panels_of(problem: Problem) -> list[Panel]:
    """Half-spaces that share a direction share a panel; every other constraint has one of its own."""
    found: list[Panel] = []
    for constraint in problem.safe:
        region = constraint.region
        if constraint.outside or region.moving or isinstance(region.form, Quadratic):
            found.append(Panel(label=_distance_label(constraint), constraint=constraint, during=constraint.during))
            continue
        form = region.form
        rows, bounds = region.lifted(form.normals, problem.system.dimension), form.bounds
        for row, b in zip(rows, bounds if region.center is None else bounds + form.normals @ region.center_at()):
            _add_face(found, row, float(b), problem.system.states, constraint.during)
    return found


def _distance_label(constraint: Inside) -> str:
    region = constraint.region
    if region.form.even and not region.moving:
        place = ", ".join(f"{value:g}" for value in region.center_at())
        return f"distance to the ball around ({place})"
    label = str(constraint.label).removeprefix("outside ").removeprefix("inside ")
    return f"distance to {label}" if len(label) < 48 else f"distance to {label[:45]}..."


def _add_face(found: list[Panel], row: Array, bound: float, states: tuple[str, ...], during: Any) -> None:
    upper = row[np.flatnonzero(row)[0]] > 0
    direction = row if upper else -row
    limit: dict[str, Any] = {"high": bound} if upper else {"low": -bound}
    for index, panel in enumerate(found):
        same = panel.direction is not None and np.array_equal(panel.direction, direction) and panel.during == during
        if same and not np.isfinite(panel.high if upper else panel.low):
            found[index] = replace(panel, **limit)
            return
    label = ""
    for value, name in zip(direction, states):
        if value:
            sign = " - " if value < 0 else " + " if label else ""
            label += sign + ("" if abs(value) == 1 else f"{abs(value):g} ") + name
    found.append(Panel(label=label, direction=direction, during=during, **limit))


def draw_panel(axes: Axes, scene: Scene, panel: Panel) -> None:
    """Sample paths, tubes, nominal and limits of one constraint over time."""
    row = panel.direction
    if row is not None:
        for order, (tube, color) in enumerate(scene.tubes):
            x, high = stairs(tube, supports(tube, row))
            _, low = stairs(tube, -supports(tube, -row))
            axes.fill_between(x, low, high, color=color, linewidth=0, zorder=1 + order)
    elif scene.tube is not None and (bound := least_distance(scene.tube, panel.constraint)) is not None:
        axes.plot(*stairs(scene.tube, bound), color=BLUE, linewidth=1.2, zorder=4)
    if scene.paths is not None and scene.times is not None:
        _draw_paths(axes, scene, panel.values(scene.paths, scene.times))
    t, centre = scene.nominal()
    axes.plot(t, panel.values(centre, t), color=INK, linewidth=1.1, zorder=5)
    start, end = panel.during or (0.0, float(scene.problem.horizon))
    for limit in panel.limits:
        axes.plot([start, end], [limit, limit], color=VERMILION, linestyle=(0, (5, 2)), linewidth=1.2, zorder=6)
    axes.set_title(panel.label, loc="left", fontsize=8)
    axes.margins(x=0)
    axes.autoscale_view()


def _draw_paths(axes: Axes, scene: Scene, values: Array) -> None:
    from matplotlib.collections import LineCollection

    segments = [np.stack([np.asarray(scene.times), value], axis=-1) for value in values]
    axes.add_collection(LineCollection(segments, colors=GREY, linewidths=0.4, alpha=0.5, zorder=3))


def least_distance(tube: ReachTube, constraint: Inside) -> Array | None:
    """A lower bound of the distance to a round obstacle, in the middle of each piece."""
    region = constraint.region
    if not isinstance(region.form, Quadratic) or not region.form.even or not constraint.outside:
        return None
    where = region.places(tube.curve.dimension)
    middles = tube.curve.middles
    states = np.stack([tube.curve.value(float(t)) for t in middles], axis=1)
    offsets = states[..., where] - np.stack([region.center_at(float(t)) for t in middles])
    lengths = np.linalg.norm(offsets, axis=-1)
    rows = np.zeros(states.shape)
    rows[..., where] = offsets / lengths[..., None]
    return np.asarray((lengths - region.form.radius - tube.spread(-rows)).min(axis=0))


def stairs(tube: ReachTube, values: Array) -> tuple[Array, Array]:
    """Piecewise-constant data as a polyline."""
    if not tube.curve.continuous:
        return np.asarray(tube.curve.starts), values
    return np.stack([tube.curve.starts, tube.curve.ends], axis=1).ravel(), np.repeat(values, 2)
