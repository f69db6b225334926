"""Fig. 7: the smallest certified safe interval against 1/delta, for two horizons."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from paper_figs.style import COLUMN, LINES, Data, letter, main, panels, shared_legend


def draw(data: Data) -> Figure:
    """Two panels on one scale."""
    figure, axes = panels(COLUMN, 2.5, 1, 2, sharey=True)
    for panel, side in zip(axes.flat, ("left", "right")):
        _panel(panel, data, side)
    axes[0, 0].set_ylabel(r"smallest safe radius $R_{\min}$ (units of $x$)")
    letter(axes.flat, ["$T=2$", "$T=5$"])
    shared_legend(figure, axes.flat, columns=2)
    return figure


def _panel(axes: Axes, data: Data, side: str) -> None:
    inverse = 10.0 ** data["exponents"]
    axes.semilogx(inverse, data[f"{side}_paper"], label=r"paper, eq. ($R\geq$)", **LINES["paper"])
    axes.semilogx(inverse, data[f"{side}_kummer"], label="certbound's tube (Kummer)", **LINES["kummer"])
    axes.semilogx(inverse, data[f"{side}_exact"], label="exact limit", **LINES["exact"])
    dots = {"color": LINES["simulated"]["color"], "markerfacecolor": "none", "markersize": 2.6}
    axes.semilogx(inverse, data[f"{side}_simulated"], "o", label="simulated quantile", **dots)
    axes.set(xlim=(8, 1.25e5), xlabel=r"$1/\delta$", ylim=(0.5, 1.65))
    axes.set_yticks([0.6, 0.8, 1.0, 1.2, 1.4, 1.6])
    axes.set_xticks([10.0**k for k in range(1, 6)])
    axes.set_xticks([m * 10.0**k for k in range(1, 5) for m in range(2, 10)], minor=True)
    axes.tick_params(which="minor", length=1.5, labelbottom=False)


if __name__ == "__main__":
    main("fig7", draw)
