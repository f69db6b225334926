"""Probabilities that the Gaussian response ever exceeds given levels along given rows (scalar events of Thm K7).

Discrete time: the first exceedance, P(xi_0 > z_0) + sum_t P(xi_t <= z_t, xi_{t+1} > z_{t+1}).

Continuous time, in windows [t_a, t_e]: M_s = Phi(t_e, s) Z_s is a Gaussian martingale, so that
P(r . M_{t_a} <= z, sup r . M > z) = 2 P(r . M_{t_a} <= z, r . M_{t_e} > z) by reflection. A row w at time s reads
w . Z_s = b . M_s with b = w Phi(s, t_e); if |M_i| <= z_i for every coordinate, then w . Z_s <= r . M_s +
sum_i |b - r|_i z_i. The event that some coordinate exceeds z_i is paid once, for all rows together.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from certbound.arrays import Array, Integers
from certbound.gaussian.response.linear_response import LinearResponse
from certbound.gaussian.response.martingale_windows import (  # fmt: skip
    ROUND,
    Course,
    Windows,
    inverse_of,
    level_left,
    logsumexp,
    longer,
    one_cell,
    remembered,
    size_of,
    spread_of,
)
from certbound.gaussian.scalar import log_tail


@dataclass(frozen=True, eq=False)
class WindowEvents:
    """Continuous time: reflection in windows of ``length`` pieces."""

    response: LinearResponse
    cell: int
    length: int  # pieces per window
    shared_log: float  # log probability granted to the event that some coordinate of M leaves its level in some window
    # what does not depend on ``shared_log``; events with other shares may share it
    memory: dict[Any, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "response", one_cell(self.response, self.cell))

    @cached_property
    def bounds(self) -> Integers:
        """Window borders: node numbers from 0 to N. A jump of the state begins a window, before the pieces after it."""
        pieces, jumps = self.response.pieces, self.response.jumps
        if not jumps:
            return np.append(np.arange(0, pieces, self.length, dtype=np.int64), pieces)
        found = []
        for first, last in itertools.pairwise((*jumps, pieces)):
            found += [first, *range(first + 1 + self.length, last, self.length)]
        return np.array([*found, pieces], dtype=np.int64)

    @property
    def back(self) -> tuple[Array, Array]:
        """Phi(t_{k+1}, t_e)^{-1 of the forward map}: G_k of the row b = w G_k, and an entrywise error bound."""
        return remembered(self.memory, "back", self._back)

    def _back(self) -> tuple[Array, Array]:
        """G_k approximates Phi(t_e, t_{k+1})^{-1}; the error also covers the motion inside piece k."""
        f, phi = self.response.transition[0], self.response.transition_error[0]
        n = f.shape[-1]
        g, error = np.zeros(f.shape), np.zeros(f.shape)
        for start, end in zip(self.bounds[:-1], self.bounds[1:], strict=True):
            forward, slack = np.eye(n), 0.0
            for k in range(end - 1, start - 1, -1):
                inverse, offset = inverse_of(forward, slack)
                deviation = self.response.deviation[0, k]
                g[k] = inverse
                error[k] = (deviation @ (np.abs(inverse) + offset) + offset) * (1 + 1e-13)
                forward, slack = longer(forward, slack, f[k], float(phi[k]))
        return g, error

    @property
    def chords(self) -> tuple[Array, Array, Array]:
        """G at the end and at the start of every piece, for the row b_t = w G_t of w at time t, and a bound E.

        Proves: at every t of the piece b_t lies between w G at its start and at its end, up to |w| E, entry by entry.
        Of a jump: the row of what is there after it.
        """
        return remembered(self.memory, "chords", self._chords)

    def _chords(self) -> tuple[Array, Array, Array]:
        """G_t = Phi(t_e, t)^{-1} obeys G'' = (K + Jhat^2) G: it leaves its chord by h^2/8 sup |G''|."""
        response, h = self.response, self.response.step * ROUND
        n, f, phi = response.slope.shape[-1], response.transition[0], response.transition_error[0]
        drift = np.abs(response.drift[0])
        size = np.abs(response.slope[0]) + response.slope_error + h * drift
        bend = h * h / 8 * ((drift + size @ size) @ (np.eye(n) + response.deviation[0])) * (1 + 1e-12)
        last, first, error = (np.zeros((response.pieces, n, n)) for _ in range(3))
        for start, end in zip(self.bounds[:-1], self.bounds[1:], strict=True):
            forward, slack = np.eye(n), 0.0
            inverse, offset = inverse_of(forward, slack)
            for k in range(end - 1, start - 1, -1):
                last[k], error[k] = inverse, bend[k] @ (np.abs(inverse) + offset) + offset
                if k in self.response.jumps:  # the first of its window: a row reads the value after the jump
                    first[k] = inverse
                    break
                forward, slack = longer(forward, slack, f[k], float(phi[k]))
                inverse, offset = inverse_of(forward, slack)
                first[k], error[k] = inverse, (error[k] + offset) * (1 + 1e-13)
        return last, first, error

    @property
    def starts(self) -> tuple[Array, Array]:
        """Phi(t_e, t_a) of every window in floats, and an entrywise error bound (one number a window)."""
        return remembered(self.memory, "starts", self._starts)

    def _starts(self) -> tuple[Array, Array]:
        f, phi = self.response.transition[0], self.response.transition_error[0]
        n = f.shape[-1]
        result, errors = [], []
        for start, end in zip(self.bounds[:-1], self.bounds[1:], strict=True):
            forward, slack = np.eye(n), 0.0
            for k in range(end - 1, start - 1, -1):
                forward, slack = longer(forward, slack, f[k], float(phi[k]))
            result.append(forward)
            errors.append(slack)
        return np.array(result), np.array(errors)

    @property
    def coordinates(self) -> tuple[Array, list[Windows]]:
        """Upper bounds of the standard deviations of M at the windows' ends (W, n), and the windows of each M_i."""
        return remembered(self.memory, "coordinates", self._coordinates)

    def _coordinates(self) -> tuple[Array, list[Windows]]:
        n, count = self.response.slope.shape[-1], len(self.bounds) - 1
        rows = [np.broadcast_to(row, (count, n)) for row in np.eye(n)]
        variance = np.stack([self.response.variance(r[None], self.bounds[1:])[1][0] for r in rows], axis=1)
        return np.sqrt(np.maximum(variance, 0.0)) * ROUND, [self._windows(r) for r in rows]

    @cached_property
    def coordinate_levels(self) -> Array:
        """z_i of every window: the levels of |M_i| that together cost exp(shared_log).

        Proves: the sum over i of twice the one-sided exceedances is at most exp(shared_log) at the factor returned;
        at the first one tried by 4 Q(q) <= 2 exp(-q^2/2) for every window and coordinate (Levy's inequality). ln of
        the sum falls by about q dq, which gives the next factor.
        """
        sd, events = self.coordinates
        moving = [i for i in range(sd.shape[1]) if sd[:, i].max() > 0]
        target, low, log = self.shared_log, 0.0, 0.0
        count = float(np.log(4.0 * max(len(moving), 1) * len(sd)))
        high = factor = min(float(np.sqrt(2 * max(count - target, 0.5))) * ROUND, 1e150)
        for _ in range(24 if moving else 0):
            logs = np.array([events[i].log_exceedance(factor * sd[:, i]) + np.log(2.0) for i in moving])
            log = logsumexp(logs)
            low, high = (low, min(high, factor)) if log <= target else (factor, high)
            if high - low <= 1e-6 or target - 2e-3 <= log <= target or not np.isfinite(target):
                break
            step = float(np.sqrt(max(factor**2 + 2 * (log - target + 1e-3), 0.0))) if log < -0.1 else 0.0
            factor = step if low < step < high else (low + high) / 2
        return np.asarray(high * sd)

    def along(self, rows: Array) -> WindowEvent:
        """The event along ``rows`` (pieces, n)."""
        course = remembered(self.memory, ("along", rows.tobytes()), lambda: self._course(rows))
        return WindowEvent(course=course, owner=self)

    def _course(self, rows: Array) -> Course:
        """What the event along ``rows`` needs, whatever the share."""
        last, first, error = self.chords
        ends = [np.einsum("ki,kij->kj", rows, g) for g in (first, last)]
        low, high = np.minimum(*ends), np.maximum(*ends)
        slack = np.einsum("ki,kij->kj", np.abs(rows), error)
        slack += 1e-14 * np.einsum("ki,kij->kj", np.abs(rows), np.maximum(np.abs(first), np.abs(last)))
        starts = self.bounds[:-1]
        directions = (np.maximum.reduceat(high, starts) + np.minimum.reduceat(low, starts)) / 2
        window = np.repeat(np.arange(len(starts)), np.diff(self.bounds))
        nodes = np.arange(self.response.pieces)
        sizes = [self.response.variance(rows[None], nodes + shift)[1][0] for shift in (0, 1)]
        deviation = np.sqrt(np.maximum(np.maximum(*sizes), 0.0))
        early = max(1, len(rows) // 5)
        return Course(
            windows=self._windows(directions), starts=starts, window=window,
            off=np.maximum(high - directions[window], directions[window] - low) + slack,
            profile=np.maximum(deviation, np.where(nodes < early, deviation[early - 1], 0.0)),
        )

    def _windows(self, directions: Array) -> Windows:
        """Second moments of one martingale direction per window."""
        forward, slack = self.starts
        first = np.einsum("wi,wij->wj", directions, forward)
        ends, begins = self.bounds[1:], self.bounds[:-1]
        end_low, end_high = (v[0] for v in self.response.variance(directions[None], ends))
        begin_low, begin_high = (v[0] for v in self.response.variance(first[None], begins))
        # the row at the window's start is known up to its rounding: r V r moves by 2 sqrt(r V r) e + e^2
        norms = np.abs(directions).sum(axis=1)
        loss = norms * (slack + 2 * len(first[0]) * 2.0**-53 * np.abs(forward).max(axis=(1, 2)))
        loss = loss * size_of(self.response, begins) * (1 + 1e-12)
        change = 2 * np.sqrt(np.maximum(begin_high, 0)) * loss + loss**2
        begin_low = np.maximum(begin_low - change * ROUND, 0.0)
        begin_high = np.minimum(begin_high + change * ROUND, end_high)
        roots = (np.sqrt(begin_low) + np.sqrt(np.maximum(end_low, 0))) / ROUND
        with np.errstate(divide="ignore", invalid="ignore"):
            spread = np.sqrt(np.maximum(end_high - begin_low, 0.0)) / roots * ROUND
        # from one window's direction to the next one's, at their common time
        previous, own = directions[:-1], first[1:]
        p_low, p_high = (v[0] for v in self.response.variance(previous[None], begins[1:]))
        own_low, own_high = begin_low[1:], begin_high[1:]
        with np.errstate(divide="ignore", invalid="ignore"):
            unit = previous / np.sqrt(p_high)[:, None] - own / np.sqrt(own_high)[:, None]
            scale = 2 * np.sqrt(np.maximum(p_low / p_high, 0) * np.maximum(own_low / own_high, 0))
        usable = np.isfinite(unit).all(axis=1) & (scale > 0)
        _, gap = (v[0] for v in self.response.variance(np.where(usable[:, None], unit, 0.0)[None], begins[1:]))
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = np.where(usable, loss[1:] / np.sqrt(own_high), 0.0) + 1e-14
        gap = (np.sqrt(np.maximum(gap, 0)) + relative * (1 + 1e-12)) ** 2
        return Windows(
            end_high=end_high, begin_low=begin_low, begin_high=begin_high,
            spread=np.where(roots > 0, spread, 1.0), previous_low=p_low,
            turn=np.where(usable, spread_of(gap, np.where(usable, scale, 1.0)), 1e6),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class WindowEvent:
    """The event along one family of rows, beside the coordinates' levels that all rows share or with its own."""

    course: Course
    owner: WindowEvents

    @property
    def profile(self) -> Array:
        """Shape of levels (see `Course`)."""
        return self.course.profile

    @cached_property
    def cost(self) -> Array:
        """What a level loses to the coordinates, piece by piece."""
        return self._cost(self.owner.coordinate_levels)

    def _cost(self, coordinates: Array) -> Array:
        found = np.einsum("ki,ki->k", self.course.off, coordinates[self.course.window]) * (1 + 1e-13)
        return np.asarray(found)

    def _log(self, levels: Array) -> float:
        return self.course.windows.log_exceedance(np.minimum.reduceat(levels, self.course.starts))

    def log_exceedance(self, levels: Array) -> float:
        """Upper bound of log P(exists t: rows[k] . Z_t > levels[k] on piece k, no coordinate above its level)."""
        return self._log(level_left(levels, self.cost))

    def log_at_best(self, levels: Array) -> float:
        """What `log_exceedance` and `log_alone` cannot fall below: nothing lost to the coordinates (no bound)."""
        return self._log(levels)

    def log_alone(self, levels: Array, log_share: float) -> float:
        """Upper bound of log P(exists t: rows[k] . Z_t > levels[k] on piece k), with coordinates' levels of its own.

        Proves: P(sup over a window of |M_i| > q s_i) <= 4 Q(q), s_i the standard deviation of M_i at the window's end
        (Levy's inequality on both sides); for all coordinates and all windows that ask for anything these add up to
        about exp(log_share).
        """
        sd, _ = self.owner.coordinates
        asked = np.minimum.reduceat(levels, self.course.starts) < np.inf
        count = 4.0 * int(np.count_nonzero(asked)) * int(np.count_nonzero(sd.max(axis=0)))
        if count == 0:
            return self._log(levels)
        factor = float(np.sqrt(2 * max(np.log(count) - log_share, 0.0)))
        lost = float(log_tail(factor)) + float(np.log(count)) + 1e-14
        return logsumexp(np.array([lost, self._log(level_left(levels, self._cost(factor * sd)))]))


