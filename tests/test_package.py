"""The package as a whole: its names, its version, what it costs to import, what it ships."""

from __future__ import annotations

import ast
import importlib.metadata
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest

import certbound as cb

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_the_version_is_stated_once() -> None:
    assert cb.__version__ == importlib.metadata.version("certbound")


@pytest.mark.parametrize("name", cb.__all__)
def test_every_public_name_can_be_loaded(name: str) -> None:
    assert getattr(cb, name) is not None


def test_editors_and_mypy_read_the_names_that_are_loaded() -> None:
    tree = ast.parse((ROOT / "certbound" / "__init__.py").read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    read = {
        alias.asname: f"{node.module}.{alias.name}"
        for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names
    }  # fmt: skip
    table = next(
        ast.literal_eval(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and node.targets[0].id == "_HOME"
    )
    assert read == {name: f"certbound.{home}.{name}" for home, names in table.items() for name in names.split()}


@pytest.mark.slow
def test_mypy_sees_real_types(tmp_path: Path) -> None:
    file = tmp_path / "user.py"
    file.write_text(
        "import certbound as cb\ncb.Problem(1, 2, nonsense=3)\nreveal_type(cb.verify_safety(cb.load('ou')))\n"
    )
    words = [sys.executable, "-m", "mypy", "--strict", "--config-file", str(ROOT / "pyproject.toml"), str(file)]
    said = subprocess.run(words, capture_output=True, text=True, cwd=ROOT).stdout
    assert "Unexpected keyword argument" in said or "No overload" in said or "Too many positional arguments" in said
    assert 'Revealed type is "certbound.safety.verdict.Verdict"' in said


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'verify_everything'"):
        cb.verify_everything  # noqa: B018  (reading the attribute is what is tested)


def test_importing_takes_less_than_a_second() -> None:
    started = time.perf_counter()
    subprocess.run([sys.executable, "-c", "import certbound"], check=True)
    assert time.perf_counter() - started < 1.0


def test_the_library_prints_nothing_when_it_is_imported() -> None:
    code = "import certbound as cb; [getattr(cb, name) for name in cb.__all__]"
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout == ""
    assert result.stderr == ""


def test_the_type_marker_is_shipped() -> None:
    assert (ROOT / "certbound" / "py.typed").exists()
    assert "Typing :: Typed" in PROJECT["project"]["classifiers"]


def test_every_dependency_has_a_lower_bound_and_no_upper_one() -> None:
    for requirement in PROJECT["project"]["dependencies"]:
        assert ">=" in requirement
        assert "<" not in requirement
