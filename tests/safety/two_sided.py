"""Verdicts a little below and above the truth, of random problems of one and two states, on purpose.

    python -m tests.safety.two_sided [first] [last] [seconds]

Of every seed one problem is drawn whose probability of failing, p, lies between 1e-6 and .9: one state in continuous
time (p by a fine monotone scheme), one or two states in discrete time, or two in continuous time (both by simulated
paths, p at least 5e-3). The verdict is asked at delta = p/1.3, where UNSAFE is true, and at 1.3 p, where SAFE is.
Seconds are those of the processor.
"""

from __future__ import annotations

import sys
import time

import numpy as np

import certbound as cb
from experiments.literature import processor_clock
from tests.values.line_truth import bracket
from tests.values.random_problems import line_problem, plane_problem, simulated, step_problem

FACTOR = 1.3
RANGE = {"line": (1e-6, 0.69), "plane": (5e-3, 0.69), "steps": (5e-3, 0.69)}  # 1.3 of it below .9
PATHS, ROUGH = 100_000, 10_000


def drawn(seed: int) -> tuple[str, cb.Problem, float]:
    """The kind of a seed's problem, the problem, and the truth."""
    rng = np.random.default_rng([seed, 77])
    kind = ("line", "plane", "steps")[seed % 3]
    while True:
        if kind == "line":
            problem, low, high = line_problem(rng)
        else:
            problem, low, high = (plane_problem if kind == "plane" else step_problem)(rng), 0.0, 0.0
        if problem.system.dimension > 2 or (kind == "steps" and problem.system.disturbance is not None):
            continue
        truth = _truth(problem, kind, low, high)
        if RANGE[kind][0] <= truth <= RANGE[kind][1]:
            return kind, problem, truth


def _truth(problem: cb.Problem, kind: str, low: float, high: float) -> float:
    if kind == "line":
        return float(np.sqrt(np.prod(np.maximum(bracket(problem, low, high), 1e-300))))
    paths = np.random.default_rng(1)  # of its own: the problems do not depend on the simulations
    rough = simulated(problem, ROUGH, paths)[0] / ROUGH
    if not RANGE[kind][0] / 2 <= rough <= RANGE[kind][1] * 1.1:
        return 0.0
    return simulated(problem, PATHS, paths)[0] / PATHS


def check(seed: int, seconds: float) -> tuple[bool, str]:
    """Whether both verdicts are right, and a line about them."""
    kind, problem, truth = drawn(seed)
    begun = time.process_time()
    rows = []
    for delta in (truth / FACTOR, truth * FACTOR):
        with processor_clock():
            found = cb.verify_safety(problem.replace(delta=delta), time_limit=seconds)
        lower = 0.0 if found.log10_lower is None else 10**found.log10_lower
        rows.append((found.status, lower / truth, 10**found.log10_delta / truth, found.method))
    good = rows[0][0] == "UNSAFE" and rows[1][0] == "SAFE"
    words = "; ".join(f"{status} [{low:.3f}, {high:.3f}] {method}" for status, low, high, method in rows)
    spent = time.process_time() - begun
    return good, f"{seed} {kind} {problem.system.dimension} truth {truth:.4g}: {words}, {spent:.1f} s"


def main() -> None:
    """A line a problem (bounds over the truth), and how many are right on both sides."""
    first, last, seconds = (*sys.argv[1:], *("0", "40", "20")[len(sys.argv) - 1 :])
    right = 0
    for seed in range(int(first), int(last)):
        good, words = check(seed, float(seconds))
        right += good
        sys.stdout.write(("" if good else "MISSED ") + words + "\n")
        sys.stdout.flush()
    sys.stdout.write(f"{right} of {int(last) - int(first)}\n")


if __name__ == "__main__":
    main()
