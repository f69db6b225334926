"""Filters by their kinds: what each is stated by, and the state equations that it stands for."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.checks import assign, names, nearest, number
from certbound.problem.filters.shaping import Shape, shaped

_SHORTEST, _LONGEST = 1e-50, 1e50
"""Times of filters, in the unit of time of the problem."""


@dataclass(frozen=True, eq=False)
class Filter:
    """Coloured noise, or the lag of an input, as states behind those of a system.

    The output is a state, named ``state``, for the dynamics to use; further states are ``<state>_2``, ``<state>_3``.
    Noise starts stationary, with mean 0 and independent of all else, unless the problem's start says otherwise. In
    discrete time the filter is that of continuous time at the times 0, 1, 2, ..., its values there exactly in law, and
    ``time``, ``length / speed`` and frequencies count in steps.

    Parameters
    ----------
    kind : str
        "ou": Ornstein-Uhlenbeck, the correlation is exp(-|s| / time). "dryden" and "von_karman": gusts along an axis
        of flight, MIL-F-8785C; the latter by rational functions, within 7 % of the spectrum up to the frequencies 13
        speed / length (axis "u") and 20 speed / length. "band": white noise behind a band-pass. "actuator":
        time * x' = u - x, which is no noise, and starts at 0.
    state : str
        Name of the output.
    std : float
        Standard deviation of the output ("ou", gusts), not negative.
    time : float
        Correlation time ("ou"), or time constant ("actuator"), positive.
    length, speed : float
        Gusts: scale of turbulence and airspeed, positive; only their ratio, a time, counts.
    axis : str
        Gusts: "u" along the flight, "v" across it, "w" vertical; "v" and "w" have the same form. MIL-HDBK-1797 states
        twice the length for these.
    density : float
        "band": two-sided spectral density S of the white noise, whose correlation is S times Dirac's delta (a diffusion
        g has S = g^2); not negative. A one-sided density in cycles per time is 2 S, one in radians per time S / pi.
    low, high : float
        "band": frequencies in radians per time, 0 <= low < high, at which half of S is left. The filter is that of
        Butterworth, of first order: the density is S at sqrt(low high), the variance S (high - low) / 2. Of low = 0 a
        low-pass is left.
    input : str, optional
        "actuator": the input that it follows; may be left out where the system has one.

    Raises
    ------
    TypeError, ValueError
        If the kind is unknown, an argument is missing, does not belong to the kind, or is out of range.

    Examples
    --------
    >>> gust = Filter("dryden", state="gust", std=1.5, length=200, speed=50, axis="w")
    >>> gust.states, gust.covariance.round(2).tolist()
    (('gust', 'gust_2'), [[2.25, 0.56], [0.56, 0.56]])
    """

    kind: str
    state: str = field(kw_only=True)
    std: Any = field(default=None, kw_only=True)
    time: Any = field(default=None, kw_only=True)
    length: Any = field(default=None, kw_only=True)
    speed: Any = field(default=None, kw_only=True)
    axis: Any = field(default=None, kw_only=True)
    density: Any = field(default=None, kw_only=True)
    low: Any = field(default=None, kw_only=True)
    high: Any = field(default=None, kw_only=True)
    input: Any = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        kind = KINDS.get(self.kind) if isinstance(self.kind, str) else None
        if kind is None:
            raise ValueError(f"`kind` must be a kind of filter, got {self.kind!r}{nearest(str(self.kind), KINDS)}")
        names("state", [self.state])
        for name in (*_ALL, "input"):
            value = getattr(self, name)
            if value is None and name in kind.wants:
                wanted = ", ".join(kind.wants)
                raise ValueError(f"`{name}` must be given for the filter {self.state!r}: {self.kind!r} wants {wanted}.")
            if value is not None and name not in (*kind.wants, *kind.may):
                wanted = " and ".join(kind.wants)
                raise ValueError(f"`{name}` must be omitted for {self.kind!r}, which is stated by {wanted}.")
        for name in kind.wants:
            assign(self, **{name: self._checked(name)})
        if self.high is not None and not self.low < self.high:
            raise ValueError(f"`low` must be below `high`, got {self.low:g} and {self.high:g}.")
        if not _SHORTEST <= self._time <= _LONGEST:
            raise ValueError(
                f"`time`, `length` / `speed` or 1 / `high` must lie between {_SHORTEST:g} and {_LONGEST:g}, got "
                f"{self._time:g}; choose another unit of time."
            )

    def _checked(self, name: str) -> Any:
        value = getattr(self, name)
        if name == "axis":
            if value not in _AXES:
                raise ValueError(f"`axis` must be one of {', '.join(_AXES)}, got {value!r}.")
            return value
        found = number(name, value)
        if found < 0 or (found == 0 and name in ("time", "length", "speed", "high")):
            rule = "not be negative" if name in ("std", "density", "low") else "be positive"
            raise ValueError(f"`{name}` must {rule}, got {found:g}.")
        return found

    def __repr__(self) -> str:
        given = {name: value for name, value in self.data().items() if name != "kind"}
        return f"Filter({self.kind!r}, {', '.join(f'{name}={value!r}' for name, value in given.items())})"

    @property
    def _time(self) -> float:
        """The unit of time in which the filter is the one of its kind."""
        if self.high is not None:
            return 1 / (math.sqrt(self.low * self.high) or self.high)
        ratio: float = self.length / self.speed if self.time is None else self.time
        return ratio

    @property
    def noisy(self) -> bool:
        """Whether noise drives it, not an input."""
        return KINDS[self.kind].shape is not None

    @property
    def shape(self) -> Shape | None:
        """Its state equations in continuous time; None of an actuator."""
        make = KINDS[self.kind].shape
        if make is None:
            return None
        std = math.sqrt(self.density * (self.high - self.low) / 2) if self.std is None else self.std
        return make(self).scaled(std, self._time)

    @property
    def states(self) -> tuple[str, ...]:
        """Names of its states, the output first."""
        count = 1 if self.shape is None else len(self.shape.noise)
        return (self.state, *(f"{self.state}_{place}" for place in range(2, count + 1)))

    @property
    def covariance(self) -> Array:
        """Stationary covariance of its states, shape (k, k); 0 of an actuator."""
        return np.zeros((1, 1)) if self.shape is None else self.shape.covariance

    def data(self) -> dict[str, Any]:
        """Its arguments, as a problem file states them."""
        given = {name: getattr(self, name) for name in (*_ALL, "input")}
        return {"state": self.state, "kind": self.kind} | {k: v for k, v in given.items() if v is not None}

    def describe(self) -> str:
        """The filter in a few words."""
        given = (f"{name} {value:g}" for name in _ALL if isinstance(value := getattr(self, name), float))
        more = [f"axis {self.axis}"] if self.axis else [f"of {self.input}"] if self.input else []
        return f"{self.state} = {self.kind.replace('_', ' ')} ({', '.join([*given, *more])})"


@dataclass(frozen=True, eq=False, kw_only=True)
class _Kind:
    wants: tuple[str, ...]
    may: tuple[str, ...] = ()
    shape: Callable[[Filter], Shape] | None


_ALL = ("std", "time", "length", "speed", "axis", "density", "low", "high")
_AXES = ("u", "v", "w")
_GUST = ("std", "length", "speed", "axis")


def _first_order(one: Filter) -> Shape:
    """sqrt(2) / (1 + s)."""
    return shaped((), (1.0, 1.0))


def _dryden(one: Filter) -> Shape:
    """MIL-F-8785C, 3.7.1.2: sqrt(2) / (1 + s), and (1 + sqrt(3) s) / (1 + s)^2 across the flight."""
    return _first_order(one) if one.axis == "u" else shaped((1 / math.sqrt(3),), (1.0, 2.0, 1.0))


def _von_karman(one: Filter) -> Shape:
    """Rational functions whose squares are close to the spectra of MIL-F-8785C, 3.7.1.1, up to their factors.

    (1 + .25 s) / (1 + 1.357 s + .1987 s^2) along the flight, and across it (1 + 2.7478 s + .3398 s^2) /
    (1 + 2.9958 s + 1.9754 s^2 + .1539 s^3), the coefficients that flight simulation uses (MathWorks, Aerospace
    Blockset, Von Karman Wind Turbulence Model (Continuous)). There their variances are .969 and .962 of std^2, as they
    have too little of high frequencies; here they are scaled to std^2.
    """
    num, den = _KARMAN["u" if one.axis == "u" else "v"]
    zeros = sorted(-root.real for root in np.roots(num))
    return shaped(tuple(zeros), tuple(np.asarray(den) / den[0]))


_KARMAN = {
    "u": ((0.25, 1.0), (0.1987, 1.357, 1.0)),
    "v": ((0.3398, 2.7478, 1.0), (0.1539, 1.9754, 2.9958, 1.0)),
}  # fmt: skip


def _band(one: Filter) -> Shape:
    """B s / (s^2 + B s + 1), B = (high - low) / sqrt(low high); a low-pass without ``low``."""
    if one.low == 0:
        return _first_order(one)
    return shaped((0.0,), (1.0, (one.high - one.low) / math.sqrt(one.low * one.high), 1.0))


KINDS = {
    "ou": _Kind(wants=("std", "time"), shape=_first_order),
    "dryden": _Kind(wants=_GUST, shape=_dryden),
    "von_karman": _Kind(wants=_GUST, shape=_von_karman),
    "band": _Kind(wants=("density", "low", "high"), shape=_band),
    "actuator": _Kind(wants=("time",), may=("input",), shape=None),
}
"""Every kind of filter, and what it is stated by."""
