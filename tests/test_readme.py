"""The README is run: its code, and the shape of its two commands."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w*)\n(.*?)^```$", README, flags=re.MULTILINE | re.DOTALL)
SHELL = [text for language, text in BLOCKS if language == "bash"]
PYTHON = [text for language, text in BLOCKS if language == "python"]


def steps(block: str) -> list[list[str]]:
    """The commands of a one-line chain ``a && b && c``, as words."""
    (line,) = block.strip().splitlines()
    return [shlex.split(part) for part in line.split("&&")]


def test_the_first_command_installs_and_verifies() -> None:
    environment, activate, install, verify = steps(SHELL[0])
    assert environment == ["python3.11", "-m", "venv", ".venv"]
    assert activate == [".", ".venv/bin/activate"]
    assert install == ["pip", "install", "."]
    assert verify == ["certbound", "verify", "unicycle"]


def test_the_second_command_installs_and_tests() -> None:
    environment, activate, install, *checks = steps(SHELL[1])
    assert environment == ["python3.11", "-m", "venv", ".venv"]
    assert activate == [".", ".venv/bin/activate"]
    assert install == ["pip", "install", ".[test]"]
    assert checks == [["ruff", "check", "."], ["mypy"], ["pytest"]]


def test_the_readme_has_exactly_two_shell_commands() -> None:
    assert len(SHELL) == 2


def test_continuous_integration_runs_the_second_command_step_by_step_and_ends_with_its_tests() -> None:
    lines = [line.strip() for line in (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()]
    _, _, install, *checks = steps(SHELL[1])
    run = [shlex.split(line, comments=True) for line in lines]
    places = [run.index([*install[:2], "--quiet", *install[2:]])] + [run.index(check) for check in checks]
    assert places == sorted(places)
    assert lines[-1] == shlex.join(checks[-1])
    assert "set -euo pipefail" in lines


@pytest.mark.parametrize("block", PYTHON)
def test_a_python_block_runs_and_prints_a_verdict(block: str, tmp_path: Path) -> None:
    script = tmp_path / "block.py"
    script.write_text(block, encoding="utf-8")
    result = subprocess.run([sys.executable, script], capture_output=True, text=True, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith("SAFE ")


def test_every_command_that_the_readme_shows_exists() -> None:
    from certbound.cli.app import app

    known = {command.name for command in app.registered_commands}
    pattern = re.compile(r"^(?:\$ )?certbound ([a-z]+)", flags=re.MULTILINE)
    shown = [word for _, text in BLOCKS for word in pattern.findall(text)]
    assert shown
    assert set(shown) <= known


def test_every_file_that_the_readme_links_to_exists() -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        assert target.startswith("http") or (ROOT / target).exists(), target
