"""How every figure looks: one column of a journal, colours that survive colour blindness and grey printing.

Lines differ in dash pattern as well as in colour (the Okabe-Ito palette, ordered by lightness).
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure, SubFigure

HERE = Path(__file__).resolve().parent
DATA = HERE.parent / "experiments" / "out"

COLUMN = 3.5
PAGE = 7.16

BLACK, GREY, PALE = "#000000", "#8c8c8c", "#c9c9c9"
BLUE, VERMILION, GREEN, ORANGE, SKY, PURPLE = "#0072B2", "#D55E00", "#009E73", "#E69F00", "#56B4E9", "#CC79A7"

LINES: dict[str, dict[str, Any]] = {
    "paper": {"color": VERMILION, "linestyle": (0, (4, 1.5)), "linewidth": 1.4},
    "printed": {"color": PURPLE, "linestyle": (0, (1, 1.2)), "linewidth": 1.4},
    "kummer": {"color": BLUE, "linestyle": "-", "linewidth": 1.6},
    "exact": {"color": BLACK, "linestyle": (0, (6, 1.5, 1, 1.5)), "linewidth": 1.0},
    "simulated": {"color": GREEN, "linestyle": "-", "linewidth": 1.0},
    "one time": {"color": ORANGE, "linestyle": (0, (2, 1)), "linewidth": 1.2},
}

RC = {
    "font.family": "DejaVu Sans",
    "font.size": 7,
    "axes.titlesize": 7.5,
    "axes.labelsize": 7,
    "xtick.labelsize": 6.5,
    "ytick.labelsize": 6.5,
    "legend.fontsize": 6.5,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "axes.grid": True,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.5,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "legend.handlelength": 2.6,
    "figure.dpi": 100,
    "savefig.dpi": 300,
    "path.simplify": True,
    "pdf.fonttype": 42,
    "svg.hashsalt": "certbound",
    "mathtext.fontset": "dejavusans",
}


@dataclass(frozen=True, kw_only=True)
class Data:
    """What an experiment left: arrays and claims."""

    stem: str
    full: bool
    arrays: dict[str, np.ndarray]
    claims: dict[str, Any]

    def __getitem__(self, name: str) -> np.ndarray:
        return self.arrays[name]


def read(stem: str, mode: str) -> Data:
    """The output of ``python -m experiments.<stem>``."""
    record = json.loads((DATA / mode / f"{stem}.json").read_text(encoding="utf-8"))
    with np.load(DATA / mode / f"{stem}.npz") as bundle:
        arrays = {name: bundle[name] for name in bundle.files}
    return Data(stem=stem, full=record["full"], arrays=arrays, claims=record["claims"])


def caption(data: Data) -> str:
    """The figure's caption, with the numbers that came out."""
    text = (HERE / "captions" / f"{data.stem}.md").read_text(encoding="utf-8")
    return text.format(**data.claims)


def main(stem: str, draw: Callable[[Data], Figure]) -> None:
    """Command line of every figure: ``python -m paper_figs.fig2 quick``."""
    parser = argparse.ArgumentParser(prog=f"python -m paper_figs.{stem}")
    parser.add_argument("mode", nargs="?", choices=["quick", "full"], default="quick")
    options = parser.parse_args()
    data = read(stem, options.mode)
    folder = HERE / "out" / options.mode
    folder.mkdir(parents=True, exist_ok=True)
    replace(folder / f"{stem}.md", caption(data).encode())
    with matplotlib.rc_context(RC):
        figure = draw(data)
        save(figure, folder / stem)


def save(figure: Figure, path: Path) -> None:
    """Write ``path.png`` and then ``path.pdf`` without date or program name: the same bytes on every run."""
    for suffix, metadata in (
        (".png", {"Software": None}),
        (".pdf", {"CreationDate": None, "Creator": None, "Producer": None}),
    ):
        temporary = path.with_name(f".{path.name}.part{suffix}")
        figure.savefig(temporary, metadata=metadata)
        temporary.replace(path.with_name(path.name + suffix))
        figure.set_layout_engine("none")  # what was laid out once stays there


def replace(path: Path, content: bytes) -> None:
    """Write a file whole or not at all."""
    temporary = path.with_name(f".{path.name}.part")
    temporary.write_bytes(content)
    temporary.replace(path)


def panels(width: float, height: float, rows: int = 1, columns: int = 1, **options: Any) -> tuple[Figure, np.ndarray]:
    """A figure with a grid of axes, laid out without overlaps."""
    figure = Figure(figsize=(width, height), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.03, h_pad=0.03, wspace=0.03, hspace=0.03)
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    return figure, axes


def paths(axes: Axes, times: np.ndarray, values: np.ndarray, *, color: str = GREY, alpha: float | None = None) -> None:
    """Sample paths (path, time) as thin lines, drawn as pixels so that the PDF stays small."""
    segments = np.stack(np.broadcast_arrays(times[None, :], values), axis=-1)
    if alpha is None:
        alpha = float(np.clip(25.0 / len(values), 0.012, 0.5))
    lines = LineCollection(list(segments), colors=color, linewidths=0.4, alpha=alpha, rasterized=True, zorder=1)
    axes.add_collection(lines)
    axes.autoscale_view()


def letter(axes: Iterable[Axes], titles: Sequence[str]) -> None:
    """Titles (a), (b), ... over the panels."""
    for index, (panel, title) in enumerate(zip(axes, titles)):
        panel.set_title(f"({chr(ord('a') + index)}) {title}", loc="left", pad=3)


def shared_legend(figure: Figure, axes: Sequence[Axes], columns: int = 2) -> None:
    """One legend over all panels, each label once."""
    entries: dict[str, Any] = {}
    for panel in axes:
        for handle, label in zip(*panel.get_legend_handles_labels()):
            entries.setdefault(label, handle)
    figure.legend(entries.values(), entries.keys(), loc="outside upper center", ncols=columns, columnspacing=1.2)


def with_strip(place: SubFigure, ratio: float = 3.2) -> tuple[Axes, Axes]:
    """Two axes, one above the other on the same times: a strip for what is far off the scale, and the panel."""
    strip, panel = place.subplots(2, 1, sharex=True, height_ratios=[1, ratio])
    return strip, panel


def draw_strip(axes: Axes, times: np.ndarray, values: np.ndarray, title: str, **line: Any) -> None:
    """A curve on a scale of its own, broken off from the panel below."""
    axes.plot(times, values, **line)
    low, high = float(values.min()), float(values.max())
    margin = max(0.2 * (high - low), 0.08 * high)
    axes.set_ylim(low - margin, high + margin)
    ends = [high] if high - low < 0.2 * high else [low, high]
    axes.set_yticks(ends, [f"{end:.3g}" for end in ends])
    axes.spines["bottom"].set_visible(False)
    axes.tick_params(bottom=False, labelbottom=False)
    axes.set_title(title, loc="left", pad=2)
    mark = {"marker": [(-1, -0.7), (1, 0.7)], "markersize": 5, "linestyle": "none", "color": BLACK, "clip_on": False}
    axes.plot([0], [0], transform=axes.transAxes, **mark)
