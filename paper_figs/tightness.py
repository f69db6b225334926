"""Tightness over the grid: how many of its cases lie within a ratio of the exact limit, method by method."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from paper_figs.style import BLUE, COLUMN, GREEN, ORANGE, VERMILION, Data, main, panels, shared_legend

LOOKS = {
    "paper": ("paper, best of Props. and Thms.", VERMILION, "-."),
    "kummer": ("Kummer", BLUE, "-"),
    "auto": ("certbound's choice", GREEN, "--"),
    "thorough": ("with the slow methods", ORANGE, ":"),
}


def draw(data: Data) -> Figure:
    """Share of the cases below each ratio."""
    figure, axes = panels(COLUMN, 2.4)
    chart = axes[0, 0]
    for name, (text, color, dash) in LOOKS.items():
        column = data["thorough"] if name == "thorough" else data["ratios"][:, data.claims["methods"].index(name)]
        values = np.sort(column[np.isfinite(column)])
        share = np.arange(1, len(values) + 1) / len(values)
        chart.step(values, 100 * share, where="post", color=color, linestyle=dash, linewidth=1.4, label=text)
    chart.axvline(1.0, color="black", linewidth=0.9)
    chart.set(xlim=(0.98, 2.0), ylim=(0, 102), xlabel="largest radius / exact limit", ylabel="cases (%)")
    shared_legend(figure, [chart], columns=2)
    return figure


if __name__ == "__main__":
    main("tightness", draw)
