"""``certbound verify``: the verdict on a problem, with its certificate, report and picture."""

from __future__ import annotations

import json
import math
import re
import shlex
import sys
import time
import warnings
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from certbound.cli.clock import Clock, VerdictLimitOption
from certbound.cli.commands.check import proved_certificate
from certbound.cli.describe import attributes, describe_constants, describe_deviation, deviation_text
from certbound.cli.messages import for_files
from certbound.cli.options import (
    ClusterOption,
    DeltaOption,
    HorizonOption,
    JsonOption,
    PlotOption,
    ProblemArgument,
    SetOption,
    check_writable,
    cluster_at,
    examples,
    integer,
    load_problem,
    option,
)
from certbound.cli.output import SETTINGS, console, print_status, show, spinner, write_file
from certbound.cli.pictures import check_picture, drawn_reach, scene_of, values_of, write_picture
from certbound.cli.progress import progress
from certbound.display import at_least_text, log10_text, name_text, one_line, rounded
from certbound.errors import CertificateError, EngineError, SolverError, contained
from certbound.watch import OutOfTime, Watch

if TYPE_CHECKING:
    from certbound.problem.problem import Problem
    from certbound.safety.verification import Verdict

EXAMPLES = examples(
    "certbound verify unicycle --horizon 2 --plot tube.png",
    "certbound verify my_system.toml --set sigma=0.1 --delta 1e-6 --json",
    "certbound verify chain --certificate chain.json --report chain.html",
    "certbound verify unicycle --smallest --time-limit 60",
)

DEFAULT_LIMIT = 60.0
_LEAST = 1e-3
_PATHS, _LONG = 1000, 10_000  # simulated where nothing was proved; steps that take too long for that
_PATIENCE = 3.0  # seconds of it

MethodOption = Annotated[
    str,
    typer.Option("--method", metavar="M", help="auto, an engine's (linear, values, ...), or a tube's (kummer, thm3)."),
]
CellsOption = Annotated[int | None, option("--cells", "K", "Cells per side of the initial set.", integer)]
JobsOption = Annotated[int, option("--jobs", "N", "Processes that prove cells side by side [1].", integer)]
CertificateOption = Annotated[Path | None, option("--certificate", "FILE", "Write the certificate.")]
ReportOption = Annotated[Path | None, option("--report", "FILE", "Write one HTML page.")]
ExplainOption = Annotated[
    bool, typer.Option("--explain", help="Show what each engine found, and for UNKNOWN and UNSAFE what would be SAFE.")
]
SmallestOption = Annotated[
    bool, typer.Option("--smallest", help="Once SAFE, go on to the smallest probability that can be proved.")
]


def verify(
    problem: ProblemArgument,
    pairs: SetOption = None,
    delta: DeltaOption = None,
    horizon: HorizonOption = None,
    method: MethodOption = "auto",
    cells: CellsOption = None,
    certificate: CertificateOption = None,
    report: ReportOption = None,
    plot: PlotOption = None,
    explain: ExplainOption = False,
    smallest: SmallestOption = False,
    time_limit: VerdictLimitOption = None,
    jobs: JobsOption = 1,
    cluster: ClusterOption = None,
    as_json: JsonOption = False,
) -> None:
    """Decide whether the system stays safe but for a probability of delta, and prove it."""
    check_writable(certificate, report, plot, problem=problem)
    check_picture(plot)
    subject = load_problem(problem, pairs, horizon=horizon, delta=delta)
    started = time.perf_counter()
    clock = Clock(DEFAULT_LIMIT if time_limit is None else time_limit)
    with cluster_at(cluster) as executor, progress(f"verifying {name_text(subject.name)}", clock.limit) as tell:
        from certbound.safety.verification import verify_safety

        verdict = verify_safety(
            subject, method=method, cells=cells, time_limit=clock.limit, progress=tell, smallest=smallest, jobs=jobs,
            executor=executor, patient=time_limit is not None, started=clock.started,
        )  # fmt: skip
    seconds = time.perf_counter() - started
    if ":" not in problem:  # reasons and cures in the words of files
        told = {name: replace(answer, reason=for_files(answer.reason)) for name, answer in verdict.answers.items()}
        verdict = replace(verdict, reason=for_files(verdict.reason), answers=told)
    result = _result(subject, verdict, seconds)
    if explain:
        result["engines"] = _engines(verdict)
    if problem.endswith((".yaml", ".yml")):
        from certbound.problem.files import notes

        result["taken"] = list(notes(problem))
    if not as_json:  # the verdict comes first: it stands, whatever becomes of the rest
        _print(subject, result, verdict.caution)
        if verdict.status == "UNKNOWN" and not SETTINGS.quiet:
            hint = _simulated(subject, math.inf if time_limit is None else clock.left)
            console().print(hint, markup=False, end="\n" if hint else "")
    if explain and verdict.status in ("UNKNOWN", "UNSAFE"):
        result["limits"] = _limits(verdict, cells, clock)
        if not as_json and not SETTINGS.quiet:
            console().print(result["limits"]["summary"], markup=False)
    proof = ""
    if certificate is not None:
        left = None if time_limit is None else max(clock.left, _LEAST)
        proof, result["certificate"] = _certify(subject, verdict, certificate, left)
        if proof and not as_json and not SETTINGS.quiet:
            spent = result["certificate"]
            share = f"the checker's share {spent['check_seconds']:.1f} s"
            console().print(f"certificate: {spent['seconds']:.1f} s, {share}", markup=False)
    _write(subject, verdict, proof, report=report, plot=plot)
    show(result, as_json, lambda: None)
    raise typer.Exit(0 if verdict.status == "SAFE" else 1)


def _simulated(problem: Problem, left: float) -> str:
    """What some simulated paths suggest where nothing was proved; empty without time, or where they tell nothing."""
    if problem.horizon > _LONG or left <= 0:
        return ""
    try:
        with spinner("simulating some paths"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            from certbound.simulation.estimates import simulate_exits

            with Watch(min(left, _PATIENCE)).running():
                found = simulate_exits(problem, paths=_PATHS, rng=0, halve=False)
                if found.refutes(problem.delta):  # only if half of the step says so too
                    found = simulate_exits(problem, paths=_PATHS, rng=0)
    except (ArithmeticError, OutOfTime, SolverError, ValueError):
        return ""
    text = f"simulated, which proves nothing: {found.exits} of {found.paths} paths failed"
    if found.refutes(problem.delta):
        return f"{text}, more often than {problem.delta!r}"
    return text if found.upper > problem.delta else f"{text}, less often than {problem.delta!r}"


def _result(problem: Problem, verdict: Verdict, seconds: float) -> dict[str, Any]:
    return {
        **attributes(verdict, "status", "log10_delta", "log10_lower"),
        "delta": problem.delta,
        **attributes(verdict, "margin", "time", "constraint", "reason", "method"),
        "constants": None if verdict.constants is None else describe_constants(verdict.constants),
        "tube": describe_deviation(verdict),
        "by_limit": [asdict(one) for one in verdict.by_limit],
        "seconds": seconds,
    }


def _engines(verdict: Verdict) -> list[dict[str, Any]]:
    """What each engine answered, for --explain."""
    keys = ("method", "applicable", "log10_delta", "log10_lower", "margin", "constraint", "time", "reason")
    return [{"engine": name, **attributes(answer, *keys)} for name, answer in verdict.answers.items()]


def _limits(verdict: Verdict, cells: int | None, clock: Clock) -> dict[str, Any]:
    """What would be SAFE, for --explain, as far as time allows."""
    from certbound.safety.limits import Limits, limits_so_far

    found, over = Limits(delta=None, horizon=None, noise=None, widening=None), ""
    try:
        with progress("looking for what would be SAFE") as tell, contained("search for limits"):
            watch = Watch(max(clock.left, _LEAST), progress=tell)
            with watch.running():
                for better in limits_so_far(verdict, cells=cells):
                    found = better
    except OutOfTime:
        over = "The time was over before it was known what would be SAFE. "
    except EngineError as error:
        return asdict(found) | {"summary": f"What would be SAFE is not known: {error}"}
    nothing = all(value is None for value in asdict(found).values())
    return asdict(found) | {"summary": over.strip() if over and nothing else f"{over}{found.summary()}"}


def _write(problem: Problem, verdict: Verdict, proof: str, *, report: Path | None, plot: Path | None) -> None:
    if plot is None and report is None:
        return
    if verdict.reach is not None and verdict.members:  # the picture is of the worst member
        verdict = verdict.worst
        problem = verdict.problem or problem
    title = f"{name_text(problem.name)}: {verdict.status}, P({problem.failing}) <= {log10_text(verdict.log10_delta)}"
    with spinner("looking for what can be drawn"):
        starts = values_of(problem, verdict) if verdict.reach is None else None
        reach = drawn_reach(problem, verdict) if starts is None else None
        bare = starts is None and reach is None
        drawn = starts is None and not (bare and problem.endless)
        scene = scene_of(problem, verdict, reach, title) if drawn else None
    if bare:
        paths = "" if scene is None or scene.paths is None else "sample paths and "
        what = "nothing is drawn" if scene is None else f"{paths}limits are drawn alone"
        sys.stderr.write(f"certbound: no set was proved that could be drawn; {what}\n")
    if plot is not None:
        from certbound.plotting import draw_scene, draw_values

        with spinner("drawing"):
            if scene is not None:
                write_picture(plot, draw_scene(scene))
            elif starts is not None:
                write_picture(plot, draw_values(starts, title))
    if report is not None:
        from certbound.html_report import report_page

        with spinner("writing the report"):
            command = shlex.join(["certbound", *(word for word in sys.argv[1:])])
            probability = log10_text(verdict.log10_delta)
            page = report_page(
                scene or starts or problem, verdict, command=command, probability=probability,
                certificate=proof,
            )  # fmt: skip
            write_file(report, page)


def _certify(problem: Problem, verdict: Verdict, path: Path, left: float | None) -> tuple[str, dict[str, Any]]:
    """Write a certificate that the checker has proved; its text, and what ``--json`` says of it.

    A limit that was given leaves it ``left`` seconds; the default one is of the search alone. What it misses is said in
    one line on standard error: that none was written, or that it proves less than delta.
    """
    started, checking = time.perf_counter(), list[float]()
    try:
        with progress("writing and checking the certificate", left) as tell:
            watch = Watch(left, progress=tell)
            with watch.running():
                text = proved_certificate(problem, verdict, checking)
    except (CertificateError, OutOfTime) as error:
        over = "the time was over before its proof was written and checked; give a larger --time-limit"
        reason = over if isinstance(error, OutOfTime) else " ".join(str(error).split())
        sys.stderr.write(f"certbound: no certificate was written: {reason}\n")
        return "", {"path": None, "log10_delta": None, "reason": reason}
    write_file(path, text)
    from certbound.safety.answers import is_at_most, is_more_than

    claim = json.loads(text)["claim"]
    proved, reason = float.fromhex(claim["log10_delta"]), ""
    if verdict.status == "SAFE" and not is_at_most(min(proved, 0.0), problem.delta):
        reason = f"the certificate proves {log10_text(proved)}, not the {problem.delta:g} of the verdict"
        sys.stderr.write(f"certbound: {reason}\n")
    spent: dict[str, Any] = {"seconds": time.perf_counter() - started, "check_seconds": sum(checking)}
    least = float.fromhex(claim["log10_lower"]) if "log10_lower" in claim else None
    spent |= {} if least is None else {"log10_lower": least}
    if least is not None and not is_more_than(least, problem.delta):
        reason = f"the certificate proves only at least {log10_text(least)}, not more than the {problem.delta:g} asked"
        sys.stderr.write(f"certbound: {reason}\n")
    return text, {"path": str(path), "log10_delta": proved, "reason": reason, **spent}


def _print(problem: Problem, result: dict[str, Any], caution: str) -> None:
    screen = console()
    print_status(screen, result["status"])
    screen.print(
        f"{name_text(problem.name)}: P({problem.failing} {problem.span}) <= "
        f"{log10_text(result['log10_delta'])}{at_least_text(result['log10_lower'])}, asked {result['delta']!r}",
        markup=False,
    )
    if SETTINGS.quiet:
        return
    if result["margin"] is not None and result["constraint"]:
        clock = "t" if problem.system.time == "continuous" else "step"
        when = "" if result["time"] is None else f" at {clock} = {result['time']:.4g}"
        margin = rounded(result["margin"], up=False, digits=4)
        where = f"constraint: {one_line(result['constraint'])}{caution}"
        screen.print(f"margin {margin}{when}, {where}", markup=False)
    if result["reason"]:
        for line in re.split(r"(?<=[.!?]) (?=By \w+: )", one_line(result["reason"])):
            screen.print(line, markup=False)
    tube = result["tube"]
    if tube is not None:
        but = f"but for a probability of {result['delta']!r}"
        screen.print(f"stochastic deviation: {deviation_text(tube, problem.system.states)}, {but}", markup=False)
    screen.print(f"method {result['method']}, {result['seconds']:.1f} s", markup=False)
    for row in result.get("engines", ()):
        bound = f"<= {log10_text(row['log10_delta'])}" if row["applicable"] else "does not apply"
        screen.print(f"  {row['engine']} ({row['method']}): {bound}. {one_line(row['reason'])}", markup=False)
