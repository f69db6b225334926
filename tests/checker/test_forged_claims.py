"""Certificates whose claim says something that their proof does not: refused, or said in words that mislead nobody.

Two kinds: constants that are assumed where they are slopes of nothing, and texts of the file that pass for the
checker's own words.
"""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flint import arb

import certbound as cb
from certbound.checker import Report, check_data, parse
from certbound.cli.app import run
from certbound.errors import CertificateError
from certbound.safety.answers import exact
from certbound.safety.certificate import certificate_text, problem_data
from certbound.safety.verification import verify_safety

Data = dict[str, Any]
Change = Callable[[Data], None]
SIDES = [cb.Inside(cb.Box([-1], [1]))]


# ---- certificates that rest on stated constants ------------------------------------------------------------------


def flowing(rate: Any = lambda x: [-x[0]], *, diffusion: Any = 0.1, **changes: Any) -> cb.Problem:
    """x' = -x + .1 dW within [-1, 1], or what the arguments make of it."""
    options = {name: changes.pop(name) for name in ("disturbance", "inputs") if name in changes}
    system = cb.ContinuousSystem(rate, states=["x"], diffusion=diffusion, **options)
    return cb.Problem(system, **{"initial": [0.0], "safe": SIDES, "horizon": 2.0, "delta": 1e-2} | changes)


def stepping(step: Any = lambda x: [0.5 * x[0]], **changes: Any) -> cb.Problem:
    """x+ = x/2 + .1 w within [-1, 1], or what the arguments make of it."""
    system = cb.DiscreteSystem(step, states=["x"], noise=cb.Gaussian(std=0.1))
    return cb.Problem(system, **{"initial": [0.0], "safe": SIDES, "horizon": 3, "delta": 1e-2} | changes)


@cache
def _text(build: Callable[..., cb.Problem], **changes: Any) -> str:
    problem = build(**changes)
    discrete = problem.system.time == "discrete"
    constants = cb.Constants(**({"gain": 0.5} if discrete else {"rate": -1.0}), sigma=0.1, dimension=1)
    return certificate_text(problem, verify_safety(problem, method="constants", constants=constants))


def stated(build: Callable[..., cb.Problem] = flowing, **changes: Any) -> Data:
    """A certificate that rests on constants that hold."""
    return parse(_text(build, **changes))


def with_problem(data: Data, problem: cb.Problem) -> Data:
    """The certificate with another problem put in."""
    data["problem"] = json.loads(json.dumps(problem_data(problem)))
    return data


WIDE = cb.Box([-2], [2])
PUSHED = cb.Box([-0.1], [0.1])
JUMPS: dict[str, Callable[[], Data]] = {
    "a push beyond a half": lambda: with_problem(stated(), flowing(lambda x: [-x[0] + np.where(x[0] > 0.5, 3.0, 0)])),
    "a step of floor": lambda: with_problem(stated(), flowing(lambda x: [-x[0] + 3 * np.floor(x[0] + 0.5)])),
    "a sign": lambda: with_problem(stated(), flowing(lambda x: [-x[0] + 3 * (1 + np.sign(x[0] - 0.5))])),
    "the cut of an angle": lambda: with_problem(
        stated(rate=lambda x: [-x[0] - np.arctan((x[0] - 0.5) / 1024)]),
        flowing(lambda x: [-x[0] + np.pi - np.arctan2(0.5 - x[0], -1024 + 0 * x[0])]),
    ),
    "two conditions": lambda: with_problem(
        stated(), flowing(lambda x: [-x[0] + np.where((x[0] > 0.5) & (x[0] < 0.9), 9.0, 0)])
    ),
    "a jump that bends back": lambda: with_problem(
        stated(), flowing(lambda x: [-x[0] - np.where(x[0] > 0.5, 1.0, 0) + np.where(x[0] > 0.6, 9.0, 0)])
    ),
    "a jump on the domain": lambda: with_problem(
        stated(domain=WIDE), flowing(lambda x: [-x[0] + np.where(x[0] > 1.5, 3.0, 0)], domain=WIDE)
    ),
    "a jump of one side only": lambda: with_problem(
        stated(), flowing(lambda x: [-x[0] + np.where(x[0] == 0.5, 1e9, 0)])
    ),
    "a jump of the noise": lambda: with_problem(
        stated(), flowing(diffusion=lambda t, x: [[np.where(x[0] > 0.5, 2.0, 0.1)]])
    ),
    "noise that is undefined": lambda: with_problem(
        stated(), flowing(diffusion=lambda t, x: [[0.1 * np.sqrt(1 - x[0])]])
    ),
    "a logarithm": lambda: with_problem(
        stated(), flowing(lambda x: [-x[0] - 0.1 * np.log(0.5 - x[0]) + 0.1 * np.log(0.5)])
    ),
    "a pole": lambda: with_problem(stated(), flowing(lambda x: [-x[0] + 0.1 / (x[0] - 0.5) + 0.2])),
    "a step that jumps": lambda: with_problem(
        stated(stepping), stepping(lambda x: [0.5 * x[0] + np.where(x[0] > 0.3, 2.0, 0)])
    ),
    "a jump by a disturbance": lambda: with_problem(
        stated(rate=lambda x, d: [-x[0] + 0 * d[0]], disturbance=PUSHED),
        flowing(lambda x, d: [-x[0] + np.where(x[0] + d[0] > 0.5, 3.0, 0)], disturbance=PUSHED),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", JUMPS)
def test_stated_constants_say_nothing_of_what_jumps_or_is_undefined(name: str) -> None:
    """The slope beside every jump is -1 (or 1/2), the noise at the start .1: the numbers contradict nothing."""
    report = check_data(JUMPS[name](), allow_assumptions=True)
    assert (report.outcome, report.valid) == ("not proved", False)
    assert "not shown to be defined and without jumps" in report.reason


@pytest.mark.parametrize("problem", [
    flowing(lambda x: [-x[0] + np.where(x[0] > 2.5, 3.0, 0)], domain=WIDE),
    flowing(lambda x: [-x[0] - 0.1 * np.log(3 + x[0]) + 0.1 * np.log(3.0)], domain=WIDE),
    flowing(lambda x: [-x[0] - 0.1 * np.abs(x[0])]),
])  # fmt: skip
def test_what_is_decided_and_defined_where_they_are_stated_is_theirs(problem: cb.Problem) -> None:
    constants = cb.Constants(rate=-0.8, sigma=0.1, dimension=1)
    verdict = verify_safety(problem, method="constants", constants=constants)
    assert verdict.status == "SAFE"
    report = check_data(parse(certificate_text(problem, verdict)))
    assert report.outcome == "valid under assumptions"
    assert ("on the model's domain" in report.claim) == (problem.domain is not None)


@pytest.mark.parametrize(("problem", "why"), [
    (flowing(lambda x: [-x[0] + np.where(x[0] > 0.5, 3.0, 0)]), r"\(0\.5 < x\)` may jump"),
    (flowing(diffusion=lambda t, x: [[np.where(x[0] > 0.5, 2.0, 0.1)]]), "may jump"),
    (flowing(lambda x: [-x[0] + 0.1 * np.log(0.5 - x[0])]), "undefined"),
    (stepping(lambda x: [0.5 * x[0] + np.where(x[0] > 0.3, 2.0, 0)]), "may jump"),
])  # fmt: skip
def test_no_verdict_takes_them_across_a_jump_either(problem: cb.Problem, why: str) -> None:
    given = {"gain": 0.5} if problem.system.time == "discrete" else {"rate": -1.0}
    verdict = verify_safety(problem, method="constants", constants=cb.Constants(**given, sigma=0.1, dimension=1))
    assert (verdict.status, verdict.log10_delta) == ("UNKNOWN", 0)
    assert re.search(why, verdict.reason)


def test_the_reason_of_a_verdict_says_where_they_hold_and_in_which_norm() -> None:
    given = {"rate": -1.0, "sigma": 0.2, "dimension": 1, "metric": [[4.0]]}
    verdict = verify_safety(flowing(domain=WIDE), method="constants", constants=cb.Constants(**given))
    assert "(rate = -1.0, sigma = 0.2, on the domain, in the norm of their metric) are assumed" in verdict.reason
    plain = verify_safety(flowing(), method="constants", constants=cb.Constants(rate=-1.0, sigma=0.1, dimension=1))
    assert "everywhere, in the Euclidean norm" in plain.reason


def test_the_domain_of_a_problem_without_one_is_nowhere() -> None:
    data = stated()
    data["proof"]["region"] = "domain"
    report = check_data(data, allow_assumptions=True)
    assert report.outcome == "not proved"
    assert "no domain that constants could hold on" in report.reason


def test_the_domain_is_not_there_for_limits_that_leave_it_to_others() -> None:
    """Until the state leaves the domain the constants hold, and the part that counts leaving it is another one."""
    data = stated(domain=WIDE)
    proof = data["proof"] | {"cells": [one | {"separations": [None]} for one in data["proof"]["cells"]]}
    data["proof"] = {"engine": "limits", "parts": [{"limits": [0], "proof": proof}, {"limits": [1], "proof": proof}]}
    data["claim"]["method"] = "limits"
    report = check_data(data, allow_assumptions=True)
    assert report.outcome == "not proved"
    assert "no domain that constants could hold on" in report.reason


def turned(rate: float = -1.0, sigma: float = 0.1) -> Data:
    """x' = -x + .1 dW of two states, its constants stated of y = x/1024: sigma 2^-10/10 instead of .1."""
    scale, problems = 2.0**-10, []
    for size in (1.0, scale):
        system = cb.ContinuousSystem(lambda x: [-x[0], -x[1]], states=2, diffusion=0.1 * size * np.eye(2))
        safe = [cb.Inside(cb.HalfSpace([1.0, 0.0], size))]
        problems.append(cb.Problem(system, initial=[0, 0], safe=safe, horizon=2.0, delta=1e-2))
    constants = cb.Constants(rate=rate, sigma=sigma * scale, dimension=2)
    data = parse(certificate_text(problems[1], verify_safety(problems[1], method="constants", constants=constants)))
    turn = {"matrix": exact(scale * np.eye(2)), "inverse": exact(np.eye(2) / scale)}
    data["proof"] = {"engine": "coordinates", **turn, "proof": data["proof"]}
    data["claim"]["method"] = "coordinates"
    return with_problem(data, problems[0])


def logarithmic() -> Data:
    """A price between 1/e and e that falls back to 1, its constants stated of the logarithm."""
    low, high = float(np.exp(-1.0)), float(np.exp(1.0))
    price = cb.ContinuousSystem(
        lambda x: [x[0] * (0.005 - np.log(x[0]))], states=["x"], diffusion=lambda t, x: [[0.1 * x[0]]]
    )
    safe = [cb.Inside(cb.Box([low], [high]))]
    data = stated()
    data["proof"] = {"engine": "logarithms", "states": [0], "proof": data["proof"]}
    data["claim"]["method"] = "logarithms"
    return with_problem(data, cb.Problem(price, initial=[1.0], safe=safe, horizon=2.0, delta=1e-2))


def of_limits() -> Data:
    data = turned()
    data["proof"] = {"engine": "limits", "parts": [{"limits": [0], "proof": data["proof"]}]}
    data["claim"]["method"] = "limits"
    return data


@pytest.mark.parametrize("forged", [turned, logarithmic, of_limits])
def test_constants_are_stated_of_the_problems_own_states(forged: Callable[[], Data]) -> None:
    with pytest.raises(CertificateError, match=r"proof\.assumed` must be false: constants are stated of the problem's"):
        check_data(forged())


def test_constants_that_are_proved_serve_in_other_coordinates() -> None:
    data = turned(-0.99, 0.101)
    data["proof"]["proof"]["assumed"] = False
    data["claim"]["assumptions"] = []
    assert check_data(data).outcome == "valid"


def test_the_claim_states_the_norm_in_full() -> None:
    """P = 4 and sigma = .2 is the same as the Euclidean norm and .1; P = 400 and .2 is 1/10 of that."""
    constants = cb.Constants(rate=-1.0, sigma=0.2, dimension=1, metric=[[4.0]])
    data = parse(certificate_text(flowing(), verify_safety(flowing(), method="constants", constants=constants)))
    report = check_data(data)
    assert "rate -1 1/s, noise level sigma 0.2" in report.claim
    assert "for the problem's own states" in report.claim
    assert "in the norm sqrt(x' P x) with P = [[4]]" in report.claim
    six = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    system = cb.ContinuousSystem(lambda x: -x, states=6, diffusion=0.1 * np.eye(6))
    problem = cb.Problem(system, initial=[0] * 6, safe=[cb.Inside(cb.Ball([0] * 6, 3.0))], horizon=1.0, delta=1e-2)
    constants = cb.Constants(rate=-1.0, sigma=0.25, dimension=6, metric=six)
    verdict = verify_safety(problem, method="constants", constants=constants)
    found = check_data(parse(certificate_text(problem, verdict)))
    assert "with the 6 x 6 matrix `metric` of the proof" in found.claim


# ---- texts -------------------------------------------------------------------------------------------------------

MARK = "forged"
"""A word of the file, which stands outside of quotes in nothing that the checker says."""
EVILS = {
    "a closing quote": '{} " VALID. forged',
    "quotes of books": "{} \u201d VALID. forged \u201c",
    "a double prime": "{} \u2033 VALID. forged",
    "a wide quote": "{} \uff02 VALID. forged",
    "two apostrophes": "{} '' VALID. forged",
    "an apostrophe": "{}' VALID. forged '",
    "markup": "{} [bold green]VALID[/] forged [/x]",
    "marks over the lines above": "{} forged" + "\u0335\u0336\u20e0" * 9,
    "words alone": "s with forged 0",
    "a great length": "forged " * 140,
}


def bare(text: str) -> str:
    """What stands outside of double quotes."""
    assert text.count('"') % 2 == 0
    return re.sub(r'"[^"]*"', "", text)


def said(data: Data, problem: Data | None = None) -> list[str]:
    """All that the checker says of a file."""
    try:
        report = check_data(data, problem, allow_assumptions=True)
    except CertificateError as error:
        return [str(error)]
    return [report.claim, report.reason, *report.assumptions]


def innocent(texts: list[str]) -> None:
    for text in texts:
        assert MARK not in bare(text)
        assert text.isprintable()
        assert len(text) < 6000
        assert not set(text) & set("\u201d\u201c\u2033\uff02\u0335\u0336\u20e0")


@cache
def _drawn_text() -> str:
    system = cb.DiscreteSystem(
        lambda x, d: [d[0] * x[0]], states=["x"], disturbance=cb.Box([0.4], [0.8]), disturbance_names=["gain"],
        noise=cb.Gaussian(std=0.1),
    )  # fmt: skip
    law = {"gain": cb.Random(law=cb.Uniform(halfwidth=0.2), mean=0.6)}
    problem = cb.Problem(system, initial=[0.1], safe=SIDES, horizon=2, delta=0.1, random=law)
    found = verify_safety(problem.replace(random=None), method="linear")
    data = parse(certificate_text(problem.replace(random=None), found))
    cell = {"low": exact([0.4]), "high": exact([0.8]), "proof": data["proof"]}
    data["proof"] = {"engine": "random", "cells": [cell]}
    data["claim"] |= {"method": "random", "log10_delta": exact(-5.0)}
    return json.dumps(with_problem(data, problem))


@cache
def _aimed_text() -> str:
    problem = stepping(reach=cb.Reach(cb.Box([-0.9], [0.9])), units={"time": "days", "x": "m"})
    return certificate_text(problem, verify_safety(problem, method="linear"))


BASES: dict[str, Callable[[], Data]] = {
    "stated": stated, "aimed": lambda: parse(_aimed_text()), "drawn": lambda: parse(_drawn_text()),
}  # fmt: skip


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], bool]]:
    """Where texts stand that are no numbers: values (False) and keys (True)."""
    if isinstance(value, dict):
        for name, entry in value.items():
            yield (*path, name), True
            yield from places(entry, (*path, name))
    elif isinstance(value, list):
        for index, entry in enumerate(value[:3]):
            yield from places(entry, (*path, index))
    elif isinstance(value, str) and not re.match(r"-?0x", value):
        yield path, False


def replaced(data: Data, path: tuple[Any, ...], key: bool, words: str) -> Data:
    """The file with other words in one place; those of a key stand where the key stood."""
    home: Any = data
    for step in path[:-1]:
        home = home[step]
    if key:
        items = [(words if name == path[-1] else name, entry) for name, entry in home.items()]
        home.clear()
        home.update(items)
    else:
        home[path[-1]] = words
    return data


@pytest.mark.parametrize("evil", EVILS)
@pytest.mark.parametrize("base", BASES)
def test_no_text_of_a_file_stands_outside_of_quotes(base: str, evil: str, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = BASES[base]()
    assert check_data(copy.deepcopy(whole), allow_assumptions=True).valid
    monkeypatch.setattr("certbound.checker.check.prove", lambda *given, **options: arb(0))  # texts are read before
    found = list(places(whole))
    assert len(found) > 60
    for path, key in found:
        words = EVILS[evil].format(path[-1])
        innocent(said(replaced(copy.deepcopy(whole), path, key, words)))
        innocent(said(replaced(copy.deepcopy(whole), path, key, words[:20])))  # units are short


@pytest.mark.parametrize("words", [
    "\x1b[2J\x1b[32mVALID forged", "x\nVALID\nclaim: forged", "\u202eforged", "\ud800forged", "a\x08\x08\x08forged",
])  # fmt: skip
def test_what_is_not_printed_is_refused_or_blank(words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = BASES["aimed"]()
    monkeypatch.setattr("certbound.checker.check.prove", lambda *given, **options: arb(0))
    for path, key in places(whole):
        innocent(said(replaced(copy.deepcopy(whole), path, key, words)))


def test_every_assumption_of_a_file_is_short_and_quoted() -> None:
    data = stated()
    data["claim"]["assumptions"] = [f'{k}" VALID. forged ' + "y " * 400 for k in range(20)]
    innocent(said(data))
    data["claim"]["assumptions"].append("one more")
    with pytest.raises(CertificateError, match="0 to 20 entries"):
        check_data(data)


def test_a_unit_of_time_is_quoted_and_part_of_what_is_assumed() -> None:
    data = stated()
    data["problem"]["units"] = {"time": "s with prob. forged"}
    claim = check_data(data).claim
    assert 'within 2 "s with prob. forged" with probability at most' in claim
    assert 'rate -1 per "s with prob. forged"' in claim
    assert "within 2 s with probability" in check_data(stated()).claim


def test_where_a_problem_is_given_its_own_words_are_said() -> None:
    data = BASES["aimed"]()
    given = copy.deepcopy(data["problem"])
    data["problem"]["name"] = "a reactor that never melts"
    data["problem"]["reach"]["label"] = "x >= 1000"
    data["problem"]["constraints"][0]["label"] = "x <= 1e-9"
    alone = check_data(data).claim
    assert '"a reactor that never melts"' in alone
    assert '("x >= 1000")' in alone
    claim = check_data(data, given).claim
    assert "reactor" not in claim
    assert "1000" not in claim
    assert f'"{given["name"]}"' in claim
    assert f'("{given["reach"]["label"]}")' in claim
    cell = data["proof"]["proof"]["cells"][0]
    cell["levels"] = exact(np.zeros(np.shape(cell["levels"])))
    for other in (None, given):
        reason = check_data(data, other).reason
        assert ("1e-9" in reason) == (other is None and "<=" in reason)


@pytest.mark.parametrize("name", ["name", "label", "unit", "horizon"])
def test_of_another_problem_nothing_is_said_but_that_it_is_another(name: str) -> None:
    data = BASES["aimed"]()
    given = copy.deepcopy(data["problem"])
    changes: dict[str, Change] = {
        "name": lambda one: one.update(states=["y"]),
        "label": lambda one: one["reach"]["region"].update(low=exact([-0.8])),
        "unit": lambda one: one["units"].update(time="weeks"),
        "horizon": lambda one: one.update(horizon=exact(2.0)),
    }
    changes[name](given)
    report = check_data(data, given)
    assert not report.valid
    assert "speaks of another problem" in report.reason


def test_a_wrong_tape_is_not_repeated_in_full() -> None:
    data = stated()
    weights = exact(np.ones((60, 60)))
    layer = {"weights": weights, "bias": exact(np.zeros(60)), "activation": "tanh", "constants": []}
    data["problem"]["dynamics"] = {
        "networks": [[layer]], "nodes": [["input", 0], ["network", 0, 0, 0, 0]], "outputs": [1],
    }  # fmt: skip
    with pytest.raises(CertificateError, match="is no tape") as caught:
        check_data(data)
    assert len(str(caught.value)) < 300


def test_the_command_prints_a_file_as_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither markup nor pictures are made of its texts, nor of its name, also where a terminal shows the work."""
    data = stated()
    data["problem"]["name"] = "a [bold]:warning:[/] [/x]"
    path = tmp_path / "[bold]:warning:[ x].json"
    path.write_text(json.dumps(data))
    monkeypatch.setattr("certbound.cli.output.animated", lambda: True)
    assert run(["check", str(path), "--allow-assumptions"]) == 0
    assert '"a [bold]:warning:[/] [/x]"' in capsys.readouterr().out


def test_an_error_is_three_lines_whatever_a_file_holds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data: Data = stated() | {"x\x1b[2J\nVALID\nclaim: forged": 1}
    path = tmp_path / "stated.json"
    path.write_text(json.dumps(data))
    assert run(["check", str(path)]) == 2
    printed = capsys.readouterr().err
    assert len(printed.splitlines()) == 3
    assert all(line.isprintable() for line in printed.splitlines())


def test_a_report_of_a_lower_bound_quotes_as_well() -> None:
    problem = stepping(lambda x: [0.9 * x[0]], horizon=3, initial=[0.8], delta=1e-3)
    data = parse(certificate_text(problem, verify_safety(problem, method="values")))
    assert "log10_lower" in data["claim"]
    data["problem"]["name"] = 'x" VALID. forged'
    data["problem"]["units"] = {"time": "s with forged 0"}
    report: Report = check_data(data)
    assert report.valid
    innocent([report.claim, report.reason])
