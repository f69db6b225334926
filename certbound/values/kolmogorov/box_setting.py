"""What the engine needs of a problem: its model as tapes and in floats, its box, and where paths go."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from certbound.arrays import Array
from certbound.errors import InfeasibleError
from certbound.problem.model import Tape, compile_numpy
from certbound.problem.problem import Problem
from certbound.problem.sets import GaussianStart
from certbound.problem.systems import ContinuousSystem
from certbound.values.enclosing import squared_diffusion
from certbound.values.kolmogorov.cell_fields import Fields
from certbound.values.room import limits_of

_PATHS, _STEPS, _EVERY = 2000, 400, 10
_RARE = 2e-4  # share of the visits that lies beyond the range on either side
_MARGIN = 0.4  # of the range, beyond it, where no limit stands


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Setting:
    """A problem in a box: dX = f(t, X) dt + g(t, X) dW, limits along the coordinates, one start set.

    Attributes
    ----------
    drift, square : Fields
        Of f and of a = g g'.
    low, high : ndarray, shape (2, n)
        Ends of the box: of the safe set rounded inward (row 0) and outward (row 1); where no limit stands, ends that
        paths hardly reach.
    limited : ndarray of bool, shape (2, n)
        Whether the lower and the upper end of a coordinate is a limit.
    noisy : tuple of bool
        Whether noise moves a coordinate at all.
    range : ndarray, shape (2, n)
        Between these ends paths spend nearly all their time.
    start_low, start_high : ndarray, shape (starts, n)
        A box around each start set.
    horizon : float
    """

    drift: Fields
    square: Fields
    low: Array
    high: Array
    limited: Array
    noisy: tuple[bool, ...]
    range: Array
    start_low: Array
    start_high: Array
    horizon: float
    flow: Callable[[Array], Array]
    spread: Callable[[Array], Array]

    @property
    def dimension(self) -> int:
        """Number of states n."""
        return len(self.noisy)


def setting_of(problem: Problem) -> Setting:
    """Read a problem.

    Raises
    ------
    InfeasibleError
        What is not served yet: disturbances, a model that changes with time, windows, moving or curved sets, random
        starts, targets; the message says which.
    """
    system = problem.system
    if not isinstance(system, ContinuousSystem):
        raise InfeasibleError("values with a carried error need continuous time here; the problem is discrete.")
    served = {
        "a disturbance": system.disturbance is None, "a target": problem.reach is None, "a random start":
        not problem.initial.random, "a plan that is an array": problem.input_sequence is None, "an infinite horizon":
        not problem.endless, "paths that end as they leave the domain": not problem.ending,
    }  # fmt: skip
    missing = [name for name, there in served.items() if not there]
    if missing:
        raise InfeasibleError(f"values with a carried error do not serve {missing[0]} yet.")
    n = system.dimension
    room = limits_of(problem)
    square = squared_diffusion(system.diffusion, system.states)
    fields = (Fields(problem.closed_loop, n), Fields(square, n))
    if not all(one.autonomous for one in fields):
        raise InfeasibleError("values with a carried error do not serve models that change with time yet.")
    hulls = [start.hull(0.0) for start in problem.starts if not isinstance(start, GaussianStart)]
    start_low, start_high = np.array([h.lo for h in hulls]), np.array([h.hi for h in hulls])
    flow, spread = _in_floats(problem.closed_loop, n), _in_floats(square, n)
    lows, highs = np.array([room.inner_low, room.outer_low]), np.array([room.inner_high, room.outer_high])
    limited = np.array([np.isfinite(lows[0]), np.isfinite(highs[0])])
    visited = _visited(problem, start_low, start_high, lows[0], highs[0])
    width = visited[1] - visited[0]
    return Setting(
        drift=fields[0], square=fields[1], low=np.where(limited[0], lows, visited[0] - _MARGIN * width),
        high=np.where(limited[1], highs, visited[1] + _MARGIN * width), limited=limited,
        noisy=tuple(fields[1].present[k * n + k] for k in range(n)), range=visited,
        start_low=start_low, start_high=start_high, horizon=float(problem.horizon),
        flow=flow, spread=spread,
    )  # fmt: skip


def _in_floats(tape: Tape, n: int) -> Callable[[Array], Array]:
    """A tape as a function of points, shape (n, ...), to its outputs, shape (outputs, ...)."""
    function = compile_numpy(tape)
    count = len(tape.outputs)

    def call(points: Array) -> Array:
        return np.ascontiguousarray(np.moveaxis(function(0.0, *points).reshape(*points.shape[1:], count), -1, 0))

    return call


def _visited(problem: Problem, low: Array, high: Array, inner_low: Array, inner_high: Array) -> Array:
    """Quantiles of where simulated paths are while they are safe, shape (2, n)."""
    rng, n = np.random.default_rng(0), problem.system.dimension
    system = problem.system
    assert isinstance(system, ContinuousSystem)
    g = system.diffusion
    flow = _in_floats(problem.closed_loop, n)
    columns = g.shape[1]
    noise = _in_floats(g, n) if isinstance(g, Tape) else lambda x: np.asarray(g)[:, :, None].reshape(n * columns, 1)
    which = rng.integers(len(low), size=_PATHS)
    x = low[which].T + (high - low)[which].T * rng.random((n, _PATHS))
    step, seen = problem.horizon / _STEPS, [x.copy()]
    alive = np.ones(_PATHS, dtype=bool)
    for k in range(_STEPS):
        kicks = noise(x).reshape(n, columns, -1) * rng.normal(size=(columns, _PATHS))
        x = x + step * flow(x) + math.sqrt(step) * kicks.sum(axis=1)
        alive &= np.all((x > inner_low[:, None]) & (x < inner_high[:, None]), axis=0)
        if k % _EVERY == 0 and alive.any():
            seen.append(x[:, alive])
    points = np.concatenate(seen, axis=1)
    points = points[:, np.isfinite(points).all(axis=0)]
    least, most = np.quantile(points, [_RARE, 1 - _RARE], axis=1)
    return np.array([np.minimum(least, low.min(axis=0)), np.maximum(most, high.max(axis=0))])
