"""CONTRIBUTING.md names what there is, and its recipes touch no more files than they should."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from tests.docs.blocks import ROOT

TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
PACKAGE = ROOT / "certbound"
MOST_FILES = {"A noise law": 2, "A shape": 4, "An elementary function": 4, "An engine": 3}
RECIPES = dict(re.findall(r"^### (.+?)\n(.*?)(?=^##|\Z)", TEXT, flags=re.MULTILINE | re.DOTALL))


def folders(path: Path) -> set[str]:
    return {entry.parent.name for entry in path.glob("*/__init__.py")}


def test_every_path_that_it_names_exists() -> None:
    named = re.findall(r"`([\w.-]*/[\w./-]+|[\w.-]+\.(?:md|yaml))`|(?<![\w/])((?:tests|\.ci)/[\w./-]+\w)", TEXT)
    paths = {first or second for first, second in named}
    assert len(paths) > 20
    assert {path for path in paths if not (ROOT / path).exists()} == set()


@pytest.mark.parametrize("title", MOST_FILES)
def test_a_recipe_names_few_files_and_a_test(title: str) -> None:
    files = re.findall(r"^\| `([^`]+)` \|", RECIPES[title], flags=re.MULTILINE)
    assert 0 < len(files) <= MOST_FILES[title]
    assert all(file.startswith("certbound/") for file in files)
    assert re.search(r"`tests/\w+/test_new_\w+\.py` adds", RECIPES[title])
    assert set(RECIPES) == set(MOST_FILES)


def test_the_table_of_rooms_has_every_room_and_sub_room() -> None:
    table = re.findall(r"^\| (`[^|]+) \| ([^|]*)\| [^|]+\|$", TEXT.split("## Where")[0], flags=re.MULTILINE)
    rooms = {room: re.findall(r"`([\w.]+)`", subs) for names, subs in table for room in re.findall(r"`(\w+)`", names)}
    modules = {path.stem for path in PACKAGE.glob("*.py") if not path.stem.startswith("_")}
    assert set(rooms) == folders(PACKAGE) | modules
    for room in folders(PACKAGE) - {"plotting", "html_report", "cli"}:
        assert set(rooms[room]) == folders(PACKAGE / room), room
    assert folders(PACKAGE / "cli") == {"commands"}


def test_what_runs_before_a_commit_is_what_it_says() -> None:
    config = (ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8")
    assert re.findall(r"- id: (\w+)", config) == ["ruff", "mypy"]
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    assert any(entry.startswith("pre-commit") for entry in extras["dev"])
