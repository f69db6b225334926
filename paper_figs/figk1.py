"""Fig. K1: ratios to the exact limit, case by case and over dimension, horizon and delta."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from paper_figs.style import BLUE, COLUMN, GREEN, ORANGE, VERMILION, Data, main, shared_legend

LOOKS = {
    "reading": ("paper, $\\varepsilon=15/16$", ORANGE, "s", "--"),
    "paper": ("paper, best parameters", VERMILION, "D", "-."),
    "kummer": ("Kummer", BLUE, "o", "-"),
    "auto": ("certbound's choice", GREEN, "|", (0, (1, 1))),
}
SWEEPS = {"n": "dimension $n$", "T": "horizon $T$ (s)", "delta": r"$1/\delta$"}
TOP = 2.28


def draw(data: Data) -> Figure:
    """A chart of the cases above three sweeps."""
    figure = Figure(figsize=(COLUMN, 4.5), layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=[1.55, 1])
    chart = upper.subplots()
    _chart(chart, data)
    for index, (axes, (name, label)) in enumerate(zip(lower.subplots(1, 3, sharey=True), SWEEPS.items())):
        _sweep(axes, data, name, label)
        axes.set_title(f"({'bcd'[index]})", loc="left", pad=3)
        if index == 0:
            axes.set_ylabel("ratio")
    shared_legend(figure, [chart], columns=2)
    return figure


def _chart(axes: Axes, data: Data) -> None:
    rows = np.arange(len(data["table"]))[::-1]
    methods = data.claims["methods"]
    for place, (method, (name, color, marker, _)) in enumerate(LOOKS.items()):
        style = {"markersize": 9 if marker == "|" else 4.0, "markeredgewidth": 1.4, "zorder": 3 + place}
        axes.plot(data["table"][:, methods.index(method)], rows, marker, color=color, label=name, **style)
    for row, value in zip(rows, data["table"][:, methods.index("printed")]):
        axes.text(TOP, row, f"{value:.0f} $\\rightarrow$", ha="right", va="center", fontsize=6.5)
    axes.text(TOP, rows[0] + 0.75, "at $\\varepsilon=1/16$:", ha="right", va="center", fontsize=6.5)
    axes.axvline(1.0, color="black", linewidth=0.9)
    axes.set_yticks(rows, [case.replace("=-", "=\N{MINUS SIGN}") for case in data.claims["cases"]])
    axes.set(xlim=(0.97, TOP), ylim=(-0.6, len(rows)), xlabel="largest radius / exact limit")
    axes.set_title("(a)", loc="left", pad=3)


def _sweep(axes: Axes, data: Data, name: str, label: str) -> None:
    values = 1 / data["delta_values"] if name == "delta" else data[f"{name}_values"]
    methods = data.claims["methods"]
    for method, (_, color, _, dash) in LOOKS.items():
        ratios = data[f"{name}_ratios"][:, methods.index(method)]
        axes.semilogx(values, ratios, linestyle=dash, color=color, linewidth=1.4)
    axes.axhline(1.0, color="black", linewidth=0.9)
    shown = [methods.index(method) for method in LOOKS]
    top = max(data[f"{sweep}_ratios"][:, shown].max() for sweep in SWEEPS)
    axes.set(ylim=(0.97, 1.04 * top), xlabel=label)
    axes.minorticks_off()


if __name__ == "__main__":
    main("figk1", draw)
