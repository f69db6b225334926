"""Constraints on the state, and random starts."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array, Mask
from certbound.checks import assign, positive_definite, vector
from certbound.problem.sets.forms import Faces, Region
from certbound.problem.sets.regions import Box, HalfSpace


@dataclass(frozen=True, eq=False)
class Inside:
    """The state stays inside a region.

    Parameters
    ----------
    region : Box, Ball, Ellipsoid, HalfSpace, Polytope or another Region
        Closed set: a state on its boundary is in it, safe where it is to be stayed in, failed where it is an obstacle.
    during : (float, float), optional
        First and last time (step) at which the constraint holds; the whole horizon when omitted, and (T, T)
        makes it a terminal one.
    label : str, optional
        Short text for humans; made from the region when omitted.
    """

    region: Region
    during: Any = None
    label: Any = None

    word: ClassVar[str] = "inside"
    outside: ClassVar[bool] = False
    without_edge: ClassVar[bool] = False
    """Whether a state on the boundary of the region has failed, although the region is one to stay in."""

    def __post_init__(self) -> None:
        if Region not in type(self.region).__bases__:  # a class made from a shape may mean something else
            kinds = "Box, Ball, Ellipsoid, HalfSpace or Polytope"
            raise TypeError(f"`region` must be a {kinds} itself, got {self.region!r}; compose your set from these.")
        window = None
        if self.during is not None:
            ends = vector("during", self.during, 2)
            window = (float(ends[0]), float(ends[1]))
            if not 0 <= window[0] <= window[1]:
                raise ValueError(f"`during` must be [a, b] with 0 <= a <= b, got {list(window)}.")
        assign(self, during=window)

    def named(self, states: tuple[str, ...]) -> Any:
        """The same constraint, its label made from the states' names unless the user gave one."""
        return self if self.label is not None else replace(self, label=self.region.describe(states, self.word))

    def at_first(self) -> Inside:
        """The constraint with its sides as they are when it first counts, where they move; for pictures and words."""
        return replace(self, region=self.region.at((self.during or (0.0,))[0])) if self.region.changing else self

    def satisfied(self, x: ArrayLike, t: float = 0.0) -> Mask:
        """Whether states, shape (..., n), satisfy the constraint at time t (its window aside)."""
        return np.asarray(self.region.contains(x, t) != self.outside)

    def as_stay(self) -> Inside:
        """A half-space to keep out of as the set to stay in that it leaves, anything else as it is.

        Who is in {n.x <= b} has failed, so that {-n.x < -b} is left. From below its closure does: who leaves that has
        failed. From above the last float before -b does in place of -b (`inward`), or a proof for which who touches
        the face has failed: either set lies in what is left, and failing on a larger set is no less probable. Windows
        stay as they are, and so do centers that move.
        """
        return self

    def closed(self) -> Inside:
        """The same constraint, satisfied on the boundary of its region too."""
        return self

    def inward(self, side: int, place: float) -> float:
        """A face on a lower (0) or upper side, from within: the next float inside if the set is open."""
        return place


@dataclass(frozen=True, eq=False)
class Outside(Inside):
    """The state stays outside a region (an obstacle).

    Parameters
    ----------
    region, during, label
        As for ``Inside``.
    """

    word: ClassVar[str] = "outside"
    outside: ClassVar[bool] = True

    def inward(self, side: int, place: float) -> float:
        return _next(side, place)

    def as_stay(self) -> Inside:
        region, form = self.region, self.region.form
        if not isinstance(form, Faces) or len(form.bounds) != 1:
            return self
        if isinstance(region, Box):
            low = np.where(np.isfinite(region.high), region.high, -np.inf)
            region = replace(region, low=low, high=np.where(np.isfinite(region.low), region.low, np.inf))
        else:
            region = HalfSpace(-form.normals[0], -float(form.bounds[0]))
        return Open(region, during=self.during, label=self.label)


@dataclass(frozen=True, eq=False)
class Open(Inside):
    """The state stays in the interior of a region: what a half-space to keep out of leaves."""

    without_edge: ClassVar[bool] = True

    def closed(self) -> Inside:
        return Inside(self.region, during=self.during, label=self.label)

    def inward(self, side: int, place: float) -> float:
        return _next(side, place)


def _next(side: int, place: float) -> float:
    """Who touches what is to be avoided has failed, also where no path crosses its face."""
    return float(np.nextafter(place, np.inf if side == 0 else -np.inf))


@dataclass(frozen=True, eq=False)
class Reach(Inside):
    """The state enters a region: the target of a problem, given as its ``reach``.

    A path fails if it breaks a constraint before it is in the target, or is never in it; what comes after does not
    count.

    Parameters
    ----------
    region
        As for ``Inside``.
    during : (float, float), optional
        When the target counts; the whole horizon when omitted, and (T, T) is one time.
    label : str, optional
        Short text for humans.
    then : str, optional
        "stay": from its first entry the state stays in the target until the horizon, or fails (discrete time). Without
        it what comes after does not count.
    """

    then: Any = None

    word: ClassVar[str] = "reach"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.then not in (None, "stay"):
            raise ValueError(f'`then` must be "stay" or omitted, got {self.then!r}.')

    @property
    def stays(self) -> bool:
        """Whether the target is not to be left again."""
        return self.then is not None

    def named(self, states: tuple[str, ...]) -> Any:
        if self.label is not None:
            return self
        where = self.region.describe(states, "inside").removeprefix("inside ")
        return replace(self, label=f"reach {'and stay ' if self.stays else ''}{where}")


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

    random: ClassVar[bool] = True
    is_point: ClassVar[bool] = False

    def __post_init__(self) -> None:
        mean = vector("mean", self.mean)
        covariance = positive_definite("covariance", self.covariance, len(mean), strict=False)
        assign(self, mean=mean, covariance=covariance)

    @property
    def dimension(self) -> int:
        """Number of states."""
        return len(self.mean)

    @property
    def spread(self) -> bool:
        """Whether it varies at all."""
        return bool(np.any(self.covariance))

    @property
    def middle(self) -> Array:
        """The mean."""
        return np.asarray(self.mean)

    def data(self, kinds: Collection[str]) -> dict[str, Any]:
        """What files say of it."""
        return {"kind": "gaussian", "mean": self.mean, "covariance": self.covariance}

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Random starts, shape (count, n)."""
        values, vectors = np.linalg.eigh(self.covariance)
        factor = vectors * np.sqrt(np.maximum(values, 0.0))
        return np.asarray(self.mean + rng.standard_normal((count, self.dimension)) @ factor.T)
