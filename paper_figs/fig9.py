"""Fig. 9: six panels of the chain: four constraints with the tube, input, cost."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from paper_figs.style import BLACK, BLUE, COLUMN, VERMILION, Data, letter, main, panels, paths, shared_legend

NAMES = {"p1": "$p_1$", "dp21": r"$\Delta p_{21}$", "dp32": r"$\Delta p_{32}$", "v3": "$v_3$"}


def draw(data: Data) -> Figure:
    """Three rows, two columns."""
    figure, axes = panels(COLUMN, 4.6, 3, 2, sharex=True)
    for panel, name in zip(axes.flat, NAMES):
        _constraint(panel, data, name)
    steps = data["steps"][:-1]
    axes[2, 0].step(steps, data["input"], where="post", color=BLACK, linewidth=1.0)
    axes[2, 0].set_ylim(0, None)
    paths(axes[2, 1], steps, data["cost"])
    axes[2, 1].plot(steps, data["cost"].mean(axis=0), color=BLACK, linewidth=1.0)
    axes[2, 1].set_ylim(0, None)
    for panel in axes[2]:
        panel.set_xlabel("step")
    letter(axes.flat, [*NAMES.values(), r"input $\|u\|_\infty$", "cost of the step"])
    shared_legend(figure, [axes[0, 0]], columns=4)
    for panel in axes.flat:
        panel.set_xlim(0, data["steps"][-1])
    return figure


def _constraint(axes: Axes, data: Data, name: str) -> None:
    steps, nominal, half = data["steps"], data[f"{name}_nominal"], data[f"{name}_bound"]
    paths(axes, steps, data[name])
    axes.plot(steps, nominal, color=BLACK, linewidth=1.0, label="nominal")
    count = min(len(half), len(steps))
    tube = {"color": BLUE, "linewidth": 1.2}
    axes.plot(steps[:count], (nominal[:count] + half[:count]), label="tube (certbound)", **tube)
    axes.plot(steps[:count], (nominal[:count] - half[:count]), **tube)
    limit = float(data[f"{name}_limit"])
    axes.axhline(limit, color=VERMILION, linestyle=(0, (4, 1.5)), linewidth=1.2, label="limit")
    low, high = axes.get_ylim()
    margin = 0.08 * (high - low)
    axes.set_ylim(min(low, limit - margin), max(high, limit + margin))
    axes.set_yticks(np.unique(np.round(axes.get_yticks(), 6))[::2])


if __name__ == "__main__":
    main("fig9", draw)
