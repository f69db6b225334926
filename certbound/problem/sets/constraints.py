"""Constraints on the state, and random starts; the sets themselves are offered here too."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from certbound.checks import positive_definite, vector
from certbound.problem.sets.regions import Ball, Box, Ellipsoid, HalfSpace, Polytope

__all__ = ["GaussianStart", "Inside", "Outside"]

Array = NDArray[np.float64]


def _set(instance: object, **values: Any) -> None:
    for name, value in values.items():
        object.__setattr__(instance, name, value)


@dataclass(frozen=True, eq=False)
class Inside:
    """The state stays inside a region.

    Parameters
    ----------
    region : Box, Ball, Ellipsoid, HalfSpace or Polytope
        Closed set.
    during : (float, float), optional
        First and last time (step) at which the constraint holds; the whole horizon when omitted, and (T, T)
        makes it a terminal one.
    label : str, optional
        Short text for humans; made from the region when omitted.
    """

    region: Any
    during: Any = None
    label: Any = None

    word: ClassVar[str] = "inside"

    def __post_init__(self) -> None:
        if type(self.region) not in (Box, Ball, Ellipsoid, HalfSpace, Polytope):  # own classes may differ
            kinds = "Box, Ball, Ellipsoid, HalfSpace or Polytope"
            raise TypeError(f"`region` must be a {kinds} itself, got {self.region!r}; compose your set from these.")
        window = None
        if self.during is not None:
            ends = vector("during", self.during, 2)
            window = (float(ends[0]), float(ends[1]))
            if not 0 <= window[0] <= window[1]:
                raise ValueError(f"`during` must be [a, b] with 0 <= a <= b, got {list(window)}.")
        _set(self, during=window)

    def named(self, states: tuple[str, ...]) -> Any:
        """The same constraint, its label made from the states' names unless the user gave one."""
        return self if self.label is not None else replace(self, label=_describe(self, states))

    def satisfied(self, x: ArrayLike, t: float = 0.0) -> NDArray[np.bool_]:
        """Whether states, shape (..., n), satisfy the constraint at time t (its window aside)."""
        return np.asarray(self.region.contains(x, t))


@dataclass(frozen=True, eq=False)
class Outside(Inside):
    """The state stays outside a region (an obstacle); parameters as for ``Inside``."""

    word: ClassVar[str] = "outside"

    def satisfied(self, x: ArrayLike, t: float = 0.0) -> NDArray[np.bool_]:
        return np.asarray(~self.region.contains(x, t))


def _describe(constraint: Inside, states: tuple[str, ...]) -> str:
    region = constraint.region
    used = states if region.coordinates is None else tuple(states[index] for index in region.coordinates)
    center = "a moving centre" if region.moving else _listed(region.center_at())
    among = "" if region.coordinates is None else f" in ({', '.join(used)})"
    if isinstance(region, Box):
        ends = sorted(zip(used, region.low, region.high), key=lambda end: states.index(end[0]))
        parts = [_interval(*end) for end in ends if np.isfinite(end[1:]).any()] or ["everywhere"]
        text = ", ".join(parts if len(parts) <= 4 else [*parts[:2], f"... ({len(parts)} intervals)"])
        text += " (moving)" if region.moving else ""
        return text if constraint.word == "inside" else f"outside {text}"
    if isinstance(region, HalfSpace):
        sign = "<=" if constraint.word == "inside" else ">"
        return f"{_linear(region.normal, used)} {sign} {region.bound:g}"
    if isinstance(region, Ball):
        text = f"the ball of radius {region.radius:g} around {center}{among}"
    elif isinstance(region, Ellipsoid):
        text = f"the ellipsoid around {center}{among}"
    else:
        text = f"a polytope of {len(region.halfspaces()[1])} faces"
    return f"{constraint.word} {text}"


def _listed(values: Array) -> str:
    return "(" + ", ".join(f"{value:g}" for value in values) + ")"


def _interval(name: str, low: float, high: float) -> str:
    if np.isinf(low) or np.isinf(high):
        return f"{name} <= {high:g}" if np.isinf(low) else f"{name} >= {low:g}"
    return f"{low:g} <= {name} <= {high:g}"


def _linear(normal: Array, used: tuple[str, ...]) -> str:
    text = ""
    for value, name in zip(normal, used):
        if value:
            sign = ("-" if value < 0 else "") if not text else (" - " if value < 0 else " + ")
            text += sign + ("" if abs(value) == 1 else f"{abs(value):g}*") + name
    return text


@dataclass(frozen=True, eq=False)
class GaussianStart:
    """A random start X_0 ~ N(mean, covariance), independent of the noise.

    Parameters
    ----------
    mean : array_like, shape (n,)
        Mean.
    covariance : array_like, shape (n, n)
        Positive semidefinite.
    """

    mean: Any
    covariance: Any

    kind: ClassVar[str] = "gaussian"

    def __post_init__(self) -> None:
        mean = vector("mean", self.mean)
        covariance = positive_definite("covariance", self.covariance, len(mean), strict=False)
        _set(self, mean=mean, covariance=covariance)

    @property
    def dimension(self) -> int:
        """Number of states."""
        return len(self.mean)

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Random starts, shape (count, n)."""
        values, vectors = np.linalg.eigh(self.covariance)
        factor = vectors * np.sqrt(np.maximum(values, 0.0))
        return np.asarray(self.mean + rng.standard_normal((count, self.dimension)) @ factor.T)
