"""Certified reach tubes against sampled noise-free trajectories: all inside, and how much wider than their hull.

A third of the trajectories start at corners of the initial set under constant disturbances at corners of D; a third
start anywhere under disturbances that jump between random values; a third start at, and are driven by, what is worst
for a random direction at a random time according to the linearisation (bang-bang). The width of the tube is set against
the sampled hull on every piece of time and for every state, and averaged.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

import certbound as cb
from certbound.problem.sets import GaussianStart
from certbound.reach.linear import Linearisation
from certbound.reach.nominal import Flow
from certbound.reach.sampled.boxes import noise_free_states
from certbound.reach.sets import ReachTube
from experiments.harness import Arrays, Claims, main

__all__ = ["Finding", "compare", "compute"]

CASES = (
    ("ou", {}, None), ("pendulum", {}, None), ("pendulum", {}, 2), ("unicycle", {}, None), ("unicycle", {}, 2),
    ("chain", {}, None), ("chain_rest", {}, None),
)  # fmt: skip
JUMPS = 12
DIRECTIONS = 240
RESOLVED = 1e-7  # hulls narrower than this, relative to the state, are not compared
TOLERANCE = 1e-9  # of the sampled trajectories' own arithmetic, relative to the state


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Trajectories, how many of them left the tube, and mean and largest ratio of widths (NaN without a width)."""

    trajectories: int
    outside: int
    mean_ratio: float
    largest_ratio: float
    seconds: float


def compare(problem: cb.Problem, tube: ReachTube, count: int, seed: int = 0, steps: int = 400) -> Finding:
    """Sample ``count`` trajectories and set them against the tube."""
    begin = time.perf_counter()
    flow, rng = Flow(problem), np.random.default_rng(seed)
    continuous = flow.continuous
    grid = np.append(tube.curve.starts, tube.curve.ends[-1:]) if continuous else np.asarray(tube.curve.starts)
    pieces = tube.curve.pieces
    low, high = np.full((pieces, flow.dimension), np.inf), np.full((pieces, flow.dimension), -np.inf)
    outside = 0
    for starts, disturbance in _families(problem, flow, grid, rng, count):
        left = np.zeros(len(starts), dtype=bool)
        for piece, t, x in noise_free_states(flow, grid, starts, disturbance, steps=steps):
            touched = {piece} if continuous else {int(t)}
            if continuous and piece + 1 < pieces and t == grid[piece + 1]:
                touched.add(piece + 1)
            for k in touched:
                low[k], high[k] = np.minimum(low[k], x.min(axis=0)), np.maximum(high[k], x.max(axis=0))
            left |= ~np.any([_inside(tube, k, t, x) for k in touched], axis=0)
        outside += int(left.sum())
    width, sampled = tube.hull.hi - tube.hull.lo, high - low
    scale = np.maximum(np.abs(low), np.abs(high)) + 1e-3
    told = sampled > RESOLVED * scale
    ratios = width[told] / sampled[told]
    return Finding(
        trajectories=count, outside=outside, seconds=time.perf_counter() - begin,
        mean_ratio=float(ratios.mean()) if ratios.size else float("nan"),
        largest_ratio=float(ratios.max()) if ratios.size else float("nan"),
    )


def _inside(tube: ReachTube, piece: int, t: float, x: np.ndarray) -> np.ndarray:
    """Which states lie in the set of one piece at time t."""
    offset = (t - tube.curve.middles[piece]) ** np.arange(tube.curve.coefficients.shape[2])
    found = np.zeros(len(x), dtype=bool)
    slack = TOLERANCE * (1 + np.abs(x).max(axis=1))
    for cell in range(tube.curve.cells):
        rest = x - offset @ tube.curve.coefficients[cell, piece]
        if tube.box is not None:
            box = tube.box[cell, piece]
            rest = rest - np.clip(rest, box.lo, box.hi)
        matrix = np.eye(len(rest[0])) if tube.metric is None else np.asarray(tube.metric)
        size = np.sqrt(np.einsum("mi,ij,mj->m", rest, matrix, rest))
        found |= size <= tube.radius[cell, piece] + slack * np.sqrt(np.linalg.norm(matrix, 2))
    return found


def _families(
    problem: cb.Problem, flow: Flow, grid: np.ndarray, rng: np.random.Generator, count: int
) -> Iterator[tuple[np.ndarray, object]]:
    """Starts and disturbances of the three families."""
    shares = [count // 3, count // 3, count - 2 * (count // 3)]
    q = len(flow.centre_disturbance)
    low, high = np.asarray(flow.disturbance.lo), np.asarray(flow.disturbance.hi)
    corners = np.array(list(itertools.product(*zip(low, high)))).reshape(2**q, q)
    pick = rng.integers(len(corners), size=shares[0])
    yield _starts(problem, rng, shares[0], extreme=True), corners[pick]

    values = rng.uniform(low, high, (JUMPS, shares[1], q))
    end = float(problem.horizon)
    yield _starts(problem, rng, shares[1]), lambda t, x: values[min(int(t / end * JUMPS), JUMPS - 1)]

    # the adjoint of the linearisation: r at the chosen time, r Phi before it
    engine = Linearisation.of(problem, noise=False)
    f, gain = engine.response.transition[0], engine.slopes[2][0]
    rows = rng.standard_normal((DIRECTIONS, flow.dimension))
    rows[: 2 * flow.dimension] = np.concatenate([np.eye(flow.dimension), -np.eye(flow.dimension)])
    last = rng.integers(1, engine.pieces + 1, DIRECTIONS)
    last[: DIRECTIONS // 4] = engine.pieces
    signs = np.zeros((engine.pieces, DIRECTIONS, q))
    for k in range(engine.pieces - 1, -1, -1):
        active = last > k
        signs[k, active] = np.sign(rows[active] @ gain[k])
        rows[active] = rows[active] @ f[k]
    which = rng.integers(DIRECTIONS, size=shares[2])
    middle, half = (low + high) / 2, (high - low) / 2

    def driven(t: float, x: np.ndarray) -> np.ndarray:
        k = min(int(t / engine.step), engine.pieces - 1)
        return middle + half * signs[k, which]

    yield _starts(problem, rng, shares[2], along=rows[which]), driven


def _starts(
    problem: cb.Problem, rng: np.random.Generator, count: int, *, extreme: bool = False, along: np.ndarray | None = None
) -> np.ndarray:
    """Starts anywhere in the initial set, at its corners, or farthest along directions."""
    start = problem.initial
    if isinstance(start, GaussianStart):
        return np.tile(np.asarray(start.mean), (count, 1))
    inside = start.sample(rng, count)
    if not isinstance(start, cb.Box) or not (extreme or along is not None):
        return inside
    side = rng.integers(2, size=inside.shape) if along is None else along > 0
    return np.where(side, start.high, start.low)


def compute(full: bool) -> tuple[Arrays, Claims]:
    """Every case: 10^5 trajectories in full, 10^4 otherwise."""
    count = 100_000 if full else 10_000
    table: Claims = {}
    for name, parameters, cells in CASES:
        problem = cb.load(name, **parameters)
        begin = time.perf_counter()
        tube = cb.bound_reach(problem, noise=False, cells=cells)
        spent = time.perf_counter() - begin
        found = compare(problem, tube, count)
        label = f"{name}, {cells or 1} cell{'s' if (cells or 1) > 1 else ''} a side"
        table[label] = {
            "method": tube.method, "trajectories": found.trajectories, "outside": found.outside,
            "mean_ratio": None if np.isnan(found.mean_ratio) else round(found.mean_ratio, 4),
            "largest_ratio": None if np.isnan(found.largest_ratio) else round(found.largest_ratio, 4),
        }  # fmt: skip
        print(
            f"{label:30} {tube.method:12} outside {found.outside} of {found.trajectories}, "
            f"width {found.mean_ratio:.3f} times the hull on average, at most "
            f"{found.largest_ratio:.3f}  ({spent:.1f} s + {found.seconds:.1f} s)",
            flush=True,
        )
    ratios = [row["mean_ratio"] for row in table.values()]
    arrays = {"mean_ratio": np.array([np.nan if ratio is None else ratio for ratio in ratios])}
    return arrays, {"table": table, "outside": sum(row["outside"] for row in table.values())}


if __name__ == "__main__":
    main("reach_tubes", compute)
