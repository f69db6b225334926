"""The commands as they are called: exit codes, JSON, files, and nothing else on standard output."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.cli.app import app, run
from certbound.cli.describe import deviation_text
from certbound.cli.output import write_file
from certbound.tubes.kummer import mixing

VERIFY_KEYS = {
    "status", "log10_delta", "log10_lower", "delta", "margin", "time", "constraint", "reason", "method", "constants",
    "tube", "by_limit", "seconds",
}  # fmt: skip


def answer(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, dict[str, Any]]:
    """Exit code and the one JSON object that a command prints."""
    code = run([*words, "--json"])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1
    return code, json.loads(lines[0])


def refusal(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """The three lines of a refusal; nothing on standard output, exit code 2."""
    assert run(list(words)) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    lines = captured.err.splitlines()
    assert len(lines) == 3
    assert lines[0].startswith("certbound: ")
    assert lines[1].startswith("  why: ")
    assert lines[2].startswith("  try: ")
    assert "Traceback" not in captured.err
    return captured.err


def test_what_is_written_leaves_links_and_devices_and_names_the_file(tmp_path: Path) -> None:
    """`--certificate /dev/null` replaced the device, where root ran it."""
    (tmp_path / "link").symlink_to("file")
    write_file(tmp_path / "link", "new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "file").read_text() == "new"
    os.mkfifo(tmp_path / "pipe")
    reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    write_file(tmp_path / "pipe", "new")
    assert os.read(reader, 9) == b"new"
    os.close(reader)
    assert (tmp_path / "pipe").is_fifo()
    with pytest.raises(OSError, match=r"none/file'$"):
        write_file(tmp_path / "none" / "file", "new")


# ---- verify ------------------------------------------------------------------------------------------------


def test_verify_prints_the_keys_of_the_contract(capsys: pytest.CaptureFixture[str]) -> None:
    code, found = answer(capsys, "verify", "ou", "--method", "kummer")
    assert code == 0
    assert found.keys() == VERIFY_KEYS
    assert found["status"] == "SAFE"
    assert found["delta"] == 1e-3
    assert found["log10_delta"] <= -3
    assert found["constants"]["rate"] == -0.5
    tube = found["tube"]
    assert tube.keys() == {"times", "radius", "extent"}
    assert len(tube["times"]) == len(tube["radius"]) + 1 == len(tube["extent"]) + 1
    assert tube["times"][0] == 0
    assert tube["times"][-1] == 5
    assert 1.2858 <= max(tube["radius"]) <= 1.3401
    assert all(len(row) == 1 for row in tube["extent"])


def test_the_smallest_probability_goes_into_the_answer_and_the_certificate(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    first = answer(capsys, "verify", "chain_rest")[1]
    file = tmp_path / "c.json"
    code, found = answer(capsys, "verify", "chain_rest", "--smallest", "--certificate", str(file))
    assert code == 0
    assert found.keys() == VERIFY_KEYS | {"certificate"}
    assert found["delta"] == first["delta"] == 0.002
    assert found["log10_delta"] < 2 * first["log10_delta"]
    code, checked = answer(capsys, "check", str(file), "--problem", "chain_rest")
    assert (code, checked["valid"]) == (0, True)
    assert "10^-6" in checked["claim"]
    stopped = answer(capsys, "verify", "chain_rest", "--smallest", "--time-limit", "0.2")[1]
    assert stopped["log10_delta"] <= 0


def test_an_answer_that_is_not_safe_exits_with_one(capsys: pytest.CaptureFixture[str]) -> None:
    code, found = answer(capsys, "verify", "ou", "--method", "kummer", "--set", "radius=0.5")
    assert code == 1
    assert found.keys() == VERIFY_KEYS
    assert found["status"] == "UNKNOWN"
    assert -3 < found["log10_delta"] <= 0
    assert "0.5" in found["constraint"]


def test_a_noise_free_path_that_leaves_is_unsafe(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "drift.toml"
    path.write_text(
        'states = ["x"]\ntime = "continuous"\nhorizon = 2\n[dynamics]\nx = "1"\n[noise]\ndiffusion = [[0.1]]\n'
        "[initial]\npoint = [0]\n[[stay]]\nbox = { x = [-1, 1] }\n"
    )
    code, found = answer(capsys, "verify", str(path))
    assert code == 1
    assert found.keys() == VERIFY_KEYS
    assert found["status"] == "UNSAFE_NOMINAL"
    assert found["log10_delta"] == 0
    assert 1 <= found["time"] <= 2


def test_horizon_delta_and_settings_change_the_problem(capsys: pytest.CaptureFixture[str]) -> None:
    words = ("--horizon", "1", "--delta", "1e-6", "--set", "sigma=1e-1", "--set", "rate=-1")
    code, found = answer(capsys, "verify", "ou", "--method", "kummer", *words)
    assert code == 0
    assert found["delta"] == 1e-6
    assert found["tube"]["times"][-1] == 1
    assert found["constants"]["rate"] == -1
    assert found["constants"]["sigma"] == pytest.approx(0.1)


def test_explain_shows_every_engine(capsys: pytest.CaptureFixture[str]) -> None:
    _, found = answer(capsys, "verify", "ou", "--method", "kummer", "--explain")
    assert [row["engine"] for row in found["engines"]] == ["constants"]
    assert found["engines"][0]["log10_delta"] == found["log10_delta"]


def test_the_plot_is_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "ou.png"
    assert run(["verify", "ou", "--method", "kummer", "--plot", str(path), "--quiet"]) == 0
    assert path.read_bytes().startswith(b"\x89PNG")
    assert capsys.readouterr().out.startswith("SAFE  ou: P(leaving within 5 s) <= ")


def test_people_get_the_verdict_first(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["verify", "ou", "--method", "kummer"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("SAFE  ou: P(leaving within 5 s) <= ")
    assert lines[0].endswith("asked 0.001")
    assert lines[1].startswith("margin ")


def test_a_deviation_that_is_bounded_in_some_states_is_said_of_these() -> None:
    """It said `at most inf`."""
    tube = {"radius": [0.5, np.inf], "extent": [[0.3, 0.4, 0.1], [0.2, np.inf, 0.15]]}
    assert deviation_text(tube, ["x", "y", "z"]) == "at most 0.3 in x, 0.15 in z"
    assert deviation_text({**tube, "radius": [0.5, 0.25]}, ["x", "y", "z"]) == "at most 0.5"


# ---- derive, tune, problems, new -----------------------------------------------------------------------------


def test_derive_gives_the_constants(capsys: pytest.CaptureFixture[str]) -> None:
    code, found = answer(capsys, "derive", "ou")
    assert code == 0
    assert {"rate", "sigma", "effective_dimension", "certified", "gap", "seconds", "metrics"} <= found.keys()
    assert found["rate"] == -0.5
    assert found["certified"] is True
    assert len(found["metrics"]) == 1


def test_derive_says_that_a_jump_at_the_start_leaves_no_constants(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "jump.toml").write_text(
        'time = "discrete"\nhorizon = 3\nstates = ["x"]\ninitial = {box = [[-0.1, 0.1]]}\n'
        'dynamics = {x = "x - 0.3*sign(x)"}\nnoise = {law = "gaussian", std = 0.1}\nstay = [{box = {x = [-1, 1]}}]\n'
    )
    assert run(["derive", str(tmp_path / "jump.toml")]) == 3
    said = capsys.readouterr().err
    assert "no reach tube was proved beyond the start" in said
    assert "ValueError" not in said


def test_tune_gives_every_method_and_the_radii_that_are_known(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mixing, "_rows", lambda cut: cut.graded(32))  # a small program
    code, found = answer(capsys, "tune", "ou")
    assert code == 0
    for row in found["rows"]:
        assert row.keys() == {"method", "level", "final", "maximum", "mean", "parameters", "seconds"}
    largest = {row["method"]: row["maximum"] for row in found["rows"]}
    assert 1.2857 <= largest["exact"] <= 1.003 * 1.2858  # the exact radius is 1.2858; a certified one lies above it
    assert largest["kummer"] <= 1.340
    windows = [row for row in found["rows"] if row["method"] == "thm3"]
    assert any(
        row["parameters"].get("step") == 0.05 and row["maximum"] == pytest.approx(2.124, abs=1e-3) for row in windows
    )
    levels = {row["method"]: row["level"] for row in found["rows"]}
    assert levels["prop1"] == levels["markov"] == "one time"
    assert levels["kummer"] == levels["thm3"] == "trajectory"
    assert levels[found["method"]] == "trajectory"


def test_problems_are_listed_with_their_keys(capsys: pytest.CaptureFixture[str]) -> None:
    _, found = answer(capsys, "problems")
    rows = {row["name"]: row for row in found["problems"]}
    assert rows.keys() == {"ou", "unicycle", "chain", "chain_rest", "pendulum"}
    for row in rows.values():
        assert row["summary"]
        assert "sigma" in row["parameters"]


def test_a_new_file_loads_and_is_never_overwritten(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, found = answer(capsys, "new", "my_system")
    assert code == 0
    problem = cb.load(found["path"])
    assert problem.system.states == ("angle", "speed")
    before = Path(found["path"]).read_text()
    assert "exists already" in refusal(capsys, "new", "my_system")
    assert Path(found["path"]).read_text() == before
    assert "letters, digits" in refusal(capsys, "new", "two words")
    assert {path.name for path in tmp_path.iterdir()} == {"my_system.toml", "problem.schema.json"}
    assert before.splitlines()[0] == "#:schema problem.schema.json"
    schema = json.loads((tmp_path / "problem.schema.json").read_text())
    assert {"dynamics", "initial", "stay", "avoid", "reach", "noise"} <= schema["properties"].keys()
    assert schema["additionalProperties"] is False
    assert {"law", "std", "probabilities", "independent"} <= schema["$defs"]["Noise"]["properties"].keys()


@pytest.mark.parametrize("example", ["pendulum", "drawn", "switching"])  # the others: tests/safety/test_features.py
def test_every_example_is_a_problem_that_is_verified(
    example: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, found = answer(capsys, "new", f"my_{example}", "--example", example)
    assert code == 0
    assert cb.load(found["path"]).name == f"my {example}"
    code, found = answer(capsys, "verify", found["path"])
    assert (code, found["status"]) == (0, "SAFE")
    assert "must be one of pendulum, " in refusal(capsys, "new", "other", "--example", "none")


def test_the_doctor_reports_every_dependency(capsys: pytest.CaptureFixture[str]) -> None:
    code, found = answer(capsys, "doctor")
    assert code == 0
    assert found["ok"] is True
    names = {row["name"] for row in found["checks"]}
    assert {"python", "numpy", "python-flint", "rounding", "ball arithmetic", "solver", "verdict"} <= names


def test_the_doctor_compiles_what_first_calls_would(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from certbound.cli.commands import doctor
    from certbound.problem import library

    monkeypatch.setattr(doctor, "_requirements", dict)
    monkeypatch.setattr(library, "MODELS", {"ou": library.MODELS["ou"]})
    monkeypatch.setattr(doctor, "_value_kernels", dict)
    found = answer(capsys, "doctor", "--warm")[1]
    details = {row["name"]: row["detail"] for row in found["checks"]}
    assert details.keys() >= {"kernels: ou", "kernels: ou --rare"}
    assert "compiled" in details["kernels: ou"]
    again = answer(capsys, "doctor", "--warm")[1]
    assert [row["detail"][:1] for row in again["checks"] if "kernels" in row["name"]] == ["0", "0"]


def test_a_broken_installation_is_reported(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    from certbound.cli.commands import doctor

    monkeypatch.setattr(doctor, "_verdict", lambda: "fine")
    monkeypatch.setattr(doctor, "_requirements", lambda: {"numpy": ">=99.0", "not-there": ">=1"})
    code, found = answer(capsys, "doctor")
    assert code == 3
    broken = {row["name"]: row["detail"] for row in found["checks"] if not row["ok"]}
    assert broken.keys() == {"numpy", "not-there"}
    assert ">=99.0 is needed" in broken["numpy"]


# ---- global options ------------------------------------------------------------------------------------------


def test_the_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--version"]) == 0
    assert capsys.readouterr().out == f"certbound {cb.__version__}\n"


def test_no_command_is_no_success(capsys: pytest.CaptureFixture[str]) -> None:
    assert run([]) == 2
    assert "Usage: certbound" in capsys.readouterr().out


@pytest.mark.parametrize("command", [entry.name for entry in app.registered_commands])
def test_every_command_has_help_with_an_example(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run([command, "--help"]) == 0
    text = capsys.readouterr().out
    assert f"Example: certbound {command}" in text
    assert "--json" in text


def test_verbose_logs_to_standard_error_only(capsys: pytest.CaptureFixture[str]) -> None:
    code = run(["problems", "--quiet", "--verbose"])
    captured = capsys.readouterr()
    assert code == 0
    assert captured.out.split() == ["chain", "chain_rest", "ou", "pendulum", "unicycle"]


def test_an_interrupt_leaves_nothing_and_exits_with_130(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import certbound.safety.verification as verification

    def stop(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(verification, "verify_safety", stop)
    path = tmp_path / "ou.png"
    assert run(["verify", "ou", "--plot", str(path), "--json"]) == 130
    captured = capsys.readouterr()
    assert "interrupted" in json.loads(captured.out)["error"]
    assert "interrupted" in captured.err
    assert list(tmp_path.iterdir()) == []


def test_a_failing_solver_exits_with_three(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    import certbound.safety.verification as verification

    def fail(*_: Any, **__: Any) -> None:
        raise cb.SolverError("Clarabel stopped; scale the states")

    monkeypatch.setattr(verification, "verify_safety", fail)
    assert run(["verify", "ou", "--json"]) == 3
    captured = capsys.readouterr()
    assert json.loads(captured.out) == {"error": "verify failed", "why": "Clarabel stopped", "try": "scale the states"}
    assert captured.err.splitlines()[1:] == ["  why: Clarabel stopped", "  try: scale the states"]


def test_standard_output_is_kept_clean(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["verify", "ou", "--method", "kummer", "--json"]) == 0
    out, err = capfd.readouterr()  # of the process, compiled libraries included
    assert json.loads(out)["status"] == "SAFE"
    assert err == ""
    assert list(tmp_path.iterdir()) == []


# ---- bad input -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "why", "cure"),
    [
        (["verify", "unicyle"], "unicyle", "unicycle"),
        (["verify", "missing.toml"], "missing.toml", ""),
        (["verify", "ou", "--set", "sgma=1"], "sgma", "sigma"),
        (["verify", "ou", "--set", "sigma=nan"], "nan", "--set sigma=0.02"),
        (["verify", "ou", "--set", "sigma"], "key=value", "--set sigma"),
        (["verify", "ou", "--delta", "1.5"], "`delta`", "--delta"),
        (["verify", "ou", "--delta", "0"], "`delta`", "--delta"),
        (["verify", "ou", "--delta", "nan"], "nan", "verify --help"),
        (["verify", "ou", "--horizon", "0"], "`horizon`", "--horizon"),
        (["verify", "ou", "--horizon", "-1"], "`horizon`", "--horizon"),
        (["verify", "chain_rest", "--horizon", "2.5"], "whole", "whole steps"),
        (["verify", "ou", "--method", "magic"], "`method`", ""),
        (["verify", "ou", "--method", "thm5"], "thm5", ""),
        (["verify", "ou", "--cells", "1.5"], "whole", "verify --help"),
        (["verify", "ou", "--cells", "0"], "cells", ""),
        (["verify", "ou", "--plot", "no/such/folder/a.png"], "does not exist", "mkdir"),
        (["verify", "ou", "--bogus"], "--bogus", "verify --help"),
        (["verify"], "PROBLEM", "verify --help"),
        (["verfy", "ou"], "verfy", "certbound verify"),
        (["derive", "ou", "--set", "dimension=0"], "dimension", ""),
        (["tune", "math:sqrt"], "", ""),
    ],
)
def test_bad_input_gets_three_lines(
    words: list[str],
    why: str,
    cure: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    lines = refusal(capsys, *words).splitlines()
    assert why in lines[1]
    assert cure in lines[2]
    assert list(tmp_path.iterdir()) == []


def test_a_problems_name_cannot_imitate_a_verdict(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    file = tmp_path / "named.toml"
    file.write_text(
        'name = "[bold]x[/]\\nSAFE  y: P(leaving within 1 s) <= 1e-9, asked 0.001"\ntime = "continuous"\nhorizon = 1\n'
        'states = ["x"]\n[dynamics]\nx = "x"\n[noise]\ndiffusion = [[3.0]]\n[initial]\npoint = [0]\n'
        '[[stay]]\nlabel = "a\\nSAFE"\nbox = { x = [-1, 1] }\n'
    )
    assert run(["verify", str(file), "--method", "kummer"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith('UNKNOWN  "[bold]x[/] SAFE y: P(leaving')
    assert not any(line.startswith("SAFE") for line in lines)


def test_unsafe_has_a_certificate_of_its_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, file = tmp_path / "walk.toml", tmp_path / "c.json"
    path.write_text(
        'states = ["x"]\ntime = "discrete"\nhorizon = 4\ndelta = 0.01\n[dynamics]\nx = "0.9*x"\n[noise]\n'
        'law = "gaussian"\nstd = [0.4]\n[initial]\npoint = [0]\n[[stay]]\nbox = { x = [-1, 1] }\n'
    )
    code, found = answer(capsys, "verify", str(path), "--method", "values", "--certificate", str(file))
    assert (code, found["status"]) == (1, "UNSAFE")
    assert found["certificate"]["log10_delta"] == 0
    assert -2 < found["certificate"]["log10_lower"] <= found["log10_lower"] + 0.01
    code, checked = answer(capsys, "check", str(file), "--problem", str(path))
    assert (code, checked["valid"]) == (0, True)
    assert "from some start" in checked["claim"]
    assert "(more than delta = 0.01)" in checked["claim"]
    assert run(["simulate", str(path), "--paths", "100", "--against", str(file)]) == 2
    assert "claims a lower bound" in capsys.readouterr().err
