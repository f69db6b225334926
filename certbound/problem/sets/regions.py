"""Sets of states.

A set may live in some of the coordinates only (``coordinates``); its centre may move: ``center`` is then a
tape over ``("t",)``, made from a function of t. What a set says at time t, it says about its shape moved to
``center(t)``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from certbound.checks import frozen, matrix, number, pick, positive_definite, vector
from certbound.problem.model import Tape, compile_numpy, trace

__all__ = ["Ball", "Box", "Ellipsoid", "HalfSpace", "Polytope", "Region"]

Array = NDArray[np.float64]
Center = Array | Tape


class Region:
    """What every set offers."""

    center: Any
    coordinates: Any
    kind: ClassVar[str] = "region"

    @property
    def dimension(self) -> int:
        """Number of coordinates that the set lives in."""
        raise NotImplementedError

    @property
    def moving(self) -> bool:
        """True when the centre is a function of time."""
        return isinstance(self.center, Tape)

    def center_at(self, t: float = 0.0) -> Array:
        """The centre at time t, shape (dimension,); zeros for a set without one."""
        if self.center is None:
            return np.zeros(self.dimension)
        return compile_numpy(self.center)(t) if isinstance(self.center, Tape) else self.center

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

    def contains(self, x: ArrayLike, t: float = 0.0) -> NDArray[np.bool_]:
        """Whether states, shape (..., n), lie in the closed set at time t."""
        raise NotImplementedError

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
        raise NotImplementedError

    def sample(self, rng: np.random.Generator, count: int, t: float = 0.0) -> Array:
        """Uniform random points, shape (count, dimension)."""
        raise NotImplementedError

    def halfspaces(self) -> tuple[Array, Array]:
        """(A, b) with the set equal to {A (x - center) <= b} in its coordinates; polyhedra only."""
        raise TypeError(f"a {type(self).__name__} is no polyhedron; use Box, HalfSpace or Polytope.")


def _center(name: str, value: Any, length: int | None) -> Center:
    """A fixed centre, or the tape of a moving one."""
    if not isinstance(value, Tape) and not callable(value):
        return vector(name, value, length)
    tape = value if isinstance(value, Tape) else trace(value, {"t": ["t"]})
    if tape.inputs != ("t",) or len(tape.shape) != 1:
        raise ValueError(f"`{name}` must be a vector over ('t',), got shape {tape.shape} over {tape.inputs}.")
    if length is not None and tape.shape != (length,):
        raise ValueError(f"`{name}` must have {length} entries, got shape {tape.shape}.")
    if all(node.op != "input" for node in tape.nodes):
        return frozen(compile_numpy(tape)(0.0))
    return tape


def _set(instance: object, **values: Any) -> None:
    for name, value in values.items():
        object.__setattr__(instance, name, value)


@dataclass(frozen=True, eq=False)
class Box(Region):
    """{low <= x - center <= high}, entry by entry; sides may be infinite, and low == high is a point.

    Parameters
    ----------
    low, high : array_like, shape (n,)
        Ends of the intervals.
    center : function of t, Tape or array_like, optional
        Where the origin of ``low`` and ``high`` is; a fixed one is added to them.
    coordinates : sequence of int, optional
        State indices that the box lives in; all when omitted.

    Examples
    --------
    >>> Box([-1, 0], [1, 2]).contains([[0.5, 1.0], [0.5, 3.0]]).tolist()
    [True, False]
    """

    low: Any
    high: Any
    center: Any = field(default=None, kw_only=True)
    coordinates: Any = field(default=None, kw_only=True)

    kind: ClassVar[str] = "box"

    def __post_init__(self) -> None:
        low = vector("low", self.low, infinite=True)
        high = vector("high", self.high, len(low), infinite=True)
        center = None if self.center is None else _center("center", self.center, len(low))
        if isinstance(center, np.ndarray):
            low, high, center = frozen(low + center), frozen(high + center), None
        if np.any(low > high):
            index = int(np.argmax(low > high))
            raise ValueError(
                f"`low` must not exceed `high`, got {low[index]:g} > {high[index]:g} in entry {index}; swap the two."
            )
        if np.any(low == np.inf) or np.any(high == -np.inf):
            raise ValueError("`low` must be below inf and `high` above -inf.")
        _set(self, low=low, high=high, center=center, coordinates=pick(self.coordinates, len(low)))

    @property
    def dimension(self) -> int:
        return len(self.low)

    @property
    def bounded(self) -> bool:
        """True when every side is finite."""
        return bool(np.all(np.isfinite(self.low)) and np.all(np.isfinite(self.high)))

    def contains(self, x: ArrayLike, t: float = 0.0) -> NDArray[np.bool_]:
        y = self.local(x) - self.center_at(t)
        return np.asarray(np.all((self.low <= y) & (y <= self.high), axis=-1))

    def local_support(self, directions: Array, t: float) -> Array:
        ends = np.where(directions > 0, self.high, self.low)
        terms = np.where(directions == 0, 0.0, directions) * np.where(directions == 0, 0.0, ends)
        return np.asarray(np.sum(terms, axis=-1) + directions @ self.center_at(t))

    def sample(self, rng: np.random.Generator, count: int, t: float = 0.0) -> Array:
        if not self.bounded:
            raise ValueError("a box with infinite sides cannot be sampled; give finite sides.")
        return np.asarray(self.center_at(t) + rng.uniform(self.low, self.high, (count, self.dimension)))

    def halfspaces(self) -> tuple[Array, Array]:
        eye = np.eye(self.dimension)
        upper, lower = np.isfinite(self.high), np.isfinite(self.low)
        return (
            frozen(np.vstack([eye[upper], -eye[lower]])),
            frozen(np.concatenate([self.high[upper], -self.low[lower]])),
        )


@dataclass(frozen=True, eq=False)
class Ball(Region):
    """{‖x - center‖ <= radius} in some or all coordinates.

    Parameters
    ----------
    center : array_like, shape (k,), or function of t, or Tape
        Centre; a function is traced.
    radius : float
        Not negative.
    coordinates : sequence of int, optional
        The k state indices that the ball lives in; all when omitted.
    """

    center: Any
    radius: Any
    coordinates: Any = field(default=None, kw_only=True)

    kind: ClassVar[str] = "ball"

    def __post_init__(self) -> None:
        center, radius = _center("center", self.center, None), number("radius", self.radius)
        if radius < 0:
            raise ValueError(f"`radius` must not be negative, got {radius:g}.")
        size = center.shape[0]
        _set(self, center=center, radius=radius, coordinates=pick(self.coordinates, size))

    @property
    def dimension(self) -> int:
        return int(self.center.shape[0])

    def contains(self, x: ArrayLike, t: float = 0.0) -> NDArray[np.bool_]:
        return np.asarray(np.linalg.norm(self.local(x) - self.center_at(t), axis=-1) <= self.radius)

    def local_support(self, directions: Array, t: float) -> Array:
        return np.asarray(directions @ self.center_at(t) + self.radius * np.linalg.norm(directions, axis=-1))

    def sample(self, rng: np.random.Generator, count: int, t: float = 0.0) -> Array:
        return np.asarray(self.center_at(t) + self.radius * _in_unit_ball(rng, count, self.dimension))


@dataclass(frozen=True, eq=False)
class Ellipsoid(Region):
    """{(x - center)' shape^-1 (x - center) <= 1} in some or all coordinates.

    Parameters
    ----------
    center : array_like, shape (k,), or function of t, or Tape
        Centre; a function is traced.
    shape : array_like, shape (k, k)
        Positive definite; diag(r_i^2) has half-axes r_i.
    coordinates : sequence of int, optional
        The k state indices that the ellipsoid lives in; all when omitted.
    """

    center: Any
    shape: Any
    coordinates: Any = field(default=None, kw_only=True)

    kind: ClassVar[str] = "ellipsoid"

    def __post_init__(self) -> None:
        shape = positive_definite("shape", self.shape)
        center = _center("center", self.center, len(shape))
        _set(self, center=center, shape=shape, coordinates=pick(self.coordinates, len(shape)))

    @property
    def dimension(self) -> int:
        return len(self.shape)

    def contains(self, x: ArrayLike, t: float = 0.0) -> NDArray[np.bool_]:
        y = self.local(x) - self.center_at(t)
        return np.asarray(np.einsum("...i,...i->...", y, y @ np.linalg.inv(self.shape)) <= 1.0)

    def local_support(self, directions: Array, t: float) -> Array:
        spread = np.sqrt(np.einsum("...i,...i->...", directions, directions @ self.shape))
        return np.asarray(directions @ self.center_at(t) + spread)

    def sample(self, rng: np.random.Generator, count: int, t: float = 0.0) -> Array:
        points = _in_unit_ball(rng, count, self.dimension)
        return np.asarray(self.center_at(t) + points @ np.linalg.cholesky(self.shape).T)


def _in_unit_ball(rng: np.random.Generator, count: int, dimension: int) -> Array:
    points = rng.standard_normal((count, dimension))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return np.asarray(points * rng.uniform(size=(count, 1)) ** (1.0 / dimension))


@dataclass(frozen=True, eq=False)
class HalfSpace(Region):
    """{normal.x <= bound}.

    Parameters
    ----------
    normal : array_like, shape (n,)
        Not all 0; any length.
    bound : float
        Right-hand side.
    """

    normal: Any
    bound: Any

    kind: ClassVar[str] = "halfspace"
    center = None
    coordinates = None

    def __post_init__(self) -> None:
        normal, bound = vector("normal", self.normal), number("bound", self.bound)
        if not np.any(normal):
            raise ValueError("`normal` must not be all 0.")
        _set(self, normal=normal, bound=bound)

    @property
    def dimension(self) -> int:
        return len(self.normal)

    def contains(self, x: ArrayLike, t: float = 0.0) -> NDArray[np.bool_]:
        return np.asarray(self.local(x) @ self.normal <= self.bound)

    def local_support(self, directions: Array, t: float) -> Array:
        scale = directions @ self.normal / (self.normal @ self.normal)
        residual = np.linalg.norm(directions - scale[..., None] * self.normal, axis=-1)
        parallel = residual <= 1e-14 * np.linalg.norm(directions, axis=-1)
        return np.where(parallel & (scale >= 0), scale * self.bound, np.inf)

    def sample(self, rng: np.random.Generator, count: int, t: float = 0.0) -> Array:
        raise ValueError("a half-space is unbounded and cannot be sampled; use a Box.")

    def halfspaces(self) -> tuple[Array, Array]:
        return frozen(self.normal[None]), frozen([self.bound])


@dataclass(frozen=True, eq=False)
class Polytope(Region):
    """{A x <= b}.

    Parameters
    ----------
    A : array_like, shape (m, n)
        One face a row, no row all 0.
    b : array_like, shape (m,)
        Right-hand sides.
    """

    A: Any
    b: Any

    kind: ClassVar[str] = "polytope"
    center = None
    coordinates = None

    def __post_init__(self) -> None:
        faces = matrix("A", self.A)
        if not np.all(np.any(faces != 0, axis=1)):
            raise ValueError("`A` must not have a row that is all 0.")
        _set(self, A=faces, b=vector("b", self.b, len(faces)))
        if _linear_maximum(faces, self.b, np.zeros(faces.shape[1])) is None:
            raise ValueError("`A`, `b` must describe a set with a point in it, got an empty one.")

    @property
    def dimension(self) -> int:
        return int(self.A.shape[1])

    def contains(self, x: ArrayLike, t: float = 0.0) -> NDArray[np.bool_]:
        return np.asarray(np.all(self.local(x) @ self.A.T <= self.b, axis=-1))

    def local_support(self, directions: Array, t: float) -> Array:
        flat = directions.reshape(-1, self.dimension)
        values = [_linear_maximum(self.A, self.b, direction) for direction in flat]
        return np.array(values, dtype=float).reshape(directions.shape[:-1])

    def sample(self, rng: np.random.Generator, count: int, t: float = 0.0) -> Array:
        eye = np.eye(self.dimension)
        high, low = self.support(eye), np.negative(self.support(-eye))
        if not np.all(np.isfinite(high) & np.isfinite(low)):
            raise ValueError("an unbounded polytope cannot be sampled; add faces.")
        points = np.empty((0, self.dimension))
        for _ in range(1000):
            draw = rng.uniform(low, high, (max(4 * count, 1000), self.dimension))
            points = np.vstack([points, draw[self.contains(draw)]])
            if len(points) >= count:
                return np.asarray(points[:count])
        raise ValueError("the polytope fills too little of its bounding box to be sampled; use a Box.")

    def halfspaces(self) -> tuple[Array, Array]:
        return self.A, self.b


def _linear_maximum(faces: Array, bounds: Array, direction: Array) -> float | None:
    """max direction.x over {faces x <= bounds}: inf if unbounded, None if the set is empty."""
    from scipy.optimize import linprog

    result = linprog(-direction, A_ub=faces, b_ub=bounds, bounds=(None, None), method="highs")
    if result.status == 2:
        return None
    return -float(result.fun or 0.0) if result.status == 0 else np.inf
