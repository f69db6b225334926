"""Constants that are drawn once, as tables of a problem file."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from certbound.checks import nearest
from certbound.problem.files.schema import RandomTable
from certbound.problem.noise import LAWS
from certbound.problem.random_constants import Random


def read_random(table: RandomTable, read: Callable[[Any, str], Any], where: str) -> Random:
    """The constant that a table describes; ``read`` gives the numbers of a value that stands at a place.

    A table of values or edges need not have the mean 0: its mean is taken off, and added again.

    Errors (ValueError, TypeError) name the key, the rule and the value.
    """
    kind = LAWS.get(table.law)
    if kind is None:
        raise ValueError(f"`{where}.law` must be one of {', '.join(LAWS)}, got {table.law!r}{nearest(table.law, LAWS)}")
    fields = {key: read(value, f"{where}.{key}") for key, value in (table.model_extra or {}).items()}
    for key in fields.keys() - {*kind.levels, *kind.tables}:
        known = nearest(key, [*kind.levels, *kind.tables])
        raise ValueError(f"unknown key {key!r} in `{where}` with law {table.law!r}{known}")
    mean = float(read(table.mean, f"{where}.mean"))
    if kind.tables and set(kind.tables) <= fields.keys():
        places, weights = (np.asarray(fields[name], dtype=float) for name in kind.tables)
        middles = places if len(places) == len(weights) else (places[1:] + places[:-1]) / 2
        if len(middles) == len(weights):
            own = float(weights @ middles)
            if abs(own) > 1e-12 * float(np.abs(places).max(initial=0.0)):
                scale = float(fields.get(kind.levels[0], 1.0))
                fields[kind.tables[0]], mean = places - own, mean + scale * own
    if not kind.tables and len(fields) != 1:
        given = ", ".join(fields) or "none"
        raise ValueError(
            f"`{where}` with law {table.law!r} needs exactly one of {', '.join(kind.levels)}; got {given}."
        )
    return Random(law=kind(**fields), mean=mean)
