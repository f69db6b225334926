"""Parameters of the bundled problems."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from certbound.checks import nearest, number


def merged(model: str, defaults: Mapping[str, float], given: Mapping[str, Any]) -> dict[str, float]:
    """The defaults with the given values in their place.

    A name that is not a parameter of the model (the message names the nearest), a value that is not finite, or a
    negative noise level is a ValueError.
    """
    for name in given:
        if name not in defaults:
            raise ValueError(f"`{name}` is no parameter of {model}{nearest(name, defaults)}")
    values = {name: number(name, given.get(name, default)) for name, default in defaults.items()}
    if values.get("sigma", 0.0) < 0:
        raise ValueError(f"`sigma` must not be negative, got {values['sigma']:g}; the noise level is its size.")
    return values


def whole(name: str, value: float, least: int = 1) -> int:
    """A parameter that counts something."""
    if value != int(value) or value < least:
        raise ValueError(f"`{name}` must be a whole number, at least {least}, got {value:g}.")
    return int(value)
