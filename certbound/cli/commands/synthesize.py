"""``certbound synthesize``: a plan of inputs, the verdict on it, and runs of the noisy closed loop."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from certbound.cli.clock import Clock, LimitOption
from certbound.cli.describe import attributes
from certbound.cli.messages import InputError
from certbound.cli.options import (
    DeltaOption,
    HorizonOption,
    JsonOption,
    PlotOption,
    ProblemArgument,
    SeedOption,
    SetOption,
    check_writable,
    examples,
    generator,
    integer,
    load_problem,
    number,
    option,
)
from certbound.cli.output import SETTINGS, console, print_status, show, write_file
from certbound.cli.pictures import check_picture, scene_of, write_picture
from certbound.cli.progress import progress
from certbound.display import log10_text, name_text, one_line, plain
from certbound.errors import SolverError
from certbound.watch import OutOfTime, poll

if TYPE_CHECKING:
    from certbound.synthesis.controllers import ClosedLoop
    from certbound.synthesis.plans import Synthesis

EXAMPLES = examples("certbound synthesize chain --closed-loop 3000 --plan plan.json")
RUNS = (
    "runs", "violations", "lower", "upper", "max_input", "mean_final_cost", "mean_cost", "by_constraint", "seconds",
)  # fmt: skip

MethodOption = Annotated[
    str, typer.Option("--method", "--tube", metavar="M", help="auto, linear, or a tube's (kummer, thm5, markov).")
]
EpsilonOption = Annotated[float | None, option("--epsilon", "E", "The paper's epsilon.", number)]
TerminalOption = Annotated[str | None, option("--terminal", "KIND", "Terminal set: contraction or riccati.")]
FeedbackOption = Annotated[str | None, option("--feedback", "KIND", "Ancillary feedback: riccati, lmi or [[K]].")]
StepsOption = Annotated[int | None, option("--steps", "N", "Pieces, in continuous time.", integer)]
RunsOption = Annotated[int | None, option("--closed-loop", "N", "Noisy runs of the plan.", integer)]
PlanOption = Annotated[Path | None, option("--plan", "FILE", "Write the plan, for [plan] file.")]
SmallestOption = Annotated[bool, typer.Option("--smallest-delta", help="Find the smallest feasible delta as well.")]


def synthesize(
    problem: ProblemArgument,
    pairs: SetOption = None,
    delta: DeltaOption = None,
    horizon: HorizonOption = None,
    method: MethodOption = "auto",
    epsilon: EpsilonOption = None,
    terminal: TerminalOption = None,
    feedback: FeedbackOption = None,
    steps: StepsOption = None,
    closed_loop: RunsOption = None,
    seed: SeedOption = None,
    plan: PlanOption = None,
    plot: PlotOption = None,
    smallest_delta: SmallestOption = False,
    time_limit: LimitOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find a plan of inputs under which the noisy system stays safe, and prove it."""
    check_writable(plan, plot, problem=problem)
    check_picture(plot)
    if closed_loop is not None and closed_loop < 1:
        raise InputError(f"`--closed-loop` must be at least 1, got {closed_loop}", "give a number of runs, like 3000")
    rng = generator(seed)
    gain = _gain(feedback)
    subject = load_problem(problem, pairs, horizon=horizon, delta=delta)

    from certbound.synthesis.controllers import simulate_closed_loop
    from certbound.synthesis.plans import synthesize_plan

    runs = None
    try:
        with progress("planning", time_limit) as tell, Clock(time_limit, tell).running():
            result = synthesize_plan(
                subject, method=method, epsilon=epsilon, terminal=terminal, feedback=gain, steps=steps,
                find_delta=smallest_delta, progress=poll,
            )  # fmt: skip
            if closed_loop is not None:
                poll(f"{closed_loop} noisy runs")
                runs = simulate_closed_loop(result, runs=closed_loop, rng=rng)
    except OutOfTime:
        raise SolverError(f"no plan was found and proved within {time_limit:g} s; give a larger --time-limit") from None
    if plan is not None:
        write_file(plan, plan_text(result))
    if plot is not None:
        _draw(result, plot)
    answer = _answer(result, runs)
    show(answer, as_json, lambda: _print(result, answer))
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
        **attributes(result, "feasible", "status", "log10_delta", "method", "cost", "states"),
    }
    if result.feedback is not None:
        content |= {"feedback": result.feedback, "nominal_inputs": result.inputs, "law": "u = plan + feedback x"}
    return json.dumps(plain(content), indent=1, allow_nan=False) + "\n"


def _draw(result: Synthesis, path: Path) -> None:
    """Tube, constraints and sample paths of the plan."""
    from certbound.plotting import draw_scene

    verdict, problem = result.verdict, result.problem
    if verdict is None or verdict.reach is None:
        raise InputError("nothing was proved about the plan that could be drawn", "leave --plot out")
    title = f"{name_text(result.source.name)}: {result.status}, P(exit) <= {log10_text(result.log10_delta)}"
    write_picture(path, draw_scene(scene_of(problem.replace(safe=result.source.safe), verdict, verdict.reach, title)))


def _answer(result: Synthesis, runs: ClosedLoop | None) -> dict[str, Any]:
    found = result.infeasibility
    return {
        **attributes(result, "feasible", "status", "log10_delta"),
        "delta": result.source.delta,
        **attributes(result, "reason", "method", "cost", "max_input"),
        "room": result.scale,
        **attributes(result, "softened", "smallest_delta"),
        "infeasible": None
        if found is None
        else attributes(found, "proved", "kind", "constraint", "time") | {"room_at_most": found.scale_bound},
        "seconds": result.seconds,
        "closed_loop": None if runs is None else attributes(runs, *RUNS),
    }


def _print(result: Synthesis, answer: dict[str, Any]) -> None:
    screen = console()
    word = "a plan" if result.feasible else "no plan"
    print_status(screen, result.status)
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
