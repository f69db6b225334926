"""The table of the yardstick is well formed, its stored run speaks of it, and losses are seen."""

from __future__ import annotations

import dataclasses
import json

import pytest

import certbound as cb
from tests.yardstick.comparison import differences, worse
from tests.yardstick.measure import Run, measure
from tests.yardstick.problems import HERE, entries

RUN = Run(status="SAFE", upper=-2.0, lower=-2.1, seconds=4.0, engine="values", certificate=1000, limit=20.0)


@pytest.mark.parametrize("name", entries())
def test_every_problem_loads_and_asks_for_a_probability(name: str) -> None:
    entry = entries()[name]
    problem = entry.problem()
    assert isinstance(problem, cb.Problem)
    assert problem.delta == pytest.approx(entry.ask * entry.truth)
    assert 0 < entry.truth < 1
    assert 0 < entry.limit <= 20
    assert entry.kind


def test_the_stored_run_is_of_these_problems() -> None:
    stored = json.loads((HERE / "stored.json").read_text(encoding="utf-8"))
    assert list(stored) == [name for name in entries() if name in stored]
    assert len(stored) > len(entries()) / 2
    for name, data in stored.items():
        run = Run(**data)
        above, below = 0.0 if run.upper is None else run.upper, -999.0 if run.lower is None else run.lower
        assert below <= above <= 0, name
        assert run.limit == entries()[name].limit
        assert not run.status.startswith(("FAILS", "HANGS")), name


def test_engines_that_are_stored_are_several() -> None:
    stored = json.loads((HERE / "stored.json").read_text(encoding="utf-8"))
    engines = {data["engine"].split(":")[0] for data in stored.values()}
    assert {"linear", "values", "quadratic"} <= engines


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"upper": -1.9}, "weaker above"),
        ({"upper": None}, "weaker above"),
        ({"lower": -2.2}, "weaker below"),
        ({"lower": None}, "weaker below"),
        ({"status": "UNKNOWN"}, "lost status"),
        ({"certificate": 0}, "lost certificate"),
    ],
)
def test_losses_are_seen(change, word: str) -> None:
    found = differences(dataclasses.replace(RUN, **change), RUN)
    assert found[0].startswith(word)
    assert worse(found)


@pytest.mark.parametrize(
    ("change", "word"),
    [({"upper": -2.09}, "tighter above"), ({"lower": -2.05}, "tighter below"), ({"seconds": 7.0}, "slower"),
     ({"seconds": 1.0}, "faster")],
)  # fmt: skip
def test_gains_and_speed_are_told_and_are_no_losses(change, word: str) -> None:
    found = differences(dataclasses.replace(RUN, **change), RUN)
    assert [one.startswith(word) for one in found] == [True]
    assert not worse(found)


def test_what_hardly_differs_is_not_told() -> None:
    near = dataclasses.replace(RUN, upper=-1.98, lower=-2.12, seconds=4.9, certificate=900)
    assert differences(near, RUN) == []
    shorter = dataclasses.replace(near, limit=5.0)
    assert differences(shorter, RUN) == ["asked for 5 s, not 20"]


def test_one_problem_is_measured() -> None:
    run = measure("ewma_alarm", 20.0, "auto")
    assert run.status == "SAFE"
    assert run.certificate > 1000
    assert run.lower is not None
    assert run.upper is not None
    assert run.lower < run.upper < -1.5
