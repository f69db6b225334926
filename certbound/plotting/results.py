"""Results into axes that the user brings: what ``result.plot(ax)`` draws."""

from __future__ import annotations

from collections.abc import Sequence
from functools import singledispatch
from typing import TYPE_CHECKING, Any

import numpy as np

from certbound.checks import nearest
from certbound.plotting.asked import Panel, panels_of
from certbound.plotting.panels import draw_panel
from certbound.plotting.picture import tightest
from certbound.plotting.plane import draw_plane, plane_of
from certbound.plotting.scene import BLUE, INK, OUTER, Scene
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


States = Sequence[str | int] | str | int | None


def draw_chosen(result: Any, axes: Axes, states: States, times: tuple[float, float] | None) -> None:
    """Draw a result, or of one with states the chosen ones, into axes; over time from the first to the second time."""
    if times is not None and not times[0] < times[1]:
        raise ValueError(f"`times` must be (first, last) in order, got {times!r}.")
    if states is None:
        draw(result, axes)
    else:
        _draw_states(_scene_of(result), axes, states, times)
    if times is not None and axes.get_xlabel().startswith("time"):
        axes.set_xlim(times)


def _scene_of(result: Any) -> Scene:
    """The scene of a verdict, or of a problem without noise."""
    if isinstance(result, Verdict):
        return Scene.of(result)
    if isinstance(result, Problem):
        from certbound.reach.dispatch import bound_reach

        return Scene(problem=result, reach=bound_reach(result, noise=False))
    raise ValueError(f"`states` must be omitted for a {type(result).__name__}; verdicts and problems have them.")


def _draw_states(scene: Scene, axes: Axes, states: States, times: tuple[float, float] | None) -> None:
    names = scene.problem.system.states
    chosen = [states] if isinstance(states, (str, int)) else list(states or ())
    numbers = [_number(name, names) for name in chosen]
    if times is not None:
        scene = scene.between(*times)
    if len(numbers) == 2:
        draw_plane(axes, scene, (numbers[0], numbers[1]))
    elif len(numbers) == 1:
        row = np.eye(len(names))[numbers[0]]
        known = [one for one in panels_of(scene.problem) if one.direction is not None and (one.direction == row).all()]
        draw_panel(axes, scene, known[0] if known else Panel(label=names[numbers[0]], direction=row))
        axes.set(xlabel=scene.problem.time_axis, ylabel=scene.problem.axis(names[numbers[0]]))
        axes.set_title("")
    else:
        raise ValueError(f"`states` must be one state over time or two in their plane, got {len(numbers)}.")


def _number(state: str | int, names: tuple[str, ...]) -> int:
    if isinstance(state, str) and state not in names:
        raise ValueError(f"`states` must be among {', '.join(names)}, got {state!r}{nearest(state, names)}")
    number = names.index(state) if isinstance(state, str) else state
    if not 0 <= number < len(names):
        raise ValueError(f"`states` must be below {len(names)}, got {number}.")
    return number


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
    scene = Scene.of(result)
    plane = plane_of(scene.problem)
    if plane is not None:
        draw_plane(axes, scene, plane)
    else:
        (panel,) = tightest(scene, panels_of(scene.problem), 1)
        draw_panel(axes, scene, panel)
        axes.set(xlabel=scene.problem.time_axis, ylabel=panel.label)
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
    axis = result.problem.time_axis
    axes.step(result.times, result.upper, where="pre", color=OUTER, linewidth=1.4, label="at most")
    axes.step(result.times, result.lower, where="post", color=BLUE, linewidth=1.4, linestyle=(0, (4, 1.5)),
              label="at least")  # fmt: skip
    axes.set(xlabel=axis, ylabel="P(exit before)", ylim=(0, 1.02), xlim=(0, float(result.problem.horizon)))
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
        axes.set_xlabel(result.time_axis)
    axes.set_title(result.summary(), fontsize="small")


def _time(continuous: bool) -> str:
    return "time (s)" if continuous else "time (steps)"
