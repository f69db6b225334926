"""What only tests reach has no place in the package."""

from __future__ import annotations

import ast
import gc
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

import certbound as cb
import certbound.constants

ROOT = Path(__file__).resolve().parents[1]
Modules = dict[str, tuple[ast.Module, bool]]
ALONE = {
    "certbound.safety.limits.find_limits": "all limits in one call, where verify and --explain take them one by one",
    "certbound.checker.check.check_file": "a whole check in one call, for programs that hold no more than a file",
    "certbound.constants.recheck.holds_gain": "the proof of a gain at a stated value: says whether a bound is tight",
    "certbound.constants.recheck.holds_rate": "the proof of a rate at a stated value, likewise",
    "certbound.plotting.results.draw_chosen": "what `plot` of results calls, from the package's own door",
}
"""Functions and classes that nothing but tests reach, and why they are there."""


@pytest.fixture(scope="module")
def modules() -> Iterator[Modules]:
    """Every module that is no test, parsed, and whether it is a room's door."""
    found = {}
    gc.disable()  # a million nodes, which the collector would walk again and again
    for folder in ("certbound", "experiments", "paper_figs", "docs"):
        for path in (ROOT / folder).rglob("*.py"):
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
            found[name] = ast.parse(path.read_text(encoding="utf-8")), path.stem == "__init__"
    yield found
    gc.enable()


def words(tree: ast.AST) -> tuple[Counter[str], set[tuple[str | None, str]]]:
    """Names that a piece of code reads, and with a dot before them attributes; what it imports from where."""
    names, imported = list[str](), set[tuple[str | None, str]]()
    for node in ast.walk(tree):
        if isinstance(node, ast.Name):
            names.append(node.id)
        elif isinstance(node, ast.Attribute):
            names.append(f".{node.attr}")
        elif isinstance(node, ast.ImportFrom):
            imported |= {(node.module, alias.name) for alias in node.names}
    return Counter(names), imported


def unreached(known: Modules) -> set[str]:
    """Functions and classes of the package that no other code reads, imports (doors apart) or offers to users."""
    found = {name: words(tree) for name, (tree, _) in known.items()}
    whole = {name: names for name, (names, _) in found.items()}
    imported = set().union(*(taken for name, (_, taken) in found.items() if not known[name][1]))
    public = {*cb.__all__, *certbound.constants.__all__, "connect"}  # `connect` is what the package's own door calls
    everywhere = set().union(*whole.values())
    alone = set()
    for module, (tree, _) in known.items():
        doors = [".".join(module.split(".")[:end]) for end in range(1, module.count(".") + 2)]
        for node in tree.body if module.startswith("certbound") else ():
            if not isinstance(node, ast.FunctionDef | ast.ClassDef) or node.name in public or node.name[:2] == "__":
                continue
            if node.decorator_list and re.search("register|callback", ast.unparse(node.decorator_list[0])):
                continue
            if f".{node.name}" in everywhere or any((door, node.name) in imported for door in doors):
                continue
            if whole[module][node.name] == words(node)[0][node.name]:
                alone.add(f"{module}.{node.name}")
    return alone


KERNELS = ("certbound.simulation.compiled.", "certbound.lazy.")
"""What the text of generated kernels calls; what every door calls."""


def test_every_function_is_reached_by_more_than_tests(modules: Modules) -> None:
    assert {name for name in unreached(modules) if not name.startswith(KERNELS)} == set(ALONE)


def test_a_planted_function_is_found(modules: Modules) -> None:
    planted = ast.parse("__all__ = ['alone']\ndef alone(): ...\ndef used(): ...\nused()"), False
    room = {name: module for name, module in modules.items() if name.startswith("certbound.rigor")}
    found = unreached(room | {"certbound.rigor.planted": planted})
    assert {name for name in found if "planted" in name} == {"certbound.rigor.planted.alone"}
