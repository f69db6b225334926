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


def test_without_any_tube_there_are_limits_and_sample_paths(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("certbound.cli.commands.verify.drawn_reach", lambda *_: None)
    file, picture, page = (tmp_path / name for name in ("pair.toml", "pair.png", "pair.html"))
    file.write_text(PAIR)
    assert run(["verify", str(file), "--method", "barrier", "--plot", str(picture), "--report", str(page)]) == 0
    assert "sample paths and limits are drawn alone" in capsys.readouterr().err
    assert picture.read_bytes().startswith(b"\x89PNG")
    words = page.read_text(encoding="utf-8")
    assert "no tube was proved" in words
    assert "Who proved what" in words
    assert "noise-free" not in words.partition("<main>")[2]


def test_for_ever_there_is_a_report_without_pictures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, picture, page = (tmp_path / name for name in ("pair.toml", "pair.png", "pair.html"))
    file.write_text(PAIR.replace("horizon = 1", "horizon = inf"))
    assert run(["verify", str(file), "--method", "barrier", "--plot", str(picture), "--report", str(page)]) == 1
    assert "nothing is drawn" in capsys.readouterr().err
    assert not picture.exists()
    assert "Who proved what" in page.read_text(encoding="utf-8")
