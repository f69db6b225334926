"""Fig. 9: six panels of the chain: four constraints with both tubes, input, cost."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from paper_figs.style import BLACK, COLUMN, LINES, Data, letter, main, panels, paths, shared_legend

STEP = 0.1  # seconds
NAMES = {"p1": "$p_1$ (m)", "dp21": r"$\Delta p_{21}$ (m)", "dp32": r"$\Delta p_{32}$ (m)", "v3": "$v_3$ (m/s)"}


def draw(data: Data) -> Figure:
    """Three rows, two columns."""
    figure, axes = panels(COLUMN, 4.6, 3, 2, sharex=True)
    for panel, name in zip(axes.flat, NAMES):
        _constraint(panel, data, name)
    steps = STEP * data["steps"][:-1]
    axes[2, 0].step(steps, data["input"], where="post", color=BLACK, linewidth=1.0)
    axes[2, 0].set_ylim(0, None)
    paths(axes[2, 1], steps, data["cost"])
    axes[2, 1].plot(steps, data["cost"].mean(axis=0), color=BLACK, linewidth=1.0)
    axes[2, 1].set_ylim(0, None)
    for panel in axes[2]:
        panel.set_xlabel("time (s)")
    letter(axes.flat, [*NAMES.values(), r"input $\|u\|_\infty$ (N)", "cost of the step"])
    shared_legend(figure, [axes[0, 0]], columns=4)
    for panel in axes.flat:
        panel.set_xlim(0, STEP * data["steps"][-1])
    return figure


def _constraint(axes: Axes, data: Data, name: str) -> None:
    steps, nominal, half = STEP * data["steps"], data[f"{name}_nominal"], data[f"{name}_bound"]
    paths(axes, steps, data[name])
    axes.plot(steps, nominal, color=BLACK, linewidth=1.0, label="nominal")
    for width, label, look in (
        (data[f"{name}_thm5"], r"Thm 5, $\varepsilon=15/16$", LINES["paper"]),
        (half, "certbound", LINES["kummer"]),
    ):
        axes.plot(steps, (nominal + width), label=label, **look)
        axes.plot(steps, (nominal - width), **look)
    limit = float(data[f"{name}_limit"])
    axes.axhline(limit, color=BLACK, linestyle=(0, (1, 1)), linewidth=1.4, label="limit")
    low, high = axes.get_ylim()
    margin = 0.08 * (high - low)
    axes.set_ylim(min(low, limit - margin), max(high, limit + margin))
    axes.yaxis.set_major_locator(MaxNLocator(nbins=4, steps=[1, 2, 5, 10]))


if __name__ == "__main__":
    main("fig9", draw)
