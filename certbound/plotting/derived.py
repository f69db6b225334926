"""What ``derive`` found: rates, the metrics that they hold in, and which entries the Jacobian has."""

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

    from certbound.constants.moving import MovingConstants

_NAMED = 20  # states whose names fit along an axis
_LABEL = 28  # characters of a metric's name that fit beside its bar


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
