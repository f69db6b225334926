"""Fig. 8: the unicycle past three obstacles, T = 2 and T = 5: nominal paths, reachable boxes, noisy paths.

Controller gains, disturbance and noise level are reconstructed (see ``certbound.problem.library.unicycle``).
"""

from __future__ import annotations

import itertools

import numpy as np

import certbound as cb
from certbound.problem.problem import Problem
from experiments.harness import Arrays, Claims, main

HORIZONS = {"left": 2.0, "right": 5.0}
POINTS = 50
BOXES = 16
DIRECTIONS = 24


def compute(full: bool) -> tuple[Arrays, Claims]:
    """Everything that the six panels show, and the verdicts."""
    count = 5000 if full else 400
    arrays: Arrays = {}
    claims: Claims = {"paths": count, "sigma": float(cb.load("unicycle").parameters["sigma"])}
    for seed, (side, horizon) in enumerate(HORIZONS.items()):
        problem = cb.load("unicycle").replace(horizon=horizon)
        verdict = cb.verify_safety(problem, method="linear", cells=1)
        quiet = cb.load("unicycle", sigma=0.0).replace(horizon=horizon)
        for name, subject in (("nominal", quiet), ("noisy", problem)):
            rng = np.random.default_rng(80 + seed)
            states = cb.sample_paths(subject, paths=count, rng=rng, points=POINTS)
            arrays[f"{side}_{name}"] = states[..., :2].astype(np.float32)
        rng = np.random.default_rng(82 + seed)
        apart = cb.sample_paths(problem, paths=60, rng=rng, points=POINTS, deviation=True)[..., :2]
        arrays[f"{side}_deviation"] = np.linalg.norm(apart, axis=-1).astype(np.float32)
        arrays[f"{side}_boxes"] = _boxes(verdict.reach.pieces, horizon)
        exits = cb.simulate_exits(problem, paths=5000, rng=np.random.default_rng(85 + seed))
        band = np.linalg.norm(verdict.deviation.extent[:, :2], axis=1)
        arrays[f"{side}_band"] = np.array(float(band.max()))
        arrays[f"{side}_needed"] = _needed(verdict)
        claims[f"{side}_needed"] = [float(end(arrays[f"{side}_needed"])) for end in (np.min, np.max)]
        claims[f"{side}_status"] = verdict.status
        claims[f"{side}_log10_delta"] = verdict.log10_delta
        claims[f"{side}_margin"] = verdict.margin
        claims[f"{side}_band"] = float(band.max())
        claims[f"{side}_violations"] = exits.exits
        claims[f"{side}_hits"] = _hits(problem, arrays[f"{side}_nominal"], float(band.max()))
    arrays["centers"] = np.array([c.region.center_at() for c in problem.safe])
    arrays["radii"] = np.array([c.region.radius for c in problem.safe])
    return arrays, claims


def _boxes(pieces, horizon: float) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Boxes (low, high) in the plane that hold the state over stretches of time without gaps: (BOXES, 2, 2)."""
    starts, ends = (np.array([getattr(piece, name) for piece in pieces]) for name in ("start", "end"))
    borders = np.linspace(0.0, horizon, BOXES + 1)
    found = []
    for first, last in itertools.pairwise(borders):
        held = [pieces[k] for k in np.flatnonzero((ends > first) & (starts < last))]
        found.append([np.min([p.low[:2] for p in held], axis=0), np.max([p.high[:2] for p in held], axis=0)])
    return np.array(found)


def _needed(verdict: cb.Verdict) -> np.ndarray:
    """Certified bounds of the deviation along each of some directions of the plane alone: (DIRECTIONS + 1,)."""
    angles = np.linspace(0.0, np.pi, DIRECTIONS // 2 + 1)
    answer = verdict.answers["linear"].details
    half = [float(np.max(answer.extent_along([np.cos(a), np.sin(a), 0.0]))) for a in angles[:-1]]
    return np.array([*half, *half, half[0]])


def _hits(problem: Problem, paths: np.ndarray, band: float) -> int:
    """Nominal paths that touch an eroded band."""
    hits = np.zeros(len(paths), dtype=bool)
    for constraint in problem.safe:
        distance = np.linalg.norm(paths - constraint.region.center_at(), axis=-1)
        hits |= (distance < constraint.region.radius + band).any(axis=1)
    return int(hits.sum())


if __name__ == "__main__":
    main("fig8", compute)
