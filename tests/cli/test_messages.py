"""Every error becomes three lines and the right exit code."""

from __future__ import annotations

import pytest

import certbound as cb
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
