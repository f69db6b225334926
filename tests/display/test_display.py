"""Results show themselves: one line, HTML, plain data, a picture; and are saved and read back."""

from __future__ import annotations

import json
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import certbound as cb
from certbound.display import Record, Shown, log10_text, name_text, plain, power_above


@pytest.fixture(scope="module")
def results() -> dict[str, Any]:
    system = cb.ContinuousSystem(lambda x: -x, states=["px", "py"], diffusion=0.05 * np.eye(2))
    safe = [cb.Outside(cb.Ball([1.0, 1.0], 0.3)), cb.Inside(cb.Box([-2.0, -2.0], [2.0, 2.0]))]
    problem = cb.Problem(system, initial=[0.5, 0.0], safe=safe, horizon=2.0, name="a <b> & c")
    verdict = cb.verify_safety(problem, method="constants")
    constants = cb.bound_constants(problem)
    tube = cb.tune_tube(constants, horizon=2.0, delta=1e-3)
    pieces = cb.Constants(gain=[0.5, 0.9], sigma=0.1, dimension=2, times=[0, 2, 4])
    return {
        "problem": problem, "verdict": verdict, "constants": constants, "tube": tube, "pieces": pieces,
        "reach": verdict.reach, "deviation": verdict.deviation,
    }  # fmt: skip


KINDS = ["problem", "verdict", "constants", "tube", "pieces", "reach", "deviation"]


@pytest.mark.parametrize("kind", KINDS)
def test_a_result_is_short_and_its_html_is_escaped(results: dict[str, Any], kind: str) -> None:
    result = results[kind]
    assert isinstance(result, Shown)
    assert repr(result) == f"<{type(result).__name__}: {result.summary()}>"
    assert len(repr(result)) < 160
    assert "\n" not in repr(result)
    assert str(result).splitlines()[0] == result.summary()
    page = result._repr_html_()
    assert page.startswith("<div><b>")
    assert page.count("<tr>") == page.count("</tr>") == len(result.rows())
    assert "<b> &" not in page


@pytest.mark.parametrize("kind", KINDS)
def test_a_result_is_plain_data(results: dict[str, Any], kind: str) -> None:
    data = results[kind].to_dict()
    assert json.loads(results[kind].to_json()) == plain(data)
    json.dumps(data)


@pytest.mark.parametrize("kind", KINDS)
def test_a_result_draws_itself_into_given_axes(results: dict[str, Any], kind: str) -> None:
    from matplotlib.figure import Figure

    figure = Figure()
    axes = figure.subplots()
    assert results[kind].plot(axes) is axes
    assert axes.has_data()
    figure.canvas.draw()


def test_axes_are_the_current_ones_when_none_are_given(results: dict[str, Any]) -> None:
    import matplotlib.pyplot as plt

    with plt.rc_context({"backend": "agg"}):
        assert results["tube"].plot() is plt.gca()
        plt.close("all")


def test_a_problem_without_a_plane_and_its_verdict_are_drawn_over_time() -> None:
    from matplotlib.figure import Figure

    problem = cb.load("ou")
    for result in (problem, cb.verify_safety(problem, method="kummer")):
        axes = result.plot(Figure().subplots())
        assert axes.get_xlabel() == "time (s)"


def test_the_lines_say_what_matters(results: dict[str, Any]) -> None:
    assert repr(results["constants"]) == "<Constants: rate -1 1/s, sigma 0.05, 2 states, certified>"
    assert repr(results["pieces"]) == "<Constants: gain 0.5 ... 0.9 per step, sigma 0.1, 2 states, stated>"
    assert repr(results["problem"]) == "<Problem: a <b> & c, 2 states, 2 constraints, 2 s, delta 0.001>"
    assert cb.load("ou").summary() == "ou, 1 state, 1 constraint, 5 s, delta 0.001"
    assert results["verdict"].summary().startswith("SAFE  a <b> & c: P(leaving) <= ")
    assert results["tube"].summary().endswith("within 2 s, delta 1e-3, trajectory level")
    assert ("constraint", "-2 <= px <= 2, -2 <= py <= 2") in results["problem"].rows()


def test_a_printed_probability_is_never_below_the_one_it_stands_for() -> None:
    near = (-2.9999997, -2.99999999, np.nextafter(-3.0, 0.0), -0.30102999, -1.99999999999)
    for log10 in (*near, -1.2175, -1.0, -49718.999999999):
        shown = Decimal(log10_text(float(log10)))
        assert shown.log10() >= Decimal(float(log10))
        assert shown <= Decimal("1.1") * Decimal(10) ** Decimal(float(log10))
    assert log10_text(float(np.nextafter(-3.0, 0.0)), ulps=2) == "1e-3"
    for log10 in (-300.25, -3.0, -0.3010299956639812, -1e-17, -1e12):
        assert power_above(log10) > 0
        assert Decimal(power_above(log10)).log10() >= Decimal(log10)


def test_a_name_cannot_imitate_a_verdict() -> None:
    verdict = cb.verify_safety(cb.load("ou").replace(name="x\nSAFE  ou: P(leaving) <= 1e-9"), method="kummer")
    assert verdict.summary().startswith('SAFE  "x SAFE ou: P(leaving) <= 1e-9": P(leaving) <= ')
    assert len(name_text("y" * 1000)) == 60
    assert [name_text(name) for name in ("chain_rest", "obstacle course", "SAFE", "\x1b[1m", "")] == [
        "chain_rest", "obstacle course", '"SAFE"', '"[1m"', '""',
    ]  # fmt: skip


def test_tubes_come_as_columns(results: dict[str, Any]) -> None:
    tube = results["tube"].to_columns([0.5, 1.0])
    assert tube["radius"].tolist() == results["tube"].radius([0.5, 1.0]).tolist()
    assert len(results["tube"].to_columns()["time"]) == 201
    discrete = cb.tune_tube(cb.Constants(gain=0.5, sigma=0.1, dimension=1), horizon=4, delta=0.1)
    assert discrete.to_columns()["time"].tolist() == [0, 1, 2, 3, 4]
    verdict = results["verdict"].to_columns()
    assert list(verdict) == ["start", "end", "radius", "extent_px", "extent_py"]
    assert len({len(column) for column in verdict.values()}) == 1
    reach = results["reach"].to_columns(["px", "py"])
    assert np.all(reach["px_low"] <= reach["px_high"])
    pandas = pytest.importorskip("pandas")
    assert pandas.DataFrame(verdict).shape == (len(verdict["start"]), 5)


def test_a_verdict_without_a_tube_has_no_columns() -> None:
    system = cb.ContinuousSystem(lambda x: x + 1, states=1, diffusion=0.1)
    problem = cb.Problem(system, initial=[0], safe=[cb.Inside(cb.Box([-1], [1]))], horizon=2)
    with pytest.raises(ValueError, match="has no tube to tabulate"):
        cb.verify_safety(problem).to_columns()


def test_constants_come_back_as_stated_ones(results: dict[str, Any], tmp_path: Path) -> None:
    metric = cb.Constants(rate=-1, sigma=0.1, dimension=2, metric=[[2.0, 0.1], [0.1, 1.0]], effective_dimension=1.5)
    for constants in (results["constants"], results["pieces"], metric):
        constants.save(tmp_path / "k.json")
        again = cb.load_result(tmp_path / "k.json")
        assert again.fingerprint == constants.fingerprint
        assert not again.certified
    assert results["constants"].certified


def test_other_results_come_back_as_records(results: dict[str, Any], tmp_path: Path) -> None:
    results["verdict"].save(tmp_path / "v.json")
    record = cb.load_result(tmp_path / "v.json")
    assert isinstance(record, Record)
    assert record.status == "SAFE" == record["status"]
    assert record.log10_delta == results["verdict"].log10_delta
    assert len(record) == len(list(record)) == len(record.rows())
    assert repr(record) == "<Record: Verdict, as saved>"
    assert record.to_dict()["delta"] == 1e-3
    with pytest.raises(AttributeError, match="the record of a Verdict has no `colour`; it has status"):
        record.colour  # noqa: B018  (reading it is what is tested)
    with pytest.raises(TypeError, match="cannot be drawn"):
        record.plot()


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"type": "Constants"}', '{"type": "Tube", "data": 3}', "[" * 100_000]
)
def test_a_file_that_is_no_result_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "r.json").write_text(text)
    with pytest.raises(ValueError, match="`path` must be a saved result"):
        cb.load_result(tmp_path / "r.json")


def test_constants_without_their_numbers_are_refused() -> None:
    with pytest.raises(ValueError, match="`data` must have sigma, got rate"):
        cb.Constants.from_dict({"rate": 1.0})


def test_a_problem_is_the_content_of_its_file(results: dict[str, Any]) -> None:
    data = results["problem"].to_dict()
    assert data["states"] == ["px", "py"]
    assert data["dynamics"] == {"px": "-px", "py": "-py"}
    assert cb.load("unicycle").to_dict()["name"] == "unicycle"


def test_what_has_no_picture_says_so() -> None:
    class Bare(Shown):
        pass

    with pytest.raises(TypeError, match="a Bare cannot be drawn"):
        Bare().plot(object())  # type: ignore[arg-type]
    for method in ("summary", "to_dict"):
        with pytest.raises(NotImplementedError):
            getattr(Bare(), method)()


def test_probabilities_are_rounded_up_and_never_lost() -> None:
    assert log10_text(-49718.25) == "5.7e-49719"
    assert log10_text(-float("inf")) == "0"
    with pytest.raises(TypeError, match="must be made of JSON types"):
        plain(object())
