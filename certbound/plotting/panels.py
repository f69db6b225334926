"""One panel a constraint: a linear function of the state with its limits, or a distance, over time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from certbound.arrays import Array
from certbound.plotting.asked import Panel
from certbound.plotting.certified import bounds_of, stairs, supports
from certbound.plotting.scene import BLUE, GREY, INK, VERMILION, Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_panel(axes: Axes, scene: Scene, panel: Panel) -> None:
    """Sample paths, tubes, nominal and limits of one constraint over time."""
    row = panel.direction
    if row is not None:
        for order, (tube, color) in enumerate(scene.tubes):
            x, high = stairs(tube, supports(tube, row))
            _, low = stairs(tube, -supports(tube, -row))
            axes.fill_between(x, low, high, color=color, linewidth=0, zorder=1 + order)
    for bound, room in bounds_of(scene, panel):
        assert scene.tube is not None
        times, shown = stairs(scene.tube, np.where(np.isfinite(room), bound, np.nan))
        axes.plot(times, shown, color=BLUE, linewidth=1.1, zorder=4)
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
