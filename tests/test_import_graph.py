"""The doors between the rooms open in one direction: checked on the source, without running it."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "certbound"

ORDER = [
    {"errors", "_version"},
    {"display"},
    {"rigor"},
    {"problem"},
    {"tubes"},
    {"values"},
    {"simulation"},
    {"values"},
    {"constants"},
    {"reach"},
    {"safety"},
    {"synthesis"},
    {"plotting"},
    {"report"},
    {"cli"},
]
LEVEL = {room: level for level, rooms in enumerate(ORDER) for room in rooms}

CHECKER_MAY_IMPORT = {"certbound.errors", "certbound.problem.tape", "flint"}
HEAVY = {"casadi", "clarabel", "control", "cvxpy", "matplotlib", "numba", "plotly", "distributed", "dask"}


def imports_of(path: Path, module: str) -> list[tuple[int, str]]:
    """(line, absolute name) of everything that a module imports, wherever in it."""
    found = []
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parts = package.split(".")
                parts = parts[: len(parts) - node.level + 1]
                base = ".".join([*parts, base] if base else parts)
            found += [(node.lineno, f"{base}.{alias.name}") for alias in node.names]
    return found


def room_of(module: str) -> str | None:
    parts = module.split(".")
    return parts[1] if len(parts) > 1 and parts[0] == "certbound" else None


def allowed(importer: str, imported: str) -> bool:
    room, other = room_of(importer), room_of(imported)
    if room == "checker":
        own = imported.startswith("certbound.checker")
        named = any(imported == name or imported.startswith(name + ".") for name in CHECKER_MAY_IMPORT)
        standard = imported.split(".")[0] in sys.stdlib_module_names
        return own or named or standard
    if other is None or other == room:
        return True
    if imported.startswith("certbound.__"):
        return True
    if other == "checker":
        return room in ("cli", "report")
    if room == "tubes":
        return other in ("rigor", "errors", "display")
    return room is None or LEVEL.get(other, 99) < LEVEL[room]


def violations(package: Path) -> list[str]:
    """Every import against the order, as ``file:line imports name``."""
    found = []
    for path in sorted(package.rglob("*.py")):
        relative = path.relative_to(package)
        parts = ["certbound", *relative.with_suffix("").parts]
        module = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        for line, name in imports_of(path, module):
            if not allowed(module, name):
                found.append(f"{relative}:{line} imports {name}")
    return found


def test_every_import_points_from_a_later_room_to_an_earlier_one() -> None:
    assert violations(PACKAGE) == []


def test_every_room_of_the_package_has_its_place_in_the_order() -> None:
    rooms = {
        path.stem for path in PACKAGE.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()
    }
    assert rooms - {"__init__", "__main__", "checker"} <= set(LEVEL)


@pytest.mark.parametrize(
    ("file", "source"),
    [
        ("problem/planted.py", "from certbound.safety import verification"),
        ("problem/planted.py", "from ..reach.linear import anything"),
        ("tubes/planted.py", "from certbound.problem.tape import Tape"),
        ("constants/planted.py", "def late():\n    import certbound.cli.app"),
        ("rigor/planted.py", "from .. import problem"),
        ("reach/planted.py", "from certbound.checker import verify"),
        ("checker/planted.py", "import numpy"),
        ("checker/planted.py", "from certbound.problem.systems import ContinuousSystem"),
        ("checker/planted.py", "from certbound.rigor import intervals"),
    ],
)
def test_a_planted_wrong_import_is_detected(tmp_path: Path, file: str, source: str) -> None:
    planted = tmp_path / file
    planted.parent.mkdir()
    planted.write_text(source)
    assert len(violations(tmp_path)) == 1


@pytest.mark.parametrize(
    ("file", "source"),
    [
        (
            "tubes/planted.py",
            "from certbound.rigor import balls\nfrom .constants import Constants\nimport numpy",
        ),
        ("checker/planted.py", "import json\nfrom flint import arb\nfrom certbound.problem.tape import Tape"),
        ("safety/planted.py", "from ..reach import linear\nfrom certbound import __version__"),
    ],
)
def test_an_import_in_the_right_direction_passes(tmp_path: Path, file: str, source: str) -> None:
    planted = tmp_path / file
    planted.parent.mkdir()
    planted.write_text(source)
    assert violations(tmp_path) == []


def loaded_by(statement: str, names: set[str]) -> set[str]:
    """Which of the named top-level modules a fresh interpreter holds after a statement."""
    code = f"import sys\n{statement}\nprint(*[name for name in {sorted(names)!r} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(result.stdout.split())


@pytest.mark.parametrize(
    "statement", ["import certbound", "import certbound.cli", "from certbound.cli import app"]
)
def test_importing_the_package_loads_nothing_heavy(statement: str) -> None:
    assert loaded_by(statement, HEAVY) == set()


def test_importing_the_checker_loads_nothing_that_it_checks() -> None:
    assert loaded_by("import certbound.checker", HEAVY | {"numpy", "scipy", "certbound.rigor"}) == set()
