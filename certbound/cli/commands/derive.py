"""``certbound derive``: the contraction and noise constants of a problem, proved."""

from __future__ import annotations

import contextlib
import logging
import time
from typing import TYPE_CHECKING, Any

import numpy as np

from certbound.cli.clock import Clock, TimeLimitOption
from certbound.cli.describe import describe_constants
from certbound.cli.messages import computing
from certbound.cli.options import HorizonOption, JsonOption, ProblemArgument, SetOption, examples, load_problem
from certbound.cli.output import SETTINGS, console, show
from certbound.cli.progress import progress
from certbound.display import log10_text, name_text
from certbound.errors import EnclosureError, InfeasibleError, SolverError
from certbound.watch import OutOfTime, poll

if TYPE_CHECKING:
    from rich.table import Table

    from certbound.problem.problem import Problem
    from certbound.tubes.constants import Constants

EXAMPLES = examples("certbound derive chain --json", "certbound derive unicycle --time-limit 20")
_log = logging.getLogger(__name__)


def derive(
    problem: ProblemArgument,
    pairs: SetOption = None,
    horizon: HorizonOption = None,
    time_limit: TimeLimitOption = None,
    as_json: JsonOption = False,
) -> None:
    """Bound the contraction rate (or gain) and the noise, with a metric for each constraint."""
    from certbound.problem.goals import check_end

    subject = load_problem(problem, pairs, horizon=horizon)
    check_end(subject, "a rate along the trajectory")
    started = time.perf_counter()
    with (
        progress(f"bounding the constants of {name_text(subject.name)}", time_limit) as tell,
        computing("constants", subject),
    ):
        constants, metrics, where = _bound(subject, Clock(time_limit, tell))
    seconds = time.perf_counter() - started
    result = {
        **describe_constants(constants),
        "domain": where,
        "status": None if constants.proof is None else constants.proof.status,
        "metrics": [
            {"constraint": constraint.label, **describe_constants(one)}
            for constraint, one in zip(subject.safe, metrics)
        ],
        "seconds": seconds,
    }
    show(result, as_json, lambda: _print(constants, result))


def _bound(subject: Problem, clock: Clock) -> tuple[Constants, list[Constants], str]:
    """Constants and where they hold: the domain, all of R^n, or else along the noise-free reach tube.

    With a limit, quick constants in the Euclidean norm come first, and are what is left when the time is over.
    """
    if clock.limit is None:
        with clock.running():
            return _searched(subject)
    from certbound.constants.bounds import bound_constants

    found: tuple[Constants, list[Constants], str] | None = None
    with contextlib.suppress(OutOfTime):
        with clock.running(), contextlib.suppress(EnclosureError, InfeasibleError):
            quick = bound_constants(subject, metric="euclidean")
            found = quick, [], "stated" if quick.proof is None else quick.proof.domain
        with clock.running():
            found = _searched(subject)
    if found is None:
        raise SolverError(f"no constants were proved within {clock.limit:g} s; give a larger --time-limit")
    return found


def _searched(subject: Problem) -> tuple[Constants, list[Constants], str]:
    from certbound.constants.bounds import bound_constants
    from certbound.constants.metrics import bound_metrics

    try:
        poll("one metric for all constraints")
        constants = bound_constants(subject)
        poll("a metric for each constraint")
        where = constants.proof.domain if constants.proof is not None else "stated"
        return constants, list(bound_metrics(subject)), where
    except (EnclosureError, InfeasibleError) as error:
        if subject.domain is not None:
            raise
        _log.info("no constants hold everywhere: %s", error)
    constants, where = _local(subject)
    return constants, [], f"{where} (no constants hold on all of R^n)"


def _local(subject: Problem) -> tuple[Constants, str]:
    """Constants along the reach tube with noise (Thm K4), or without where none was proved; and where they hold."""
    from certbound.constants.fitted import fitted_constants_along
    from certbound.reach import bound_reach
    from certbound.rigor.intervals import Interval

    horizon = float(subject.horizon)
    poll("along the reach tube, for no constants hold everywhere")
    try:
        reach = bound_reach(subject)
        odds = f"left with probability at most {log10_text(reach.log10_delta, ulps=2)}"
    except (ArithmeticError, InfeasibleError) as error:
        _log.info("no tube with noise: %s", error)
        reach = bound_reach(subject, noise=False)
        odds = "with no room for the noise, for no tube with noise confirmed itself"
    kind = "reach set + tube" if reach.noise else "noise-free reach set"
    unit = "s" if reach.curve.continuous else "steps"
    where = f"the {kind}, box by box in time, up to {reach.end:g} {unit}, {odds}"
    if reach.end < horizon:
        where += f"; it ends before {horizon:g} {unit}, where no guess of its size confirmed itself"
    boxes, times = reach.hull, reach.curve.starts
    if reach.curve.continuous:
        times = np.append(times, reach.curve.ends[-1])
    else:
        boxes = Interval(boxes.lo[:-1], boxes.hi[:-1])
    return fitted_constants_along(subject, times, boxes), where


def _print(constants: Constants, result: dict[str, Any]) -> None:
    screen = console()
    name = "rate" if constants.continuous else "gain"
    unit = "1/s" if constants.continuous else "per step"
    origin = "certified" if constants.certified else "stated, not certified"
    screen.print(f"{name} {_range(getattr(constants, name))} {unit}, {origin}", markup=False)
    if SETTINGS.quiet:
        return
    screen.print(f"sigma {_range(constants.sigma)}, effective dimension {constants.nu:.4g} of {constants.dimension}")
    if constants.gap is not None:
        screen.print(f"at most {constants.gap:.3g} above what sampling found")
    screen.print(f"holds on {result['domain']}", markup=False)
    screen.print(f"proposed by: {result['status']}", markup=False)
    if result["metrics"]:
        screen.print(_table(name, [{"constraint": "all in one", **result}, *result["metrics"]]))
    screen.print(f"{result['seconds']:.2f} s")


def _table(name: str, rows: list[dict[str, Any]]) -> Table:
    """A row per metric: its norm, certified value and gap, noise, condition, and the constraint that it serves."""
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for heading in ("serves", "norm", name, "gap", "sigma", "eff. dimension", "cond(P)"):
        table.add_column(heading)
    for row in rows:
        metric, gap = row["metric"], row["gap"]
        table.add_row(
            row["constraint"],
            "Euclidean" if metric is None else "weighted",
            _range(row[name]),
            "-" if gap is None else f"{gap:.2g}",
            _range(row["sigma"]),
            f"{row['effective_dimension']:.4g}",
            "1" if metric is None else f"{np.linalg.cond(np.asarray(metric)):.3g}",
        )
    return table


def _range(value: Any) -> str:
    values = np.atleast_1d(np.asarray(value, dtype=float))
    low, high = float(values.min()), float(values.max())
    return f"{high:.6g}" if low == high else f"{low:.4g} .. {high:.4g}"
