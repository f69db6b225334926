"""Table I as a table: the paper's choice of theorem, with numbers."""

from __future__ import annotations

from matplotlib.figure import Figure

from paper_figs.style import COLUMN, Data, main

HEADINGS = ("case", "paper", "example", r"$\varepsilon=\frac{15}{16}$", "best", "certbound", "limit")
THEOREMS = {"thm2": "Thm 2", "thm3": "Thm 3", "thm4": "Thm 4*", "thm5": "Thm 5"}
LEFT = (0.0, 0.235, 0.345, 0.56, 0.665, 0.765, 0.925)


def draw(data: Data) -> Figure:
    """Text on lines; no axes."""
    figure = Figure(figsize=(COLUMN, 1.42))
    claims = data.claims
    lines = [HEADINGS]
    for case, pick, example, method, radii in zip(
        claims["cases"], claims["picks"], claims["examples"], claims["methods"], claims["radii"]
    ):
        reading, best, chosen, exact = (f"{value:#.4g}" for value in radii)
        result = f"{chosen} ({method[0].upper()})"
        lines.append((case, THEOREMS[pick], example.replace("-", "\N{MINUS SIGN}"), reading, best, result, exact))
    for row, line in enumerate(lines):
        for left, cell in zip(LEFT, line):
            weight = "bold" if row == 0 else "normal"
            figure.text(0.01 + 0.98 * left, 0.87 - 0.15 * row, cell, fontsize=5.8, weight=weight, va="center")
    for height, width in ((0.96, 1.0), (0.79, 0.6), (0.19, 1.0)):
        figure.add_artist(_rule(height, width))
    note = (
        r"* with the factor 1/L that the print lacks. Largest radius, $n=\sigma=1$, $\delta=10^{-3}$." "\n"
        "K: Kummer, B: Bessel, T: Theorem 3 sharpened."
    )
    figure.text(0.01, 0.085, note, fontsize=4.7, va="center")
    return figure


def _rule(height: float, width: float):  # type: ignore[no-untyped-def]
    from matplotlib.lines import Line2D

    return Line2D([0.01, 0.99], [height, height], color="black", linewidth=width)


if __name__ == "__main__":
    main("table1", draw)
