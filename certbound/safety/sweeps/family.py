"""A grid of parameters, and the problem at each of its points."""

from __future__ import annotations

import inspect
import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from certbound.checks import nearest, number, vector
from certbound.problem.files import load
from certbound.problem.problem import Problem

Point = tuple[float, ...]

ALWAYS = ("horizon", "delta")
"""What every problem has, whether its builder takes a parameter of that name or not."""
_MOST = 100_000


@dataclass(frozen=True)
class Grid:
    """Names, and for each its values in increasing order."""

    names: tuple[str, ...]
    values: tuple[Point, ...]

    @classmethod
    def of(cls, over: Mapping[str, Any]) -> Grid:
        """A grid from a mapping of names to values; what is no grid is a ValueError or TypeError."""
        if not isinstance(over, Mapping) or not over or any(not isinstance(name, str) for name in over):
            raise TypeError(f"`over` must be a mapping from names of parameters to their values, got {over!r}.")
        values = []
        for name, given in over.items():
            if not isinstance(given, int | float) and not len(given):
                raise ValueError(f"`over[{name!r}]` must hold at least one value, got none.")
            found = sorted(float(value) for value in vector(f"over[{name!r}]", given))
            twice = next((one for one, other in itertools.pairwise(found) if one == other), None)
            if twice is not None:
                raise ValueError(f"`over[{name!r}]` must hold each value once, got {twice:g} twice.")
            values.append(tuple(number(f"over[{name!r}]", value) for value in found))
        grid = cls(tuple(over), tuple(values))
        if grid.size > _MOST:
            raise ValueError(f"`over` must make at most {_MOST} points, got {grid.size}; take fewer values.")
        return grid

    @property
    def size(self) -> int:
        """The number of points."""
        count = 1
        for values in self.values:
            count *= len(values)
        return count

    def points(self) -> list[Point]:
        """All points; the last name's value changes first."""
        return list(itertools.product(*self.values))

    def named(self, point: Point) -> dict[str, float]:
        """The values of a point by name."""
        return dict(zip(self.names, point, strict=True))

    def words(self, point: Point) -> str:
        """A point for humans."""
        return ", ".join(f"{name} = {value:.6g}" for name, value in self.named(point).items())

    def chains(self, name: str) -> dict[Point, list[Point]]:
        """For every choice of the other parameters, the points along one, in increasing order."""
        place = self.names.index(name)
        found: dict[Point, list[Point]] = {}
        for point in self.points():
            found.setdefault(point[:place] + point[place + 1 :], []).append(point)
        return found


class Family:
    """The problem at each point: of a file or bundled name, of a function of the parameters, or of one problem.

    ``fixed`` are parameters that every point shares; ``horizon`` and ``delta`` are changed in the problem itself where
    its builder has no parameter of that name.
    """

    def __init__(self, source: Any, fixed: Mapping[str, float]) -> None:
        if not isinstance(source, str | Path | Problem) and not callable(source):
            kind = type(source).__name__
            raise TypeError(f"`source` must be a problem, its name or file, or a function that builds one, got {kind}.")
        self.fixed = dict(fixed)
        self._source = source
        self._takes = _takes(source)

    def at(self, parameters: Mapping[str, float]) -> Problem:
        """The problem at some values; what refuses them is a ValueError that names them."""
        values = self.fixed | dict(parameters)
        apart = [name for name in ALWAYS if name in values and not self._takes(name)]
        changes: dict[str, Any] = {name: values.pop(name) for name in apart}
        try:
            problem = self._built(values)
            if "horizon" in changes and problem.system.time == "discrete":
                changes["horizon"] = _whole(changes["horizon"])
            return problem.replace(**changes) if changes else problem
        except (ValueError, TypeError, ArithmeticError) as error:
            if any(f"`{name}` is no parameter" in str(error) for name in values):
                raise
            words = ", ".join(f"{name} = {value:.6g}" for name, value in parameters.items())
            raise ValueError(f"there is no problem at {words}: {error}") from error

    def _built(self, values: dict[str, float]) -> Problem:
        if isinstance(self._source, Problem):
            if values:
                name = next(iter(values))
                raise ValueError(
                    f"`{name}` is no parameter of a finished problem{nearest(name, ALWAYS)} Give a function of the "
                    "parameters, a file or a name; of a problem only horizon and delta can change."
                )
            return self._source
        if isinstance(self._source, str | Path):
            return load(self._source, **values)
        unknown = next((name for name in values if not self._takes(name)), None)
        if unknown is not None:
            known = inspect.signature(self._source).parameters
            raise ValueError(f"`{unknown}` is no parameter of the function{nearest(unknown, known)}")
        problem = self._source(**values)
        if not isinstance(problem, Problem):
            raise TypeError(f"`source` must return a cb.Problem, got {problem!r}.")
        return problem


def _takes(source: Any) -> Callable[[str], bool]:
    """Whether a builder has a parameter of some name."""
    if isinstance(source, Problem):
        return lambda name: False
    if isinstance(source, str | Path):
        text = str(source)
        if ":" in text and not Path(text).exists():
            return lambda name: name not in ALWAYS
        known = load(source).parameters
        return lambda name: name in known
    parameters = inspect.signature(source).parameters.values()
    if any(entry.kind is entry.VAR_KEYWORD for entry in parameters):
        return lambda name: True
    names = {entry.name for entry in parameters}
    return lambda name: name in names


def _whole(horizon: float) -> float:
    if math.isinf(horizon):
        return horizon
    if horizon != int(horizon):
        raise ValueError(f"`horizon` counts steps and must be whole, got {horizon:g}.")
    return int(horizon)
