"""Results into axes that the user brings: what ``result.plot(ax)`` draws."""

from __future__ import annotations

from functools import singledispatch
from typing import TYPE_CHECKING, Any

import numpy as np

from certbound.plotting.asked import panels_of
from certbound.plotting.panels import draw_panel
from certbound.plotting.plane import draw_plane, plane_of
from certbound.plotting.scene import BLUE, INK, OUTER, Scene, noisy_reach
from certbound.plotting.sweep_maps import draw_sweep_into
from certbound.plotting.value_maps import draw_curves, draw_map, slices_of
from certbound.problem.problem import Problem
from certbound.reach.sets import ReachTube
from certbound.safety.answers import Deviation
from certbound.safety.first_exits import ExitTimes
from certbound.safety.starts import SafeStarts
from certbound.safety.sweeps import Sweep
from certbound.safety.verification import Verdict
from certbound.tubes.constants import Constants
from certbound.tubes.tube import Tube

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@singledispatch
def draw(result: Any, axes: Axes) -> None:
    """Draw a result into axes: a Verdict, Problem, Tube, ReachTube, Deviation or Constants.

    What cannot be drawn is a TypeError, or a ValueError where nothing was proved.
    """
    raise TypeError(f"a {type(result).__name__} cannot be drawn.")


@draw.register(Tube)
def _tube(result: Tube, axes: Axes) -> None:
    columns = result.to_columns()
    style = "-" if result.constants.continuous else "."
    axes.plot(columns["time"], columns["radius"], style, color=BLUE, label=result.method)
    axes.set(xlabel=_time(result.constants.continuous), ylabel="radius", ylim=(0, None))


@draw.register(Constants)
def _constants(result: Constants, axes: Axes) -> None:
    name = "rate" if result.continuous else "gain"
    times = np.array([0.0, 1.0]) if result.times is None else result.times
    values = np.broadcast_to(np.asarray(getattr(result, name), dtype=float), len(times) - 1)
    axes.stairs(values, times, baseline=None, color=INK, label=name)
    axes.set(xlabel=_time(result.continuous), ylabel=name)
    if result.times is None:
        axes.set_xticks([])


@draw.register(Deviation)
def _deviation(result: Deviation, axes: Axes) -> None:
    axes.stairs(result.radius, result.times, color=OUTER, fill=True, label="stochastic deviation")
    axes.set(xlabel="time", ylabel="size of X - x", ylim=(0, None))


@draw.register(ReachTube)
def _reach(result: ReachTube, axes: Axes) -> None:
    columns = result.to_columns()
    for index in range(result.curve.dimension):
        name = f"x{index + 1}"
        low, high = (np.repeat(columns[f"{name}_{end}"], 2) for end in ("low", "high"))
        times = np.stack([columns["start"], columns["end"]], axis=1).ravel()
        axes.fill_between(times, low, high, alpha=0.4, linewidth=0, label=name)
    axes.set_xlabel(_time(result.curve.continuous))
    axes.legend()


@draw.register(Verdict)
def _verdict(result: Verdict, axes: Axes) -> None:
    if result.problem is None or result.reach is None:
        raise ValueError(f"nothing was proved that could be drawn; {result.reason}")
    scene = Scene(problem=result.problem, reach=result.reach, tube=noisy_reach(result))
    plane = plane_of(result.problem)
    if plane is not None:
        draw_plane(axes, scene, plane)
    else:
        panels = panels_of(result.problem)
        tightest = [c.label for c in result.problem.safe].index(result.constraint) if _named(result) else 0
        draw_panel(axes, scene, panels[min(tightest, len(panels) - 1)])
        axes.set_xlabel(_time(result.reach.curve.continuous))
    axes.set_title(result.summary(), fontsize="small")


@draw.register(SafeStarts)
def _starts(result: SafeStarts, axes: Axes) -> None:
    slices = list(slices_of(result))
    if slices:
        draw_map(axes, result, slices[0][0], slices[0][2])
    else:
        draw_curves(axes, result)
    axes.set_title(result.summary(), fontsize="small")


@draw.register(ExitTimes)
def _exit_times(result: ExitTimes, axes: Axes) -> None:
    continuous = result.problem.system.time == "continuous"
    axes.step(result.times, result.upper, where="pre", color=OUTER, linewidth=1.4, label="at most")
    axes.step(result.times, result.lower, where="post", color=BLUE, linewidth=1.4, linestyle=(0, (4, 1.5)),
              label="at least")  # fmt: skip
    axes.set(xlabel=_time(continuous), ylabel="P(exit before)", ylim=(0, 1.02), xlim=(0, float(result.problem.horizon)))
    axes.legend()
    axes.set_title(result.summary(), fontsize="small")


@draw.register(Sweep)
def _sweep(result: Sweep, axes: Axes) -> None:
    draw_sweep_into(axes, result)
    axes.set_title(result.summary(), fontsize="small")


@draw.register(Problem)
def _problem(result: Problem, axes: Axes) -> None:
    from certbound.reach.dispatch import bound_reach

    reach = bound_reach(result, noise=False)
    plane = plane_of(result)
    scene = Scene(problem=result, reach=reach)
    if plane is not None:
        draw_plane(axes, scene, plane)
    else:
        draw_panel(axes, scene, panels_of(result)[0])
        axes.set_xlabel(_time(reach.curve.continuous))
    axes.set_title(result.summary(), fontsize="small")


def _named(verdict: Verdict) -> bool:
    return verdict.problem is not None and verdict.constraint in [c.label for c in verdict.problem.safe]


def _time(continuous: bool) -> str:
    return "time (s)" if continuous else "time (steps)"
