"""What `derive` and `tune` found: rates and the metrics they hold in, and the radii of tubes, side by side."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from certbound.arrays import Array
from certbound.plotting.scene import BLUE, GREY, VERMILION
from certbound.problem.model import is_zero, jacobian, sources
from certbound.problem.problem import Problem
from certbound.tubes.constants import Constants

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from certbound.constants.fitted import MovingConstants
    from certbound.tubes.tube import Tube

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
DASHES = ("-", "--", "-.", ":")
HEIGHT = 3.0
_NAMED = 20  # states whose names fit along an axis
_LABEL = 28  # characters of a metric's name that fit beside its bar


def draw_tubes(tubes: Mapping[str, Tube], chosen: str, deviations: Array | None = None) -> Figure:
    """A figure of r_t for every tube, the chosen one in bold, over the sizes ||S_t||_P of sample paths.

    All tubes (by label) are for the same constants and horizon; the chart ends at three times the largest radius of the
    ``chosen`` one: wider tubes leave it. ``deviations``, shape (path, time), are norms at equally spaced times from 0
    to the horizon.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes = figure.subplots()
    best = tubes[chosen]
    continuous = best.constants.continuous
    if deviations is not None:
        times = np.linspace(0.0, best.horizon, deviations.shape[1])
        axes.plot(times, deviations.T, color="0.75", linewidth=0.5, zorder=1)
    grid = np.linspace(0.0, best.horizon, 401) if continuous else np.arange(best.horizon + 1)
    for index, (label, tube) in enumerate(tubes.items()):
        colour, dash = COLOURS[index % len(COLOURS)], DASHES[index // len(COLOURS) % len(DASHES)]
        bold = label == chosen
        name = label if tube.level == "trajectory" else f"{label} (one time)"
        axes.plot(
            grid, tube.radius(grid), linewidth=2.6 if bold else 1.1, zorder=4 if bold else 3,
            label=f"{name}: chosen" if bold else name, color=colour, linestyle=dash,
        )  # fmt: skip
    axes.set_xlim(0.0, best.horizon)
    axes.set_ylim(0.0, HEIGHT * best.maximum if 0 < best.maximum < np.inf else None)
    axes.set_xlabel("time (s)" if continuous else "step")
    axes.set_ylabel("radius" if best.constants.metric is None else "radius in the norm of the metric")
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=7, frameon=False)
    return figure


def draw_constants(
    problem: Problem, found: Mapping[str, Constants], moving: MovingConstants | None = None
) -> Figure:
    """Three charts: rates (or gains), over time or by metric; eigenvalues of the metrics; entries of the Jacobian.

    ``found`` are constants by what they serve, the first of them for all.
    """
    from matplotlib.figure import Figure

    count = len(found)
    figure = Figure(figsize=(11.0, max(3.4, 1.6 + 0.22 * count)), layout="constrained")
    rates, spectra, entries = figure.subplots(1, 3)
    first = next(iter(found.values()))
    _rates_over_time(rates, problem, first, moving) if first.times is not None else _rates_by_metric(rates, found)
    _spectra(spectra, problem, found, moving)
    _entries(entries, problem)
    return figure


def _rates_over_time(axes: Axes, problem: Problem, constants: Constants, moving: MovingConstants | None) -> None:
    assert constants.times is not None
    still = np.broadcast_to(np.asarray(constants.slope), (len(constants.times) - 1,))
    axes.stairs(still, constants.times, baseline=None, color=BLUE, linewidth=1.4, label="one metric")
    if moving is not None:
        axes.stairs(moving.rate, moving.times, baseline=None, color=VERMILION, linewidth=1.4, linestyle=(0, (4, 1.5)),
                    label="moving coordinates")  # fmt: skip
        axes.legend(fontsize=7, frameon=False)
    axes.axhline(0.0 if constants.continuous else 1.0, color=GREY, linewidth=0.6)
    axes.set(xlabel=problem.time_axis, ylabel=_quantity(constants), title="certified rates")


def _rates_by_metric(axes: Axes, found: Mapping[str, Constants]) -> None:
    values = [constants.worst_slope for constants in found.values()]
    places = np.arange(len(values))
    first = next(iter(found.values()))
    axes.axvline(0.0 if first.continuous else 1.0, color=GREY, linewidth=0.6)
    axes.scatter(values, places, s=36, color=_colours(found), zorder=3)
    axes.set_yticks(places, [_short(name) for name in found], fontsize=7)
    axes.set_ylim(len(values) - 0.4, -0.6)
    axes.margins(x=0.15)
    axes.ticklabel_format(axis="x", useOffset=False)
    axes.set(xlabel=_quantity(first), title="certified, by metric")


def _spectra(axes: Axes, problem: Problem, found: Mapping[str, Constants], moving: MovingConstants | None) -> None:
    if moving is not None:
        axes.set_yscale("log")
        values = np.linalg.eigvalsh(np.swapaxes(moving.frames, -1, -2) @ moving.frames)
        axes.plot(moving.times, values, color=VERMILION, linewidth=1.4, linestyle=(0, (4, 1.5)))
        for value in np.linalg.eigvalsh(next(iter(found.values())).matrix):
            axes.axhline(value, color=BLUE, linewidth=1.4)
        axes.set(xlabel=problem.time_axis)
    else:
        axes.set_xscale("log")
        for place, (constants, colour) in enumerate(zip(found.values(), _colours(found))):
            values = np.linalg.eigvalsh(constants.matrix)
            axes.scatter(values, np.full(len(values), place), s=36, marker="|", color=colour)
        axes.set_yticks(np.arange(len(found)), [""] * len(found))
        axes.set_ylim(len(found) - 0.4, -0.6)
    axes.set(title="eigenvalues of P")


def _entries(axes: Axes, problem: Problem) -> None:
    """Entries that are constant in grey, those that change in blue, zeros white."""
    from matplotlib.colors import ListedColormap

    n = problem.system.dimension
    tape = jacobian(problem.closed_loop, tuple(range(1, n + 1)))
    depends = sources(tape)
    kinds: Array = np.array([0.0 if is_zero(tape, k) else 2.0 if depends[k] else 1.0 for k in range(n * n)])
    share = 100 * np.mean(kinds == 0.0)
    axes.imshow(kinds.reshape(n, n), cmap=ListedColormap(["white", GREY, BLUE]), vmin=0.0, vmax=2.0)
    names: Any = problem.system.states
    if n <= _NAMED:
        axes.set_xticks(np.arange(n), names, rotation=90, fontsize=7)
        axes.set_yticks(np.arange(n), names, fontsize=7)
    axes.set(title=f"Jacobian, {share:.0f} % zero", xlabel="by (grey: constant, blue: not)", ylabel="of")


def _colours(found: Mapping[str, Constants]) -> list[str]:
    return [BLUE, *[VERMILION] * (len(found) - 1)]


def _quantity(constants: Constants) -> str:
    return "rate (1/s)" if constants.continuous else "gain per step"


def _short(name: str) -> str:
    return name if len(name) <= _LABEL else name[: _LABEL - 1] + "…"
