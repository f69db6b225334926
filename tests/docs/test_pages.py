"""Every code block of the documentation does what the page says.

The blocks of a page run one after the other, as a reader would paste them: Python in one namespace, commands in one
folder, files under the title of their block.
"""

from __future__ import annotations

import contextlib
import io
import linecache
import re
import sys
from pathlib import Path
from typing import Any

import pytest

import certbound as cb
from tests.docs.blocks import DOCS, ROOT, Block, blocks, commands, matches, pages

LANGUAGES = {"python", "console", "bash", "toml", "yaml", "text", "json", "bibtex", ""}
ELSEWHERE = {"pip", "python3.11", ".", "git", "make", "dask", "jupytext", "mkdocs", "pytest"}
"""Programs that the test of a fresh environment runs, or that need a second computer."""
SLOW = {
    "README.md", "certificate.md", "how-to/certificates.md", "how-to/cluster.md", "how-to/expressions.md",
    "how-to/moving-limits.md",
    "how-to/mpc.md", "how-to/networks.md", "how-to/observers.md", "how-to/obstacles.md", "how-to/plug-ins.md",
    "how-to/python-control.md", "how-to/sampled.md", "how-to/speed.md", "how-to/sweeps.md",
    "how-to/toml.md", "tutorial.md",
}  # fmt: skip
"""Pages that take more than some seconds; the tutorial's and the README's first steps are in other tests as well."""


def _cases() -> list[Any]:
    cases = []
    for page in pages():
        name = page.relative_to(DOCS if DOCS in page.parents else ROOT).as_posix()
        if any(block.language in ("python", "console", "toml") for block in blocks(page)):
            cases.append(pytest.param(page, id=name, marks=[pytest.mark.slow] if name in SLOW else []))
    return cases


@pytest.mark.parametrize("page", _cases())
def test_a_page_does_what_it_says(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    (tmp_path / "docs").symlink_to(DOCS)  # the README's commands are typed in the project's folder
    for extra in ("sympy", "distributed"):
        if any(f"{extra} import" in block.text or f"import {extra}" in block.text for block in blocks(page)):
            pytest.importorskip(extra, reason="needs an extra")
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    names: dict[str, Any] = {"__name__": "page"}
    for block in blocks(page):
        where = f"{page.relative_to(ROOT)}:{block.line}"
        if block.title:
            Path(block.title).write_text(block.text, encoding="utf-8")
        if block.language == "python":
            _run_python(block, where, names)
        elif block.language == "console":
            _run_commands(block, where)
        elif block.language == "toml" and "[dynamics]" in block.text:
            assert cb.load(_saved(block)).name


def _saved(block: Block) -> Path:
    path = Path(block.title or "unnamed.toml")
    path.write_text(block.text, encoding="utf-8")
    return path


PROGRESS = re.compile(r"(?m)^[a-z].*, \d+ s\n")
"""How far a command is, said every ten seconds on a busy machine."""


def _run_python(block: Block, where: str, names: dict[str, Any]) -> None:
    """Run a block; the lines of a ``text`` comment ``# -> ...`` are compared with what it prints."""
    linecache.cache[where] = (len(block.text), None, block.text.splitlines(keepends=True), where)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(block.text, where, "exec", dont_inherit=True), names)  # noqa: S102  (our own pages)
    expected = [line.split("# -> ", 1)[1] for line in block.text.splitlines() if "# -> " in line]
    assert matches("\n".join(expected), printed.getvalue()), f"{where} printed:\n{printed.getvalue()}"


def _run_commands(block: Block, where: str) -> None:
    from certbound.cli.app import run

    for command in commands(block):
        if not command.words or command.words[0] in ELSEWHERE:
            continue
        if command.words[0] == "cat":
            printed = "".join(Path(name).read_text(encoding="utf-8") for name in command.words[1:])
            assert matches(command.shown, printed), f"{where}: {command.words}"
            continue
        assert command.words[0] == "certbound", f"{where}: {command.words}"
        words, out = command.words[1:], io.StringIO()
        target = words[words.index(">") + 1] if ">" in words else None
        words = words[: words.index(">")] if target else words
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
            code = run(words)
        refused = command.shown.startswith("certbound: ")
        printed = PROGRESS.sub("", out.getvalue())
        assert code == 2 if refused else code in (0, 1), f"{where}: {command.words} ended with {code}:\n{printed}"
        assert matches(command.shown, printed), f"{where}: {command.words} printed\n{printed}"
        if target:
            Path(target).write_text(out.getvalue(), encoding="utf-8")


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.stem)
def test_every_block_says_what_it_is(page: Path) -> None:
    for block in blocks(page):
        assert block.language in LANGUAGES, f"{page.name}:{block.line}"
        if block.language in ("", "text", "bash"):
            continue
        if block.language == "console":
            assert commands(block), f"{page.name}:{block.line} has no line that begins with `$ `"
