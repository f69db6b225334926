"""``certbound simulate``: exit probabilities by Monte Carlo, beside what was certified."""

from __future__ import annotations

import contextlib
import math
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from certbound.cli.clock import Clock, TimeLimitOption
from certbound.cli.describe import attributes
from certbound.cli.messages import InputError
from certbound.cli.options import (
    ClusterOption,
    HorizonOption,
    JsonOption,
    ProblemArgument,
    SeedOption,
    SetOption,
    check_writable,
    cluster_at,
    examples,
    generator,
    integer,
    load_problem,
    number,
    option,
)
from certbound.cli.output import SETTINGS, animated, console, show, spinner
from certbound.display import one_line, rounded
from certbound.errors import SolverError
from certbound.watch import OutOfTime

if TYPE_CHECKING:
    from certbound.problem.problem import Problem
    from certbound.simulation.executors import Progress

EXAMPLES = examples(
    "certbound simulate ou --paths 1e6 --seed 1",
    "certbound simulate unicycle --paths 1e9 --time-limit 60",
    "certbound simulate chain --paths 1e7 --checkpoint run.npz --against chain.json",
    "certbound simulate ou --paths 1e4 --rare",
)
FIRST = 500
COUNTED = ("paths", "exits", "probability", "lower", "upper", "confidence", "refuted")
SPENT = ("steps", "scheme", "path_steps_per_second", "seconds")

PathsOption = Annotated[
    int, typer.Option("--paths", parser=integer, metavar="N", help="Paths to simulate, such as 3e6.")
]
StepOption = Annotated[float | None, option("--step", "H", "Time step in seconds [T/1000, or what it takes].", number)]
ConfidenceOption = Annotated[float, typer.Option("--confidence", parser=number, metavar="C", help="Of the limits.")]
RareOption = Annotated[bool, typer.Option("--rare", help="Importance splitting, for rare exits.")]
CheckpointOption = Annotated[Path | None, option("--checkpoint", "FILE", "Keep finished work here, and go on from it.")]
AgainstOption = Annotated[Path | None, option("--against", "CERT", "Does the simulation contradict this certificate?")]


def simulate(
    problem: ProblemArgument,
    paths: PathsOption,
    pairs: SetOption = None,
    horizon: HorizonOption = None,
    seed: SeedOption = None,
    step: StepOption = None,
    confidence: ConfidenceOption = 0.99,
    rare: RareOption = False,
    checkpoint: CheckpointOption = None,
    cluster: ClusterOption = None,
    against: AgainstOption = None,
    time_limit: TimeLimitOption = None,
    as_json: JsonOption = False,
) -> None:
    """Count how many random paths leave the safe set or the domain, with confidence limits."""
    check_writable(checkpoint, problem=problem)
    rng = generator(seed)
    if time_limit is not None and checkpoint is not None:
        raise InputError(
            "`--time-limit` and `--checkpoint` exclude each other", "stop a run with Ctrl-C and go on later"
        )
    subject = load_problem(problem, pairs, horizon=horizon)
    claim = None if against is None else _claimed(against, subject)
    options: dict[str, Any] = {"paths": paths, "steps": _steps(subject, step), "confidence": confidence}
    if seed is not None or checkpoint is None:
        options["rng"] = rng
    with cluster_at(cluster) as executor, _progress_bar(paths) as progress:
        options |= {"executor": executor, "progress": progress, "checkpoint": checkpoint}
        with warnings.catch_warnings(record=True) as doubts:
            result = _within(Clock(time_limit), _rare if rare else _plain, subject, options)
    for doubt in {str(doubt.message) for doubt in doubts}:
        sys.stderr.write(f"certbound: {doubt}\n")
    if claim is not None:
        contradicted = result["refuted"] > 10.0**claim
        result["against"] = {"certificate": str(against), "log10_delta": claim, "contradicted": contradicted}
    show(result, as_json, lambda: _print(result))
    raise typer.Exit(1 if claim is not None and result["against"]["contradicted"] else 0)


def _within(
    clock: Clock, count: Callable[[Problem, dict[str, Any]], dict[str, Any]], problem: Problem, options: dict[str, Any]
) -> dict[str, Any]:
    """A run of all paths, or of as many as are expected to fit into the time.

    Trial runs of growing size measure the speed and are thrown away, so that the number of paths of the run that
    counts does not depend on what it finds.
    """
    if clock.limit is None:
        return count(problem, options)
    asked = options["paths"]
    number, result = min(asked, FIRST), dict[str, Any]()
    with contextlib.suppress(OutOfTime), clock.running():
        while True:
            result = count(problem, options | {"paths": number}) | {"asked": asked}
            affordable = int(0.8 * max(clock.left, 0.0) / max(result["seconds"], 1e-3) * number)
            if number == asked or affordable < 2 * number:
                break
            number = min(asked, affordable, 30 * number)
    if not result:
        raise SolverError(f"no paths were simulated within {clock.limit:g} s; give a larger --time-limit")
    return result


def _steps(problem: Problem, step: float | None) -> int | None:
    """Number of steps that a time step means; None for the default."""
    if step is None:
        return None
    if problem.system.time == "discrete":
        raise InputError("`--step` has no meaning in discrete time", "leave it out")
    if not 0.0 < step <= problem.horizon:
        raise InputError(
            f"`--step` must lie in (0, {problem.horizon:g}], got {step:g}", f"try --step {problem.horizon / 1000:g}"
        )
    count = float(problem.horizon) / step
    return round(count) if math.isclose(count, round(count), rel_tol=1e-9) else math.ceil(count)


def _plain(problem: Problem, options: dict[str, Any]) -> dict[str, Any]:
    from certbound.simulation.estimates import simulate_exits

    found = simulate_exits(problem, **options)
    return attributes(found, *COUNTED, "by_constraint", *SPENT) | _step(found.step)


def _rare(problem: Problem, options: dict[str, Any]) -> dict[str, Any]:
    from certbound.simulation.estimates import simulate_rare_exits

    found = simulate_rare_exits(problem, **options)
    return attributes(found, *COUNTED, "standard_error", "replicas", *SPENT) | _step(found.step)


def _step(effect: Any) -> dict[str, Any]:
    """What the step adds, with its limits, and the paths that say so; null in discrete time."""
    return {"step": None if effect is None else attributes(effect, "adds", "lower", "upper", "paths")}


def _claimed(path: Path, problem: Problem) -> float:
    """log10 of the probability that a certificate claims of this very problem."""
    from certbound.checker import find_difference, read
    from certbound.safety.certificate import problem_data

    content, cure = read(path), "give the file of verify --certificate"
    claim = content.get("claim")
    if not isinstance(claim, dict):
        raise InputError(f"`{path}` claims no probability (`log10_delta`)", cure)
    if "log10_lower" in claim:
        raise InputError(f"`{path}` claims a lower bound", "compare with a certificate of SAFE")
    difference = find_difference(content, problem_data(problem))
    if difference:
        raise InputError(
            f"`{path}` speaks of another problem than the one to be simulated: {difference}",
            "simulate with the problem, --set and --horizon that it was written for",
        )
    written, level = claim.get("log10_delta"), math.nan
    with contextlib.suppress(ValueError):
        level = float.fromhex(written) if isinstance(written, str) else math.nan
    if not level <= 0:
        raise InputError(f"`{path}` claims no probability (`log10_delta`)", cure)
    return level


@contextlib.contextmanager
def _progress_bar(paths: int) -> Iterator[Callable[[Progress], None] | None]:
    """A bar with rate and time left on standard error on a terminal, a line now and then elsewhere."""
    if not animated():
        with spinner("simulating: compiling") as change:
            yield lambda state: change(
                f"simulating: {state.paths} of {state.total} paths, {state.rate:.3g} path-steps/s, "
                f"{state.remaining:.0f} s left"
            )
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn
    from rich.progress import Progress as Bar

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:3.0f} %"))
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("compiling", total=paths)

        def update(state: Progress) -> None:
            text = f"{state.rate:.3g} path-steps/s, {state.remaining:.0f} s left"
            bar.update(task, description=text, completed=state.paths, total=state.total)

        yield update


def _added(result: dict[str, Any]) -> str:
    """What the step adds to the probability, in words; nothing in discrete time."""
    step = result["step"]
    if step is None:
        return ""
    low, high = rounded(step["lower"], up=False, digits=2), rounded(step["upper"], up=True, digits=2)
    return f"; the step adds about {step['adds']:.2g}, within [{low}, {high}]"


def _print(result: dict[str, Any]) -> None:
    screen = console()
    low, high = result["lower"], result["upper"]
    least, most = rounded(low, up=False, digits=4), rounded(high, up=True, digits=4)
    sure = f"{100 * result['confidence']:g} %"
    screen.print(f"exit probability {result['probability']:.4g}  ({sure} sampling [{least}, {most}]{_added(result)})")
    if SETTINGS.quiet:
        return
    steps = f"{result['steps']} steps of the {result['scheme']} scheme"
    if "standard_error" in result:
        error, replicas = result["standard_error"], result["replicas"]
        screen.print(f"standard error {error:.2g}, from {replicas} runs of importance splitting, {steps}")
    else:
        screen.print(f"{result['exits']} of {result['paths']} paths left, {steps}")
    for label, count in result.get("by_constraint", {}).items():
        screen.print(f"  {count:>9}  {one_line(label)}", markup=False)
    refuted = result["refuted"]
    against = f"it refutes every bound below {rounded(refuted, up=False, digits=4)}"
    if refuted <= 0.0:
        against = "it refutes no bound" + (", as half of the step does not" if low > 0.0 else "")
    elif refuted < low:
        against += ", with half of the step"
    screen.print(f"{against}, and supports none below {most}")
    if result.get("asked", result["paths"]) != result["paths"]:
        screen.print(f"the time was enough for {result['paths']} of {result['asked']} paths")
    if "against" in result:
        word = "contradicts" if result["against"]["contradicted"] else "does not contradict"
        screen.print(f"the simulation {word} the certificate (10^{rounded(result['against']['log10_delta'], up=True)})")
    screen.print(f"{result['seconds']:.2f} s, {result['path_steps_per_second']:.3g} path-steps per second")
