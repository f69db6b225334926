"""The check of the printed numbers fails where a number is wrong, missing, or out of its tolerance."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from paper_figs import check as figures_check

EXPECTED = json.loads((figures_check.HERE / "expected.json").read_text(encoding="utf-8"))["claims"]


def entry(**changes: Any) -> dict[str, Any]:
    return {
        "claim": "fig0.radius",
        "place": "Sec. 0",
        "value": 3.32,
        "tolerance": 0.01,
        "status": "reproduced",
        **changes,
    }


CLAIMS = {"fig0": {"radius": 3.3271, "optimum": 19, "values": [1.0, 2.0], "safe": True}}


def test_a_number_within_its_tolerance_passes() -> None:
    (row,) = figures_check.check([entry()], CLAIMS, "quick")
    assert row.passed


@pytest.mark.parametrize(
    "wrong",
    [
        entry(value=3.42),
        entry(tolerance=0.001),
        entry(claim="fig0.missing"),
        entry(claim="fig7.radius"),
        entry(claim="fig0.optimum", value=20, tolerance=0),
        {**entry(claim="fig0.values"), "value": [1.0, 2.1]},
        {**entry(claim="fig0.values"), "value": [1.0, 2.0, 3.0]},
        {"claim": "fig0.radius", "place": "", "at_most": 3.3, "status": "reproduced"},
        {"claim": "fig0.radius", "place": "", "at_least": 3.4, "status": "reproduced"},
        {"claim": "fig0.safe", "place": "", "value": False, "status": "reproduced"},
    ],
)
def test_one_planted_wrong_number_fails_the_check(wrong: dict[str, Any]) -> None:
    rows = figures_check.check([entry(), wrong], CLAIMS, "quick")
    assert [row.passed for row in rows] == [True, False]
    assert figures_check.table(rows).endswith("1 passed, 1 failed")


def test_the_command_fails_on_a_planted_wrong_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    data = tmp_path / "data"
    (data / "quick").mkdir(parents=True)
    (data / "quick" / "fig0.json").write_text(json.dumps({"claims": CLAIMS["fig0"]}))
    monkeypatch.setattr(figures_check, "DATA", data)
    expected = tmp_path / "expected.json"
    for planted, code, count in ((3.32, 0, "1 passed, 0 failed"), (3.52, 1, "0 passed, 1 failed")):
        expected.write_text(json.dumps({"claims": [entry(value=planted)]}))
        assert figures_check.main(["quick", "--expected", str(expected)]) == code
        assert capsys.readouterr().out.strip().endswith(count)


def test_an_expectation_of_the_other_mode_is_left_out() -> None:
    assert figures_check.check([entry(mode="full")], CLAIMS, "quick") == []


def test_an_unknown_status_is_refused() -> None:
    with pytest.raises(ValueError, match="`status` must be one of"):
        figures_check.check([entry(status="fine")], CLAIMS, "quick")


@pytest.mark.parametrize("expectation", EXPECTED, ids=lambda value: value["claim"])
def test_every_expectation_names_a_place_a_status_and_a_figure_that_exists(
    expectation: dict[str, Any],
) -> None:
    assert expectation["place"]
    assert expectation["status"] in figures_check.STATUSES
    assert {"value", "at_least", "at_most"} & expectation.keys()
    stem = expectation["claim"].split(".")[0]
    assert (figures_check.HERE.parent / "experiments" / f"{stem}.py").exists()


def right(expectation: dict[str, Any]) -> Any:
    """A finding that meets an expectation."""
    return expectation.get("value", expectation.get("at_most", expectation.get("at_least")))


def wrong(expectation: dict[str, Any]) -> Any:
    """A finding that is off by ten tolerances, or beyond the limit."""
    value = right(expectation)
    if isinstance(value, bool):
        return not value
    if isinstance(value, str):
        return "UNKNOWN"
    if isinstance(value, list):
        return [*value[:-1], wrong({**expectation, "value": value[-1]})]
    step = 10 * expectation.get("tolerance", 0.1) or 0.1
    return value - step if "value" not in expectation and "at_most" not in expectation else value + step


def collected(findings: dict[str, Any]) -> dict[str, dict[str, Any]]:
    claims: dict[str, dict[str, Any]] = {}
    for name, found in findings.items():
        stem, _, short = name.partition(".")
        claims.setdefault(stem, {})[short] = found
    return claims


@pytest.mark.parametrize("planted", EXPECTED, ids=lambda value: value["claim"])
def test_every_expectation_of_the_paper_fails_on_a_number_planted_for_it(planted: dict[str, Any]) -> None:
    findings = {expectation["claim"]: right(expectation) for expectation in EXPECTED}
    assert all(row.passed for row in figures_check.check(EXPECTED, collected(findings), "quick"))
    findings[planted["claim"]] = wrong(planted)
    failed = [row.name for row in figures_check.check(EXPECTED, collected(findings), "quick") if not row.passed]
    assert failed == [planted["claim"]]


def test_no_claim_is_expected_twice() -> None:
    names = [expectation["claim"] for expectation in EXPECTED]
    assert len(names) == len(set(names))


@pytest.mark.parametrize(
    ("place", "number"),
    [
        ("Sec. V", "148.4"),
        ("Sec. V", "3.32"),
        ("Sec. IV-C", "3.71"),
        ("Fig. 6 left", "19"),
        ("Fig. 6 right", "1"),
        ("Sec. VIII-B, Markov", "infeasible below 0.04"),
        ("Sec. VIII-B, MPC at 0.002", "feasible"),
        ("Sec. VIII-A, 99.9 %, T = 2", "99.9 %"),
        ("Sec. VIII-A, 99.9 %, T = 5", "99.9 %"),
        ("Fig. 8 bottom left", "0 of 5000"),
        ("Fig. 8 bottom right", "0 of 5000"),
        ("Fig. 9", "0 of 3000"),
    ],
)
def test_every_number_that_the_paper_prints_is_expected(place: str, number: str) -> None:
    assert any(
        expectation["place"].startswith(place) and str(expectation.get("printed")) == number for expectation in EXPECTED
    )


def test_the_smallest_radii_of_fig_7_are_expected_at_every_decade() -> None:
    values = {expectation["claim"]: expectation.get("value") for expectation in EXPECTED}
    assert values["fig7.left_paper"] == [1.074, 1.2038, 1.3208, 1.4283, 1.5283]
    assert values["fig7.right_paper"] == [1.1366, 1.2618, 1.3757, 1.4808, 1.579]
