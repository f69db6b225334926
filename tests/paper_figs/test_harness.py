"""What an experiment writes depends on its input alone, and a figure has everything it needs."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

from experiments import harness

ROOT = Path(__file__).resolve().parents[2]
FIGURES = sorted(path.stem for path in (ROOT / "paper_figs").glob("fig*.py"))
TABLES = sorted(path.stem for path in (ROOT / "paper_figs").glob("table*.py"))


def test_the_same_input_gives_the_same_bytes(tmp_path: Path) -> None:
    arrays = {"b": np.linspace(0, 1, 7), "a": np.arange(6).reshape(2, 3)}
    for name in ("one", "two"):
        harness.save(tmp_path / name, "fig0", arrays, {"x": np.float64(0.1), "y": [np.int64(2)]}, full=False)
    for suffix in ("npz", "json"):
        assert (tmp_path / "one" / f"fig0.{suffix}").read_bytes() == (tmp_path / "two" / f"fig0.{suffix}").read_bytes()
    with np.load(tmp_path / "one" / "fig0.npz") as bundle:
        assert sorted(bundle.files) == ["a", "b"]
        assert np.array_equal(bundle["b"], arrays["b"])
    record = json.loads((tmp_path / "one" / "fig0.json").read_text())
    assert record["claims"] == {"x": 0.1, "y": [2]}
    assert "numpy" in record["versions"]


def test_a_claim_that_is_not_a_number_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        harness.save(tmp_path, "fig0", {}, {"x": float("nan")}, full=False)
    assert not (tmp_path / "fig0.npz").exists()


def test_a_rebuild_depends_on_the_modules_that_computed(tmp_path: Path) -> None:
    harness.save(tmp_path, "fig0", {}, {}, full=False)
    rule = (tmp_path / "fig0.d").read_text().splitlines()[0]
    assert "../experiments/harness.py" in rule
    assert "../certbound/__init__.py" in rule


@pytest.mark.parametrize("stem", FIGURES + TABLES)
def test_every_figure_has_an_experiment_and_a_caption(stem: str) -> None:
    assert (ROOT / "experiments" / f"{stem}.py").exists()
    assert (ROOT / "paper_figs" / "captions" / f"{stem}.md").read_text(encoding="utf-8").strip()


def test_make_lists_every_figure() -> None:
    result = subprocess.run(["make", "-s", "list"], cwd=ROOT / "paper_figs", capture_output=True, text=True, check=True)
    assert sorted(result.stdout.split()) == FIGURES + TABLES


def test_a_figure_is_drawn_from_data_alone() -> None:
    for stem in FIGURES + TABLES:
        source = (ROOT / "paper_figs" / f"{stem}.py").read_text(encoding="utf-8")
        assert "import certbound" not in source
        assert "experiments" not in source.replace("python -m experiments", "")
    for path in (ROOT / "experiments").rglob("*.py"):
        assert "matplotlib" not in path.read_text(encoding="utf-8"), path
