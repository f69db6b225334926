"""Reach sets from samples, with a statistical guarantee: no proof, and nothing that makes a verdict SAFE.

N trajectories are drawn independently: starts uniform in the initial set (a Gaussian start from its law), disturbances
constant and uniform in D, the noise from its law. The tube is the smallest box around them on every piece of time. This
is a convex program with one constraint per trajectory, and 2 n K variables (two faces per state and piece): at most
2 n K trajectories decide it. By the scenario theorem a further trajectory leaves the tube with probability at most
epsilon, unless the drawn ones were exceptional, which has probability at most

    P(Binomial(N, epsilon) <= 2 n K - 1) = beta = 1 - confidence.

N is the smallest number for which that holds, from the exact tail. "Trajectory" means what was computed: the states of
the discretised path at its own times.

Source: Campi and Garatti, "The exact feasibility of randomized solutions of uncertain convex programs" (2008);
Devonport and Arcak, "Data-driven reachable set computation using adaptive Gaussian process classification and Monte
Carlo methods" (2020), whose Monte Carlo method takes one box at one time.
"""

from __future__ import annotations

import math
from collections.abc import Container, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from certbound.arrays import Array
from certbound.problem.problem import Problem
from certbound.reach.nominal import Curve, Flow
from certbound.reach.sets import ReachTube
from certbound.rigor.intervals import Interval
from certbound.simulation.estimates import sample_paths

_PIECES = 25
_STEPS = 200  # of the noise-free integration over the horizon, at least
_NOISY_STEPS = 1000
_MOST = 2_000_000  # trajectories
_CHUNK = 4_000_000  # numbers in memory at once


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class SampledTube(ReachTube):
    """A reach tube that rests on samples: a statistical statement, never a certified one.

    States, for ``samples`` trajectories drawn as `estimate_reach` says: with probability at least ``confidence`` over
    the draw, a further one stays in the tube at all its computed times with probability at least 1 - ``epsilon``.

    Parameters
    ----------
    epsilon, confidence : float
    samples : int
    """

    epsilon: float = 1.0
    confidence: float = 0.0
    samples: int = 0

    @property
    def certified(self) -> bool:
        """False: samples prove nothing about what was not drawn."""
        return False

    def summary(self) -> str:
        """The tube in one line."""
        kind = "with noise" if self.noise else "noise-free"
        return (
            f"statistical, not certified: {kind}, left by at most {self.epsilon:g} of the trajectories with confidence "
            f"{self.confidence:g}, from {self.samples} samples, by {self.method}, up to {self.end:g} in "
            f"{self.curve.pieces} pieces, {self.curve.dimension} states"
        )

    def to_dict(self) -> dict[str, Any]:
        """Box hulls per piece, and what they rest on."""
        statement = {"certified": False, "epsilon": self.epsilon, "confidence": self.confidence}
        return {**super().to_dict(), **statement, "samples": self.samples}


def scenario_count(constraints: int, epsilon: float, confidence: float) -> int:
    """The least N with P(Binomial(N, epsilon) <= constraints - 1) <= 1 - confidence.

    ``constraints`` bounds the number of samples that decide the set (support constraints); the others lie in (0, 1).

    Raises
    ------
    ValueError
        If a number lies outside its range, or more than two million samples are needed.

    Examples
    --------
    >>> scenario_count(1, 0.01, 0.99)
    459
    """
    from scipy.special import bdtr

    for name, value in (("epsilon", epsilon), ("confidence", confidence)):
        if not 0.0 < value < 1.0:
            raise ValueError(f"`{name}` must lie in (0, 1), got {value!r}.")

    def enough(count: int) -> bool:
        return bool(bdtr(float(constraints - 1), count, epsilon) * (1 + 1e-9) <= 1.0 - confidence)

    low, high = constraints - 1, constraints
    while not enough(high):
        low, high = high, 2 * high
        if low > _MOST:
            raise ValueError(
                f"`epsilon` must be larger: {epsilon:g} needs more than {_MOST} trajectories for a set with "
                f"{constraints} faces; take fewer pieces or a larger epsilon."
            )
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if enough(middle) else (middle, high)
    return high


def estimate_reach(
    problem: Problem,
    *,
    noise: bool = False,
    epsilon: float = 0.01,
    confidence: float = 0.999,
    pieces: int | None = None,
    rng: np.random.Generator | int | None = None,
) -> SampledTube:
    """The smallest boxes around sampled trajectories, with a statistical guarantee (see the module).

    Parameters
    ----------
    problem : Problem
        With a plan if its system has inputs.
    noise : bool
        Whether the trajectories are noisy.
    epsilon, confidence : float
        With probability ``confidence`` over the draw, at most ``epsilon`` of all trajectories leave the tube.
    pieces : int, optional
        Pieces of time, 25 when omitted; the steps themselves in discrete time.
    rng : numpy.random.Generator or int, optional

    Returns
    -------
    SampledTube

    Raises
    ------
    ValueError
        If a number is malformed, the initial or the disturbance set has no uniform law, the noise has none, or a
        trajectory is lost before the horizon.

    Examples
    --------
    >>> import certbound as cb
    >>> tube = estimate_reach(cb.load("pendulum"), epsilon=0.1, confidence=0.9, pieces=5, rng=0)
    >>> tube.samples, tube.certified, tube.contains(0.0, [0.5, 0.0])
    (256, False, True)
    """
    flow = Flow(problem)
    grid = time_grid(flow, pieces)
    count = scenario_count(2 * flow.dimension * (len(grid) - flow.continuous), epsilon, confidence)
    low, high, *_ = (_noisy_boxes if noise else noise_free_boxes)(flow, grid, count, np.random.default_rng(rng))
    return boxes_tube(flow, grid, low, high, noise=noise, epsilon=epsilon, confidence=confidence, samples=count)


def time_grid(flow: Flow, pieces: int | None) -> Array:
    """Ends of the pieces of time (the steps in discrete time)."""
    if not flow.continuous:
        if pieces is not None:
            raise ValueError(f"`pieces` must be left out in discrete time, where every step is one; got {pieces!r}.")
        return np.arange(flow.horizon + 1.0)
    if pieces is not None and (isinstance(pieces, bool) or int(pieces) != pieces or pieces < 1):
        raise ValueError(f"`pieces` must be a positive integer, got {pieces!r}.")
    rows = len(flow.breaks) - 1
    count = rows * math.ceil((_PIECES if pieces is None else int(pieces)) / rows)
    return np.linspace(0.0, flow.horizon, count + 1)


def draw(flow: Flow, rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    """Starts (count, n), uniform in the initial set, and constant disturbances (count, q), uniform in D."""
    initial = flow.problem.initial
    starts = np.tile(initial.middle, (count, 1)) if initial.random else initial.sample(rng, count)
    box = flow.problem.system.disturbance
    if box is None:
        return starts, np.zeros((count, 0))
    if not (np.all(np.isfinite(box.low)) and np.all(np.isfinite(box.high))):
        raise ValueError(f"`disturbance` must be bounded, got {box}: give it finite ends.")
    return starts, rng.uniform(box.low, box.high, (count, len(box.low)))


def noise_free_states(
    flow: Flow, grid: Array, starts: Array, disturbance: Any, *, steps: int = _STEPS, strict: bool = True
) -> Iterator[tuple[int, float, Array]]:
    """Noise-free states along the classical Runge-Kutta method: (piece, time, states) from time 0 on.

    Parameters
    ----------
    grid : ndarray
        Ends of the pieces; time may run backwards (a falling grid).
    starts : ndarray, shape (count, n)
    disturbance : ndarray, shape (count, q), or callable
        A callable is given the time and the states.
    steps : int
        At least this many over the whole grid.
    strict : bool
        False: states may be lost.

    Raises
    ------
    ValueError
        If a state is not finite, unless not ``strict``.
    """
    of = disturbance if callable(disturbance) else lambda t, x: disturbance
    x, last = np.array(starts, dtype=float), len(grid) - 1
    yield 0, float(grid[0]), x
    inner = math.ceil(steps / last) if flow.continuous else 1
    for piece in range(last):
        t0, h = float(grid[piece]), float(grid[piece + 1] - grid[piece]) / inner
        rows = np.broadcast_to(flow.plan_rows([min(t0, t0 + h * inner)])[0], (len(x), flow.plan_rows([0.0]).shape[1]))
        for j in range(inner):
            t = t0 + j * h
            end = t + h if j < inner - 1 else float(grid[piece + 1])
            with np.errstate(all="ignore"):
                d = of(t, x)
                if flow.continuous:
                    k1 = flow.value(t, x, rows, d)
                    k2 = flow.value(t + h / 2, x + h / 2 * k1, rows, d)
                    k3 = flow.value(t + h / 2, x + h / 2 * k2, rows, d)
                    k4 = flow.value(t + h, x + h * k3, rows, d)
                    x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
                else:
                    x = np.asarray(flow.value(t, x, rows, d))
            if strict and not np.isfinite(x).all():
                raise ValueError(
                    f"`horizon` must end before a noise-free trajectory is lost, at t = {end:.4g}; got "
                    f"{flow.horizon:g}: shorten it, or check the model."
                )
            yield piece, end, x


def _noisy_boxes(flow: Flow, grid: Array, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Least and largest states on every piece (every step in discrete time) over ``count`` trajectories."""
    pieces = len(grid) - flow.continuous
    low = np.full((pieces, flow.dimension), np.inf)
    high = -low
    inner = math.ceil(_NOISY_STEPS / pieces) if flow.continuous else 1
    steps = inner * pieces if flow.continuous else pieces - 1
    chunk = max(1, _CHUNK // ((steps + 1) * flow.dimension))
    for first in range(0, count, chunk):
        paths = sample_paths(
            flow.problem, paths=min(chunk, count - first), rng=rng, steps=steps if flow.continuous else None
        )
        for k in range(pieces):
            own = paths[:, k * inner : (k + 1) * inner + 1] if flow.continuous else paths[:, k : k + 1]
            low[k], high[k] = np.minimum(low[k], own.min(axis=(0, 1))), np.maximum(high[k], own.max(axis=(0, 1)))
    return low, high


def noise_free_boxes(
    flow: Flow, grid: Array, count: int, rng: np.random.Generator, wanted: Container[float] = ()
) -> tuple[Array, Array, dict[float, Array]]:
    """The same without noise, and the states (count, n) at those times of the grid that are wanted."""
    pieces, kept = len(grid) - flow.continuous, {}
    low = np.full((pieces, flow.dimension), np.inf)
    high = -low
    for piece, t, x in noise_free_states(flow, grid, *draw(flow, rng, count)):
        touched = {piece} if flow.continuous else {int(t)}
        if flow.continuous and piece + 1 < pieces and t == grid[piece + 1]:
            touched.add(piece + 1)
        for k in touched:
            low[k], high[k] = np.minimum(low[k], x.min(axis=0)), np.maximum(high[k], x.max(axis=0))
        if t in wanted:
            kept[t] = x.copy()
    return low, high, kept


def boxes_tube(flow: Flow, grid: Array, low: Array, high: Array, **statement: Any) -> SampledTube:
    """The tube of boxes [low, high], shapes (K, n)."""
    centre = np.clip(0.5 * low + 0.5 * high, low, high)
    curve = Curve(
        continuous=flow.continuous,
        starts=grid[:-1] if flow.continuous else grid,
        ends=grid[1:] if flow.continuous else grid,
        coefficients=centre[None, :, None, :],
    )
    box = Interval(np.nextafter(low - centre, -np.inf)[None], np.nextafter(high - centre, np.inf)[None])
    noise, epsilon = bool(statement.pop("noise")), float(statement.pop("epsilon"))
    return SampledTube(
        curve=curve, box=box, noise=noise, log10_delta=math.log10(epsilon), method="boxes around samples",
        assumption="trajectories as simulated: starts uniform in the initial set, disturbances constant and uniform",
        epsilon=epsilon, **statement,
    )
