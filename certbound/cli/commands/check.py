"""``certbound check``: prove a certificate again, and that it speaks of a given problem."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from certbound.cli.clock import Clock, LimitOption
from certbound.cli.describe import attributes
from certbound.cli.messages import InputError
from certbound.cli.options import DeltaOption, HorizonOption, JsonOption, SetOption, examples, load_problem, option
from certbound.cli.output import SETTINGS, console, show, spinner
from certbound.errors import CertificateError, EngineError, contained
from certbound.watch import OutOfTime, poll

if TYPE_CHECKING:
    from certbound.problem.problem import Problem
    from certbound.safety.verification import Verdict

EXAMPLES = examples(
    "certbound check unicycle.json --problem unicycle",
    "certbound check my_system.json --problem my_system.toml --json",
    "certbound check stated.json --allow-assumptions",
)
ATTEMPTS = 3

CertificateArgument = Annotated[
    Path, typer.Argument(metavar="CERT", help="The file of verify --certificate.", show_default=False)
]
ProblemOption = Annotated[str | None, option("--problem", "PROBLEM", "Prove also that it speaks of this problem.")]
AllowOption = Annotated[
    bool,
    typer.Option("--allow-assumptions", help="Exit with 0 also where the proof rests on the assumptions it names."),
]
WORDS = {
    "valid": "[bold green]VALID[/]",
    "valid under assumptions": "[bold yellow]VALID UNDER ASSUMPTIONS[/]",
    "not proved": "[bold red]NOT PROVED[/]",
}


def check(
    certificate: CertificateArgument,
    problem: ProblemOption = None,
    pairs: SetOption = None,
    delta: DeltaOption = None,
    horizon: HorizonOption = None,
    allow: AllowOption = False,
    time_limit: LimitOption = None,
    as_json: JsonOption = False,
) -> None:
    """Prove every inequality of a certificate again, in ball arithmetic, from the file alone."""
    from certbound.checker import check_data, read

    started = time.perf_counter()
    data = read(certificate)
    given = _stated(problem, pairs, delta, horizon)
    result: dict[str, Any] = {
        "valid": False, "claim": "", "reason": "", "seconds": 0.0, "outcome": "not proved", "assumptions": [],
    }  # fmt: skip
    try:
        with spinner(f"checking {certificate.name}"), Clock(time_limit).running():
            report = check_data(data, given, allow_assumptions=allow)
            result |= attributes(report, "valid", "claim", "reason", "outcome")
            result["assumptions"] = list(report.assumptions)
    except OutOfTime:
        result["reason"] = f"the time of {time_limit:g} s was over before everything was proved again"
    result["seconds"] = time.perf_counter() - started
    show(result, as_json, lambda: _print(result))
    raise typer.Exit(0 if result["valid"] else 1)


def _stated(
    problem: str | None, pairs: list[str] | None, delta: float | None, horizon: float | None
) -> dict[str, Any] | None:
    """The data of the problem that the certificate must speak of."""
    if problem is None:
        if pairs or delta is not None or horizon is not None:
            raise InputError("`--set`, `--delta` and `--horizon` change a problem, and none is given", "add --problem")
        return None
    from certbound.safety.certificate import problem_data

    return problem_data(load_problem(problem, pairs, horizon=horizon, delta=delta))


def proved_certificate(problem: Problem, verdict: Verdict, checking: list[float] | None = None) -> str:
    """The text of a verdict's certificate, which the checker has proved again; it claims what was proved.

    Assumptions of the verdict are assumptions of the certificate, which names them. Where the checker proves no
    certificate of one engine, at any effort, the other engines' are tried. CertificateError where the verdict bounds no
    probability, or the checker did not prove what was written. ``checking`` takes the seconds of every check.
    """
    spent = [] if checking is None else checking
    if verdict.members and not any(member.status == "UNSAFE" for member in verdict.members):
        return _united(problem, verdict, spent)
    if problem.random:
        return _whole_again(problem, _averaged(problem, verdict, spent), spent)
    left, reasons = dict(verdict.answers), list[str]()
    while left:
        try:
            found, engine, reason = _proved(problem, replace(verdict, answers=left), spent)
        except EngineError as error:
            if not reasons:
                raise CertificateError(str(error)) from error
            break
        if found is not None:
            return found
        reasons.append(f"{engine}: {reason}")
        if left.pop(engine, None) is None:
            break
    if not reasons:
        raise CertificateError(f"no probability was bounded that a certificate could state: {verdict.reason}")
    raise CertificateError(f"no certificate could be proved again by the checker: {' '.join(reasons)}")


def _united(problem: Problem, verdict: Verdict, spent: list[float]) -> str:
    """The certificate of a union of starts, from those of its members, proved again as a whole."""
    from certbound.checker import parse
    from certbound.safety.certificate import united

    members = [parse(proved_certificate(one.problem, one, spent)) for one in verdict.members if one.problem is not None]
    return _whole_again(problem, united(problem, members), spent)


def _averaged(problem: Problem, verdict: Verdict, spent: list[float]) -> dict[str, Any]:
    """The certificate of drawn constants, from those of the cells of their values that have one."""
    from certbound.checker import parse
    from certbound.safety.certificate import averaged

    if verdict.status == "UNSAFE":
        raise CertificateError("certificates state no lower bounds where constants are drawn.")
    found: list[dict[str, Any] | None] = []
    for cell in verdict.cells:
        try:
            found.append(parse(proved_certificate(cell.plain, cell.verdict, spent)) if cell.asked else None)
        except CertificateError:
            found.append(None)
    return averaged(problem, verdict.cells, found)


def _whole_again(problem: Problem, data: dict[str, Any], spent: list[float]) -> str:
    """A certificate made of others, proved again as a whole."""
    from certbound.checker import check_data, parse
    from certbound.safety.certificate import problem_data

    text = json.dumps(data, separators=(",", ":")) + "\n"
    poll("checking the certificate")
    begun = time.perf_counter()
    report = check_data(parse(text), problem_data(problem), allow_assumptions=True)
    spent.append(time.perf_counter() - begun)
    if not report.valid:
        raise CertificateError(f"no certificate could be proved again by the checker: {report.reason}")
    return text


def _proved(problem: Problem, verdict: Verdict, checking: list[float]) -> tuple[str | None, str, str]:
    """A certificate that the checker has proved (None: it proved none), its engine, and what stood in the way.

    Where SAFE was proved and it says less than that, more effort is spent, and the best one is kept. EngineError where
    no certificate could be written.
    """
    from certbound.checker import check_data, parse
    from certbound.safety.answers import is_at_most
    from certbound.safety.certificate import problem_data, restated

    engine = reason = text = ""
    best: tuple[float, str, str] | None = None
    for attempt in range(ATTEMPTS):
        try:
            with contained("certificate"):
                before, text = text, verdict.certificate_text(problem, attempt=attempt)
        except EngineError as error:
            if attempt + 1 == ATTEMPTS and not engine:
                raise
            reason = str(error)
            continue
        if text == before:  # of which the checker says the same
            continue
        poll("checking the certificate")
        begun = time.perf_counter()
        try:
            data = parse(text)
            engine = str(data["claim"]["method"])
            report = check_data(data, problem_data(problem), allow_assumptions=True)
        except CertificateError as error:  # larger than the checker accepts: what was proved with less effort stands
            engine, reason = str(json.loads(text)["claim"]["method"]), str(error)
            break
        finally:
            checking.append(time.perf_counter() - begun)
        if report.valid and report.log10_lower_proved is not None:
            return restated(text, report.log10_lower_proved, lower=True), engine, ""
        if report.valid and report.log10_proved is not None:
            found = report.log10_proved, restated(text, report.log10_proved), engine
            best = found if best is None else min(best, found)
            if verdict.status != "SAFE" or is_at_most(min(found[0], 0.0), problem.delta):
                break
        reason = report.reason
    return (None, engine, reason) if best is None else (*best[1:], "")


def _print(result: dict[str, Any]) -> None:
    screen = console()
    screen.print(WORDS[result["outcome"]])
    if SETTINGS.quiet:
        return
    screen.print(f"claim: {result['claim']}", markup=False)
    screen.print(f"{result['reason']}  ({result['seconds']:.1f} s)", markup=False)
