"""The verdict is printed first and stands, whatever becomes of its certificate; failures are not called bad input."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import certbound as cb
from certbound.cli.app import run
from certbound.cli.commands import check, verify
from certbound.cli.commands.check import proved_certificate
from certbound.errors import CertificateError
from certbound.safety.verification import verify_safety

OU = ["verify", "ou", "--method", "constants"]


def test_a_certificate_that_fails_takes_nothing_from_the_verdict(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def failing(*_: Any) -> str:
        raise CertificateError("nothing is left\nfor the noise")

    monkeypatch.setattr(verify, "proved_certificate", failing)
    path = tmp_path / "ou.json"
    assert run([*OU, "--certificate", str(path)]) == 0
    streams = capsys.readouterr()
    assert streams.out.startswith("SAFE")
    assert streams.err == "certbound: no certificate was written: nothing is left for the noise\n"
    assert not path.exists()
    assert run([*OU, "--certificate", str(path), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["status"] == "SAFE"
    assert result["certificate"] == {"path": None, "log10_delta": None, "reason": "nothing is left for the noise"}


def test_the_verdict_is_printed_before_the_certificate_is_tried(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: Any) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr(verify, "proved_certificate", interrupted)
    assert run([*OU, "--certificate", str(tmp_path / "ou.json")]) == 130
    assert capsys.readouterr().out.startswith("SAFE")


def test_the_json_says_where_the_certificate_lies_and_what_it_proves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "ou.json"
    assert run([*OU, "--certificate", str(path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["certificate"]
    claim = json.loads(path.read_text())["claim"]
    assert found["path"] == str(path)
    assert found["log10_delta"] == float.fromhex(claim["log10_delta"])
    assert found["reason"] == ""


def test_where_one_engines_certificate_is_not_proved_anothers_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    import certbound.checker as checker

    whole = checker.check_data
    problem = cb.load("ou")
    verdict = verify_safety(problem)
    best = min(verdict.answers, key=lambda name: verdict.answers[name].log10_delta)

    def strict(data: Any, given: Any = None, **options: Any) -> Any:
        report = whole(data, given, **options)
        refused = data["claim"]["method"] == best
        return replace(report, valid=False, reason="not this one") if refused else report

    monkeypatch.setattr(checker, "check_data", strict)
    monkeypatch.setattr(check, "ATTEMPTS", 1)
    claim = json.loads(proved_certificate(problem, verdict))["claim"]
    assert claim["method"] in {"linear", "constants"} - {best}


@pytest.mark.parametrize("command", ["derive", "tune"])
def test_what_fails_inside_is_not_called_bad_input(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def failing(*_: Any, **__: Any) -> Any:
        raise ValueError("`gain` must be positive, got 0.0.")

    monkeypatch.setattr("certbound.constants.bounds.bound_constants", failing)
    assert run([command, "ou"]) == 3
    error = capsys.readouterr().err
    assert "the constants engine failed (ValueError: `gain` must be positive, got 0.0)" in error
    assert "refused its input" not in error


def test_with_a_time_limit_all_engines_answers_are_kept(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["verify", "ou", "--time-limit", "300", "--explain", "--json"]) == 0
    engines = json.loads(capsys.readouterr().out)["engines"]
    assert {"linear", "constants"} <= {row["engine"] for row in engines}


def test_a_search_for_limits_stops_when_the_time_is_over(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def slow(*_: Any, **__: Any) -> Any:
        raise verify.OutOfTime

    monkeypatch.setattr("certbound.safety.limits.limits_so_far", slow)
    assert run(["verify", "ou", "--delta", "1e-90", "--method", "constants", "--explain"]) == 1
    assert "The time was over before it was known what would be SAFE." in capsys.readouterr().out


def test_what_the_checker_does_not_prove_is_no_certificate(monkeypatch: pytest.MonkeyPatch) -> None:
    from certbound import checker
    from certbound.checker import check_data

    def strict(*arguments: Any, **options: Any) -> Any:
        return replace(check_data(*arguments, **options), valid=False, reason="nothing is left for the noise.")

    monkeypatch.setattr(checker, "check_data", strict)
    monkeypatch.setattr(check, "ATTEMPTS", 1)
    problem = cb.load("ou")
    with pytest.raises(CertificateError, match=r"no certificate could be proved .* nothing is left for the noise"):
        proved_certificate(problem, verify_safety(problem, method="constants"))


def test_where_nothing_is_proved_simulated_paths_are_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    unknown = [*OU, "--set", "radius=0.8", "--delta", "1e-4"]
    assert run(unknown) == 1
    last = capsys.readouterr().out.splitlines()[-1]
    assert re.fullmatch(r"simulated, which proves nothing: 1\d\d of 1000 paths failed, more often than 0.0001", last)
    for quieter in ("--json", "--quiet"):
        assert run([*unknown, quieter]) == 1
        assert "simulated" not in capsys.readouterr().out

    def broken(*_: Any, **__: Any) -> None:
        raise ValueError("the noise has no law")

    monkeypatch.setattr("certbound.simulation.estimates.simulate_exits", broken)
    assert run(unknown) == 1
    assert capsys.readouterr().out.splitlines()[-1].startswith("method")
