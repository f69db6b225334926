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
    from certbound.checker import Report
    from certbound.problem.problem import Problem
    from certbound.safety.verification import Verdict

EXAMPLES = examples(
    "certbound check unicycle.json --problem unicycle",
    "certbound check my_system.json --problem my_system.toml --json",
    "certbound check stated.json --allow-assumptions",
)
ATTEMPTS = 3
_Found = tuple[float, str]  # log10 of what was proved, and the certificate

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
    certificate of one engine, at any effort, the other engines' are tried; engines that had not been asked come last,
    where what is proved says less than SAFE. CertificateError where the verdict bounds no probability, or the checker
    did not prove what was written. ``checking`` takes the seconds of every check.
    """
    spent = [] if checking is None else checking
    if verdict.members and not any(member.status == "UNSAFE" for member in verdict.members):
        return _at_once(problem, verdict, spent) or _united(problem, verdict, spent)
    if problem.random:
        return _at_once(problem, verdict, spent) or _whole_again(problem, _averaged(problem, verdict, spent), spent)
    left, reasons = dict(verdict.answers), list[str]()
    best: _Found | None = None
    for reserves in (False, True) if verdict.status == "SAFE" else (True,):
        while left:
            try:
                own = replace(verdict, answers=left)
                found, engine, reason = _proved(problem, own, spent, best, reserves=reserves)
            except EngineError as error:
                if reserves and not reasons and best is None:
                    raise CertificateError(str(error)) from error
                break
            if found is not None:
                best = found
                break
            reasons.append(f"{engine}: {reason}")
            if left.pop(engine, None) is None:
                break
        if best is not None and _is_enough(problem, verdict, best[0]):
            break
    if best is not None:
        return best[1]
    if not reasons:
        raise CertificateError(f"no probability was bounded that a certificate could state: {verdict.reason}")
    raise CertificateError(f"no certificate could be proved again by the checker: {' '.join(reasons)}")


def _at_once(problem: Problem, verdict: Verdict, checking: list[float]) -> str | None:
    """The certificate made of those of its parts, checked as a whole alone; None where that does not settle delta."""
    from certbound.checker import parse
    from certbound.safety.certificate import certificate_of, restated

    try:
        with contained("certificate"):
            text = certificate_of(problem, verdict, reserves=False)[0]
        report = _checked(problem, parse(text), checking)
    except (EngineError, CertificateError):
        return None
    most = report.log10_proved
    if most is None or not _may_be_claimed(problem, verdict, report) or not _is_enough(problem, verdict, most):
        return None
    return restated(text, most)


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
    from certbound.checker import parse

    text = json.dumps(data, separators=(",", ":")) + "\n"
    report = _checked(problem, parse(text), spent)
    if not report.valid:
        raise CertificateError(f"no certificate could be proved again by the checker: {report.reason}")
    return text


def _checked(problem: Problem, data: dict[str, Any], checking: list[float]) -> Report:
    """What the checker says of a certificate; ``checking`` takes the seconds."""
    from certbound.checker import check_data
    from certbound.safety.certificate import problem_data

    poll("checking the certificate")
    begun = time.perf_counter()
    try:
        return check_data(data, problem_data(problem), allow_assumptions=True)
    finally:
        checking.append(time.perf_counter() - begun)


def _is_enough(problem: Problem, verdict: Verdict, level: float) -> bool:
    """Whether a bound of 10**level says what a verdict says: at most delta where it is SAFE."""
    from certbound.safety.answers import is_at_most

    return verdict.status != "SAFE" or is_at_most(min(level, 0.0), problem.delta)


def _may_be_claimed(problem: Problem, verdict: Verdict, report: Report) -> bool:
    """Whether a certificate is valid, or claims more than was proved of it, and that is enough for the verdict."""
    from certbound.safety.answers import is_more_than

    least, most = report.log10_lower_proved, report.log10_proved
    if report.valid or report.proved:  # else it rests on what may not be assumed
        return report.valid
    if least is not None:
        return is_more_than(least, problem.delta)
    return most is not None and verdict.status == "SAFE" and _is_enough(problem, verdict, most)


def _proved(
    problem: Problem, verdict: Verdict, checking: list[float], best: _Found | None, *, reserves: bool
) -> tuple[_Found | None, str, str]:
    """A certificate that the checker has proved (None: it proved none), its engine, and what stood in the way.

    Where SAFE was proved and it says less than that, more effort is spent, and the best one is kept, that of before
    included. It claims what was proved, also where the writer had claimed more, if that shows what the verdict says. A
    claim of less than is proved already is not checked. EngineError where no certificate could be written.
    """
    from certbound.checker import parse
    from certbound.safety.certificate import certificate_of, restated

    engine = reason = text = ""
    for attempt in range(ATTEMPTS):
        try:
            with contained("certificate"):
                before, (text, engine) = text, certificate_of(
                    problem, verdict, attempt=attempt, reserves=reserves
                )
        except EngineError as error:
            if attempt + 1 == ATTEMPTS and not text:
                raise
            reason = str(error)
            continue
        if text == before:  # of which the checker says the same
            continue
        try:
            data = parse(text)
            claimed = float.fromhex(data["claim"]["log10_delta"])
            if best is not None and claimed >= best[0] and not _is_enough(problem, verdict, claimed):
                continue
            report = _checked(problem, data, checking)
        except CertificateError as error:  # larger than the checker accepts: what was proved with less effort stands
            reason = str(error)
            break
        least, most = report.log10_lower_proved, report.log10_proved
        holds = _may_be_claimed(problem, verdict, report)
        if least is not None and holds:
            return (0.0, restated(text, least, lower=True)), engine, ""
        if most is not None and holds:
            found = most, restated(text, most)
            best = found if best is None else min(best, found)
            if _is_enough(problem, verdict, most):
                break
        reason = report.reason
    return best, engine, reason


def _print(result: dict[str, Any]) -> None:
    screen = console()
    screen.print(WORDS[result["outcome"]])
    if SETTINGS.quiet:
        return
    screen.print(f"claim: {result['claim']}", markup=False)
    screen.print(f"{result['reason']}  ({result['seconds']:.1f} s)", markup=False)
