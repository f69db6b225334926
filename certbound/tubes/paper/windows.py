"""Windows: Thms 3 and 5 for time-varying data and for any sign of c, with fewer events (item 7.15).

At the window starts t_k the one-time bound sqrt(V_{t_k} B) holds, inside a window the deviation from the noise-free
solution through X_{t_k} stays below e^{C_t - C_{t_k}} sqrt(W_k B), W_k = int sigma^2 e^{-2(C_s - C_{t_k})} ds over
the window, and ||x_t - y_t|| <= e^{C_t - C_{t_k}} ||x_{t_k} - X_{t_k}||. So, with ell = log(events/delta) in B,

    r_t = e^{C_t - C_{t_k}} (sqrt(V_{t_k}) + sqrt(W_k)) sqrt(B),

with 2N - 1 events in continuous time, because S_0 = 0 needs none. In discrete time the window leaves out its ends,
which the one-time bounds cover.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from flint import arb

from certbound.arrays import Array
from certbound.rigor.balls import precision
from certbound.tubes.ballpath import BallPath, ball_path, integral
from certbound.tubes.paper.radii import Tail
from certbound.tubes.piecewise import MonotoneProfile
from certbound.tubes.schedule import Schedule
from certbound.tubes.schedule import integral as integral_float


def event_count(horizon: float, step: float, *, continuous: bool) -> int:
    """Events that share delta: 2N - 1 in CT; one-time bounds and windows with an inside in DT."""
    if continuous:
        return 2 * len(_starts(horizon, step)) - 1
    ends, length = int(horizon) // int(step), int(step)
    inside = 0 if length == 1 else -(-int(horizon) // length)
    return ends + inside


def _starts(horizon: float, step: float) -> Array:
    """Window starts k step below the horizon."""
    starts = step * np.arange(max(1, int(np.ceil(horizon / step - 1e-9))))
    return np.asarray(starts[starts < horizon])


@dataclass(frozen=True, eq=False, kw_only=True)
class _Piece:
    """e^{2(C - C_{t_k})} at the start, sqrt(B)(sqrt(V_{t_k}) + sqrt(W_k)), and DT's one-time bounds at the ends."""

    growth: arb
    whole: arb
    begin: arb | None
    end: arb | None


@dataclass(frozen=True, eq=False, kw_only=True)
class WindowProfile(MonotoneProfile):
    """Radius of the module's formula; ``schedule`` is not refined."""

    tail: Tail  # B with the number of events
    step: float  # window length

    @cached_property
    def grid(self) -> Schedule:
        """Data cut at the window starts as well."""
        return self.schedule.refined(_starts(self.schedule.horizon, self.step))

    def to_dict(self) -> dict[str, Any]:
        """Parameters as plain data."""
        return {"kind": "windows", "step": self.step, "unit": self.schedule.unit, "tail": vars(self.tail)}

    def stretch(self, piece: int, start: float, end: float) -> tuple[float, float]:
        """C_t is monotone on a piece; in DT the ends of windows count apart."""
        stretch = super().stretch
        if self.schedule.continuous or start == end:
            return stretch(piece, start, end)
        first, last = min(start + 1, end), max(end - 1, start)
        spans = [(start, start), (end, end), *([(first, last)] if first <= last else [])]
        bounds = [stretch(piece, *span) for span in spans]
        return max(b for b, _ in bounds), max(v for _, v in bounds)

    @cached_property
    def _path(self) -> BallPath:
        return ball_path(self.grid, 0.0)

    @cached_property
    def _pieces(self) -> list[_Piece]:
        data, v = self.grid, self._path.nodes[0]
        starts = np.searchsorted(data.times, _starts(self.schedule.horizon, self.step))
        ends = np.append(starts[1:], len(data.lengths))
        result: list[_Piece] = []
        with precision():
            root = arb(data.unit) * self.tail.ball().sqrt()
            one_time = [arb.max(x, arb(0)).sqrt() * root for x in v]
            for first, last in zip(starts.tolist(), ends.tolist()):
                growth, inside, grown = arb(1), arb(0), []
                closes = not data.continuous and (last < len(data.lengths) or data.horizon % self.step == 0)
                for j in range(first, last):
                    rate, noise = self._path.pieces[j]
                    length = arb(float(data.times[j + 1])) - arb(float(data.times[j]))
                    kept = length - 1 if closes and j == last - 1 else length
                    inside += noise * integral(-2 * rate, kept) / growth
                    grown.append(growth)
                    growth = growth * (2 * rate * length).exp()
                whole = one_time[first] + arb.max(inside, arb(0)).sqrt() * root
                for j, g in zip(range(first, last), grown):
                    begin = one_time[j] if j == first and not data.continuous else None
                    end = one_time[j + 1] if j == last - 1 and closes else None
                    result.append(_Piece(growth=g, whole=whole, begin=begin, end=end))
        return result

    def point(self, piece: int, t: float) -> arb:
        """The radius at a time of a piece."""
        data, held = self.grid, self._pieces[piece]
        if held.begin is not None and t == data.times[piece]:
            return held.begin
        if held.end is not None and t == data.times[piece + 1]:
            return held.end
        rate = self._path.pieces[piece][0]
        return (held.growth * (2 * rate * (arb(t) - arb(float(data.times[piece])))).exp()).sqrt() * held.whole


def window_scale(
    schedule: Schedule, step: float, clearance: Callable[[Schedule], Array] | None, *, final: bool = False
) -> float:
    """max_t r_t/(clearance_t sqrt(B)) in floating point, over the ends of the pieces; the mean without weights."""
    starts = _starts(schedule.horizon, step)
    grid = schedule.refined(starts)
    k = np.searchsorted(grid.times, starts)
    variance = np.maximum(grid.nodes[1][:-1], 0.0)
    drift = np.concatenate([[0.0], np.cumsum(2 * grid.rates * grid.lengths)])
    owner = np.repeat(np.arange(len(k)), np.diff(np.append(k, len(grid.lengths))))
    kept = grid.lengths.copy()
    if not grid.continuous:
        kept[np.append(k[1:], len(grid.lengths))[: len(k)] - 1] -= 1.0
    base = drift[k][owner]
    inside = np.add.reduceat(grid.noise * integral_float(-2 * grid.rates, kept) * np.exp(base - drift[:-1]), k)
    whole = np.sqrt(variance[k]) + np.sqrt(np.maximum(inside, 0.0))
    left, right = np.exp((drift[:-1] - base) / 2) * whole[owner], np.exp((drift[1:] - base) / 2) * whole[owner]
    unit = grid.unit
    if final:
        return float(unit * right[-1])
    if clearance is None:
        return float(unit * np.sum((left + right) / 2 * grid.lengths) / grid.horizon)
    weights = clearance(grid)
    return float(unit * np.max(np.maximum(left, right) / weights))
