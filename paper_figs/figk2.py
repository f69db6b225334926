"""Fig. K2: erosions of the chain's constraints by method."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from paper_figs.style import BLACK, BLUE, COLUMN, GREEN, GREY, PURPLE, SKY, VERMILION, Data, main, panels

NAMES = (
    ("Markov (paper's baseline)", PURPLE, "x"),
    ("Theorem 5, $\\varepsilon=15/16$", VERMILION, "D"),
    ("Kummer, one metric", SKY, "s"),
    ("own metric per constraint", GREEN, "^"),
    ("linear response", BLUE, "o"),
    ("simulated quantile", BLACK, "|"),
)
LABELS = ("$p_1$", r"$\Delta p_{21}$", r"$\Delta p_{32}$", "$v_3$")


def draw(data: Data) -> Figure:
    """One row a constraint, one mark a method, logarithmic."""
    figure, axes = panels(COLUMN, 2.5)
    panel = axes[0, 0]
    rows = np.arange(len(LABELS))[::-1]
    for index, (values, (name, color, marker)) in enumerate(zip(data["erosions"], NAMES)):
        style = {"markersize": 11 if marker == "|" else 4.8, "markeredgewidth": 1.4, "zorder": 3 + index}
        panel.plot(values, rows, marker, color=color, label=name, **style)
    for row, room in zip(rows, data["rooms"]):
        panel.plot([room, room], [row - 0.3, row + 0.3], color=GREY, linewidth=2.0, zorder=2)
    panel.plot([], [], color=GREY, linewidth=2.0, label="room at the origin")
    panel.set_xscale("log")
    panel.set_xticks([0.1, 0.2, 0.5, 1, 2, 5, 10], ["0.1", "0.2", "0.5", "1", "2", "5", "10"])
    panel.minorticks_off()
    panel.set(xlim=(0.05, 14), ylim=(-0.6, 3.6), xlabel="erosion of the constraint (m, m/s)")
    panel.set_yticks(rows, LABELS)
    panel.tick_params(axis="y", labelsize=8)
    figure.legend(*panel.get_legend_handles_labels(), loc="outside upper center", ncols=2, columnspacing=1.0)
    return figure


if __name__ == "__main__":
    main("figk2", draw)
