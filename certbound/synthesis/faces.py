"""Constraints as smooth functions of the nominal state: what multiple shooting, rechecks and the filter read.

A *face* is a function h(t, z) that is at least 0 where its constraint holds, with the rows a along which a deviation
S of the state costs at most a . S. A tube takes e = sup a . S from it, so that h(t, z) >= e keeps z + S safe:

- a half-space a . z <= b: h = b - a . z, row a;
- outside a ball or an ellipsoid {||M (z - o)|| <= size}: h = ||M (z - o)|| - size, and the row -M^T n with n the unit
  vector of M (z - o), which separates the convex obstacle;
- inside one: h = size - ||M (z - o)||, the erosion taken over all unit vectors;
- outside a polyhedron {A z <= b}: h_i = a_i . z - b_i for each facet, of which one must reach its own erosion.

Everything is in floating point: a verdict proves the result again. Source: Thm 1 and Prop 4 (paper).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array, Mask
from certbound.problem.adapters import to_casadi
from certbound.problem.model import Tape, compile_numpy
from certbound.problem.problem import Problem
from certbound.problem.sets import Inside, Quadratic

_ANGLES = 24


@dataclass(frozen=True, eq=False, kw_only=True)
class Face:
    """What every face offers."""

    label: str  # of its constraint, for humans
    constraint: int  # index into ``problem.constraints``
    during: tuple[float, float] | None  # when it is asked
    dimension: int  # of the state
    coordinates: tuple[int, ...]  # state indices that the set lives in
    center: Any  # where the set's origin is

    @property
    def weights(self) -> int:
        """Number of multipliers that choose among the parts of a union (0: none)."""
        return 0

    @property
    def parts(self) -> int:
        """Number of erosions that the face takes."""
        return 1

    def asked(self, times: Array) -> Mask:
        """Whether the constraint is asked at each time."""
        if self.during is None:
            return np.ones(len(times), dtype=bool)
        slack = 1e-9 * max(1.0, self.during[1])
        return np.asarray((times >= self.during[0] - slack) & (times <= self.during[1] + slack))

    def rows(self, states: Array, times: Array) -> Array:
        """Rows along which a deviation counts, shape (K, R, n), at states (K, n)."""
        raise NotImplementedError

    def erosion(self, extents: Array) -> Array:
        """Erosions (K, parts) from the tube's extents along ``rows``, shape (K, R)."""
        return extents

    def room(self, states: Array, times: Array, erosion: ArrayLike = 0.0) -> Array:
        """h - e, shape (K,), at states (K, n) for erosions (K, parts)."""
        raise NotImplementedError

    def gap(self, ca: Any, state: Any, time: Any, erosion: Any, weights: Any) -> Any:
        """h - e as a CasADi expression; for a union, the weighted sum over its parts."""
        raise NotImplementedError

    def local(self, states: Array, times: Array) -> Array:
        """Coordinates relative to the centre, shape (K, q)."""
        chosen = states[:, list(self.coordinates)]
        if isinstance(self.center, Tape):
            return np.asarray(chosen - compile_numpy(self.center)(times))
        return np.asarray(chosen - self.center)

    def relative(self, ca: Any, state: Any, time: Any) -> Any:
        """Coordinates relative to the centre as a CasADi expression."""
        chosen = ca.vertcat(*[state[i] for i in self.coordinates])
        if isinstance(self.center, Tape):
            return chosen - to_casadi(self.center, [time])
        return chosen - ca.DM(np.asarray(self.center))

    def _taken(self, states: Array, erosion: ArrayLike) -> Array:
        """Erosions (K, parts)."""
        return np.broadcast_to(np.asarray(erosion, dtype=float), (len(states), self.parts))

    def _embedded(self, rows: Array) -> Array:
        """Rows over the set's coordinates as rows over the whole state."""
        full = np.zeros((*rows.shape[:-1], self.dimension))
        full[..., list(self.coordinates)] = rows
        return full


@dataclass(frozen=True, eq=False, kw_only=True)
class Plane(Face):
    """normal . (z - o) <= bound."""

    normal: Array
    bound: float

    @property
    def row(self) -> Array:
        """The normal over the whole state."""
        return self._embedded(self.normal)

    def rows(self, states: Array, times: Array) -> Array:
        return np.broadcast_to(self.row, (len(states), 1, self.dimension))

    def room(self, states: Array, times: Array, erosion: ArrayLike = 0.0) -> Array:
        return np.asarray(self.bound - self.local(states, times) @ self.normal - self._taken(states, erosion)[:, 0])

    def gap(self, ca: Any, state: Any, time: Any, erosion: Any, weights: Any) -> Any:
        return self.bound - ca.dot(ca.DM(self.normal), self.relative(ca, state, time)) - erosion[0]


@dataclass(frozen=True, eq=False, kw_only=True)
class Round(Face):
    """||matrix (z - o)|| <= size (``outside``: >= size)."""

    matrix: Array
    size: float
    outside: bool

    def rows(self, states: Array, times: Array) -> Array:
        count = len(self.coordinates)
        if self.outside:
            image = self.local(states, times) @ self.matrix.T
            length = np.linalg.norm(image, axis=1, keepdims=True)
            unit = np.where(length > 0, image / np.maximum(length, 1e-300), np.eye(count)[0])
            return self._embedded(-(unit @ self.matrix)[:, None, :])
        if count == 2:
            angles = 2 * np.pi * np.arange(_ANGLES) / _ANGLES
            units = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        else:
            units = np.concatenate([np.eye(count), -np.eye(count)])
        full = self._embedded(units @ self.matrix)
        return np.broadcast_to(full, (len(states), *full.shape))

    def erosion(self, extents: Array) -> Array:
        if self.outside:
            return extents
        count = len(self.coordinates)
        factor = 1.0 if count == 1 else 1 / np.cos(np.pi / _ANGLES) if count == 2 else np.sqrt(count)
        return np.asarray(extents.max(axis=1, keepdims=True) * factor)

    def room(self, states: Array, times: Array, erosion: ArrayLike = 0.0) -> Array:
        value = np.linalg.norm(self.local(states, times) @ self.matrix.T, axis=1) - self.size
        return np.asarray((value if self.outside else -value) - self._taken(states, erosion)[:, 0])

    def gap(self, ca: Any, state: Any, time: Any, erosion: Any, weights: Any) -> Any:
        image = ca.DM(self.matrix) @ self.relative(ca, state, time)
        # smooth at the centre, where a plan with the most room inside may lie: too large a distance, by little
        smooth = (1e-6 if self.outside else 1e-2) * self.size
        value = ca.sqrt(ca.sumsqr(image) + smooth**2 + 1e-24) - self.size
        return (value if self.outside else -value) - erosion[0]


@dataclass(frozen=True, eq=False, kw_only=True)
class Facets(Face):
    """Outside the polyhedron {normals (z - o) <= bounds}: some facet is passed."""

    normals: Array
    bounds: Array

    @property
    def weights(self) -> int:
        return len(self.bounds)

    @property
    def parts(self) -> int:
        return len(self.bounds)

    def rows(self, states: Array, times: Array) -> Array:
        full = self._embedded(-self.normals)
        return np.broadcast_to(full, (len(states), *full.shape))

    def room(self, states: Array, times: Array, erosion: ArrayLike = 0.0) -> Array:
        return np.asarray(np.max(self.values(states, times, erosion), axis=1))

    def values(self, states: Array, times: Array, erosion: ArrayLike = 0.0) -> Array:
        """By how much every facet is passed, (K, facets)."""
        return self.local(states, times) @ self.normals.T - self.bounds - self._taken(states, erosion)

    def best(self, states: Array, times: Array, erosion: ArrayLike = 0.0) -> Array:
        """Weights (K, facets) that choose the facet with the most room."""
        return np.asarray(np.eye(self.parts)[np.argmax(self.values(states, times, erosion), axis=1)])

    def gap(self, ca: Any, state: Any, time: Any, erosion: Any, weights: Any) -> Any:
        value = ca.DM(self.normals) @ self.relative(ca, state, time) - ca.DM(self.bounds) - erosion
        return ca.dot(weights, value)


def faces_of(problem: Problem) -> tuple[Face, ...]:
    """Every constraint of a problem (its domain last) as faces; infinite sides of boxes make none."""
    found: list[Face] = []
    for index, constraint in enumerate(problem.constraints):
        found += _faces(constraint, index, problem.system.dimension)
    return tuple(found)


def with_parts(faces: Iterable[Face]) -> Iterator[tuple[Face, slice]]:
    """Every face, and its place among the parts of all."""
    first = 0
    for face in faces:
        yield face, slice(first, first + face.parts)
        first += face.parts


def _faces(constraint: Inside, index: int, dimension: int) -> list[Face]:
    region, outside = constraint.region, constraint.outside
    places = tuple(region.places(dimension))
    common: dict[str, Any] = {
        "constraint": index, "during": constraint.during, "dimension": dimension, "coordinates": places,
        "center": np.zeros(len(places)) if region.center is None else region.center,
    }  # fmt: skip
    label = str(constraint.label)
    if isinstance(region.form, Quadratic):
        matrix = region.form.root
        unit = 1.0 / float(np.linalg.norm(matrix, 2))  # a Euclidean length, for people and for scaling
        size = float(region.form.radius) * unit
        return [Round(label=label, matrix=matrix * unit, size=size, outside=outside, **common)]
    normals, bounds = region.form.normals, region.form.bounds
    if outside and len(bounds) > 1:
        return [Facets(label=label, normals=normals, bounds=bounds, **common)]
    sign = -1.0 if outside else 1.0
    several = len(bounds) > 1
    return [
        Plane(
            label=f"{label} [side {i + 1}]" if several else label, normal=sign * normals[i],
            bound=float(sign * bounds[i]), **common,
        )
        for i in range(len(bounds))
    ]  # fmt: skip
