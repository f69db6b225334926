"""Parameters of the bundled problems."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from certbound.checks import nearest, number


def merged(model: str, defaults: Mapping[str, float], given: Mapping[str, Any]) -> dict[str, float]:
    """The defaults with the given values in their place.

    A name that is not a parameter of the model (the message names the nearest), or a value that is not finite, is a
    ValueError.
    """
    for name in given:
        if name not in defaults:
            raise ValueError(f"`{name}` is no parameter of {model}{nearest(name, defaults)}")
    return {name: number(name, given.get(name, default)) for name, default in defaults.items()}


def whole(name: str, value: float, least: int = 1) -> int:
    """A parameter that counts something."""
    if value != int(value) or value < least:
        raise ValueError(f"`{name}` must be a whole number, at least {least}, got {value:g}.")
    return int(value)
