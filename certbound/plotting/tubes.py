"""Radii of tubes over time, side by side, with the size of simulated deviations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from certbound.arrays import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from certbound.tubes.tube import Tube

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
DASHES = ("-", "--", "-.", ":")
HEIGHT = 3.0


def draw_tubes(tubes: Mapping[str, Tube], chosen: str, deviations: Array | None = None) -> Figure:
    """A figure of r_t for every tube, the chosen one in bold, over the sizes ||S_t||_P of sample paths.

    All tubes (by label) are for the same constants and horizon; the chart ends at three times the largest radius of the
    ``chosen`` one: wider tubes leave it. ``deviations``, shape (path, time), are norms at equally spaced times from 0
    to the horizon.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes = figure.subplots()
    best = tubes[chosen]
    continuous = best.constants.continuous
    if deviations is not None:
        times = np.linspace(0.0, best.horizon, deviations.shape[1])
        axes.plot(times, deviations.T, color="0.75", linewidth=0.5, zorder=1)
    grid = np.linspace(0.0, best.horizon, 401) if continuous else np.arange(best.horizon + 1)
    for index, (label, tube) in enumerate(tubes.items()):
        colour, dash = COLOURS[index % len(COLOURS)], DASHES[index // len(COLOURS) % len(DASHES)]
        bold = label == chosen
        name = label if tube.level == "trajectory" else f"{label} (one time)"
        axes.plot(
            grid, tube.radius(grid), linewidth=2.6 if bold else 1.1, zorder=4 if bold else 3,
            label=f"{name}: chosen" if bold else name, color=colour, linestyle=dash,
        )  # fmt: skip
    axes.set_xlim(0.0, best.horizon)
    axes.set_ylim(0.0, HEIGHT * best.maximum if 0 < best.maximum < np.inf else None)
    axes.set_xlabel("time (s)" if continuous else "step")
    axes.set_ylabel("radius" if best.constants.metric is None else "radius in the norm of the metric")
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=7, frameon=False)
    return figure
