"""Fig. 8: six panels of the unicycle; columns are the horizons, rows nominal paths, boxes and noisy paths."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Rectangle

from paper_figs.style import BLUE, COLUMN, Data, letter, main, panels

OBSTACLE, RIM, BAND, EDGE, NOMINAL, NOISY = "#D55E00", "#7a3500", "#F7EC8C", "#8a7d00", "#2b6da3", "#555555"
BOX = "#9cc8e8"
TITLES = {"left": "$T=2$", "right": "$T=5$"}


def draw(data: Data) -> Figure:
    """Three rows, two columns, one scale."""
    figure, axes = panels(COLUMN, 4.3, 3, 2, sharex=True, sharey=True)
    for column, side in enumerate(TITLES):
        for row in range(3):
            _scene(axes[row, column], data, side)
        _paths(axes[0, column], data[f"{side}_nominal"], NOMINAL)
        for low, high in data[f"{side}_boxes"]:
            box = Rectangle(tuple(low), *(high - low), facecolor=BOX, edgecolor=BLUE, linewidth=0.4, alpha=0.8)
            axes[1, column].add_patch(box)
        _paths(axes[2, column], data[f"{side}_noisy"], NOISY)
        _inset(axes[2, column], data, side)
    for row in range(3):
        axes[row, 0].set_ylabel("$p_y$ (m)")
    for column in range(2):
        axes[2, column].set_xlabel("$p_x$ (m)")
    letter(
        axes.flat,
        [f"{name}, {title}" for name in ("noise-free", "reach boxes", "noisy") for title in TITLES.values()],
    )
    handles = [
        Patch(facecolor=OBSTACLE, edgecolor=RIM, hatch="////", label="obstacle"),
        Patch(facecolor=BAND, edgecolor=EDGE, linewidth=0.5, label="eroded by a ball"),
        Line2D([], [], color=BLUE, linestyle=(0, (2, 1)), linewidth=0.7, label="eroded by direction"),
        Line2D([], [], color="black", marker="x", markersize=4, linestyle="none", label="goal"),
        Line2D([], [], color=NOMINAL, label="noise-free path"),
        Line2D([], [], color=NOISY, label="noisy path"),
        Patch(facecolor=BOX, edgecolor=BLUE, linewidth=0.7, label="reachable box"),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=3, columnspacing=1.0, handlelength=1.5)
    return figure


def _scene(axes: Axes, data: Data, side: str) -> None:
    for centre, radius in zip(data["centers"], data["radii"]):
        band = radius + float(data[f"{side}_band"])
        axes.add_patch(Circle(tuple(centre), band, facecolor=BAND, edgecolor=EDGE, linewidth=0.5, zorder=0.7))
        axes.add_patch(
            Circle(tuple(centre), radius, facecolor=OBSTACLE, edgecolor=RIM, hatch="////", linewidth=0.4, zorder=0.8)
        )
        ring = (radius + data[f"{side}_needed"])[:, None] * _circle(len(data[f"{side}_needed"]))
        axes.plot(*(centre + ring).T, color=BLUE, linestyle=(0, (2, 1)), linewidth=0.7, zorder=0.9)
    axes.plot(0.5, 0.0, "x", color="black", markersize=4, zorder=6)
    axes.set(xlim=(-2.6, 7.8), ylim=(-1.0, 5.6), xticks=range(-2, 8, 2), yticks=range(0, 6, 2))
    axes.set_aspect("equal", adjustable="box")
    axes.set_axisbelow(True)


def _circle(count: int) -> np.ndarray:
    angles = np.linspace(0.0, 2 * np.pi, count)
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _inset(axes: Axes, data: Data, side: str) -> None:
    """How far the noise carries each path from its noise-free twin, in cm, under what is certified."""
    small = axes.inset_axes((0.79, 0.5, 0.2, 0.44))
    deviation = 100 * data[f"{side}_deviation"]
    times = np.linspace(0.0, float(TITLES[side].strip("$T=")), deviation.shape[1])
    for one in deviation:
        small.plot(times, one, color=NOISY, linewidth=0.25, alpha=0.6)
    small.axhline(100 * float(data[f"{side}_band"]), color=EDGE, linewidth=0.8)
    small.set(xlim=(0, times[-1]), ylim=(0, 112 * float(data[f"{side}_band"])), xticks=[], yticks=[])
    top = 100 * float(data[f"{side}_band"])
    small.text(0.95, 0.86, f"{top:.0f} cm", fontsize=5, ha="right", va="top", transform=small.transAxes)
    small.grid(False)


def _paths(axes: Axes, paths: np.ndarray, color: str) -> None:
    alpha = float(np.clip(60 / len(paths), 0.04, 0.5))
    axes.add_collection(
        LineCollection(list(paths), colors=color, linewidths=0.35, alpha=alpha, rasterized=True, zorder=2)
    )


if __name__ == "__main__":
    main("fig8", draw)
