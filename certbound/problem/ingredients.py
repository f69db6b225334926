"""What the arguments of a problem have to be: each is checked, and returned as the problem keeps it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.checks import frozen, nearest, number, positive_definite, vector
from certbound.problem.model import Tape
from certbound.problem.random_constants import Random
from certbound.problem.sets import Box, GaussianStart, Region, StartUnion
from certbound.problem.systems import System

_LONGEST_UNIT = 20
_SHORTEST, _LONGEST = 1e-50, 1e50  # horizons in continuous time: their fifth powers are floats
_ROUNDED = Fraction(1, 2**51)  # share of the horizon by which two floats of decimal numbers may miss each other
_MOST_SAMPLES = 1000


def checked_horizon(value: Any, discrete: bool) -> float | int:
    """Seconds, or whole steps; infinity is for ever."""
    horizon = number("horizon", value, infinite=True)
    if not horizon > 0:
        raise ValueError(f"`horizon` must be positive, got {horizon:g}.")
    if discrete and np.isfinite(horizon):
        if horizon != int(horizon):
            raise ValueError(f"`horizon` must be a whole number of steps in discrete time, got {horizon:g}.")
        return int(horizon)
    if np.isfinite(horizon) and not _SHORTEST <= horizon <= _LONGEST:
        raise ValueError(
            f"`horizon` must lie between {_SHORTEST:g} and {_LONGEST:g}, or be infinite, got {horizon:g}; choose "
            "another unit of time."
        )
    return horizon


def checked_delta(value: Any) -> float:
    """A probability between 0 and 1."""
    delta = number("delta", value)
    if not 0 < delta < 1:
        raise ValueError(f"`delta` must lie in (0, 1), got {delta:g}.")
    return delta


def checked_hold(value: Any, plan: Any, system: System, horizon: float) -> float | None:
    """Seconds between two sampling times, of which the horizon is a whole number; None where nothing is held."""
    if value is None:
        return None
    hold = number("hold", value)
    if system.time != "continuous":
        raise ValueError("`hold` must be left out in discrete time, where every step computes the inputs anew.")
    if not isinstance(plan, Tape):
        raise ValueError("`hold` must come with a `plan` that is a law of t and x; rows of an array are held already.")
    if not 0 < hold <= horizon or np.isinf(horizon):
        raise ValueError(f"`hold` must be positive, and at most the horizon {horizon:g}, which ends; got {hold:g}.")
    count = samples_of(hold, horizon)
    if count is None:
        raise ValueError(
            f"`hold` must fit into the horizon a whole number of times, got {hold:g} in {horizon:g}; a horizon of "
            f"{max(round(horizon / hold), 1) * hold:.6g} does."
        )
    if count > _MOST_SAMPLES:
        raise ValueError(f"`hold` must make at most {_MOST_SAMPLES} sampling times, got {count}; shorten the horizon.")
    return hold


def samples_of(hold: float, horizon: float) -> int | None:
    """How often ``hold`` fits into the horizon, up to rounding; None if not.

    The samples are at the ends of as many equal parts of the horizon.
    """
    count = round(horizon / hold)
    missed = abs(count * Fraction(hold) - Fraction(horizon))
    return count if count and missed <= _ROUNDED * Fraction(horizon) else None


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


def checked_start(value: Any, system: System) -> Any:
    """A set of starts, a random start, or the union of several sets; states of filters may be left out."""
    n, own = system.dimension, system.own_dimension
    given = _dimension_of(value) if system.filters else n
    if given not in (own, n, None):
        raise ValueError(
            f"`initial` must have {own} entries, or {n} with those of the filters ({', '.join(system.states[own:])}), "
            f"got {given}."
        )
    if given != own or own == n:
        return _checked_start(value, n)
    box = system.inputs
    ends = {} if box is None else dict(zip(system.input_names, np.stack([box.low, box.high], axis=1).tolist()))
    return system.filters.start(_checked_start(value, own), ends)


def _dimension_of(value: Any) -> int | None:
    """Of a set, a point or a list of sets; None of anything else."""
    if isinstance(value, list | tuple) and any(isinstance(one, Region | GaussianStart) for one in value):
        sizes = {size for one in value if (size := _dimension_of(one)) is not None}
        return sizes.pop() if len(sizes) == 1 else None
    if isinstance(value, Region | GaussianStart | StartUnion):
        return value.dimension
    return None if isinstance(value, Mapping | str) or value is None else int(np.size(value))


def _checked_start(value: Any, dimension: int) -> Any:
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
        if type(start).extent is not Region.extent:
            _check_extent(start)
    if start.dimension != dimension:
        raise ValueError(f"`initial` must have dimension {dimension} (the states), got {start.dimension}.")
    return start


def _check_extent(start: Region) -> None:
    """Refuse a shape's own box that does not hold what its form says: certificates state the box."""
    around, eye = start.hull(), np.eye(start.dimension)
    low, high = (sign * Region.local_support(start, sign * eye, 0.0) for sign in (-1, 1))
    slack = 1e-6 * np.maximum(high - low, 1e-6 * np.abs(high + low))
    if np.any((around.lo > low + slack) | (around.hi < high - slack)):
        name = type(start).__name__
        raise ValueError(
            f"`initial` reaches from {low} to {high} by its form, and its `extent` from {around.lo} to "
            f"{around.hi}; let `extent` of {name} hold the whole set, or leave it out."
        )


def _checked_weight(name: str, value: Any, size: int, *, strict: bool) -> Array:
    """A matrix of weights, or a diagonal as one."""
    matrix = np.diag(vector(name, value, size)) if np.ndim(value) == 1 else value
    return positive_definite(name, matrix, size, strict=strict)


def checked_cost(value: Any, system: System) -> tuple[Array, Array] | None:
    """The weights (Q, R) of a system with inputs."""
    if value is None:
        return None
    if system.inputs is None:
        raise ValueError("`cost` must be omitted for a system without inputs.")
    if not isinstance(value, Sequence) or len(value) != 2:
        raise ValueError(f"`cost` must be the pair (Q, R), got {value!r}.")
    state = _checked_weight("Q", value[0], system.dimension, strict=False)
    return state, _checked_weight("R", value[1], len(system.input_names), strict=True)


def checked_unknown(value: Any, known: Sequence[str]) -> tuple[str, ...]:
    """Names of disturbances."""
    if not isinstance(value, Iterable):
        raise TypeError(f"`unknown` must be a list of names of disturbances, got {value!r}.")
    found = (value,) if isinstance(value, str) else tuple(value)
    for name in found:
        if name not in known:
            raise ValueError(f"`unknown` must name disturbances of the system, got {name!r}{nearest(str(name), known)}")
    return found


def _table(name: str, value: Any) -> dict[str, Any]:
    if value is not None and not isinstance(value, Mapping):
        raise TypeError(f"`{name}` must be a dict by names, got {value!r}.")
    return dict(value or {})


def checked_random(value: Any, known: Sequence[str], unknown: Sequence[str]) -> dict[str, Random]:
    """Constants that are drawn, by the names of their disturbances."""
    found: dict[str, Random] = _table("random", value)
    for name, constant in found.items():
        if name not in known:
            raise ValueError(f"`random` must name disturbances of the system, got {name!r}{nearest(str(name), known)}")
        if name in unknown:
            raise ValueError(f"`random` must not name {name!r}, which is unknown; it is one or the other.")
        if not isinstance(constant, Random):
            raise TypeError(f"`random[{name!r}]` must be cb.Random(law=..., mean=...), got {constant!r}.")
    return found


def checked_units(value: Any, system: System) -> dict[str, str]:
    """Units by the names of signals, and of ``time``: short printable texts."""
    known = ("time", *system.states, *system.input_names, *system.disturbance_names)
    found = _table("units", value)
    for name, unit in found.items():
        if name not in known:
            raise ValueError(f"`units` must name time or signals, got {name!r}{nearest(str(name), known)}")
        if not isinstance(unit, str) or not unit.isprintable() or not 0 < len(unit) <= _LONGEST_UNIT:
            raise ValueError(f"`units.{name}` must be a text of 1 to {_LONGEST_UNIT} characters, got {unit!r}.")
    return found


def described(problem: Any) -> list[tuple[str, str]]:
    """Signals, start and constraints of a problem, for its summary."""
    system = problem.system
    signals = {"states": system.states, "inputs": system.input_names, "disturbances": system.disturbance_names}
    found = [(word, ", ".join(map(problem.axis, names))) for word, names in signals.items() if names]
    found += [] if problem.hold is None else [("held for", f"{problem.hold:g} {problem.time_unit}")]
    found += [("filter", one.describe()) for one in system.filters.members]
    found += [("drawn", f"{name} = {law.describe()}") for name, law in problem.random.items()]
    starts = ["a point" if start.is_point else type(start).__name__ for start in problem.starts]
    found.append(("start", starts[0] if len(starts) == 1 else f"one of {', '.join(starts)}"))
    found += [("constraint", constraint.label) for constraint in problem.kept]
    return found if problem.reach is None else [*found, ("target", problem.reach.label)]


def checked_rows(plan: Any, system: System, horizon: float) -> Array:
    """A plan that is an array: one row a step, or equal pieces of the horizon, inside the inputs' bounds."""
    count, box, discrete = len(system.input_names), system.inputs, system.time == "discrete"
    assert box is not None
    if np.isinf(horizon):
        raise ValueError("`plan` must be a feedback law where the horizon is infinite, got an array.")
    rows = np.asarray(plan, dtype=float)
    rows = rows[:, None] if rows.ndim == 1 and count == 1 else rows
    if rows.ndim != 2 or rows.shape[1] != count or not len(rows) or not np.all(np.isfinite(rows)):
        raise ValueError(f"`plan` must be a finite array (steps, {count}), got shape {rows.shape}.")
    if discrete:
        if len(rows) < horizon:
            raise ValueError(f"`plan` must have {horizon} rows, one a step, got {len(rows)}.")
        rows = rows[: int(horizon)]
    width = box.high - box.low
    slack = 1e-9 * (np.abs(rows) + np.where(np.isfinite(width), width, 0.0))
    outside = (rows < box.low - slack) | (rows > box.high + slack)
    if np.any(outside):
        row, column = (int(k) for k in np.argwhere(outside)[0])
        name, value = system.input_names[column], rows[row, column]
        raise ValueError(
            f"`plan` must stay in the input bounds, got {name} = {value:g} in row {row}, outside "
            f"[{box.low[column]:g}, {box.high[column]:g}]."
        )
    return frozen(np.clip(rows, box.low, box.high))
