"""Names of a package that are loaded when they are first used."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any


def names_in(homes: Mapping[str, str]) -> list[str]:
    """All names of a table from modules to the names that they hold, in its order."""
    return [name for names in homes.values() for name in names.split()]


def lazily(
    package: str, homes: Mapping[str, str], offered: Sequence[str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """``__getattr__`` and ``__dir__`` of a package: a name comes from its module, and is an attribute from then on."""

    def load(name: str) -> Any:
        for home, names in homes.items():
            if name in names.split():
                value = getattr(importlib.import_module(f"{package}.{home}"), name)
                setattr(sys.modules[package], name, value)
                return value
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return load, lambda: sorted(offered)
