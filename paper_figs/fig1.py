"""Fig. 1: (a) the eroded aisle with the nominal inside, (b) tubes at three levels with sample paths."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from paper_figs.style import BLACK, COLUMN, Data, main, panels

WALL, BAND, RIM, PATH = "#7f7f7f", "#F7EC8C", "#8a7d00", "#D55E00"
TUBES = ("#e3eef8", "#a6cfee", "#4a90cc")


def draw(data: Data) -> Figure:
    """Two panels, one above the other, on the same axes."""
    figure, axes = panels(COLUMN, 3.95, 2, 1, sharex=True)
    handles = [
        Patch(facecolor=WALL, label="unsafe"),
        Line2D([], [], color=BLACK, linewidth=1.5, label="noise-free $x_t$"),
        Line2D([], [], color=PATH, linewidth=0.9, label="noisy $X_t$"),
        *_erosion(axes[0, 0], data),
        *_tubes(axes[1, 0], data),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=3, columnspacing=1.2, handlelength=1.6)
    for panel, title in zip(axes.flat, ("(a) set erosion", "(b) probabilistic tubes")):
        panel.set_title(title, loc="left", pad=3)
        panel.set(xlim=(data["x"][0], data["x"][-1]), ylim=(data["y"][0], data["y"][-1]), ylabel="$p_y$ (m)")
        panel.set_aspect("equal", adjustable="box")
        panel.grid(False)
        panel.fill_between(data["x"], data["high"], data["y"][-1], color=WALL, linewidth=0, zorder=3)
        panel.fill_between(data["x"], data["y"][0], data["low"], color=WALL, linewidth=0, zorder=3)
    axes[1, 0].set_xlabel("$p_x$ (m)")
    return figure


def _erosion(axes: Axes, data: Data) -> list[Patch]:
    radius = data.claims["radius"]
    distance = data["distance"]
    axes.contourf(data["x"], data["y"], distance, levels=[-2, radius], colors=[BAND], zorder=1)
    axes.contour(data["x"], data["y"], distance, levels=[radius], colors=[RIM], linewidths=0.7, zorder=2)
    axes.plot(*data["nominal"].T, color=BLACK, linewidth=1.5, zorder=5)
    return [Patch(facecolor=BAND, label=rf"eroded by {radius:.2f} m")]


def _tubes(axes: Axes, data: Data) -> list[Patch]:
    angles = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    handles = []
    order = np.argsort(data["levels"])
    for place, index in enumerate(order):
        discs = data["nominal"][:, None] + data["radii"][index][:, None, None] * circle
        axes.add_collection(
            PolyCollection(list(discs), facecolors=TUBES[place], edgecolors="none", zorder=1 + 0.1 * place)
        )
        exponent = round(np.log10(data["levels"][index]))
        handles.append(Patch(facecolor=TUBES[place], label=rf"tube, $\delta=10^{{{exponent}}}$"))
    for path in data["paths"]:
        axes.plot(*path.T, color=PATH, linewidth=0.35, alpha=0.7, zorder=4)
    axes.plot(*data["nominal"].T, color=BLACK, linewidth=0.9, zorder=5)
    return handles


if __name__ == "__main__":
    main("fig1", draw)
