"""What a problem asks over time: for every panel one function of the state, and its limits."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from certbound.arrays import Array
from certbound.problem.sets import Faces, Inside, Quadratic, clearance

if TYPE_CHECKING:
    from certbound.problem.problem import Problem


@dataclass(frozen=True, eq=False, kw_only=True)
class Panel:
    """A linear function with limits (``direction``), or the distance to a constraint (``constraint``).

    ``numbers`` are the constraints that it shows, by their places in ``problem.safe``.
    """

    label: str
    direction: Array | None = None
    low: float = -np.inf
    high: float = np.inf
    constraint: Any = None
    during: tuple[float, float] | None = None
    numbers: tuple[int, ...] = ()

    @property
    def limits(self) -> list[float]:
        """Where the constraint is broken: the finite limits, or a distance of 0."""
        return [0.0] if self.direction is None else [end for end in (self.low, self.high) if np.isfinite(end)]

    def values(self, states: Array, times: Array) -> Array:
        """The function along states (..., K, n) at times (K,)."""
        if self.direction is not None:
            return np.asarray(states @ self.direction)
        distances = [clearance(self.constraint, states[..., k, :], None, float(t)) for k, t in enumerate(times)]
        return np.stack(distances, axis=-1)


def panels_of(problem: Problem) -> list[Panel]:
    """Half-spaces that share a direction share a panel; every other constraint has one of its own.

    Where there is no constraint (a target or a domain alone) the first state has a panel without limits.
    """
    found: list[Panel] = []
    names = tuple(problem.axis(name) for name in problem.system.states)
    for number, constraint in enumerate(problem.safe):
        region = constraint.region
        if constraint.outside or region.moving or isinstance(region.form, Quadratic):
            label = _distance_label(constraint)
            found.append(Panel(label=label, constraint=constraint, during=constraint.during, numbers=(number,)))
            continue
        form = region.form
        rows, bounds = region.lifted(form.normals, problem.system.dimension), form.bounds
        for row, b in zip(rows, bounds if region.center is None else bounds + form.normals @ region.center_at()):
            _add_face(found, row, float(b), names, constraint.during, number)
    return found or [Panel(label=names[0], direction=np.eye(problem.system.dimension)[0])]


def _distance_label(constraint: Inside) -> str:
    region = constraint.at_first().region
    if not constraint.region.changing and region.form.even and not region.moving:
        place = ", ".join(f"{value:g}" for value in region.center_at())
        return f"distance to the ball around ({place})"
    label = str(constraint.label).removeprefix("outside ").removeprefix("inside ")
    word = "room of" if isinstance(region.form, Faces) else "distance to"  # of faces the best one's, less at corners
    return f"{word} {label}" if len(label) < 48 else f"{word} {label[:45]}..."


def _add_face(
    found: list[Panel], row: Array, bound: float, states: tuple[str, ...], during: Any, number: int
) -> None:
    upper = row[np.flatnonzero(row)[0]] > 0
    direction = row if upper else -row
    limit: dict[str, Any] = {"high": bound} if upper else {"low": -bound}
    for index, panel in enumerate(found):
        same = panel.direction is not None and np.array_equal(panel.direction, direction) and panel.during == during
        if same and not np.isfinite(panel.high if upper else panel.low):
            found[index] = replace(panel, numbers=(*panel.numbers, number), **limit)
            return
    label = ""
    for value, name in zip(direction, states):
        if value:
            sign = " - " if value < 0 else " + " if label else ""
            label += sign + ("" if abs(value) == 1 else f"{abs(value):g} ") + name
    found.append(Panel(label=label, direction=direction, during=during, numbers=(number,), **limit))
