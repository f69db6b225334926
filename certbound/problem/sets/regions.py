"""The shapes of sets of states.

A set may live in some of the coordinates only (``coordinates``). Its centre may move: ``center`` is then a tape over
``("t",)``, made from a function of t, and what a set says at time t, it says about its shape moved to ``center(t)``.
Its sides, radius or bounds may move too: they are tapes then, the set has no form that is the same at all times, and
what it says at time t, it says about the set that it is then (``at``).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array, Mask
from certbound.checks import assign, frozen, matrix, pick, positive_definite, vector
from certbound.problem.model import Tape, compile_numpy, trace
from certbound.problem.sets.forms import Faces, Quadratic, Region, linear_maximum
from certbound.problem.sets.moving import entries_of, read_side, read_sides, shifted

Center = Array | Tape


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


@dataclass(frozen=True, eq=False)
class Box(Region):
    """{low <= x - center <= high}, entry by entry; sides may be infinite, and low == high is a point.

    Parameters
    ----------
    low, high : array_like, shape (n,)
        Ends of the intervals; each may be a function of t, and so may the whole vector.
    center : function of t, Tape or array_like, optional
        Where the origin of ``low`` and ``high`` is; a fixed one is added to them.
    coordinates : sequence of int, optional
        State indices that the box lives in; all when omitted.

    Examples
    --------
    >>> Box([-1, 0], [1, 2]).contains([[0.5, 1.0], [0.5, 3.0]]).tolist()
    [True, False]
    >>> closing = Box([lambda t: t - 1.0], [1.0])
    >>> closing.contains([-0.5], t=0.0).item(), closing.contains([-0.5], t=0.6).item()
    (True, False)
    """

    low: Any
    high: Any
    center: Any = field(default=None, kw_only=True)
    coordinates: Any = field(default=None, kw_only=True)

    kind: ClassVar[str] = "box"

    def __post_init__(self) -> None:
        low = read_sides("low", self.low, infinite=True)
        high = read_sides("high", self.high, low.shape[0], infinite=True)
        center = None if self.center is None else _center("center", self.center, low.shape[0])
        if isinstance(low, Tape) or isinstance(high, Tape):
            low, high = shifted(low, center), shifted(high, center)
            coordinates = pick(self.coordinates, low.shape[0])
            assign(self, low=low, high=high, center=None, coordinates=coordinates)
            return
        if isinstance(center, np.ndarray):
            low, high, center = frozen(low + center), frozen(high + center), None
        if np.any(low > high):
            index = int(np.argmax(low > high))
            raise ValueError(
                f"`low` must not exceed `high`, got {low[index]:g} > {high[index]:g} in entry {index}; swap the two."
            )
        if np.any(low == np.inf) or np.any(high == -np.inf):
            raise ValueError("`low` must be below inf and `high` above -inf.")
        assign(self, low=low, high=high, center=center, coordinates=pick(self.coordinates, len(low)))

    @property
    def dimension(self) -> int:
        return int(self.low.shape[0])

    @cached_property
    def form(self) -> Faces:
        self.refuse_changing()
        eye = np.eye(len(self.low))
        upper, lower = np.isfinite(self.high), np.isfinite(self.low)
        bounds = np.concatenate([self.high[upper], -self.low[lower]])
        return Faces(frozen(np.vstack([eye[upper], -eye[lower]])), frozen(bounds), axial=True)

    @property
    def is_point(self) -> bool:
        return not self.changing and bool(np.all(self.low == self.high))

    @property
    def middle(self) -> Array:
        if self.changing:
            return self.at(0.0).middle
        return np.asarray(np.clip(0.5 * self.low + 0.5 * self.high, self.low, self.high) + self.center_at())

    @property
    def bounded(self) -> bool:
        """True when every side is finite."""
        if self.changing:
            ends = [*entries_of(self.low), *entries_of(self.high)]
            return all(isinstance(end, Tape) or np.isfinite(end) for end in ends)
        return bool(np.all(np.isfinite([self.low, self.high])))

    def contains(self, x: ArrayLike, t: float = 0.0) -> Mask:
        if self.changing:
            return self.at(t).contains(x)
        y = self.local(x) - self.center_at(t)
        return np.asarray(np.all((self.low <= y) & (y <= self.high), axis=-1))

    def local_support(self, directions: Array, t: float) -> Array:
        if self.changing:
            return self.at(t).local_support(directions, 0.0)
        ends = np.where(directions > 0, self.high, self.low)
        terms = np.where(directions == 0, 0.0, directions) * np.where(directions == 0, 0.0, ends)
        return np.asarray(np.sum(terms, axis=-1) + directions @ self.center_at(t))

    def sample(self, rng: np.random.Generator, count: int, t: float = 0.0) -> Array:
        if not self.bounded:
            raise ValueError("a box with infinite sides cannot be sampled; give finite sides.")
        if self.changing:
            return self.at(t).sample(rng, count)
        return np.asarray(self.center_at(t) + rng.uniform(self.low, self.high, (count, self.dimension)))

    def corners(self, rng: np.random.Generator, count: int) -> Array:
        return np.asarray(np.where(rng.random((count, self.dimension)) < 0.5, self.low, self.high))

    def reaches(self, point: Array, places: list[int]) -> tuple[float, float]:
        low, high = self.low[places], self.high[places]
        farthest = np.maximum(np.abs(low - point), np.abs(high - point))
        return float(np.linalg.norm(np.clip(point, low, high) - point)), float(np.linalg.norm(farthest))

    def describe(self, states: tuple[str, ...], word: str) -> str:
        used = [states[place] for place in self.places(len(states))]
        sides = zip(used, entries_of(self.low), entries_of(self.high))
        ends = sorted(sides, key=lambda end: states.index(end[0]))
        parts = [_interval(*end) for end in ends if any(map(_bounds, end[1:]))] or ["everywhere"]
        text = ", ".join(parts if len(parts) <= 4 else [*parts[:2], f"... ({len(parts)} intervals)"])
        text += " (moving)" if self.moving and not self.changing else ""
        return text if word == "inside" else f"outside {text}"

    def grown(self, distance: float) -> Box:
        self.refuse_changing()
        return replace(self, low=self.low - distance, high=self.high + distance)


@dataclass(frozen=True, eq=False)
class Ball(Region):
    """{‖x - center‖ <= radius} in some or all coordinates.

    Parameters
    ----------
    center : array_like, shape (k,), or function of t, or Tape
        Centre; a function is traced.
    radius : float, or function of t
        Not negative.
    coordinates : sequence of int, optional
        The k state indices that the ball lives in; all when omitted.
    """

    center: Any
    radius: Any
    coordinates: Any = field(default=None, kw_only=True)

    kind: ClassVar[str] = "ball"

    def __post_init__(self) -> None:
        center, radius = _center("center", self.center, None), read_side("radius", self.radius)
        if not isinstance(radius, Tape) and radius < 0:
            raise ValueError(f"`radius` must not be negative, got {radius:g}.")
        size = center.shape[0]
        assign(self, center=center, radius=radius, coordinates=pick(self.coordinates, size))

    @property
    def dimension(self) -> int:
        return int(self.center.shape[0])

    @cached_property
    def form(self) -> Quadratic:
        self.refuse_changing()
        return Quadratic(np.eye(self.dimension), self.radius)

    def describe(self, states: tuple[str, ...], word: str) -> str:
        return f"{word} the ball of radius {_side_text(self.radius)} around {self._place(states)}"

    def grown(self, distance: float) -> Ball:
        self.refuse_changing()
        return replace(self, radius=self.radius + distance)


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
        assign(self, center=center, shape=shape, coordinates=pick(self.coordinates, len(shape)))

    @cached_property
    def form(self) -> Quadratic:
        return Quadratic(self.shape, 1.0)


@dataclass(frozen=True, eq=False)
class HalfSpace(Region):
    """{normal.x <= bound}.

    Parameters
    ----------
    normal : array_like, shape (n,)
        Not all 0; any length.
    bound : float, or function of t
        Right-hand side.
    """

    normal: Any
    bound: Any

    kind: ClassVar[str] = "halfspace"
    starts: ClassVar[bool] = False
    center = None
    coordinates = None

    def __post_init__(self) -> None:
        normal, bound = vector("normal", self.normal), read_side("bound", self.bound)
        if not np.any(normal):
            raise ValueError("`normal` must not be all 0.")
        assign(self, normal=normal, bound=bound)

    @property
    def dimension(self) -> int:
        return len(self.normal)

    @cached_property
    def form(self) -> Faces:
        self.refuse_changing()
        return Faces(frozen(self.normal[None]), frozen([self.bound]))

    def local_support(self, directions: Array, t: float) -> Array:
        if self.changing:
            return self.at(t).local_support(directions, 0.0)
        scale = directions @ self.normal / (self.normal @ self.normal)
        residual = np.linalg.norm(directions - scale[..., None] * self.normal, axis=-1)
        parallel = residual <= 1e-14 * np.linalg.norm(directions, axis=-1)
        return np.where(parallel & (scale >= 0), scale * self.bound, np.inf)

    def describe(self, states: tuple[str, ...], word: str) -> str:
        text = ""
        for value, name in zip(self.normal, states):
            if value:
                sign = ("-" if value < 0 else "") if not text else (" - " if value < 0 else " + ")
                text += sign + ("" if abs(value) == 1 else f"{abs(value):g}*") + name
        return f"{text} {'<=' if word == 'inside' else '>'} {_side_text(self.bound)}"

    def grown(self, distance: float) -> HalfSpace:
        self.refuse_changing()
        return replace(self, bound=self.bound + distance * float(np.linalg.norm(self.normal)))


@dataclass(frozen=True, eq=False)
class Polytope(Region):
    """{A x <= b}.

    Parameters
    ----------
    A : array_like, shape (m, n)
        One face a row, no row all 0.
    b : array_like, shape (m,)
        Right-hand sides; each may be a function of t, and so may the whole vector.
    """

    A: Any
    b: Any

    kind: ClassVar[str] = "polytope"
    starts: ClassVar[bool] = False
    center = None
    coordinates = None

    def __post_init__(self) -> None:
        faces = matrix("A", self.A)
        if not np.all(np.any(faces != 0, axis=1)):
            raise ValueError("`A` must not have a row that is all 0.")
        assign(self, A=faces, b=read_sides("b", self.b, len(faces)))
        if not self.changing and linear_maximum(faces, self.b, np.zeros(faces.shape[1])) is None:
            raise ValueError("`A`, `b` must describe a set with a point in it, got an empty one.")

    @property
    def dimension(self) -> int:
        return int(self.A.shape[1])

    @cached_property
    def form(self) -> Faces:
        self.refuse_changing()
        return Faces(self.A, self.b)

    def describe(self, states: tuple[str, ...], word: str) -> str:
        return f"{word} a polytope of {len(self.A)} faces"

    def grown(self, distance: float) -> Polytope:
        self.refuse_changing()
        return replace(self, b=self.b + distance * np.linalg.norm(self.A, axis=1))


def _bounds(side: float | Tape) -> bool:
    """Whether a side bounds anything."""
    return isinstance(side, Tape) or bool(np.isfinite(side))


def _side_text(side: float | Tape) -> str:
    """A number, or the formula of a side that moves."""
    if not isinstance(side, Tape):
        return f"{side:g}"
    text = side.describe(side.outputs[0])
    return text[1:-1] if text.startswith("(") and _closes_last(text) else text


def _closes_last(text: str) -> bool:
    """Whether the first bracket of a formula closes at its end."""
    depth = 0
    for place, letter in enumerate(text):
        depth += (letter == "(") - (letter == ")")
        if depth == 0:
            return place == len(text) - 1
    return False


def _interval(name: str, low: float | Tape, high: float | Tape) -> str:
    if not _bounds(low) or not _bounds(high):
        return f"{name} >= {_side_text(low)}" if _bounds(low) else f"{name} <= {_side_text(high)}"
    return f"{_side_text(low)} <= {name} <= {_side_text(high)}"
