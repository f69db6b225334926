"""Does a certificate speak of a given problem? Both are compared as data."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from certbound.checker.statement.tapes import canonical

_FOR_HUMANS = re.compile(r"name|units|(constraints\[\d+\]|reach)\.label")
"""Paths; what is drawn stands under names of its own, which may be any."""


def _clock(problem: Mapping[str, Any]) -> Any:
    """The unit of time, which the claim names."""
    units = problem.get("units")
    return units.get("time") if isinstance(units, Mapping) else None


def first_difference(mine: Any, theirs: Any, path: str = "") -> str:
    """Where two problems' data differ first, in words; empty where they state the same problem.

    Names for humans, units but that of time, and the order of a tape's operations do not count.

    Examples
    --------
    >>> first_difference({"horizon": "0x1p+0", "name": "a"}, {"horizon": "0x1p+0", "name": "b"})
    ''
    >>> first_difference({"horizon": "0x1p+0"}, {"horizon": "0x1p+1"})
    'horizon differs'
    """
    if isinstance(mine, Mapping) and isinstance(theirs, Mapping):
        if isinstance(mine.get("nodes"), list) and isinstance(theirs.get("nodes"), list):
            same = canonical(mine) == canonical(theirs) and mine.get("columns") == theirs.get("columns")
            return "" if same else f"{path} is another function"
        for name in [*mine, *(name for name in theirs if name not in mine)]:
            place = f"{path}.{name}" if path else str(name)
            if _FOR_HUMANS.fullmatch(place):
                if name == "units" and _clock(mine) != _clock(theirs):
                    return "units.time differs"
                continue
            if name not in mine or name not in theirs:
                return f"{place} differs"
            found = first_difference(mine[name], theirs[name], place)
            if found:
                return found
        return ""
    if isinstance(mine, list) and isinstance(theirs, list):
        if len(mine) != len(theirs):
            return f"{path} differs in length"
        for index, (a, b) in enumerate(zip(mine, theirs)):
            found = first_difference(a, b, f"{path}[{index}]")
            if found:
                return found
        return ""
    return "" if type(mine) is type(theirs) and mine == theirs else f"{path} differs"
