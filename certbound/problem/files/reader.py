"""Numbers, matrices and functions of a problem file, in its states and parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.checks import located, nearest
from certbound.checks import names as checked_names
from certbound.problem.files.constants_drawn import read_random
from certbound.problem.files.parser import RESERVED, constant, parse
from certbound.problem.files.schema import Specification
from certbound.problem.filters import Filter, Filters
from certbound.problem.model import Graph, Network, Tape
from certbound.problem.networks import network


class _ForbiddenError(ValueError):
    """An expression uses a name that exists, but not here."""


class Reader:
    """What every part of a problem file is read with: its names, the values of its parameters, its folder."""

    def __init__(self, spec: Specification, folder: Path | None) -> None:
        self.spec, self.folder = spec, folder
        self.own = self.states = checked_names("states", spec.states, RESERVED)
        self.inputs = checked_names("inputs", list(spec.inputs), {*RESERVED, *self.states})
        taken = {*RESERVED, *self.states, *self.inputs}
        self.disturbances = checked_names("disturbances", [*spec.disturbances, *spec.uncertain, *spec.random], taken)
        taken |= set(self.disturbances)
        self.parameters = dict.fromkeys(checked_names("parameters", list(spec.parameters), taken), 0.0)
        self.parameters |= {name: self.number(value, name) for name, value in spec.parameters.items()}
        taken |= set(self.parameters)
        self.filters = self._filters()
        self.states = (*self.own, *checked_names("noise.filter", self.filters.states, sorted(taken)))
        taken |= set(self.states)
        checked_names("networks", list(spec.networks), taken)
        paths = {name: self.file(value, f"networks.{name}") for name, value in spec.networks.items()}
        self.networks = {name: _network(path, name) for name, path in paths.items()}
        checked_names("definitions", list(spec.definitions), taken | set(self.networks))
        self.random = {name: read_random(table, self.array, f"random.{name}") for name, table in spec.random.items()}

    def _filters(self) -> Filters:
        found = []
        for place, table in enumerate(self.spec.noise.filter if self.spec.noise is not None else []):
            where = f"noise.filter.{place}"
            given = {name: value for name, value in table if value is not None}
            texts = ("state", "kind", "axis", "input")
            values: dict[str, Any] = {
                name: value if name in texts else self.number(value, f"{where}.{name}") for name, value in given.items()
            }
            with located(where, type(table).model_fields):
                found.append(Filter(**values))
        return Filters(found)

    def number(self, value: float | str, where: str, *, quoted: bool = False) -> float:
        """A number, or the value of an expression in the parameters; in quotes a mere number only if ``quoted``."""
        if not isinstance(value, str):
            if isinstance(value, bool) or np.isnan(value):
                raise ValueError(f"`{where}` must be a number, got {str(value).lower()}.")
            return float(value)
        if not quoted and _is_number(value):
            raise ValueError(f"`{where}` must be a number, got the text {value!r}; write it without quotes.")
        graph = Graph(())
        node = parse(value, graph, {name: graph.const(p) for name, p in self.parameters.items()}, where)
        result = constant(graph, node)
        if result is None or not np.isfinite(result):
            raise ValueError(f"`{where}` must be finite, got {value!r} = {result}.")
        return result

    def array(self, value: Any, where: str, *, quoted: bool = False) -> Any:
        """A number, vector or matrix of numbers or expressions in the parameters."""
        if isinstance(value, list):
            return [self.array(entry, f"{where}.{k}", quoted=quoted) for k, entry in enumerate(value)]
        return self.number(value, where, quoted=quoted)

    def matrix(self, value: Any, where: str) -> Array:
        rows = self.array(value, where, quoted=True)  # beside expressions, numbers may be in quotes too
        if isinstance(rows, list) and len({len(row) if isinstance(row, list) else 0 for row in rows}) > 1:
            raise ValueError(f"`{where}` must have rows of equal length.")
        return np.array(rows, dtype=float)

    def widened(self, values: Array, axes: int) -> Array:
        """Entries by state, along the last axes, that leave out the states of filters: 0 for these."""
        more = len(self.states) - len(self.own)
        if not more or np.shape(values)[-1] != len(self.own):
            return values
        return np.pad(values, [(0, 0)] * (np.ndim(values) - axes) + [(0, more)] * axes)

    def function(
        self, texts: Sequence[float | str], inputs: Sequence[str], where: Sequence[str], shape: tuple[int, ...]
    ) -> Tape:
        """The tape of expressions over ``inputs``, with the parameters put in and the definitions used."""
        graph = Graph(inputs)
        names: dict[str, int | Callable[[], int]] = {}
        for name in ("t", *self.states, *self.inputs, *self.disturbances):
            slot = graph.inputs.index(name) if name in graph.inputs else None
            names[name] = _forbidden(name, inputs) if slot is None else graph.input(slot)
        names |= {name: graph.const(_finite(value, f"parameters.{name}")) for name, value in self.parameters.items()}
        current = ""

        def later(name: str) -> Callable[[], int]:
            def use() -> int:
                which = "itself" if name == current else f"{name!r}, which stands below it"
                raise ValueError(f"`definitions.{current}` must not use {which}; definitions are read in order.")

            return use

        names |= {name: later(name) for name in self.spec.definitions}
        for current, text in self.spec.definitions.items():
            try:
                names[current] = self._node(text, graph, names, f"definitions.{current}")
            except _ForbiddenError as error:
                names[current] = _raise(error)
        nodes = [self._node(text, graph, names, place) for text, place in zip(texts, where)]
        return graph.tape(nodes, shape)

    def _node(
        self, text: float | str, graph: Graph, names: Mapping[str, int | Callable[[], int]], where: str
    ) -> int:
        try:
            if isinstance(text, str):
                return parse(text, graph, names, where, self.networks)
            return graph.const(_finite(text, where))
        except _ForbiddenError as error:
            raise _ForbiddenError(f"`{where}`: {error}") from None

    def by_state(self, table: Any, where: str) -> tuple[list[Any], tuple[int, ...] | None]:
        """Entries given by state name or as a list, and the states' indices (None: all, in order)."""
        if isinstance(table, list):
            if len(table) == len(self.own) < len(self.states):
                return table, tuple(range(len(self.own)))
            if len(table) != len(self.states):
                either = f" or {len(self.own)}" if self.filters else ""
                raise ValueError(f"`{where}` must have {len(self.states)}{either} entries, got {len(table)}.")
            return table, None
        for key in table:
            if key not in self.states:
                known = nearest(key, self.states)
                raise ValueError(f"`{where}` must use the states' names, got {key!r}{known}")
        indices = tuple(self.states.index(key) for key in table)
        if not indices:
            raise ValueError(f"`{where}` must not be empty.")
        return list(table.values()), None if indices == tuple(range(len(self.states))) else indices

    def file(self, value: Any, where: str) -> Path:
        path = Path(str(value))
        if self.folder is None or path.is_absolute() or ".." in path.parts or not isinstance(value, str):
            raise ValueError(f"`{where}` must be a file in the problem file's folder, got {value!r}.")
        return self.folder / path


def _is_number(text: str) -> bool:
    try:
        return bool(np.isfinite(float(text)))
    except ValueError:
        return False


def _finite(value: float, where: str) -> float:
    """A number that may stand in a model."""
    if not np.isfinite(value):
        raise ValueError(f"`{where}` must be finite, got {value}.")
    return value


def _network(path: Path, name: str) -> Network:
    """The network of a file, whose errors name the key."""
    try:
        return network(path, name=name).data
    except ValueError as error:
        raise ValueError(str(error).replace("`source`", f"`networks.{name}`", 1)) from error


def _forbidden(name: str, inputs: Sequence[str]) -> Callable[[], int]:
    return _raise(_ForbiddenError(f"{name!r} must not be used here, only {', '.join(inputs)}"))


def _raise(error: ValueError) -> Callable[[], int]:
    def use() -> int:
        raise error

    return use
