"""The check command: what it prints, and its exit codes."""

from __future__ import annotations

import json
import time

import pytest

from certbound.cli.app import run


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory):
    path = tmp_path_factory.mktemp("certificates") / "chain.json"
    words = ["verify", "chain", "--horizon", "5", "--method", "linear", "--certificate", str(path), "--quiet"]
    assert run(words) == 0
    return path


def test_a_valid_certificate_exits_with_0(certificate, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["check", str(certificate), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert list(result) == ["valid", "claim", "reason", "seconds", "outcome", "assumptions"]
    assert result["valid"] is True
    assert (result["outcome"], result["assumptions"]) == ("valid", [])
    assert "chain" in result["claim"]


def test_the_given_problem_is_compared(certificate, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["check", str(certificate), "--problem", "chain", "--horizon", "5"]) == 0
    assert "VALID" in capsys.readouterr().out
    for other in (["--problem", "chain"], ["--problem", "chain", "--horizon", "5", "--set", "sigma=0.5"]):
        assert run(["check", str(certificate), *other]) == 1
        assert "another problem" in capsys.readouterr().out


def test_a_changed_certificate_exits_with_1(certificate, tmp_path, capsys: pytest.CaptureFixture[str]) -> None:
    data = json.loads(certificate.read_text())
    data["claim"]["log10_delta"] = (-1e6).hex()
    changed = tmp_path / "changed.json"
    changed.write_text(json.dumps(data))
    assert run(["check", str(changed), "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["valid"] is False


@pytest.mark.parametrize("content", ["", "{", "[" * 100_000, '{"a": NaN}', '{"a": 1e999}', "null"])
def test_what_is_no_certificate_exits_with_2_and_one_line_why(
    content: str, tmp_path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bad.json"
    path.write_text(content)
    started = time.perf_counter()
    assert run(["check", str(path)]) == 2
    assert time.perf_counter() - started < 2.0
    assert len([line for line in capsys.readouterr().err.splitlines() if "why:" in line]) == 1


def test_a_huge_or_missing_file_exits_with_2(tmp_path, capsys: pytest.CaptureFixture[str]) -> None:
    huge = tmp_path / "huge.json"
    with huge.open("wb") as stream:
        stream.truncate(100_000_000)
    assert run(["check", str(huge)]) == 2
    assert "95 MiB" in capsys.readouterr().err
    assert run(["check", str(tmp_path / "none.json")]) == 2


def test_settings_without_a_problem_are_refused(certificate, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["check", str(certificate), "--set", "sigma=1"]) == 2
    assert "--problem" in capsys.readouterr().err


def test_a_verdict_without_a_bound_writes_no_file(tmp_path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "none.json"
    words = ["verify", "chain", "--horizon", "2", "--set", "sigma=300", "--method", "linear"]
    assert run([*words, "--certificate", str(path)]) == 1
    assert "no certificate was written" in capsys.readouterr().err
    assert not path.exists()


def test_a_barrier_is_written_and_checked(tmp_path, capsys: pytest.CaptureFixture[str]) -> None:
    problem, path = tmp_path / "pull.toml", tmp_path / "pull.json"
    problem.write_text(
        'name = "pull"\ntime = "continuous"\nhorizon = 1\nstates = ["x"]\ndelta = 1e-2\n[dynamics]\nx = "-x - x**3"\n'
        '[noise]\ndiffusion = [[0.3]]\n[initial]\npoint = [0]\n[[stay]]\nbox = { x = [-1, 1] }\n'
    )
    words = ["verify", str(problem), "--method", "barrier", "--certificate", str(path), "--quiet"]
    assert run(words) == 0
    assert run(["check", str(path), "--problem", str(problem)]) == 0
    assert "exponential of a polynomial" in capsys.readouterr().out.replace("\n", " ")
    assert run(["check", str(path), "--problem", str(problem), "--horizon", "2"]) == 1


def test_the_table_of_certificates_has_a_row_a_problem() -> None:
    import certbound as cb
    from experiments.certificates import row, subjects, table

    assert {"ou", "unicycle", "chain", "chain_rest", "pendulum", "oscillator_cubic", "two_tanks"} <= set(subjects())
    found = row("chain, 5 steps", cb.load("chain").replace(horizon=5))
    assert (found.status, found.check, found.quick) == ("SAFE", "valid", True)
    assert abs(found.log10_delta - found.claimed) < 1
    assert found.size > 1000
    unproved = row("loud", cb.load("chain", sigma=300.0).replace(horizon=2))
    assert unproved.check.startswith("none: ")
    lines = list(table([["a", "b"], found.cells()[:2]]))
    assert lines[1].startswith("chain, 5 steps  SAFE")
