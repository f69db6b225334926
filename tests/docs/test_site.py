"""The site builds without a warning, its links lead somewhere, and its pages say what the project contains."""

from __future__ import annotations

import json
import os
import re
import runpy
import subprocess
import sys
import tomllib
from importlib.util import find_spec
from pathlib import Path

import pytest

import certbound as cb
from tests.docs.blocks import DOCS, ROOT, pages

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.py"))


def anchors(page: Path) -> set[str]:
    """The anchors that the site gives to a page's headings."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    found = set()
    for heading in re.findall(r"^#+ +(.+)$", text, flags=re.MULTILINE):
        words = re.sub(r"[^\w\s-]", "", heading.replace("`", "")).strip().lower()
        found.add(re.sub(r"[-\s]+", "-", words))
    return found


@pytest.mark.parametrize(
    "page", [*pages(), ROOT / "CONTRIBUTING.md"], ids=lambda page: page.relative_to(ROOT).as_posix()
)
def test_every_internal_link_leads_to_a_page_and_a_heading(page: Path) -> None:
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", re.sub(r"`[^`]*`", "", text)):
        if target.startswith(("http://", "https://", "mailto:")):
            continue
        path, _, anchor = target.partition("#")
        file = page if not path else (page.parent / path).resolve()
        assert file.exists(), target
        if anchor:
            assert anchor in anchors(file), target


@pytest.mark.skipif(
    find_spec("mkdocs") is None or find_spec("latex2mathml") is None, reason="needs the extra `docs` (mkdocs)"
)
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    result = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment)
    assert result.returncode == 0, result.stderr
    assert "WARNING" not in result.stderr
    shown = (tmp_path / "site" / "reference" / "index.html").read_text(encoding="utf-8")
    for name in cb.__all__:
        if not name.startswith("_"):
            assert f">{name}<" in shown or f".{name}" in shown, name
    theory = (tmp_path / "site" / "theory" / "index.html").read_text(encoding="utf-8")
    assert theory.count("<math") > 100
    assert "arithmatex" not in theory
    assert "mathjax" not in theory.lower()  # formulas are read without a script and without the network
    assert (tmp_path / "site" / "pictures" / "warehouse_robot.png").exists()
    commands = (tmp_path / "site" / "commands" / "index.html").read_text(encoding="utf-8")
    assert "--certificate FILE" in commands
    assert "<!-- commands -->" not in commands


def test_the_page_of_commands_has_every_command_option_and_example() -> None:
    from certbound.cli.app import app

    sections = runpy.run_path(str(DOCS / "hooks" / "commands.py"))["on_page_markdown"]("<!-- commands -->")
    for command in app.registered_commands:
        assert f"## {command.name}\n" in sections
        assert f"certbound {command.name}" in sections
    assert sections.count("--json") >= len(app.registered_commands)
    assert "--time-limit SECONDS" in sections
    assert runpy.run_path(str(DOCS / "hooks" / "commands.py"))["on_page_markdown"]("text") == "text"


def test_the_table_of_engines_says_what_their_rows_say() -> None:
    from certbound.safety.portfolio import ENGINES

    text = (DOCS / "explanation.md").read_text(encoding="utf-8")
    filled = runpy.run_path(str(DOCS / "hooks" / "commands.py"))["on_page_markdown"](text)
    table = re.findall(r"^\| `(\w+)` \| ([^|]+) \| ([^|]+) \|$", filled, flags=re.MULTILINE)
    assert table == [(name, row.words, row.when) for name, row in ENGINES.items()]


def test_every_page_is_reached_from_the_navigation() -> None:
    config = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    for page in DOCS.rglob("*.md"):
        assert f": {page.relative_to(DOCS).as_posix()}" in config


def test_nothing_in_the_documentation_names_a_place_on_one_computer() -> None:
    for page in [*pages(), *NOTEBOOKS, ROOT / "mkdocs.yml", ROOT / "CITATION.cff", ROOT / "CHANGELOG.md"]:
        assert not re.search(r"/(home|root|work|opt|tmp)/", page.read_text(encoding="utf-8")), page.name


def test_the_citation_and_the_changelog_speak_of_this_version() -> None:
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"version: {cb.__version__}\n" in citation
    assert "cff-version: 1.2.0" in citation
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.search(r"^## ", changes, flags=re.MULTILINE)
    assert f"## {cb.__version__}" in changes


@pytest.mark.slow
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_from_top_to_bottom(notebook: Path, tmp_path: Path) -> None:
    environment = os.environ | {"MPLBACKEND": "agg"}
    command = [sys.executable, "-W", "error", str(notebook)]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert result.returncode == 0, result.stderr
    assert "SAFE" in result.stdout


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_in_percent_format(notebook: Path) -> None:
    text = notebook.read_text(encoding="utf-8")
    assert "format_name: percent" in text
    assert text.count("# %%") >= 8
    if find_spec("jupytext") is not None:
        import jupytext

        cells = jupytext.reads(text, fmt="py:percent").cells
        assert {"markdown", "code"} == {cell.cell_type for cell in cells}
        json.dumps(cells)
