"""The nominal curve: a noise-free trajectory as exact piecewise quintics, with a proved defect.

A solver proposes the states at the nodes; each piece is the quintic through both ends with their velocities
and accelerations, with float coefficients that are exact from then on. What the solver or the rounding got
wrong is in the defect p' - f(p, d0, t), enclosed over whole pieces by Taylor expansion with Lagrange's
remainder, and in the jumps between pieces. Discrete time: p is the float iteration, the defect its rounding
error.

Source: Thm K5 (theory); 7.8 for the jumps.
"""

from __future__ import annotations

import itertools
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from certbound.arrays import Array
from certbound.errors import EngineError
from certbound.problem.problem import Problem
from certbound.reach.nominal.curve import Curve
from certbound.reach.nominal.flow import Flow
from certbound.reach.nominal.series import taylor_bounds
from certbound.rigor.intervals import Interval, stack
from certbound.watch import poll

ORDER = 6
PIECES = 128  # at least, where the grid is chosen
ROUNDS = 5
LARGEST_GRID = 4096
_FEW = 16  # numbers of a state up to which trajectories are kept: 100 MB where a solver takes the most steps it may
_Known = dict[float, Any]  # SciPy's solutions, by the times they begin at
MOST_EVALUATIONS = 400_000
_NO_TIME = 2.0**-44  # share of the horizon in which the solver leaves states as they are
PATIENCE, LEAST_PROGRESS = 5000, 1e-4
"""Evaluations within which the solver must advance, and by which share of the time."""


def nominal_curve(problem: Problem | Flow, points: ArrayLike, *, times: ArrayLike | None = None) -> Curve:
    """Curves through ``points`` at time 0 that follow the noise-free closed loop closely.

    Nothing is proved about them here; see `bound_defect`.

    Parameters
    ----------
    points : array_like, shape (B, n) or (n,)
        States at time 0, one per cell.
    times : array_like, optional
        Nodes of the pieces in continuous time, from 0 to the horizon; chosen so that the defect is small when
        omitted (at least 128 pieces; the plan's and the constraints' times are nodes).

    Raises
    ------
    EngineError
        If the trajectory cannot be followed up to the horizon.
    """
    flow = problem if isinstance(problem, Flow) else Flow(problem)
    states = np.atleast_2d(np.asarray(points, dtype=float))
    if not flow.continuous:
        return _iterate(flow, states)
    if times is not None:
        return _through(flow, np.asarray(times, dtype=float), states)
    grid = time_grid(flow, PIECES)
    known: _Known | None = {} if states.size <= _FEW else None
    for _ in range(ROUNDS):
        poll("nominal curve")
        curve = _through(flow, grid, states, known)
        coarse = _estimate_defect(flow, curve) > _tolerance(curve)
        if not np.any(coarse) or len(grid) > LARGEST_GRID:
            break
        grid = np.unique(np.concatenate([grid, (grid[:-1] + (grid[1:] - grid[:-1]) / 2)[coarse]]))
    return curve


def time_grid(flow: Flow, pieces: int) -> Array:
    """Nodes 0 = t_0 < ... < t_K = T at about equal distances; the plan's and the windows' ends are nodes."""
    horizon = flow.horizon
    marks = set(flow.breaks.tolist())
    for constraint in flow.problem.safe:
        if constraint.during is not None:
            marks |= {float(t) for t in constraint.during if 0 < t < horizon}
    fixed = np.array(sorted(marks))
    nodes = [np.array([horizon])]
    for first, last in itertools.pairwise(fixed):
        count = max(1, int(np.ceil(pieces * (last - first) / horizon - 1e-9)))
        nodes.append(np.linspace(first, last, count + 1)[:-1])
    return np.unique(np.concatenate(nodes))


def bound_defect(flow: Flow, curve: Curve) -> Interval:
    """Enclosure of p' - f(p, d0, t) over every piece, shape (B, K, n); DT: p_{t+1} - f(p_t, d0, t), (B, K -
    1, n).

    Proves: the difference lies in the returned box at every t of the piece, both ends included. Pieces on
    which the closed loop is undefined get [-inf, inf].
    """
    rows = flow.plan_ranges(curve.starts)
    d0 = Interval.point(flow.centre_disturbance)
    if not curve.continuous:
        points = curve.range()
        image = flow.bounds(flow.tape, curve.times[:-1], points[:, :-1], rows[:-1], d0)
        return points[:, 1:] - image
    centre, piece = defect_series(flow, curve)
    span = curve.span
    plain = _derivative_range(curve) - flow.bounds(flow.tape, curve.times, curve.range(), rows, d0)
    undefined = np.any(~np.isfinite(plain.mag), axis=-1)
    columns = []
    for i in range(curve.dimension):
        best = plain[..., i]
        for bound in taylor_bounds(centre[i], piece[i], span)[1:]:
            best = best.intersect(bound)
        columns.append(best)
    result = stack(columns, axis=-1)
    mask = undefined[..., None]
    return Interval(np.where(mask, -np.inf, result.lo), np.where(mask, np.inf, result.hi))


def defect_series(
    flow: Flow, curve: Curve, order: int = ORDER
) -> tuple[list[list[Interval]], list[list[Interval]]]:
    """Series of p' - f(p, d0, t) at the middles and over the pieces, one per state (continuous time)."""
    rows = flow.plan_ranges(curve.starts)
    one = Interval.point(1.0)
    results = []
    for times, states in (
        (Interval.point(curve.middles), curve.series()),
        (curve.times, curve.series_over(curve.span)),
    ):
        field = flow.expand([times, one], states, rows, order)
        difference = []
        for state, values in zip(states, field):
            shape = np.broadcast_shapes(state[0].shape, values[0].shape)
            velocity = [state[j] * float(j) for j in range(1, len(state))]
            velocity += [Interval.point(0.0)] * (order + 1 - len(velocity))
            difference.append([(v - w).broadcast_to(shape) for v, w in zip(velocity, values)])
        results.append(difference)
    return results[0], results[1]


def bound_disturbance_slope(flow: Flow, curve: Curve) -> Interval:
    """Enclosure E of D_d f along the curve for all d in D, shape (B, K, n, q).

    Proves: f(p, d, t) - f(p, d0, t) lies in E (d - d0) for every t of the piece (mean-value theorem on the
    segment from d0 to d).
    """
    rows = flow.plan_ranges(curve.starts)
    return flow.bounds(flow.disturbance_jacobian, curve.times, curve.range(), rows)


def _derivative_range(curve: Curve) -> Interval:
    wide = curve.series_over(curve.span)
    zero = Interval.point(np.zeros(wide[0][0].shape))
    return stack([series[1] if len(series) > 1 else zero for series in wide], axis=-1)


def _iterate(flow: Flow, states: Array) -> Curve:
    steps = int(flow.horizon)
    rows = flow.plan_rows(np.arange(steps + 1))
    path = np.empty((len(states), steps + 1, flow.dimension))
    path[:, 0] = states
    for t in range(steps):
        path[:, t + 1] = flow.value(float(t), path[:, t], rows[t])
        if not np.all(np.isfinite(path[:, t + 1])):
            raise _lost(float(t + 1), flow)
    instants = np.arange(steps + 1, dtype=float)
    return Curve(continuous=False, starts=instants, ends=instants, coefficients=path[:, :, None, :])


def _through(flow: Flow, grid: Array, states: Array, known: _Known | None = None) -> Curve:
    nodes = _node_states(flow, grid, states, known)
    rows = flow.plan_rows(grid[:-1])
    h = grid[1:] - grid[:-1]
    middles = np.clip(0.5 * grid[:-1] + 0.5 * grid[1:], grid[:-1], grid[1:])
    half = np.maximum(middles - grid[:-1], h / 2)
    data = []
    for times, ends in ((grid[:-1], nodes[:, :-1]), (grid[1:], nodes[:, 1:])):
        velocity = flow.value(times, ends, rows)
        data.append((ends, velocity, _acceleration(flow, times, ends, velocity, rows)))
    scale = half[:, None]
    stacked = np.stack(
        [end[order] * scale**order for order in range(3) for end in data],
        axis=-2,
    )
    if not np.all(np.isfinite(stacked)):
        bad = ~np.all(np.isfinite(stacked), axis=(0, 2, 3))
        raise _lost(float(grid[:-1][bad][0]), flow)
    normalised = np.einsum("jk,bpki->bpji", _hermite(), stacked)
    coefficients = normalised / half[:, None, None] ** np.arange(6)[:, None]
    return Curve(continuous=True, starts=grid[:-1], ends=grid[1:], coefficients=coefficients)


class _Patience:
    """Ends a solver that chatters at a jump of the dynamics, or creeps: it would not come back."""

    def __init__(self, flow: Flow, span: float) -> None:
        self.flow, self.span = flow, span
        self.count, self.mark = 0, -np.inf

    def spend(self, t: float) -> None:
        """Count an evaluation; raises EngineError where too many were spent on next to no time."""
        self.count += 1
        if self.count % PATIENCE:
            return
        if self.count >= MOST_EVALUATIONS or t - self.mark < LEAST_PROGRESS * self.span:
            raise _lost(t, self.flow)
        self.mark = t


def _node_states(flow: Flow, grid: Array, states: Array, known: _Known | None = None) -> Array:
    """States at the nodes; ``known`` keeps trajectories by the times they begin at, for other nodes between these."""
    from scipy.integrate import solve_ivp

    count, n = states.shape
    nodes = np.empty((count, len(grid), n))
    nodes[:, 0] = states
    segments = np.unique(np.searchsorted(grid, flow.breaks))
    for first, last in itertools.pairwise(segments):
        if grid[last] - grid[first] <= _NO_TIME * flow.horizon:
            nodes[:, first : last + 1] = nodes[:, first : first + 1]
            continue
        begin, times = float(grid[first]), grid[first : last + 1]
        if known is not None and begin in known:
            nodes[:, first : last + 1] = known[begin](times).T.reshape(last - first + 1, count, n).swapaxes(0, 1)
            continue
        row = flow.plan_rows(grid[first : first + 1])[0]
        patience = _Patience(flow, float(grid[last] - grid[first]))

        def slope(t: float, flat: Array, row: Array = row, patience: _Patience = patience) -> Array:
            patience.spend(t)
            poll()
            return flow.value(t, flat.reshape(count, n), row).reshape(-1)

        start = nodes[:, first].reshape(-1)
        with np.errstate(all="ignore"):
            solution = solve_ivp(
                slope,
                (grid[first], grid[last]),
                start,
                method="DOP853",
                t_eval=times,
                dense_output=known is not None,
                rtol=1e-12,
                atol=1e-13 * _magnitude(flow, start, slope(begin, start)),
            )
        if solution.status != 0 or not np.all(np.isfinite(solution.y)):
            raise _lost(float(solution.t[-1]) if len(solution.t) else float(grid[first]), flow)
        nodes[:, first : last + 1] = solution.y.T.reshape(last - first + 1, count, n).swapaxes(0, 1)
        if known is not None:
            known[begin] = solution.sol
    return nodes


def _acceleration(flow: Flow, times: Array, states: Array, velocity: Array, rows: Array) -> Array:
    """x'' = D_x f f + D_t f in floating point."""
    if not np.all(np.isfinite(velocity)):
        return np.full(states.shape, np.nan)
    moving = [[Interval.point(x[..., i]) for x in (states, velocity)] for i in range(flow.dimension)]
    series = flow.expand([Interval.point(times), Interval.point(1.0)], moving, Interval.point(rows), 1)
    return np.stack([np.broadcast_to(s[1].mid, states.shape[:-1]) for s in series], axis=-1)


@cache
def _hermite() -> Array:
    """Coefficients of the quintic on [-1, 1] from (left, right) values, first and second derivatives."""
    matrix = np.zeros((6, 6))
    for row, (derivative, point) in enumerate([(0, -1), (0, 1), (1, -1), (1, 1), (2, -1), (2, 1)]):
        for j in range(derivative, 6):
            factor = [1, j, j * (j - 1)][derivative]
            matrix[row, j] = factor * float(point) ** (j - derivative)
    return np.asarray(np.linalg.inv(matrix), dtype=float)


def _estimate_defect(flow: Flow, curve: Curve) -> Array:
    """Largest sampled |p' - f| per piece, relative to the size of the curve per horizon."""
    rows = flow.plan_rows(curve.starts)
    worst = np.zeros(curve.pieces)
    size = _size(curve)
    for fraction in (0.2, 0.5, 0.8):
        times = curve.starts + fraction * (curve.ends - curve.starts)
        s = (times - curve.middles)[:, None]
        value = np.zeros((*curve.coefficients.shape[:2], curve.dimension))
        slope = np.zeros_like(value)
        for j in reversed(range(curve.coefficients.shape[-2])):
            slope = slope * s + value
            value = value * s + curve.coefficients[..., j, :]
        error = np.abs(slope - flow.value(times, value, rows)) / size
        worst = np.maximum(worst, np.max(np.nan_to_num(error, nan=0.0), axis=(0, 2)))
    return worst


def _size(curve: Curve) -> Array:
    values = curve.coefficients[..., 0, :]
    spread = np.max(values, axis=(0, 1)) - np.min(values, axis=(0, 1))
    return np.asarray(np.maximum(spread, 1e-3 * (float(np.max(np.abs(values))) or 1.0)))


def _magnitude(flow: Flow, start: Array, velocity: Array) -> float:
    """A size of the states, by which a solver's absolute tolerance is measured: any positive number serves."""
    moved = 1e-3 * flow.horizon * float(np.max(np.abs(velocity)))
    size = float(np.max(np.abs(start))) + (moved if np.isfinite(moved) else 0.0)
    return size if 1e-250 < size < np.inf else 1.0


def _tolerance(curve: Curve) -> float:
    return 1e-8 / max(float(curve.ends[-1]), 1e-300)


def _lost(time: float, flow: Flow) -> EngineError:
    return EngineError(
        f"the noise-free trajectory is lost: it cannot be followed beyond t = {time:.6g}, before the horizon "
        f"{flow.horizon:g}; shorten the horizon, or check the model there."
    )
