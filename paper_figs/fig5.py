"""Fig. 5: Theorem 3 over time for four windows (left), over the window at four times (right)."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from paper_figs.style import BLUE, COLUMN, GREEN, LINES, ORANGE, PURPLE, VERMILION, Data, letter, main, panels

COLORS = (ORANGE, GREEN, VERMILION, PURPLE)
DASHES = ((0, (1, 1)), (0, (3, 1)), (0, (6, 1.5)), (0, (5, 1, 1, 1)))


def draw(data: Data) -> Figure:
    """Two panels, legends inside."""
    figure, axes = panels(COLUMN, 2.6, 1, 2)
    _over_time(axes[0, 0], data)
    _over_window(axes[0, 1], data)
    letter(axes.flat, ["over time", "over the window"])
    return figure


def _over_time(axes: Axes, data: Data) -> None:
    times = data["times"]
    for radius, window, color, dash in zip(data["left"], data["windows"], COLORS, DASHES):
        axes.plot(times, radius, color=color, linestyle=dash, linewidth=1.2, label=rf"$\Delta t={window:g}$ s")
    axes.plot(times, data["kummer"], label="Kummer", **LINES["kummer"])
    axes.plot(times, data["exact"], label="exact", **LINES["exact"])
    axes.set(xlim=(0, times[-1]), ylim=(0, None), xlabel="time $t$ (s)", ylabel="radius $r_t$")
    axes.legend(loc="lower right", handlelength=2.2, labelspacing=0.25, borderaxespad=0.1)


def _over_window(axes: Axes, data: Data) -> None:
    steps = data["steps"]
    for index, (instant, color, dash) in enumerate(zip(data["instants"], COLORS, DASHES)):
        axes.semilogx(steps, data["right"][index], color=color, linewidth=0.5, alpha=0.55)
        printed = data["right_printed"][index]
        axes.semilogx(steps, printed, color=color, linestyle=dash, linewidth=1.2, label=f"$t={instant:g}$ s")
        best = int(np.argmin(printed))
        axes.plot(steps[best], printed[best], "v", color=color, markersize=3.5)
    axes.axhline(data["kummer_instants"][-1], color=BLUE, linewidth=1.4, label="Kummer, $t=5$ s")
    axes.set(xlim=(steps[0], steps[-1]), ylim=(0, None), xlabel=r"window $\Delta t$ (s)")
    axes.legend(loc="lower right", handlelength=2.2, labelspacing=0.25, borderaxespad=0.1)


if __name__ == "__main__":
    main("fig5", draw)
