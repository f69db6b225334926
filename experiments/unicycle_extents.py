"""How wide the unicycle's tube is, over time: certified extents of the deviation beside simulated quantiles.

From a point without a disturbance (what the linear response is about), from the whole initial box with one, and the
paper's path beside them: local constants with Thm K4 and the tube of Thm 2 as a radius. The ratio over time is extent
to the 99.9 % quantile of the deviation at that time, for px and py; `whole` is the factor by which the tube could be
scaled, in one direction, and still hold 99.9 % of the paths at all times.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

import certbound as cb
from certbound.errors import CertboundError
from certbound.problem.problem import Problem
from certbound.reach.contraction import local_contraction_tube, local_tube
from certbound.reach.linear import linear_answer
from certbound.reach.nominal import Flow
from certbound.simulation.estimates.deviations import Measure, sup_deviation
from experiments.harness import Arrays, Claims, main

__all__ = ["compute", "ratios"]

HORIZONS = (2.0, 5.0)
POINTS = 10
LEVEL = 0.999
STATES = ("px", "py")


def compute(full: bool) -> tuple[Arrays, Claims]:
    """Extents, quantiles and their ratios, case by case."""
    paths = 200_000 if full else 20_000
    arrays: Arrays = {}
    claims: Claims = {"paths": paths, "level": LEVEL}
    for horizon in HORIZONS:
        for name, quiet in (("point", True), ("box", False)):
            parameters: dict[str, Any] = {"disturbance": 0.0, "x0_halfwidth": 0.0} if quiet else {}
            problem = cb.load("unicycle", **parameters).replace(horizon=horizon)
            found = ratios(problem, paths)
            key = f"{name}_{horizon:g}"
            arrays |= {f"{key}_{part}": found[part] for part in ("times", "extent", "quantile", "ratio")}
            claims[f"{key}_largest_ratio"] = float(found["ratio"].max())
            claims[f"{key}_whole"] = found["whole"]
            claims[f"{key}_seconds"] = round(found["seconds"], 1)
            if quiet:
                claims[f"{key}_radius_thm2"] = paper_radius(problem)
    return arrays, claims


def ratios(problem: Problem, paths: int) -> dict[str, Any]:
    """Certified extents of px and py, simulated quantiles at the same times, and what the tube gives away."""
    started = time.process_time()
    answer = linear_answer(problem)
    alone = [answer.extent_along(np.eye(3)[i]) for i in range(len(STATES))]
    seconds = time.process_time() - started
    starts = answer.run.engine.times
    times = np.linspace(0.0, problem.horizon, POINTS + 1)[1:]
    inside = np.minimum(times, problem.horizon * (1 - 1e-9))
    extents, quantiles, whole = [], [], []
    for i in range(len(STATES)):
        direction = np.eye(3)[i]
        grid = np.linspace(0.0, problem.horizon, 1001)
        held = alone[i][_piece(starts, grid)]
        both = np.stack([direction, -direction])
        spread = sup_deviation(problem, paths=paths, rng=np.random.default_rng(7 + i), points=POINTS,
                               measure=Measure(directions=both))
        scaled = sup_deviation(problem, paths=paths, rng=np.random.default_rng(17 + i),
                               measure=Measure(directions=both, profile=held))
        half = 1 - (1 - LEVEL) / 2
        quantiles.append(np.max([spread.quantile_curve(half, row=row)[:, 0] for row in (0, 1)], axis=0))
        whole.append(1 / max(scaled.quantile(half, row=row).value for row in (0, 1)))
        extents.append(alone[i][_piece(starts, inside)])
    extent, quantile = np.array(extents), np.array(quantiles)
    return {
        "times": times, "extent": extent, "quantile": quantile, "ratio": extent / quantile,
        "whole": [float(value) for value in whole], "seconds": seconds,
    }


def _piece(starts: np.ndarray, times: np.ndarray) -> np.ndarray:
    return np.clip(np.searchsorted(starts, times, side="right") - 1, 0, len(starts) - 2)


def paper_radius(problem: Problem) -> float | None:
    """Largest radius of Thm 2's tube from local constants (Thm K4); None where no guess confirms itself."""
    try:
        reach = local_contraction_tube(Flow(problem))
        if reach.end < problem.horizon:
            return None
        _, radius = local_tube(problem, reach, delta=problem.delta, method="thm2")
    except (CertboundError, ValueError):
        return None
    return float(radius.max())


if __name__ == "__main__":
    main("unicycle_extents", compute)
