"""An answer of an engine that has no tube has a picture and a report all the same."""

from __future__ import annotations

from pathlib import Path

import pytest

from certbound.cli.app import run

PAIR = """
name = "pair"
time = "continuous"
horizon = 1
delta = 0.5
states = ["a", "b"]
[dynamics]
a = "-a - a**3"
b = "-b"
[noise]
diffusion = [[0.2, 0], [0, 0.2]]
[initial]
point = [0, 0]
[[stay]]
box = { a = [-1.5, 1.5], b = [-1.5, 1.5] }
"""


def test_a_barrier_is_drawn_with_the_noise_free_tube(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, picture, page = (tmp_path / name for name in ("pair.toml", "pair.png", "pair.html"))
    file.write_text(PAIR)
    assert run(["verify", str(file), "--method", "barrier", "--plot", str(picture), "--report", str(page)]) == 0
    assert "nothing was drawn" not in capsys.readouterr().err
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "Seen from above: a, b" in page.read_text(encoding="utf-8")
