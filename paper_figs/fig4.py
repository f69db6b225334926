"""Fig. 4: Theorem 2 (left) and Theorem 3 (right) at c = -0.5, with the Kummer tube and the exact limit."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from paper_figs.style import COLUMN, LINES, Data, letter, main, panels, paths, shared_legend


def draw(data: Data) -> Figure:
    """Two panels on one scale; the printed epsilon, far above it, is named with its largest radius."""
    figure, axes = panels(COLUMN, 2.6, 1, 2, sharey=True)
    for panel, key, name in zip(axes.flat, ("thm2", "thm3"), ("Thm 2", r"Thm 3, $\Delta t=0.05$")):
        _panel(panel, data, key, name)
    axes[0, 0].set_ylabel("deviation $|X_t-x_t|$")
    letter(axes.flat, ["Theorem 2", "Theorem 3"])
    shared_legend(figure, axes.flat, columns=2)
    return figure


def _panel(axes: Axes, data: Data, key: str, name: str) -> None:
    times = data["times"]
    paths(axes, times, data["paths"])
    style = {**LINES["paper"], "linestyle": (0, (4, 1.5)) if key == "thm2" else (0, (7, 1.5))}
    axes.plot(times, data[key], label=rf"{name}, $\varepsilon=15/16$", **style)
    axes.plot(times, data["kummer"], label="Kummer tube (certbound)", **LINES["kummer"])
    axes.plot(times, data["exact"], label="exact constant radius", **LINES["exact"])
    axes.set(xlim=(0, times[-1]), ylim=(0, 1.05 * data["thm2"].max()), xlabel="time $t$ (s)")
    printed = data[f"{key}_printed"]
    axes.annotate(
        r"$\varepsilon=1/16$ as printed:" + f"\n{printed.min():.0f} to {printed.max():.0f}, off this scale",
        xy=(0.97, 0.97),
        xycoords="axes fraction",
        ha="right",
        va="top",
        fontsize=6,
    )


if __name__ == "__main__":
    main("fig4", draw)
