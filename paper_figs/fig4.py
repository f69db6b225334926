"""Fig. 4: Theorem 2 (left) and Theorem 3 (right) at c = -0.5, with the Kummer tube and the exact limit."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from paper_figs.style import COLUMN, LINES, Data, draw_strip, main, paths, shared_legend, with_strip

PANELS = {"thm2": "(a) Theorem 2", "thm3": r"(b) Theorem 3, $\Delta t=0.05$"}


def draw(data: Data) -> Figure:
    """Two panels on one scale, with the printed epsilon in a strip above."""
    figure = Figure(figsize=(COLUMN, 2.9), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.015, hspace=0.0, wspace=0.04)
    every = []
    top = 1.08 * data["thm3"].max()
    for place, (key, title) in zip(figure.subfigures(1, 2), PANELS.items()):
        strip, panel = with_strip(place)
        _panel(panel, data, key, top)
        line = {"label": r"paper, $\varepsilon=1/16$ as printed", **LINES["printed"]}
        draw_strip(strip, data["times"], data[f"{key}_printed"], title, **line)
        every += [strip, panel]
    every[1].set_ylabel("deviation $|X_t-x_t|$")
    shared_legend(figure, every, columns=2)
    return figure


def _panel(axes: Axes, data: Data, key: str, top: float) -> None:
    times = data["times"]
    paths(axes, times, data["paths"])
    axes.plot(times, data[key], label=r"paper, $\varepsilon=15/16$", **LINES["paper"])
    axes.plot(times, data["kummer"], label="certbound's tube (Kummer)", **LINES["kummer"])
    axes.plot(times, data["exact"], label="exact constant radius", **LINES["exact"])
    axes.set(xlim=(0, times[-1]), ylim=(0, top), xlabel="time $t$ (s)")
    axes.locator_params(axis="both", nbins=5)
    if data[key].max() > top:
        high, begins = f"from {data[key][0]:.3g} at $t=0$", float(times[np.argmax(data[key] <= top)])
        axes.text(begins - 0.15, 0.97 * top, high, ha="right", va="top", fontsize=6, color=LINES["paper"]["color"])


if __name__ == "__main__":
    main("fig4", draw)
