"""``certbound synthesize``."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import certbound as cb
from certbound.cli.app import run
from tests.synthesis.conftest import cart

TOML = """
name = "cart"
time = "discrete"
horizon = 15
delta = 1e-3
states = ["p", "v"]
[inputs]
u = [-3, 3]
[dynamics]
p = "p + 0.1*v"
v = "v + 0.1*u"
[cost]
Q = [1, 1]
R = [0.01]
[noise]
law = "gaussian"
std = 0.01
[initial]
point = [1, 0]
[[stay]]
box = { p = [-0.5, 1.5], v = [-0.8, 0.8] }
"""


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "cart.toml"
    path.write_text(TOML)
    return path


def test_the_answer_has_its_keys_and_the_plan_is_read_back(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = tmp_path / "plan.json"
    code = run(["synthesize", str(source), "--closed-loop", "500", "--seed", "1", "--plan", str(plan), "--json"])
    answer = json.loads(capsys.readouterr().out)
    keys = {"feasible", "status", "log10_delta", "reason", "cost", "max_input", "seconds", "closed_loop"}
    assert code == 0
    assert keys <= answer.keys()
    assert {"runs", "violations", "max_input", "mean_final_cost"} <= answer["closed_loop"].keys()
    assert answer["feasible"] is True
    assert answer["status"] == "SAFE"
    planned = tmp_path / "planned.toml"
    planned.write_text(TOML + '[plan]\nfile = "plan.json"\n')
    assert run(["verify", str(planned), "--method", "linear", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["log10_delta"] == answer["log10_delta"]


def test_people_are_told_in_words(source: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["synthesize", str(source), "--tube", "linear"]) == 0
    shown = capsys.readouterr().out
    assert "SAFE" in shown
    assert "a plan with tube linear" in shown


def test_no_plan_is_exit_code_one(source: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source.write_text(TOML.replace("std = 0.01", "std = 0.5"))
    assert run(["synthesize", str(source), "--tube", "linear", "--json"]) == 1
    answer = json.loads(capsys.readouterr().out)
    assert answer["feasible"] is False
    assert answer["infeasible"]["proved"] is False


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--method", "nonsense"], "`method` must be"),
        (["--closed-loop", "0"], "--closed-loop"),
        (["--seed", "-1"], "--seed"),
        (["--feedback", "nonsense"], "`feedback` must be"),
        (["--feedback", "[[1, 1]]"], "`feedback` must stabilise"),
        (["--feedback", "[[1]]"], "`feedback` must have shape"),
        (["--feedback", "[[1,"], "`--feedback` is not a matrix"),
        (["--terminal", "nonsense"], "`terminal` must be"),
        (["--terminal", "contraction", "--tube", "linear"], "`terminal` from the contraction metric needs a gain < 1"),
        (["--steps", "0"], "`steps` must be a positive integer"),
        (["--horizon", "0"], "horizon"),
    ],
)
def test_bad_input_is_exit_code_two(
    source: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    assert run(["synthesize", str(source), *options]) == 2
    assert message in capsys.readouterr().err


def test_inputs_without_bounds_are_exit_code_two(source: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = TOML.replace("u = [-3, 3]", "u = [-inf, inf]").replace('v = "v + 0.1*u"', 'v = "v + 0.1*u*v"')
    source.write_text(text)
    assert run(["synthesize", str(source), "--tube", "kummer"]) == 2
    assert "`inputs` must be bounded" in capsys.readouterr().err


def test_a_matrix_serves_as_feedback(source: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["synthesize", str(source), "--tube", "linear", "--feedback", "[[-4, -3]]", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["status"] == "SAFE"


def test_a_problem_without_inputs_is_exit_code_two(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["synthesize", "ou"]) == 2
    assert "inputs" in capsys.readouterr().err


def test_the_picture_is_drawn(source: Path, tmp_path: Path) -> None:
    picture = tmp_path / "plan.png"
    assert run(["synthesize", str(source), "--plot", str(picture), "--json"]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_runs_of_nothing_are_refused() -> None:
    found = cb.synthesize_plan(cart(), method="linear")
    with pytest.raises(ValueError, match="`runs` must be a positive integer"):
        cb.simulate_closed_loop(found, runs=0)
