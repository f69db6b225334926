"""Sharper scalar events in continuous time, along rows that do not change with time.

A rough xi_t = w . Z_t is compared with an Ornstein-Uhlenbeck process in a clock of its own (Slepian;
`certbound.gaussian.scalar.slepian`), a smooth one (w . g = 0) counted by its up-crossings (Rice;
`certbound.gaussian.scalar.rice`). This module proves the second moments that they ask for, over all times. Every piece
is cut into parts short enough that first-order enclosures over a part are tight. The first pieces of a rough row,
where the variance starts from 0, are left to the martingale windows.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.gaussian.response.decorrelation import decorrelation
from certbound.gaussian.response.events import WindowEvent, WindowEvents
from certbound.gaussian.response.linear_response import LinearResponse, continuous_response
from certbound.gaussian.response.martingale_windows import logsumexp, remembered
from certbound.gaussian.response.moments import smooth_moments
from certbound.gaussian.scalar import Clock, clock_crossing, crossing_rate, node_clock
from certbound.rigor.intervals import Interval

_PART, _FEWEST_PARTS = 0.05, 100  # ||J|| times the length of a part; parts of the horizon
_LIMITS = (0.35, 3.0)  # of -log corr in a block: short blocks have a slower clock, long ones add fewer probabilities
_MOST_PARTS = 1200
_EARLY = 20  # one piece in so many at the start is left to the windows
_ENOUGH, _FAR_OFF = -200.0, 20.0  # log probabilities below it, from so many deviations on, need no sharper bound
_CLEARLY, _INFORMATIVE = 0.02, 0.5  # a clock that wins by so much, both well below 1, is used alone from then on
_GAPS = (6.0, 3.0, 1.0)  # the first pieces' coordinates cost exp(-gap) of what comes later
_FAR = 1e4  # -log of a probability that is as good as 0
_UNIT = 2.0**-53
_LN10 = float(np.log(10.0))


@dataclass(frozen=True, eq=False, kw_only=True)
class ClockBound:
    """A rough row: its clocks after the first ``early`` pieces, and upper bounds of its variance per part."""

    clocks: tuple[Clock, ...]
    variance: Array
    parts: int
    early: int
    leader: list[int] = field(default_factory=list)

    def log_exceedance(self, levels: Array, windows: WindowEvent) -> float:
        """Upper bound of log P(exists t: w . Z_t > levels[k] on piece k)."""
        first = np.where(np.arange(len(levels)) < self.early, levels, np.inf)
        late = np.repeat(levels[self.early :], self.parts)
        normal = np.where(np.isinf(late), np.inf, late / np.sqrt(self.variance) * (1 - 1e-14))
        crossing = self._crossing(normal)
        return _with_start(crossing, windows, first)

    def _crossing(self, normal: Array) -> float:
        """The least over the clocks; once one of them has won clearly, it alone."""
        tried = self.leader or range(len(self.clocks))
        logs = {i: clock_crossing(self.clocks[i], normal) * _LN10 for i in tried}
        best = min(logs, key=lambda i: logs[i])
        clear = -np.inf < logs[best] < -_INFORMATIVE
        if clear and len(logs) > 1 and all(i == best or log > logs[best] + _CLEARLY for i, log in logs.items()):
            self.leader.append(best)
        return float(logs[best] + 1e-13 * abs(logs[best]))


def _with_start(crossing: float, windows: WindowEvent, first: Array) -> float:
    """The crossing after the first pieces and the windows' bound on these, at the best of a few shares."""
    if not np.isfinite(crossing):
        crossing = -_FAR
    best = 0.0
    for gap in _GAPS:
        start = windows.log_alone(first, crossing - gap)
        best = min(best, logsumexp(np.array([start, crossing])))
        if start <= crossing - 0.5 * gap:
            break
    return best


@dataclass(frozen=True, eq=False, kw_only=True)
class RateBound:
    """A smooth row: enclosures per part of its variance, of cov(xi, xi') and of the variance of xi'."""

    step: float
    variance: Interval
    covariance: Interval
    velocity: Interval
    start: Interval
    parts: int

    def log_exceedance(self, levels: Array, windows: WindowEvent) -> float:
        """Upper bound of log P(exists t: w . Z_t > levels[k] on piece k); ``windows`` are not needed."""
        # no level beyond 60 standard deviations is worth more than that one
        cap = 60 * float(np.sqrt(self.variance.hi.max()))
        shape = np.repeat(np.minimum(levels, cap), self.parts)
        rate = crossing_rate(
            np.full(len(shape), self.step), shape, self.variance, self.covariance, self.velocity,
            start_variance=self.start,
        ) * _LN10
        return float(rate + 1e-13 * abs(rate))


@dataclass(frozen=True, eq=False)
class SteadyEvent:
    """The event along one row that stays the same: the better of its windows and its clock or crossing rate.

    ``known`` are the bounds by the clock or the rate found so far, by the levels' bytes; they ask for no share.
    ``beaten`` is not empty once the windows have lost: they are asked again only where the sharper bound says nothing.
    """

    windows: WindowEvent
    row: Array
    owner: ClockEvents
    known: dict[bytes, float] = field(default_factory=dict)
    beaten: set[bool] = field(default_factory=set)

    @property
    def profile(self) -> Array:
        """Shape of levels (see `WindowEvent`)."""
        return self.windows.profile

    def log_exceedance(self, levels: Array) -> float:
        """Upper bound of log P(exists t: w . Z_t > levels[k] on piece k, no coordinate above its level)."""
        if np.any(levels < 0):
            return 0.0
        if np.all(levels >= _FAR_OFF * self.profile):
            whole = self.windows.log_exceedance(levels)
            if whole < _ENOUGH:
                return whole
        sharp = self.log_unshared(levels)
        clear = sharp < -_INFORMATIVE
        smooth = isinstance(self.owner.bound(self.row), RateBound)  # up-crossings are next to exact
        if clear and (smooth or self.beaten or sharp <= self.windows.log_at_best(levels)):
            self.beaten.add(True)
            return sharp
        whole = self.windows.log_exceedance(levels)
        if clear and sharp < whole - _CLEARLY:
            self.beaten.add(True)
        return min(sharp, whole)

    def log_unshared(self, levels: Array) -> float:
        """Upper bound of log P(exists t: w . Z_t > levels[k] on piece k) alone, whatever the coordinates do."""
        if np.any(levels < 0):
            return 0.0
        key = levels.tobytes()
        if key not in self.known:
            bound = self.owner.bound(self.row)
            self.known[key] = 0.0 if bound is None else bound.log_exceedance(levels, self.windows)
        return self.known[key]


@dataclass(frozen=True, eq=False)
class ClockEvents:
    """Windows for every row, clocks or crossing rates for the rows that stay the same."""

    windows: WindowEvents
    diffusion: Array  # (n, m), or (N, n, m) where it differs from piece to piece
    # what was computed for this cell's response before; shared by events with other levels
    memory: dict[Any, Any] = field(default_factory=dict)

    @property
    def shared_log(self) -> float:
        """Log probability that all rows share (see `WindowEvents`)."""
        return self.windows.shared_log

    def __post_init__(self) -> None:
        windows = copy(self.windows)  # its response is one cell's already
        object.__setattr__(windows, "memory", self.memory)
        object.__setattr__(self, "windows", windows)

    def along(self, rows: Array) -> WindowEvent | SteadyEvent:
        """The event along ``rows`` (pieces, n)."""
        steady = not np.any(rows != rows[0]) and len(rows) > 2 * _EARLY
        if not steady:
            return self.windows.along(rows)
        row = np.array(rows[0])
        if np.any(row[np.flatnonzero(row)[:1]] < 0):  # w . Z and -w . Z have the same law; a row may be zero
            row, rows = 0.0 - row, 0.0 - rows
        known, beaten = self.memory.setdefault(("known", row.tobytes()), ({}, set()))
        return SteadyEvent(self.windows.along(rows), row, self, known, beaten)

    def bound(self, row: Array) -> ClockBound | RateBound | None:
        """The sharper bound along ``row``; None where none is proved."""
        smooth = not np.any(np.abs(row) @ np.abs(self.diffusion))
        return remembered(self.memory, row.tobytes(), lambda: self._rate(row) if smooth else self._clock(row))

    @cached_property
    def parts(self) -> int:
        """Parts per piece."""
        response = self.windows.response
        size = float(np.linalg.norm(response.slope[0], axis=(-2, -1)).max()) * response.step
        least = max(size / _PART, _FEWEST_PARTS / response.pieces)
        return int(np.clip(np.ceil(least), 1, max(1, _MOST_PARTS // response.pieces)))

    @property
    def by_parts(self) -> Array:
        """The diffusion, on every part where it differs from piece to piece."""
        return self.diffusion if self.diffusion.ndim == 2 else np.repeat(self.diffusion, self.parts, axis=0)

    def _noise(self, first: int) -> Array:
        """The diffusion as it holds from part ``first`` on."""
        return self.diffusion if self.diffusion.ndim == 2 else self.by_parts[first:]

    @property
    def fine(self) -> LinearResponse:
        """The same response on the parts."""
        return remembered(self.memory, b"fine", self._refined)

    def _refined(self) -> LinearResponse:
        response, parts = self.windows.response, self.parts
        offsets = np.arange(parts) / parts * response.step
        slope = response.slope[:, :, None] + offsets[:, None, None] * response.drift[:, :, None]
        shape = (1, response.pieces * parts, *response.slope.shape[2:])
        size = float(np.abs(slope).max(initial=0.0))
        # A + tau_r K rounded, and parts of length h/parts rounded: the exact slope is within this of the floats
        error = 8 * _UNIT * (size + float(np.abs(response.drift).max(initial=0.0)) * response.step)
        drift = np.broadcast_to(response.drift[:, :, None], (1, response.pieces, parts, *shape[2:])).reshape(shape)
        return continuous_response(
            slope.reshape(shape), drift, response.step / parts, self.by_parts, response.covariance[0, 0],
            slope_error=error + self.slope_error,
        )

    @property
    def slope_error(self) -> float:
        """Entrywise error of the coarse slope's floats, as the coarse response was told."""
        return self.windows.response.slope_error

    def _rate(self, w: Array) -> RateBound:
        """Rice's data: the second moments of xi and xi' over every part."""
        moments = smooth_moments(self.fine, w, self._noise(0))
        return RateBound(
            step=self.fine.step * (1 + 1e-14), variance=moments.variance, covariance=moments.covariance,
            velocity=moments.velocity, start=moments.start, parts=self.parts,
        )

    def _clock(self, w: Array) -> ClockBound | None:
        """The clock of w . Z after the first pieces; None where none is proved."""
        early = max(1, self.windows.response.pieces // _EARLY)
        first = early * self.parts
        found = decorrelation(self.fine, w, self._noise(first), first)
        if found is None:
            return None
        clocks = tuple(node_clock(found.durations, found.near, found.needs, limit=limit) for limit in _LIMITS)
        return ClockBound(clocks=clocks, variance=found.variance.hi, parts=self.parts, early=early)
