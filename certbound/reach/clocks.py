"""Sharper scalar events in continuous time, along rows that do not change with time.

A rough xi_t = w . Z_t is compared with an Ornstein-Uhlenbeck process in a clock of its own (Slepian;
`certbound.tubes.gaussian_clock`), a smooth one (w . g = 0) counted by its up-crossings (Rice;
`certbound.tubes.gaussian_rate`). This module proves the second moments that they ask for, over all times. Every piece
is cut into parts short enough that first-order enclosures over a part are tight. The first pieces of a rough row,
where the variance starts from 0, are left to the martingale windows.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certbound.reach.events import WindowEvent, WindowEvents, logsumexp
from certbound.reach.response import LinearResponse, continuous_response
from certbound.rigor.intervals import Interval
from certbound.tubes.gaussian import Clock, clock_crossing, crossing_rate, decorrelation_rates, markov_clock

__all__ = ["ClockBound", "ClockEvents", "RateBound", "SteadyEvent"]

Array = NDArray[np.float64]

_PART = 0.01  # ||J|| times the length of a part
_LIMITS = (0.35, 3.0)  # of -log corr in a block: short blocks have a slower clock, long ones add fewer probabilities
_MOST_PARTS = 1200
_BAND = 400  # pairs of parts farther apart are not compared
_EARLY = 20  # one piece in so many at the start is left to the windows
_ENOUGH = -200.0  # log probabilities below it need no sharper bound
_UNIT = 2.0**-53
_LN10 = float(np.log(10.0))


@dataclass(frozen=True, eq=False, kw_only=True)
class ClockBound:
    """A rough row: its clocks after the first ``early`` pieces, and upper bounds of its variance per part."""

    clocks: tuple[Clock, ...]
    variance: Array
    parts: int
    early: int

    def log_exceedance(self, levels: Array, windows: WindowEvent) -> float:
        """Upper bound of log P(exists t: w . Z_t > levels[k] on piece k)."""
        first = np.where(np.arange(len(levels)) < self.early, levels, np.inf)
        late = np.repeat(levels[self.early :], self.parts)
        normal = np.where(np.isinf(late), np.inf, late / np.sqrt(self.variance) * (1 - 1e-14))
        crossing = min(clock_crossing(clock, normal) for clock in self.clocks) * _LN10
        return logsumexp(np.array([windows.log_exceedance(first), crossing + 1e-13 * abs(crossing)]))


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
    """The event along one row that stays the same: the better of its windows and its clock or crossing rate."""

    windows: WindowEvent
    row: Array
    owner: ClockEvents

    @property
    def profile(self) -> Array:
        """Shape of levels (see `WindowEvent`)."""
        return self.windows.profile

    def log_exceedance(self, levels: Array) -> float:
        """Upper bound of log P(exists t: w . Z_t > levels[k] on piece k, no coordinate above its level)."""
        whole = self.windows.log_exceedance(levels)
        if whole < _ENOUGH or np.any(levels < 0):
            return whole
        bound = self.owner.bound(self.row)
        return whole if bound is None else min(whole, bound.log_exceedance(levels, self.windows))


@dataclass(frozen=True, eq=False, kw_only=True)
class Moments:
    """Majorants and moments of one row over the parts (axis 0).

    ``alpha`` = w A, ``kappa`` = w K; ``size_v`` and ``size_rate`` bound |V_t| and |V'_t| entrywise, ``size_alpha``
    bounds |w Jhat|; ``spill`` the error of the covariance's floats; ``own`` and ``own_error`` enclose
    cov(xi_s, xi'_t) over s <= t in one part.
    """

    alpha: Array
    kappa: Array
    size_v: Array
    size_rate: Array
    size_alpha: Array
    spill: Array
    variance: Interval
    own: Array
    own_error: Array


@dataclass(frozen=True, eq=False)
class ClockEvents:
    """Windows for every row, clocks or crossing rates for the rows that stay the same.

    Parameters
    ----------
    windows : WindowEvents
    diffusion : ndarray, shape (n, m), or (N, n, m) where it differs from piece to piece
    memory : dict
        What was computed for this cell's response before; shared by events with other levels.
    """

    windows: WindowEvents
    diffusion: Array
    memory: dict[bytes, Any] = field(default_factory=dict)

    @property
    def shared_log(self) -> float:
        """Log probability that all rows share (see `WindowEvents`)."""
        return self.windows.shared_log

    def along(self, rows: Array) -> WindowEvent | SteadyEvent:
        """The event along ``rows`` (pieces, n)."""
        event = self.windows.along(rows)
        steady = not np.any(rows != rows[0]) and len(rows) > 2 * _EARLY
        return SteadyEvent(event, np.array(rows[0]), self) if steady else event

    def bound(self, row: Array) -> ClockBound | RateBound | None:
        """The sharper bound along ``row``; None where none is proved."""
        key = row.tobytes()
        if key not in self.memory:
            smooth = not np.any(np.abs(row) @ np.abs(self.diffusion))
            self.memory[key] = self._rate(row) if smooth else self._clock(row)
        found: ClockBound | RateBound | None = self.memory[key]
        return found

    @cached_property
    def parts(self) -> int:
        """Parts per piece."""
        response = self.windows.response
        size = float(np.linalg.norm(response.slope[0], axis=(-2, -1)).max()) * response.step
        return int(np.clip(np.ceil(size / _PART), 1, max(1, _MOST_PARTS // response.pieces)))

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
        if b"fine" not in self.memory:
            self.memory[b"fine"] = self._refined()
        found: LinearResponse = self.memory[b"fine"]
        return found

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

    def _moments(self, w: Array, first: int) -> Moments:
        """Moments over the parts from number ``first`` on."""
        r = self.fine
        h, pick, weight = r.step * (1 + 1e-14), slice(first, None), np.abs(w)
        a, drift, dev = r.slope[0, pick], r.drift[0, pick], r.deviation[0, pick]
        noise = np.abs(self._noise(first))
        size_g = noise @ np.swapaxes(noise, -1, -2) * (1 + 1e-13)
        v, v_next = r.covariance[0, first:-1], r.covariance[0, first + 1 :]
        traces = np.trace(r.covariance_error[0], axis1=1, axis2=2)
        spill = (traces[first:-1] + traces[first + 1 :])[:, None, None]
        grow = np.eye(len(w)) + dev
        size_v = grow @ (np.abs(v) + spill) @ np.swapaxes(grow, 1, 2) + h * (grow @ size_g @ np.swapaxes(grow, 1, 2))
        size_v = size_v * (1 + 1e-12)
        size_a = np.abs(a) + h * np.abs(drift)
        product = size_a @ size_v
        size_rate = (product + np.swapaxes(product, 1, 2) + size_g) * (1 + 1e-12)
        alpha, kappa = np.einsum("i,kij->kj", w, a), np.einsum("i,kij->kj", w, drift)
        size_alpha = np.einsum("i,kij->kj", weight, size_a)
        # variance over each part: between its ends up to h^2/8 of its second derivative
        value, value_next = (np.einsum("i,kij,j->k", w, m, w) for m in (v, v_next))
        bend = 2 * np.einsum("ki,kij,j->k", np.abs(kappa), size_v, weight)
        bend += 2 * np.einsum("ki,kij,j->k", size_alpha, size_rate, weight)
        slack = spill[:, 0, 0] * weight.sum() ** 2 + 1e-13 * np.einsum("i,kij,j->k", weight, size_v, weight)
        slack = slack + h * h / 8 * bend * (1 + 1e-12)
        own = np.einsum("ki,kij,j->k", alpha, v, w)
        own_error = h * np.einsum("ki,kij,j->k", np.abs(kappa), size_v, weight)
        own_error += np.einsum("ki,kij,j->k", size_alpha, dev @ size_v + h * size_rate, weight)
        own_error = own_error * (1 + 1e-12) + spill[:, 0, 0] * size_alpha.sum(1) * weight.sum()
        own_error += 1e-13 * np.einsum("ki,kij,j->k", size_alpha, size_v, weight)
        return Moments(
            alpha=alpha, kappa=kappa, size_v=size_v, size_rate=size_rate, size_alpha=size_alpha, spill=spill,
            variance=Interval(np.minimum(value, value_next) - slack, np.maximum(value, value_next) + slack),
            own=own, own_error=own_error,
        )

    def _rate(self, w: Array) -> RateBound:
        """Rice's data: Var(xi') = alpha V alpha moves over a part by at most h sup |its derivative|."""
        r, m = self.fine, self._moments(w, 0)
        h = r.step * (1 + 1e-14)
        value = np.einsum("ki,kij,kj->k", m.alpha, r.covariance[0, :-1], m.alpha)
        error = h * (2 * np.einsum("ki,kij,kj->k", np.abs(m.kappa), m.size_v, m.size_alpha)
                     + np.einsum("ki,kij,kj->k", m.size_alpha, m.size_rate, m.size_alpha)) * (1 + 1e-12)
        error += m.spill[:, 0, 0] * m.size_alpha.sum(1) ** 2
        error += 1e-13 * np.einsum("ki,kij,kj->k", m.size_alpha, m.size_v, m.size_alpha)
        start = float(w @ r.covariance[0, 0] @ w)
        loose = 1e-13 * float(np.abs(w) @ np.abs(r.covariance[0, 0]) @ np.abs(w))
        return RateBound(
            step=h, variance=Interval(np.maximum(m.variance.lo, 0.0), m.variance.hi),
            covariance=Interval(m.own - m.own_error, m.own + m.own_error),
            velocity=Interval(np.maximum(value - error, 0.0), value + error),
            start=Interval(np.maximum(start - loose, 0.0), start + loose), parts=self.parts,
        )

    def _clock(self, w: Array) -> ClockBound | None:
        """The clock of w . Z after the first pieces; None where none is proved."""
        early = max(1, self.windows.response.pieces // _EARLY)
        first = early * self.parts
        r, m = self.fine, self._moments(w, first)
        h, pick, weight = r.step * (1 + 1e-14), slice(first, None), np.abs(w)
        a, dev, f, phi = r.slope[0, pick], r.deviation[0, pick], r.transition[0, pick], r.transition_error[0, pick]
        v_next, count, variance, alpha = r.covariance[0, first + 1 :], len(a), m.variance, m.alpha
        grow = np.eye(len(w)) + dev
        diffusion = self._noise(first)
        gram, size_g = (g @ np.swapaxes(g, -1, -2) for g in (diffusion, np.abs(diffusion)))
        alpha2 = np.einsum("ki,kij->kj", alpha, a) + m.kappa
        second = np.maximum(dev - h * np.abs(a), 0.0) + 4e-16 * (1 + dev)
        noise_value = np.broadcast_to(w @ gram @ w, count)
        noise_error = np.broadcast_to(1e-13 * (weight @ size_g @ weight), count)
        noise = Interval(np.maximum(noise_value - noise_error, 0.0), noise_value + noise_error)
        # covariances of the times s <= t of one part
        cov_lo, cov_hi = np.full((count, count), -1.0), np.full((count, count), 1.0)
        run_lo, run_hi = np.zeros((count, count)), np.zeros((count, count))
        near = np.einsum("i,kij,kjl,l->k", weight, dev, m.size_v, weight) * (1 + 1e-12)
        np.fill_diagonal(cov_lo, variance.lo - near)
        np.fill_diagonal(cov_hi, variance.hi + near)
        np.fill_diagonal(run_lo, m.own - m.own_error)
        np.fill_diagonal(run_hi, m.own + m.own_error)
        # u_s = Phi(t_{i+1}, s) V_s w = u_{i+1} - int (...), carried from part to part
        rate = np.einsum("kij,kj->ki", v_next, alpha) + gram @ w
        rate_error = np.einsum("kij,kj->ki", dev, np.abs(rate)) + np.einsum(
            "kij,kjl,kl->ki", grow, h * m.size_rate, m.size_alpha) + np.einsum(
            "kij,kjl,kl->ki", grow, m.size_v, h * np.abs(m.kappa))
        middle = np.einsum("kij,j->ki", v_next, w) - h / 2 * rate
        swing = h / 2 * rate
        blur = h * rate_error * (1 + 1e-12) + m.spill[:, :, 0] * weight.sum()
        blur += 1e-13 * (np.einsum("kij,j->ki", m.size_v, weight) + h * (np.abs(rate) + np.einsum(
            "kij,kj->ki", m.size_v, m.size_alpha)))
        for lag in range(1, min(count, _BAND)):
            middle, swing, blur = middle[: count - lag], swing[: count - lag], blur[: count - lag]
            if lag > 1:
                step, loss = f[lag - 1 : count - 1], phi[lag - 1 : count - 1]
                total = np.abs(middle) + np.abs(swing) + blur
                blur = np.einsum("kij,kj->ki", np.abs(step), blur) + (
                    loss[:, None] + 4 * (len(w) + 4) * _UNIT * np.abs(step).max(axis=(1, 2))[:, None]
                ) * total.sum(axis=1)[:, None]
                blur = blur * (1 + 1e-12)
                middle, swing = np.einsum("kij,kj->ki", step, middle), np.einsum("kij,kj->ki", step, swing)
            late = slice(lag, None)
            index = np.arange(count - lag)
            both = ((w + h / 2 * alpha[late], h / 2 * alpha[late],
                     np.einsum("i,kij->kj", weight, second[late])),
                    (alpha[late] + h / 2 * alpha2[late], h / 2 * alpha2[late],
                     np.einsum("ki,kij->kj", m.size_alpha[late], second[late])
                     + h * np.einsum("ki,kij->kj", np.abs(m.kappa[late]), dev[late])))
            for (row, half, rest), lo, hi in zip(both, (cov_lo, run_lo), (cov_hi, run_hi), strict=True):
                centre = np.einsum("ki,ki->k", row, middle)
                radius = np.abs(np.einsum("ki,ki->k", row, swing)) + np.einsum("ki,ki->k", np.abs(row), blur)
                radius += np.abs(np.einsum("ki,ki->k", half, middle)) + np.einsum("ki,ki->k", rest, np.abs(middle))
                radius += np.einsum("ki,ki->k", np.abs(half) + rest, np.abs(swing) + blur)
                radius = radius * (1 + 1e-12) + 1e-14 * np.einsum("ki,ki->k", np.abs(row), np.abs(middle))
                lo[index, index + lag], hi[index, index + lag] = centre - radius, centre + radius
        if not (np.all(variance.lo > 0) and np.all(np.diagonal(cov_lo) > 0)):
            return None
        rates = decorrelation_rates(variance, noise, (cov_lo, cov_hi), (run_lo, run_hi))
        if not np.all(np.isfinite(np.diagonal(rates))):
            return None
        clocks = tuple(markov_clock(np.full(count, h), rates, limit=limit) for limit in _LIMITS)
        return ClockBound(clocks=clocks, variance=variance.hi, parts=self.parts, early=early)
