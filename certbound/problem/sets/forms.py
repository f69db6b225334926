"""What a set is to everything that reads one: half-spaces or a quadratic form about a centre that may move.

A ``Region`` says which of the two it is by its ``form``; all that is asked of a set is answered here from the form, and
a shape says better where it knows better.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array, Mask
from certbound.errors import InfeasibleError
from certbound.problem.model import Tape, arithmetic, compile_numpy
from certbound.rigor.intervals import Interval, sqrt, stack

_BALANCINGS = 8  # rounds that scale rows and columns
_SMALL = 40  # bits by which an entry that rounding left is smaller than others


@dataclass(frozen=True, eq=False)
class Faces:
    """{normals y <= bounds} of y = x - center, in the set's coordinates."""

    normals: Array  # (m, k): no row all 0; m = 0 is the whole space
    bounds: Array  # (m,): finite
    # whether every face bounds one coordinate, by an entry of 1 or -1, and no two faces have the same row: then
    # comparisons are exact, and a row tells the weights of the faces it is made of
    axial: bool = False

    round: ClassVar[bool] = False
    even: ClassVar[bool] = False

    def __post_init__(self) -> None:
        rows = {tuple(row) for row in self.normals.tolist()}
        units = {tuple(row) for row in np.vstack([np.eye(self.dimension), -np.eye(self.dimension)]).tolist()}
        if self.axial and not (rows <= units and len(rows) == len(self.normals)):
            raise ValueError("`axial` faces must bound one coordinate each, on one side each, by an entry of 1 or -1.")

    @property
    def dimension(self) -> int:
        """Number of coordinates."""
        return int(self.normals.shape[1])

    def hull(self) -> Interval:
        """A box around the set, from the faces that bound one coordinate; rounded outward."""
        low, high = np.full(self.dimension, -np.inf), np.full(self.dimension, np.inf)
        for normal, bound in zip(self.normals, self.bounds):
            places = np.flatnonzero(normal)
            if len(places) != 1:
                continue
            place, factor = int(places[0]), normal[places[0]]
            end = Interval.point(bound * factor) if self.axial else Interval.point(bound) / Interval.point(factor)
            if factor > 0:
                high[place] = min(high[place], float(end.hi))
            else:
                low[place] = max(low[place], float(end.lo))
        return Interval(low, high)

    def values(self, y: Interval) -> Interval:
        """normals y over boxes: (N, k) to (N, m); exact for axial faces."""
        if not self.axial:
            return (Interval.point(self.normals) * y[:, None, :]).sum(axis=-1)
        places, up = np.argmax(np.abs(self.normals), axis=1), self.normals.sum(axis=1) > 0
        ends = y[:, places]
        return Interval(np.where(up, ends.lo, -ends.hi), np.where(up, ends.hi, -ends.lo))


@dataclass(frozen=True, eq=False)
class Quadratic:
    """{y' shape^-1 y <= radius^2} of y = x - center, in the set's coordinates."""

    shape: Array  # (k, k): positive definite; the identity for a ball
    radius: float  # not negative

    round: ClassVar[bool] = True
    axial: ClassVar[bool] = False

    @cached_property
    def even(self) -> bool:
        """Whether it is a ball."""
        return np.array_equal(self.shape, np.eye(self.dimension))

    @property
    def dimension(self) -> int:
        """Number of coordinates."""
        return len(self.shape)

    @property
    def matrix(self) -> Array:
        """radius^2 shape: the set is {y' matrix^-1 y <= 1}."""
        return np.asarray(self.radius**2 * self.shape)

    @property
    def root(self) -> Array:
        """W with the set equal to {|W y| <= radius}, in floating point."""
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.shape)))

    @cached_property
    def test(self) -> tuple[Array, float]:
        """(W, rho) with the set equal to {|W y| <= rho}, in floating point.

        In units of the largest half-axis along a coordinate: points on the edge of an ellipsoid whose half-axes are
        floats are mostly found there.
        """
        longest = float(np.sqrt(np.diag(self.shape).max()))
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.shape) / longest)), longest * self.radius

    def hull(self) -> Interval:
        """A box around the set, rounded outward."""
        reach = Interval.point(np.full(self.dimension, self.radius))
        if not self.even:
            side = sqrt(Interval.point(np.diag(self.shape)))
            reach = side if self.radius == 1 else side * reach
        return Interval(-reach.hi, reach.hi)


Form = Faces | Quadratic


class Region:
    """What every set offers. A shape has ``form``, ``center`` and ``coordinates``, the two None where it has none."""

    center: Any
    coordinates: Any
    kind: ClassVar[str] = ""
    """Its name in problem files and certificates, whose entries are its fields; without one its form is stated."""
    starts: ClassVar[bool] = True
    """Whether it may be an initial set."""
    random: ClassVar[bool] = False
    spread: ClassVar[bool] = False
    """Whether it is a random start, and not one point all the same."""

    @cached_property
    def form(self) -> Form:
        """The set about its centre, in its coordinates.

        InfeasibleError where its sides move, so that no form is the set's at all times.
        """
        raise NotImplementedError

    @property
    def dimension(self) -> int:
        """Number of coordinates that the set lives in."""
        return self.form.dimension

    # ---- place -------------------------------------------------------------------------------------------------

    @property
    def moving(self) -> bool:
        """True when the centre, or a side, is a function of time."""
        return isinstance(self.center, Tape) or self.changing

    @cached_property
    def sides(self) -> dict[str, Tape]:
        """The sides, radius or bounds that are functions of time, by their fields' names; the centre is none."""
        found = {entry.name: getattr(self, entry.name) for entry in fields(self) if entry.name != "center"}  # type: ignore[arg-type]  # a shape is a dataclass
        return {name: value for name, value in found.items() if isinstance(value, Tape)}

    @property
    def changing(self) -> bool:
        """True when a side, the radius or a bound is a function of time."""
        return bool(self.sides)

    def refuse_changing(self) -> None:
        """InfeasibleError where sides move: who reads the set as one that rests, or that only its centre moves."""
        if self.changing:
            raise InfeasibleError(
                f"sides of a {self.kind} move with t ({', '.join(self.sides)}), which this does not serve: "
                "verify_safety, bound_exit_times and simulations do; give sides that rest, or move the centre."
            )

    def at(self, t: float) -> Self:
        """The set as it is at a time, which rests; its sides and centre are computed in plain floating point.

        ValueError where the sides describe no set then.
        """
        sides = {name: compile_numpy(tape)(t) for name, tape in self.sides.items()}
        numbers = {name: float(value[0]) if name in ("radius", "bound") else value for name, value in sides.items()}
        if isinstance(self.center, Tape):
            numbers["center"] = self.center_at(t)
        shape: Any = self
        return replace(shape, **numbers) if numbers else shape  # type: ignore[no-any-return]  # a shape is a dataclass

    @property
    def is_point(self) -> bool:
        """True when the set is a single point."""
        return False

    @property
    def middle(self) -> Array:
        """A point of the set at time 0, shape (dimension,): its centre, unless the shape says another."""
        if self.center is None:
            raise NotImplementedError(f"a {type(self).__name__} without a centre must say its `middle`.")
        return np.asarray(self.center_at(), dtype=float)

    def center_at(self, t: float = 0.0) -> Array:
        """The centre at time t, shape (dimension,); zeros for a set without one."""
        if self.center is None:
            return np.zeros(self.dimension)
        return compile_numpy(self.center)(t) if isinstance(self.center, Tape) else self.center

    def relative(self, x: Interval, t: float) -> Interval:
        """x - center at time t, in the set's coordinates."""
        return x if self.center is None else x - self._enclosed_center(t)

    def _enclosed_center(self, t: float) -> Interval:
        if not isinstance(self.center, Tape):
            return Interval.point(np.asarray(self.center, dtype=float))
        return stack(self.center.evaluate(arithmetic("interval"), [Interval.point(float(t))]))

    def extent(self) -> Interval:
        """A box around the set about its centre, rounded outward; infinite where nothing is known."""
        return self.form.hull()

    def hull(self, t: float = 0.0) -> Interval:
        """A box around the set at time t in its coordinates, rounded outward."""
        return self.extent() if self.center is None else self._enclosed_center(t) + self.extent()

    def places(self, dimension: int) -> list[int]:
        """The indices of the states that the set lives in, of ``dimension`` states."""
        return list(range(dimension) if self.coordinates is None else self.coordinates)

    def touched(self, dimension: int) -> set[int]:
        """The indices of the states, of ``dimension``, that decide whether a state lies in the set.

        Where its sides move, all of those that it lives in.
        """
        places = np.array(self.places(dimension))
        if self.changing:
            return {int(place) for place in places}
        form = self.form
        bounded = np.any(form.normals != 0, axis=0) if isinstance(form, Faces) else np.ones(len(places), dtype=bool)
        return {int(place) for place in places[bounded]}

    def lifted(self, rows: Array, dimension: int) -> Array:
        """Rows over the set's coordinates as rows over the whole state, shape (..., dimension)."""
        full = np.zeros((*rows.shape[:-1], dimension))
        full[..., self.places(dimension)] = rows
        return full

    def local(self, x: ArrayLike) -> Array:
        """The set's coordinates of states, shape (..., dimension)."""
        array = np.asarray(x, dtype=float)
        if self.coordinates is not None:
            if array.ndim == 0 or array.shape[-1] <= max(self.coordinates):
                least = max(self.coordinates) + 1
                raise ValueError(f"`x` must have {least} or more entries, got shape {array.shape}.")
            return np.asarray(array[..., list(self.coordinates)])
        if array.ndim == 0 or array.shape[-1] != self.dimension:
            raise ValueError(f"`x` must end in an axis of {self.dimension}, got shape {array.shape}.")
        return array

    # ---- points and directions ---------------------------------------------------------------------------------

    def contains(self, x: ArrayLike, t: float = 0.0) -> Mask:
        """Whether states, shape (..., n), lie in the closed set at time t."""
        if self.changing:
            return np.asarray(self.at(t).contains(x))
        return self._holds(self.local(x) - self.center_at(t))

    def _holds(self, y: Array) -> Mask:
        match self.form:
            case Quadratic() as form:
                matrix, radius = form.test
                return np.asarray(np.linalg.norm(y @ matrix.T, axis=-1) <= radius)
            case Faces() as form:
                return np.asarray(np.all(y @ form.normals.T <= form.bounds, axis=-1))

    def support(self, directions: ArrayLike, t: float = 0.0) -> Array:
        """max a.x over the set at time t, for directions a of shape (..., n); inf where unbounded."""
        raw = np.asarray(directions, dtype=float)
        value = self.local_support(self.local(raw), t)
        if self.coordinates is None:
            return value
        rest = np.delete(raw, list(self.coordinates), axis=-1)
        return np.where(np.any(rest != 0, axis=-1), np.inf, value)

    def local_support(self, directions: Array, t: float) -> Array:
        """`support` along directions of the coordinates that the set bounds."""
        if self.changing:
            return np.asarray(self.at(t).local_support(directions, 0.0))
        match self.form:
            case Quadratic() as form:
                square = np.einsum("...i,...i->...", directions, directions @ form.shape)
                reach = form.radius * (np.linalg.norm(directions, axis=-1) if form.even else np.sqrt(square))
            case Faces() as form:
                flat = directions.reshape(-1, self.dimension)
                values = [linear_maximum(form.normals, form.bounds, direction) for direction in flat]
                reach = np.array(values, dtype=float).reshape(directions.shape[:-1])
        return np.asarray(directions @ self.center_at(t) + reach)

    def reaches(self, point: Array, places: list[int]) -> tuple[float, float]:
        """Distances from a point in some states that the set surely goes down to and up to."""
        distance = float(np.linalg.norm(self.middle[places] - point))
        more = self.form.radius if isinstance(self.form, Quadratic) and self.form.even else 0.0
        return distance - more, distance + more

    def sample(self, rng: np.random.Generator, count: int, t: float = 0.0) -> Array:
        """Uniform random points, shape (count, dimension)."""
        if self.changing:
            return np.asarray(self.at(t).sample(rng, count))
        center, eye = self.center_at(t), np.eye(self.dimension)
        if isinstance(self.form, Quadratic):
            points = rng.standard_normal((count, self.dimension))
            points /= np.linalg.norm(points, axis=1, keepdims=True)
            points *= rng.uniform(size=(count, 1)) ** (1.0 / self.dimension)
            return np.asarray(center + self.form.radius * points @ np.linalg.cholesky(self.form.shape).T)
        high, low = self.local_support(eye, t) - center, -self.local_support(-eye, t) - center
        name = self.kind or type(self).__name__
        if not np.all(np.isfinite(high) & np.isfinite(low)):
            raise ValueError(f"an unbounded {name} cannot be sampled; add faces, or use a Box.")
        points = np.empty((0, self.dimension))
        for _ in range(1000):
            draw = rng.uniform(low, high, (max(4 * count, 1000), self.dimension))
            points = np.vstack([points, draw[self._holds(draw)]])
            if len(points) >= count:
                return np.asarray(center + points[:count])
        raise ValueError(f"the {name} fills too little of its bounding box to be sampled; use a Box.")

    def corners(self, rng: np.random.Generator, count: int) -> Array:
        """Random corners of the set, shape (count, dimension); none where it has none worth a try."""
        return np.empty((0, self.dimension))

    def halfspaces(self) -> tuple[Array, Array]:
        """(A, b) with the set equal to {A (x - center) <= b} in its coordinates; polyhedra only."""
        if isinstance(self.form, Quadratic):
            raise TypeError(f"a {type(self).__name__} is no polyhedron; use Box, HalfSpace or Polytope.")
        return self.form.normals, self.form.bounds

    # ---- for people and files ----------------------------------------------------------------------------------

    def describe(self, states: tuple[str, ...], word: str) -> str:
        """The set in words; ``word`` tells whether it is a place to be "inside" or "outside"."""
        match self.form:
            case Quadratic():
                return f"{word} the {self.kind or type(self).__name__} around {self._place(states)}"
            case Faces() as form:
                return f"{word} a {self.kind or type(self).__name__} of {len(form.bounds)} faces"

    def _place(self, states: tuple[str, ...]) -> str:
        numbers = ", ".join(f"{x:g}" for x in self.center_at())
        place = "a moving centre" if isinstance(self.center, Tape) else f"({numbers})"
        return place if self.coordinates is None else f"{place} in ({', '.join(states[k] for k in self.coordinates)})"

    def data(self, kinds: Collection[str]) -> dict[str, Any]:
        """What files say of it: its fields if its kind is one of ``kinds``, which they have rows for, else its form."""
        if self.kind in kinds:
            return {"kind": self.kind, **{entry.name: getattr(self, entry.name) for entry in fields(self)}}  # type: ignore[arg-type]  # a shape is a dataclass
        match self.form:
            case Quadratic() as form:
                center = self.center if self.moving else self.center_at()
                return {"kind": "ellipsoid", "center": center, "shape": form.matrix, "coordinates": self.coordinates}
            case Faces() as form:
                stated = {"kind": "polytope", "A": form.normals, "b": form.bounds}
                place = {"center": self.center, "coordinates": self.coordinates}
                return stated | {name: value for name, value in place.items() if value is not None}

    def grown(self, distance: float) -> Region:
        """The set with its boundary moved outward by at most ``distance`` (inward where negative).

        Raises
        ------
        ValueError
            If nothing is left, or the shape does not know how.
        """
        raise ValueError(f"a set of the kind {self.kind or type(self).__name__} cannot be moved outward evenly.")


def linear_maximum(faces: Array, bounds: Array, direction: Array) -> float | None:
    """max direction.x over {faces x <= bounds}: inf if unbounded, None if the set is empty.

    It is asked in units of the faces' own, since the solver takes numbers below 1e-9 for 0 and 1e-7 for nothing.
    """
    from scipy.optimize import linprog

    rows, states = _balanced(faces, bounds)
    cost = direction * states[:-1] / states[-1]
    size = float(np.abs(cost).max(initial=0.0)) or 1.0
    unit = np.where(np.any(faces != 0, axis=0), cost / size, np.sign(cost))  # without an end where no face has one
    result = linprog(
        -unit, A_ub=faces * rows[:, None] * states[:-1], b_ub=bounds * rows * states[-1], bounds=(None, None),
        method="highs",
    )  # fmt: skip
    if result.status == 2:
        return None
    return -float(result.fun or 0.0) * size if result.status == 0 else np.inf


def _balanced(faces: Array, bounds: Array) -> tuple[Array, Array]:
    """Powers of 2 for the rows (m,) and columns (k + 1,) of (faces | bounds) that bring its entries near to 1.

    In turn every row and every column is divided by the geometric mean of its least and its largest entry; then again
    without entries that are still small in their row and their column, as those are that rounding left.
    """
    with np.errstate(divide="ignore"):
        logs = np.log2(np.abs(np.column_stack([faces, bounds])))
    used = logs > -np.inf
    for _ in range(2):
        low, high = np.where(used, logs, np.inf), np.where(used, logs, -np.inf)
        free = ~used.any(axis=0)
        low[:, free] = high[:, free] = 0.0
        columns = np.zeros(logs.shape[1])
        for _ in range(_BALANCINGS):
            rows = -0.5 * ((low + columns)[:, ~free].min(axis=1) + (high + columns)[:, ~free].max(axis=1))
            columns = -0.5 * ((low + rows[:, None]).min(axis=0) + (high + rows[:, None]).max(axis=0))
            columns[free] = 0.0
        scaled = high + rows[:, None] + columns
        used &= (scaled >= scaled.max(axis=1, keepdims=True) - _SMALL) | (scaled >= scaled.max(axis=0) - _SMALL)
    return np.exp2(np.rint(np.clip(rows, -500, 500))), np.exp2(np.rint(np.clip(columns, -500, 500)))
