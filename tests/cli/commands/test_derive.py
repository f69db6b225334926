"""``certbound derive`` where no constants hold on all of R^n: along the tube, saying how far."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from certbound.cli.app import run

TEXT = """
name = "square"
time = "continuous"
horizon = {horizon}
delta = 1e-3
states = ["x"]
[dynamics]
x = "{law}"
[noise]
diffusion = [[{sigma}]]
[initial]
box = [[{low}, {high}]]
[[stay]]
box = {{ x = [-5, 5] }}
"""


def derived(tmp_path: Path, capsys: pytest.CaptureFixture[str], **values: object) -> dict[str, object]:
    path = tmp_path / "square.toml"
    path.write_text(TEXT.format(**values))
    assert run(["derive", str(path), "--json"]) == 0
    return dict(json.loads(capsys.readouterr().out))


def test_local_constants_name_the_tube_that_they_hold_on(tmp_path, capsys):
    found = derived(tmp_path, capsys, horizon=1, law="-x + x**2", sigma=0.01, low=-0.1, high=0.1)
    assert found["certified"]
    assert "reach set + tube, box by box in time, up to 1 s, left with probability" in found["domain"]
    assert len(found["times"]) == len(found["rate"]) + 1
    assert all(-1.5 < rate < -0.5 for rate in found["rate"])


def test_local_constants_say_where_the_tube_ends(tmp_path, capsys):
    found = derived(tmp_path, capsys, horizon=1.5, law="x**2", sigma=0.01, low=0.2, high=1.0)  # the last escapes at 1
    assert "before 1.5 s, where no guess of its size confirmed itself" in found["domain"]
    assert 0.1 < found["times"][-1] < 1


def answer(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, dict[str, Any]]:
    """Exit code and the JSON object."""
    code = run([*words, "--json"])
    return code, dict(json.loads(capsys.readouterr().out))


def test_only_the_constraint_that_is_asked_for_gets_a_metric(capsys: pytest.CaptureFixture[str]) -> None:
    code, found = answer(capsys, "derive", "chain_rest", "--constraint", "v3 <= 2")
    assert code == 0
    assert [one["constraint"] for one in found["metrics"]] == ["v3 <= 2"]
    assert found["metrics"][0]["certified"] is True
    assert answer(capsys, "derive", "chain_rest", "--constraint", "none")[1]["metrics"] == []


def test_each_metric_is_printed_as_it_is_found(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["derive", "chain_rest", "--constraint", "v3 <= 2", "--constraint", "p1 >= -1.2", "--jobs", "2"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert sorted(line.partition(": gain ")[0] for line in lines[:2]) == ["p1 >= -1.2", "v3 <= 2"]
    assert lines[2].startswith("gain 0.99005 per step, certified")


def test_what_was_found_when_the_time_is_over_is_kept(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from certbound.constants import metrics
    from certbound.watch import OutOfTime

    every = metrics.each_metric

    def cut(*arguments: Any, **options: Any) -> Any:
        yield next(every(*arguments, **options))
        raise OutOfTime

    monkeypatch.setattr(metrics, "each_metric", cut)
    code, found = answer(capsys, "derive", "chain_rest", "--time-limit", "300")
    assert code == 0
    assert len(found["metrics"]) == 1
    assert found["gain"] < 0.9906


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["--constraint", "v9 <= 2"], "no constraint is called `v9 <= 2`"),
        (["--jobs", "0"], "`--jobs` must be positive, got 0"),
    ],
)
def test_derive_refuses_what_it_cannot_do(words: list[str], why: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["derive", "chain_rest", *words]) == 2
    assert why in capsys.readouterr().err


PLANE = """
name = "plane"
time = "continuous"
horizon = 0.5
delta = 1e-3
states = ["x", "y"]
[dynamics]
x = "2*y + 0.1*x**2"
y = "-y"
[noise]
diffusion = [[0], [0.02]]
[initial]
point = [0.2, 0.1]
[[stay]]
box = { x = [-5, 5] }
"""


@pytest.mark.slow
def test_moving_coordinates_are_shown_and_drawn_where_constants_are_local(tmp_path, capsys):
    path, picture = tmp_path / "plane.toml", tmp_path / "rates.png"
    path.write_text(PLANE)
    assert run(["derive", str(path), "--json", "--plot", str(picture)]) == 0
    moving = json.loads(capsys.readouterr().out)["moving"]
    assert moving["states"] == ["x"]
    assert moving["log10_left"] == pytest.approx(-3, abs=0.1)  # paths may leave the boxes, too
    assert 0.0 < moving["radius"] < 0.7 * moving["standing_radius"]
    assert len(moving["rate"]) == len(moving["frames"]) - 1
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_no_radius_is_shown_where_the_boxes_have_no_room_for_the_noise(tmp_path, capsys):
    """Rates that hold on the noise-free reach set alone say nothing of noisy paths."""
    path = tmp_path / "plane.toml"
    path.write_text(PLANE.replace("0.02", "60").replace("0.1*x**2", "0.1*x**3"))
    assert run(["derive", str(path), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert "no room for the noise" in result["domain"]
    assert result["moving"] is None
