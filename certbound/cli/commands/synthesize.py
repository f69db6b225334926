"""``certbound synthesize``: a plan of inputs, the verdict on it, and runs of the noisy closed loop."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from certbound.cli.messages import InputError
from certbound.cli.options import (
    DeltaOption,
    HorizonOption,
    JsonOption,
    ProblemArgument,
    SetOption,
    check_picture,
    check_writable,
    integer,
    load_problem,
    number,
)
from certbound.cli.output import SETTINGS, console, print_json, write_file
from certbound.display import log10_text, name_text, one_line, plain

if TYPE_CHECKING:
    from certbound.synthesis.controllers import ClosedLoop
    from certbound.synthesis.plans import Synthesis

__all__ = ["register"]

PATHS = 60

TubeOption = Annotated[
    str, typer.Option("--tube", metavar="METHOD", help="auto, linear, or a tube method such as kummer, thm5, markov.")
]
EpsilonOption = Annotated[
    float | None,
    typer.Option("--epsilon", parser=number, metavar="E", help="The paper's epsilon.", show_default=False),
]
TerminalOption = Annotated[
    str | None,
    typer.Option("--terminal", metavar="KIND", help="Terminal set: contraction or riccati.", show_default=False),
]
FeedbackOption = Annotated[
    str | None,
    typer.Option("--feedback", metavar="KIND", help="Ancillary feedback: riccati, lmi or [[K]].", show_default=False),
]
StepsOption = Annotated[
    int | None,
    typer.Option("--steps", parser=integer, metavar="N", help="Pieces, in continuous time.", show_default=False),
]
RunsOption = Annotated[
    int | None,
    typer.Option("--closed-loop", parser=integer, metavar="N", help="Noisy runs of the plan.", show_default=False),
]
SeedOption = Annotated[
    int | None,
    typer.Option("--seed", parser=integer, metavar="S", help="The same seed gives the same runs.", show_default=False),
]
PlanOption = Annotated[
    Path | None,
    typer.Option("--plan", metavar="FILE", help="Write the plan, for [plan] file.", show_default=False),
]
PlotOption = Annotated[
    Path | None,
    typer.Option("--plot", metavar="FILE", help="Draw tube, sets and sample paths.", show_default=False),
]
SmallestOption = Annotated[bool, typer.Option("--smallest-delta", help="Find the smallest feasible delta as well.")]


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    epilog = "Example: certbound synthesize chain --closed-loop 3000 --plan plan.json"
    app.command("synthesize", epilog=epilog)(synthesize)


def synthesize(
    problem: ProblemArgument,
    pairs: SetOption = None,
    delta: DeltaOption = None,
    horizon: HorizonOption = None,
    tube: TubeOption = "auto",
    epsilon: EpsilonOption = None,
    terminal: TerminalOption = None,
    feedback: FeedbackOption = None,
    steps: StepsOption = None,
    closed_loop: RunsOption = None,
    seed: SeedOption = None,
    plan: PlanOption = None,
    plot: PlotOption = None,
    smallest_delta: SmallestOption = False,
    as_json: JsonOption = False,
) -> None:
    """Find a plan of inputs under which the noisy system stays safe, and prove it."""
    check_writable(plan, plot)
    check_picture(plot)
    if closed_loop is not None and closed_loop < 1:
        raise InputError(f"`--closed-loop` must be at least 1, got {closed_loop}", "give a number of runs, like 3000")
    if seed is not None and seed < 0:
        raise InputError(f"`--seed` must not be negative, got {seed}", "give a whole number such as 1")
    gain = _gain(feedback)
    subject = load_problem(problem, pairs, horizon=horizon, delta=delta)
    import numpy as np

    from certbound.synthesis.controllers import simulate_closed_loop
    from certbound.synthesis.plans import synthesize_plan

    with _told() as tell:
        result = synthesize_plan(
            subject, tube=tube, epsilon=epsilon, terminal=terminal, feedback=gain, steps=steps,
            find_delta=smallest_delta, progress=tell,
        )  # fmt: skip
        runs = None
        if closed_loop is not None:
            tell(f"{closed_loop} noisy runs")
            runs = simulate_closed_loop(result, runs=closed_loop, rng=np.random.default_rng(seed))
    if plan is not None:
        write_file(plan, plan_text(result))
    if plot is not None:
        write_file(plot, _picture(result, plot.suffix.lstrip(".") or "png"))
    answer = _answer(result, runs)
    if as_json:
        print_json(answer)
    else:
        _print(result, answer)
    raise typer.Exit(0 if result.feasible and result.status == "SAFE" else 1)


def _gain(text: str | None) -> Any:
    """A name as it is; rows of numbers in brackets as a matrix."""
    if text is None or not text.lstrip().startswith("["):
        return text
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(f"`--feedback` is not a matrix: {error}", "write its rows, like [[-4, -3]]") from error


def plan_text(result: Synthesis) -> str:
    """The plan as JSON, as ``[plan] file`` reads it; with a feedback, K and the reference beside it."""
    problem = result.problem
    content: dict[str, Any] = {
        "inputs": list(problem.system.input_names),
        "plan": result.plan,
        "problem": result.source.name,
        "horizon": problem.horizon,
        "feasible": result.feasible,
        "status": result.status,
        "log10_delta": result.log10_delta,
        "tube": result.method,
        "cost": result.cost,
        "states": result.states,
    }
    if result.feedback is not None:
        content |= {"feedback": result.feedback, "nominal_inputs": result.inputs, "law": "u = plan + feedback x"}
    return json.dumps(plain(content), indent=1, allow_nan=False) + "\n"


def _picture(result: Synthesis, suffix: str) -> bytes:
    """Tube, constraints and sample paths of the plan."""
    import numpy as np

    from certbound.plotting import Scene, draw_scene, noisy_reach
    from certbound.simulation.estimates import sample_paths

    verdict, problem = result.verdict, result.problem
    if verdict is None or verdict.reach is None:
        raise InputError("nothing was proved about the plan that could be drawn", "leave --plot out")
    paths = times = None
    with contextlib.suppress(ValueError):  # noise without a law cannot be sampled
        paths = sample_paths(problem, paths=PATHS, rng=np.random.default_rng(0))
        times = np.linspace(0.0, float(problem.horizon), paths.shape[1])
    scene = Scene(
        problem=problem.replace(safe=result.source.safe),
        reach=verdict.reach,
        tube=noisy_reach(verdict),
        times=times,
        paths=paths,
        title=f"{name_text(result.source.name)}: {result.status}, P(exit) <= {log10_text(result.log10_delta)}",
    )
    stream = BytesIO()
    draw_scene(scene).savefig(stream, format=suffix, dpi=150)
    return stream.getvalue()


@contextlib.contextmanager
def _told() -> Iterator[Callable[[str], None]]:
    """A spinner whose text says what is being done, on a terminal only."""
    if SETTINGS.quiet or SETTINGS.verbose or not sys.stderr.isatty():
        yield lambda text: None
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("planning", total=None)
        yield lambda text: progress.update(task, description=text)


def _answer(result: Synthesis, runs: ClosedLoop | None) -> dict[str, Any]:
    found = result.infeasibility
    return {
        "feasible": result.feasible,
        "status": result.status,
        "log10_delta": result.log10_delta,
        "delta": result.source.delta,
        "reason": result.reason,
        "tube": result.method,
        "cost": result.cost,
        "max_input": result.max_input,
        "room": result.scale,
        "softened": result.softened,
        "smallest_delta": result.smallest_delta,
        "infeasible": None
        if found is None
        else {
            "proved": found.proved,
            "kind": found.kind,
            "constraint": found.constraint,
            "time": found.time,
            "room_at_most": found.scale_bound,
        },
        "seconds": result.seconds,
        "closed_loop": None
        if runs is None
        else {
            "runs": runs.runs,
            "violations": runs.violations,
            "lower": runs.lower,
            "upper": runs.upper,
            "max_input": runs.max_input,
            "mean_final_cost": runs.mean_final_cost,
            "mean_cost": runs.mean_cost,
            "by_constraint": runs.by_constraint,
            "seconds": runs.seconds,
        },
    }


def _print(result: Synthesis, answer: dict[str, Any]) -> None:
    screen = console()
    colors = {"SAFE": "bold green", "UNSAFE_NOMINAL": "bold red", "UNSAFE": "bold red", "UNKNOWN": "bold yellow"}
    word = "a plan" if result.feasible else "no plan"
    screen.print(f"[{colors[result.status]}]{result.status}[/]  ", end="")
    screen.print(f"{name_text(result.source.name)}: {word} with tube ", end="", markup=False)
    screen.print(f"{result.method}, P(leaving) <= {log10_text(result.log10_delta)}", markup=False)
    if SETTINGS.quiet:
        return
    screen.print(f"cost {result.cost:.6g}, largest input {result.max_input:.4g}, room for {result.scale:.4g} tubes")
    if result.reason:
        screen.print(one_line(result.reason), markup=False)
    runs = answer["closed_loop"]
    if runs is not None:
        screen.print(
            f"{runs['violations']} of {runs['runs']} runs broke a constraint; largest input {runs['max_input']:.4g}, "
            f"mean cost at the end {runs['mean_final_cost']:.4g}"
        )
    screen.print(f"{result.seconds:.1f} s")
