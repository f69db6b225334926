"""Sweeps as pictures: bounds over one parameter, a map over two, or the boundary of what is SAFE."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from certbound.arrays import Array
from certbound.plotting.scene import BLUE, INK, VERMILION
from certbound.plotting.value_maps import BORDER, DEEPEST, TIMES, outline_of
from certbound.safety.sweeps import Sweep

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PANELS = 12
_TICKS = 8
_MARKS = {"SAFE": ("o", BLUE), "UNKNOWN": ("s", INK)}
_LEAST = -300.0


def draw_sweep(sweep: Sweep) -> Figure:
    """Draw a sweep: curves, maps of two parameters for each choice of the others, or the boundary.

    ValueError where there are more choices of the others than can be looked at.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    style: Any = {"font.size": 8, "hatch.linewidth": 0.6, "axes.spines.top": False, "axes.spines.right": False}
    with mpl.rc_context(style):
        others = [] if sweep.boundaries is not None else list(_others(sweep))
        if len(others) > _PANELS:
            raise ValueError(f"a picture shows at most {_PANELS} maps, got {len(others)}; vary fewer parameters.")
        count = max(len(others), 1)
        wide = min(count, 3)
        high = -(-count // wide)
        figure = Figure(figsize=(2.0 + 3.4 * wide, 1.2 + 3.0 * high), layout="constrained")
        grid = figure.subplots(high, wide, squeeze=False).ravel()
        for axes, fixed in itertools.zip_longest(grid, others or [{}]):
            if fixed is None:
                axes.set_axis_off()
                continue
            mesh = draw_sweep_into(axes, sweep, fixed)
            axes.set_title(", ".join(f"{name} = {value:.4g}" for name, value in fixed.items()), loc="left", fontsize=8)
        if mesh is not None:
            bar = figure.colorbar(mesh, ax=list(grid), extend="min", fraction=0.05, aspect=30, pad=0.02)
            bar.set_label("log10 of P(leaving), at most")
        figure.suptitle(sweep.summary(), fontsize=9)
    return figure


def _others(sweep: Sweep) -> Iterator[dict[str, float]]:
    names = list(sweep.over)[:-2]
    for values in itertools.product(*(sweep.over[name] for name in names)):
        yield dict(zip(names, values, strict=True))


def draw_sweep_into(axes: Axes, sweep: Sweep, fixed: dict[str, float] | None = None) -> Any:
    """Draw a sweep into axes, at ``fixed`` values of all parameters but the last two; the colours' mappable, if any.

    ValueError where it has more than two parameters and the others are not fixed.
    """
    if sweep.boundaries is not None:
        _draw_boundary(axes, sweep)
        return None
    if len(sweep.over) - len(fixed or {}) > 2:
        raise ValueError(f"axes show two parameters, got {', '.join(sweep.over)}; `certbound sweep --plot` draws maps.")
    if len(sweep.over) == 1:
        _draw_curve(axes, sweep)
        return None
    return _draw_map(axes, sweep, fixed or {})


def _draw_curve(axes: Axes, sweep: Sweep) -> None:
    (name,) = sweep.over
    rows = [row for row in sweep.points if row.status != "FAILED"]
    x = [row.parameters[name] for row in rows]
    axes.plot(x, [10.0 ** max(row.log10_delta, _LEAST) for row in rows], color=BLUE, linewidth=1.0)
    for status in dict.fromkeys(row.status for row in rows):
        mark, colour = _MARKS.get(status, ("X", VERMILION))
        chosen = [(row.parameters[name], 10.0 ** max(row.log10_delta, _LEAST)) for row in rows if row.status == status]
        axes.plot(*zip(*chosen), mark, color=colour, markersize=4, label=status)
    lower = [(row.parameters[name], 10.0**row.log10_lower) for row in rows if row.log10_lower is not None]
    if lower:
        axes.plot(*zip(*lower), color=BLUE, linewidth=1.0, linestyle=(0, (4, 1.5)), label="at least")
    if sweep.delta is not None:
        axes.axhline(sweep.delta, label=f"delta = {sweep.delta:g}", **BORDER)
    axes.set_yscale("log")
    axes.set(xlabel=name, ylabel="P(leaving), at most")
    axes.legend(fontsize=7, frameon=False)


def _draw_map(axes: Axes, sweep: Sweep, fixed: dict[str, float]) -> Any:
    from matplotlib.collections import LineCollection

    across, upward = list(sweep.over)[-2:]
    values = sweep.over[across], sweep.over[upward]
    shown, safe = np.full((len(values[0]), len(values[1])), np.nan), np.zeros((len(values[0]), len(values[1])), bool)
    unsafe = safe.copy()
    for row in sweep.points:
        if row.status != "FAILED" and all(row.parameters[name] == value for name, value in fixed.items()):
            place = values[0].index(row.parameters[across]), values[1].index(row.parameters[upward])
            shown[place] = row.log10_delta
            safe[place], unsafe[place] = row.status == "SAFE", row.status.startswith("UNSAFE")
    ends = _ends(values[0]), _ends(values[1])
    mesh = axes.pcolormesh(*ends, np.maximum(shown, DEEPEST).T, vmin=DEEPEST, vmax=0.0, cmap="cividis", rasterized=True)
    for colour, width in (("white", 3.2), (BLUE, 1.8)):
        edges = list(outline_of(ends, safe))
        axes.add_collection(LineCollection(edges, colors=colour, linewidths=width, capstyle="round", zorder=5))
    for i, j in zip(*np.nonzero(unsafe)):
        box = [(ends[0][i], ends[1][j]), (ends[0][i + 1], ends[1][j + 1])]
        axes.fill_between([box[0][0], box[1][0]], box[0][1], box[1][1], hatch="////", facecolor="none",
                          edgecolor=VERMILION, linewidth=0.0, zorder=4)  # fmt: skip
    axes.set(xlabel=across, ylabel=upward)
    for axis, own in ((axes.xaxis, values[0]), (axes.yaxis, values[1])):
        if len(own) <= _TICKS:
            axis.set_ticks(own, labels=[f"{value:.3g}" for value in own])
    return mesh


def _ends(values: tuple[float, ...]) -> Array:
    """Edges half-way between values."""
    if len(values) == 1:
        width = 0.05 * abs(values[0]) or 0.5
        return np.array([values[0] - width, values[0] + width])
    x = np.array(values)
    inner = 0.5 * (x[1:] + x[:-1])
    return np.concatenate([[2 * x[0] - inner[0]], inner, [2 * x[-1] - inner[-1]]])


def _draw_boundary(axes: Axes, sweep: Sweep) -> None:
    """The last SAFE value, and the gap to the first that is not, over the first other parameter."""
    assert sweep.boundaries is not None
    name = sweep.boundaries[0].name
    across, *rest = [*(other for other in sweep.over if other != name), ""]
    lines: dict[tuple[float, ...], list[tuple[float, float, float]]] = {}
    for one in sweep.boundaries:
        if one.safe is not None:
            place = one.parameters.get(across, 0.0)
            key = tuple(one.parameters[other] for other in rest if other)
            beyond = one.safe if one.not_safe is None else one.not_safe
            lines.setdefault(key, []).append((place, one.safe, beyond))
    for (key, found), colour in zip(lines.items(), itertools.cycle(TIMES)):
        x, safe, beyond = np.array(found).T
        label = ", ".join(f"{other} = {value:.4g}" for other, value in zip(rest, key)) or "SAFE"
        axes.plot(x, safe, "o-", color=colour, linewidth=1.2, markersize=4, label=label)
        axes.fill_between(x, safe, beyond, color=colour, alpha=0.25, linewidth=0)
    axes.set(xlabel=across, ylabel=f"{name} at the boundary")
    if lines:
        axes.legend(fontsize=7, frameon=False)
