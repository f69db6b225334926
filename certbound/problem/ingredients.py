"""What the arguments of a problem have to be: each is checked, and returned as the problem keeps it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.checks import nearest, number, positive_definite, vector
from certbound.problem.random_constants import Random
from certbound.problem.sets import Box, GaussianStart, Region, StartUnion


def checked_horizon(value: Any, discrete: bool) -> float | int:
    """Seconds, or whole steps; infinity is for ever."""
    horizon = number("horizon", value, infinite=True)
    if not horizon > 0:
        raise ValueError(f"`horizon` must be positive, got {horizon:g}.")
    if discrete and np.isfinite(horizon):
        if horizon != int(horizon):
            raise ValueError(f"`horizon` must be a whole number of steps in discrete time, got {horizon:g}.")
        return int(horizon)
    return horizon


def checked_delta(value: Any) -> float:
    """A probability between 0 and 1."""
    delta = number("delta", value)
    if not 0 < delta < 1:
        raise ValueError(f"`delta` must lie in (0, 1), got {delta:g}.")
    return delta


def check_dimension(name: str, region: Any, dimension: int) -> None:
    """Refuse a set that does not live in the states."""
    if region.coordinates is not None:
        if max(region.coordinates) >= dimension:
            raise ValueError(
                f"`{name}` must use state indices below {dimension}, got coordinates {region.coordinates}; "
                "the first state has index 0."
            )
    elif region.dimension != dimension:
        raise ValueError(
            f"`{name}` must have dimension {dimension} (the states), got {region.dimension}; a set in some of the "
            "states names them by `coordinates`."
        )


def checked_start(value: Any, dimension: int) -> Any:
    """A set of starts, a random start, or the union of several sets."""
    sets = value.members if isinstance(value, StartUnion) else value
    if not isinstance(sets, list | tuple) or not any(isinstance(entry, Region | GaussianStart) for entry in sets):
        return _one_start(value, dimension)
    members = [_one_start(entry, dimension) for entry in sets]
    if any(member.random for member in members):
        raise ValueError("`initial` must hold sets and points in a union; a GaussianStart stands alone.")
    return StartUnion(tuple(members)) if len(members) > 1 else members[0]


def _one_start(value: Any, dimension: int) -> Any:
    kind: Any = type(value)
    if issubclass(kind, Region | GaussianStart | StartUnion | Mapping | str):
        if kind is not GaussianStart and not (Region in kind.__bases__ and kind.starts):
            kinds = "a point, Box, Ball, Ellipsoid or GaussianStart, or a list of sets"
            raise TypeError(f"`initial` must be {kinds}, got {value!r}.")
    else:
        point = vector("initial", value, dimension)
        value = Box(point, point)
    start: Any = value
    if not start.random:
        if start.moving or start.coordinates is not None:
            raise ValueError("`initial` must be a fixed set over all states, without `coordinates`.")
        if not np.all(np.isfinite([start.extent().lo, start.extent().hi])):
            raise ValueError("`initial` must be bounded, got a set with infinite sides.")
    if start.dimension != dimension:
        raise ValueError(f"`initial` must have dimension {dimension} (the states), got {start.dimension}.")
    return start


def checked_weight(name: str, value: Any, size: int, *, strict: bool) -> Array:
    """A matrix of weights, or a diagonal as one."""
    matrix = np.diag(vector(name, value, size)) if np.ndim(value) == 1 else value
    return positive_definite(name, matrix, size, strict=strict)


def checked_unknown(value: Any, known: Sequence[str]) -> tuple[str, ...]:
    """Names of disturbances."""
    found = (value,) if isinstance(value, str) else tuple(value)
    for name in found:
        if name not in known:
            raise ValueError(f"`unknown` must name disturbances of the system, got {name!r}{nearest(str(name), known)}")
    return found


def checked_random(value: Any, known: Sequence[str], unknown: Sequence[str]) -> dict[str, Random]:
    """Constants that are drawn, by the names of their disturbances."""
    found: dict[str, Random] = dict(value or {})
    for name, constant in found.items():
        if name not in known:
            raise ValueError(f"`random` must name disturbances of the system, got {name!r}{nearest(str(name), known)}")
        if name in unknown:
            raise ValueError(f"`random` must not name {name!r}, which is unknown; it is one or the other.")
        if not isinstance(constant, Random):
            raise TypeError(f"`random[{name!r}]` must be cb.Random(law=..., mean=...), got {constant!r}.")
    return found
