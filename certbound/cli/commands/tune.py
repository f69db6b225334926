"""``certbound tune``: every valid tube of a problem, side by side."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from certbound.cli.clock import Clock, TimeLimitOption
from certbound.cli.describe import describe_parameters
from certbound.cli.messages import computing
from certbound.cli.options import (
    DeltaOption,
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
from certbound.cli.pictures import check_picture, sampled, write_picture
from certbound.cli.progress import progress
from certbound.display import name_text
from certbound.errors import SolverError
from certbound.watch import OutOfTime, poll

if TYPE_CHECKING:
    from certbound.problem.problem import Problem
    from certbound.tubes.constants import Constants
    from certbound.tubes.tube import Tube

SAMPLES = 513
EXAMPLES = examples(
    "certbound tune ou --json",
    "certbound tune ou --plot tubes.png",
    "certbound tune chain_rest --delta 1e-6 --time-limit 30",
)
_log = logging.getLogger(__name__)


def tune(
    problem: ProblemArgument,
    pairs: SetOption = None,
    horizon: HorizonOption = None,
    delta: DeltaOption = None,
    time_limit: TimeLimitOption = None,
    plot: PlotOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compute the probabilistic tube by every method that applies, and say which is smallest."""
    check_writable(plot, problem=problem)
    check_picture(plot)
    from certbound.problem.goals import check_end

    subject = load_problem(problem, pairs, horizon=horizon, delta=delta)
    check_end(subject, "a tube")
    rows: list[dict[str, Any]] = []
    tubes: dict[str, Tube] = {}
    constants: Constants | None = None
    with (
        contextlib.suppress(OutOfTime),
        progress(f"tuning tubes for {name_text(subject.name)}", time_limit) as tell,
        Clock(time_limit, tell).running(),
        computing("constants", subject),
    ):
        from certbound.constants.bounds import bound_constants

        poll("constants")
        constants = bound_constants(subject)
        for tube, row in _rows(constants, subject.horizon, subject.delta):
            rows.append(row)
            tubes.setdefault(row["method"], tube)
    valid = [row for row in rows if row["level"] == "trajectory" and not row["method"].endswith("_as_printed")]
    if (constants is None or not valid) and time_limit is not None:
        raise SolverError(f"no tube was computed within {time_limit:g} s; give a larger --time-limit")
    if constants is None or not valid:
        raise SolverError(f"no tube along whole trajectories was found for {subject.name}; try verify, it has others")
    best = min(valid, key=lambda row: row["maximum"])["method"]
    if plot is not None:
        _draw(subject, tubes, best, plot)
    norm = "" if constants.metric is None else " (radii in the norm of the certified metric)"
    show({"method": best, "rows": rows}, as_json, lambda: _print(best, rows, norm))


def _draw(problem: Problem, tubes: dict[str, Tube], best: str, path: Path) -> None:
    from certbound.plotting import draw_tubes

    sizes, metric = None, tubes[best].constants.metric
    with spinner("drawing"):
        states = sampled(problem, deviation=True)
        if states is not None:
            sizes = np.linalg.norm(states if metric is None else states @ np.linalg.cholesky(metric), axis=-1)
        write_picture(path, draw_tubes(tubes, best, sizes))


def _rows(constants: Constants, horizon: float, delta: float) -> Iterator[tuple[Tube, dict[str, Any]]]:
    """Every method whose hypotheses hold, its parameters tuned; the paper's windows also with its own ones."""
    from certbound.tubes.tuning import METHODS, tune_tube

    asked: list[tuple[str, dict[str, float]]] = [(method, {}) for method in METHODS if method != "auto"]
    window = horizon / 100 if constants.continuous else 1
    asked += [(method, {"epsilon": 15 / 16, "step": window}) for method in ("thm3", "thm5")]
    for method, fixed in asked:
        started = time.perf_counter()
        try:
            poll(f"the tube {method}")
            tube = tune_tube(constants, horizon=horizon, delta=delta, method=method, **fixed)  # type: ignore[arg-type]  # floats by name
        except (ValueError, ArithmeticError) as error:
            _log.debug("%s does not apply: %s", method, error)
            continue
        yield tube, _row(tube, method, horizon, time.perf_counter() - started, constants.continuous)


def _row(tube: Tube, method: str, horizon: float, seconds: float, continuous: bool) -> dict[str, Any]:
    times = np.linspace(0.0, horizon, SAMPLES) if continuous else np.arange(int(horizon) + 1.0)
    radii = np.asarray(tube.radius(times))
    mean = float(np.trapezoid(radii, times) / horizon) if continuous else float(radii[1:].mean())
    return {
        "method": method,
        "level": tube.level,
        "final": float(radii[-1]),
        "maximum": float(max(tube.bound(0.0, horizon), radii.max())),
        "mean": mean,
        "parameters": describe_parameters(tube),
        "seconds": seconds,
    }


def _print(best: str, rows: list[dict[str, Any]], norm: str) -> None:
    screen = console()
    if SETTINGS.quiet:
        screen.print(best)
        return
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for heading in ("method", "level"):
        table.add_column(heading)
    for heading in ("largest", "final", "mean"):
        table.add_column(heading, justify="right")
    table.add_column("parameters", overflow="fold")
    for row in sorted(rows, key=lambda row: row["maximum"]):
        name = f"[bold]{row['method']}[/]" if row["method"] == best else row["method"]
        numbers = (f"{row[key]:.4f}" for key in ("maximum", "final", "mean"))
        parameters = ", ".join(f"{key} {_short(value)}" for key, value in row["parameters"].items())
        table.add_row(name, row["level"], *numbers, parameters)
    screen.print(table)
    screen.print(f"smallest trajectory-level tube: {best}{norm}")


def _short(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return f"({len(value)})"
    return f"{value:.4g}" if isinstance(value, (int, float)) else str(value)
