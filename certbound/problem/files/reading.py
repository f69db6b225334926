"""From the content of a problem file to a ``Problem``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.checks import names as checked_names
from certbound.checks import nearest
from certbound.problem import sets
from certbound.problem.files.constants_drawn import read_random
from certbound.problem.files.parser import RESERVED, constant, parse
from certbound.problem.files.plans import read_plan
from certbound.problem.files.schema import Constraint, Cost, Part, PolygonTable, Specification, Start
from certbound.problem.model import Graph, Tape, sources
from certbound.problem.networks import network
from certbound.problem.noise import LAWS
from certbound.problem.problem import Problem
from certbound.problem.systems import ContinuousSystem, DiscreteSystem, linear_system

_OUTSIDE = 1e-3  # of delta


class _ForbiddenError(ValueError):
    """An expression uses a name that exists, but not here."""


def read_problem(spec: Specification, folder: Path | None, source: Mapping[str, Any] | None = None) -> Problem:
    """Build the problem that a validated specification describes; ``source``, the raw content, is kept for saving.

    ``plan.file`` and networks are read from ``folder``; None forbids it. Errors (ValueError, TypeError) name the key,
    the rule and the value.
    """
    return _Reader(spec, folder).problem(source)


class _Reader:
    def __init__(self, spec: Specification, folder: Path | None) -> None:
        self.spec, self.folder = spec, folder
        self.states = checked_names("states", spec.states, RESERVED)
        self.inputs = checked_names("inputs", list(spec.inputs), {*RESERVED, *self.states})
        taken = {*RESERVED, *self.states, *self.inputs}
        self.disturbances = checked_names("disturbances", [*spec.disturbances, *spec.uncertain, *spec.random], taken)
        taken |= set(self.disturbances)
        self.parameters = dict.fromkeys(checked_names("parameters", list(spec.parameters), taken), 0.0)
        self.parameters |= {name: self.number(value, name) for name, value in spec.parameters.items()}
        taken |= set(self.parameters)
        checked_names("networks", list(spec.networks), taken)
        paths = {name: self.file(value, f"networks.{name}") for name, value in spec.networks.items()}
        self.networks = {name: network(path, name=name).data for name, path in paths.items()}
        checked_names("definitions", list(spec.definitions), taken | set(self.networks))

        self.random = {name: read_random(table, self.array, f"random.{name}") for name, table in spec.random.items()}

    def problem(self, source: Mapping[str, Any] | None) -> Problem:
        spec = self.spec
        system = self.system()
        safe = [one for k, entry in enumerate(spec.stay) for one in self.stays(entry, f"stay.{k}")]
        safe += [self.constraint(sets.Outside, entry, f"avoid.{k}") for k, entry in enumerate(spec.avoid)]
        targets = [self.constraint(sets.Reach, entry, f"reach.{k}") for k, entry in enumerate(spec.reach)]
        return Problem(
            system,
            initial=self.starts(spec.initial),
            safe=safe, unknown=list(spec.uncertain), random=self.random,
            reach=targets[0] if targets else None,
            horizon=self.number(spec.horizon, "horizon"),
            delta=self.number(spec.delta, "delta"),
            plan=self.plan(),
            cost=None if spec.cost is None else self.weights(spec.cost),
            domain=None if spec.domain is None else self.box(spec.domain.box, "domain.box", np.inf),
            leaving="unsafe" if spec.domain is None else spec.domain.leaving,
            name=spec.name, units=spec.units,
            parameters=self.parameters,
            source=source,
        )

    # numbers and functions

    def number(self, value: float | str, where: str) -> float:
        """A number, or the value of an expression in the parameters."""
        if not isinstance(value, str):
            if np.isnan(value):
                raise ValueError(f"`{where}` must be a number, got nan.")
            return float(value)
        graph = Graph(())
        node = parse(value, graph, {name: graph.const(p) for name, p in self.parameters.items()}, where)
        result = constant(graph, node)
        if result is None or not np.isfinite(result):
            raise ValueError(f"`{where}` must be finite, got {value!r} = {result}.")
        return result

    def array(self, value: Any, where: str) -> Any:
        """A number, vector or matrix of numbers or expressions in the parameters."""
        if isinstance(value, list):
            return [self.array(entry, f"{where}.{k}") for k, entry in enumerate(value)]
        return self.number(value, where)

    def matrix(self, value: Any, where: str) -> Array:
        rows = self.array(value, where)
        if isinstance(rows, list) and len({len(row) if isinstance(row, list) else 0 for row in rows}) > 1:
            raise ValueError(f"`{where}` must have rows of equal length.")
        return np.array(rows, dtype=float)

    def function(
        self, texts: Sequence[float | str], inputs: Sequence[str], where: Sequence[str], shape: tuple[int, ...]
    ) -> Tape:
        """The tape of expressions over ``inputs``, with the parameters put in and the definitions used."""
        graph = Graph(inputs)
        names: dict[str, int | Callable[[], int]] = {}
        for name in ("t", *self.states, *self.inputs, *self.disturbances):
            slot = graph.inputs.index(name) if name in graph.inputs else None
            names[name] = _forbidden(name, inputs) if slot is None else graph.input(slot)
        names |= {name: graph.const(value) for name, value in self.parameters.items()}
        for name, text in self.spec.definitions.items():
            try:
                names[name] = self._node(text, graph, names, f"definitions.{name}")
            except _ForbiddenError as error:
                names[name] = _raise(error)
        nodes = [self._node(text, graph, names, place) for text, place in zip(texts, where)]
        return graph.tape(nodes, shape)

    def _node(
        self, text: float | str, graph: Graph, names: Mapping[str, int | Callable[[], int]], where: str
    ) -> int:
        try:
            return parse(text, graph, names, where, self.networks) if isinstance(text, str) else graph.const(text)
        except _ForbiddenError as error:
            raise _ForbiddenError(f"`{where}`: {error}") from None

    def by_state(self, table: Any, where: str) -> tuple[list[Any], tuple[int, ...] | None]:
        """Entries given by state name or as a list, and the states' indices (None: all, in order)."""
        if isinstance(table, list):
            if len(table) != len(self.states):
                raise ValueError(f"`{where}` must have {len(self.states)} entries, got {len(table)}.")
            return table, None
        for key in table:
            if key not in self.states:
                known = nearest(key, self.states)
                raise ValueError(f"`{where}` must use the states' names, got {key!r}{known}")
        indices = tuple(self.states.index(key) for key in table)
        if not indices:
            raise ValueError(f"`{where}` must not be empty.")
        return list(table.values()), None if indices == tuple(range(len(self.states))) else indices

    # the system

    def system(self) -> ContinuousSystem | DiscreteSystem:
        spec = self.spec
        options: dict[str, Any] = {
            "states": self.states,
            "inputs": self.signal(spec.inputs, "inputs"),
            "disturbance": self.signal(self.bounds(), "disturbances"),
            "input_names": self.inputs or None,
            "disturbance_names": self.disturbances or None,
        }
        options |= self.diffusion() if spec.time == "continuous" else self.law()
        keys = set(spec.dynamics)
        if "A" in keys and "A" not in self.states:
            for key in keys - {"A", "B", "b", "E"}:
                raise ValueError(f"unknown key {key!r} in [dynamics]{nearest(key, ['A', 'B', 'b', 'E'])}")
            options |= {key: self.matrix(value, f"dynamics.{key}") for key, value in spec.dynamics.items()}
            return linear_system(time=spec.time, **options)
        for key in keys - set(self.states):
            raise ValueError(f"unknown key {key!r} in [dynamics]{nearest(key, self.states)}")
        for name in self.states:
            if not isinstance(spec.dynamics.get(name), (str, int, float)):
                got = spec.dynamics.get(name, "nothing")
                raise ValueError(f"`dynamics.{name}` must be an expression, got {got!r}.")
        where = [f"dynamics.{name}" for name in self.states]
        inputs = ("t", *self.states, *self.inputs, *self.disturbances)
        texts = [spec.dynamics[name] for name in self.states]
        tape = self.function(texts, inputs, where, (len(self.states),))
        return (ContinuousSystem if spec.time == "continuous" else DiscreteSystem)(tape, **options)

    def bounds(self) -> dict[str, list[Any]]:
        """Ends of the disturbances; of what is drawn, ends that leave next to nothing outside."""
        tail = _OUTSIDE * self.number(self.spec.delta, "delta")
        drawn = {name: list(law.ends(tail)) for name, law in self.random.items()}
        return {**self.spec.disturbances, **self.spec.uncertain, **drawn}

    def signal(self, table: Mapping[str, list[Any]], where: str) -> sets.Box | None:
        if not table:
            return None
        ends = np.array([self.array(pair, f"{where}.{name}") for name, pair in table.items()])
        for name, (low, high) in zip(table, ends):
            if low > high:
                raise ValueError(f"`{where}.{name}` must be [low, high], got {low:g} > {high:g}; swap the two.")
        return sets.Box(ends[:, 0], ends[:, 1])

    def diffusion(self) -> dict[str, Any]:
        table = self.spec.noise
        if table is None:
            return {}
        extra = sorted(table.model_fields_set - {"diffusion"})
        if extra or table.diffusion is None:
            raise ValueError(
                "`noise` must hold `diffusion` alone in continuous time, a matrix with "
                f"{len(self.states)} rows; got {', '.join(extra) or 'nothing'}."
            )
        value = table.diffusion
        if not isinstance(value, list):
            value = [[value]] if len(self.states) == 1 else value
        if not isinstance(value, list) or not all(isinstance(row, list) for row in value):
            return {"diffusion": self.array(value, "noise.diffusion")}
        return {"diffusion": self.expressions(value, "noise.diffusion")}

    def expressions(self, value: list[Any], name: str) -> Tape:
        """A matrix of expressions in t and the states."""
        rows: list[list[float | str]] = [list(row) for row in value if isinstance(row, list)]
        texts = [entry for row in rows for entry in row]
        shape = (len(rows), len(rows[0]))
        if len(texts) != shape[0] * shape[1] or any(len(row) != shape[1] for row in rows):
            raise ValueError(f"`{name}` must have rows of equal length.")
        where = [f"{name}.{k // shape[1]}.{k % shape[1]}" for k in range(len(texts))]
        return self.function(texts, ("t", *self.states), where, shape)

    def gain(self, value: Any, name: str) -> Array | Tape:
        """G: numbers, or expressions in t and the states."""
        if not isinstance(value, list) or not all(isinstance(row, list) for row in value):
            return self.matrix(value, name)
        tape = self.expressions(value, name)
        return tape if any(sources(tape)) else self.matrix(value, name)

    def law(self) -> dict[str, Any]:
        table = self.spec.noise
        if table is None:
            return {}
        if table.diffusion is not None or table.law not in LAWS:
            continuous = table.diffusion is not None
            cure = "; `diffusion` is for continuous time." if continuous else nearest(f"{table.law}", LAWS)
            raise ValueError(
                f"`noise.law` must be one of {', '.join(LAWS)} in discrete time, with one level and at most `matrix`, "
                f"got {table.law!r}{cure}"
            )
        build, entries = LAWS[table.law], dict(table.model_extra or {})
        flags = {key: entries.pop(key) for key in list(entries) if any(key in law.flags for law in LAWS.values())}
        tables = {key: self.array(entries.pop(key), f"noise.{key}") for key in build.tables if key in entries}
        if not entries and build.tables:
            entries = {build.levels[0]: 1.0}
        if len(entries) != 1 or not entries.keys() <= set(build.levels):
            raise ValueError(
                f"`noise` with law {table.law!r} needs exactly one of {', '.join(build.levels)}; "
                f"got {list(entries) or 'none'}."
            )
        for flag in flags.keys() - set(build.flags):
            raise ValueError(f"`noise.{flag}` must be omitted for law {table.law!r}.")
        level = {key: self.array(value, f"noise.{key}") for key, value in entries.items()}
        result: dict[str, Any] = {"noise": build(**level, **tables, **flags)}
        if table.matrix is not None:
            result["noise_matrix"] = self.gain(table.matrix, "noise.matrix")
        return result

    # the plan, the cost, the sets

    def plan(self) -> Any:
        table = self.spec.plan
        if table is None:
            return None
        if set(table) == {"file"} and "file" not in self.inputs:
            return read_plan(self.file(table["file"], "plan.file"), self.inputs)
        for key in table:
            if not self.inputs:
                raise ValueError(f"`plan.{key}` must be an input, and the file has none; give an [inputs] table.")
            if key not in self.inputs:
                raise ValueError(f"unknown key {key!r} in [plan]{nearest(key, [*self.inputs, 'file'])}")
        for name in self.inputs:
            if name not in table:
                raise ValueError(f"`plan` must give every input, {name!r} is missing.")
        where = [f"plan.{name}" for name in self.inputs]
        texts = [table[name] for name in self.inputs]
        return self.function(texts, ("t", *self.states), where, (len(self.inputs),))

    def file(self, value: Any, where: str) -> Path:
        path = Path(str(value))
        if self.folder is None or path.is_absolute() or ".." in path.parts or not isinstance(value, str):
            raise ValueError(f"`{where}` must be a file in the problem file's folder, got {value!r}.")
        return self.folder / path

    def weights(self, cost: Cost) -> tuple[Array, Array]:
        return self.matrix(cost.Q, "cost.Q"), self.matrix(cost.R, "cost.R")

    def place(self, table: Any, where: str) -> tuple[Any, tuple[int, ...] | None]:
        """A centre (a tape where it moves), and the coordinates that it is in."""
        texts, coordinates = self.by_state(table, where)
        places = [f"{where}.{k}" for k in range(len(texts))]
        return self.function(texts, ("t",), places, (len(texts),)), coordinates

    def box(self, table: Any, where: str, missing: float | None, center: Any = None) -> sets.Box:
        pairs, coordinates = self.by_state(table, where)
        indices = range(len(self.states)) if coordinates is None else coordinates
        ends = [self.array(pair, f"{where}.{self.states[k]}") for k, pair in zip(indices, pairs)]
        if missing is None and len(ends) != len(self.states):
            absent = [name for k, name in enumerate(self.states) if k not in indices]
            raise ValueError(f"`{where}` must bound every state, {', '.join(absent)} is missing.")
        low, high = np.full(len(self.states), -np.inf), np.full(len(self.states), np.inf)
        for index, pair in zip(indices, ends):
            if pair[0] > pair[1]:
                state = self.states[index]
                got = f"{pair[0]:g} > {pair[1]:g}"
                raise ValueError(f"`{where}.{state}` must be [low, high], got {got}; swap the two.")
            low[index], high[index] = pair
        return sets.Box(low, high, center=center)

    def starts(self, tables: Start | list[Start]) -> Any:
        if isinstance(tables, Start):
            return self.start(tables, "initial")
        found = [self.start(table, f"initial.{k}") for k, table in enumerate(tables)]
        points = [sets.Box(start, start) if isinstance(start, list) else start for start in found]
        return points if len(points) > 1 else points[0]

    def start(self, table: Start, where: str) -> Any:
        where = f"{where}.{table.chosen}"
        match table.chosen:
            case "point":
                values, coordinates = self.by_state(table.point, where)
                return self.array(self._ordered(values, coordinates, where), where)
            case "box":
                return self.box(table.box, where, None)
            case "gaussian":
                assert table.gaussian is not None
                mean = self.array(table.gaussian.mean, f"{where}.mean")
                covariance = self.matrix(table.gaussian.covariance, f"{where}.covariance")
                return sets.GaussianStart(mean, covariance)
        region = self.shape(getattr(table, table.chosen), table.chosen, where)
        if region.moving:
            raise ValueError(f"`{where}` must not move with t.")
        if region.coordinates is not None:
            order = np.argsort(region.coordinates)
            if len(order) != len(self.states):
                raise ValueError(f"`{where}` must give every state.")
            shape = {} if table.ellipsoid is None else {"shape": region.shape[np.ix_(order, order)]}
            return replace(region, center=region.center[order], coordinates=None, **shape)
        return region

    def _ordered(self, values: list[Any], coordinates: tuple[int, ...] | None, where: str) -> list[Any]:
        if coordinates is None:
            return values
        if len(coordinates) != len(self.states):
            raise ValueError(f"`{where}` must give every state.")
        return [values[coordinates.index(k)] for k in range(len(values))]

    def shape(self, table: Any, kind: str, where: str) -> Any:
        """A set from its table, whose entries are its fields: centres and normals by state."""
        fields: dict[str, Any] = {}
        for name, value in table:
            place = f"{where}.{name}"
            if name == "center":
                fields["center"], fields["coordinates"] = self.place(value, place)
            elif name == "normal":
                values, coordinates = self.by_state(value, place)
                fields["normal"] = np.zeros(len(self.states))
                chosen = list(range(len(self.states)) if coordinates is None else coordinates)
                fields["normal"][chosen] = self.array(values, place)
            elif isinstance(value, list):
                read = self.matrix if any(isinstance(row, list) for row in value) else self.array
                fields[name] = read(value, place)
            else:
                fields[name] = self.number(value, place)
        return _SHAPES[kind](**fields)

    def stays(self, table: Constraint, where: str) -> list[Any]:
        """Staying in an intersection is staying in each of its parts."""
        _refuse_then(table, where)
        during = None if table.during is None else self.array(table.during, f"{where}.during")
        return [sets.Inside(part, during=during, label=table.label) for part in self.parts(table, where)]

    def constraint(self, kind: Callable[..., Any], table: Constraint, where: str) -> Any:
        during = None if table.during is None else self.array(table.during, f"{where}.during")
        whole, outward = table.all is not None, kind is sets.Outside
        parts = self.parts(table, where, outward=outward)
        region = sets.intersection(parts, dimension=len(self.states), outward=outward) if whole else parts[0]
        if kind is sets.Reach:
            return kind(region, during=during, label=table.label, then=table.then)
        _refuse_then(table, where)
        return kind(region, during=during, label=table.label)

    def parts(self, table: Constraint, where: str, *, outward: bool = False) -> list[Any]:
        if table.all is None:
            return [self.region(table, f"{where}.{table.chosen}", outward=outward)]
        found = [(f"{where}.all.{k}.{part.chosen}", part) for k, part in enumerate(table.all)]
        return [self.region(part, place, outward=outward) for place, part in found]

    def polygon(self, table: PolygonTable, where: str, *, outward: bool) -> sets.Polytope:
        vertices: Any = table.vertices
        names = list(vertices) if isinstance(vertices, dict) else self.states
        if len(names) != 2 or not set(names) <= set(self.states):
            raise ValueError(f"`{where}.vertices` must give two of the states {', '.join(self.states)} by name.")
        rows = list(vertices.values()) if isinstance(vertices, dict) else vertices
        if len({len(row) for row in rows}) > 1:
            raise ValueError(f"`{where}.vertices` must have rows of equal length.")
        corners = self.matrix(rows, f"{where}.vertices")
        places = [self.states.index(name) for name in names]
        points = corners.T if isinstance(vertices, dict) else corners
        return sets.polygon(points, places=places, dimension=len(self.states), outward=outward)

    def region(self, table: Part | Constraint, where: str, *, outward: bool = False) -> Any:
        if table.polygon is not None:
            return self.polygon(table.polygon, where, outward=outward)
        if table.box is not None:
            center = None
            if table.center is not None:
                texts, coordinates = self.by_state(table.center, f"{where}.center")
                indices = range(len(self.states)) if coordinates is None else coordinates
                moves = dict(zip(indices, texts))
                full = [moves.get(k, 0.0) for k in range(len(self.states))]
                center = self.place(full, f"{where}.center")[0]
            return self.box(table.box, where, np.inf, center)
        return self.shape(getattr(table, table.chosen), table.chosen, where)


def _refuse_then(table: Constraint, where: str) -> None:
    if table.then is not None:
        raise ValueError(f"`{where}.then` must be omitted, got {table.then!r}; it says what follows in a [[reach]].")


_SHAPES: dict[str, Any] = {shape.kind: shape for name in sets.__all__ if hasattr(shape := getattr(sets, name), "kind")}


def _forbidden(name: str, inputs: Sequence[str]) -> Callable[[], int]:
    return _raise(_ForbiddenError(f"{name!r} must not be used here, only {', '.join(inputs)}"))


def _raise(error: ValueError) -> Callable[[], int]:
    def use() -> int:
        raise error

    return use
