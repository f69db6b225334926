"""``certbound sweep``: the table, its files, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from certbound.cli.app import run

ROW = {"parameters", "status", "log10_delta", "log10_lower", "method", "reason", "seconds"}
LINEAR = ("--method", "linear", "--jobs", "1")


def test_json_files_and_pictures(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    table, picture, kept = tmp_path / "s.csv", tmp_path / "s.png", tmp_path / "r.jsonl"
    words = ["sweep", "ou", "--over", "sigma=0.1:0.5:2", "--over", "horizon=1", *LINEAR, "--json"]
    assert run([*words, "--out", str(table), "--plot", str(picture), "--resume", str(kept)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found.keys() == {"over", "rows", "seconds"}
    assert found["over"] == {"sigma": [0.1, 0.5], "horizon": [1.0]}
    assert [row.keys() for row in found["rows"]] == [ROW, ROW]
    assert len(table.read_text().splitlines()) == len(kept.read_text().splitlines()) == 3
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert run([*words, "--resume", str(kept)]) == 0
    assert json.loads(capsys.readouterr().out)["rows"] == found["rows"]


def test_the_boundary_in_words(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    table = tmp_path / "b.csv"
    words = ["sweep", "chain_rest", "--over", "delta=1e-300:0.1:3:log", "--boundary", "delta", *LINEAR]
    assert run([*words, "--out", str(table)]) == 0
    shown = capsys.readouterr().out.splitlines()
    assert shown[0].startswith("smallest SAFE delta")
    assert table.read_text().splitlines()[0] == "delta_safe,delta_not_safe,log10_delta"


def test_rows_in_words_and_a_point_without_verdict(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from certbound.errors import SolverError
    from certbound.safety.sweeps import running

    proved = running._proved

    def failing(problem: object, settings: object) -> object:
        if problem.horizon == 2:  # type: ignore[attr-defined]
            raise SolverError("no luck.")
        return proved(problem, settings)  # type: ignore[arg-type]

    monkeypatch.setattr(running, "_proved", failing)
    assert run(["sweep", "ou", "--over", "horizon=1,2", *LINEAR]) == 3
    shown = capsys.readouterr().out.splitlines()
    assert shown[0].startswith("SAFE  horizon = 1: P <= ")
    assert shown[2] == "no verdict at horizon = 2: no luck."
    assert shown[-1] == "ou over horizon: 2 points, 1 FAILED, 1 SAFE"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "Missing option '--over'"),
        (("--over", "sigma"), "`--over` takes key=values, got `sigma`"),
        (("--over", "sigma=1", "--over", "sigma=2"), "`--over sigma` is given twice"),
        (("--over", "sigma=0.1:0.2"), "low:high:count"),
        (("--over", "sigma=0.2:0.1:5"), "the range is empty: 0.2 is not below 0.1"),
        (("--over", "sigma=0.1:0.2:1"), "at least 2, got `1`"),
        (("--over", "sigma=0.1:0.2:2.5"), "at least 2, got `2.5`"),
        (("--over", "sigma=0.1:0.2:3:lin"), "low:high:count:log"),
        (("--over", "sigma=0.1:0.2:3:log:log"), "low:high:count:log"),
        (("--over", "sigma=0:0.2:3:log"), "begins above 0"),
        (("--over", "sigma=0.1,,0.2"), "must be a number such as 0.5"),
        (("--over", "sigma=nan"), "must be a finite number"),
        (("--over", "sigmas=0.1"), "`sigmas` is no parameter of ou"),
        (("--over", "sigma=0.1", "--set", "sigma=1"), "must not hold `sigma`"),
        (("--over", "sigma=0.1", "--jobs", "1", "--cluster", "tcp://x:1"), "exclude each other"),
        (("--over", "sigma=0.1", "--out", "/nowhere/at/all.csv"), "does not exist"),
        (("--over", "sigma=0.1", "--resume", "/tmp"), "is a directory"),
        (("--over", "sigma=0.1", "--plot", "s.xyz"), "no format of pictures"),
        (("--over", "sigma=0.1", "--out", "s.csv", "--resume", "s.csv"), "written twice"),
        (("--over", "sigma=0.1", "--boundary", "radius"), "must be a name in `over`, got 'radius'"),
    ],
)
def test_malformed_input_is_refused(capsys: pytest.CaptureFixture[str], words: tuple[str, ...], message: str) -> None:
    assert run(["sweep", "ou", *words]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert message in captured.err
    assert len(captured.err.splitlines()) == 3
