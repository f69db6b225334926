"""Docstrings say of parameters and exceptions what the code says, wherever a door offers a function or a class."""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FunctionType
from typing import Any

import pytest

import certbound as cb

ROOT = Path(__file__).resolve().parents[1]


def doors() -> Iterator[tuple[str, Any]]:
    """Everything that the package and its sub-rooms offer, once, by where it is defined."""
    seen: dict[str, Any] = {}
    for path in sorted((ROOT / "certbound").rglob("__init__.py")):
        room = importlib.import_module(".".join(path.parent.relative_to(ROOT).parts))
        for name in getattr(room, "__all__", ()):
            value = getattr(room, name)
            if isinstance(value, type | FunctionType) and value.__module__.startswith("certbound"):
                seen[f"{value.__module__}.{value.__qualname__}"] = value
    yield from seen.items()


def described() -> Iterator[tuple[str, Any]]:
    """These, and the public methods of the classes among them."""
    for name, value in doors():
        yield name, value
        if isinstance(value, type):
            for method, held in vars(value).items():
                inner = held.__func__ if isinstance(held, classmethod | staticmethod) else held
                if isinstance(inner, FunctionType) and not method.startswith("_"):
                    yield f"{name}.{method}", inner


def subclasses(kind: type) -> Iterator[str]:
    """The names of a class and all that derive from it, in the language and in the package."""
    if kind.__module__.partition(".")[0] in ("builtins", "certbound"):
        yield kind.__name__
    for inner in type.__subclasses__(kind):
        yield from subclasses(inner)


PUBLIC = dict(described())
OFFERED = {name: getattr(cb, name) for name in cb.__all__ if name != "__version__"}
EXCEPTIONS = set(subclasses(BaseException))


def section(value: Any, title: str) -> list[str] | None:
    """The entries of a section of a docstring, without what is indented under them; None where there is none."""
    text = inspect.cleandoc(value.__doc__ or "")
    found = re.search(rf"^{title}\n-+\n(.*?)(?=^[^\n]+\n-+\n|\Z)", text, flags=re.MULTILINE | re.DOTALL)
    if found is None:
        return None
    return [line for line in re.split(r"\n\n(?=\S)", found[1])[0].splitlines() if line and not line.startswith(" ")]


def parameters(value: Any) -> list[str] | None:
    """The names that the section on parameters describes, in its order."""
    entries = section(value, "Parameters")
    return None if entries is None else [
        name.strip().lstrip("*") for entry in entries for name in entry.split(" :")[0].split(",")
    ]


def taken(value: Callable[..., Any]) -> list[str]:
    """The public parameters of a function, or of the making of a class, in order."""
    names = inspect.signature(value).parameters
    return [name for name in names if name not in ("self", "cls") and not name.startswith("_")]


@pytest.mark.parametrize("name", [name for name, value in PUBLIC.items() if parameters(value) is not None])
def test_what_is_described_is_taken_in_that_order(name: str) -> None:
    listed, real = parameters(PUBLIC[name]), taken(PUBLIC[name])
    assert listed == [entry for entry in real if entry in (listed or [])]


@pytest.mark.parametrize("name", OFFERED)
def test_every_parameter_of_what_users_get_is_described(name: str) -> None:
    value = OFFERED[name]
    assert value.__doc__
    if not (isinstance(value, type) and issubclass(value, Exception)):
        assert (parameters(value) or []) == taken(value)


@pytest.mark.parametrize("name", [name for name, value in PUBLIC.items() if section(value, "Raises") is not None])
def test_what_is_raised_exists(name: str) -> None:
    named = {word for entry in section(PUBLIC[name], "Raises") or [] for word in re.split(r", *", entry)}
    assert named <= EXCEPTIONS
