"""Names of a package that are loaded when they are first used."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping
from typing import Any

__all__ = ["load_name", "names_in"]


def names_in(homes: Mapping[str, str]) -> list[str]:
    """All names of a table from modules to the names that they hold, in its order."""
    return [name for names in homes.values() for name in names.split()]


def load_name(package: str, homes: Mapping[str, str], name: str) -> Any:
    """A name from its module, from then on an attribute of the package.

    Raises
    ------
    AttributeError
        If no module of the table holds it.
    """
    for home, names in homes.items():
        if name in names.split():
            value = getattr(importlib.import_module(f"{package}.{home}"), name)
            setattr(sys.modules[package], name, value)
            return value
    raise AttributeError(f"module {package!r} has no attribute {name!r}")
