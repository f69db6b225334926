"""Every error becomes three lines and the right exit code."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

import certbound as cb
from certbound.cli.app import run
from certbound.cli.messages import BAD_INPUT, FAILED, InputError, explain, split_cure, write_error


def caught(function: object) -> Exception:
    try:
        function()  # type: ignore[operator]
    except Exception as error:  # noqa: BLE001  (the error is what is tested)
        return error
    raise AssertionError("nothing was raised")


@pytest.mark.parametrize(
    ("message", "why", "cure"),
    [
        ("`delta` must lie in (0, 1), got 1.5.", "`delta` must lie in (0, 1), got 1.5", ""),
        ("unknown key `sgma`; did you mean `sigma`?", "unknown key `sgma`", "did you mean `sigma`?"),
        ("`x` has shape (1; 2). Give a column.", "`x` has shape (1; 2)", "Give a column"),
        ("no answer after 3.5 s; raise the limit", "no answer after 3.5 s", "raise the limit"),
        ("two\n  lines; one cure", "two lines", "one cure"),
    ],
)
def test_a_message_is_split_into_reason_and_cure(message: str, why: str, cure: str) -> None:
    assert split_cure(message) == (why, cure)


def test_what_the_library_refuses_is_bad_input() -> None:
    error = caught(lambda: cb.Constants(rate=1.0, sigma=-1.0, dimension=1))
    code, why, cure = explain(error, "tune")
    assert code == BAD_INPUT
    assert "`sigma` must not be negative" in why
    assert cure == "see `certbound tune --help`"


def test_an_error_from_inside_numpy_is_a_failure_of_certbound() -> None:
    import numpy as np

    error = caught(lambda: np.zeros(2) + np.zeros(3))
    code, why, cure = explain(error, "verify")
    assert code == FAILED
    assert "ValueError" in why
    assert "--verbose" in cure


@pytest.mark.parametrize(
    ("error", "code", "cure"),
    [
        (InputError("one", "two"), BAD_INPUT, "two"),
        (cb.SolverError("the solver stopped; scale the states"), FAILED, "scale the states"),
        (cb.InfeasibleError("no metric exists; shorten the horizon"), FAILED, "shorten the horizon"),
        (cb.EnclosureError("1/x on [-1, 1]; shrink the domain"), BAD_INPUT, "shrink the domain"),
        (cb.CertificateError("the hash differs; ask for the file again"), BAD_INPUT, "ask for the file again"),
        (FileNotFoundError(2, "No such file or directory", "a.toml"), BAD_INPUT, "check the path"),
        (ModuleNotFoundError("No module named 'dask'", name="dask"), BAD_INPUT, 'pip install "certbound[cluster]"'),
        (MemoryError("no room for an array"), FAILED, "ask for less"),
        (RuntimeError("boom"), FAILED, "report"),
        (ZeroDivisionError("boom"), FAILED, "report"),
    ],
)
def test_each_kind_of_error_has_its_code_and_cure(error: Exception, code: int, cure: str) -> None:
    found, why, advice = explain(error, "verify")
    assert found == code
    assert why
    assert cure in advice


def test_three_lines_are_written(capsys: pytest.CaptureFixture[str]) -> None:
    write_error("verify refused its input", "because", "do this")
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["certbound: verify refused its input", "  why: because", "  try: do this"]


@pytest.mark.parametrize(("body", "why"), [
    ("problem = 1 / 0", r"the module raised ZeroDivisionError in line 2 of raising\.py: division by zero"),
    ("from math import nothing", r"the module raised ImportError in line 2 of raising\.py: cannot import name"),
    ("import not_installed_here", r"the module raised ModuleNotFoundError in line 2 of raising\.py: No module named"),
    ("def problem(): return {}['key']", r"the module raised KeyError in line 2 of raising\.py: 'key'"),
    ("def problem(): return int('x')", r"the module raised ValueError in line 2 of raising\.py: invalid literal"),
    ("problem = np.linalg.inv(np.zeros((2, 2)))", r"LinAlgError in line 2 of raising\.py: Singular matrix"),
    ("import certbound as cb; cb.Box([1], [0])", r"`low` must not exceed `high`, got 1 > 0"),
    ("raise SystemExit(0)", "the module ended the program"),
    ("def problem(): raise SystemExit(0)", "the module ended the program"),
])  # fmt: skip
def test_an_error_inside_a_module_is_the_modules(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], body: str, why: str
) -> None:
    """Neither is its name wrong, nor does the exit code of what it raised pass for an answer."""
    (tmp_path / "raising.py").write_text(f"import numpy as np\n{body}\n")
    monkeypatch.chdir(tmp_path)
    try:
        assert run(["verify", "raising:problem"]) == 2
    finally:
        sys.modules.pop("raising", None)
    said = capsys.readouterr().err
    assert re.search(why, said)
    assert "check the name" not in said


def test_an_error_says_no_control_characters(capsys: pytest.CaptureFixture[str]) -> None:
    write_error("a\x1b[2J", "b\nVALID", "c\u202e")
    assert capsys.readouterr().err == "certbound: a [2J\n  why: b VALID\n  try: c\n"


def test_a_trajectory_without_noise_says_that_it_came_before_the_method() -> None:
    problem = cb.load("ou", rate=0.5).replace(initial=[1.0])
    for method, said in (("auto", ""), ("quadratic", ", looked for before quadratic")):
        verdict = cb.verify_safety(problem, method=method)
        assert (verdict.status, verdict.method) == ("UNSAFE_NOMINAL", f"noise-free trajectory{said}")
