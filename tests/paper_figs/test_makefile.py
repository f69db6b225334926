"""What make runs and what it leaves alone, with an interpreter that only writes down what it was asked for."""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
STEMS = ("fig1", "fig2", "table1")
INTERPRETER = """#!/bin/sh
# stands for python: notes its arguments and writes the files that the real one would
module=$2
stem=${module#*.}
mode=quick
case "$*" in *full) mode=full ;; esac
case "$BREAK" in "$module") exit 3 ;; esac
echo "$module $mode" >> asked.txt
case "$module" in
    experiments.*)
        mkdir -p experiments/out/$mode
        for end in json npz; do echo x > experiments/out/$mode/$stem.$end; done
        echo "../experiments/out/$mode/$stem.npz: ../shared_by_$stem.py" > experiments/out/$mode/$stem.d
        ;;
    paper_figs.check) echo "1 passed, 0 failed" ;;
    *)
        mkdir -p paper_figs/out/$mode
        for end in md png pdf html; do echo x > paper_figs/out/$mode/$stem.$end; done
        ;;
esac
"""


class Tree:
    """A copy of the Makefile among empty scripts."""

    def __init__(self, root: Path) -> None:
        self.root = root
        for folder in ("experiments", "paper_figs/captions"):
            (root / folder).mkdir(parents=True)
        shutil.copy(ROOT / "paper_figs" / "Makefile", root / "paper_figs")
        scripts = [f"{folder}/{stem}.py" for stem in STEMS for folder in ("experiments", "paper_figs")]
        scripts += [f"paper_figs/captions/{stem}.md" for stem in STEMS]
        scripts += [f"shared_by_{stem}.py" for stem in (*STEMS, "errata")]
        for name in ("report.py", "binding.py", "check.py", "style.py", "expected.json"):
            scripts.append(f"paper_figs/{name}")
        for script in (*scripts, "experiments/harness.py", "experiments/errata.py"):
            (root / script).touch()
            os.utime(root / script, (1e9, 1e9))
        self.python = root / "interpreter"
        self.python.write_text(INTERPRETER)
        self.python.chmod(0o755)

    def make(self, *arguments: str, fails: bool = False, **environment: str) -> list[str]:
        """What the interpreter was asked for, sorted."""
        (self.root / "asked.txt").unlink(missing_ok=True)
        result = subprocess.run(
            ["make", "-s", "-C", "paper_figs", f"PYTHON={self.python}", *arguments],
            cwd=self.root,
            capture_output=True,
            text=True,
            env={"PATH": os.environ["PATH"], **environment},
        )
        assert (result.returncode != 0) == fails, result.stderr
        asked = self.root / "asked.txt"
        return sorted(asked.read_text().splitlines()) if asked.exists() else []

    def change(self, name: str) -> None:
        """Make a file newer than all that was built."""
        later = time.time() + 2
        os.utime(self.root / name, (later, later))


@pytest.fixture
def tree(tmp_path: Path) -> Tree:
    return Tree(tmp_path)


def everything(mode: str = "quick") -> list[str]:
    numbers = [f"experiments.{stem} {mode}" for stem in (*STEMS, "errata")]
    return sorted([*numbers, *(f"paper_figs.{stem} {mode}" for stem in STEMS), f"paper_figs.check {mode}"])


@pytest.mark.parametrize("parallel", ["-j1", "-j2"])
def test_everything_is_built_once_and_then_checked(tree: Tree, parallel: str) -> None:
    assert tree.make(parallel) == everything()
    assert tree.make(parallel) == ["paper_figs.check quick"]


def test_the_full_build_has_folders_of_its_own(tree: Tree) -> None:
    tree.make()
    assert tree.make("FULL=1") == everything("full")
    assert tree.make() == ["paper_figs.check quick"]


def test_a_single_target_builds_that_figure_alone(tree: Tree) -> None:
    assert tree.make("fig2") == ["experiments.fig2 quick", "paper_figs.fig2 quick"]
    assert tree.make("fig2") == []


@pytest.mark.parametrize(
    ("changed", "again"),
    [
        ("experiments/fig1.py", ["experiments.fig1", "paper_figs.fig1"]),
        ("shared_by_fig1.py", ["experiments.fig1", "paper_figs.fig1"]),
        ("paper_figs/fig2.py", ["paper_figs.fig2"]),
        ("paper_figs/captions/table1.md", ["paper_figs.table1"]),
        ("paper_figs/style.py", ["paper_figs.fig1", "paper_figs.fig2", "paper_figs.table1"]),
        ("paper_figs/expected.json", []),
    ],
)
def test_a_change_builds_again_what_depends_on_it(tree: Tree, changed: str, again: list[str]) -> None:
    tree.make()
    tree.change(changed)
    assert tree.make() == sorted(f"{module} quick" for module in [*again, "paper_figs.check"])


@pytest.mark.parametrize(
    ("lost", "again"),
    [
        ("paper_figs/out/quick/fig1.png", "paper_figs.fig1"),
        ("paper_figs/out/quick/fig1.md", "paper_figs.fig1"),
        ("paper_figs/out/quick/fig1.pdf", "paper_figs.fig1"),
        ("experiments/out/quick/errata.json", "experiments.errata"),
    ],
)
def test_a_file_that_was_lost_is_made_again(tree: Tree, lost: str, again: str) -> None:
    tree.make()
    (tree.root / lost).unlink()
    assert tree.make() == sorted([f"{again} quick", "paper_figs.check quick"])


def test_an_interrupted_build_goes_on_where_it_stopped(tree: Tree) -> None:
    done = tree.make("-k", fails=True, BREAK="experiments.fig2")
    rest = tree.make()
    assert "experiments.fig2 quick" not in done
    assert sorted([*done, *rest]) == everything()


def test_the_report_follows_the_figures_and_the_expectations(tree: Tree) -> None:
    without_check = [line for line in everything() if "check" not in line]
    assert tree.make("report") == sorted([*without_check, "paper_figs.report quick"])
    assert tree.make("report") == []
    tree.change("paper_figs/expected.json")
    assert tree.make("report") == ["paper_figs.report quick"]
    for end in ("html", "pdf"):
        (tree.root / "paper_figs" / "out" / "quick" / f"report.{end}").unlink()
        assert tree.make("report") == ["paper_figs.report quick"]


def test_a_failed_check_fails_the_build(tree: Tree) -> None:
    tree.make(fails=True, BREAK="paper_figs.check")
    tree.make("check", fails=True, BREAK="paper_figs.check")


def test_clean_leaves_nothing_that_was_built(tree: Tree) -> None:
    tree.make("report")
    assert tree.make("clean") == []
    assert not list(tree.root.rglob("out"))
    assert (tree.root / "paper_figs" / "fig1.py").exists()
