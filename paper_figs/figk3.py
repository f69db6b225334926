"""Fig. K3: certified noise level of the unicycle over the horizon."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from paper_figs.style import BLACK, BLUE, COLUMN, GREEN, Data, main, panels


def draw(data: Data) -> Figure:
    """One panel, logarithmic in the noise level."""
    figure, axes = panels(COLUMN, 2.4)
    panel = axes[0, 0]
    horizons = data["horizons"]
    panel.semilogy(horizons, data["simulated"], "--", color=BLACK, linewidth=1.2, label="simulated limit")
    panel.semilogy(horizons, data["linear"], "o-", color=BLUE, linewidth=1.5, markersize=3.5, label="linear response")
    local = data["local"]
    shown = local > 0
    if np.any(shown):
        style = {"color": GREEN, "linewidth": 1.3, "markersize": 3.5}
        panel.semilogy(horizons[shown], local[shown], "^-.", label="local rates", **style)
    panel.fill_between(horizons, 1e-3, data["linear"], color=BLUE, alpha=0.12, linewidth=0)
    panel.set(xlabel="horizon $T$ (s)", ylabel=r"noise level $\sigma$", ylim=(4e-3, 1.0))
    panel.set_yticks([0.01, 0.03, 0.1, 0.3, 1.0], ["0.01", "0.03", "0.1", "0.3", "1"])
    panel.minorticks_off()
    figure.legend(*panel.get_legend_handles_labels(), loc="outside upper center", ncols=3, columnspacing=1.0)
    return figure


if __name__ == "__main__":
    main("figk3", draw)
