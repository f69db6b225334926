"""Units of time and signals are named wherever these are, and change nothing else."""

from __future__ import annotations

import json

import matplotlib as mpl
import numpy as np
import pytest

import certbound as cb
from certbound.checker import check_data, parse
from certbound.html_report import report_page
from certbound.plotting.scene import Scene
from certbound.problem.files.loading import load, loads, save
from certbound.safety.certificate import certificate_text, problem_data
from certbound.safety.first_exits import ExitTimes

TEXT = """
name = "room"
time = "continuous"
horizon = 2
delta = 1e-2
states = ["room"]
units = { time = "days", room = "K" }
[dynamics]
room = "-room"
[noise]
diffusion = [[0.2]]
[initial]
point = [0]
[[stay]]
box = { room = [-1, 1] }
"""


@pytest.fixture(scope="module")
def problem() -> cb.Problem:
    return loads(TEXT)


@pytest.fixture(scope="module")
def verdict(problem: cb.Problem) -> cb.Verdict:
    return cb.verify_safety(problem, method="linear")


def test_texts_name_them(problem):
    assert problem.span == "within 2 days"
    assert problem.time_unit == "days"
    assert "2 days" in problem.summary()
    assert ("states", "room (K)") in problem.rows()
    ends = np.array([0.0, 2.0])
    times = ExitTimes(problem=problem, times=ends, lower=ends / 4, upper=ends / 2, mean_lower=1.0, mean_upper=None)
    assert "within 2 days" in times.summary()
    assert times.summary().endswith("at least 1 days")
    plain = problem.replace(units=None)
    assert (plain.span, plain.axis("room"), plain.time_axis) == ("within 2 s", "room", "time (s)")


def test_axes_and_reports_name_them(problem, verdict):
    with mpl.rc_context({"backend": "agg"}):
        axes = verdict.plot(states="room")
    assert axes.get_xlabel() == "time (days)"
    assert axes.get_ylabel() == "room (K)"
    page = report_page(Scene(problem=problem, reach=verdict.reach), verdict)
    assert "2 days" in page
    assert "time (days)" in page


def test_files_and_certificates_keep_them(problem, verdict, tmp_path):
    for one in (problem, problem.replace(name="traced")):
        save(one, tmp_path / "room.toml")
        assert load(tmp_path / "room.toml").units == {"time": "days", "room": "K"}
    text = certificate_text(problem, verdict)
    given = [json.loads(json.dumps(problem_data(problem.replace(units=units)))) for units in ({"time": "days"}, None)]
    report = check_data(parse(text), given[0])
    assert report.valid, report.reason
    assert "units.time differs" in check_data(parse(text), given[1]).reason  # the claim names it
    assert 'within 2 "days"' in report.claim


@pytest.mark.parametrize(
    ("units", "message"),
    [
        ({"tme": "s"}, "units.*'tme'"), ({"room": ""}, "1 to 20"), ({"time": "s" * 30}, "1 to 20"),
        ({"time": 3}, "1 to 20"),
    ],
)
def test_what_is_no_unit_is_refused(problem, units, message):
    with pytest.raises(ValueError, match=message):
        problem.replace(units=units)


@pytest.mark.parametrize("name", ["units", "random"])
def test_a_table_by_names_is_asked_for(problem, name):
    with pytest.raises(TypeError, match=f"`{name}` must be a dict by names, got 3"):
        problem.replace(**{name: 3})
