"""``certbound derive``: the contraction and noise constants of a problem, proved."""

from __future__ import annotations

import contextlib
import difflib
import logging
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from certbound.cli.clock import Clock, TimeLimitOption
from certbound.cli.describe import attributes, describe_constants
from certbound.cli.messages import InputError, computing
from certbound.cli.options import (
    HorizonOption,
    JsonOption,
    PlotOption,
    ProblemArgument,
    SetOption,
    check_writable,
    examples,
    integer,
    load_problem,
    option,
)
from certbound.cli.output import SETTINGS, console, show
from certbound.cli.pictures import check_picture, write_picture
from certbound.cli.progress import progress
from certbound.display import log10_text, name_text
from certbound.errors import EnclosureError, InfeasibleError, SolverError
from certbound.watch import OutOfTime, poll

if TYPE_CHECKING:
    from rich.table import Table

    from certbound.constants.fitted import MovingConstants
    from certbound.problem.problem import Problem
    from certbound.rigor.intervals import Interval
    from certbound.tubes.constants import Constants

EXAMPLES = examples(
    "certbound derive chain --json",
    "certbound derive unicycle --time-limit 20 --plot rates.png",
    'certbound derive chain --constraint "v3 <= 2"',
    "certbound derive chain_rest --set masses=20 --constraint all --jobs 2",
)
MOST_UNASKED = 24
"""States up to which every constraint gets a metric of its own unless something else is asked for."""
ConstraintOption = Annotated[
    list[str] | None,
    option("--constraint", "NAME", "A metric of its own for this one (repeat for more), for all, or none [all]."),
]
JobsOption = Annotated[int, option("--jobs", "N", "Processes that work on metrics side by side [1].", integer)]
_log = logging.getLogger(__name__)


def derive(
    problem: ProblemArgument,
    pairs: SetOption = None,
    horizon: HorizonOption = None,
    constraint: ConstraintOption = None,
    jobs: JobsOption = 1,
    plot: PlotOption = None,
    time_limit: TimeLimitOption = None,
    as_json: JsonOption = False,
) -> None:
    """Bound the contraction rate (or gain) and the noise, with a metric for each constraint."""
    from certbound.problem.goals import check_end

    check_writable(plot, problem=problem)
    check_picture(plot)
    subject = load_problem(problem, pairs, horizon=horizon)
    check_end(subject, "a rate along the trajectory")
    asked = _Asked(_places(subject, constraint), _checked_jobs(jobs), live=not as_json)
    started = time.perf_counter()
    with (
        progress(f"bounding the constants of {name_text(subject.name)}", time_limit) as tell,
        computing("constants", subject),
    ):
        constants, metrics, where, moving = _bound(subject, asked, Clock(time_limit, tell))
    seconds = time.perf_counter() - started
    result = {
        **describe_constants(constants),
        "domain": where,
        "status": None if constants.proof is None else constants.proof.status,
        "metrics": [
            {"constraint": subject.constraints[place].label, **describe_constants(one)}
            for place, one in sorted(metrics.items())
        ],
        "moving": None if moving is None else moving.describe(),
        "seconds": seconds,
    }
    if plot is not None:
        from certbound.plotting import draw_constants

        labels = {subject.constraints[place].label: one for place, one in sorted(metrics.items())}
        write_picture(
            plot, draw_constants(subject, {"all in one": constants, **labels}, None if moving is None else moving.found)
        )
    show(result, as_json, lambda: _print(constants, moving, result))


@dataclass(frozen=True)
class _Asked:
    """Which constraints get a metric of their own, on how many processes, and whether each is printed when found."""

    places: list[int]
    jobs: int
    live: bool


def _places(subject: Problem, names: list[str] | None) -> list[int]:
    """Places of the constraints that are asked for."""
    labels = [constraint.label for constraint in subject.safe]
    if names is None:
        return list(range(len(labels))) if subject.system.dimension <= MOST_UNASKED else []
    if names == ["none"]:
        return []
    if "all" in names:
        return list(range(len(labels)))
    for name in names:
        if name not in labels:
            nearest = difflib.get_close_matches(name, labels, n=1, cutoff=0.0)[0]
            raise InputError(f"no constraint is called `{name}`", f'the nearest is "{nearest}"; or give all')
    return [place for place, label in enumerate(labels) if label in names]


def _checked_jobs(jobs: int) -> int:
    if jobs < 1:
        raise InputError(f"`--jobs` must be positive, got {jobs}", "give a number of processes such as 2")
    return jobs


@dataclass(frozen=True, eq=False)
class _Moving:
    """Rates in moving coordinates, and how far |W (X - x)| comes, in the ``states`` that are asked about."""

    found: MovingConstants
    delta: float
    left: float  # log10 of the probability that paths leave the boxes where the rates hold
    states: list[str]
    radius: float
    standing_radius: float  # by the constants of the metric that stands still

    def describe(self) -> dict[str, Any]:
        names = ("times", "rate", "sigma", "effective_dimension", "integral", "frames")
        own = attributes(self, "delta", "states", "radius", "standing_radius")
        return {**attributes(self.found, *names), **own, "log10_left": self.left}


Found = tuple["Constants", dict[int, "Constants"], str, _Moving | None]


def _bound(subject: Problem, asked: _Asked, clock: Clock) -> Found:
    """Constants and where they hold: the domain, all of R^n, or else along the noise-free reach tube.

    With a limit, quick constants in the Euclidean norm come first; what is found when the time is over is kept.
    """
    found: list[Found] = []
    if clock.limit is None:
        with clock.running():
            _search(subject, asked, found)
        return found[-1]
    from certbound.constants.bounds import bound_constants

    with contextlib.suppress(OutOfTime):
        with clock.running(), contextlib.suppress(EnclosureError, InfeasibleError):
            quick = bound_constants(subject, metric="euclidean")
            found.append((quick, {}, "stated" if quick.proof is None else quick.proof.domain, None))
        with clock.running():
            _search(subject, asked, found)
    if not found:
        raise SolverError(f"no constants were proved within {clock.limit:g} s; give a larger --time-limit")
    return found[-1]


def _search(subject: Problem, asked: _Asked, found: list[Found]) -> None:
    """Append what is found: the common metric first, to which those of single constraints are added one by one."""
    from certbound.constants.bounds import bound_constants
    from certbound.constants.metrics import each_metric

    try:
        poll("one metric for all constraints")
        constants = bound_constants(subject)
        metrics: dict[int, Constants] = {}
        found.append((constants, metrics, constants.proof.domain if constants.proof is not None else "stated", None))
        if not asked.places:
            return
        poll("a metric for each constraint")
        for place, one in each_metric(subject, only=asked.places, jobs=asked.jobs):
            metrics[place] = one
            if asked.live and not SETTINGS.quiet:
                console().print(f"{subject.constraints[place].label}: {one.summary()}", markup=False)
        return
    except (EnclosureError, InfeasibleError) as error:
        if subject.domain is not None:
            raise
        _log.info("no constants hold everywhere: %s", error)
    constants, where, boxes, left = _local(subject)
    where = f"{where} (no constants hold on all of R^n)"
    found.append((constants, {}, where, None))
    if left is not None and constants.continuous and constants.dimension > 1:
        with contextlib.suppress(ArithmeticError, InfeasibleError, ValueError):
            found.append((constants, {}, where, _moving(subject, constants, boxes, left)))


def _moving(subject: Problem, constants: Constants, boxes: Interval, left: float) -> _Moving:
    """The same in coordinates that move, which make the deviation small where constraints ask about it.

    A tube by them holds but for delta and the probability that paths leave the boxes.
    """
    from certbound.constants.fitted import moving_constants_along
    from certbound.tubes.tuning import tune_tube

    asked = _states_asked(subject)
    rows = np.eye(constants.dimension)[asked]
    assert constants.times is not None
    end, delta = float(constants.times[-1]), subject.delta
    found = moving_constants_along(subject, constants.times, boxes, directions=rows)
    radius = found.extent(tune_tube(found.constants(), horizon=end, delta=delta), rows)
    standing = tune_tube(constants, horizon=end, delta=delta).bound(0.0, end) * constants.norm.section(rows)
    names = [subject.system.states[k] for k in asked]
    return _Moving(found, delta, left, names, float(np.max(radius)), float(standing))


def _states_asked(subject: Problem) -> list[int]:
    """Places of the states that a constraint bounds; all where none does."""
    asked: set[int] = set()
    for part in subject.constraints:
        places = part.region.places(subject.system.dimension)
        normals = getattr(part.region.form, "normals", np.eye(len(places)))
        asked |= {places[k] for k in np.flatnonzero(np.any(normals != 0, axis=0))}
    return sorted(asked) or list(range(subject.system.dimension))


def _local(subject: Problem) -> tuple[Constants, str, Interval, float | None]:
    """Constants along the reach tube with noise (Thm K4), or without where none was proved; and where they hold.

    Last the log10 of the probability that a path leaves the boxes; None where they have no room for the noise.
    """
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
    if not reach.end > 0:
        raise InfeasibleError(
            "no constants hold everywhere, and no reach tube was proved beyond the start, along which others might: "
            "the dynamics jump there, or grow too fast; state a smaller `domain`, or a smaller initial set."
        )
    kind = "reach set + tube" if reach.noise else "noise-free reach set"
    unit = subject.time_unit
    where = f"the {kind}, box by box in time, up to {reach.end:g} {unit}, {odds}"
    if reach.end < horizon:
        where += f"; it ends before {horizon:g} {unit}, where no guess of its size confirmed itself"
    boxes, times = reach.hull, reach.curve.starts
    if reach.curve.continuous:
        times = np.append(times, reach.curve.ends[-1])
    else:
        boxes = Interval(boxes.lo[:-1], boxes.hi[:-1])
    left = reach.log10_delta if reach.noise else None
    return fitted_constants_along(subject, times, boxes), where, boxes, left


def _print(constants: Constants, moving: _Moving | None, result: dict[str, Any]) -> None:
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
    if moving is not None:
        whole = float(np.diff(moving.found.times) @ np.broadcast_to(constants.slope, moving.found.rate.shape))
        screen.print(
            f"in coordinates that move with the trajectory the rate integrates to {moving.found.integral:.4g}, not "
            f"{whole:.4g}: but for {moving.delta:g} and {log10_text(moving.left, ulps=2)} for leaving that set, paths "
            f"stay within {moving.radius:.4g} of the noise-free one in {', '.join(moving.states)}, not "
            f"{moving.standing_radius:.4g} (no certificate states such coordinates)",
            markup=False,
        )
    if not result["metrics"]:
        screen.print("metrics of single constraints: --constraint NAME, or all")
    else:
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
