"""Fig. 2: four panels of the linear system, with the printed epsilon in a strip of its own above each."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from paper_figs.style import COLUMN, LINES, Data, draw_strip, main, paths, shared_legend, with_strip

PANELS = {"a": "$c=1$, $T=2$", "b": "$c=0$, $T=2$", "c": "$c=-1$, $T=2$", "d": "$c=-1$, $T=0.02$"}


def draw(data: Data) -> Figure:
    """Four panels; each has a lower part on the scale of the paths and a strip for eps = 1/16."""
    figure = Figure(figsize=(COLUMN, 4.1), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.03, hspace=0.0, wspace=0.04)
    grid = figure.subfigures(2, 2, hspace=0.03)
    lower = []
    for place, (name, title) in zip(grid.flat, PANELS.items()):
        strip, panel = with_strip(place)
        _panel(panel, data, name)
        line = {"label": r"Thm 2, $\varepsilon=1/16$ as printed", **LINES["printed"]}
        draw_strip(strip, data[f"{name}_times"], data[f"{name}_printed"], f"({name}) {title}", **line)
        lower.append((strip, panel))
    for index, (_, panel) in enumerate(lower):
        if index >= 2:
            panel.set_xlabel("time $t$ (s)")
        if index % 2 == 0:
            panel.set_ylabel("deviation $|X_t-x_t|$")
    shared_legend(figure, [axes for pair in lower for axes in pair], columns=2)
    return figure


def _panel(axes: Axes, data: Data, name: str) -> None:
    times = data[f"{name}_times"]
    paths(axes, times, data[f"{name}_paths"])
    axes.plot(times, data[f"{name}_paper"], label=r"Thm 2, $\varepsilon=15/16$", **LINES["paper"])
    axes.plot(times, data[f"{name}_kummer"], label="certbound's tube", **LINES["kummer"])
    axes.plot(times, data[f"{name}_exact"], label="exact constant radius", **LINES["exact"])
    top = 1.12 * max(data[f"{name}_paper"].max(), data[f"{name}_exact"].max(), data[f"{name}_paths"].max())
    axes.set(xlim=(0, times[-1]), ylim=(0, top))
    axes.locator_params(axis="y", nbins=4)
    axes.locator_params(axis="x", nbins=2)
    axes.margins(x=0)


if __name__ == "__main__":
    main("fig2", draw)
