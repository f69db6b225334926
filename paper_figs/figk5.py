"""Fig. K5: certified bounds of the probability of failing from both sides, beside simulation."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from paper_figs.style import BLACK, BLUE, GREEN, PAGE, VERMILION, Data, letter, main, panels, shared_legend

TITLES = {
    "well": "double well, 10 s",
    "oscillator": "Van der Pol backward, 5 s",
    "logistic": "logistic map, 20 steps",
    "pendulum": "pendulum, 20 steps",
}


def draw(data: Data) -> Figure:
    """Four panels, logarithmic in the probability."""
    figure, axes = panels(PAGE, 2.3, 1, 4)
    for panel, name in zip(axes[0], TITLES):
        _draw_problem(panel, data, name)
    axes[0, 0].set_ylabel("P(leaving)")
    letter(axes[0], list(TITLES.values()))
    shared_legend(figure, list(axes[0]), columns=3)
    return figure


def _draw_problem(panel: Axes, data: Data, name: str) -> None:
    sigma, upper, lower = (data[f"{name}_{part}"] for part in ("sigma", "upper", "lower"))
    low, high = data[f"{name}_simulated_low"], data[f"{name}_simulated_high"]
    panel.semilogy(sigma, upper, "v-", color=BLUE, markersize=3.5, linewidth=1.2, label="certified: at most")
    if np.isfinite(lower).any():
        panel.semilogy(sigma, lower, "^--", color=VERMILION, markersize=3.5, linewidth=1.0, label="certified: at least")
        panel.fill_between(sigma, lower, upper, color=GREEN, alpha=0.2, linewidth=0)
    bottom = 0.3 * float(min(upper.min(), np.nanmin(lower) if np.isfinite(lower).any() else np.inf))
    shown = np.maximum(low, bottom)
    panel.vlines(sigma, shown, high, color=BLACK, linewidth=2.6, alpha=0.55, label="simulated, 99 % limits", zorder=3)
    panel.set(xlabel=r"noise level $\sigma$", ylim=(bottom, min(2.0, 4 * float(max(upper.max(), high.max())))))
    panel.margins(x=0.08)


if __name__ == "__main__":
    main("figk5", draw)
