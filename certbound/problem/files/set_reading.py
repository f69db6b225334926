"""The sets of a problem file: where it starts, stays, avoids and arrives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from certbound.checks import located
from certbound.problem import sets
from certbound.problem.files.reader import Reader
from certbound.problem.files.schema import Constraint, Part, PolygonTable, Start
from certbound.problem.model import Tape


class SetReader(Reader):
    """Regions, initial sets and constraints, from their tables."""

    def place(self, table: Any, where: str) -> tuple[Any, tuple[int, ...] | None]:
        """A centre (a tape where it moves), and the coordinates that it is in."""
        texts, coordinates = self.by_state(table, where)
        places = [f"{where}.{k}" for k in range(len(texts))]
        return self.function(texts, ("t",), places, (len(texts),)), coordinates

    def side(self, value: Any, where: str) -> Any:
        """A number; or the tape of an expression that uses t, which moves a side of a set."""
        if not isinstance(value, str):
            return self.number(value, where)
        tape = self.function([value], ("t",), [where], (1,))
        return tape if any(node.op == "input" for node in tape.nodes) else self.number(value, where)

    def box(
        self, table: Any, where: str, missing: float | None, center: Any = None, *, moves: bool = False
    ) -> sets.Box:
        pairs, coordinates = self.by_state(table, where)
        indices = range(len(self.states)) if coordinates is None else coordinates
        names = [f"{where}.{self.states[k]}" for k in indices]
        if moves:
            read = [[self.side(end, f"{name}.{k}") for k, end in enumerate(pair)] for name, pair in zip(names, pairs)]
            if any(isinstance(end, Tape) for pair in read for end in pair):
                return self.moving_box(read, indices, center)
        ends = [self.array(pair, name) for name, pair in zip(names, pairs)]
        if missing is None and coordinates is not None:
            self._complete(coordinates, where)
        low, high = np.full(len(self.states), -np.inf), np.full(len(self.states), np.inf)
        for index, pair in zip(indices, ends):
            if pair[0] > pair[1]:
                state = self.states[index]
                got = f"{pair[0]:g} > {pair[1]:g}"
                raise ValueError(f"`{where}.{state}` must be [low, high], got {got}; swap the two.")
            low[index], high[index] = pair
        if missing is None:
            low, high = low[: len(ends)], high[: len(ends)]  # without the states of filters, which stand behind
        return sets.Box(low, high, center=center)

    def moving_box(self, pairs: list[list[Any]], indices: Any, center: Any) -> sets.Box:
        """A box with sides that are functions of t."""
        low: list[Any] = [-np.inf] * len(self.states)
        high: list[Any] = [np.inf] * len(self.states)
        for index, pair in zip(indices, pairs):
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
                return self.point(*self.by_state(table.point, where), where)
            case "box":
                return self.box(table.box, where, None)
            case "gaussian":
                assert table.gaussian is not None
                mean = self.array(table.gaussian.mean, f"{where}.mean")
                if table.gaussian.covariance is None:
                    std = np.broadcast_to(self.array(table.gaussian.std, f"{where}.std"), len(mean))
                    if np.any(std < 0):
                        raise ValueError(f"`{where}.std` must not be negative, got {std.tolist()}.")
                    return sets.GaussianStart(mean, np.diag(std**2))
                covariance = self.matrix(table.gaussian.covariance, f"{where}.covariance")
                return sets.GaussianStart(mean, covariance)
        region = self.shape(getattr(table, table.chosen), table.chosen, where)
        if region.moving:
            raise ValueError(f"`{where}` must not move with t.")
        if region.coordinates is not None:
            order = np.argsort(region.coordinates)
            self._complete(region.coordinates, where)
            shape = {} if table.ellipsoid is None else {"shape": region.shape[np.ix_(order, order)]}
            return replace(region, center=region.center[order], coordinates=None, **shape)
        return region

    def point(self, values: list[Any], coordinates: tuple[int, ...] | None, where: str) -> Any:
        """A point of all states, or of all but those of filters; some of these filters may have theirs."""
        if coordinates is None:
            return self.array(values, where)
        given = dict(zip((self.states[k] for k in coordinates), self.array(values, where)))
        fixed = [one for one in self.filters.members if given.keys() & set(one.states)]
        self._complete(coordinates, where, [name for one in fixed for name in one.states])
        own = [given.pop(name) for name in self.own]
        if len(fixed) == len(self.filters.members):
            return own + [given[name] for name in self.states[len(own) :]]
        ends = {name: self.array(pair, f"inputs.{name}") for name, pair in self.spec.inputs.items()}
        return self.filters.start(sets.Box(own, own), ends, given)

    def _complete(self, coordinates: tuple[int, ...], where: str, filtered: Sequence[str] | None = None) -> None:
        """Refuse to do without a state; those of filters may all be left out, or all but the ``filtered`` ones."""
        only_own = all(k < len(self.own) for k in coordinates)
        wanted = self.own if only_own else self.states if filtered is None else (*self.own, *filtered)
        absent = [name for name in wanted if self.states.index(name) not in coordinates]
        if absent:
            raise ValueError(f"`{where}` must give every state, {', '.join(absent)} is missing.")

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
                if any(isinstance(row, list) for row in value):
                    read: Any = self.matrix(value, place)
                elif name == "A":
                    read = self.array(value, place)
                else:
                    read = [self.side(entry, f"{place}.{k}") for k, entry in enumerate(value)]
                fields[name] = self.widened(read, 1) if name == "A" else read
            else:
                fields[name] = self.side(value, place)
        with located(where, fields):
            return _SHAPES[kind](**fields)

    def stays(self, table: Constraint, where: str) -> list[Any]:
        """Staying in an intersection is staying in each of its parts."""
        _refuse_then(table, where)
        during = None if table.during is None else self.array(table.during, f"{where}.during")
        parts = self.parts(table, where)
        with located(where, ["during"]):
            return [sets.Inside(part, during=during, label=table.label) for part in parts]

    def constraint(self, kind: Callable[..., Any], table: Constraint, where: str) -> Any:
        during = None if table.during is None else self.array(table.during, f"{where}.during")
        whole, outward = table.all is not None, kind is sets.Outside
        parts = self.parts(table, where, outward=outward)
        region = sets.intersection(parts, dimension=len(self.states), outward=outward) if whole else parts[0]
        options = {"then": table.then} if kind is sets.Reach else {}
        if not options:
            _refuse_then(table, where)
        with located(where, ["during"]):
            return kind(region, during=during, label=table.label, **options)

    def parts(self, table: Constraint, where: str, *, outward: bool = False) -> list[Any]:
        if table.all is None:
            return [self.region(table, f"{where}.{table.chosen}", outward=outward)]
        found = [(f"{where}.all.{k}.{part.chosen}", part) for k, part in enumerate(table.all)]
        return [self.region(part, place, outward=outward) for place, part in found]

    def polygon(self, table: PolygonTable, where: str, *, outward: bool) -> sets.Polytope:
        vertices: Any = table.vertices
        names = list(vertices) if isinstance(vertices, dict) else self.own
        if len(names) != 2 or not set(names) <= set(self.states):
            raise ValueError(f"`{where}.vertices` must give two of the states {', '.join(self.states)} by name.")
        rows = list(vertices.values()) if isinstance(vertices, dict) else vertices
        if len({len(row) for row in rows}) > 1:
            raise ValueError(f"`{where}.vertices` must have rows of equal length.")
        corners = self.matrix(rows, f"{where}.vertices")
        places = [self.states.index(name) for name in names]
        points = corners.T if isinstance(vertices, dict) else corners
        with located(where, ["vertices"]):
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
            return self.box(table.box, where, np.inf, center, moves=True)
        return self.shape(getattr(table, table.chosen), table.chosen, where)


def _refuse_then(table: Constraint, where: str) -> None:
    if table.then is not None:
        raise ValueError(f"`{where}.then` must be omitted, got {table.then!r}; it says what follows in a [[reach]].")


_SHAPES: dict[str, Any] = {shape.kind: shape for name in sets.__all__ if hasattr(shape := getattr(sets, name), "kind")}
