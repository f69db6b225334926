"""Fig. K4: seconds against the number of states."""

from __future__ import annotations

import math

from matplotlib.figure import Figure

from paper_figs.style import BLUE, COLUMN, GREEN, LINES, Data, main, panels


def draw(data: Data) -> Figure:
    """One panel, logarithmic both ways."""
    figure, axes = panels(COLUMN, 2.5)
    panel = axes[0, 0]
    states = data["states"]
    panel.loglog(states, data["linear"], "o-", color=BLUE, markersize=3.5, label="verdict, linear response")
    panel.loglog(states, data["constants"], "^-.", color=GREEN, markersize=3.5, label="constants with metric")
    for level, paths, style in zip(data["levels"], data["paths_needed"], ("paper", "printed")):
        name = rf"simulation for $\delta=10^{{{round(math.log10(level))}}}$"
        panel.loglog(states, data["sampling"] * paths, label=name, **LINES[style])
    panel.set_xticks(states, [str(count) for count in states])
    panel.minorticks_off()
    panel.set(xlabel="states $n$", ylabel="wall time (s)")
    figure.legend(*panel.get_legend_handles_labels(), loc="outside upper center", ncols=2, columnspacing=1.0)
    return figure


if __name__ == "__main__":
    main("figk4", draw)
