"""The keys of a foreign file, taken one by one: whatever is left at the end is an error that names it."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from certbound.checks import nearest

_MISSING = object()


@dataclass(frozen=True, eq=False, kw_only=True)
class Restated:
    """The content of a problem file of this package, and a line for each key that it was made of."""

    content: dict[str, Any]
    notes: tuple[str, ...]


class Keys:
    """A table whose keys are taken, each with a note of what it became.

    ``where`` is put before the keys of a table inside another one.
    """

    def __init__(self, table: Any, tool: str, where: str = "") -> None:
        if not isinstance(table, Mapping):
            raise ValueError(f"`{where or 'the file'}` must be a table of keys, got {table!r}.")
        self.left: dict[Any, Any] = dict(table)
        self.known: list[str] = []
        self.tool, self.where = tool, where
        self.notes: list[str] = []

    def name(self, key: str) -> str:
        """The key with the tables that it stands in."""
        return f"{self.where}.{key}" if self.where else key

    def take(self, key: str, default: Any = _MISSING) -> Any:
        """The value of a key, which is a ValueError where it is missing and has no default."""
        self.known.append(key)
        if key not in self.left and default is _MISSING:
            close = difflib.get_close_matches(key, map(str, self.left), 1)
            instead = f"the file has `{close[0]}` instead" if close else f"{self.tool} needs it"
            raise ValueError(f"`{self.name(key)}` is missing; {instead}.")
        return self.left.pop(key, default)

    def note(self, key: str, became: str) -> None:
        """Say what a key became."""
        self.notes.append(f"{self.name(key)} -> {became}")

    def leave(self, keys: Iterable[str], why: str) -> None:
        """Take keys that are not of the problem."""
        self.known += keys
        found = [key for key in self.left if key in self.known]
        for key in found:
            del self.left[key]
        if found:
            self.notes.append(f"{', '.join(map(self.name, found))} -> {why}")

    def finish(self) -> None:
        """Refuse what is left."""
        for key in self.left:
            close = nearest(str(key), self.known)
            raise ValueError(f"unknown key `{self.name(str(key))}` in a file of {self.tool}{close}")


def real(key: str, value: Any) -> float:
    """A finite number; YAML hands over 1e-5 as text."""
    try:
        number = float(value) if not isinstance(value, bool) else math.nan
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"`{key}` must be a finite number, got {value!r}.")
    return number


def whole(key: str, value: Any) -> int:
    """A whole number that is positive."""
    number = real(key, value)
    if number != int(number) or number < 1:
        raise ValueError(f"`{key}` must be a positive whole number, got {value!r}.")
    return int(number)


def reals(key: str, value: Any, length: int | None = None) -> list[float]:
    """A list of numbers."""
    if not isinstance(value, Sequence) or isinstance(value, str) or not value:
        raise ValueError(f"`{key}` must be a list of numbers, got {value!r}.")
    if length is not None and len(value) != length:
        raise ValueError(f"`{key}` must have {length} entries, got {len(value)}.")
    return [real(key, entry) for entry in value]


def sides(key: str, low: list[float], high: list[float]) -> list[list[float]]:
    """Intervals from lower and upper ends."""
    if len(low) != len(high):
        raise ValueError(f"`{key}` must have as many lower ends as upper ones, got {len(low)} and {len(high)}.")
    for one, other in zip(low, high):
        if one > other:
            raise ValueError(f"`{key}` must have its lower ends first, got {one:g} > {other:g}.")
    return [[one, other] for one, other in zip(low, high)]


def listed(values: Iterable[float]) -> str:
    """Numbers for a note."""
    return ", ".join(f"{value:g}" for value in values)


def boxed(intervals: Iterable[Sequence[float]]) -> str:
    """A box for a note."""
    return " x ".join(f"[{low:g}, {high:g}]" for low, high in intervals)
