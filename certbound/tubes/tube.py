"""The record that every tube formula returns: P(||S_t||_P <= r_t for all t in [0, T]) >= 1 - delta."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, Protocol

import numpy as np
from flint import arb, arb_mat
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.display import Shown, log10_text, rounded
from certbound.rigor.balls import lower, precision, upper
from certbound.tubes.constants import Constants


class Profile(Protocol):
    """A radius as a function of time; one implementation per family of formulas."""

    @property
    def times(self) -> Array:
        """Piece ends: the radius may jump there and is continuous inside."""

    def radius(self, t: Array) -> Array:
        """Floating-point radius at times inside the horizon."""

    def stretch(self, piece: int, start: float, end: float) -> tuple[float, float]:
        """Rigorous bounds (of the supremum over [start, end] inside one piece, of the radius at ``end``)."""

    def rough(self, piece: int, start: float, end: float) -> float:
        """Quicker upper bound of the same supremum (inf where there is none)."""

    def to_dict(self) -> dict[str, Any]:
        """Everything needed to evaluate the radius again, as plain data."""


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Tube(Shown):
    """A probabilistic tube around the associated trajectory.

    The inequality is P(||S_t||_P <= r_t for all t in [0, T]) >= 1 - delta for ``level`` ``"trajectory"``, and
    P(||S_t||_P <= r_t) >= 1 - delta at each single t for ``"one time"``.

    Parameters
    ----------
    method : str
        Formula, as named in :func:`certbound.tune_tube`.
    parameters : dict
        Its free parameters, as used.
    level : str
        ``"trajectory"`` or ``"one time"``.
    certified : bool
        True when the level is ``"trajectory"`` and the formula was evaluated rigorously *given the constants*.
        Whether the constants themselves are proved stands in ``constants.certified``: stated constants are an
        assumption, which a verdict names.
    delta, horizon, constants, objective
        What was asked.
    profile : Profile
        The radius as a function of time.
    bounded : Profile, optional
        An almost-sure bound; the radius is the pointwise minimum with it.

    Source: Def. 2 (paper); Sec. 4 of docs/theory.md.
    """

    pictured: ClassVar[bool] = True

    method: str
    parameters: dict[str, Any]
    level: str
    certified: bool
    delta: float
    horizon: float
    constants: Constants
    objective: Any
    profile: Profile = field(repr=False)
    bounded: Profile | None = field(default=None, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

    @property
    def log10_delta(self) -> float:
        """Upper bound of log10(delta)."""
        return log10_upper(self.delta)

    @cached_property
    def maximum(self) -> float:
        """Rigorous upper bound of the largest radius over [0, T]."""
        return float(self.bound(0.0, self.horizon))

    def radius(self, t: ArrayLike) -> Any:
        """Radius r_t (floating point, in the norm of the metric); scalar or array, in the shape of ``t``.

        In discrete time ``t`` must be whole steps. No erosion is owed at t = 0, where S_0 = 0.
        """
        times = self._checked("t", t)
        result = self.profile.radius(times)
        if self.bounded is not None:
            result = np.minimum(result, self.bounded.radius(times))
        return float(result) if times.ndim == 0 else result

    def bound(self, t0: ArrayLike, t1: ArrayLike) -> Any:
        """Upper bound of sup r_t over [t0, t1], evaluated in ball arithmetic and rounded up.

        In discrete time the supremum runs over the whole steps in [t0, t1] (0 when there is none).
        """
        begin, end = np.broadcast_arrays(self._checked("t0", t0, whole=False), self._checked("t1", t1, whole=False))
        if np.any(begin > end):
            raise ValueError("`t0` must not exceed `t1`.")
        flat = [self._sup(float(a), float(b)) for a, b in zip(begin.ravel(), end.ravel())]
        return flat[0] if begin.ndim == 0 else np.array(flat).reshape(begin.shape)

    def extent(self, directions: ArrayLike, t: ArrayLike) -> Any:
        """Erosion r_t sqrt(a^T P^-1 a) of half-spaces a^T x <= b, rounded up.

        ``directions`` has shape (..., n), ``t`` any shape; the result has shape (*t.shape, ...).
        """
        factor = metric_factor(self.constants, directions)
        times = self._checked("t", t)
        size = np.multiply.outer(np.asarray(self.bound(times, times)), factor)
        result = np.nextafter(size, np.inf)
        return float(result) if result.ndim == 0 else result

    def summary(self) -> str:
        """The tube in one line."""
        unit = "s" if self.constants.continuous else "steps"
        size = f"radius at most {rounded(self.maximum, up=True)} within {self.horizon:g} {unit}"
        return f"{self.method}, {size}, delta {log10_text(self.log10_delta, ulps=2)}, {self.level} level"

    def rows(self) -> list[tuple[str, str]]:
        """Parameters, and what the tube rests on."""
        found = [(name, f"{value:.6g}") for name, value in self.parameters.items() if isinstance(value, float)]
        formula = "evaluated rigorously" if self.certified else "not certified"
        return [*found, ("formula", formula), ("constants", self.constants.summary())]

    def to_columns(self, times: ArrayLike | None = None) -> dict[str, Array]:
        """Columns ``time`` and ``radius``, as ``pandas.DataFrame`` takes them.

        Parameters
        ----------
        times : array_like, optional
            Times; 201 equal ones, or every step, when omitted.
        """
        if times is None:
            times = np.linspace(0, self.horizon, 201) if self.constants.continuous else np.arange(self.horizon + 1)
        chosen = np.atleast_1d(np.asarray(times, dtype=float))
        return {"time": chosen, "radius": np.asarray(self.radius(chosen))}

    def to_dict(self) -> dict[str, Any]:
        """Plain data: what was claimed, and everything needed to evaluate the radius again."""
        constants = self.constants
        return {
            "method": self.method,
            "parameters": {key: _plain(value) for key, value in self.parameters.items()},
            "level": self.level,
            "certified": self.certified,
            "delta": self.delta,
            "log10_delta": self.log10_delta,
            "horizon": self.horizon,
            "objective": _plain(self.objective),
            "constants": {
                name: _plain(getattr(constants, name))
                for name in (
                    "rate", "gain", "sigma", "dimension", "effective_dimension", "metric", "isotropic", "gaussian",
                    "times", "certified",
                )
            },
            "profile": self.profile.to_dict(),
            "bounded": None if self.bounded is None else self.bounded.to_dict(),
        }  # fmt: skip

    def _checked(self, name: str, value: ArrayLike, *, whole: bool = True) -> Array:
        times = np.asarray(value, dtype=float)
        if not np.all((times >= 0) & (times <= self.horizon)):
            raise ValueError(f"`{name}` must lie in [0, {self.horizon}], got {value!r}.")
        if whole and not self.constants.continuous and np.any(times != np.round(times)):
            raise ValueError(f"`{name}` must be whole steps in discrete time, got {value!r}.")
        return times

    def _sup(self, start: float, end: float) -> float:
        if not self.constants.continuous:
            start, end = math.ceil(start), math.floor(end)
            if start > end:
                return 0.0
        result = supremum(self.profile, start, end, whole=not self.constants.continuous)
        if self.bounded is not None:
            result = min(result, supremum(self.bounded, start, end, whole=not self.constants.continuous))
        return result


def supremum(profile: Profile, start: float, end: float, *, whole: bool, gap: float = 1e-4) -> float:
    """Rigorous upper bound of the supremum of a profile over [start, end], within ``gap`` where it is cheap.

    A profile may set ``splits`` (64 halvings), which limits the effort.
    """
    times = profile.times
    first = int(np.clip(np.searchsorted(times, start, side="right") - 1, 0, len(times) - 2))
    last = int(np.clip(np.searchsorted(times, end, side="left") - 1, first, len(times) - 2))
    heap: list[tuple[float, bool, int, float, float]] = []
    attained = 0.0

    def push(piece: int, s: float, e: float) -> None:
        nonlocal attained
        bound, value = profile.stretch(piece, s, e)
        attained = max(attained, value)
        heapq.heappush(heap, (-bound, True, piece, s, e))

    for piece in range(first, last + 1):
        s, e = max(start, float(times[piece])), min(end, float(times[piece + 1]))
        if piece == last:
            push(piece, s, e)
        else:  # most pieces are settled by the rough bound
            heapq.heappush(heap, (-profile.rough(piece, s, e), False, piece, s, e))
    budget = getattr(profile, "splits", 64)
    while True:
        bound, exact, piece, s, e = heap[0]
        middle = math.floor((s + e) / 2) if whole else (s + e) / 2
        settled = -bound <= attained * (1 + gap) or budget <= 0 or not math.isfinite(bound)
        if settled or (exact and not s <= middle < e):
            return -bound
        heapq.heappop(heap)
        if not exact:
            push(piece, s, e)
            continue
        budget -= 1
        push(piece, s, middle)
        push(piece, middle + 1 if whole else middle, e)


def metric_factor(constants: Constants, directions: ArrayLike) -> Array:
    """sqrt(a^T P^-1 a) for directions of shape (..., n), rounded up.

    Raises
    ------
    ValueError
        If the last axis is not the dimension, or an entry is not finite.
    """
    vectors = np.asarray(directions, dtype=float)
    n = constants.dimension
    if vectors.ndim == 0 or vectors.shape[-1] != n or not np.all(np.isfinite(vectors)):
        raise ValueError(f"`directions` must be finite, of shape (..., {n}), got shape {vectors.shape}.")
    flat = vectors.reshape(-1, n)
    with precision():
        rows = arb_mat(flat.tolist())
        solved = rows.transpose()
        if constants.metric is not None:
            solved = arb_mat(constants.metric.tolist()).solve(solved)
        squares = [sum((rows[i, j] * solved[j, i] for j in range(n)), arb(0)) for i in range(len(flat))]
        result = [upper(arb.max(square, arb(0)).sqrt()) for square in squares]
    return np.array(result).reshape(vectors.shape[:-1])


def log10_upper(value: float) -> float:
    """Upper bound of log10 of a positive float."""
    with precision():
        return upper(arb(value).log() / arb(10).log())


def monotone(function: Callable[[float], arb], start: float, end: float) -> tuple[float, float]:
    """(upper bound of the supremum, value at the end) of a function that is monotone on [start, end]."""
    with precision():
        first, last = function(start), function(end)
        return max(upper(first), upper(last)), max(lower(last), lower(first))


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, tuple | list):
        return [_plain(entry) for entry in value]
    return value
