"""Fig. 6: Theorem 5 over the window, for the printed epsilon (top) and for eps = 15/16 (bottom)."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from paper_figs.style import COLUMN, GREEN, LINES, ORANGE, VERMILION, Data, main, panels, shared_legend

COLORS = (ORANGE, GREEN, VERMILION)
DASHES = ((0, (1, 1)), (0, (3, 1)), "-")
GAINS = {"left": "0.9999", "right": "0.99"}
READINGS = {"printed": r"$\varepsilon=1/16$", "reading": r"$\varepsilon=15/16$"}


def draw(data: Data) -> Figure:
    """Rows: the two readings of epsilon; columns: the two gains."""
    figure, axes = panels(COLUMN, 3.9, 2, 2, sharex="col")
    order = iter("abcd")
    for row, (reading, epsilon) in zip(axes, READINGS.items()):
        for panel, (side, gain) in zip(row, GAINS.items()):
            _panel(panel, data, side, reading)
            panel.set_title(f"({next(order)}) $L={gain}$, {epsilon}", loc="left", pad=3)
        row[0].set_ylabel("radius $r_t$")
    for panel in axes[1]:
        panel.set_xlabel(r"window $\Delta t$ (steps)")
    figure.align_ylabels(axes[:, 0])
    shared_legend(figure, axes.flat, columns=3)
    return figure


def _panel(axes: Axes, data: Data, side: str, reading: str) -> None:
    steps = data[f"{side}_steps"]
    printed, proved = data[f"{side}_{reading}_real"], data[f"{side}_{reading}_whole"]
    for index, (instant, color, dash) in enumerate(zip(data["instants"], COLORS, DASHES)):
        axes.plot(steps, proved[index], color=color, linewidth=0.5, alpha=0.5)
        axes.plot(steps, printed[index], color=color, linestyle=dash, linewidth=1.2, label=f"Thm 5, $t={instant:g}$")
    best = int(np.argmin(printed[-1]))
    axes.plot(steps[best], printed[-1, best], "v", color=VERMILION, markersize=4, clip_on=False, zorder=5)
    axes.annotate(
        rf"best $\Delta t={steps[best]}$",
        (steps[best], printed[-1, best]),
        xytext=(5, 8) if side == "left" else (10, -7),
        textcoords="offset points",
        fontsize=6.5,
        color=VERMILION,
    )
    if reading == "reading":
        axes.axhline(data[f"{side}_kummer"][-1], label="Kummer, $t=2000$", **LINES["kummer"])
        axes.axhline(data[f"{side}_exact"][-1], label="exact limit", **LINES["exact"])
    if side == "right":
        corner = {"transform": axes.transAxes, "ha": "right", "va": "bottom", "fontsize": 6.5}
        axes.text(0.97, 0.05, "the three times coincide", **corner)
    axes.set_xlim(0, steps[-1])
    axes.set_ylim(0, 1.15 * max(printed.max(), proved.max()))


if __name__ == "__main__":
    main("fig6", draw)
