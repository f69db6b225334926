"""Piecewise-constant data over a horizon, and the two scalars that every tube formula reads.

Symbols (docs/theory.md, Sec. 4): v' = 2 c_t v + sigma_t^2 (CT) or v+ = L_t^2 v + sigma_t^2 (DT), and the information
I_t = int_t^T sigma^2/v (CT) or sum_{k >= t} log(v_{k+1}/(L_k^2 v_k)) (DT). Both are closed forms on a piece; in DT
the same ones hold at whole steps with c = log L and sigma^2 2c/(e^{2c} - 1). v is linear in its start:
v_t = gain_t v_0 + variance_t. The Bessel form takes v' = 2 c_t v instead. Variances are in units of ``unit``^2,
the largest sigma, so that no sigma overflows or underflows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from certbound.arrays import Array, Index
from certbound.tubes.constants import Constants


def integral(rate: Array, length: Array) -> Array:
    """int_0^length e^{rate s} ds, without cancellation at rate -> 0."""
    x = np.asarray(rate * length)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        return np.where(np.abs(x) < 1e-300, length, length * np.expm1(x) / np.where(x == 0, 1.0, x))


@dataclass(frozen=True, eq=False, kw_only=True)
class Schedule:
    """Constants cut to a horizon: K pieces, values constant on [times[k], times[k+1])."""

    continuous: bool  # CT or DT
    times: Array  # (K + 1,): from 0 to the horizon; whole numbers in DT
    slopes: Array  # (K,): rate (CT) or gain (DT) per piece, as stated
    sigmas: Array  # (K,): noise level per piece, as stated
    nu: float  # effective dimension
    any_power: bool  # whether every Kummer parameter a > 0 is valid (CT, Gaussian noise or isotropic proxy; Thm K1)
    scale: float | None = None  # unit of length; the largest sigma when omitted

    def __getstate__(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

    @property
    def horizon(self) -> float:
        """End of the last piece."""
        return float(self.times[-1])

    @cached_property
    def unit(self) -> float:
        """Largest sigma (1 when there is no noise), or ``scale``."""
        return self.scale or float(np.max(self.sigmas)) or 1.0

    @cached_property
    def rates(self) -> Array:
        """c per piece; log L in DT."""
        return self.slopes if self.continuous else np.log(self.slopes)

    @cached_property
    def lengths(self) -> Array:
        """Length of each piece."""
        return np.diff(self.times)

    @cached_property
    def noise(self) -> Array:
        """sigma^2/unit^2 per piece, in DT times 2c/(e^{2c} - 1)."""
        relative = (self.sigmas / self.unit) ** 2
        return relative if self.continuous else relative / integral(2 * self.rates, np.ones_like(self.rates))

    @cached_property
    def nodes(self) -> tuple[Array, Array]:
        """(gain, variance) at the times: v = gain v_0 + variance."""
        changes = (np.diff(self.rates) != 0) | (np.diff(self.noise) != 0)
        starts = np.flatnonzero(np.append(True, changes))  # runs of equal data are closed forms
        run = np.append(0, np.cumsum(changes))
        with np.errstate(over="ignore", invalid="ignore"):
            elapsed = self.times[1:] - self.times[starts][run]
            growth = np.exp(2 * self.rates * elapsed)
            forward = self.noise * integral(2 * self.rates, elapsed)
            ends = np.append(starts[1:], len(run)) - 1
            gains, variances = [1.0], [0.0]
            for factor, part in zip(growth[ends].tolist(), forward[ends].tolist()):
                gains.append(gains[-1] * factor)
                variances.append(variances[-1] * factor + part)
            gain = np.append(1.0, np.array(gains)[run] * growth)
            variance = np.append(0.0, np.array(variances)[run] * growth + forward)
        return gain, np.nan_to_num(variance, nan=np.inf, posinf=np.inf)

    def refined(self, times: Array) -> Schedule:
        """The same data on a finer grid: the union of ``times`` (inside the horizon) and the old ones."""
        inside = times[(times > 0) & (times < self.horizon)]
        if not len(inside):
            return self
        merged = np.union1d(self.times, inside)
        piece = np.searchsorted(self.times, merged[:-1], side="right") - 1
        return replace(self, times=merged, slopes=self.slopes[piece], sigmas=self.sigmas[piece])

    def until(self, last: int) -> Schedule:
        """The first ``last`` pieces, in the same unit."""
        times, slopes, sigmas = self.times[: last + 1], self.slopes[:last], self.sigmas[:last]
        return replace(self, times=times, slopes=slopes, sigmas=sigmas, scale=self.unit)

    def idle_time(self, limit: float = 250.0) -> float:
        """Time after which the contraction adds up to e^-limit; 0 where the whole of it is weaker."""
        inward = np.maximum(-self.rates, 0.0)
        later = np.append(np.cumsum((inward * self.lengths)[::-1])[::-1], 0.0)
        if later[0] <= limit:
            return 0.0
        k = int(np.flatnonzero(later > limit)[-1])
        t = float(self.times[k + 1] - (limit - later[k + 1]) / inward[k])
        return t if self.continuous else math.floor(t)

    def idled(self, until: float) -> Schedule:
        """The data without contraction up to a time: larger rates, which the smaller ones imply.

        For what happens long after, v may then wait at any size without leaving the range of floats.
        """
        data = self.refined(np.array([until]))
        early = data.times[1:] <= until
        slopes = np.where(early, np.maximum(data.slopes, 0.0 if self.continuous else 1.0), data.slopes)
        return replace(data, slopes=slopes)

    def graded(self, count: int = 32) -> Schedule:
        """Refined inside the pieces, more densely after their starts, to about ``count`` pieces or more.

        In discrete time step 1 is a node: nothing is asked of step 0, and v may be largest right after it.
        """
        each = max(1, -(-count // len(self.lengths)))
        fraction = (np.arange(1, each) / each) ** 2
        extra = (self.times[:-1, None] + self.lengths[:, None] * fraction).ravel()
        return self.refined(extra if self.continuous else np.append(np.ceil(extra), 1.0))

    def locate(self, t: Array) -> Index:
        """Piece that holds each time."""
        last = len(self.lengths) - 1
        return np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, last)

    def state(self, t: Array) -> tuple[Array, Array]:
        """(gain, variance) at any times inside the horizon, shape of ``t``."""
        gain, variance = self.nodes
        k = self.locate(t)
        h = t - self.times[k]
        with np.errstate(over="ignore", invalid="ignore"):
            growth = np.exp(2 * self.rates[k] * h)
            forward = self.noise[k] * integral(2 * self.rates[k], h)
            return gain[k] * growth, variance[k] * growth + forward

    @cached_property
    def backward(self) -> tuple[Array, Array]:
        """(sigma^2 int e^{-2 c s}, 2 c h) per piece."""
        with np.errstate(over="ignore", invalid="ignore"):
            return self.noise * integral(-2 * self.rates, self.lengths), 2 * self.rates * self.lengths

    def path(self, start: Array, *, bessel: bool = False) -> tuple[Array, Array]:
        """v and I at the times for each v_0 in ``start``: two arrays of shape (*start.shape, K + 1)."""
        gain, variance = self.nodes
        backward, drift = self.backward
        start = np.asarray(start, dtype=float)[..., None]
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            v = gain * start if bessel else gain * start + variance
            part = backward / v[..., :-1]
            if not bessel:
                part = np.where(part < 1, np.log1p(part), np.log(v[..., 1:] / v[..., :-1]) - drift)
            info = np.zeros_like(v)
            info[..., :-1] = np.cumsum(part[..., ::-1], axis=-1)[..., ::-1]
        return v, info

    def path_at(self, start: float, t: Array, *, bessel: bool = False) -> tuple[Array, Array]:
        """v and I at any times for one v_0: two arrays of the shape of ``t``."""
        gain, variance = self.state(t)
        k = self.locate(t)
        _, info = self.path(np.asarray(start), bessel=bessel)
        with np.errstate(over="ignore", invalid="ignore"):
            v = gain * start + (0.0 if bessel else variance)
            rest = self._information(v, self.rates[k], self.noise[k], self.times[k + 1] - t, bessel)
        return v, info[k + 1] + rest

    @staticmethod
    def _information(v: Array, rate: Array, noise: Array, length: Array, bessel: bool) -> Array:
        """int sigma^2/v over a stretch of one piece that starts at v."""
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            x = noise * integral(-2 * rate, length) / v
            if bessel:
                return x
            end = v * np.exp(2 * rate * length) + noise * integral(2 * rate, length)
            return np.where(x < 1, np.log1p(x), np.log(end / v) - 2 * rate * length)


def make_schedule(constants: Constants, horizon: float) -> Schedule:
    """Cut constants to a horizon, after checking it.

    Raises
    ------
    ValueError
        If ``horizon`` is not positive and finite, not a whole number of steps (DT), or beyond ``times``.
    """
    horizon = float(horizon)
    if not (np.isfinite(horizon) and horizon > 0):
        raise ValueError(f"`horizon` must be positive and finite, got {horizon}.")
    if not constants.continuous and horizon != int(horizon):
        raise ValueError(f"`horizon` must be a whole number of steps in discrete time, got {horizon}.")
    slopes, sigmas = (np.atleast_1d(np.asarray(part, float)) for part in (constants.slope, constants.sigma))
    if constants.times is None:
        times = np.array([0.0, horizon])
    else:
        times = constants.times
        if not constants.continuous and np.any(times != np.round(times)):
            raise ValueError("`times` must be whole numbers of steps in discrete time.")
        if horizon > times[-1]:
            raise ValueError(f"`horizon` must not exceed the last entry of `times`, {times[-1]}, got {horizon}.")
        pieces = len(times) - 1
        slopes, sigmas = spread(slopes, pieces), spread(sigmas, pieces)
        kept = int(np.searchsorted(times, horizon, side="left"))
        times = np.append(times[:kept], horizon)
        slopes, sigmas = slopes[:kept], sigmas[:kept]
    nu = constants.nu
    any_power = constants.continuous or constants.gaussian or nu == constants.dimension
    return Schedule(
        continuous=constants.continuous, times=times, slopes=slopes, sigmas=sigmas, nu=nu, any_power=any_power
    )


def spread(values: Array, count: int) -> Array:
    """A single value repeated, or the values as they are."""
    return np.full(count, values[0]) if len(values) == 1 else values
