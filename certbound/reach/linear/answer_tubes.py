"""Tubes of the linear-response engine: levels of Z, coordinate by coordinate, and the room that the remainder takes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array, Index
from certbound.gaussian.response import level_along, level_scale, logsumexp
from certbound.reach.linear.inclusion import Supports
from certbound.reach.linear.linearisation import Linearisation
from certbound.reach.linear.run import LinearRun, Outcome
from certbound.reach.linear.shares import Share
from certbound.reach.nominal import Curve
from certbound.reach.sets import ReachTube
from certbound.rigor.intervals import Interval

_FEW = 20  # states up to which each has an event of its own in the deviation tube
LEAST = -1e12  # log10 of the smallest probability that is told apart from 0


@dataclass(frozen=True, eq=False, kw_only=True)
class DeviationTube:
    """Bounds, coordinate by coordinate, of the deviation X - x from every associated trajectory.

    Proves: with probability at least 1 - 10**log10_delta, |X_t - x_t|_i <= ``half_widths[k, i]`` for every state i
    and every t in [times[k], times[k + 1]), whatever the start and the disturbance. Source: Thm K7.

    Parameters
    ----------
    times : ndarray, shape (K + 1,)
    half_widths : ndarray, shape (K, n)
    log10_delta : float
    """

    times: Array
    half_widths: Array
    log10_delta: float
    method: str = "linear"
    level: str = "trajectory"
    certified: bool = True
    parameters: Mapping[str, float] = field(default_factory=dict)

    @property
    def horizon(self) -> float:
        """Last time that the tube covers."""
        return float(self.times[-1])

    @cached_property
    def radii(self) -> Array:
        """Euclidean bound of the deviation on each piece."""
        return np.asarray(np.linalg.norm(self.half_widths, axis=1) * (1 + 1e-14))

    def _piece(self, t: ArrayLike) -> Index:
        index = np.searchsorted(self.times, np.asarray(t, dtype=float), side="right") - 1
        return np.clip(index, 0, len(self.half_widths) - 1)

    def radius(self, t: ArrayLike) -> Any:
        """Euclidean bound of the deviation at times ``t``."""
        value = self.radii[self._piece(t)]
        return float(value) if np.ndim(t) == 0 else value

    def bound(self, t0: float, t1: float) -> float:
        """Supremum of the radius over [t0, t1]."""
        return float(self.radii[int(self._piece(t0)) : int(self._piece(t1)) + 1].max())

    def extent(self, directions: ArrayLike, t: ArrayLike) -> Any:
        """Bound of a . (X_t - x_t) for directions a of shape (..., n)."""
        value = np.abs(np.asarray(directions, dtype=float)) @ self.half_widths[self._piece(t)].T * (1 + 1e-14)
        return float(value) if np.ndim(value) == 0 else value


def deviation_along(
    run: LinearRun, outcome: Outcome, bounds: tuple[Array, Array], direction: Array, share: Share
) -> Array:
    """Bounds of |a . (X_t - x_t)| over every piece for one direction a (n,), each of its sides at a ``share``."""
    engine = run.engine
    count = _places(engine)
    rows = np.broadcast_to(direction, (count, engine.n))
    silent, result = _silent(run), np.zeros(count)
    _, events = run.levels(outcome.nonlinear)
    for cell in range(engine.cells):
        event = events[cell].along(rows)
        level = level_along(event, share.log) if event.profile.max() > 0 else np.zeros(count)
        support = engine.supports(cell, rows[:, None], engine.moved)
        found = level + _apart(support, cell, bounds, silent)[:, 0]
        result = np.maximum(result, found * (1 + 1e-15))
    return result


def _places(engine: Linearisation) -> int:
    """Pieces, or in discrete time steps with the last one."""
    return engine.pieces if engine.continuous else engine.pieces + 1


def _coordinates(engine: Linearisation, cell: int) -> Supports:
    """Supports along the coordinates over every piece."""
    rows = np.broadcast_to(np.eye(engine.n), (_places(engine), engine.n, engine.n))
    return engine.supports(cell, rows, engine.moved)


def levels_of_coordinates(run: LinearRun, outcome: Outcome) -> tuple[list[Array], float]:
    """Levels of |Z_i| over every piece, one array (K, n) a cell, and the log probability of the whole event."""
    engine = run.engine
    n, count = engine.n, _places(engine)
    active = [int(state) for state in engine.model.active]
    nonlinear = outcome.nonlinear if active else Share.of(engine.problem.delta / 10)
    levels, events = run.levels(nonlinear)
    left = engine.problem.delta - np.exp(nonlinear.log)
    again = n <= _FEW and left >= 0.5 * engine.problem.delta  # room for events of the active states alone
    rest = [i for i in range(n) if again or i not in active]
    budget = 0.99 * left if again else 0.5 * engine.problem.delta
    share = Share.of(budget / (2 * max(len(rest), 1))).log
    result, worst = [], -np.inf
    for cell in range(engine.cells):
        values, logs = np.zeros((count, n)), [nonlinear.log]
        for i in range(n):
            event = events[cell].along(np.broadcast_to(np.eye(n)[i], (count, n)))
            own = np.full(count, np.inf)
            kept = levels[cell, :, active.index(i)] if i in active else own[:0]
            if event.profile.max() <= 0:
                own = np.zeros(count)
            elif i in rest:
                factor = level_scale(event, event.profile, share)
                own = np.where(event.profile > 0, factor, 0.0) * event.profile if np.isfinite(factor) else own
                logs.append(share + np.log(2.0))
            elif len(kept) < count:  # the last step does not enter the dynamics: an event of its own
                last = np.where(np.arange(count) == count - 1, event.profile, np.inf)
                own[-1] = level_scale(event, last, share) * event.profile[-1]
                logs.append(share + np.log(2.0))
            own[: len(kept)] = np.minimum(own[: len(kept)], kept)
            values[:, i] = own
        result.append(values * (1 + 1e-15))
        worst = max(worst, logsumexp(np.array(logs)))
    return result, worst


def _silent(run: LinearRun) -> tuple[Array, Array] | None:
    """Bounds of the remainder of the associated trajectory from a fixed start without disturbance: next to nothing."""
    engine = run.engine
    alone = not engine.radii.any() and not engine.d_radius.any() and run.curved
    return run.include(np.zeros(run.rows.shape[:3]), 1) if alone else None


def _apart(support: Supports, cell: int, bounds: tuple[Array, Array], silent: tuple[Array, Array] | None) -> Array:
    """How far the remainders of X and of x may be apart, along the rows of ``support`` over every piece.

    Both lie in R's set; where x has one of its own, that counts.
    """
    low, high, _ = support.remainder(bounds[0][cell], bounds[1][cell])
    wide = high - low
    if silent is not None:
        own = support.remainder(silent[0][cell], silent[1][cell])
        wide = np.minimum(wide, np.maximum(high - own[0], own[1] - low))
    return np.asarray(np.maximum(wide, 0.0) * (1 + 1e-15))


def deviation_tube(run: LinearRun, outcome: Outcome, bounds: tuple[Array, Array]) -> DeviationTube:
    """|X - x|_i <= level of |Z_i| plus how far both remainders may be apart."""
    engine = run.engine
    silent = _silent(run)
    levels, log_probability = levels_of_coordinates(run, outcome)
    half = np.zeros_like(levels[0])
    for cell, level in enumerate(levels):
        half = np.maximum(half, (level + _apart(_coordinates(engine, cell), cell, bounds, silent)) * (1 + 1e-15))
    count = len(half)
    times = engine.times if engine.continuous else np.arange(count + 1.0)
    own = engine.lasting
    if not isinstance(own, slice):
        times, half = np.append(times[own], times[-1]), half[own, : engine.states]
    return DeviationTube(times=times, half_widths=half, log10_delta=log10_up(log_probability))


def log10_up(log_probability: float) -> float:
    """log10 of a probability from its natural logarithm, rounded up."""
    return float(min(max(log_probability / np.log(10.0), LEAST) * (1 - 1e-15), 0.0))


def reach_tube(
    run: LinearRun, bounds: tuple[Array, Array], log10_delta: float, levels: list[Array] | None
) -> ReachTube:
    """Nominal curve plus a box around it on every piece."""
    engine = run.engine
    boxes = []
    for cell in range(engine.cells):
        support = _coordinates(engine, cell)
        low, high, _ = support.remainder(bounds[0][cell], bounds[1][cell])
        level = 0.0 if levels is None else levels[cell]
        boxes.append((low - support.y - level, high + support.y + level))
    if engine.continuous:
        c = engine.controls
        h = engine.step
        exact = [Interval.point(c[:, :, i]) for i in range(4)]
        # Bezier points about the middle of the piece, s in [-h/2, h/2]
        powers = [
            (exact[0] + 3.0 * (exact[1] + exact[2]) + exact[3]) / 8.0,
            0.75 * (exact[3] + exact[2] - exact[1] - exact[0]) / h,
            1.5 * (exact[0] - exact[1] - exact[2] + exact[3]) / (h * h),
            (exact[3] - exact[0] + 3.0 * (exact[1] - exact[2])) / (h * h * h),
        ]
        coefficients = np.stack([p.mid for p in powers], axis=2)
        slack = sum(p.rad * (0.6 * h) ** j for j, p in enumerate(powers))
        # the pieces' ends are floats within a rounding of k h
        size = np.abs(coefficients)
        speed = size[:, :, 1] + 2 * h * size[:, :, 2] + h * h * size[:, :, 3]
        slack = np.asarray(slack) * (1 + 1e-12) + speed * 4e-15 * (1 + engine.times[-1])
        starts, ends = engine.times[:-1], engine.times[1:]
    else:
        coefficients = engine.nodes[:, :, None, :]
        slack = np.zeros((engine.cells, engine.pieces + 1, engine.n))
        starts = ends = np.arange(engine.pieces + 1.0)
    low = np.stack([b[0] for b in boxes]) - slack
    high = np.stack([b[1] for b in boxes]) + slack
    own, states = engine.lasting, slice(engine.states)
    low, high, coefficients = low[:, own, states], high[:, own, states], coefficients[:, own, :, states]
    starts, ends = starts[own], ends[own]
    curve = Curve(continuous=engine.continuous, starts=starts, ends=ends, coefficients=coefficients)
    return ReachTube(
        curve=curve, box=Interval(np.nextafter(low, -np.inf), np.nextafter(high, np.inf)),
        noise=levels is not None, log10_delta=log10_delta, method="linear",
    )
