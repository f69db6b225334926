"""How certified metrics of the chain grow with its length, and how far metrics alone tighten it.

For each number of masses: the spectral lower bound of the gain, the certified gain of the proposed metric, and the
processor time of each part (structure, proposal, proof). The vertices number 2^masses; the proof is one inequality
of size 3 masses. Then the erosions of the chain with three masses at T = 50, delta = 0.002: one common metric, and
one per constraint with delta split evenly or as is best. The full run goes to 100 masses.
"""

from __future__ import annotations

import time

import numpy as np

import certbound as cb
from certbound.constants.metrics import bound_metrics, model_set, propose_metrics, split_delta
from certbound.constants.model_data import model_of
from certbound.constants.programs import rate_proposals
from certbound.constants.programs.proposals import spectral_bound
from certbound.constants.recheck import certify_gain
from experiments.harness import Arrays, Claims, main

HORIZON, DELTA = 50, 0.002
WEIGHTS = np.array([0.66, 0.56, 0.45, 1.17])
DIRECTIONS = np.array([[-1, 0, 0, 0, 0, 0], [1, -1, 0, 0, 0, 0], [0, 1, -1, 0, 0, 0], [0, 0, 0, 0, 0, 1.0]])


def growth(masses: int) -> tuple[float, float, float, float, float]:
    """(spectral bound, certified gain, seconds of structure, of proposal, of proof)."""
    problem = cb.load("chain_rest", masses=masses)
    marks = [time.process_time()]
    members = model_set(model_of(problem, None, None))
    marks.append(time.process_time())
    metric = rate_proposals(members, continuous=False)[0].metric
    marks.append(time.process_time())
    gain = certify_gain(metric, members)
    marks.append(time.process_time())
    lower = float(np.sqrt(spectral_bound(members, continuous=False)))
    return (lower, gain, *(float(x) for x in np.diff(marks)))


def common_erosion(problem: cb.Problem) -> np.ndarray:
    """Erosions of the four constraints in one common metric."""
    metric = propose_metrics(
        problem,
        objective="erosion",
        directions=list(DIRECTIONS),
        clearances=WEIGHTS,
        horizon=HORIZON,
        delta=DELTA,
    )[0]
    constants = cb.bound_constants(problem, metric=metric)
    return np.asarray(cb.tune_tube(constants, horizon=HORIZON, delta=DELTA).extent(DIRECTIONS, HORIZON))


def own_erosions(problem: cb.Problem) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Erosions in a metric per constraint: delta split evenly, split best, and the shares."""
    constants = bound_metrics(problem)
    shares = split_delta(problem, constants)
    even, split = [], []
    for record, direction, share in zip(constants, DIRECTIONS, shares):
        for level, into in ((DELTA / len(constants), even), (float(share), split)):
            tube = cb.tune_tube(record, horizon=HORIZON, delta=level)
            into.append(float(tube.extent(direction, HORIZON)))
    return np.array(even), np.array(split), shares


def compute(full: bool) -> tuple[Arrays, Claims]:
    """The growth with the number of masses, and the erosions at three masses."""
    masses = (3, 5, 10, 20, 30, 50, 100) if full else (3, 5, 8)
    rows = []
    for count in masses:
        rows.append(growth(count))
        lower, gain, *seconds = rows[-1]
        print(f"{count:3d} masses: {lower:.7f} <= L <= {gain:.7f}; seconds {', '.join(f'{s:.2f}' for s in seconds)}")
    problem = cb.load("chain_rest")
    common = common_erosion(problem)
    even, split, shares = own_erosions(problem)
    for name, erosion in (("one common metric", common), ("own metrics, even", even), ("own metrics, split", split)):
        print(f"{name:20s} " + " ".join(f"{x:.3f}" for x in erosion))
    table = np.array(rows)
    arrays: Arrays = {
        "masses": np.array(masses),
        "lower": table[:, 0],
        "gain": table[:, 1],
        "seconds": table[:, 2:],
        "common": common,
        "own_even": even,
        "own_split": split,
        "shares": shares,
    }
    claims: Claims = {
        "largest_masses": int(masses[-1]),
        "largest_gain": float(table[-1, 1]),
        "gain_3": float(table[0, 1]),
        "common_erosion": common.tolist(),
        "own_erosion_even": even.tolist(),
        "own_erosion_split": split.tolist(),
    }
    return arrays, claims


if __name__ == "__main__":
    main("metrics_growth", compute)
