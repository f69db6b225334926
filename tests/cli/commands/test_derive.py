"""``certbound derive`` where no constants hold on all of R^n: along the tube, saying how far."""

from __future__ import annotations

import json
from pathlib import Path

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
