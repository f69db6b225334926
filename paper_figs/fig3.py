"""Fig. 3: the window strategy, drawn with the bounds that it really uses."""

from __future__ import annotations

from matplotlib.figure import Figure

from paper_figs.style import BLACK, COLUMN, LINES, VERMILION, Data, main, panels, paths


def draw(data: Data) -> Figure:
    """One panel: ends of windows, the arcs inside them, and the tube that covers all."""
    figure, axes = panels(COLUMN, 2.75)
    panel = axes[0, 0]
    paths(panel, data["path_times"], data["paths"])
    for start in data["starts"]:
        panel.axvline(start, color="#d0d0d0", linewidth=0.6, zorder=0)
    panel.plot(data["times"], data["thm2"], label="Thm 2 over $[0,T]$", **LINES["printed"])
    panel.plot(data["times"], data["thm3"], label="Thm 3", **LINES["paper"])
    arcs = {"color": VERMILION, "linewidth": 1.0}
    for index, (start, arc) in enumerate(zip(data["starts"], data["within"])):
        label = r"Thm 2 per window, $\delta/2N$" if index == 0 else None
        panel.plot(start + data["inside"], arc, label=label, **arcs)
    panel.plot(data["times"], data["one_time"], label=r"Prop. 1 (one time), $\delta/2N$", **LINES["one time"])
    panel.plot(data["starts"], data["at_starts"], "o", markersize=2.8, color=BLACK, zorder=5, clip_on=False)
    panel.plot(data["times"], data["kummer"], label="Kummer tube (certbound)", **LINES["kummer"])
    panel.set(xlim=(0, data["times"][-1]), ylim=(0, 1.02 * data["thm2"].max()))
    panel.set(xlabel="time $t$ (s)", ylabel="deviation $|X_t-x_t|$")
    figure.legend(*panel.get_legend_handles_labels(), loc="outside upper center", ncols=2, columnspacing=1.0)
    return figure


if __name__ == "__main__":
    main("fig3", draw)
