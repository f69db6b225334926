"""``certbound exit-times``: when a path of one state leaves, as certified curves and a mean."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import typer

from certbound.cli.clock import Clock, VerdictLimitOption
from certbound.cli.options import (
    HorizonOption,
    JsonOption,
    PlotOption,
    ProblemArgument,
    SetOption,
    check_writable,
    examples,
    load_problem,
)
from certbound.cli.output import SETTINGS, console, show, spinner
from certbound.cli.pictures import check_picture, write_picture
from certbound.cli.progress import progress
from certbound.display import name_text

if TYPE_CHECKING:
    from certbound.safety.first_exits import ExitTimes

EXAMPLES = examples(
    "certbound exit-times ou --set radius=1",
    "certbound exit-times my_system.toml --plot exits.png",
)

DEFAULT_LIMIT = 60.0


def exit_times(
    problem: ProblemArgument,
    pairs: SetOption = None,
    horizon: HorizonOption = None,
    plot: PlotOption = None,
    time_limit: VerdictLimitOption = None,
    as_json: JsonOption = False,
) -> None:
    """Bound the probability of leaving before every time up to the horizon, and the mean time (one state)."""
    check_writable(plot, problem=problem)
    check_picture(plot)
    subject = load_problem(problem, pairs, horizon=horizon)
    started, limit = time.perf_counter(), DEFAULT_LIMIT if time_limit is None else time_limit
    with progress(f"bounding the exit times of {name_text(subject.name)}", limit) as tell:
        from certbound.safety.first_exits import bound_exit_times

        with Clock(limit, tell).running():
            found = bound_exit_times(subject, by_limit=as_json)
    result: dict[str, Any] = {**found.to_dict(), "seconds": time.perf_counter() - started}
    if plot is not None:
        from matplotlib.figure import Figure

        from certbound.plotting.results import draw

        with spinner("drawing"):
            figure = Figure(figsize=(6.4, 4.0), layout="constrained")
            draw(found, figure.add_subplot())
            write_picture(plot, figure)
    show(result, as_json, lambda: _print(found, result["seconds"]))
    raise typer.Exit(0)


def _print(found: ExitTimes, seconds: float) -> None:
    screen = console()
    screen.print(found.summary(), markup=False)
    if SETTINGS.quiet:
        return
    for label, value in found.rows():
        screen.print(f"  {label:<16} {value}", markup=False)
    screen.print(f"{len(found.times)} times, {seconds:.1f} s", markup=False)
